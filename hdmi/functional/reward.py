"""Reward kernels (the paper's reward table). All return [..., 1]; penalties are positive, their weights negative."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor


def tracking(error: Tensor, *, sigma: float, tolerance: float = 0.0) -> Tensor:
    """Tracking kernel `exp(-max(mean error - tolerance, 0) / sigma)`.

    Args:
        error: non-negative errors. [..., K]
        sigma: error above the tolerance at which the reward has fallen to 1/e, in the error's unit.
        tolerance: error that costs nothing.

    Returns:
        Reward in (0, 1]. [..., 1]

    Examples:
        >>> tracking(torch.tensor([0.1, 0.3]), sigma=0.2)  # exp(-1)
        tensor([0.3679])
        >>> tracking(torch.tensor([0.1, 0.3]), sigma=0.2, tolerance=0.2)
        tensor([1.])
    """
    return torch.exp(-(error.mean(-1, keepdim=True) - tolerance).clamp(min=0) / sigma)


def tracking_mean(*errors: Tensor, sigmas: Sequence[float], tolerances: Sequence[float]) -> Tensor:
    """Mean of the tracking kernels of several errors, each with its own sigma and tolerance.

    Args:
        errors: non-negative errors. [..., K] each, K of its own

    Returns:
        Reward in (0, 1]. [..., 1]

    Examples:
        >>> near, far = torch.tensor([0.0, 0.0]), torch.tensor([0.2])
        >>> tracking_mean(near, far, sigmas=[0.1, 0.2], tolerances=[0.0, 0.0])  # (1 + exp(-1)) / 2
        tensor([0.6839])
    """
    kernels = [tracking(e, sigma=s, tolerance=t) for e, s, t in zip(errors, sigmas, tolerances, strict=True)]
    return torch.stack(kernels).mean(0)


def interaction(
    eef_pos_w: Tensor,
    target_pos_w: Tensor,
    force: Tensor,
    active: Tensor,
    *,
    sigma_pos: float,
    sigma_frc: float,
    force_threshold: float,
    tolerance: float = 0.0,
    reduce: Literal["mean", "max"] = "mean",
) -> Tensor:
    """Reward for touching the object where and when the reference does (section III-B-3).

    Proximity `exp(-|p_eef - p_target| / sigma_pos)` times sufficient force
    `min(exp((|F| - F_thres) / sigma_frc), 1)`, over the end effectors whose contact is intended in this
    frame; zero where none is.

    Args:
        eef_pos_w, target_pos_w: end effectors and their contact points, m. [..., E, 3]
        force: contact force between each end effector and the object, N. [..., E, 3]
        active: whether contact is intended. bool [..., E]
        tolerance: distance that costs nothing, m.
        reduce: `mean` over the active effectors, or the best of them (`max`).

    Returns:
        Reward in [0, 1]. [..., 1]

    Examples:
        >>> hands = torch.tensor([[0.0, 0.1, 0.0], [0.0, 0.0, 0.0]])  # the first is 10 cm off, the second at its point
        >>> force = torch.tensor([[0.0, 8.0, 0.0], [0.0, 0.0, 0.0]])  # but does not press
        >>> sigmas = {"sigma_pos": 0.1, "sigma_frc": 5.0, "force_threshold": 5.0}
        >>> interaction(hands, torch.zeros(2, 3), force, torch.tensor([True, False]), **sigmas)  # exp(-0.1 / 0.1)
        tensor([0.3679])
        >>> interaction(hands, torch.zeros(2, 3), force, torch.tensor([False, True]), **sigmas)  # exp((0 - 5) / 5)
        tensor([0.3679])
    """
    distance = ((eef_pos_w - target_pos_w).norm(dim=-1) - tolerance).clamp(min=0)  # [..., E]
    proximity = torch.exp(-distance / sigma_pos)
    firmness = torch.exp((force.norm(dim=-1) - force_threshold).clamp(max=0) / sigma_frc)
    intended = active.to(proximity.dtype)
    reward = proximity * firmness * intended
    if reduce == "max":
        return reward.amax(-1, keepdim=True)
    return reward.sum(-1, keepdim=True) / intended.sum(-1, keepdim=True).clamp(min=1)


def alive(terminated: Tensor) -> Tensor:
    """One in every step that does not terminate. bool [..., 1] -> [..., 1]

    Examples:
        >>> alive(torch.tensor([[True], [False]]))
        tensor([[0.],
                [1.]])
    """
    return (~terminated).float()


def sum_of_squares(value: Tensor) -> Tensor:
    """Squares, summed over joints. [..., J] -> [..., 1]

    Examples:
        >>> sum_of_squares(torch.tensor([1.0, 2.0]))
        tensor([5.])
    """
    return value.square().sum(-1, keepdim=True)


def action_rate(action: Tensor, previous: Tensor) -> Tensor:
    """Squared change of the action between control steps. [..., A], [..., A] -> [..., 1]

    Examples:
        >>> action_rate(torch.tensor([1.0, 2.0]), torch.tensor([0.0, 0.0]))
        tensor([5.])
    """
    return (action - previous).square().sum(-1, keepdim=True)


def limit_excess(value: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """L1 distance outside of [low, high], summed over joints. [..., J] -> [..., 1]

    Examples:
        >>> low, high = torch.full((3,), -1.0), torch.full((3,), 1.0)
        >>> limit_excess(torch.tensor([-1.5, 0.2, 2.0]), low, high)
        tensor([1.5000])
    """
    return ((low - value).clamp(min=0) + (value - high).clamp(min=0)).sum(-1, keepdim=True)


def feet_impact(force: Tensor, previous_force: Tensor, *, weight_force: float) -> Tensor:
    """Squared rise of each foot's force in one control step, in units of `weight_force` N, over both feet.

    Standing and pushing off cost nothing; landing hard does.

    Args:
        force, previous_force: on each foot, N. [..., 2, 3]
        weight_force: the robot's weight, N.

    Returns:
        [..., 1]

    Examples:
        >>> before = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 300.0]])
        >>> after = torch.tensor([[0.0, 0.0, 600.0], [0.0, 0.0, 0.0]])  # one lands at twice the weight, one lifts off
        >>> feet_impact(after, before, weight_force=300.0)
        tensor([4.])
    """
    rise = (force.norm(dim=-1) - previous_force.norm(dim=-1)).clamp(min=0) / weight_force
    return rise.square().sum(-1, keepdim=True)


def feet_slip(foot_lin_vel_w: Tensor, force: Tensor, *, force_threshold: float) -> Tensor:
    """Horizontal speed of the feet that carry load, m/s summed over feet. [..., 2, 3], [..., 2, 3] -> [..., 1]

    Examples:
        >>> velocity = torch.tensor([[0.3, 0.4, 0.0], [1.0, 0.0, 0.0]])
        >>> force = torch.tensor([[0.0, 0.0, 200.0], [0.0, 0.0, 0.0]])  # the second foot is in the air
        >>> feet_slip(velocity, force, force_threshold=1.0)
        tensor([0.5000])
    """
    loaded = force.norm(dim=-1) > force_threshold
    return (foot_lin_vel_w[..., :2].norm(dim=-1) * loaded).sum(-1, keepdim=True)


def feet_stumble(force: Tensor, *, ratio: float) -> Tensor:
    """Number of feet that run into something: pushed sideways more than they carry.

    Args:
        force: on each foot, world frame, N. [..., 2, 3]
        ratio: of horizontal to vertical force above which a foot stumbles; more than friction can give.

    Returns:
        [..., 1]

    Examples:
        >>> feet_stumble(torch.tensor([[50.0, 0.0, 10.0], [20.0, 0.0, 100.0]]), ratio=4.0)
        tensor([1.])
    """
    stumbles = force[..., :2].norm(dim=-1) > ratio * force[..., 2].abs()
    return stumbles.sum(-1, keepdim=True).to(force.dtype)


def feet_air_time(air_time: Tensor, touchdown: Tensor, *, threshold: float) -> Tensor:
    """Shortfall of each swing below `threshold` seconds, charged at touchdown: many little steps cost, none do not.

    Args:
        air_time: of the swing that ends, s. [..., 2]
        touchdown: bool [..., 2]

    Returns:
        s. [..., 1]

    Examples:
        >>> feet_air_time(torch.tensor([0.25, 0.1]), torch.tensor([True, False]), threshold=0.5)
        tensor([0.2500])
    """
    return ((threshold - air_time).clamp(min=0) * touchdown).sum(-1, keepdim=True)
