"""Forward kinematics of a robot, and derivatives of sampled motions."""

from __future__ import annotations

from functools import lru_cache

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from hdmi.assets import Robot, RobotConfig, add_robot


@lru_cache(maxsize=4)
def robot_model(robot: Robot) -> mujoco.MjModel:
    """A robot alone: 7 + J positions, bodies in the record's order after the world."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    return add_robot(spec, RobotConfig(robot)).compile()


def forward_kinematics(
    robot: Robot, root_pos: np.ndarray, root_quat: np.ndarray, joint_pos: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """World poses of all bodies.

    Args:
        root_pos: m. [T, 3]
        root_quat: wxyz. [T, 4]
        joint_pos: in the robot's order, rad. [T, J]

    Returns:
        Positions [T, B, 3] and orientations [T, B, 4], bodies in the robot's order.
    """
    model = robot_model(robot)
    data = mujoco.MjData(model)
    num_frames, num_bodies = len(root_pos), len(robot.body_names)
    pos, quat = np.empty((num_frames, num_bodies, 3)), np.empty((num_frames, num_bodies, 4))
    for t in range(num_frames):
        data.qpos[:3], data.qpos[3:7], data.qpos[7:] = root_pos[t], root_quat[t], joint_pos[t]
        mujoco.mj_kinematics(model, data)
        pos[t], quat[t] = data.xpos[1:], data.xquat[1:]
    return pos, quat


def derivative(values: np.ndarray, fps: float) -> np.ndarray:
    """Central differences over time. [T, ...] -> [T, ...] per second"""
    return np.gradient(values, 1.0 / fps, axis=0)


def angular_velocity(quat: np.ndarray, fps: float) -> np.ndarray:
    """World angular velocity from orientations by central differences, rad/s. [T, ..., 4] -> [T, ..., 3]"""
    before, after = np.concatenate([quat[:1], quat[:-1]]), np.concatenate([quat[1:], quat[-1:]])
    steps = np.full(len(quat), 2.0)
    steps[[0, -1]] = 1.0
    flat = (-1, 4)
    relative = (
        Rotation.from_quat(after.reshape(flat), scalar_first=True)
        * Rotation.from_quat(before.reshape(flat), scalar_first=True).inv()
    )
    velocity = relative.as_rotvec().reshape(*quat.shape[:-1], 3) * fps
    return velocity / steps.reshape(-1, *([1] * (quat.ndim - 1)))


def resampled_times(num_frames: int, fps: float, new_fps: float) -> tuple[np.ndarray, np.ndarray]:
    """Times of the frames of a motion and of the same motion at another rate, s."""
    old = np.arange(num_frames) / fps
    new = np.arange(int(np.floor(old[-1] * new_fps + 1e-6)) + 1) / new_fps
    return old, np.minimum(new, old[-1])


def interpolate(values: np.ndarray, old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Linearly, from times `old` to times `new`. [T, ...] -> [T', ...] float32"""
    before = np.clip(np.searchsorted(old, new, side="right") - 1, 0, len(old) - 2)
    share = ((new - old[before]) / (old[before + 1] - old[before])).reshape(-1, *([1] * (values.ndim - 1)))
    return ((1 - share) * values[before] + share * values[before + 1]).astype(np.float32)


def interpolate_quat(quat: np.ndarray, old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """By slerp, from times `old` to times `new`. [T, ..., 4] -> [T', ..., 4] float32"""
    tracks = quat.reshape(len(quat), -1, 4).swapaxes(0, 1)
    out = [Slerp(old, Rotation.from_quat(track, scalar_first=True))(new).as_quat(scalar_first=True) for track in tracks]
    return np.stack(out, axis=1).reshape(len(new), *quat.shape[1:]).astype(np.float32)


def nearest_frames(old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Index of the time in `old` that is nearest to each in `new`. [T']"""
    return np.searchsorted((old[:-1] + old[1:]) / 2, new)


def minimum_jerk(phase: np.ndarray) -> np.ndarray:
    """From 0 to 1 as `phase` goes from 0 to 1, at rest at both ends."""
    u = np.clip(phase, 0.0, 1.0)
    return u**3 * (10 - 15 * u + 6 * u**2)


def smoothing_window(num_frames: int, fps: float, span: float = 0.18) -> int:
    """Odd number of frames, at most the motion's, that a Savitzky-Golay filter over `span` seconds takes."""
    return min(round(span * fps) // 2 * 2 + 1, (num_frames - 1) // 2 * 2 + 1)
