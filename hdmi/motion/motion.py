"""The reference-motion file: a folder with motion.npz and meta.json.

meta.json: `body_names`, `joint_names` (robot, object and scenery together), `fps`.
motion.npz, float32, world frame, quaternions wxyz:

| key                | shape     |                                                              |
|--------------------|-----------|--------------------------------------------------------------|
| body_pos_w         | [T, B, 3] | m, required                                                  |
| body_quat_w        | [T, B, 4] | required                                                     |
| joint_pos          | [T, J]    | rad, required                                                |
| body_lin_vel_w     | [T, B, 3] | m/s; re-derived when absent                                  |
| body_ang_vel_w     | [T, B, 3] | rad/s; re-derived when absent                                |
| joint_vel          | [T, J]    | rad/s; re-derived when absent                                |
| object_contact     | [T, E]    | intended contact, bool or 0/1; one column serves all effectors |
| contact_points     | [T, E, 3] | in the frame of the object's link, m; the task's when absent |
"""

from __future__ import annotations

import json
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hdmi.motion.kinematics import angular_velocity, derivative


class MotionError(ValueError):
    """A motion file that cannot be used; the message names file, field and frame."""


@dataclass(frozen=True)
class Motion:
    """A motion of named bodies and joints, sampled at `fps`. Arrays as in the file format, float32."""

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

    @property
    def num_frames(self) -> int:
        return len(self.joint_pos)


_REQUIRED = {"body_pos_w": 3, "body_quat_w": 4, "joint_pos": None}
_OPTIONAL = {"body_lin_vel_w": 3, "body_ang_vel_w": 3, "joint_vel": None}


def load_motion(path: str | Path) -> Motion:
    """Reads and checks a motion folder.

    Raises:
        MotionError: for a missing or truncated file, missing fields or names, wrong shapes, values that are
            not finite, quaternions that are not unit, or labels that are not 0/1.
    """
    folder = Path(path)
    meta_path, npz_path = folder / "meta.json", folder / "motion.npz"
    for file in (meta_path, npz_path):
        if not file.is_file():
            raise MotionError(f"{file}: no such file; a motion is a folder with motion.npz and meta.json")
    try:
        meta = json.loads(meta_path.read_text(encoding="utf-8"))
        body_names, joint_names = tuple(meta["body_names"]), tuple(meta["joint_names"])
        fps = float(meta["fps"])
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        raise MotionError(f"{meta_path}: needs body_names, joint_names and fps: {error!r}") from error
    if not (np.isfinite(fps) and fps > 0):
        raise MotionError(f"{meta_path}: fps must be positive, got {fps}")
    for kind, names in (("body_names", body_names), ("joint_names", joint_names)):
        if not all(isinstance(name, str) for name in names) or len(set(names)) != len(names):
            raise MotionError(f"{meta_path}: {kind} must be distinct strings")
    try:
        with np.load(npz_path, allow_pickle=False) as file:
            arrays = {key: file[key] for key in file.files}
    except (OSError, ValueError, EOFError, KeyError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise MotionError(f"{npz_path}: truncated or not an npz of plain arrays: {error}") from error
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
        values[key] = _checked(npz_path, key, arrays[key], shape)
    norms = np.linalg.norm(values["body_quat_w"].astype(np.float64), axis=-1)
    if (bad := np.argwhere(np.abs(norms - 1) > 1e-2)).size:
        t, b = bad[0]
        raise MotionError(f"{npz_path}: body_quat_w: norm {norms[t, b]:.3f} at frame {t}, body {body_names[b]!r}")
    norms[np.abs(norms - 1) < 1e-6] = 1.0  # unit as far as float32 can tell: leave the bits alone
    values["body_quat_w"] = (values["body_quat_w"] / norms[..., None]).astype(np.float32)
    values.setdefault("body_lin_vel_w", derivative(values["body_pos_w"], fps).astype(np.float32))
    values.setdefault("body_ang_vel_w", angular_velocity(values["body_quat_w"], fps).astype(np.float32))
    values.setdefault("joint_vel", derivative(values["joint_pos"], fps).astype(np.float32))
    contact = points = None
    if "object_contact" in arrays:
        raw = arrays["object_contact"]
        raw = raw[:, None] if raw.ndim == 1 else raw
        raw = _checked(npz_path, "object_contact", raw, (num_frames, *raw.shape[1:2]))
        if (bad := np.argwhere((raw != 0) & (raw != 1))).size:
            raise MotionError(
                f"{npz_path}: object_contact: {raw[tuple(bad[0])]} at frame {bad[0][0]} is neither 0 nor 1"
            )
        contact = raw.astype(bool)
    if "contact_points" in arrays:
        raw = arrays["contact_points"]
        points = _checked(npz_path, "contact_points", raw, (num_frames, *raw.shape[1:2], 3))
    return Motion(
        name=folder.name,
        fps=fps,
        body_names=body_names,
        joint_names=joint_names,
        object_contact=contact,
        contact_points=points,
        **values,
    )


def _checked(path: Path, key: str, array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if array.dtype.kind not in "fiub":
        raise MotionError(f"{path}: {key}: numbers expected, got dtype {array.dtype}")
    if array.shape != shape:
        raise MotionError(f"{path}: {key}: shape {array.shape}, expected {shape} from meta.json and joint_pos")
    array = array.astype(np.float32)
    if (bad := np.argwhere(~np.isfinite(array))).size:
        raise MotionError(f"{path}: {key}: not finite at frame {bad[0][0]}, index {tuple(int(i) for i in bad[0][1:])}")
    return array


def save_motion(motion: Motion, path: str | Path) -> Path:
    """Writes a motion folder that `load_motion` reads back unchanged; returns the folder."""
    folder = Path(path)
    folder.mkdir(parents=True, exist_ok=True)
    arrays = {key: getattr(motion, key) for key in (*_REQUIRED, *_OPTIONAL)}
    arrays = {key: value.astype(np.float32) for key, value in arrays.items()}
    if motion.object_contact is not None:
        arrays["object_contact"] = motion.object_contact
    if motion.contact_points is not None:
        arrays["contact_points"] = motion.contact_points.astype(np.float32)
    np.savez_compressed(folder / "motion.npz", **arrays)
    meta = {"body_names": list(motion.body_names), "joint_names": list(motion.joint_names), "fps": motion.fps}
    (folder / "meta.json").write_text(json.dumps(meta, indent=1) + "\n", encoding="utf-8")
    return folder
