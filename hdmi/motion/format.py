"""The reference-motion file: a folder with motion.npz and meta.json.

meta.json: `body_names`, `joint_names` (robot, object and scenery together), `fps`.
motion.npz, float32, world frame, quaternions wxyz:

| key                | shape     |                                                              |
|--------------------|-----------|--------------------------------------------------------------|
| body_pos_w         | [T, B, 3] | m, required                                                  |
| body_quat_w        | [T, B, 4] | required                                                     |
| joint_pos          | [T, J]    | rad, required                                                |
| body_lin_vel_w     | [T, B, 3] | m/s; re-derived when absent, and for training always         |
| body_ang_vel_w     | [T, B, 3] | rad/s; re-derived when absent                                |
| joint_vel          | [T, J]    | rad/s; re-derived when absent                                |
| object_contact     | [T, E]    | intended contact, bool or 0/1; one column serves all effectors |
| contact_points     | [T, E, 3] | in the frame of the object's link, m; the task's when absent |
| joint_target       | [T, J]    | rad; where servos are to be sent, optional                   |

Nothing says whether `body_lin_vel_w` is of the bodies' origins or of their centres of mass, as in the public motions
and whatever else Isaac wrote: files keep what they have, `make_reference` takes differences of positions.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hdmi.motion.check import MotionError, checked, checked_fps, checked_labels, checked_names, checked_quat
from hdmi.motion.files import existing_file, read_npz, read_text, write_npz, write_text
from hdmi.motion.kinematics import angular_velocity, derivative


@dataclass(frozen=True)
class Motion:
    """A motion of named bodies and joints, sampled at `fps`. Arrays as in the file format, float32.

    Examples:
        >>> motion = load_motion(find_motion("lift_box"))
        >>> motion.num_frames, motion.fps, motion.joint_pos.shape
        (300, 50.0, (300, 29))
        >>> motion.with_joints(["left_knee_joint"]).joint_pos.shape
        (300, 1)
        >>> load_motion(save_motion(motion, "copy/lift_box")).body_names == motion.body_names
        True
    """

    name: str
    fps: float
    body_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    body_pos_w: np.ndarray
    body_quat_w: np.ndarray
    body_lin_vel_w: np.ndarray
    body_ang_vel_w: np.ndarray
    joint_pos: np.ndarray
    joint_vel: np.ndarray
    object_contact: np.ndarray | None = None  # bool [T, E]
    contact_points: np.ndarray | None = None  # [T, E, 3]
    joint_target: np.ndarray | None = None  # [T, J]

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.joint_pos)

    def with_joints(self, names: Collection[str]) -> Motion:
        """The motion with those of its joints that are among `names`, in its own order."""
        kept = [j for j, name in enumerate(self.joint_names) if name in names]
        return replace(
            self,
            joint_names=tuple(self.joint_names[j] for j in kept),
            joint_pos=self.joint_pos[:, kept],
            joint_vel=self.joint_vel[:, kept],
            joint_target=None if self.joint_target is None else self.joint_target[:, kept],
        )


def motion_from_poses(
    name: str,
    fps: float,
    body_names: Sequence[str],
    joint_names: Sequence[str],
    body_pos_w: np.ndarray,
    body_quat_w: np.ndarray,
    joint_pos: np.ndarray,
    object_contact: np.ndarray | None = None,
    contact_points: np.ndarray | None = None,
) -> Motion:
    """A float32 motion whose velocities are central differences of its poses; arguments as the fields of `Motion`."""
    arrays = {
        "body_pos_w": body_pos_w,
        "body_quat_w": body_quat_w,
        "body_lin_vel_w": derivative(body_pos_w, fps),
        "body_ang_vel_w": angular_velocity(body_quat_w, fps),
        "joint_pos": joint_pos,
        "joint_vel": derivative(joint_pos, fps),
    }
    return Motion(
        name=name,
        fps=fps,
        body_names=tuple(body_names),
        joint_names=tuple(joint_names),
        object_contact=object_contact,
        contact_points=None if contact_points is None else contact_points.astype(np.float32),
        **{key: value.astype(np.float32) for key, value in arrays.items()},
    )


_REQUIRED = {"body_pos_w": 3, "body_quat_w": 4, "joint_pos": None}
_OPTIONAL = {"body_lin_vel_w": 3, "body_ang_vel_w": 3, "joint_vel": None}
_EXTRAS = ("object_contact", "contact_points", "joint_target")
_BECAUSE = " from meta.json and joint_pos"


def load_motion(path: str | Path) -> Motion:
    """Reads and checks a motion folder.

    Raises:
        MotionError: for a missing or truncated file, missing fields or names, wrong shapes, values that are
            not finite, quaternions that are not unit, or labels that are not 0/1.
    """
    folder = Path(path)
    meta_path, npz_path = folder / "meta.json", folder / "motion.npz"
    for file in (meta_path, npz_path):
        existing_file(file, "; a motion is a folder with motion.npz and meta.json")
    text = read_text(meta_path)
    try:
        meta = json.loads(text)
        body_names, joint_names = tuple(meta["body_names"]), tuple(meta["joint_names"])
        fps = float(meta["fps"])
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise MotionError(f"{meta_path}: needs body_names, joint_names and fps: {error!r}") from error
    checked_fps(meta_path, fps)
    body_names = checked_names(meta_path, "body_names", body_names)
    joint_names = checked_names(meta_path, "joint_names", joint_names)
    arrays = read_npz(npz_path, {*_REQUIRED, *_OPTIONAL, *_EXTRAS})
    for key in _REQUIRED:
        if key not in arrays:
            raise MotionError(f"{npz_path}: lacks {key!r}; it has {sorted(arrays)}")
    num_frames = len(np.atleast_1d(arrays["joint_pos"]))
    if num_frames < 2:
        raise MotionError(f"{npz_path}: joint_pos: needs at least 2 frames, has {num_frames}")
    values: dict[str, np.ndarray] = {}
    for key, width in (_REQUIRED | _OPTIONAL).items():
        if key not in arrays:
            continue
        shape = (num_frames, len(joint_names)) if width is None else (num_frames, len(body_names), width)
        values[key] = checked(npz_path, key, arrays[key], shape, _BECAUSE)
    values["body_quat_w"] = checked_quat(npz_path, "body_quat_w", values["body_quat_w"], body_names, "body")
    values.setdefault("body_lin_vel_w", derivative(values["body_pos_w"], fps).astype(np.float32))
    values.setdefault("body_ang_vel_w", angular_velocity(values["body_quat_w"], fps).astype(np.float32))
    values.setdefault("joint_vel", derivative(values["joint_pos"], fps).astype(np.float32))
    contact = points = None
    if "object_contact" in arrays:
        raw = arrays["object_contact"]
        raw = raw[:, None] if raw.ndim == 1 else raw
        contact = checked_labels(npz_path, "object_contact", raw, (num_frames, *raw.shape[1:2]))
    if "contact_points" in arrays:
        raw = arrays["contact_points"]
        points = checked(npz_path, "contact_points", raw, (num_frames, *raw.shape[1:2], 3))
    target = arrays.get("joint_target")
    if target is not None:
        target = checked(npz_path, "joint_target", target, (num_frames, len(joint_names)), _BECAUSE)
    return Motion(
        name=folder.name,
        fps=fps,
        body_names=body_names,
        joint_names=joint_names,
        object_contact=contact,
        contact_points=points,
        joint_target=target,
        **values,
    )


def save_motion(motion: Motion, path: str | Path) -> Path:
    """Writes a motion folder that `load_motion` reads back unchanged; returns the folder."""
    folder = Path(path)
    arrays = {key: getattr(motion, key) for key in (*_REQUIRED, *_OPTIONAL)}
    arrays = {key: value.astype(np.float32) for key, value in arrays.items()}
    if motion.object_contact is not None:
        arrays["object_contact"] = motion.object_contact
    for key in ("contact_points", "joint_target"):
        if (values := getattr(motion, key)) is not None:
            arrays[key] = values.astype(np.float32)
    write_npz(folder / "motion.npz", arrays)
    meta = {"body_names": list(motion.body_names), "joint_names": list(motion.joint_names), "fps": motion.fps}
    write_text(folder / "meta.json", json.dumps(meta, indent=1) + "\n")
    return folder
