"""Forward kinematics of the robot table, and derivatives of sampled motions."""

from __future__ import annotations

from functools import lru_cache

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from hdmi.assets import g1
from hdmi.assets.robot import RobotConfig, add_robot


@lru_cache(maxsize=1)
def robot_model() -> mujoco.MjModel:
    """The robot alone: 7 + 29 positions, bodies in table order after the world."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    add_robot(spec, RobotConfig())
    return spec.compile()


def forward_kinematics(
    root_pos: np.ndarray, root_quat: np.ndarray, joint_pos: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """World poses of all bodies.

    Args:
        root_pos: m. [T, 3]
        root_quat: wxyz. [T, 4]
        joint_pos: in table order, rad. [T, 29]

    Returns:
        Positions [T, B, 3] and orientations [T, B, 4], bodies in table order.
    """
    model = robot_model()
    data = mujoco.MjData(model)
    num_frames, num_bodies = len(root_pos), len(g1.BODY_NAMES)
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
