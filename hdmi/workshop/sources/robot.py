"""References of the same robot in other projects' npz formats: mjlab and BeyondMimic, holosoma."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from hdmi.assets import default_joint_pos, g1, g1_robot
from hdmi.motion.check import MotionError, checked, checked_fps, checked_names, checked_quat
from hdmi.motion.complete import complete_robot
from hdmi.motion.files import read_npz, write_npz
from hdmi.motion.format import Motion, motion_from_poses
from hdmi.motion.kinematics import forward_kinematics
from hdmi.workshop.sources.conventions import Conventions, reread, settle
from hdmi.workshop.sources.layouts import breadth_first

Order = Literal["mujoco", "isaac"]

_BODY_KEYS = {"body_pos_w": 3, "body_quat_w": 4, "body_lin_vel_w": 3, "body_ang_vel_w": 3}
_OBJECT_KEYS = {"object_pos_w": 3, "object_quat_w": 4, "object_lin_vel_w": 3, "object_ang_vel_w": 3}
_MAX_FK_ERROR = 0.05  # m; more is another robot, or another order
_FOREIGN = "not this robot's"


# -- mjlab, BeyondMimic ---------------------------------------------------------------------------------------


def table_order(order: Order) -> tuple[list[int], list[int]]:
    """Where the table's joints and bodies are taken from: row i of a file is number `index[i]` of the table.

    MuJoCo counts depth first, as the robot table does, Isaac Lab breadth first.
    """
    if order == "isaac":
        return breadth_first()
    return list(range(len(g1.JOINT_NAMES))), list(range(len(g1.BODY_NAMES)))


def read_mjlab(path: str | Path, order: Order | None = None, given: Conventions | None = None) -> Motion:
    """A motion of mjlab or BeyondMimic (whole_body_tracking): an npz of the robot's 29 joints and 30 bodies.

    The file names neither: its order is mjlab's (MuJoCo, depth first) or BeyondMimic's (Isaac Lab, breadth first).

    Args:
        order: of joints and bodies; None takes the one in which forward kinematics reproduces the bodies.
        given: how the file means its numbers.

    Raises:
        MotionError: if the file is not such a motion, is one of another robot, or looks misread, see `settle`.
    """
    path, given = Path(path), given or Conventions()
    arrays = read_npz(path, {"fps", "joint_pos", "joint_vel", *_BODY_KEYS})
    num_frames = _num_frames(path, arrays, ("fps", "joint_pos", "joint_vel", *_BODY_KEYS))
    fps = _fps(path, arrays["fps"])
    because = " from joint_pos and the robot table"
    values = {}
    for key in ("joint_pos", "joint_vel"):
        values[key] = checked(path, key, arrays[key], (num_frames, len(g1.JOINT_NAMES)), because)
    for key, width in _BODY_KEYS.items():
        values[key] = checked(path, key, arrays[key], (num_frames, len(g1.BODY_NAMES), width), because)
    values["body_quat_w"] = checked_quat(path, "body_quat_w", values["body_quat_w"], g1.BODY_NAMES, "row of")
    orders: tuple[Order, ...] = ("mujoco", "isaac") if order is None else (order,)
    motions = [_in_table_order(path.stem, fps, values, o) for o in orders]
    candidates = [reread(motion, given) for motion in motions]
    errors = [_kinematic_error(candidate) for candidate in candidates]
    best = int(np.argmin(errors))
    if errors[best] > _MAX_FK_ERROR:
        raise MotionError(
            f"{path}: body_pos_w: {errors[best]:.2f} m from the joints' forward kinematics in the order of "
            f"{' or '.join(orders)}: {_other_reading(motions, given) or _FOREIGN}"
        )
    return settle(candidates[best], path, given)


def _other_reading(motions: Sequence[Motion], given: Conventions) -> str | None:
    """Options under which forward kinematics would reproduce the bodies."""
    for quat, angles, unit in product((given.quat, "xyzw"), (given.angles, "degrees"), (given.unit, 0.01, 0.001)):
        other = replace(given, quat=quat, angles=angles, unit=unit)
        if other != given and min(_kinematic_error(reread(motion, other)) for motion in motions) < _MAX_FK_ERROR:
            pairs = (("quat", quat), ("angles", angles), ("unit", unit))
            return f"give {' '.join(f'{key}={value}' for key, value in pairs if value != getattr(given, key))}"
    return None


def _in_table_order(name: str, fps: float, values: dict[str, np.ndarray], order: Order) -> Motion:
    joints, bodies = (np.argsort(index) for index in table_order(order))
    arrays = {key: array[:, bodies if key in _BODY_KEYS else joints] for key, array in values.items()}
    return Motion(name=name, fps=fps, body_names=g1.BODY_NAMES, joint_names=g1.JOINT_NAMES, **arrays)


def _kinematic_error(motion: Motion) -> float:
    """Mean distance between the bodies and their forward kinematics over a few frames, m."""
    frames = np.linspace(0, motion.num_frames - 1, 10).astype(int)
    pos, quat = motion.body_pos_w[frames], motion.body_quat_w[frames]
    expected, _ = forward_kinematics(g1_robot(), pos[:, 0], quat[:, 0], motion.joint_pos[frames])
    error = np.linalg.norm(pos - expected, axis=-1).mean()
    return float(error) if np.isfinite(error) else np.inf


def write_mjlab(motion: Motion, path: str | Path, order: Order = "mujoco") -> tuple[Path, list[str]]:
    """Writes the npz that mjlab (order `mujoco`) or BeyondMimic (order `isaac`) read.

    Returns:
        The file, and what of the motion it cannot hold.
    """
    full = complete_robot(motion)
    joints, bodies = table_order(order)
    arrays = {"fps": np.array([motion.fps])}
    arrays |= {key: getattr(full, key)[:, joints] for key in ("joint_pos", "joint_vel")}
    arrays |= {key: getattr(full, key)[:, bodies] for key in _BODY_KEYS}
    return write_npz(path, arrays), lost_by(full, bodies=True)


# -- holosoma -------------------------------------------------------------------------------------------------


def read_holosoma(path: str | Path, object_name: str | None = None, given: Conventions | None = None) -> Motion:
    """A motion of holosoma: an npz with names, and `object_*` arrays if there is an object.

    Its `joint_pos` and `joint_vel` may start with the free root's 7 and 6 columns, which the root's body repeats; its
    `body_names` with the world.

    Args:
        object_name: of the object's body; None takes the one body that is not the robot's, else "object".
        given: how the file means its numbers.

    Raises:
        MotionError: if the file is not such a motion, or looks misread, see `settle`.
    """
    path, given = Path(path), given or Conventions()
    names = ("joint_names", "body_names")
    arrays = read_npz(path, {"fps", "joint_pos", "joint_vel", *names, *_BODY_KEYS, *_OBJECT_KEYS})
    num_frames = _num_frames(path, arrays, ("fps", "joint_pos", "joint_vel", *names, *_BODY_KEYS))
    fps = _fps(path, arrays["fps"])
    joint_names, body_names = (_names(path, key, arrays[key]) for key in names)
    values = {}
    for key, free in (("joint_pos", 7), ("joint_vel", 6)):
        raw = arrays[key]
        if raw.ndim == 2 and raw.shape[1] == free + len(joint_names):
            raw = raw[:, free:]
        values[key] = checked(path, key, raw, (num_frames, len(joint_names)), " from joint_names, with or without root")
    for key, width in _BODY_KEYS.items():
        values[key] = checked(path, key, arrays[key], (num_frames, len(body_names), width), " from body_names")
    if "world" in body_names:
        keep = [i for i, name in enumerate(body_names) if name != "world"]
        body_names = tuple(body_names[i] for i in keep)
        values |= {key: values[key][:, keep] for key in _BODY_KEYS}
    object_keys = [key for key in _OBJECT_KEYS if key in arrays]
    if object_keys:
        if len(object_keys) != len(_OBJECT_KEYS):
            raise MotionError(f"{path}: lacks {', '.join(key for key in _OBJECT_KEYS if key not in arrays)}")
        if object_name is None:
            others = [name for name in body_names if name not in g1.BODY_NAMES]
            object_name = others[0] if len(others) == 1 else "object"
        if object_name not in body_names:
            body_names = (*body_names, object_name)
            for key, width in _BODY_KEYS.items():
                values[key] = np.concatenate([values[key], np.empty((num_frames, 1, width), np.float32)], axis=1)
        i = body_names.index(object_name)
        for key, width in _OBJECT_KEYS.items():
            body_key = key.replace("object", "body")
            values[body_key][:, i] = checked(path, key, arrays[key], (num_frames, width), " from joint_pos")
    values["body_quat_w"] = checked_quat(path, "body_quat_w", values["body_quat_w"], body_names, "body")
    motion = Motion(name=path.stem, fps=fps, body_names=body_names, joint_names=joint_names, **values)
    return settle(reread(motion, given), path, given)


def _names(path: Path, key: str, array: np.ndarray) -> tuple[str, ...]:
    if array.dtype.kind not in "US" or array.ndim != 1:
        raise MotionError(f"{path}: {key}: strings expected, got dtype {array.dtype}, shape {array.shape}")
    return checked_names(path, key, array.astype(str).tolist())


def write_holosoma(motion: Motion, path: str | Path, object_name: str | None = None) -> tuple[Path, list[str]]:
    """Writes the npz that holosoma reads: all bodies, the robot's joints, and the object if there is one.

    Args:
        object_name: which body becomes `object_*`; None takes the one that is not the robot's if there is but one.

    Returns:
        The file, and what of the motion it cannot hold.

    Raises:
        MotionError: if the motion has no such body.
    """
    full = complete_robot(motion)
    count = len(g1.JOINT_NAMES)
    world = {"body_pos_w": (0, 0, 0), "body_quat_w": (1, 0, 0, 0), "body_lin_vel_w": (0, 0, 0)}
    arrays = {"fps": np.array([motion.fps])}
    root = {key: getattr(full, key)[:, 0] for key in _BODY_KEYS}
    # the free joint as MuJoCo has it: angular velocity in the root's frame
    turn = Rotation.from_quat(root["body_quat_w"], scalar_first=True)
    ang_vel_b = turn.inv().apply(root["body_ang_vel_w"]).astype(np.float32)
    arrays["joint_pos"] = np.concatenate([root["body_pos_w"], root["body_quat_w"], full.joint_pos[:, :count]], axis=1)
    arrays["joint_vel"] = np.concatenate([root["body_lin_vel_w"], ang_vel_b, full.joint_vel[:, :count]], axis=1)
    for key in _BODY_KEYS:
        values = getattr(full, key)
        at = np.broadcast_to(np.asarray(world.get(key, (0, 0, 0)), np.float32), (len(values), 1, values.shape[2]))
        arrays[key] = np.concatenate([at, values], axis=1)
    others = full.body_names[len(g1.BODY_NAMES) :]
    if object_name is not None and object_name not in others:
        raise MotionError(f"motion {motion.name!r}: body_names has no object {object_name!r}; it has {list(others)}")
    if object_name is None and len(others) == 1:
        object_name = others[0]
    lost = lost_by(full, bodies=False)
    if object_name is not None:
        i = full.body_names.index(object_name)
        arrays |= {key: getattr(full, key.replace("object", "body"))[:, i] for key in _OBJECT_KEYS}
    elif others:
        lost.append(f"which of {', '.join(others)} is the object: name it")
    arrays["joint_names"], arrays["body_names"] = np.array(g1.JOINT_NAMES), np.array(["world", *full.body_names])
    return write_npz(path, arrays), lost


# -- shared ---------------------------------------------------------------------------------------------------


def robot_motion(
    where: object,
    name: str,
    fps: float,
    root_pos: np.ndarray,
    root_quat: np.ndarray,
    joint_names: Sequence[str],
    joint_pos: np.ndarray,
    given: Conventions,
    usual: str,
    fields: tuple[str, str, str],
) -> Motion:
    """A motion of the robot alone: bodies from forward kinematics, velocities from differences.

    Args:
        where: what messages start with: file, and clip if it holds several.
        root_pos, root_quat: float32, as the file has them. [T, 3] and [T, 4]
        joint_names, joint_pos: in any order, rad; what the robot lacks is dropped. [T, J]
        usual: order of quaternions in this format.
        fields: what holds positions, orientations and joint angles in the file.

    Raises:
        MotionError: for quaternions that are not unit, or a robot that looks misread, see `settle`.
    """
    quat = checked_quat(where, fields[1], given.wxyz(root_quat, usual)[:, None], ["root"], "body")[:, 0]
    pos = checked(where, fields[0], given.metres(root_pos), root_pos.shape)
    kept = [i for i, joint in enumerate(joint_names) if joint in g1.JOINT_NAMES]
    joint_names, joint_pos = tuple(joint_names[i] for i in kept), joint_pos[:, kept]
    table = np.tile(default_joint_pos(), (len(pos), 1))
    table[:, [g1.JOINT_NAMES.index(joint) for joint in joint_names]] = joint_pos
    body_pos, body_quat = forward_kinematics(g1_robot(), pos, quat, table)
    body_pos[:, 0], body_quat[:, 0] = pos, quat
    checked(where, fields[0], body_pos, body_pos.shape)
    motion = motion_from_poses(name, fps, g1.BODY_NAMES, joint_names, body_pos, body_quat, joint_pos)
    return settle(motion, where, given, usual=usual, fields=fields)


def _num_frames(path: Path, arrays: dict[str, np.ndarray], required: tuple[str, ...]) -> int:
    if missing := [key for key in required if key not in arrays]:
        raise MotionError(
            f"{path}: lacks {', '.join(missing)}; it has {', '.join(sorted(arrays)) or 'nothing of them'}"
        )
    num_frames = len(np.atleast_1d(arrays["joint_pos"]))
    if num_frames < 2:
        raise MotionError(f"{path}: joint_pos: needs at least 2 frames, has {num_frames}")
    return num_frames


def _fps(path: Path, array: np.ndarray) -> float:
    return checked_fps(path, float(checked(path, "fps", array.reshape(array.shape or (1,)), (1,))[0]))


def lost_by(full: Motion, *, bodies: bool) -> list[str]:
    """What formats of the robot alone leave out of a completed motion."""
    lost = []
    if others := full.joint_names[len(g1.JOINT_NAMES) :]:
        lost.append(f"joints {', '.join(others)}")
    if bodies and (others := full.body_names[len(g1.BODY_NAMES) :]):
        lost.append(f"bodies {', '.join(others)}")
    if full.object_contact is not None:
        lost.append("object_contact")
    if full.contact_points is not None:
        lost.append("contact_points")
    if full.joint_target is not None:
        lost.append("joint_target")
    return lost
