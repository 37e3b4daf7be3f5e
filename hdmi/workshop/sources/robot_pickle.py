"""Pickles of robot motions: those of GMR, and those of PHC, ASAP and PBHC."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hdmi.assets import default_joint_pos, g1, g1_robot
from hdmi.motion.check import MotionError, checked, checked_fps, checked_names
from hdmi.motion.complete import is_finger_joint
from hdmi.motion.format import Motion
from hdmi.motion.kinematics import forward_kinematics
from hdmi.workshop.sources.conventions import Conventions
from hdmi.workshop.sources.layouts import LAYOUTS, choose_layout
from hdmi.workshop.sources.plain_pickle import read_plain_pickle
from hdmi.workshop.sources.robot import robot_motion

_POSITION = ("root_pos", "root_trans_offset", "root_trans")
_ROTATION = ("root_rot", "root_quat")
_JOINTS = ("dof_pos", "dof")
_RATE = ("fps", "motion_fps", "mocap_framerate")
_NAMES = ("dof_names", "joint_names")
_AXES_ANGLES = "pose_aa"
_NOT_NEEDED = ("local_body_pos", "link_body_list", "smpl_joints", "body_names", "contact_mask", "dof_vel")
_OFF_AXIS = 0.02  # rad that a joint may turn about another axis than its own
_MAX_FK_ERROR = 0.05  # m
_SHOWN = 12


def read_robot_pickle(
    path: str | Path,
    fps: float | None = None,
    *,
    clip: str | None = None,
    joints: str | None = None,
    given: Conventions | None = None,
) -> Motion:
    """A robot's motion as GMR, PHC, ASAP and PBHC pickle them; no code of the file is run, see `read_plain_pickle`.

    GMR's is a dict with `fps`, `root_pos` [T, 3], `root_rot` [T, 4] (xyzw) and `dof_pos` [T, J]; that of the others a
    dict of clips with `fps`, `root_trans_offset`, `root_rot` (or the first row of `pose_aa`) and `dof` (or the others).
    Bodies come from forward kinematics, velocities from differences.

    Args:
        fps: where the file does not say.
        clip: the name of one of several clips.
        joints: which they are, a name in `LAYOUTS`, where the file does not name them (`dof_names`).
        given: how the file means its numbers.

    Raises:
        MotionError: if the file is not such a pickle or holds anything but numbers and numpy arrays, if it holds
            several clips and none is chosen, or if the robot in it looks misread, see `settle`.
    """
    path, given = Path(path), given or Conventions()
    name, where, content = _chosen(path, read_plain_pickle(path), clip)
    position, rotation, angles_key, rate = (
        next((key for key in keys if content.get(key) is not None), None)
        for keys in (_POSITION, _ROTATION, _JOINTS, _RATE)
    )
    has_poses = content.get(_AXES_ANGLES) is not None
    if position is None or (not has_poses and (rotation is None or angles_key is None)):
        raise MotionError(
            f"{where}: needs {' or '.join(_POSITION)}, {' or '.join(_ROTATION)} and {' or '.join(_JOINTS)}; "
            f"it has {_listed(content)}"
        )
    fps = _rate(where, fps, None if rate is None else _array(where, rate, content[rate]))
    pos = _array(where, position, content[position])
    num_frames = len(pos) if pos.ndim else 0
    if num_frames < 2:
        raise MotionError(f"{where}: {position}: needs at least 2 frames, has {num_frames}")
    pos = checked(where, position, pos, (num_frames, 3))
    poses = _poses(where, content, num_frames)
    if rotation is not None:
        quat = checked(where, rotation, _array(where, rotation, content[rotation]), (num_frames, 4))
    else:
        rotation, given = _AXES_ANGLES, replace(given, quat="xyzw")
        quat = Rotation.from_rotvec(poses[:, 0]).as_quat().astype(np.float32)
    if angles_key is None:
        angles_key = _AXES_ANGLES
        joint_names, angles = _from_poses(where, poses, joints)
    else:
        angles = _array(where, angles_key, content[angles_key])
        angles = angles[..., 0] if angles.ndim == 3 and angles.shape[2] == 1 else angles
        angles = given.radians(checked(where, angles_key, angles, (num_frames, *angles.shape[1:2])))
        usual = "g1_29dof_anneal_23dof" if position != _POSITION[0] else None
        joint_names = _joints(f"{where}: {angles_key}", content, angles, poses, joints, usual)
    if lost := [joint for joint in joint_names if joint not in g1.JOINT_NAMES]:
        warnings.warn(f"{where}: joints of hands are dropped: {', '.join(lost)}", stacklevel=2)
    used = {position, rotation, angles_key, rate, *_NAMES, *_NOT_NEEDED, _AXES_ANGLES}
    if unused := [str(key) for key, value in content.items() if key not in used and value is not None]:
        warnings.warn(f"{where}: not read: {_listed(unused)}", stacklevel=2)
    fields = (position, rotation, angles_key)
    return robot_motion(where, name, fps, pos, quat, joint_names, angles, given, "xyzw", fields)


def _rate(where: str, given: float | None, own: np.ndarray | None) -> float:
    if own is None:
        if given is None:
            raise MotionError(f"{where}: does not say its rate ({', '.join(_RATE)}): give source_fps")
        return checked_fps(where, given)
    if own.size != 1:
        raise MotionError(f"{where}: fps: a number expected, got shape {own.shape}")
    fps = checked_fps(where, float(own.reshape(-1)[0]))
    if given is not None and abs(given - fps) > 1e-3:
        warnings.warn(f"{where}: says its rate itself, {fps:g} fps: source_fps={given:g} is not used", stacklevel=3)
    return fps


def _poses(where: str, content: dict[str, Any], num_frames: int) -> np.ndarray:
    """`pose_aa`: rotation vectors of root, joints and links that are no joints. [T, B, 3], no B if there is none"""
    if content.get(_AXES_ANGLES) is None:
        return np.zeros((num_frames, 0, 3))
    poses = _array(where, _AXES_ANGLES, content[_AXES_ANGLES])
    if not poses.size or poses.size % (3 * num_frames) or len(poses) not in (1, num_frames):
        raise MotionError(f"{where}: {_AXES_ANGLES}: shape {poses.shape}, expected ({num_frames}, bodies, 3)")
    return checked(where, _AXES_ANGLES, poses, poses.shape).reshape(num_frames, -1, 3)


def _joints(
    where: str, content: dict[str, Any], angles: np.ndarray, poses: np.ndarray, given: str | None, usual: str | None
) -> tuple[str, ...]:
    """Names of the joints: those that the file has, else those that it shows, else the usual ones."""
    named = next((key for key in _NAMES if isinstance(content.get(key), list | tuple | np.ndarray)), None)
    if given is None and named is not None:
        return _joint_names(where, named, content[named], angles.shape[1])
    shown = None if given else _by_axes(poses, angles.shape[1]) or _by_bodies(where, content, angles)
    return LAYOUTS[shown] if shown else choose_layout(where, angles, given, usual)


def _chosen(path: Path, content: object, clip: str | None) -> tuple[str, str, dict[str, Any]]:
    """Name of the motion, what messages start with, and the fields of the chosen clip."""
    if isinstance(content, list):
        content = {str(i): value for i, value in enumerate(content)}
    if not isinstance(content, dict):
        raise MotionError(f"{path}: a dict of arrays or of clips expected, got a {type(content).__name__}")
    keys = {*_POSITION, *_ROTATION, *_JOINTS, _AXES_ANGLES}
    if keys & content.keys():
        if clip is not None:
            raise MotionError(f"{path}: holds a single motion without a name: leave clip={clip} out")
        return path.stem, str(path), content
    clips = {str(key): value for key, value in content.items() if isinstance(value, dict) and keys & value.keys()}
    if not clips:
        raise MotionError(
            f"{path}: neither a motion nor a dict of motions with {' or '.join(_POSITION)}; it has {_listed(content)}"
        )
    if clip is None and len(clips) == 1:
        clip = next(iter(clips))
    if clip not in clips:
        problem = "holds several clips: give clip=NAME" if clip is None else f"there is no clip {clip!r}"
        raise MotionError(f"{path}: {problem}; there is {_listed(clips)}")
    return Path(clip).name or path.stem, f"{path}: {clip}", clips[clip]


def _listed(names: Any) -> str:
    shown = [str(name)[:60] for name in names]
    rest = len(shown) - _SHOWN
    return (", ".join(shown[:_SHOWN]) or "nothing") + (f" and {rest} more" if rest > 0 else "")


def _array(where: str, key: str, value: object) -> np.ndarray:
    if not isinstance(value, np.ndarray | list | tuple | int | float):
        raise MotionError(f"{where}: {key}: an array of numbers expected, got a {type(value).__name__}")
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise MotionError(f"{where}: {key}: an array of numbers expected, got rows of several lengths") from error
    if array.dtype.kind not in "fiub":
        raise MotionError(f"{where}: {key}: numbers expected, got dtype {array.dtype}")
    return array


def _joint_names(where: str, key: str, value: Any, count: int) -> tuple[str, ...]:
    names = checked_names(where, key, value.tolist() if isinstance(value, np.ndarray) else list(value))
    # some leave the suffix out
    names = tuple(name if name.endswith("_joint") else f"{name}_joint" for name in names)
    if len(names) != count:
        raise MotionError(f"{where}: {key}: {len(names)} names of {count} joints")
    if unknown := [name for name in names if name not in g1.JOINT_NAMES and not is_finger_joint(name)]:
        raise MotionError(f"{where}: {key}: {_listed(unknown)} are not joints of this robot")
    return names


def _axes(layout: str) -> np.ndarray:
    axis = {joint.name: joint.axis for joint in g1.JOINTS}
    return np.array([axis[name] for name in LAYOUTS[layout]])


def _off_axis(poses: np.ndarray, layout: str) -> float:
    """How far joints turn about other axes than their own, rad."""
    axes = _axes(layout)
    turns = poses[:, 1 : 1 + len(axes)]
    along = (turns * axes).sum(axis=-1, keepdims=True) * axes
    return float(np.abs(turns - along).max())


def _by_axes(poses: np.ndarray, count: int) -> str | None:
    """The layout of so many joints whose axes are those that the rows of `pose_aa` turn about, if but one has them."""
    if poses.shape[1] <= count:
        return None
    fitting = [name for name, names in LAYOUTS.items() if len(names) == count and set(names) <= set(g1.JOINT_NAMES)]
    fitting = [name for name in fitting if _off_axis(poses, name) < _OFF_AXIS]
    return fitting[0] if len(fitting) == 1 else None


def _by_bodies(where: str, content: dict[str, Any], angles: np.ndarray) -> str | None:
    """The layout under which forward kinematics reproduces GMR's `local_body_pos`, where the file has it."""
    names, local = content.get("link_body_list"), content.get("local_body_pos")
    if not isinstance(names, list | tuple | np.ndarray) or not isinstance(local, np.ndarray):
        return None
    shared = [(i, g1.BODY_NAMES.index(name)) for i, name in enumerate(names) if name in g1.BODY_NAMES]
    if local.shape != (len(angles), len(names), 3) or local.dtype.kind != "f" or len(shared) < 2:
        return None
    theirs, ours = zip(*shared, strict=True)
    frames = np.linspace(0, len(angles) - 1, 10).astype(int)
    origin, upright = np.zeros((len(frames), 3)), np.tile([1.0, 0.0, 0.0, 0.0], (len(frames), 1))
    errors = {}
    for layout, joints in LAYOUTS.items():
        if len(joints) != angles.shape[1]:
            continue
        table = np.tile(default_joint_pos(), (len(frames), 1))
        for i, joint in enumerate(joints):
            if joint in g1.JOINT_NAMES:
                table[:, g1.JOINT_NAMES.index(joint)] = angles[frames, i]
        pos, _ = forward_kinematics(g1_robot(), origin, upright, table)
        apart = np.linalg.norm(pos[:, ours] - local[frames][:, theirs], axis=-1)
        errors[layout] = float(np.nan_to_num(apart, nan=np.inf).mean())
    best = min(errors, key=lambda layout: errors[layout], default=None)
    if best is None or errors[best] < _MAX_FK_ERROR:
        return best
    warnings.warn(
        f"{where}: local_body_pos is {errors[best]:.2f} m from the joints' forward kinematics: another robot's?",
        stacklevel=3,
    )
    return None


def _from_poses(where: str, poses: np.ndarray, joints: str | None) -> tuple[tuple[str, ...], np.ndarray]:
    """Joints and their angles from `pose_aa`: the root, the joints, and up to three links more."""
    layouts = {name: names for name, names in LAYOUTS.items() if set(names) <= set(g1.JOINT_NAMES)}
    for name, names in layouts.items():
        fits = len(names) < poses.shape[1] <= len(names) + 4 if joints is None else name == joints
        if fits and len(names) < poses.shape[1] and _off_axis(poses, name) < _OFF_AXIS:
            return names, (poses[:, 1 : 1 + len(names)] * _axes(name)).sum(axis=-1)
    raise MotionError(
        f"{where}: {_AXES_ANGLES}: rotations of {poses.shape[1]} bodies about other axes than those of "
        f"{joints or ' or '.join(layouts)}"
    )
