"""Centre of mass and centre of pressure: where one has to be so that the other is as planned."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import mujoco
import numpy as np
from scipy.linalg import solve_banded
from scipy.signal import savgol_filter

from hdmi.assets import g1, g1_robot
from hdmi.motion.kinematics import robot_model, smoothing_window

GRAVITY = 9.81
COM_HEIGHT = 0.65  # above the ground, of the linear inverted pendulum, m


@dataclass(frozen=True)
class Load:
    """What the object exerts on the robot: a point mass that it carries, and a further force.

    Args:
        pos: of the carried object's centre of mass, m. [T, 3]
        mass: that is carried, kg. [T]
        force: N. [T, 3]
        point: where it acts, m. [T, 3]
    """

    pos: np.ndarray
    mass: np.ndarray
    force: np.ndarray
    point: np.ndarray


def pendulum_com(pressure: np.ndarray, fps: float, height: float = COM_HEIGHT) -> np.ndarray:
    """Centre of mass of a linear inverted pendulum with a centre of pressure.

    Solves c - (h / g) c'' = p as a boundary value problem, at rest over the pressure at both ends.

    Args:
        pressure: [T, 2] m

    Returns:
        Centre of mass. [T, 2] m
    """
    k = height / GRAVITY * fps**2
    bands = np.zeros((3, len(pressure)))
    bands[1], bands[0, 2:], bands[2, :-2] = 1 + 2 * k, -k, -k
    bands[1, [0, -1]] = 1.0
    solution: np.ndarray = solve_banded((1, 1), bands, pressure)
    return solution


def centre_of_pressure(qpos: np.ndarray, load: Load, ground: np.ndarray, fps: float) -> np.ndarray:
    """Where the ground has to push the robot for it to move like this, inertia and load included.

    Args:
        qpos: of `robot_model`. [T, 36]
        ground: height at which the pressure is taken, m. [T]

    Returns:
        [T, 2] m
    """
    model = robot_model(g1_robot())
    data = mujoco.MjData(model)
    com, spin = np.empty((len(qpos), 3)), np.empty((len(qpos), 3))
    for t in range(len(qpos)):
        before, after = max(t - 1, 0), min(t + 1, len(qpos) - 1)
        data.qpos[:] = qpos[t]
        mujoco.mj_differentiatePos(model, data.qvel, (after - before) / fps, qpos[before], qpos[after])
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_subtreeVel(model, data)
        com[t], spin[t] = data.subtree_com[1], data.subtree_angmom[1]
    window = smoothing_window(len(qpos), fps)
    smooth = partial(savgol_filter, window_length=window, polyorder=2, axis=0, delta=1 / fps)
    up = np.array([0.0, 0.0, GRAVITY])
    floor = np.column_stack([np.zeros((len(qpos), 2)), ground])
    force = g1.TOTAL_MASS * (smooth(com, deriv=2) + up)
    moment = np.cross(com - floor, force) + smooth(spin, deriv=1)
    carried = load.mass[:, None] * (smooth(load.pos, deriv=2) + up)
    force = force + carried - load.force
    moment = moment + np.cross(load.pos - floor, carried) - np.cross(load.point - floor, load.force)
    return np.column_stack([-moment[:, 1], moment[:, 0]]) / force[:, 2:]
