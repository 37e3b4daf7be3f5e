"""Agents that need no training, to see what a task is without a policy."""

from __future__ import annotations

from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, open_dict
from tensordict import TensorDictBase

from hdmi.build import ConfigError, Task, make_env

CONF = Path(__file__).resolve().parents[2] / "conf"
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


def choose_engine(cfg: DictConfig, name: str) -> None:
    """Changes which engine computes the physics of a config, and nothing else about it.

    Args:
        name: of a config in conf/sim: `cpu` or `gpu`.

    Raises:
        ConfigError: if there is no such config.
    """
    there = sorted(path.stem for path in (CONF / "sim").glob("*.yaml"))
    if name not in there:
        raise ConfigError(f"sim: there is no {name!r}; there is {', '.join(there)}")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        sim = compose("config", overrides=[f"sim={name}"]).sim
    with open_dict(cfg):
        cfg.sim.device, cfg.sim.backend = sim.device, sim.backend


def task_names() -> list[str]:
    """The tasks of conf/task."""
    return sorted(path.stem for path in (CONF / "task").glob("*.yaml"))


def task_config(task: str, motion_root: str | None = None) -> DictConfig:
    """The default config with a task.

    Raises:
        ConfigError: if there is no such task.
    """
    if task not in (tasks := task_names()):
        raise ConfigError(f"task: there is no {task!r}; there is {', '.join(tasks)}")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("config", overrides=[f"task={task}"])
    cfg.motion_root = motion_root
    return cfg
