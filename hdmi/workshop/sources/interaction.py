"""Sources of persons with objects: OMOMO and InterMimic."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Unpack

import numpy as np
from scipy.spatial.transform import Rotation
from torch import Tensor

from hdmi.motion.check import MotionError, checked, checked_quat
from hdmi.motion.files import read_npz, read_torch, reading, tensor_array
from hdmi.workshop.human import SMPL_JOINTS, SMPL_PARENTS, HumanMotion, ObjectTrajectory
from hdmi.workshop.skeleton import UPRIGHT, Skeleton, height_from_legs, pose_skeleton
from hdmi.workshop.sources.world import World, checked_height, fps_of, placed, unit_of, without_blank_ends

_FPS = 30.0  # of both

_OMOMO_JOINTS = (*SMPL_JOINTS, "left_hand", "right_hand")
_OMOMO_PARENTS = (*SMPL_PARENTS, 20, 21)

_FINGERS = tuple(f"{finger}{i}" for finger in ("index", "middle", "pinky", "ring", "thumb") for i in (1, 2, 3))
# bodies of the simulated person, depth first, under SMPL's names
_INTERMIMIC_JOINTS = (
    "pelvis",
    *("left_hip", "left_knee", "left_ankle", "left_foot"),
    *("right_hip", "right_knee", "right_ankle", "right_foot"),
    *("spine1", "spine2", "spine3", "neck", "head"),
    *("left_collar", "left_shoulder", "left_elbow", "left_wrist", *(f"left_{finger}" for finger in _FINGERS)),
    *("right_collar", "right_shoulder", "right_elbow", "right_wrist", *(f"right_{finger}" for finger in _FINGERS)),
)
_BODIES = len(_INTERMIMIC_JOINTS)  # 52
_WIDTH = 331 + 5 * _BODIES  # 591 columns


def read_omomo(path: str | Path, fps: float | None = None, **world: Unpack[World]) -> HumanMotion:
    """One sequence of OMOMO, z up at 30 fps, as an npz with the field names of OMOMO's pickle.

    The pickle itself is refused, like every pickle; docs/motions.md shows how to export one that you trust. Joints
    come from the sequence's own `rest_offsets`. The object's mesh is to be scaled by `obj_scale`.

    Reads seq_name, trans [T, 3] (of the pelvis), root_orient [T, 3], pose_body [T, 63], rest_offsets [22 or 24, 3],
    obj_trans [T, 3] or [T, 3, 1], obj_rot [T, 3, 3].

    Args:
        fps: instead of OMOMO's.
        world: see `World`.

    Raises:
        MotionError: if the file is not such a sequence.
    """
    path = Path(path)
    keys = ("trans", "root_orient", "pose_body", "rest_offsets", "obj_trans", "obj_rot")
    arrays = read_npz(path, ("seq_name", *keys))
    if missing := [key for key in keys if key not in arrays]:
        raise MotionError(f"{path}: not a sequence of OMOMO: lacks {', '.join(missing)}")
    num_frames = len(np.atleast_1d(arrays["trans"]))
    if num_frames < 2:
        raise MotionError(f"{path}: trans: needs at least 2 frames, has {num_frames}")
    trans = checked(path, "trans", arrays["trans"], (num_frames, 3))
    root = checked(path, "root_orient", arrays["root_orient"], (num_frames, 3), " from trans")
    body = checked(path, "pose_body", arrays["pose_body"], (num_frames, 63), " from trans")
    count = len(np.atleast_1d(arrays["rest_offsets"]))
    if count not in (len(SMPL_JOINTS), len(_OMOMO_JOINTS)):
        raise MotionError(f"{path}: rest_offsets: {count} joints, expected {len(SMPL_JOINTS)} or {len(_OMOMO_JOINTS)}")
    offsets = checked(path, "rest_offsets", arrays["rest_offsets"], (count, 3)).astype(float)
    obj_pos = arrays["obj_trans"][..., 0] if arrays["obj_trans"].ndim == 3 else arrays["obj_trans"]
    obj_pos = checked(path, "obj_trans", obj_pos, (num_frames, 3), " from trans")
    obj_rot = checked(path, "obj_rot", arrays["obj_rot"], (num_frames, 3, 3), " from trans").astype(float)
    error = np.abs(obj_rot @ obj_rot.swapaxes(1, 2) - np.eye(3)).max((1, 2))
    if (bad := np.flatnonzero((error > 1e-2) | (np.linalg.det(obj_rot) < 0))).size:
        raise MotionError(f"{path}: obj_rot: not a rotation at frame {bad[0]}")

    name = str(arrays.get("seq_name", path.stem))
    rotation = np.zeros((num_frames, count, 3))
    rotation[:, :22] = np.concatenate([root, body], axis=1).reshape(num_frames, 22, 3)
    # here the translation is the pelvis itself
    offsets[0] = 0.0
    names, parents = _OMOMO_JOINTS[:count], _OMOMO_PARENTS[:count]
    with reading(path):
        unit = unit_of(world, 1.0)
        skeleton = Skeleton(names, parents, offsets * unit, height=np.nan)
        rest, _ = skeleton.forward(np.zeros((1, count, 3)), np.zeros((1, 3)))
        skeleton = replace(skeleton, height=checked_height(height_from_legs(names, rest), unit, world, None))
        rate, notes = fps_of(fps, _FPS, "OMOMO")
        kept, dropped = without_blank_ends(np.concatenate([root, body, trans], axis=1))
        motion = pose_skeleton(name, skeleton, rotation[kept], trans[kept] * unit, rate, y_up=False)
        quat = Rotation.from_matrix(obj_rot).as_quat(scalar_first=True)
        thing = ObjectTrajectory(_object_of(name), obj_pos[kept] * unit, quat[kept])
        return placed(replace(motion, object=thing, notes=notes + dropped), "z", unit, world)


def read_intermimic(
    path: str | Path, height: float | None = None, fps: float | None = None, **world: Unpack[World]
) -> HumanMotion:
    """One sequence of InterMimic: a tensor of 591 columns, z up at 30 fps.

    Columns: root 0-7, joints 9-162, body positions 162-318, object pose 318-325 (xyzw), contact of the object 330 and
    of the 52 bodies 331-383 (1 touches, -1 must not), body orientations 383-591 (xyzw). Contacts of fingers count as
    their wrist's. Blank frames at start and end, which the project's own retargeted sequences have, are dropped.

    Args:
        height: of the person, m; from the length of the legs if not given.
        fps: instead of InterMimic's.
        world: see `World`.

    Raises:
        MotionError: if the file is not such a sequence.
    """
    path = Path(path)
    tensor = read_torch(path)
    if not isinstance(tensor, Tensor) or tensor.ndim != 2 or tensor.shape[1] != _WIDTH:
        shape = tuple(tensor.shape) if isinstance(tensor, Tensor) else type(tensor).__name__
        raise MotionError(f"{path}: not a sequence of InterMimic: {shape}, expected a tensor of shape (T, {_WIDTH})")
    data = tensor_array(path, "tensor", tensor)
    num_frames = len(data)
    if num_frames < 2:
        raise MotionError(f"{path}: tensor: needs at least 2 frames, has {num_frames}")
    data = checked(path, "tensor", data, data.shape)
    quat, obj_quat = _wxyz(data[:, 383:].reshape(num_frames, _BODIES, 4)), _wxyz(data[:, None, 321:325])
    kept, dropped = without_blank_ends(np.concatenate([data[:, 162:318], data[:, 383:]], axis=1))
    ends = np.ones(num_frames, bool)
    ends[kept] = False  # checked as the identity and dropped afterwards, so that messages have the file's frames
    quat[ends], obj_quat[ends] = [1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]
    quat = checked_quat(path, "columns 383-591", quat, _INTERMIMIC_JOINTS, "body")[kept]
    obj_quat = checked_quat(path, "columns 321-325", obj_quat, ["object"], "object")[kept, 0]
    data = data[kept]
    # its bodies rest with x forward, y left and z up
    turned = Rotation.from_quat(quat.reshape(-1, 4), scalar_first=True) * UPRIGHT
    quat = turned.as_quat(scalar_first=True).reshape(quat.shape)
    touching = data[:, 331:383] > 0.5
    names = tuple(name for name in _INTERMIMIC_JOINTS if name in SMPL_JOINTS)
    contact = np.stack([touching[:, _contact_columns(name)].any(1) for name in names], axis=1)
    with reading(path):
        unit = unit_of(world, 1.0)
        pos = data[:, 162:318].reshape(-1, _BODIES, 3) * unit
        rate, notes = fps_of(fps, _FPS, "InterMimic")
        motion = HumanMotion(
            path.stem,
            rate,
            checked_height(height_from_legs(_INTERMIMIC_JOINTS, pos), unit, world, height),
            _INTERMIMIC_JOINTS,
            pos,
            quat,
            ObjectTrajectory(_object_of(path.stem), data[:, 318:321] * unit, obj_quat),
            contact,
            names,
            notes + dropped,
        )
        return placed(motion, "z", unit, world)


def _contact_columns(joint: str) -> list[int]:
    side = joint.removesuffix("_wrist")
    fingers = [f"{side}_{finger}" for finger in _FINGERS] if joint.endswith("_wrist") else []
    return [_INTERMIMIC_JOINTS.index(name) for name in (joint, *fingers)]


def _object_of(sequence: str) -> str:
    """Both name their sequences subject_object_number."""
    parts = sequence.split("_")
    return parts[-2] if len(parts) > 2 else "object"


def _wxyz(xyzw: np.ndarray) -> np.ndarray:
    return np.roll(xyzw, 1, axis=-1)
