"""The reference that training tracks: a motion in the robot's order, at the control rate, as tensors."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hdmi.assets import Effector, ObjectConfig, RobotConfig, SceneryConfig
from hdmi.assets.surface import object_surfaces
from hdmi.motion.complete import complete_robot, resample, without_fingers
from hdmi.motion.format import Motion, MotionError, load_motion
from hdmi.motion.kinematics import derivative

_ROOT_JOINT = "root"  # a column that some tools write for the free joint; nothing reads it
_EMBEDDED = Path(__file__).parent / "references"


@dataclass(frozen=True)
class Reference:
    """A robot-and-object reference s_t = (robot, object, c_t) with contact points (section III-A).

    Float32 tensors, world frame, T frames at the control rate; E is 0 and the object fields are empty for a
    robot-only motion, K is 0 for a rigid object.

    Examples:
        >>> reference = make_reference(find_motion("walk"), control_dt=0.02)
        >>> reference.num_frames, reference.has_object, reference.joint_pos.shape
        (550, False, torch.Size([550, 29]))
    """

    name: str
    joint_pos: Tensor  # [T, J] rad
    joint_vel: Tensor  # [T, J]
    body_pos: Tensor  # [T, B, 3]
    body_quat: Tensor  # [T, B, 4]
    body_lin_vel: Tensor  # [T, B, 3] of the bodies' origins
    body_ang_vel: Tensor  # [T, B, 3]
    object_pos: Tensor  # [T, 3] or [T, 0]
    object_quat: Tensor  # [T, 4] or [T, 0]
    object_lin_vel: Tensor
    object_ang_vel: Tensor
    object_joint_pos: Tensor  # [T, K]
    object_joint_vel: Tensor  # [T, K]
    contact: Tensor  # bool [T, E]
    contact_point: Tensor  # [T, E, 3] in the frame of the object's link
    placements: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]]  # object and scenery at the first frame
    joint_target: Tensor | None = None  # [T, J] rad, where servos are to be sent, if the motion says so

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.joint_pos)

    @property
    def has_object(self) -> bool:
        """Whether it is not of a robot alone."""
        return self.object_pos.shape[-1] == 3

    def to(self, device: torch.device | str) -> Reference:
        """The same reference on another device."""
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        moved: dict[str, Any] = {k: v.to(device) for k, v in values.items() if isinstance(v, Tensor)}
        return replace(self, **moved)


def find_motion(name: str, motion_root: str | None = None) -> Path:
    """Folder of a motion: under `motion_root` if given, else among those that ship with the package.

    Raises:
        MotionError: if there is none; says where was looked and what is there.
    """
    root = Path(motion_root).expanduser() if motion_root else _EMBEDDED
    if (root / name / "meta.json").is_file():
        return root / name
    there = sorted(p.parent.name for p in root.glob("*/meta.json")) if root.is_dir() else []
    raise MotionError(
        f"motion {name!r}: not under {root} (there: {', '.join(there) or 'no motions'}); "
        "set motion_root=FOLDER to the folder that holds it"
    )


def motion_digest(folder: Path) -> str:
    """SHA-256 of a motion's files, which tells whether two trainings track the same one.

    Raises:
        OSError: if they cannot be read.

    Examples:
        >>> len(motion_digest(find_motion("walk")))
        64
    """
    return hashlib.sha256(b"".join((folder / name).read_bytes() for name in ("meta.json", "motion.npz"))).hexdigest()


def make_reference(
    motion: Motion | str | Path,
    *,
    control_dt: float,
    object: ObjectConfig | None = None,
    scenery: Sequence[SceneryConfig] = (),
    effectors: Sequence[Effector] = (),
    robot: RobotConfig | None = None,
) -> Reference:
    """Completes a motion to a reference: the robot's order, control rate, all joints and bodies.

    Joints that the motion lacks hold the robot's default pose, and so do those that the robot holds there whatever a
    motion says; those of hands, which the robot lacks, are dropped with a warning. Bodies that the motion lacks, or
    that held joints move, come from forward kinematics. The object's name and hinge, the scenery and the effectors are
    the task's. Linear velocities are differences of positions: the simulator's are of the bodies' origins, those in
    files often of their centres of mass.

    Raises:
        MotionError: if the motion has joints or bodies that nothing knows, lacks the robot's root, the object, its
            hinge, or contact labels for the effectors.
    """
    motion = motion if isinstance(motion, Motion) else load_motion(motion)
    where = f"motion {motion.name!r}"
    hinge = object.hinge.name if object is not None and object.hinge is not None else None
    robot = robot or RobotConfig()
    model = robot.model
    known = (*model.joint_names, hinge)
    motion = without_fingers(motion, keep=known)
    unknown = [name for name in motion.joint_names if name not in (*known, _ROOT_JOINT)]
    if unknown:
        raise MotionError(f"{where}: joint_names: {unknown} are neither the robot's nor the object's hinge ({hinge!r})")
    motion = replace(motion, body_lin_vel_w=derivative(motion.body_pos_w, motion.fps))
    motion = complete_robot(resample(motion, 1.0 / control_dt), robot)
    num_frames = motion.num_frames
    num_joints, num_bodies = len(model.joint_names), len(model.body_names)

    empty = np.zeros((num_frames, 0))
    object_state = [empty] * 4
    hinge_pos = hinge_vel = empty
    if object is not None:
        if object.name not in motion.body_names:
            raise MotionError(f"{where}: body_names lacks the task's object {object.name!r}")
        i = motion.body_names.index(object.name)
        object_state = [
            getattr(motion, key)[:, i] for key in ("body_pos_w", "body_quat_w", "body_lin_vel_w", "body_ang_vel_w")
        ]
        if hinge is not None:
            if hinge not in motion.joint_names:
                raise MotionError(f"{where}: joint_names lacks the object's hinge {hinge!r}")
            i = motion.joint_names.index(hinge)
            hinge_pos, hinge_vel = motion.joint_pos[:, i : i + 1], motion.joint_vel[:, i : i + 1]
    contact, points = _contacts(motion, effectors)
    points = _pressed(points, effectors, object)

    placed = [item.name for item in scenery] + ([object.name] if object is not None else [])
    placements = {}
    for name in placed:
        if name in motion.body_names:
            i = motion.body_names.index(name)
            placements[name] = (tuple(motion.body_pos_w[0, i].tolist()), tuple(motion.body_quat_w[0, i].tolist()))

    def tensor(array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).float()

    return Reference(
        name=motion.name,
        joint_pos=tensor(motion.joint_pos[:, :num_joints]),
        joint_vel=tensor(motion.joint_vel[:, :num_joints]),
        body_pos=tensor(motion.body_pos_w[:, :num_bodies]),
        body_quat=tensor(motion.body_quat_w[:, :num_bodies]),
        body_lin_vel=tensor(motion.body_lin_vel_w[:, :num_bodies]),
        body_ang_vel=tensor(motion.body_ang_vel_w[:, :num_bodies]),
        object_pos=tensor(object_state[0]),
        object_quat=tensor(object_state[1]),
        object_lin_vel=tensor(object_state[2]),
        object_ang_vel=tensor(object_state[3]),
        object_joint_pos=tensor(hinge_pos),
        object_joint_vel=tensor(hinge_vel),
        contact=torch.from_numpy(contact.copy()),
        contact_point=tensor(points),
        placements=placements,
        joint_target=None if motion.joint_target is None else tensor(motion.joint_target[:, :num_joints]),
    )


def _contacts(motion: Motion, effectors: Sequence[Effector]) -> tuple[np.ndarray, np.ndarray]:
    count = len(effectors)
    if count == 0:
        return np.zeros((motion.num_frames, 0), bool), np.zeros((motion.num_frames, 0, 3))
    if motion.object_contact is None:
        raise MotionError(f"motion {motion.name!r}: has no object_contact labels, and the task has {count} effectors")
    columns = motion.object_contact.shape[1]
    if columns not in (1, count):
        raise MotionError(
            f"motion {motion.name!r}: object_contact has {columns} columns; the task has {count} effectors"
        )
    contact = np.broadcast_to(motion.object_contact, (motion.num_frames, count))
    points = np.asarray([effector.target for effector in effectors], dtype=float)
    points = np.broadcast_to(points, (motion.num_frames, count, 3))
    if motion.contact_points is not None:
        if motion.contact_points.shape[1] != count:
            raise MotionError(
                f"motion {motion.name!r}: contact_points has {motion.contact_points.shape[1]} effectors, "
                f"the task {count}"
            )
        points = motion.contact_points
    return contact, points


def _pressed(points: np.ndarray, effectors: Sequence[Effector], object: ObjectConfig | None) -> np.ndarray:
    """Contact points, each moved into the object by its effector's press. [T, E, 3]"""
    points = np.array(points, float)
    for e, effector in enumerate(effectors):
        if effector.press:
            assert object is not None
            flat, row = np.unique(points[:, e], axis=0, return_inverse=True)
            surface = object_surfaces(object)[object.link]
            points[:, e] = (flat + effector.press * surface.inward(flat))[row.reshape(-1)]
    return points
