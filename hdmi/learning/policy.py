"""Policies from checkpoints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torchrl.modules import ProbabilisticActor, ValueOperator

from hdmi.learning.checkpoint import CheckpointError, find_checkpoint, load_checkpoint, save_checkpoint
from hdmi.learning.networks import make_actor, make_critic, use_bf16

_PLACE = ("output_dir", "run_name", "resume")  # where a training ran


def make_networks(
    cfg: DictConfig, sizes: dict[str, int], device: torch.device
) -> tuple[ProbabilisticActor, ValueOperator]:
    """Actor and critic of a config. sizes: of `policy`, `critic` and `action`, and of `state_value` if not one."""
    algo = cfg.algo
    actor = make_actor_of(cfg, sizes["policy"], sizes["action"], device)
    bf16, values = use_bf16(algo.bf16, device), sizes.get("state_value", 1)
    critic = make_critic(sizes["critic"], algo.critic_hidden, algo.activation, bf16, values)
    return actor, critic.to(device)


def make_actor_of(
    cfg: DictConfig, in_size: int, out_size: int, device: torch.device, in_key: str = "policy"
) -> ProbabilisticActor:
    """An actor of a config from an observation [..., in_size]."""
    algo = cfg.algo
    bf16 = use_bf16(algo.bf16, device)
    return make_actor(in_size, out_size, algo.actor_hidden, algo.activation, algo.init_noise, bf16, in_key).to(device)


def load_config(path: str | Path) -> DictConfig:
    """The config that a checkpoint was trained with.

    Raises:
        CheckpointError: if the checkpoint cannot be read.
    """
    cfg = OmegaConf.create(load_checkpoint(path)["config"])
    assert isinstance(cfg, DictConfig)
    return cfg


def load_policy(
    path: str | Path, device: str | torch.device = "cpu"
) -> tuple[ProbabilisticActor, DictConfig, dict[str, Any]]:
    """Reads a policy.

    Returns:
        The actor (`policy` -> `action`), its config, and the checkpoint's counters: iteration, frames.

    Raises:
        CheckpointError: if the checkpoint cannot be read or does not fit its own config.
    """
    device = torch.device(device)
    file = find_checkpoint(path)
    state = load_checkpoint(file, device)
    cfg = OmegaConf.create(state["config"])
    assert isinstance(cfg, DictConfig)
    actor, _ = make_networks(cfg, state["sizes"], device)
    try:
        actor.load_state_dict(state["actor"])
    except RuntimeError as error:
        raise CheckpointError(f"{file}: the actor does not fit its config: {error}") from error
    return actor.eval(), cfg, {"iteration": state["iteration"], "frames": state["frames"], "file": str(file)}


def export_policy(source: str | Path, path: str | Path) -> Path:
    """Writes the policy of a checkpoint alone: weights, normalization, config and counters, for `load_policy`.

    The config is without `output_dir`, `run_name` and `resume`, and so are the arguments that it was made with: where a
    training ran is nobody else's business.

    Args:
        source: a run folder (its newest checkpoint counts) or a checkpoint file.

    Raises:
        CheckpointError: if the checkpoint cannot be read.
        OSError: if the file cannot be written.
    """
    state = load_checkpoint(source)
    kept = ("config", "task", "motion", "sizes", "inputs", "iteration", "frames", "elapsed", "actor")
    policy = {key: state[key] for key in kept if key in state}
    config = {key: value for key, value in state["config"].items() if key not in _PLACE}
    if "overrides" in config:
        config["overrides"] = [text for text in config["overrides"] if text.partition("=")[0] not in _PLACE]
    save_checkpoint(Path(path), {**policy, "config": config})
    return Path(path)
