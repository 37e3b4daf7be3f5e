"""The evaluation protocol of the paper: first episodes from the first frame over the whole motion, deterministic.

A metric is averaged over the steps that an environment survives, so that a policy that falls at once may have the
smallest errors. Each error is therefore there a second time, `<name>_horizon`, averaged over all steps of the motion:
the world goes on after the termination, the robot lying where it fell.
"""

from __future__ import annotations

import copy
import inspect
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, open_dict
from rich.table import Table
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import ExplorationType, TransformedEnv, set_exploration_type

from hdmi.assembly import Task, make_env, make_task
from hdmi.config import ConfigError, choose_engine, task_config, task_files
from hdmi.learning.checkpoint import POLICY_FILE, CheckpointError, find_checkpoint
from hdmi.learning.policy import load_config, load_policy
from hdmi.transforms import ReferenceStateInitialization

Policy = Callable[[TensorDictBase], TensorDictBase]

# Metrics that every eval.json names, null where the task has nothing to measure.
METRICS = (
    "joint_error",
    "body_error",
    "root_pos_error",
    "root_ori_error",
    "object_pos_error",
    "object_ori_error",
)
UNITS = {
    "success_rate": "%",
    "survival": "%",
    "contact_rate": "%",
    "joint_error": "rad",
    "body_error": "m",
    "root_pos_error": "m",
    "root_ori_error": "rad",
    "object_pos_error": "m",
    "object_ori_error": "rad",
    "object_joint_error": "rad",
}
EVAL_FILE = "eval.json"  # in a run folder, or beside an exported policy
HORIZON = "_horizon"  # of errors over the whole motion, survived or not
_MADE, _INTENDED = "contact_made", "contact_intended"
_DIVERGED, _OTHER = "diverged", "other"


def unit_of(figure: str) -> str:
    """Unit of a figure, empty if it has none."""
    return UNITS.get(figure.removesuffix(HORIZON), "")


def evaluation_config(
    cfg: DictConfig,
    terminations: Sequence[str] | None = None,
    start: int = 0,
    without: Sequence[str] = (),
    early_end: bool = False,
) -> DictConfig:
    """The training config changed to the protocol; reset noise, randomization and observation noise stay, aids go.

    Args:
        terminations: names of the terminations that end episodes; None for those of the training.
        start: frame of the reference that episodes start from.
        without: names of terminations that do not, whatever `terminations` says. The task must have them; a training
            may have gone without.
        early_end: let what ended episodes early in the training end them here, too, as terminations.

    Raises:
        ConfigError: for a termination that the config does not have, or early ends that it does not have.
    """
    cfg = copy.deepcopy(cfg)
    with open_dict(cfg):
        node = (cfg.reset or {}).get("state") or {}
        cls = ReferenceStateInitialization
        kept = {key: value for key, value in node.items() if key in inspect.signature(cls).parameters}
        state = kept | {"start": start, "first_share": 0.0, "_target_": f"{cls.__module__}.{cls.__qualname__}"}
        cfg.reset = {"state": state}
        if early_end:
            if not has_early_end(cfg):
                raise ConfigError("early_end: the policy was trained without early ends")
            cfg.termination = {**(cfg.termination or {}), **cfg.early_end}
        cfg.early_end, cfg.assist = {}, {}
        known = termination_names(cfg)
        if unknown := [name for name in terminations or () if name not in known]:
            raise ConfigError(f"terminations: the config has no {unknown}; there is {known}")
        if unknown := [name for name in without if name not in known and name not in _terminations_of_task(cfg)]:
            raise ConfigError(f"without: the task has no {unknown}; there is {known}")
        for name in known:
            if name in without or (terminations is not None and name not in terminations):
                cfg.termination[name] = None
    return cfg


def has_early_end(cfg: DictConfig) -> bool:
    """Whether episodes of a training ended earlier than by its terminations."""
    return any(node is not None for node in (cfg.get("early_end") or {}).values())


def task_starts_config(cfg: DictConfig) -> DictConfig:
    """A training config with the reset noise of its task, whatever the training had.

    Raises:
        ConfigError: if conf/task has no such task.
    """
    cfg = copy.deepcopy(cfg)
    with open_dict(cfg):
        cfg.reset = {**(cfg.reset or {}), "state": task_config(cfg.task.name).reset.state}
    return cfg


def conditions(cfg: DictConfig) -> dict[str, dict[str, Any]]:
    """What a policy of a config is judged by: name -> arguments of `evaluate_checkpoint`.

    `training` is always there, its terminations and starts; `early_end` where episodes ended earlier in the training,
    `task_starts` where they started elsewhere than the task's.
    """
    found: dict[str, dict[str, Any]] = {"training": {}}
    if has_early_end(cfg):
        found["early_end"] = {"early_end": True}
    noise = ((cfg.reset or {}).get("state") or {}).get("noise")
    if cfg.task.name in task_files() and noise != task_config(cfg.task.name).reset.state.noise:
        found["task_starts"] = {"task_starts": True}
    return found


def termination_names(cfg: DictConfig) -> list[str]:
    """Nodes of a config that end episodes as failures."""
    return [str(name) for name, node in (cfg.termination or {}).items() if node is not None]


def _terminations_of_task(cfg: DictConfig) -> list[str]:
    """Those of a config's task without ablations; none for a task that conf/task does not have."""
    return termination_names(task_config(cfg.task.name)) if cfg.task.name in task_files() else []


def make_evaluation_env(cfg: DictConfig, task: Task, num_envs: int) -> TransformedEnv:
    """The environment of an `evaluation_config`; no step limit below the motion's length."""
    step_count = (cfg.horizon or {}).get("step_count")
    if step_count is not None:
        cfg = copy.deepcopy(cfg)
        frames = task.reference.num_frames
        cfg.horizon.step_count.max_steps = max(step_count.get("max_steps") or frames, frames)
    return make_env(cfg, num_envs, task)


class EvalResult(Mapping[str, Any]):
    """What eval.json holds, as a mapping.

    Figures are `{"mean", "std"}` over environments, or None where nothing could be measured.

    Examples:
        >>> result = EvalResult({"task": "walk", "success": {"mean": 0.75, "std": 0.43}})
        >>> result.save("eval.json")
        >>> EvalResult.load("eval.json").figures()["success"]["mean"]
        0.75
    """

    def __init__(self, values: Mapping[str, Any], path: Path | None = None):
        self._values = dict(values)
        self.path = path  # where it was written

    def __getitem__(self, key: str) -> Any:
        return self._values[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __repr__(self) -> str:
        return f"EvalResult({self._values})"

    @classmethod
    def load(cls, path: str | Path) -> EvalResult:
        """Reads an eval.json."""
        return cls(json.loads(Path(path).read_text(encoding="utf-8")), Path(path))

    def save(self, path: str | Path) -> None:
        """Writes an eval.json; a crash or a full disk leaves what was there before."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial")
        try:
            partial.write_text(json.dumps(self._values, indent=2, allow_nan=False) + "\n", encoding="utf-8")
            os.replace(partial, path)
        except OSError:
            partial.unlink(missing_ok=True)
            raise
        self.path = path

    def figures(self) -> dict[str, dict[str, float]]:
        """The entries that have a mean and a standard deviation."""
        return {key: value for key, value in self.items() if isinstance(value, dict) and "mean" in value}

    def table(self) -> Table:
        """The figures with units, and why episodes failed."""
        title = f"{self['task']}: {self['num_envs']} episodes of {self['motion_frames'] - 1} steps"
        table = Table(title=title, title_justify="left")
        table.add_column("metric")
        for column in ("mean", "std"):
            table.add_column(column, justify="right")
        table.add_column("unit")
        for name, value in self.figures().items():
            unit = unit_of(name)
            shown = (
                f"{value[key] * 100:.1f}" if unit == "%" else f"{value[key]:.3g}" for key in ("mean", "std")
            )  # fmt: skip
            table.add_row(name, *shown, unit)
        table.add_section()
        for name, share in self["termination_causes"].items():
            frame = self["failure_frames"][name]
            when = "" if frame is None else f", median frame {frame:g}"
            table.add_row(f"failed by {name}", f"{share * 100:.1f}", "", f"%{when}")
        return table


class FirstEpisodes:
    """Accumulates the figures of the first episode of every environment.

    An environment counts up to and including the step that terminates it; a step whose physics diverged has no state
    of its own and only ends the episode. Errors over the whole motion go on after the end, up to a divergence: from
    there on the last ones count.

    Args:
        num_envs: environments.
        horizon: steps of a full episode.
        causes: termination names, the first has precedence.
        whole_motion: whether errors over the whole motion are wanted; all its steps must then be added.
        excused: names of terminations that end no episode here, whatever the environment says.
    """

    def __init__(
        self,
        num_envs: int,
        horizon: int,
        causes: Sequence[str] = (),
        whole_motion: bool = True,
        excused: Sequence[str] = (),
    ):
        self.horizon, self.whole_motion = horizon, whole_motion
        self.excused = tuple(excused)
        self.causes = (_DIVERGED, *causes, _OTHER)
        self.alive = torch.ones(num_envs, dtype=torch.bool)
        self.survived = torch.zeros(num_envs, dtype=torch.int64)  # steps without termination
        self.steps = 0
        self._counted = torch.zeros(num_envs, dtype=torch.int64)
        self._sums: dict[str, Tensor] = {}
        self._sound = torch.ones(num_envs, dtype=torch.bool)  # never diverged
        self._last: dict[str, Tensor] = {}  # metrics of the last step that did not diverge
        self._horizon_sums: dict[str, Tensor] = {}
        self._ended = {cause: torch.zeros(num_envs, dtype=torch.bool) for cause in self.causes}

    def add(self, after: TensorDictBase) -> None:
        """Takes the `next` of a step of all environments, without resets in between. [N]"""
        self.steps += 1
        terminated = after["terminated"].reshape(-1).cpu()
        flags = after.get("termination", None)

        def fired_by(cause: str) -> Tensor:
            return _flag(None if flags is None else flags.get(cause, None), terminated)

        if self.excused:  # what they ended is ended by another cause, or not at all
            excused = torch.stack([fired_by(cause) for cause in self.excused]).any(0)
            others = [fired_by(cause) for cause in self.causes if cause not in (_DIVERGED, _OTHER)]
            terminated = terminated & (torch.stack([~excused, *others]).any(0))
        diverged = _flag(after.get("diverged", None), terminated)
        measured = self.alive & ~diverged
        self._sound &= ~diverged
        metrics = after.get("metrics", None)
        for name, value in () if metrics is None else metrics.items():
            value = value.reshape(-1).double().cpu()
            total = self._sums.setdefault(name, torch.zeros_like(value))
            total += torch.where(measured, value, 0)
            if self.whole_motion and name.endswith("_error"):
                self._last[name] = torch.where(self._sound, value, self._last.get(name, torch.nan))
                self._horizon_sums[name] = self._horizon_sums.get(name, 0) + self._last[name]
        self._counted += measured

        unexplained = self.alive & (terminated | diverged)
        self.alive &= ~unexplained
        self.survived += self.alive
        for cause in self.causes:
            if cause == _DIVERGED:
                fired = diverged
            elif cause == _OTHER:
                fired = unexplained
            else:
                fired = fired_by(cause)
            self._ended[cause] |= unexplained & fired
            unexplained = unexplained & ~fired

    @property
    def success(self) -> Tensor:
        """Environments that came through the whole horizon without termination. bool [N]"""
        return self.survived >= self.horizon

    def values(self) -> dict[str, Tensor]:
        """Figures of each environment, NaN where nothing could be measured. [N]"""
        out = {"success_rate": self.success.double(), "survival": self.survived.double() / self.horizon}
        out |= {name: total / self._counted for name, total in self._sums.items() if name not in (_MADE, _INTENDED)}
        if _MADE in self._sums:
            out["contact_rate"] = self._sums[_MADE] / self._sums[_INTENDED]
        return out | {f"{name}{HORIZON}": total / self.steps for name, total in self._horizon_sums.items()}

    def summary(self) -> dict[str, Any]:
        """Mean and standard deviation over environments, and why and when episodes failed."""
        values = self.values()
        names = ["success_rate", "survival", *METRICS, "contact_rate"]
        if self.whole_motion:
            names += [f"{name}{HORIZON}" for name in METRICS]
        names += [name for name in values if name not in names]
        names.sort(key=lambda name: name.endswith(HORIZON))
        ended = {cause: mask for cause, mask in self._ended.items() if cause != _OTHER or mask.any()}
        return {name: _statistic(values.get(name)) for name in names} | {
            "termination_causes": {cause: float(mask.double().mean()) for cause, mask in ended.items()},
            # the frame of the first step that was not survived
            "failure_frames": {
                cause: float(self.survived[mask].double().quantile(0.5)) + 1 if mask.any() else None
                for cause, mask in ended.items()
            },
        }


def _flag(value: Tensor | None, like: Tensor) -> Tensor:
    return torch.zeros_like(like) if value is None else value.reshape(-1).cpu()


def _statistic(values: Tensor | None) -> dict[str, float] | None:
    if values is None or not (finite := values[values.isfinite()]).numel():
        return None
    return {"mean": float(finite.mean()), "std": float(finite.std(correction=0))}


def on_device(actor: torch.nn.Module, device: torch.device | None) -> Policy:
    """A policy that acts on tensordicts of another device than its parameters'."""
    home = next((p.device for p in actor.parameters()), None)
    if home is None or home == device:
        return actor

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        out = actor(tensordict.select("policy").to(home))
        return tensordict.set("action", out["action"].to(device))

    return act


@torch.no_grad()
def run_episodes(env: TransformedEnv, policy: Policy, counts: Sequence[FirstEpisodes]) -> None:
    """Plays one episode in every environment, without resets in between.

    Args:
        counts: what accumulates its figures, all of one horizon. If one of them is of the whole motion, it is played
            to its end, otherwise until all episodes have ended.
    """
    tensordict = env.reset()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(counts[0].horizon):
            stepped = env.step(policy(tensordict))
            for episodes in counts:
                episodes.add(stepped["next"])
            if not any(episodes.whole_motion or episodes.alive.any() for episodes in counts):
                break
            tensordict = env.step_mdp(stepped)


def evaluate_policy(
    actor: torch.nn.Module,
    cfg: DictConfig,
    num_envs: int,
    task: Task | None = None,
    terminations: Sequence[str] | None = None,
    seed: int = 0,
    without: Sequence[str] = (),
    whole_motion: bool = True,
    early_end: bool = False,
) -> EvalResult:
    """Evaluates an actor under the conditions it was trained with.

    Episodes start at the first frame and run over the whole motion; the first of each environment counts. Actions are
    the policy's means. An episode succeeds if it reaches the last frame without termination or divergence.

    Args:
        actor: `policy` -> `action`.
        cfg: of the training.
        task: made from the config if absent.
        terminations: names of those that end episodes; None for those of the training, empty for none.
        seed: of start states, randomization and noise. The caller's random state is left alone.
        without: names of terminations that do not end episodes.
        whole_motion: measure errors over the whole motion, too; without, it ends with the last episode.
        early_end: let what ended episodes early in the training end them here, too.

    Raises:
        ConfigError: for a termination that the config does not have, or a config that cannot be built.
    """
    cfg = evaluation_config(cfg, terminations, without=without, early_end=early_end)
    return _evaluate(actor, cfg, num_envs, {"": ()}, task, seed, whole_motion)[""]


def evaluate_excused(
    actor: torch.nn.Module,
    cfg: DictConfig,
    num_envs: int,
    excused: Mapping[str, Sequence[str]],
    task: Task | None = None,
    seed: int = 0,
) -> dict[str, EvalResult]:
    """Evaluates an actor as `evaluate_policy`, several times over the same episodes, without terminations each time.

    Worlds go on after a failure, so that one run through the motion says what would have ended under each set of
    terminations.

    Args:
        actor, cfg, num_envs, task, seed: as of `evaluate_policy`.
        excused: name of a result -> terminations that end no episode of it; those that the config lacks count as such.

    Raises:
        ConfigError: for a config that cannot be built.
    """
    return _evaluate(actor, evaluation_config(cfg), num_envs, excused, task, seed, whole_motion=True)


def _evaluate(
    actor: torch.nn.Module,
    cfg: DictConfig,
    num_envs: int,
    excused: Mapping[str, Sequence[str]],
    task: Task | None,
    seed: int,
    whole_motion: bool,
) -> dict[str, EvalResult]:
    """Evaluates an actor under an `evaluation_config`, for each set of terminations that do not count."""
    task = make_task(cfg) if task is None else task
    causes = termination_names(cfg)
    horizon = task.reference.num_frames - 1
    counting = {name: [cause for cause in causes if cause not in out] for name, out in excused.items()}
    counts = {
        name: FirstEpisodes(num_envs, horizon, counting[name], whole_motion, excused=out)
        for name, out in excused.items()
    }
    was_training = actor.training
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        env = make_evaluation_env(cfg, task, num_envs)
        try:
            actor.eval()
            run_episodes(env, on_device(actor, env.device), list(counts.values()))
            env.base_env.backend.overflows()  # warns
        finally:
            actor.train(was_training)
            env.close()
    about = {
        "task": task.name,
        "motion": task.reference.name,
        "motion_frames": task.reference.num_frames,
        "num_envs": num_envs,
        "seed": seed,
    }
    return {
        name: EvalResult(episodes.summary() | about | {"terminations": counting[name]})
        for name, episodes in counts.items()
    }


def training_figures(actor: torch.nn.Module, cfg: DictConfig, task: Task) -> dict[str, float]:
    """Figures of a policy in the middle of its training, for the log: without what comes after a failure."""
    result = evaluate_policy(actor, cfg, cfg.eval_envs, task=task, whole_motion=False)
    return {f"eval/{name}": value["mean"] for name, value in result.figures().items()}


def evaluate_checkpoint(
    run_or_checkpoint: str | Path,
    num_envs: int = 256,
    terminations: Sequence[str] | None = None,
    seed: int = 0,
    out: str | Path | None = None,
    task: str | None = None,
    motion_root: str | None = None,
    num_threads: int | None = None,
    sim: str | None = None,
    without: Sequence[str] = (),
    early_end: bool = False,
    task_starts: bool = False,
) -> EvalResult:
    """Evaluates a checkpoint by `evaluate_policy` and writes eval.json, which its result then names as `path`.

    Args:
        run_or_checkpoint: a run folder (its newest checkpoint counts) or a checkpoint file.
        out: file to write; None for eval.json in the run folder, but for an exported policy none: its eval.json is the
            one that its card quotes.
        task: that the checkpoint must be of.
        motion_root, num_threads: instead of the training's.
        sim: engine (`cpu`, `gpu`) instead of the training's.
        without: names of terminations that do not end episodes.
        early_end: let what ended episodes early in the training end them here, too.
        task_starts: under the reset noise of the task instead of the training's.

    Raises:
        CheckpointError: if there is no usable checkpoint, or it is of another task.
        ConfigError, MotionError: if its environment cannot be built here.
        OSError: if the result cannot be written.
    """
    actor, cfg, info = load_checked_policy(run_or_checkpoint, task)
    if motion_root is not None:
        cfg.motion_root = motion_root
    if num_threads is not None:
        cfg.num_threads = num_threads
    if sim is not None:
        choose_engine(cfg, sim)
    if task_starts:
        cfg = task_starts_config(cfg)
    values = evaluate_policy(
        actor, cfg, num_envs, terminations=terminations, seed=seed, without=without, early_end=early_end
    )
    file = Path(info["file"])
    folder = run_folder_of(file)
    origin = {
        "checkpoint": str(file.relative_to(folder)),
        "iteration": info["iteration"],
        "frames": info["frames"],
    }
    result = EvalResult({**values, **origin})
    if out is None and file.name != POLICY_FILE:
        out = folder / EVAL_FILE
    if out is not None:
        result.save(out)
    return result


def evaluate_conditions(
    run_or_checkpoint: str | Path,
    num_envs: int = 256,
    seed: int = 0,
    num_threads: int | None = None,
    folder: str | Path | None = None,
) -> dict[str, EvalResult]:
    """Evaluates a checkpoint under each of its `conditions`, by name.

    Args:
        run_or_checkpoint, num_envs, seed, num_threads: as of `evaluate_checkpoint`.
        folder: to write the results to, each into its `evaluation_file`; None for none.

    Raises:
        CheckpointError, ConfigError, MotionError, OSError: as `evaluate_checkpoint`.
    """
    checkpoint = find_checkpoint(run_or_checkpoint)
    results = {}
    for name, arguments in conditions(load_config(checkpoint)).items():
        out = None if folder is None else Path(folder) / evaluation_file(name)
        results[name] = evaluate_checkpoint(
            checkpoint, num_envs, seed=seed, num_threads=num_threads, out=out, **arguments
        )
    return results


def evaluation_file(condition: str) -> str:
    """Name of the file that holds the evaluation under one of the `conditions`."""
    return EVAL_FILE if condition == "training" else f"eval_{condition}.json"


def load_checked_policy(
    path: str | Path, task: str | None = None
) -> tuple[torch.nn.Module, DictConfig, dict[str, Any]]:
    """`load_policy`, but only of the given task if there is one.

    Raises:
        CheckpointError: if there is no usable checkpoint, or it is of another task.
    """
    actor, cfg, info = load_policy(path)
    if task is not None and cfg.task.name != task:
        raise CheckpointError(f"{info['file']}: a policy of task {cfg.task.name!r}, not of {task!r}")
    return actor, cfg, info


def run_folder_of(checkpoint: Path) -> Path:
    """The run folder that a checkpoint file belongs to."""
    folder = checkpoint.parent
    return folder.parent if folder.name == "checkpoints" else folder
