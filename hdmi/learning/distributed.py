"""Data parallelism under torchrun: each rank has its own environment; gradients and statistics are averaged."""

from __future__ import annotations

import os
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor

from hdmi.threads import share_of_processors

_SEED_STRIDE = 2**20  # between ranks, so that runs of neighbouring seeds share none


@dataclass(frozen=True)
class Ranks:
    """This process among those that train together; alone, its methods return what they are given.

    Args:
        rank: of this process.
        size: number of processes.
        local_rank, local_size: the same on this machine.
    """

    rank: int = 0
    size: int = 1
    local_rank: int = 0
    local_size: int = 1

    @classmethod
    def from_environment(cls, device: str) -> Ranks:
        """Joins the processes that torchrun has started, or stands alone.

        Args:
            device: of the training: `cuda` communicates by NCCL, anything else by Gloo.
        """
        if not dist.is_torchelastic_launched():
            return cls()
        if not dist.is_initialized():
            dist.init_process_group("nccl" if device.startswith("cuda") else "gloo")
        local_rank, local_size = (int(os.environ[key]) for key in ("LOCAL_RANK", "LOCAL_WORLD_SIZE"))
        return cls(dist.get_rank(), dist.get_world_size(), local_rank, local_size)

    @property
    def is_first(self) -> bool:
        """Whether this rank logs, evaluates and writes checkpoints."""
        return self.rank == 0

    def seed(self, seed: int) -> int:
        """The seed of this rank in a run of this seed."""
        return seed + _SEED_STRIDE * self.rank

    def threads(self, count: int) -> int:
        """Threads of this rank: those asked for, or its share of the machine's processors; 0 leaves the choice."""
        return count or (0 if self.local_size == 1 else share_of_processors(self.local_size))

    def mean(self, value: Tensor) -> Tensor:
        """Mean over ranks, the same on all of them."""
        if self.size == 1:
            return value
        value = value.detach().clone()
        dist.all_reduce(value)
        return value / self.size

    def moments(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and population variance of the first dimension over all ranks' values. [n, ...] -> [...], [...]

        The ranks may have unequal numbers of them.
        """
        count = torch.tensor(float(len(values)), device=values.device)
        share = count / self.mean(count)
        mean = self.mean(values.mean(0) * share)
        centred = values - mean
        return mean, self.mean(centred.mul_(centred).mean(0) * share)  # in place: all observations of a batch

    def least(self, count: int) -> int:
        """The smallest of the ranks' counts."""
        if self.size == 1:
            return count
        counts = [0] * self.size
        dist.all_gather_object(counts, count)
        return min(counts)

    def mean_row(self, row: dict[str, float]) -> dict[str, float]:
        """Mean of each figure over the ranks that have it."""
        if self.size == 1:
            return row
        rows: list[dict[str, float]] = [{}] * self.size
        dist.all_gather_object(rows, row)
        keys = dict.fromkeys(key for each in rows for key in each)
        having = {key: [each[key] for each in rows if key in each] for key in keys}
        return {key: sum(values) / len(values) for key, values in having.items()}

    def gather(self, state: dict) -> list[dict]:
        """The states of all ranks, by rank, on the first one; the others get an empty list."""
        if self.size == 1:
            return [state]
        states: list[dict] = [{}] * self.size
        dist.gather_object(state, states if self.is_first else None)
        return states if self.is_first else []
