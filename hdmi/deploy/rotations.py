"""Rotations in numpy: quaternions wxyz, batched over the leading dimensions."""

from __future__ import annotations

import math

import numpy as np


def quat_multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product. [..., 4], [..., 4] -> [..., 4]"""
    w, x, y, z = a[..., 0], a[..., 1], a[..., 2], a[..., 3]
    W, X, Y, Z = b[..., 0], b[..., 1], b[..., 2], b[..., 3]  # noqa: N806
    product = (
        w * W - x * X - y * Y - z * Z,
        w * X + x * W + y * Z - z * Y,
        w * Y - x * Z + y * W + z * X,
        w * Z + x * Y - y * X + z * W,
    )
    return np.stack(product, axis=-1)


def quat_conjugate(quat: np.ndarray) -> np.ndarray:
    """The inverse of a unit quaternion. [..., 4]"""
    return quat * np.array([1.0, -1.0, -1.0, -1.0])


def quat_apply(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Rotates vectors. [..., 4], [..., 3] -> [..., 3]"""
    axis = quat[..., 1:]
    turned = 2.0 * _cross(axis, vector)
    return vector + quat[..., :1] * turned + _cross(axis, turned)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The cross product, for few vectors several times as fast as numpy's. [..., 3], [..., 3] -> [..., 3]"""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    X, Y, Z = b[..., 0], b[..., 1], b[..., 2]  # noqa: N806
    return np.stack([y * Z - z * Y, z * X - x * Z, x * Y - y * X], axis=-1)


def quat_apply_inverse(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Rotates vectors back. [..., 4], [..., 3] -> [..., 3]"""
    return quat_apply(quat_conjugate(quat), vector)


def quat_angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle between orientations, rad, in [0, pi]. [..., 4], [..., 4] -> [...]"""
    difference = quat_multiply(quat_conjugate(a), b)
    return 2.0 * np.arctan2(np.linalg.norm(difference[..., 1:], axis=-1), np.abs(difference[..., 0]))


def quat_from_rotation_vector(vector: np.ndarray) -> np.ndarray:
    """Rotation about an axis by its length, rad. [..., 3] -> [..., 4]"""
    half = 0.5 * np.linalg.norm(vector, axis=-1, keepdims=True)
    # sin(x) / x, also at 0
    return np.concatenate([np.cos(half), 0.5 * vector * np.sinc(half / np.pi)], axis=-1)


def rotation_vector(quat: np.ndarray) -> np.ndarray:
    """Axis times angle of the shorter way round, rad. [..., 4] -> [..., 3]"""
    quat = np.where(quat[..., :1] < 0, -quat, quat)
    sine = np.linalg.norm(quat[..., 1:], axis=-1, keepdims=True)
    half = np.arctan2(sine, quat[..., :1])
    return 2.0 * quat[..., 1:] * np.where(sine > 1e-9, half / np.maximum(sine, 1e-9), 1.0)


def matrix_of(quat: np.ndarray) -> np.ndarray:
    """Rotation matrices. [..., 4] -> [..., 3, 3]"""
    w, x, y, z = quat[..., 0], quat[..., 1], quat[..., 2], quat[..., 3]
    entries = (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip
    return np.stack(entries, axis=-1).reshape(*quat.shape[:-1], 3, 3)


def quat_from_euler(angles: np.ndarray) -> np.ndarray:
    """Roll, pitch and yaw about the fixed axes x, y, z in this order, rad. [..., 3] -> [..., 4]"""
    turns = [quat_from_rotation_vector(angles[..., i : i + 1] * np.eye(3)[i]) for i in range(3)]
    return quat_multiply(turns[2], quat_multiply(turns[1], turns[0]))


def tilt_of(quat: np.ndarray) -> np.ndarray:
    """Angle between a body's z axis and the vertical, rad. [..., 4] -> [...]"""
    x, y = quat[..., 1], quat[..., 2]
    return np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0))


def yaw_of(quat: np.ndarray) -> np.ndarray:
    """The rotation about the vertical that is left when a body's tilt is taken away. [..., 4] -> [..., 4]"""
    w, x, y, z = quat[..., 0], quat[..., 1], quat[..., 2], quat[..., 3]
    half = 0.5 * np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    zero = np.zeros_like(half)
    return np.stack([np.cos(half), zero, zero, np.sin(half)], axis=-1)


def turn_about(axis: np.ndarray, quat: np.ndarray) -> float:
    """The angle of a rotation's part about a unit axis, rad, in (-pi, pi]. [3], [4]"""
    return wrapped(2.0 * math.atan2(float(quat[1:] @ axis), float(quat[0])))


def wrapped(angle: float) -> float:
    """The same angle in (-pi, pi], rad."""
    return math.pi - (math.pi - angle) % (2.0 * math.pi)
