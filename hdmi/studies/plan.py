"""What a study is: variants of a training, on tasks and seeds, how each is judged, and which figures it makes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from hdmi.config import (
    CONF,
    ConfigError,
    build_dataclass,
    composition_fault,
    one_line,
    plain_container,
    task_files,
    use_installed_configs,
)

KINDS = ("bars", "summary", "curves", "poses", "starts")  # of figures
_FOLDER = "study"  # in conf


@dataclass(frozen=True)
class Variant:
    """One way to train.

    Args:
        name: of its run folders.
        label: in figures and tables.
        arguments: of `hdmi train`, beside the study's.
        reference: name of the variant whose policy is played and recorded, to train on that motion; none for the
            task's own motion.

    Examples:
        >>> Variant("no_rsi", arguments=("+ablation=no_rsi",)).label
        'no rsi'
    """

    name: str
    label: str = ""
    arguments: tuple[str, ...] = ()
    reference: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "arguments", _texts(self.arguments, f"variants.{self.name}.arguments"))
        object.__setattr__(self, "label", self.label or self.name.replace("_", " "))


@dataclass(frozen=True)
class Figure:
    """A figure of the report.

    Args:
        kind: one of `KINDS`. `bars`: a figure over tasks, a bar for each variant. `summary`: its interquartile mean
            over all tasks. `curves`: it over frames, a panel for each task. `poses`: pictures of all variants at the
            same frame. `starts`: the first second of untrained policies from one frame.
        of: name of a figure of evaluations, such as success_rate.
        without: terminations that do not count, as the study's; each is a row of its own.
        tasks: of the study's, all if empty.
        title: above it.

    Raises:
        ValueError: for another kind, or what is no list of texts.

    Examples:
        >>> Figure("pie")
        Traceback (most recent call last):
        ValueError: kind: expected one of bars, summary, curves, poses, starts, got 'pie'
    """

    kind: str
    of: str = "success_rate"
    without: tuple[str, ...] = ()
    tasks: tuple[str, ...] = ()
    title: str = ""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"kind: expected one of {', '.join(KINDS)}, got {self.kind!r}")
        object.__setattr__(self, "without", _texts(self.without, "without"))
        object.__setattr__(self, "tasks", _texts(self.tasks, "tasks"))


@dataclass(frozen=True)
class Study:
    """A question, and the trainings that answer it.

    Args:
        name: of its file.
        title, question: what it is about.
        variants: by name; the first is the one that others are compared with.
        tasks: names.
        seeds: how many, from 0 on.
        total_frames: of each training.
        points: evaluations of each training, evenly over its frames.
        num_envs: episodes of an evaluation.
        without: terminations that do not count in evaluations, `none` for all of them counting; the first is what
            tables show.
        arguments: of every training.
        figures: of the report.

    Raises:
        ValueError: for a count below 1, or without variants or tasks; names the field.

    Examples:
        >>> study = read_study("residual_action", tasks=["lift_box"], seeds=2)
        >>> len(study.jobs), study.jobs[0].name
        (8, 'lift_box/residual_seed0')
    """

    name: str
    title: str
    question: str
    variants: Mapping[str, Variant]
    tasks: tuple[str, ...]
    seeds: int = 3
    total_frames: int = 1_000_000
    points: int = 5
    num_envs: int = 128
    without: tuple[str, ...] = ("none",)
    arguments: tuple[str, ...] = ()
    figures: tuple[Figure, ...] = field(default=())

    def __post_init__(self) -> None:
        for key in ("tasks", "without", "arguments"):
            object.__setattr__(self, key, _texts(getattr(self, key), key))
        for key in ("seeds", "total_frames", "points", "num_envs"):
            value = getattr(self, key)
            if not isinstance(value, int) or value < 1:
                raise ValueError(f"{key}: expected a whole number from 1 on, got {value!r}")
        if not self.variants:
            raise ValueError("variants: none")
        if not self.tasks:
            raise ValueError("tasks: none")

    @property
    def jobs(self) -> list[Job]:
        """All trainings, a seed at a time, so that a study that is stopped has whole comparisons."""
        return [
            Job(self, variant, task, seed)
            for seed in range(self.seeds)
            for task in self.tasks
            for variant in self.variants.values()
        ]


@dataclass(frozen=True)
class Job:
    """One training of a study.

    Examples:
        >>> job = read_study("interaction_reward", seeds=1, total_frames=1000).jobs[1]
        >>> job.arguments[1:]
        ['+preset=laptop', '+ablation=no_interaction_reward', 'seed=0', 'total_frames=1000']
    """

    study: Study
    variant: Variant
    task: str
    seed: int

    @property
    def name(self) -> str:
        """Its folder below that of the runs."""
        return f"{self.task}/{self.variant.name}_seed{self.seed}"

    @property
    def arguments(self) -> list[str]:
        """What `hdmi train` is told, but for where it runs, and the recorded motion of a variant that has one."""
        study = self.study
        return [
            f"task={self.task}",
            *study.arguments,
            *self.variant.arguments,
            f"seed={self.seed}",
            f"total_frames={study.total_frames}",
        ]

    def config(self, extra: Sequence[str] = ()) -> DictConfig:
        """The config of this training.

        Raises:
            ConfigError: if its arguments cannot be composed; names the study's node.
        """
        use_installed_configs()
        try:
            with initialize_config_dir(str(CONF), version_base="1.3"):
                return compose("config", overrides=[*self.arguments, *extra])
        except (HydraException, OmegaConfBaseException, YAMLError) as error:
            raise ConfigError(
                f"study {self.study.name}: {self.variant.name} of {self.task}: {composition_fault(error)}"
            ) from error


def study_files() -> dict[str, Path]:
    """The studies of conf/study, by name."""
    return {path.stem: path for path in sorted((CONF / _FOLDER).glob("*.yaml"))}


def read_study(name: str, **changes: Any) -> Study:
    """A study of conf/study, or of a YAML file of that form.

    Args:
        name: of the study, or path of the file.
        changes: fields of `Study` that are to be others; None leaves what the file says.

    Raises:
        ConfigError: if there is no such study, task, variant or field, or values that it refuses; names file and node.
    """
    files = study_files()
    path = files.get(name, Path(name))
    if path.suffix != ".yaml" or not path.is_file():
        raise ConfigError(f"study: there is no {name!r}; there is {', '.join(files)}, or give a .yaml file")
    try:
        node = OmegaConf.load(path)
        values = plain_container(node) if OmegaConf.is_dict(node) else None
    except (OmegaConfBaseException, YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: {one_line(error)}") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: expected fields of a study: {', '.join(f.name for f in fields(Study))}")
    values |= {key: value for key, value in changes.items() if value is not None}
    variants, figures = values.pop("variants", None) or {}, values.pop("figures", None) or ()
    if not isinstance(variants, Mapping) or not all(isinstance(node, Mapping) for node in variants.values()):
        raise ConfigError(f"{path}: variants: expected fields by name, such as full: {{arguments: []}}")
    study: Study = build_dataclass(
        Study,
        {
            "name": path.stem,
            **values,
            "variants": {
                key: build_dataclass(Variant, {"name": key, **node}, f"{path}: variants.{key}")
                for key, node in variants.items()
            },
            "figures": tuple(build_dataclass(Figure, node, f"{path}: figures[{i}]") for i, node in enumerate(figures)),
        },
        str(path),
    )
    _check(study, path)
    return study


def _check(study: Study, path: Path) -> None:
    known = task_files()
    if unknown := [task for task in study.tasks if task not in known]:
        raise ConfigError(f"{path}: tasks: there is no {', '.join(unknown)}; there is {', '.join(known)}")
    for variant in study.variants.values():
        source = variant.reference
        if source is not None and (source not in study.variants or study.variants[source].reference is not None):
            raise ConfigError(
                f"{path}: variants.{variant.name}.reference: expected a variant that is trained on the task's own "
                f"motion, got {source!r}"
            )
    for i, figure in enumerate(study.figures):
        if unknown := [name for name in figure.without if name not in study.without]:
            raise ConfigError(
                f"{path}: figures[{i}].without: {', '.join(unknown)} is not among the study's, {list(study.without)}"
            )


def of_tasks(study: Study, figure: Figure) -> tuple[str, ...]:
    """The tasks of a figure that the study has."""
    return tuple(task for task in study.tasks if not figure.tasks or task in figure.tasks)


def subset(study: Study, variants: Sequence[str]) -> Study:
    """The study with some of its variants.

    Raises:
        ConfigError: for one that it does not have.
    """
    if unknown := [name for name in variants if name not in study.variants]:
        raise ConfigError(f"variants: {study.name} has no {', '.join(unknown)}; there is {', '.join(study.variants)}")
    return replace(study, variants={name: v for name, v in study.variants.items() if name in variants})


def _texts(values: Any, where: str) -> tuple[str, ...]:
    if isinstance(values, str) or not all(isinstance(value, str) for value in values):
        raise ValueError(f"{where}: expected a list of texts, got {values!r}")
    return tuple(values)
