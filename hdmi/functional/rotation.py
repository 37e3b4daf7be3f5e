"""Rotations as unit quaternions wxyz, broadcasting over leading dimensions."""

from __future__ import annotations

import torch
from torch import Tensor


def quat_conjugate(q: Tensor) -> Tensor:
    """Inverse of a unit quaternion. [..., 4] -> [..., 4]

    Examples:
        >>> quat_conjugate(torch.tensor([0.5, 0.5, 0.5, 0.5]))
        tensor([ 0.5000, -0.5000, -0.5000, -0.5000])
    """
    return torch.cat([q[..., :1], -q[..., 1:]], dim=-1)


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product: the rotation b followed by a. [..., 4], [..., 4] -> [..., 4]

    Examples:
        >>> quarter = torch.tensor([0.5**0.5, 0.0, 0.0, 0.5**0.5])  # about z; twice is half a turn
        >>> quat_multiply(quarter, quarter)
        tensor([0.0000, 0.0000, 0.0000, 1.0000])
    """
    a, b = torch.broadcast_tensors(a, b)  # which torch.linalg.cross does not do by itself
    aw, axyz, bw, bxyz = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    w = aw * bw - (axyz * bxyz).sum(-1, keepdim=True)
    return torch.cat([w, aw * bxyz + bw * axyz + torch.linalg.cross(axyz, bxyz)], dim=-1)


def quat_apply(q: Tensor, v: Tensor) -> Tensor:
    """Rotates vectors. [..., 4], [..., 3] -> [..., 3]

    Examples:
        >>> half_turn = torch.tensor([0.0, 0.0, 0.0, 1.0])  # about z
        >>> quat_apply(half_turn, torch.tensor([1.0, 2.0, 3.0]))
        tensor([-1., -2.,  3.])
    """
    xyz, v = torch.broadcast_tensors(q[..., 1:], v)
    t = 2 * torch.linalg.cross(xyz, v)
    return v + q[..., :1] * t + torch.linalg.cross(xyz, t)


def quat_apply_inverse(q: Tensor, v: Tensor) -> Tensor:
    """Rotates vectors by the inverse: world to body frame. [..., 4], [..., 3] -> [..., 3]

    Examples:
        >>> cycle = torch.tensor([0.5, 0.5, 0.5, 0.5])  # x to y, y to z, z to x
        >>> quat_apply_inverse(cycle, torch.tensor([1.0, 2.0, 3.0]))
        tensor([2., 3., 1.])
    """
    xyz, v = torch.broadcast_tensors(q[..., 1:], v)
    t = 2 * torch.linalg.cross(v, xyz)
    return v + q[..., :1] * t + torch.linalg.cross(t, xyz)


def quat_angle(a: Tensor, b: Tensor) -> Tensor:
    """Angle of the rotation between two orientations, rad in [0, pi]. [..., 4], [..., 4] -> [...]

    Examples:
        >>> quat_angle(torch.tensor([1.0, 0.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0, 0.0]))
        tensor(3.1416)
    """
    # The chord |a - b| of unit quaternions is 2 sin(angle / 4); unlike acos(a . b) it is accurate at small angles.
    chord = torch.minimum((a - b).norm(dim=-1), (a + b).norm(dim=-1))
    return 4 * torch.asin((0.5 * chord).clamp(max=1.0))


def yaw_quat(q: Tensor) -> Tensor:
    """Heading of an orientation: the rotation about world z of its x axis. [..., 4] -> [..., 4]

    Examples:
        >>> leaning = quat_from_euler(torch.tensor([0.3, 0.2, torch.pi / 3]))
        >>> yaw_quat(leaning)
        tensor([0.8660, 0.0000, 0.0000, 0.5000])
    """
    w, x, y, z = q.unbind(-1)
    half = 0.5 * torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    zero = torch.zeros_like(half)
    return torch.stack([half.cos(), zero, zero, half.sin()], dim=-1)


def quat_from_axis_angle(axis: Tensor, angle: Tensor) -> Tensor:
    """Rotation by `angle` rad about unit `axis`. [..., 3], [...] -> [..., 4]

    Examples:
        >>> quat_from_axis_angle(torch.tensor([0.0, 0.0, 1.0]), torch.tensor(torch.pi / 3))
        tensor([0.8660, 0.0000, 0.0000, 0.5000])
    """
    half = 0.5 * angle[..., None]
    return torch.cat([half.cos(), half.sin() * axis], dim=-1)


def quat_from_euler(rpy: Tensor) -> Tensor:
    """Rotation with roll, pitch, yaw (x, then y, then z, about fixed axes), rad. [..., 3] -> [..., 4]

    Examples:
        >>> quat_from_euler(torch.tensor([torch.pi / 2, 0.0, torch.pi / 2]))  # x to y, y to z, z to x
        tensor([0.5000, 0.5000, 0.5000, 0.5000])
    """
    cr, cp, cy = (0.5 * rpy).cos().unbind(-1)
    sr, sp, sy = (0.5 * rpy).sin().unbind(-1)
    return torch.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        dim=-1,
    )


def quat_to_rot6d(q: Tensor) -> Tensor:
    """First two columns of the rotation matrix, a continuous representation for networks. [..., 4] -> [..., 6]

    Examples:
        >>> quat_to_rot6d(torch.tensor([0.5, 0.5, 0.5, 0.5]))  # x goes to y, y to z
        tensor([0., 1., 0., 0., 0., 1.])
    """
    w, x, y, z = q.unbind(-1)
    return torch.stack(
        [
            1 - 2 * (y * y + z * z),
            2 * (x * y + w * z),
            2 * (x * z - w * y),
            2 * (x * y - w * z),
            1 - 2 * (x * x + z * z),
            2 * (y * z + w * x),
        ],
        dim=-1,
    )


def quat_to_rotation_vector(q: Tensor) -> Tensor:
    """Axis times angle, at most pi, of unit quaternions wxyz. [..., 4] -> [..., 3], rad

    Examples:
        >>> quat_to_rotation_vector(torch.tensor([0.5**0.5, 0.0, 0.0, -(0.5**0.5)]))  # a quarter turn to the right
        tensor([ 0.0000,  0.0000, -1.5708])
    """
    q = torch.where(q[..., :1] < 0, -q, q)  # the shorter way
    sine = q[..., 1:].norm(dim=-1, keepdim=True)  # of half the angle
    angle = 2 * torch.atan2(sine, q[..., :1])
    return q[..., 1:] * torch.where(sine > 1e-6, angle / sine.clamp(min=1e-6), 2.0)
