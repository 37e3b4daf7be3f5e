"""Configs: the folder of configs, the tasks in it, and nodes with a `_target_` made into objects."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import fields
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.plugins import Plugins
from hydra.errors import HydraException, MissingConfigException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from hdmi.errors import ConfigError as ConfigError

# beside the package in a checkout, in the package when it is installed
CONF = next(path for path in (Path(__file__).parent / "conf", Path(__file__).parents[1] / "conf") if path.is_dir())


_ENTRY_POINTS = "hdmi.configs"  # by which packages name their config folders


def build(node: Any, where: str, **context: Any) -> Any:
    """Calls a config node `{_target_: class or function, parameter: value, ...}`; lists become tuples.

    Args:
        context: values for parameters of the target that the node does not give.

    Raises:
        ConfigError: for an unknown target or parameter, or values that the target refuses; names the node.
    """
    try:
        values: dict[str, Any] = plain_container(node) if OmegaConf.is_config(node) else dict(node)
    except OmegaConfBaseException as error:
        raise ConfigError(f"{where}: {one_line(error)}") from error
    path = values.pop("_target_", None)
    if path is None:
        raise ConfigError(f"{where}: has no _target_")
    try:
        cls: Any = get_object(path)
    except Exception as error:
        raise ConfigError(f"{where}: _target_ {path!r}: {error}") from error
    if not callable(cls):
        raise ConfigError(f"{where}: _target_ {path!r}: a class or function expected, got {type(cls).__name__}")
    kwargs = {key: _plain(value, f"{where}.{key}") for key, value in values.items()}
    parameters = inspect.signature(cls).parameters
    kwargs |= {key: value for key, value in context.items() if key in parameters and key not in kwargs}
    if not any(p.kind is p.VAR_KEYWORD for p in parameters.values()) and (unknown := set(kwargs) - set(parameters)):
        raise ConfigError(f"{where}: {cls.__name__} has no {sorted(unknown)}; it takes {sorted(parameters)}")
    try:
        return cls(**kwargs)
    except ConfigError:  # of a node of its own
        raise
    except (TypeError, ValueError, KeyError) as error:
        raise ConfigError(f"{where} ({cls.__name__}): {error}") from error


def _plain(value: Any, where: str) -> Any:
    if isinstance(value, dict):
        if "_target_" in value:
            return build(value, where)
        return {key: _plain(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, list):
        return tuple(_plain(item, f"{where}[{i}]") for i, item in enumerate(value))
    return value


def plain_container(node: Any) -> dict[str, Any]:
    """A config node as plain values, interpolations resolved."""
    values: Any = OmegaConf.to_container(node, resolve=True)
    return values


def run_container(cfg: DictConfig) -> dict[str, Any]:
    """A run's config as plain values, interpolations resolved, but `motion_root` and the arguments as typed.

    `motion_root='${oc.env:HDMI_MOTIONS}'` stays so in what leaves the machine, and is looked up where it is used.

    Examples:
        >>> cfg = OmegaConf.create({"seed": 1, "device": "${seed}", "motion_root": "${oc.env:HOME}"})
        >>> run_container(cfg)
        {'seed': 1, 'device': 1, 'motion_root': '${oc.env:HOME}'}
    """
    typed: Any = OmegaConf.to_container(cfg, resolve=False)
    return plain_container(cfg) | {key: typed[key] for key in ("motion_root", "overrides") if key in typed}


def build_dataclass(cls: type, node: Any, where: str) -> Any:
    """A dataclass from a config node, or from a mapping, of its fields.

    Raises:
        ConfigError: for a field that it lacks, or values that it refuses; names the node.
    """
    values = plain_container(node) if OmegaConf.is_config(node) else node
    names = {f.name for f in fields(cls)}
    if unknown := set(values) - names:
        raise ConfigError(f"{where}: unknown {sorted(map(str, unknown))}; there is {sorted(names)}")
    try:
        return cls(**values)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{where}: {error}") from error


def task_node(cfg: DictConfig, where: str) -> Any:
    """A node of the config that each task has.

    Raises:
        ConfigError: if this one lacks it.
    """
    node = cfg
    for key in where.split("."):
        if node is None or key not in node:
            nested = "task" in cfg and cfg.task is not None and "task" in cfg.task
            hint = "; the file's first line has to be `# @package _global_`" if nested else ""
            raise ConfigError(f"{where}: missing{hint}")
        try:
            node = node[key]
        except OmegaConfBaseException as error:
            raise ConfigError(f"{where}: {one_line(error)}") from error
    return node


def one_line(error: Exception) -> str:
    """The message of an error on one line."""
    return " ".join(str(error).split())


def composition_fault(error: Exception) -> str:
    """What keeps Hydra from composing a config, on one line: with the names that there are, without the search path."""
    said = " ".join(str(error).split("\n\n")[0].split())
    if isinstance(error, MissingConfigException) and error.options:
        said = f"{said}; there is {', '.join(error.options)}"
    if isinstance(error.__cause__, OmegaConfBaseException):
        reason = str(error.__cause__).splitlines()[0]
        said = f"{said}: {reason}" if said else reason
    return said


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


def installed_configs() -> dict[Path, str]:
    """Config folders of installed packages, with the name of the package of each.

    A package names a folder with an entry point of the group `hdmi.configs`, such as `tasks = "my_package.conf"`.

    Raises:
        ConfigError: if there is no such folder, or it has a config that conf or another package has; names the package.
    """
    found: dict[Path, str] = {}
    for entry in entry_points(group=_ENTRY_POINTS):
        package = entry.dist.name if entry.dist is not None else entry.name
        where = f"package {package}: its entry point {entry.name!r} of {_ENTRY_POINTS} names {entry.value}, which"
        try:
            spec = find_spec(entry.value)
        except Exception as error:  # whatever the package's own code raises
            raise ConfigError(f"{where} cannot be imported: {type(error).__name__}: {one_line(error)}") from error
        folders = [] if spec is None else [Path(path) for path in spec.submodule_search_locations or ()]
        if not folders or not folders[0].is_dir():
            raise ConfigError(f"{where} is no package with a folder")
        found[folders[0]] = package
    if found:
        _refuse_twins(found)
    return found


def _refuse_twins(folders: Mapping[Path, str]) -> None:
    """Raises ConfigError for a config that conf, or a package before it, has as well: Hydra would take that one."""
    taken = {path.relative_to(CONF): path for path in CONF.rglob("*.yaml")}
    for folder, package in folders.items():
        for path in sorted(folder.rglob("*.yaml")):
            name = path.relative_to(folder)
            if name in taken:
                raise ConfigError(f"package {package}: {path}: there is {taken[name]} already; give it another name")
            taken[name] = path


class _InstalledConfigs(SearchPathPlugin):
    """Config folders of installed packages on Hydra's search path."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for folder, package in installed_configs().items():
            search_path.append(package, f"file://{folder}")


def use_installed_configs() -> None:
    """Puts config folders of installed packages on the search path of whatever Hydra composes from now on."""
    installed_configs()  # what is wrong with one is said here, and not from inside of Hydra
    plugins = Plugins.instance()
    if _InstalledConfigs not in plugins.discover(SearchPathPlugin):
        plugins.register(_InstalledConfigs)


def task_files(config_dir: str | Path | None = None) -> dict[str, Path]:
    """The tasks of conf/task, of installed packages, and of `config_dir`/task, by name.

    Raises:
        ConfigError: if there is no such folder, or two have a task of one name.
    """
    found = {path.stem: path for folder in (CONF, *installed_configs()) for path in (folder / "task").glob("*.yaml")}
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
    use_installed_configs()
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
        raise ConfigError(f"{files[task]}: {composition_fault(error)}") from error
    cfg.motion_root = motion_root
    return cfg
