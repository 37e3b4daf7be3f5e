"""Poses in the frame that tracking compares them in, and velocities of bodies."""

from __future__ import annotations

import torch
from torch import Tensor

from hdmi.functional.rotation import yaw_quat


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

    Examples:
        >>> facing_y = quat_from_euler(torch.tensor([0.0, 0.0, torch.pi / 2]))
        >>> ahead = torch.tensor([[1.0, 3.0, 0.5]])  # 2 m in front of a root at (1, 1), 0.5 m above the ground
        >>> pos, quat = local_pose(ahead, facing_y[None], torch.tensor([1.0, 1.0, 0.8]), facing_y)
        >>> pos.round(decimals=3).abs(), quat.round(decimals=3)
        (tensor([[2.0000, 0.0000, 0.5000]]), tensor([[1., 0., 0., 0.]]))
    """
    # The frame is turned about z only, which leaves a plane rotation and half of the quaternion product.
    cos_half, _, _, sin_half = yaw_quat(root_quat_w).unsqueeze(-2).unbind(-1)  # [..., 1]
    cos, sin = cos_half.square() - sin_half.square(), 2 * cos_half * sin_half
    x, y, height = body_pos_w.unbind(-1)
    x, y = x - root_pos_w[..., :1], y - root_pos_w[..., 1:2]
    pos = torch.stack([cos * x + sin * y, cos * y - sin * x, height], dim=-1)
    qw, qx, qy, qz = body_quat_w.unbind(-1)
    quat = torch.stack(
        [
            cos_half * qw + sin_half * qz,
            cos_half * qx + sin_half * qy,
            cos_half * qy - sin_half * qx,
            cos_half * qz - sin_half * qw,
        ],
        dim=-1,
    )
    return pos, quat


def body_velocity(cvel: Tensor, pos_w: Tensor, com_w: Tensor) -> tuple[Tensor, Tensor]:
    """World velocities of body origins from MuJoCo's com-based spatial velocities.

    Args:
        cvel: angular, then linear velocity at the tree's centre of mass. [..., B, 6]
        pos_w: body origins, m. [..., B, 3]
        com_w: centre of mass of the kinematic tree, m. [..., 1 or B, 3]

    Returns:
        Linear (m/s) and angular (rad/s) velocities. [..., B, 3] each

    Examples:
        >>> cvel = torch.tensor([[0.0, 0.0, 2.0, 1.0, 0.0, 0.0]])  # 2 rad/s about z, 1 m/s along x
        >>> lin, ang = body_velocity(cvel, torch.tensor([[0.0, 1.0, 0.0]]), torch.zeros(1, 3))
        >>> lin, ang
        (tensor([[-1.,  0.,  0.]]), tensor([[0., 0., 2.]]))
    """
    ang = cvel[..., :3]
    lin = cvel[..., 3:] + torch.linalg.cross(ang, pos_w - com_w)
    return lin, ang
