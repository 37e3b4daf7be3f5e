"""Termination kernels (the paper's table of termination conditions)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor


def error_exceeds(error: Tensor, threshold: float) -> Tensor:
    """Whether any of the errors is above the threshold. [..., K] -> bool [..., 1]

    Examples:
        >>> error_exceeds(torch.tensor([[0.1, 0.6], [0.1, 0.2]]), 0.5)
        tensor([[ True],
                [False]])
    """
    return (error > threshold).any(-1, keepdim=True)


def any_error_exceeds(*errors: Tensor, thresholds: Sequence[float]) -> Tensor:
    """Whether any of several errors is above its threshold. [..., K] each -> bool [..., 1]

    Examples:
        >>> any_error_exceeds(torch.tensor([0.1, 0.2]), torch.tensor([0.6]), thresholds=[0.5, 0.5])
        tensor([True])
    """
    exceeded = [error_exceeds(error, threshold) for error, threshold in zip(errors, thresholds, strict=True)]
    return torch.stack(exceeded).any(0)


def contact_lost(
    eef_pos_w: Tensor,
    target_pos_w: Tensor,
    force: Tensor,
    active: Tensor,
    *,
    distance: float,
    min_force: float,
    require: Literal["either", "both"] = "either",
) -> Tensor:
    """Whether an end effector that should touch is too far from its contact point, or touches without force.

    Args:
        eef_pos_w, target_pos_w: m. [..., E, 3]
        force: N. [..., E, 3]
        active: whether contact is intended. bool [..., E]
        distance: m.
        min_force: N.
        require: `either`: a contact is near and firm, and lost when it is far or loose; `both`: only when it is both.

    Returns:
        bool [..., 1]

    Examples:
        >>> hand = torch.tensor([[0.3, 0.0, 0.0]])  # presses with 10 N, 30 cm off its contact point
        >>> state = (hand, torch.zeros(1, 3), torch.tensor([[10.0, 0.0, 0.0]]), torch.tensor([True]))
        >>> contact_lost(*state, distance=0.2, min_force=1.0)
        tensor([True])
        >>> contact_lost(*state, distance=0.2, min_force=1.0, require="both")
        tensor([False])
    """
    far = (eef_pos_w - target_pos_w).norm(dim=-1) > distance
    loose = force.norm(dim=-1) < min_force
    lost = far | loose if require == "either" else far & loose
    return (lost & active).any(-1, keepdim=True)


def persist(condition: Tensor, count: Tensor) -> Tensor:
    """Consecutive steps for which the condition has held. bool [..., 1], int [..., 1] -> int [..., 1]

    Examples:
        >>> persist(torch.tensor([[True], [False]]), torch.tensor([[2], [2]]))
        tensor([[3],
                [0]])
    """
    return (count + 1) * condition.to(count.dtype)
