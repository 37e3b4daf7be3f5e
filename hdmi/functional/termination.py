"""Termination kernels (the paper's table of termination conditions)."""

from __future__ import annotations

from torch import Tensor


def error_exceeds(error: Tensor, threshold: float) -> Tensor:
    """Whether any of the errors is above the threshold. [..., K] -> bool [..., 1]"""
    return (error > threshold).any(-1, keepdim=True)


def contact_lost(
    eef_pos_w: Tensor, target_pos_w: Tensor, force: Tensor, active: Tensor, *, distance: float, min_force: float
) -> Tensor:
    """Whether an end effector that should touch is both too far from its contact point and without force.

    Args:
        eef_pos_w, target_pos_w: m. [..., E, 3]
        force: N. [..., E, 3]
        active: whether contact is intended. bool [..., E]
        distance: m. min_force: N.

    Returns:
        bool [..., 1]
    """
    far = (eef_pos_w - target_pos_w).norm(dim=-1) > distance
    loose = force.norm(dim=-1) < min_force
    return (far & loose & active).any(-1, keepdim=True)


def persist(condition: Tensor, count: Tensor) -> Tensor:
    """Consecutive steps for which the condition has held. bool [..., 1], int [..., 1] -> int [..., 1]"""
    return (count + 1) * condition.to(count.dtype)
