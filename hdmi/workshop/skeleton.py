"""A human skeleton from published anthropometry, with SMPL's joints and rest pose.

It takes the place of a body model: joint rotations in SMPL's convention pose it, and only a height is needed to scale
it. Whoever has the body model's own file can take its joints instead (`body_model_skeleton`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hdmi.motion.check import MotionError
from hdmi.motion.files import read_npz
from hdmi.workshop.human import SMPL_JOINTS, SMPL_PARENTS, HumanMotion

# Rest positions in shares of the height: upright T-pose on the ground, x left, y up, z forward.
# - Hip, knee and ankle heights 0.530, 0.285, 0.039, shoulder height 0.818 and foot length 0.152: Drillis and Contini
#   (1966), as in Winter, Biomechanics and Motor Control of Human Movement, figure 4.1.
# - Upper arm 0.162 and forearm 0.154 between joint centres: de Leva (1996), table 4, men (281.7 and 268.9 mm of 1741).
# - Hip centres 0.10 apart: 0.36 of the distance of the anterior iliac spines (Bell et al. 1990), which is 0.24 m.
# - Shoulder centres 0.20 apart, so that with a hand of 0.108 (Winter) the arms span 1.05 heights.
# - Where along the trunk SMPL has its spine, neck and collar joints is not anatomy: rounded to a fraction of it.
_REST = {
    "pelvis": (0.0, 0.580, 0.0),
    "hip": (0.050, 0.530, 0.0),
    "knee": (0.050, 0.285, 0.0),
    "ankle": (0.050, 0.039, -0.015),
    "foot": (0.055, 0.012, 0.060),
    "spine1": (0.0, 0.645, -0.010),
    "spine2": (0.0, 0.725, -0.010),
    "spine3": (0.0, 0.757, -0.010),
    "neck": (0.0, 0.850, -0.020),
    "head": (0.0, 0.905, 0.0),
    "collar": (0.045, 0.805, -0.015),
    "shoulder": (0.100, 0.818, -0.020),
    "elbow": (0.262, 0.818, -0.020),
    "wrist": (0.416, 0.818, -0.020),
}
# Where SMPL's translation is measured from: its origin is at the chest, this far above the pelvis.
_ORIGIN_ABOVE_PELVIS = 0.14

GROUNDS = ("shift", "keep")
_SLACK = 0.05  # m; retargeting puts a sole on the ground that misses it by less
_FARTHEST = 10.0  # m, of a person from the ground

UPRIGHT = Rotation.from_quat([0.5, 0.5, 0.5, 0.5])  # of a T-pose that faces world x: x left, y up, z forward


@dataclass(frozen=True)
class Skeleton:
    """A tree of joints; with all rotations zero it stands in a T-pose, x left, y up, z forward.

    `offset` of the root is where it rests relative to the origin that translations move.

    Examples:
        >>> body = anthropometric_skeleton(height=2.0)
        >>> pos, quat = body.forward(np.zeros((1, 22, 3)), np.zeros((1, 3)))
        >>> hip, ankle = pos[0, body.index("left_hip")], pos[0, body.index("left_ankle")]
        >>> round(float(hip[1] - ankle[1]), 3)  # legs are 0.491 of the height
        0.982
    """

    joint_names: tuple[str, ...]
    parents: tuple[int, ...]  # -1 for the root, which comes first; else before the joint
    offset: np.ndarray  # [J, 3] m, from the parent, in the parent's frame
    height: float  # m

    def index(self, joint: str) -> int:
        """Number of a joint."""
        return self.joint_names.index(joint)

    def forward(self, rotation: np.ndarray, root_pos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses of all joints.

        Args:
            rotation: axis times angle, rad: of the root in the world, of the others relative to their parents.
                [T, J, 3]
            root_pos: m. [T, 3]

        Returns:
            Positions [T, J, 3] and orientations wxyz [T, J, 4].
        """
        num_frames = len(root_pos)
        local = Rotation.from_rotvec(rotation.reshape(-1, 3)).as_matrix().reshape(num_frames, -1, 3, 3)
        pos, mat = np.empty((num_frames, len(self.parents), 3)), np.empty_like(local)
        pos[:, 0], mat[:, 0] = root_pos, local[:, 0]
        for j, parent in enumerate(self.parents[1:], start=1):
            pos[:, j] = pos[:, parent] + mat[:, parent] @ self.offset[j]
            mat[:, j] = mat[:, parent] @ local[:, j]
        quat = Rotation.from_matrix(mat.reshape(-1, 3, 3)).as_quat(scalar_first=True)
        return pos, quat.reshape(num_frames, -1, 4)


def anthropometric_skeleton(height: float) -> Skeleton:
    """SMPL's 22 joints on a body of average proportions.

    Args:
        height: m.
    """
    rest = np.array([_rest_position(name) for name in SMPL_JOINTS]) * height
    offset = rest - rest[list(SMPL_PARENTS)]
    offset[0] = (0.0, -_ORIGIN_ABOVE_PELVIS * height, 0.0)
    return Skeleton(SMPL_JOINTS, SMPL_PARENTS, offset, height)


def _rest_position(joint: str) -> tuple[float, float, float]:
    side, _, part = joint.partition("_")
    if side not in ("left", "right"):
        return _REST[joint]
    x, y, z = _REST[part]
    return (x if side == "left" else -x, y, z)


def body_model_skeleton(path: str | Path, betas: np.ndarray | Sequence[float] = ()) -> Skeleton:
    """The first 22 joints of a body model's own npz file (SMPL, SMPL-H or SMPL-X), for a shape.

    Rest joints are `J_regressor (v_template + shapedirs betas)`; the height is that of the shaped vertices. Nothing
    else of the model is read.

    Args:
        path: such as `SMPLX_NEUTRAL.npz`. Pickles (.pkl) are refused.
        betas: shape; those that the model lacks are ignored. [S]

    Raises:
        MotionError: if the file is not such a model.
    """
    keys = ("v_template", "shapedirs", "J_regressor", "kintree_table")
    arrays = read_npz(path, keys)
    if missing := [key for key in keys if key not in arrays]:
        raise MotionError(f"{path}: not a body model: lacks {', '.join(missing)}")
    template, directions, regressor, tree = (arrays[key] for key in keys)
    if any(array.dtype.kind not in "fiu" for array in arrays.values()):
        raise MotionError(f"{path}: not a body model: {', '.join(keys)} must be numbers")
    joints, vertices = len(SMPL_JOINTS), len(np.atleast_1d(template))
    shapes = (template.shape, directions.shape[:2], regressor.shape[1:], tree.shape[:1])
    if shapes != ((vertices, 3), (vertices, 3), (vertices,), (2,)) or directions.ndim != 3 or len(regressor) < joints:
        raise MotionError(f"{path}: shapes of v_template, shapedirs, J_regressor and kintree_table do not agree")
    parents = tuple(int(np.int32(np.uint32(p & 0xFFFFFFFF))) for p in tree[0, :joints].astype(np.int64))
    if (-1, *parents[1:]) != SMPL_PARENTS:
        raise MotionError(f"{path}: kintree_table: the first {joints} joints are not SMPL's")
    shape = np.asarray(betas, dtype=float)[: directions.shape[2]]
    body = template + directions[..., : len(shape)] @ shape
    rest = (regressor @ body)[:joints]
    offset = rest - rest[list(SMPL_PARENTS)]
    offset[0] = rest[0]
    if not np.isfinite(offset).all():
        raise MotionError(f"{path}: J_regressor: joints are not finite")
    return Skeleton(SMPL_JOINTS, SMPL_PARENTS, offset, float(np.ptp(body[:, 1])))


def pose_skeleton(
    name: str,
    skeleton: Skeleton,
    rotation: np.ndarray,
    transl: np.ndarray,
    fps: float,
    *,
    y_up: bool,
) -> HumanMotion:
    """A human motion from SMPL's parameters.

    The root is at its rest position plus `transl`; SMPL rotates the body about the root, not about the origin.

    Args:
        rotation: axis times angle, rad; the first is `global_orient`, the others `body_pose`. [T, J, 3]
        transl: m. [T, 3]
        y_up: whether y, not z, is up in the file's world.
    """
    pos, quat = skeleton.forward(rotation, transl + skeleton.offset[0])
    if y_up:
        pos, quat = z_up(pos), z_up_quat(quat)
    return HumanMotion(name, fps, skeleton.height, skeleton.joint_names, pos, quat)


def z_up(pos: np.ndarray) -> np.ndarray:
    """Points from a world in which y is up. [..., 3]"""
    return np.stack([pos[..., 0], -pos[..., 2], pos[..., 1]], axis=-1)


def z_up_quat(quat: np.ndarray) -> np.ndarray:
    """Orientations wxyz from a world in which y is up. [..., 4]"""
    turn = Rotation.from_euler("x", 90, degrees=True)
    turned = turn * Rotation.from_quat(quat.reshape(-1, 4), scalar_first=True)
    return turned.as_quat(scalar_first=True).reshape(quat.shape)


def height_from_legs(joint_names: Sequence[str], joint_pos: np.ndarray) -> float:
    """Height of a person from the length of the legs: thigh and shank are 0.491 of it (`_REST`).

    Args:
        joint_pos: m. [T, J, 3]

    Raises:
        MotionError: without hip, knee and ankle of a side.
    """
    lengths, missing = [], []
    for side in ("left", "right"):
        parts = [f"{side}_{part}" for part in ("hip", "knee", "ankle")]
        missing += [part for part in parts if part not in joint_names]
        if all(part in joint_names for part in parts):
            hip, knee, ankle = (joint_pos[:, list(joint_names).index(part)] for part in parts)
            length = np.linalg.norm(hip - knee, axis=-1) + np.linalg.norm(knee - ankle, axis=-1)
            lengths.append(np.median(length))
    if not lengths:
        raise MotionError(f"height: cannot be told from the legs, which lack {', '.join(missing)}; give height")
    return float(np.mean(lengths)) / (_REST["hip"][1] - _REST["ankle"][1])


def height_above_ground(motion: HumanMotion) -> float | None:
    """How far the lowest sole is above the ground, m; below zero, the ground is above it.

    Soles are the feet's resting height below the joints `left_ankle`, `right_ankle`, `left_foot` and `right_foot`,
    those of them that the motion has; none: None. Another joint that is lower counts too: somebody may stand on their
    hands. The 1st percentile over frames counts, not one outlier.
    """
    soles = {f"{side}_{part}": _REST[part][1] for side in ("left", "right") for part in ("ankle", "foot")}
    if not soles.keys() & set(motion.joint_names):
        return None
    gaps = [
        motion.pos(joint)[:, 2] - soles.get(joint, 0.0) * motion.height
        for joint in motion.joint_names
        if joint in SMPL_JOINTS
    ]
    return float(np.percentile(np.min(gaps, axis=0), 1))


def stand_on_ground(motion: HumanMotion) -> HumanMotion:
    """The motion shifted vertically until its lowest sole touches the ground (`height_above_ground`)."""
    gap = height_above_ground(motion)
    return motion if gap is None else motion.shifted(np.array([0.0, 0.0, -gap], np.float32))


def grounded(motion: HumanMotion, ground: str | None, slack: float = _SLACK) -> HumanMotion:
    """The motion with its lowest sole on the ground, or a note of how far it is from it.

    Args:
        ground: `shift` it there, `keep` its height, or None: shift what misses the ground by more than `slack`.
        slack: m.

    Raises:
        MotionError: for an unknown `ground`, or if it is None and the ground is too far away for lengths in metres.
    """
    if ground not in (None, *GROUNDS):
        raise MotionError(f"ground: {' or '.join(GROUNDS)} expected, got {ground!r}")
    gap = height_above_ground(motion)
    if gap is None:
        return motion
    where = f"the lowest sole is {abs(gap):.2f} m {'above' if gap > 0 else 'below'} the ground"
    if abs(gap) > _FARTHEST and ground is None:
        raise MotionError(f"{where}: are lengths in the unit that was taken? Give unit, in m, or ground=shift")
    noted = abs(gap) > _SLACK
    if ground == "keep":
        return replace(motion, notes=(*motion.notes, f"{where}, and kept there")) if noted else motion
    if ground is None and abs(gap) <= slack:
        return motion
    notes = (f"shifted by {-gap:+.2f} m onto the ground; ground=keep does not",) if noted else ()
    return replace(stand_on_ground(motion), notes=(*motion.notes, *notes))
