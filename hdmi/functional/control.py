"""Targets of position servos."""

from __future__ import annotations

import torch
from torch import Tensor


def feedforward_target(
    joint_pos: Tensor, joint_vel: Tensor, torque: Tensor, stiffness: Tensor, damping: Tensor, limit: Tensor
) -> Tensor:
    """Targets with which servos follow a motion by themselves: q + (tau + kd qd) / kp.

    A servo's torque is kp (target - q) - kd qd: on the motion it is then tau.

    Args:
        joint_pos, joint_vel: of the motion, rad and rad/s. [..., J]
        torque: that the motion asks for, N m. [..., J]
        stiffness, damping: of the servos, N m/rad and N m s/rad. [J]
        limit: that torques are clipped to, N m. [J]

    Returns:
        rad. [..., J]

    Examples:
        >>> kp, kd, limit = torch.tensor([100.0]), torch.tensor([2.0]), torch.tensor([50.0])
        >>> feedforward_target(torch.tensor([0.5]), torch.tensor([1.0]), torch.tensor([10.0]), kp, kd, limit)
        tensor([0.6200])
    """
    return joint_pos + (torque.clamp(-limit, limit) + damping * joint_vel) / stiffness


def spring_wrench(
    offset: Tensor, rotation: Tensor, lin_vel: Tensor, ang_vel: Tensor, mass: Tensor | float, radius: float, rate: float
) -> Tensor:
    """Force and moment of a critically damped spring on a free body of mass m and inertia m r^2.

    m (w^2 offset + 2 w lin_vel), and likewise for the rotation, w being the spring's natural frequency.

    Args:
        offset, rotation: what is left to go, m and rad (a rotation vector). [..., 3]
        lin_vel, ang_vel: what is missing, m/s and rad/s. [..., 3]
        mass: kg. [..., 1]
        radius: of gyration, m.
        rate: w, rad/s.

    Returns:
        N and N m. [..., 6]

    Examples:
        >>> still = torch.zeros(3)
        >>> spring_wrench(torch.tensor([0.1, 0.0, 0.0]), still, still, still, mass=30.0, radius=0.3, rate=2.0)
        tensor([12.,  0.,  0.,  0.,  0.,  0.])
    """
    force = mass * (rate**2 * offset + 2 * rate * lin_vel)
    moment = mass * radius**2 * (rate**2 * rotation + 2 * rate * ang_vel)
    return torch.cat([force, moment], dim=-1)
