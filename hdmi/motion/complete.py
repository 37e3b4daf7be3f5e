"""Motions made fit for a robot: all of its joints and bodies, no fingers, another rate."""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection
from dataclasses import replace
from typing import Any

import numpy as np

from hdmi.assets import RobotConfig
from hdmi.motion.check import checked_fps
from hdmi.motion.format import Motion, MotionError
from hdmi.motion.kinematics import (
    angular_velocity,
    derivative,
    forward_kinematics,
    interpolate,
    interpolate_quat,
    nearest_frames,
    resampled_times,
)

_FINGERS = r"thumb|finger|index|middle|ring|pinky|little"
_FINGER_JOINT = re.compile(
    rf"(.*_)?(left|right|l|r)_(.*_)?(hand|gripper|claw|palm|{_FINGERS})(_?\d+)?(_.*)?|({_FINGERS})_?\d+(_.*)?"
    r"|(left|right)_(zero|one|two|three|four|five|six)_joint"
)


def is_finger_joint(name: str) -> bool:
    """Whether a joint is called as those of hands with fingers are, such as `left_hand_thumb_0_joint`."""
    plain = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()
    return _FINGER_JOINT.fullmatch(plain) is not None


def without_fingers(motion: Motion, keep: Collection[str | None]) -> Motion:
    """The motion without joints of hands, which the robot lacks; warns if there are any.

    Args:
        keep: joints that stay, whatever they are called: the robot's, and the object's hinge.
    """
    fingers = [name for name in motion.joint_names if name not in keep and is_finger_joint(name)]
    if not fingers:
        return motion
    warnings.warn(f"motion {motion.name!r}: joints of hands are dropped: {', '.join(fingers)}", stacklevel=3)
    return motion.with_joints([name for name in motion.joint_names if name not in fingers])


def complete_robot(motion: Motion, robot: RobotConfig | None = None) -> Motion:
    """The motion with all joints and bodies of the robot, first and in its order; others follow.

    Joints that it lacks or that the robot holds there are at the default pose; bodies that it lacks or that these move
    come from forward kinematics.

    Raises:
        MotionError: if it lacks the robot's root, or has no joint of the robot.
    """
    where = f"motion {motion.name!r}"
    robot = robot or RobotConfig()
    model = robot.model
    if model.root not in motion.body_names:
        raise MotionError(f"{where}: body_names lacks the root {model.root!r}")
    if not any(name in model.joint_names for name in motion.joint_names):
        raise MotionError(f"{where}: joint_names has no joint of the robot")
    fps, num_frames = motion.fps, motion.num_frames
    held = robot.held_joints
    joint_pos = np.tile(robot.default_joint_pos, (num_frames, 1))
    joint_vel = np.zeros_like(joint_pos)
    target = motion.joint_target
    joint_target = joint_pos.copy()
    for i, name in enumerate(motion.joint_names):
        if name in model.joint_names and name not in held:
            j = model.joint_names.index(name)
            joint_pos[:, j], joint_vel[:, j] = motion.joint_pos[:, i], motion.joint_vel[:, i]
            if target is not None:
                joint_target[:, j] = target[:, i]

    root = motion.body_names.index(model.root)
    pos, quat = forward_kinematics(model, motion.body_pos_w[:, root], motion.body_quat_w[:, root], joint_pos)
    lin_vel, ang_vel = derivative(pos, fps), angular_velocity(quat, fps)
    moved = model.bodies_after(held)
    for b, name in enumerate(model.body_names):
        if name in motion.body_names and name not in moved:
            i = motion.body_names.index(name)
            pos[:, b], quat[:, b] = motion.body_pos_w[:, i], motion.body_quat_w[:, i]
            lin_vel[:, b], ang_vel[:, b] = motion.body_lin_vel_w[:, i], motion.body_ang_vel_w[:, i]

    joints = [i for i, name in enumerate(motion.joint_names) if name not in model.joint_names]
    bodies = [i for i, name in enumerate(motion.body_names) if name not in model.body_names]

    def joined(table: np.ndarray, others: np.ndarray) -> np.ndarray:
        return np.concatenate([table.astype(np.float32), others], axis=1)

    return replace(
        motion,
        joint_names=(*model.joint_names, *(motion.joint_names[i] for i in joints)),
        body_names=(*model.body_names, *(motion.body_names[i] for i in bodies)),
        joint_pos=joined(joint_pos, motion.joint_pos[:, joints]),
        joint_vel=joined(joint_vel, motion.joint_vel[:, joints]),
        joint_target=None if target is None else joined(joint_target, target[:, joints]),
        body_pos_w=joined(pos, motion.body_pos_w[:, bodies]),
        body_quat_w=joined(quat, motion.body_quat_w[:, bodies]),
        body_lin_vel_w=joined(lin_vel, motion.body_lin_vel_w[:, bodies]),
        body_ang_vel_w=joined(ang_vel, motion.body_ang_vel_w[:, bodies]),
    )


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
    optional = [key for key in ("contact_points", "joint_target") if getattr(motion, key) is not None]
    sampled: dict[str, Any] = {
        key: interpolate(getattr(motion, key), old, new)
        for key in ("body_pos_w", "body_lin_vel_w", "body_ang_vel_w", "joint_pos", "joint_vel", *optional)
    }
    return replace(
        motion,
        fps=fps,
        body_quat_w=interpolate_quat(motion.body_quat_w, old, new),
        object_contact=None if motion.object_contact is None else motion.object_contact[nearest],
        **sampled,
    )
