"""Agents that need no training, to see what a task is without a policy."""

from __future__ import annotations

from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf import DictConfig, open_dict
from omegaconf.errors import OmegaConfBaseException
from tensordict import TensorDictBase
from yaml import YAMLError

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


def task_files(config_dir: str | Path | None = None) -> dict[str, Path]:
    """The tasks of conf/task, and of `config_dir`/task, by name.

    Raises:
        ConfigError: if there is no such folder, or both have a task of one name.
    """
    found = {path.stem: path for path in (CONF / "task").glob("*.yaml")}
    if config_dir is not None:
        if not (folder := Path(config_dir).expanduser()).is_dir():
            raise ConfigError(f"config_dir: no folder {folder}")
        own = {path.stem: path for path in (folder / "task").glob("*.yaml")}
        if twice := sorted(set(own) & set(found)):
            raise ConfigError(
                f"config_dir: {own[twice[0]]}: there is a task {twice[0]!r} already; give it another name"
            )
        found |= own
    return dict(sorted(found.items()))


def task_config(task: str, motion_root: str | None = None, config_dir: str | Path | None = None) -> DictConfig:
    """The default config with a task.

    Args:
        config_dir: folder with `task/NAME.yaml`, and other groups, of tasks that conf lacks, as Hydra's `--config-dir`.

    Raises:
        ConfigError: if there is no such task, or its file cannot be composed.
    """
    if task not in (files := task_files(config_dir)):
        hint = "; config_dir=FOLDER adds those of FOLDER/task" if config_dir is None else ""
        raise ConfigError(f"task: there is no {task!r}; there is {', '.join(files)}{hint}")
    overrides = [f"task={task}"]
    if config_dir is not None:
        path = str(Path(config_dir).expanduser().resolve())
        quoted = path.replace("\\", "\\\\").replace("'", "\\'")
        overrides.append(f"hydra.searchpath=['file://{quoted}']")
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            cfg = compose("config", overrides=overrides)
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        raise ConfigError(f"{files[task]}: {' '.join(str(error).split(chr(10) * 2)[0].split())}") from error
    cfg.motion_root = motion_root
    return cfg
