"""Rotations against values worked out by hand and against scipy."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from hdmi.functional import (
    quat_angle,
    quat_apply,
    quat_apply_inverse,
    quat_conjugate,
    quat_from_axis_angle,
    quat_from_euler,
    quat_multiply,
    quat_to_rot6d,
    quat_to_rotation_vector,
    yaw_quat,
)

HALF = math.sqrt(0.5)
IDENTITY = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
X, Y, Z = torch.eye(3, dtype=torch.float64)
QUARTER_X = torch.tensor([HALF, HALF, 0.0, 0.0], dtype=torch.float64)
QUARTER_Y = torch.tensor([HALF, 0.0, HALF, 0.0], dtype=torch.float64)
QUARTER_Z = torch.tensor([HALF, 0.0, 0.0, HALF], dtype=torch.float64)


def floats(low: float, high: float, size: int) -> st.SearchStrategy[Tensor]:
    figure = st.floats(low, high, allow_nan=False, width=32)
    return st.lists(figure, min_size=size, max_size=size).map(lambda v: torch.tensor(v, dtype=torch.float64))


vectors = floats(-10, 10, 3)
axes = floats(-1, 1, 3).filter(lambda v: v.norm() > 0.1).map(lambda v: v / v.norm())
quats = floats(-1, 1, 4).filter(lambda q: q.norm() > 0.1).map(lambda q: q / q.norm())
angles = st.floats(-3.0, 3.0)


def scipy(q: Tensor) -> Rotation:
    return Rotation.from_quat(q.numpy(), scalar_first=True)


def close(actual: Tensor, expected, atol: float = 1e-9) -> None:
    torch.testing.assert_close(actual, torch.as_tensor(np.asarray(expected)), rtol=0, atol=atol)


def same_rotation(a: Tensor, b: Tensor) -> None:
    close((a * b).sum(-1).abs(), np.ones(a.shape[:-1]))


def test_conjugate_negates_the_vector_part():
    close(quat_conjugate(torch.tensor([0.1, 0.2, -0.3, 0.4])), np.float32([0.1, -0.2, 0.3, -0.4]))


def test_multiply_applies_the_right_factor_first():
    close(quat_multiply(QUARTER_X, QUARTER_Z), [0.5, 0.5, -0.5, 0.5])
    # z turns x to y, then x turns y to z
    close(quat_apply(quat_multiply(QUARTER_X, QUARTER_Z), X), Z)


def test_quarter_turns_follow_the_right_hand():
    close(quat_apply(QUARTER_X, Y), Z)
    close(quat_apply(QUARTER_Y, Z), X)
    close(quat_apply(QUARTER_Z, X), Y)
    close(quat_apply_inverse(QUARTER_Z, Y), X)


@given(quats, vectors)
def test_apply_matches_scipy_and_preserves_norm(q, v):
    rotated = quat_apply(q, v)
    close(rotated, scipy(q).apply(v.numpy()))
    close(rotated.norm(), v.norm())


@given(quats, vectors)
def test_inverse_undoes(q, v):
    close(quat_apply_inverse(q, quat_apply(q, v)), v)
    close(quat_multiply(q, quat_conjugate(q)), IDENTITY)


@given(quats, quats, vectors)
def test_product_composes(a, b, v):
    product = quat_multiply(a, b)
    same_rotation(product, torch.as_tensor((scipy(a) * scipy(b)).as_quat(scalar_first=True)))
    close(quat_apply(product, v), quat_apply(a, quat_apply(b, v)))
    close(product.norm(), 1.0)


def test_angle_of_known_rotations():
    close(quat_angle(IDENTITY, IDENTITY), 0.0)
    close(quat_angle(QUARTER_X, IDENTITY), math.pi / 2)
    close(quat_angle(QUARTER_X, quat_conjugate(QUARTER_X)), math.pi)
    # a quarter about x and a quarter about y are a third of a turn apart
    close(quat_angle(QUARTER_X, QUARTER_Y), 2 * math.pi / 3)


@given(quats, quats)
def test_angle_matches_scipy_is_symmetric_and_ignores_sign(a, b):
    angle = quat_angle(a, b)
    close(angle, (scipy(a).inv() * scipy(b)).magnitude(), atol=1e-7)
    close(quat_angle(b, a), angle)
    close(quat_angle(-a, b), angle)
    assert 0 <= angle <= math.pi + 1e-12


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1e-4, 1e-3, math.pi - 1e-3, math.pi - 1e-4, math.pi])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_angle_is_accurate_at_both_ends(angle, dtype):
    q = quat_from_axis_angle(torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64), torch.tensor(angle).double())
    base = torch.tensor([0.5, -0.5, 0.5, 0.5], dtype=torch.float64)
    measured = quat_angle(quat_multiply(q, base).to(dtype), base.to(dtype))
    # acos of a float32 dot product would be off by 3e-4 here
    assert abs(measured.item() - angle) < (1e-6 if dtype == torch.float32 else 1e-7)


def test_angle_has_a_gradient_at_zero():
    q = IDENTITY.clone().requires_grad_()
    quat_angle(q, IDENTITY).backward()
    assert q.grad is not None
    assert q.grad.isfinite().all()


def test_yaw_quat_of_known_headings():
    close(yaw_quat(QUARTER_Z), QUARTER_Z)
    close(yaw_quat(QUARTER_X), IDENTITY)
    # x axis up and to the left: what is left of it on the ground points along y
    close(yaw_quat(quat_from_euler(torch.tensor([0.4, -0.7, math.pi / 2], dtype=torch.float64))), QUARTER_Z)


@given(quats.filter(lambda q: quat_apply(q, X)[:2].norm() > 1e-3))
def test_yaw_quat_keeps_the_heading_and_only_that(q):
    heading = yaw_quat(q)
    close(heading[1:3], [0.0, 0.0])
    close(heading.norm(), 1.0)
    x_axis = quat_apply_inverse(heading, quat_apply(q, X))
    close(x_axis[1], 0.0, atol=1e-7)
    assert x_axis[0] > 0


@given(angles, quats.filter(lambda q: quat_apply(q, X)[:2].norm() > 1e-3))
def test_turning_about_z_turns_the_heading(angle, q):
    turn = quat_from_axis_angle(Z, torch.tensor(angle, dtype=torch.float64))
    same_rotation(yaw_quat(turn), turn)
    same_rotation(yaw_quat(quat_multiply(turn, q)), quat_multiply(turn, yaw_quat(q)))


def test_axis_angle_of_a_quarter_turn():
    close(quat_from_axis_angle(Y, torch.tensor(math.pi / 2, dtype=torch.float64)), QUARTER_Y)


@given(axes, angles)
def test_axis_angle_matches_scipy(axis, angle):
    q = quat_from_axis_angle(axis, torch.tensor(angle, dtype=torch.float64))
    same_rotation(q, torch.as_tensor(Rotation.from_rotvec(angle * axis.numpy()).as_quat(scalar_first=True)))
    close(quat_angle(q, IDENTITY), abs(angle))


def test_euler_of_single_axes():
    for axis, expected in enumerate((QUARTER_X, QUARTER_Y, QUARTER_Z)):
        rpy = torch.zeros(3, dtype=torch.float64)
        rpy[axis] = math.pi / 2
        close(quat_from_euler(rpy), expected)


@given(floats(-7, 7, 3))
def test_euler_matches_scipy_about_fixed_axes(rpy):
    same_rotation(
        quat_from_euler(rpy), torch.as_tensor(Rotation.from_euler("xyz", rpy.numpy()).as_quat(scalar_first=True))
    )


def test_rot6d_of_a_quarter_turn():
    # x goes to y, y goes to -x
    close(quat_to_rot6d(QUARTER_Z), [0.0, 1.0, 0.0, -1.0, 0.0, 0.0])


@given(quats)
def test_rot6d_is_the_first_two_columns(q):
    matrix = scipy(q).as_matrix()
    close(quat_to_rot6d(q), np.concatenate([matrix[:, 0], matrix[:, 1]]))
    close(quat_to_rot6d(-q), quat_to_rot6d(q))


def test_rotation_vectors_of_known_rotations():
    close(quat_to_rotation_vector(IDENTITY), [0.0, 0.0, 0.0])
    close(quat_to_rotation_vector(-IDENTITY), [0.0, 0.0, 0.0])
    close(quat_to_rotation_vector(QUARTER_Y), [0.0, math.pi / 2, 0.0])
    # three quarters of a turn to the left are one to the right
    three_quarters = quat_from_axis_angle(Z, torch.tensor(1.5 * math.pi, dtype=torch.float64))
    close(quat_to_rotation_vector(three_quarters), [0.0, 0.0, -math.pi / 2])


@given(axes, angles)
def test_rotation_vector_undoes_axis_angle_whatever_the_sign(axis, angle):
    q = quat_from_axis_angle(axis, torch.tensor(angle, dtype=torch.float64))
    close(quat_to_rotation_vector(q), angle * axis, atol=1e-7)
    close(quat_to_rotation_vector(-q), angle * axis, atol=1e-7)


@pytest.mark.parametrize("angle", [1e-9, 1e-7, 2e-6, 1e-4, 1e-3, math.pi - 1e-3, math.pi - 1e-4])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rotation_vector_is_accurate_at_both_ends(angle, dtype):
    axis = torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64)
    q = quat_from_axis_angle(axis, torch.tensor(angle).double()).to(dtype)
    for sign in (1, -1):
        found = quat_to_rotation_vector(sign * q).double()
        assert (found - angle * axis).norm() < (1e-6 * angle + 1e-12 if angle < 1 else 1e-6)


def test_rotation_vector_of_half_a_turn():
    """Either axis is right."""
    half = torch.tensor([0.0, 0.6, 0.0, -0.8], dtype=torch.float64)
    for q in (half, -half):
        found = quat_to_rotation_vector(q)
        close(found.norm(), math.pi)
        close((found / math.pi * half[1:]).sum().abs(), 1.0)


@pytest.mark.parametrize("q", [IDENTITY, -IDENTITY, QUARTER_X], ids=["identity", "negative identity", "quarter"])
def test_rotation_vector_has_its_gradient(q):
    """Twice that of the vector part at the identity."""
    jacobian = torch.autograd.functional.jacobian(quat_to_rotation_vector, q)
    assert jacobian.isfinite().all()
    if q[1] == 0:
        close(jacobian[:, 1:], 2 * q[0] * torch.eye(3, dtype=torch.float64))


@pytest.mark.parametrize(
    ("function", "shapes", "expected"),
    [
        (quat_conjugate, [(5, 3, 4)], (5, 3, 4)),
        (quat_multiply, [(5, 1, 4), (3, 4)], (5, 3, 4)),
        (quat_apply, [(5, 1, 4), (3, 3)], (5, 3, 3)),
        (quat_apply, [(4,), (5, 3, 3)], (5, 3, 3)),
        (quat_apply_inverse, [(5, 1, 4), (3, 3)], (5, 3, 3)),
        (quat_angle, [(5, 1, 4), (3, 4)], (5, 3)),
        (yaw_quat, [(5, 3, 4)], (5, 3, 4)),
        (quat_from_axis_angle, [(5, 3), (5,)], (5, 4)),
        (quat_from_euler, [(5, 2, 3)], (5, 2, 4)),
        (quat_to_rot6d, [(5, 3, 4)], (5, 3, 6)),
        (quat_to_rotation_vector, [(5, 3, 4)], (5, 3, 3)),
        (quat_apply, [(0, 4), (0, 3)], (0, 3)),
    ],
)
def test_leading_dimensions_broadcast(function, shapes, expected):
    assert function(*(torch.ones(shape) for shape in shapes)).shape == expected


def test_broadcasting_equals_a_loop():
    generator = torch.Generator().manual_seed(0)
    q = torch.nn.functional.normalize(torch.randn(4, 1, 4, generator=generator), dim=-1)
    v = torch.randn(3, 3, generator=generator)
    together = quat_apply(q, v)
    for i in range(4):
        for j in range(3):
            torch.testing.assert_close(together[i, j], quat_apply(q[i, 0], v[j]))
