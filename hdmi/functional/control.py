"""Targets of position servos."""

from __future__ import annotations

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
    """
    return joint_pos + (torque.clamp(-limit, limit) + damping * joint_vel) / stiffness
