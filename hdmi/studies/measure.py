"""What a training of a study came to: its checkpoints, evaluated under the terminations of the task."""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, open_dict

from hdmi.assembly import make_task
from hdmi.config import ConfigError, task_config, task_files
from hdmi.evaluation.protocol import evaluate_excused, termination_names
from hdmi.learning.checkpoint import checkpoints, load_checkpoint, rotate
from hdmi.learning.policy import load_policy

POINTS_FILE = "points.json"  # in a run folder
NONE = "none"  # no termination is left out

Points = dict[int, dict[str, Any]]  # frames -> termination that is left out -> what an eval.json holds


def task_terminations_config(cfg: DictConfig) -> DictConfig:
    """A training config with the terminations of its task, whatever the training had: ablations may have dropped some.

    A task that conf/task does not have keeps those of the training.
    """
    cfg = copy.deepcopy(cfg)
    if cfg.task.name in task_files():
        with open_dict(cfg):
            cfg.termination = task_config(cfg.task.name).termination
    return cfg


def read_points(run: Path) -> Points:
    """The evaluations of a run, by the frames that it had trained.

    Raises:
        ConfigError: if the file is not one of these.
    """
    path = run / POINTS_FILE
    if not path.is_file():
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return {int(frames): dict(results) for frames, results in found.items()}
    except (ValueError, AttributeError, TypeError) as error:
        raise ConfigError(
            f"{path}: damaged ({error}); remove it, and what checkpoints remain is evaluated anew"
        ) from error


def _write_points(run: Path, points: Points) -> None:
    path = run / POINTS_FILE
    partial = path.with_suffix(".partial")
    try:
        partial.write_text(json.dumps({str(frames): points[frames] for frames in sorted(points)}, allow_nan=False))
        os.replace(partial, path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise


def is_measured(run: Path, num_envs: int) -> bool:
    """Whether the last checkpoint of a run has been evaluated over that many episodes.

    Raises:
        CheckpointError: if it cannot be used. ConfigError: if what was measured is damaged.
    """
    found = read_points(run).get(load_checkpoint(run)["frames"], {})
    return bool(found) and all(result["num_envs"] >= num_envs for result in found.values())


def measure_run(run: Path, num_envs: int, num_threads: int, seed: int = 0) -> None:
    """Evaluates the checkpoints of a run that have not been, and keeps the newest of them.

    Each is played once, over the whole motion, and judged under all terminations of its task (`none` is left out) and
    without each of them.

    Args:
        num_envs: episodes.
        num_threads: of physics.
        seed: of starts, randomization and noise.

    Raises:
        CheckpointError, ConfigError, MotionError: if it cannot be evaluated here.
        OSError: if points.json cannot be written.
    """
    points = read_points(run)
    files = checkpoints(run / "checkpoints")
    for file in files:
        actor, cfg, info = load_policy(file)
        done = points.get(info["frames"], {})
        if done and min(result["num_envs"] for result in done.values()) >= num_envs:
            continue
        cfg = task_terminations_config(cfg)
        cfg.num_threads = num_threads
        left_out: dict[str, Sequence[str]] = {NONE: (), **{name: (name,) for name in termination_names(cfg)}}
        results = evaluate_excused(actor, cfg, num_envs, left_out, make_task(cfg), seed)
        points[info["frames"]] = {name: dict(result) for name, result in results.items()}
        _write_points(run, points)
    rotate(run / "checkpoints", 1)
