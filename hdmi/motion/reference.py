"""The reference that training tracks: a motion in the order of the robot table, at the control rate, as tensors."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hdmi.assets import Effector, ObjectConfig, RobotConfig, SceneryConfig, g1
from hdmi.assets.surface import object_surfaces
from hdmi.motion.check import checked_fps
from hdmi.motion.kinematics import (
    angular_velocity,
    derivative,
    forward_kinematics,
    interpolate,
    interpolate_quat,
    nearest_frames,
    resampled_times,
)
from hdmi.motion.motion import Motion, MotionError, load_motion

_ROOT_JOINT = "root"  # a column that some tools write for the free joint; nothing reads it
_FINGERS = r"thumb|finger|index|middle|ring|pinky|little"
_FINGER_JOINT = re.compile(
    rf"(.*_)?(left|right|l|r)_(.*_)?(hand|gripper|claw|palm|{_FINGERS})(_?\d+)?(_.*)?|({_FINGERS})_?\d+(_.*)?"
    r"|(left|right)_(zero|one|two|three|four|five|six)_joint"
)
_EMBEDDED = Path(__file__).parent / "references"


@dataclass(frozen=True)
class Reference:
    """A robot-and-object reference s_t = (robot, object, c_t) with contact points (section III-A).

    Float32 tensors, world frame, T frames at the control rate; E is 0 and the object fields are empty for a
    robot-only motion, K is 0 for a rigid object.
    """

    name: str
    joint_pos: Tensor  # [T, 29] rad
    joint_vel: Tensor  # [T, 29]
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

    @property
    def num_frames(self) -> int:
        return len(self.joint_pos)

    @property
    def has_object(self) -> bool:
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


def make_reference(
    motion: Motion | str | Path,
    *,
    control_dt: float,
    object: ObjectConfig | None = None,
    scenery: Sequence[SceneryConfig] = (),
    effectors: Sequence[Effector] = (),
    robot: RobotConfig | None = None,
) -> Reference:
    """Completes a motion to a reference: table order, control rate, all joints and bodies.

    Joints that the motion lacks hold the robot's default pose, and so do those that the robot holds there whatever a
    motion says; those of hands, which the robot lacks, are dropped with a warning. Bodies that the motion lacks, or
    that held joints move, come from forward kinematics. The object's name and hinge, the scenery and the effectors are
    the task's. Linear velocities are differences of positions: the simulator's are of the bodies' origins, those in
    files often of their centres of mass.

    Raises:
        MotionError: if the motion has joints or bodies that nothing knows, lacks the pelvis, the object, its
            hinge, or contact labels for the effectors.
    """
    motion = motion if isinstance(motion, Motion) else load_motion(motion)
    where = f"motion {motion.name!r}"
    hinge = object.hinge.name if object is not None and object.hinge is not None else None
    motion = without_fingers(motion, keep=hinge)
    unknown = [name for name in motion.joint_names if name not in (*g1.JOINT_NAMES, _ROOT_JOINT, hinge)]
    if unknown:
        raise MotionError(f"{where}: joint_names: {unknown} are neither the robot's nor the object's hinge ({hinge!r})")
    motion = replace(motion, body_lin_vel_w=derivative(motion.body_pos_w, motion.fps))
    motion = complete_robot(resample(motion, 1.0 / control_dt), robot)
    num_frames = motion.num_frames
    num_joints, num_bodies = len(g1.JOINT_NAMES), len(g1.BODY_NAMES)

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
    )


def is_finger_joint(name: str) -> bool:
    """Whether a joint is called as those of hands are that the robot lacks, such as `left_hand_thumb_0_joint`."""
    plain = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()
    return name not in g1.JOINT_NAMES and _FINGER_JOINT.fullmatch(plain) is not None


def without_fingers(motion: Motion, keep: str | None = None) -> Motion:
    """The motion without joints of hands, which the robot lacks; warns if there are any.

    Args:
        keep: a joint that stays, whatever it is called: the object's hinge.
    """
    fingers = [name for name in motion.joint_names if name != keep and is_finger_joint(name)]
    if not fingers:
        return motion
    warnings.warn(f"motion {motion.name!r}: joints of hands are dropped: {', '.join(fingers)}", stacklevel=3)
    return motion.with_joints([name for name in motion.joint_names if name not in fingers])


def complete_robot(motion: Motion, robot: RobotConfig | None = None) -> Motion:
    """The motion with all joints and bodies of the robot table, first and in its order; others follow.

    Joints that it lacks or that the robot holds there are at the default pose; bodies that it lacks or that these move
    come from forward kinematics.

    Raises:
        MotionError: if it lacks the pelvis, or has no joint of the robot.
    """
    where = f"motion {motion.name!r}"
    if "pelvis" not in motion.body_names:
        raise MotionError(f"{where}: body_names lacks the root 'pelvis'")
    if not any(name in g1.JOINT_NAMES for name in motion.joint_names):
        raise MotionError(f"{where}: joint_names has no joint of the robot")
    fps, num_frames = motion.fps, motion.num_frames
    robot = robot or RobotConfig()
    held = robot.held_joints
    joint_pos = np.tile(robot.default_joint_pos, (num_frames, 1))
    joint_vel = np.zeros_like(joint_pos)
    for i, name in enumerate(motion.joint_names):
        if name in g1.JOINT_NAMES and name not in held:
            j = g1.JOINT_NAMES.index(name)
            joint_pos[:, j], joint_vel[:, j] = motion.joint_pos[:, i], motion.joint_vel[:, i]

    root = motion.body_names.index("pelvis")
    pos, quat = forward_kinematics(motion.body_pos_w[:, root], motion.body_quat_w[:, root], joint_pos)
    lin_vel, ang_vel = derivative(pos, fps), angular_velocity(quat, fps)
    moved = _bodies_after(held)
    for b, name in enumerate(g1.BODY_NAMES):
        if name in motion.body_names and name not in moved:
            i = motion.body_names.index(name)
            pos[:, b], quat[:, b] = motion.body_pos_w[:, i], motion.body_quat_w[:, i]
            lin_vel[:, b], ang_vel[:, b] = motion.body_lin_vel_w[:, i], motion.body_ang_vel_w[:, i]

    joints = [i for i, name in enumerate(motion.joint_names) if name not in g1.JOINT_NAMES]
    bodies = [i for i, name in enumerate(motion.body_names) if name not in g1.BODY_NAMES]

    def joined(table: np.ndarray, others: np.ndarray) -> np.ndarray:
        return np.concatenate([table.astype(np.float32), others], axis=1)

    return replace(
        motion,
        joint_names=(*g1.JOINT_NAMES, *(motion.joint_names[i] for i in joints)),
        body_names=(*g1.BODY_NAMES, *(motion.body_names[i] for i in bodies)),
        joint_pos=joined(joint_pos, motion.joint_pos[:, joints]),
        joint_vel=joined(joint_vel, motion.joint_vel[:, joints]),
        body_pos_w=joined(pos, motion.body_pos_w[:, bodies]),
        body_quat_w=joined(quat, motion.body_quat_w[:, bodies]),
        body_lin_vel_w=joined(lin_vel, motion.body_lin_vel_w[:, bodies]),
        body_ang_vel_w=joined(ang_vel, motion.body_ang_vel_w[:, bodies]),
    )


def _bodies_after(joints: Sequence[str]) -> set[str]:
    """The robot's bodies that joints move."""
    moved = {joint.body for joint in g1.JOINTS if joint.name in joints}
    for body in g1.BODIES:  # parents come first
        if body.parent in moved:
            moved.add(body.name)
    return moved


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


def resample(motion: Motion, fps: float) -> Motion:
    """The motion at another rate: positions and velocities linear, orientations slerp, labels nearest.

    Raises:
        MotionError: unless the rate is from 1 to 1000 frames per second, and leaves at least 2 frames.
    """
    if abs(motion.fps - fps) < 1e-6:
        return motion
    where = f"motion {motion.name!r}"
    old, new = resampled_times(motion.num_frames, motion.fps, checked_fps(where, fps))
    if len(new) < 2:
        raise MotionError(
            f"{where}: its {motion.num_frames} frames at {motion.fps:g} fps are 1 frame at {fps:g} fps, and a motion "
            "needs at least 2"
        )
    nearest = nearest_frames(old, new)
    sampled: dict[str, Any] = {
        key: interpolate(getattr(motion, key), old, new)
        for key in ("body_pos_w", "body_lin_vel_w", "body_ang_vel_w", "joint_pos", "joint_vel")
    }
    return replace(
        motion,
        fps=fps,
        body_quat_w=interpolate_quat(motion.body_quat_w, old, new),
        object_contact=None if motion.object_contact is None else motion.object_contact[nearest],
        contact_points=None if motion.contact_points is None else interpolate(motion.contact_points, old, new),
        **sampled,
    )
