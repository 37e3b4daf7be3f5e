"""How many of torch's threads work, and when."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def torch_threads(num_envs: int, envs_per_thread: int | None) -> Iterator[None]:
    """Lowers torch's threads to what tensors of so many rows can use, without changing them for good.

    Torch's threads wait for work by spinning, for milliseconds, on processors that physics wants. While worlds are
    stepped, a policy between the steps should therefore have no more of them than the environment.

    Args:
        num_envs: rows.
        envs_per_thread: rows that are worth a thread; None leaves torch's threads alone.
    """
    before = torch.get_num_threads()
    if envs_per_thread is not None:
        torch.set_num_threads(min(before, -(-num_envs // envs_per_thread)))
    try:
        yield
    finally:
        torch.set_num_threads(before)


def share_of_processors(parts: int) -> int:
    """Threads for each of so many processes that share the machine, at least 1.

    Examples:
        >>> share_of_processors(10**6)
        1
    """
    return max(1, (os.cpu_count() or 1) // parts)


def set_threads(count: int) -> None:
    """Threads of torch; 0 leaves its choice."""
    if count:
        torch.set_num_threads(count)
