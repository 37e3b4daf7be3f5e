"""Poses in the frame that tracking compares them in, and velocities of bodies."""

from __future__ import annotations

import torch
from torch import Tensor

from hdmi.functional.rotation import quat_apply_inverse, quat_conjugate, quat_multiply, yaw_quat


def local_pose(
    body_pos_w: Tensor, body_quat_w: Tensor, root_pos_w: Tensor, root_quat_w: Tensor
) -> tuple[Tensor, Tensor]:
    """Body poses in the root's yaw frame at the root's ground projection (height is kept).

    Args:
        body_pos_w: m. [..., K, 3]
        body_quat_w: [..., K, 4]
        root_pos_w: m. [..., 3]
        root_quat_w: [..., 4]

    Returns:
        Positions [..., K, 3] and orientations [..., K, 4] in that frame.
    """
    heading = yaw_quat(root_quat_w).unsqueeze(-2)  # [..., 1, 4]
    ground = torch.cat([root_pos_w[..., :2], torch.zeros_like(root_pos_w[..., 2:])], dim=-1).unsqueeze(-2)
    pos = quat_apply_inverse(heading, body_pos_w - ground)
    quat = quat_multiply(quat_conjugate(heading).expand_as(body_quat_w), body_quat_w)
    return pos, quat


def body_velocity(cvel: Tensor, pos_w: Tensor, com_w: Tensor) -> tuple[Tensor, Tensor]:
    """World velocities of body origins from MuJoCo's com-based spatial velocities.

    Args:
        cvel: angular, then linear velocity at the tree's centre of mass. [..., B, 6]
        pos_w: body origins, m. [..., B, 3]
        com_w: centre of mass of the kinematic tree, m. [..., 1 or B, 3]

    Returns:
        Linear (m/s) and angular (rad/s) velocities. [..., B, 3] each
    """
    ang = cvel[..., :3]
    lin = cvel[..., 3:] + torch.linalg.cross(ang, pos_w - com_w)
    return lin, ang
