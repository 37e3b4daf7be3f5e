"""Continuing a run: where it is, under which config it goes on, and what must not change."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from hdmi.config import ConfigError, run_container
from hdmi.learning.checkpoint import (
    BEST_FILE,
    POLICY_FILE,
    CheckpointError,
    checkpoints,
    find_checkpoint,
    load_checkpoint,
)

CONFIG_FILE = "config.yaml"
# Of the call, not of the run.
_OF_THE_CALL = ("resume", "resume_anyway", "overrides")
# What a continued run has from its checkpoint or its place, whatever the command line says.
KEPT = {
    "seed": "random numbers and worlds continue from the checkpoint",
    "algo.init_noise": "the noise is what the policy has learned",
    "run_name": "a continued run stays in its folder",
    "output_dir": "a continued run stays in its folder",
}
# What decides the problem, besides the nodes of the stack, and the networks' form.
_PROBLEM = ("stack", "starts", "task", "robot", "sim", "reference_set", "num_envs")
_NETWORKS = ("trainer", "actor_hidden", "critic_hidden", "activation")

# Arguments of a training that say where it runs and what it leaves, not what it learns.
_PLACE = (
    "output_dir=", "run_name=", "resume=", "num_threads=", "keep_checkpoints=", "checkpoint_interval=", "video=",
    "logger=", "eval_interval=", "eval_envs=",
)  # fmt: skip

_Path = tuple[str, ...]


def of_training(arguments: Iterable[str]) -> list[str]:
    """The arguments of a training that decide what it learns.

    Examples:
        >>> of_training(["task=walk", "video=false", "output_dir=runs/walks", "seed=1"])
        ['task=walk', 'seed=1']
    """
    return [text for text in arguments if not text.startswith(_PLACE)]


class _Absent:
    def __repr__(self) -> str:
        return "(absent)"


ABSENT = _Absent()


def find_run(path: str | Path) -> tuple[Path, Path]:
    """The folder of a run to continue, and the checkpoint to continue from.

    Args:
        path: the run folder or its folder `checkpoints` (the newest checkpoint counts), or a checkpoint file there.

    Raises:
        CheckpointError: if there is no checkpoint, or it is not in a run folder, or it is an exported policy.
    """
    checkpoint = find_checkpoint(path).resolve()
    if checkpoint.name == POLICY_FILE:
        raise CheckpointError(
            f"resume: {checkpoint} is an exported policy, without critic and optimizers; it cannot be continued"
        )
    folder = checkpoint.parent.parent
    if checkpoint.name == BEST_FILE:
        raise CheckpointError(
            f"resume: {checkpoint} holds networks, but no worlds to continue; resume={folder} goes on from the newest "
            "checkpoint, warm_start= begins a run from these networks"
        )
    if (
        checkpoint.parent.name != "checkpoints"
        or not (folder / CONFIG_FILE).is_file()
        or checkpoint not in checkpoints(checkpoint.parent)
    ):
        raise CheckpointError(
            f"resume: {checkpoint} is not in a run folder, where it would be checkpoints/checkpoint_<iteration>.pt "
            f"beside {CONFIG_FILE}"
        )
    return folder, checkpoint


def with_own_arguments(arguments: Sequence[str]) -> list[str]:
    """A command line that continues a run, with what the run was made with before what is typed.

    Hydra composes a config before anything of a run is known, and refuses nodes that the default task does not have.
    Where nothing is continued, or it cannot be found, the command line is as it was.
    """
    options = [text for text in arguments if text.startswith("-")]
    parser = OverridesParser.create()
    try:
        typed = parser.parse_overrides([text for text in arguments if text not in options])
        resume = [override.value() for override in typed if override.key_or_group == "resume"]
        if not resume or not isinstance(resume[-1], str):
            return list(arguments)
        own = load_checkpoint(find_run(resume[-1])[1])["config"].get("overrides")
        before = parser.parse_overrides(list(own or ()))
    except (CheckpointError, HydraException):
        return list(arguments)
    return options + _merged(before, typed)


def continued_config(
    run: Mapping[str, Any], typed: Sequence[str], compose: Callable[[list[str]], DictConfig]
) -> DictConfig:
    """The config under which a run goes on: its own, changed by what the command line adds.

    Groups are compared as they are composed now, with and without what was typed; only what that changes is taken
    over. Keys that the run's config does not have get the present default, but no transform is added that way.

    Args:
        run: the run's config, without interpolations.
        typed: overrides of the command line, such as `total_frames=1000` or `+ablation=no_rsi`.
        compose: from overrides to a config.

    Raises:
        ConfigError: if the overrides do not fit the run's config.
    """
    overrides = list(run.get("overrides") or ())
    parser = OverridesParser.create()
    given = parser.parse_overrides(list(typed))
    added = [override for override in given if override.key_or_group not in {*_OF_THE_CALL, *KEPT}]
    try:
        before = run_container(compose(overrides))
    except (HydraException, OmegaConfBaseException):  # the config has changed since
        overrides = [f"task={run['task']['name']}"]
        before = run_container(compose(overrides))
    merged = _merged(parser.parse_overrides(overrides), added)
    try:
        after = run_container(compose(merged))
    except (HydraException, OmegaConfBaseException) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"resume: {reason} (the run was made with {' '.join(overrides) or 'no options'})") from error
    config = _filled(copy.deepcopy(dict(run)), before)
    old, new = dict(_leaves(before)), dict(_leaves(after))
    values = [tuple(override.key_or_group.split(".")) for override in added if not _is_group(override)]
    for path in old.keys() - new.keys():
        _remove(config, path)
    for path, value in new.items():
        if old.get(path, ABSENT) != value or any(path[: len(v)] == v or v[: len(path)] == path for v in values):
            _set(config, path, value)
    for key in KEPT:  # groups may have changed them
        if (value := OmegaConf.select(OmegaConf.create(dict(run)), key, default=ABSENT)) is not ABSENT:
            _set(config, tuple(key.split(".")), value)
    config["overrides"] = _merged(parser.parse_overrides(list(run.get("overrides") or ())), added)
    made = OmegaConf.create(config)
    assert isinstance(made, DictConfig)
    return made


def _merged(before: Sequence[Override], added: Sequence[Override]) -> list[str]:
    """Overrides in which later ones replace earlier ones of the same key."""
    new = {override.key_or_group for override in added}
    kept = [override for override in before if override.key_or_group not in new]
    return [str(override.input_line) for override in (*kept, *added)]


def _is_group(override: Override) -> bool:
    return bool(GlobalHydra.instance().config_loader().get_group_options(override.key_or_group))


def _entries(*configs: Mapping[str, Any]) -> list[str]:
    """What the stacks of configs list, by name."""
    return sorted({entry for config in configs for entry in config.get("stack") or ()})


def _filled(config: dict[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """The config with what it lacks, down to the parameters of a group; what is deeper belongs together.

    A node that would make another experiment of a run that did not have it stays out.
    """
    groups = {entry.split(".")[0] for entry in _entries(config)}
    for key, default in defaults.items():
        if key in _PROBLEM and key not in config:
            continue
        value = config.setdefault(key, default)
        if key in groups or not (isinstance(value, dict) and isinstance(default, dict)):
            continue
        if value.get("_target_") == default.get("_target_"):
            config[key] = value | {name: item for name, item in default.items() if name not in value}
    return config


def _leaves(node: Any, path: _Path = ()) -> Iterator[tuple[_Path, Any]]:
    if isinstance(node, dict) and node:
        for key, value in node.items():
            yield from _leaves(value, (*path, str(key)))
    else:
        yield path, node


def _remove(config: dict[str, Any], path: _Path) -> None:
    for key in path[:-1]:
        config = config.get(key) or {}
    config.pop(path[-1], None)


def _set(config: dict[str, Any], path: _Path, value: Any) -> None:
    for key in path[:-1]:
        if not isinstance(config.get(key), dict):
            config[key] = {}
        config = config[key]
    config[path[-1]] = value


def differences(old: Any, new: Any, path: _Path = ()) -> dict[str, tuple[Any, Any]]:
    """What two configs differ in: path -> values before and after, `ABSENT` where there is none."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        out: dict[str, tuple[Any, Any]] = {}
        for key in dict.fromkeys([*old, *new]):
            if path or key not in _OF_THE_CALL:
                out |= differences(old.get(key, ABSENT), new.get(key, ABSENT), (*path, str(key)))
        return out
    return {} if old == new else {".".join(path): (old, new)}


def problem_changes(run: Mapping[str, Any], config: Mapping[str, Any]) -> list[str]:
    """Nodes that make of a run another experiment, or whose state a checkpoint cannot be of.

    Args:
        run, config: before and after, without interpolations. A transform that is null is one that is not there; a
            parameter that `run` did not know yet is none that has changed.
    """
    nodes: list[str] = []
    for key in _PROBLEM:
        old, new = run.get(key), config.get(key)
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            new = {name: value for name, value in new.items() if name in old}
        nodes += [".".join(path.split(".")[:2]) for path in differences(old, new, (key,))]
    for entry in _entries(run, config):
        path = tuple(entry.split("."))
        old, new = (_without_nulls(_at(values, path)) for values in (run, config))
        depth = len(path) + ("_target_" not in {*old, *new})
        nodes += [".".join(changed.split(".")[:depth]) for changed in differences(old, new, path)]
    algo, other = run["algo"], config["algo"]
    nodes += [f"algo.{name}" for name in _NETWORKS if name in algo and algo[name] != other.get(name)]
    if run["collector"].get("num_workers") != config["collector"].get("num_workers"):
        nodes.append("collector")
    return list(dict.fromkeys(nodes))


def _at(config: Any, path: _Path) -> Any:
    for key in path:
        config = (config or {}).get(key)
    return config


def _without_nulls(node: Any) -> Any:
    if not isinstance(node, Mapping):
        return node if node is not None else {}
    return {key: _without_nulls(value) for key, value in node.items() if value is not None}
