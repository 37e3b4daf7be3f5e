"""The motion that a network follows, in numpy: of a folder in this project's format, or of other arrays."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hdmi.deploy.description import PolicyError
from hdmi.deploy.foreign.kinematics import Kinematics
from hdmi.deploy.foreign.schema import NetworkSpec, per_joint
from hdmi.deploy.rotations import quat_conjugate, quat_multiply, rotation_vector

_NEEDED = ("joint_pos", "body_pos_w", "body_quat_w")


@dataclass(frozen=True)
class Motion:
    """A frame each control step; joints as the policy's, bodies as `Kinematics.body_names`. World frame, wxyz, SI.

    Velocities of bodies are differences of poses. What the motion lacks has width 0.
    """

    name: str
    joint_pos: np.ndarray  # [T, J]
    joint_vel: np.ndarray  # [T, J]
    body_pos_w: np.ndarray  # [T, B, 3]
    body_quat_w: np.ndarray  # [T, B, 4]
    body_lin_vel_w: np.ndarray  # [T, B, 3]
    body_ang_vel_w: np.ndarray  # [T, B, 3]
    object_pos_w: np.ndarray  # [T, 3]
    object_quat_w: np.ndarray  # [T, 4]
    object_joint_pos: np.ndarray  # [T, K]
    contact: np.ndarray  # [T, E], 0 or 1
    contact_points: np.ndarray  # [T, E, 3], in the frame of the object's link
    joint_target: np.ndarray  # [T, J], where servos are to be sent; width 0 if the motion does not say so

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.joint_pos)

    def reference(self) -> dict[str, np.ndarray]:
        """As `hdmi.deploy.trial.read_reference` gives it."""
        found = {
            "joint_pos": self.joint_pos,
            "root_pos_w": self.body_pos_w[:, 0],
            "root_quat_w": self.body_quat_w[:, 0],
            "object_pos_w": self.object_pos_w,
            "object_quat_w": self.object_quat_w,
            "object_joint_pos": self.object_joint_pos,
        }
        return {name: value for name, value in found.items() if value.shape[-1]}


def read_motion(folder: str | Path, spec: NetworkSpec, kinematics: Kinematics) -> Motion:
    """A motion folder, motion.npz and meta.json: see docs/motions.md.

    Joints that it lacks hold the default pose; bodies that it lacks come from forward kinematics.

    Raises:
        PolicyError: if a file is missing or damaged, or is of another rate, robot or object.
    """
    folder = Path(folder)
    meta_path, path = folder / "meta.json", folder / "motion.npz"
    for file in (meta_path, path):
        if not file.is_file():
            raise PolicyError(f"{file}: there is no such file; a motion is a folder with motion.npz and meta.json")
    try:
        meta = json.loads(meta_path.read_text(encoding="utf-8"))
        names = [str(name) for name in meta["joint_names"]], [str(name) for name in meta["body_names"]]
        fps = float(meta["fps"])
    except (ValueError, KeyError, TypeError) as error:
        raise PolicyError(f"{meta_path}: needs joint_names, body_names and fps: {error!r}") from error
    if abs(fps * spec.control_dt - 1.0) > 1e-3:
        raise PolicyError(
            f"{meta_path}: fps {fps:g}, and the policy has control steps of {spec.control_dt:g} s; "
            "write the motion at that rate"
        )
    try:
        with np.load(path, allow_pickle=False) as file:
            kept = (*_NEEDED, "joint_vel", "joint_target", "object_contact", "contact_points")
            arrays = {name: np.asarray(file[name], dtype=float) for name in kept if name in file.files}
    except Exception as error:  # zipfile's, too
        raise PolicyError(f"{path}: cannot be read: {str(error).splitlines()[0]}") from error
    return motion_of(folder.name, arrays, *names, spec, kinematics, str(path))


def motion_of(
    name: str,
    arrays: Mapping[str, np.ndarray],
    joint_names: Sequence[str],
    body_names: Sequence[str],
    spec: NetworkSpec,
    kinematics: Kinematics,
    where: str,
) -> Motion:
    """A motion in the policy's order, completed.

    Args:
        arrays: `joint_pos` [T, *], `body_pos_w` [T, *, 3], `body_quat_w` [T, *, 4]; if there are any `joint_vel`,
            `joint_target` [T, *], `object_contact` [T, E] or [T], `contact_points` [T, E, 3].
        joint_names, body_names: of these.

    Raises:
        PolicyError: for arrays of wrong shapes, or what the policy's robot or object lacks; begins with `where`.
    """
    if missing := [key for key in _NEEDED if key not in arrays]:
        raise PolicyError(f"{where}: lacks {', '.join(missing)}")
    frames, dt = len(arrays["joint_pos"]), spec.control_dt
    shapes = {
        **dict.fromkeys(("joint_pos", "joint_vel", "joint_target"), (frames, len(joint_names))),
        "body_pos_w": (frames, len(body_names), 3), "body_quat_w": (frames, len(body_names), 4),
    }  # fmt: skip
    for key, shape in shapes.items():
        if key in arrays and arrays[key].shape != shape:
            raise PolicyError(f"{where}: {key}: expected shape {list(shape)}, got {list(arrays[key].shape)}")
        if key in arrays and not np.isfinite(arrays[key]).all():
            raise PolicyError(f"{where}: {key}: expected finite numbers")
    if frames < 2:
        raise PolicyError(f"{where}: has {frames} frames, needs at least 2")
    own = [joint for joint in spec.joints if joint in joint_names]
    if not own:
        raise PolicyError(f"{where}: has none of the policy's joints {', '.join(spec.joints)}")
    if kinematics.root not in body_names:
        raise PolicyError(f"{where}: has no body {kinematics.root!r}, the scene's root; it has {', '.join(body_names)}")
    rows, columns = [spec.joints.index(joint) for joint in own], [joint_names.index(joint) for joint in own]
    pos = np.tile(per_joint(spec.default_pose, spec.joints, f"{where}: default_pose"), (frames, 1))
    pos[:, rows] = arrays["joint_pos"][:, columns]
    vel = np.zeros_like(pos)
    vel[:, rows] = arrays["joint_vel"][:, columns] if "joint_vel" in arrays else _rate(pos, dt)[:, rows]
    target = np.zeros((frames, 0))
    if "joint_target" in arrays:
        target = pos.copy()
        target[:, rows] = arrays["joint_target"][:, columns]
    elif spec.action.base == "joint_target":
        raise PolicyError(f"{where}: has no joint_target, which the policy's actions start from")
    quats = arrays["body_quat_w"]
    if (np.abs(np.linalg.norm(quats, axis=-1) - 1.0) > 0.05).any():
        raise PolicyError(f"{where}: body_quat_w: expected quaternions wxyz of length 1")
    quats = quats / np.linalg.norm(quats, axis=-1, keepdims=True)
    root = body_names.index(kinematics.root)
    body_pos, body_quat = kinematics(arrays["body_pos_w"][:, root], quats[:, root], pos)
    for i, body in enumerate(kinematics.body_names):
        if body in body_names:
            at = body_names.index(body)
            body_pos[:, i], body_quat[:, i] = arrays["body_pos_w"][:, at], quats[:, at]
    thing: dict[str, Any] = dict.fromkeys(("object_pos_w", "object_quat_w"), np.zeros((frames, 0)))
    if spec.object:
        if spec.object not in body_names:
            raise PolicyError(f"{where}: has no body {spec.object!r}, the object; it has {', '.join(body_names)}")
        at = body_names.index(spec.object)
        thing = {"object_pos_w": arrays["body_pos_w"][:, at], "object_quat_w": quats[:, at]}
    if spec.object_joint and spec.object_joint not in joint_names:
        raise PolicyError(f"{where}: has no joint {spec.object_joint!r}, the object's hinge")
    hinge = [joint_names.index(spec.object_joint)] if spec.object_joint else []
    labels, points = _contacts(arrays, frames, len(spec.contact_bodies), where)
    return Motion(
        name=name,
        joint_pos=pos,
        joint_vel=vel,
        body_pos_w=body_pos,
        body_quat_w=body_quat,
        body_lin_vel_w=_rate(body_pos, dt),
        body_ang_vel_w=_turn_rate(body_quat, dt),
        object_joint_pos=arrays["joint_pos"][:, hinge],
        contact=labels,
        contact_points=points,
        joint_target=target,
        **thing,
    )


def _contacts(arrays: Mapping[str, np.ndarray], frames: int, count: int, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Labels [T, E] and points [T, E, 3] of `count` bodies; of none, where the motion has none."""
    labels = arrays.get("object_contact", np.zeros((frames, 0))).reshape(frames, -1)
    points = arrays.get("contact_points", np.zeros((frames, 0, 3))).reshape(frames, -1, 3)
    if labels.shape[1] == 1:
        labels = np.repeat(labels, count, axis=1)  # one column serves all
    for name, value in (("object_contact", labels), ("contact_points", points)):
        if count and value.shape[1] not in (0, count):
            raise PolicyError(f"{where}: {name} is of {value.shape[1]} bodies, contact_bodies are {count}")
    return labels, points


def _rate(values: np.ndarray, dt: float) -> np.ndarray:
    """Central differences over frames, one-sided at the ends."""
    return np.gradient(values, dt, axis=0)


def _turn_rate(quat: np.ndarray, dt: float) -> np.ndarray:
    """Angular velocity in the world, central differences, rad/s. [T, ..., 4] -> [T, ..., 3]"""
    after, before = np.concatenate([quat[1:], quat[-1:]]), np.concatenate([quat[:1], quat[:-1]])
    steps = np.full(len(quat), 2.0)
    steps[[0, -1]] = 1.0
    turn = rotation_vector(quat_multiply(after, quat_conjugate(before)))
    return turn / (steps * dt).reshape(-1, *[1] * (turn.ndim - 1))
