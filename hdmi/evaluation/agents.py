"""Agents that need no training, to see what a task is without a policy."""

from __future__ import annotations

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase

from hdmi.assembly import Task, make_env
from hdmi.config import ConfigError

AGENTS = ("zero", "random")


class BlindAgent(torch.nn.Module):
    """Looks at nothing and writes `action` [N, A]: zeros, or uniform in [-1, 1].

    Args:
        kind: one of `AGENTS`.
        action_size: A.

    Raises:
        ConfigError: if there is no such agent.
    """

    def __init__(self, kind: str, action_size: int):
        super().__init__()
        if kind not in AGENTS:
            raise ConfigError(f"agent: there is no {kind!r}; there is {', '.join(AGENTS)}")
        self.half_range = float(kind == "random")
        self.action_size = action_size

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = torch.empty(*tensordict.batch_size, self.action_size, device=tensordict.device)
        return tensordict.set("action", action.uniform_(-self.half_range, self.half_range))


def blind_agent(kind: str, cfg: DictConfig, task: Task) -> BlindAgent:
    """A `BlindAgent` for the environment of a config, whose actions are as wide as the environment's.

    Raises:
        ConfigError: if there is no such agent, or the environment cannot be built.
    """
    env = make_env(cfg, 1, task)
    size = env.action_spec.shape[-1]
    env.close()
    return BlindAgent(kind, size)
