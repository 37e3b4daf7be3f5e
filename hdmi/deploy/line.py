"""A line that delays what it carries and loses some of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np

T = TypeVar("T")


class Line(Generic[T]):
    """Carries items in their order.

    Args:
        delay: s.
        loss: share of items that are lost.
        rng: what decides which.
    """

    def __init__(self, delay: float, loss: float, rng: np.random.Generator):
        self._delay, self._loss, self._rng = delay, loss, rng
        self._under_way: deque[tuple[float, T]] = deque()

    def put(self, now: float, item: Callable[[], T]) -> None:
        """Sends an item, which is asked for if it is not lost, at a time, s."""
        if self._rng.uniform() >= self._loss:
            self._under_way.append((now, item()))

    def due(self, now: float) -> list[tuple[float, T]]:
        """What has arrived since the last call, with the times at which it was sent, s."""
        found = []
        while self._under_way and self._under_way[0][0] + self._delay <= now + 1e-9:
            found.append(self._under_way.popleft())
        return found
