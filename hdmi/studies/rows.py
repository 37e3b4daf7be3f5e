"""What the runs of a study came to, as rows: one for each run, and one for each evaluation on the way."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hdmi.learning.checkpoint import load_checkpoint
from hdmi.studies.measure import Points, read_points
from hdmi.studies.plan import Job, Study
from hdmi.studies.statistics import Sample

RUNS_FILE = "runs.csv"
CURVES_FILE = "curves.csv"


@dataclass(frozen=True)
class Row:
    """One run.

    Args:
        job: what it was to be.
        folder: of the run.
        points: its evaluations, by frames.
        frames: that it was trained.
        minutes: of collection and learning.
        arguments: of `hdmi train`, but for where it ran.
    """

    job: Job
    folder: Path
    points: Points
    frames: int
    minutes: float
    arguments: tuple[str, ...]

    def figure(self, of: str, without: str, frames: int | None = None) -> float:
        """The mean of a figure over the episodes of an evaluation, NaN where there is none.

        Args:
            of: its name.
            without: termination that does not count.
            frames: of the training; None for the last evaluation.
        """
        results = self.points.get(max(self.points) if frames is None else frames, {})
        entry = results.get(without, {}).get(of)
        return np.nan if entry is None else float(entry["mean"])


def read_rows_of(study: Study, runs: Path) -> list[Row]:
    """The runs of a study that have been trained to their end and evaluated; others are not there.

    Raises:
        CheckpointError, ConfigError: for a run folder that cannot be read.
    """
    rows = []
    for job in study.jobs:
        folder = runs / job.name
        points = read_points(folder)
        if not points:
            continue
        state = load_checkpoint(folder)
        if state["frames"] not in points or state["frames"] < state["config"]["total_frames"]:
            continue
        own = ("output_dir=", "run_name=", "resume=", "num_threads=", "keep_checkpoints=", "checkpoint_interval=")
        arguments = tuple(text for text in state["config"].get("overrides", ()) if not text.startswith(own))
        rows.append(Row(job, folder, points, state["frames"], state["elapsed"] / 60, arguments))
    return rows


def samples(rows: Iterable[Row], variant: str, tasks: Sequence[str], of: str, without: str) -> list[Sample]:
    """A figure of a variant: for each task an array over seeds, in their order; NaN is left out."""
    found: Mapping[str, list[float]] = {task: [] for task in tasks}
    for row in sorted(rows, key=lambda row: row.job.seed):
        if row.job.variant.name == variant and row.job.task in found:
            found[row.job.task].append(row.figure(of, without))
    return [np.array([value for value in found[task] if np.isfinite(value)]) for task in tasks]


def paired(
    rows: Sequence[Row], variant: str, other: str, tasks: Sequence[str], of: str, without: str
) -> tuple[list[Sample], list[Sample]]:
    """A figure of two variants, for each task only of the seeds that both have."""
    values = {(row.job.variant.name, row.job.task, row.job.seed): row.figure(of, without) for row in rows}
    first, second = [], []
    for task in tasks:
        seeds = sorted(
            seed
            for name, where, seed in values
            if (name, where) == (variant, task)
            and np.isfinite(values[variant, task, seed])
            and np.isfinite(values.get((other, task, seed), np.nan))
        )
        first.append(np.array([values[variant, task, seed] for seed in seeds]))
        second.append(np.array([values[other, task, seed] for seed in seeds]))
    return first, second


def write_rows(study: Study, rows: Sequence[Row], folder: Path) -> None:
    """Writes runs.csv, a line for each run, and curves.csv, a line for each of its evaluations.

    Figures are `<figure>` with all terminations, `<figure>/without_<termination>` otherwise.

    Raises:
        OSError: if they cannot be written.
    """
    runs, curves = [], []
    for row in rows:
        about = {"variant": row.job.variant.name, "task": row.job.task, "seed": row.job.seed}
        command = "hdmi train " + " ".join(row.arguments)
        runs.append({**about, "minutes": f"{row.minutes:.2f}", **_figures(study, row, row.frames), "command": command})
        curves += [{**about, **_figures(study, row, frames)} for frames in sorted(row.points)]
    for name, lines in ((RUNS_FILE, runs), (CURVES_FILE, curves)):
        _write_csv(folder / name, lines)


def _figures(study: Study, row: Row, frames: int) -> dict[str, Any]:
    found: dict[str, Any] = {"frames": frames}
    for without in study.without:
        result = row.points[frames].get(without, {})
        suffix = "" if without == "none" else f"/without_{without}"
        found |= {f"{key}{suffix}": f"{value['mean']:.6g}" for key, value in result.items() if _is_figure(value)}
    return found


def _is_figure(value: Any) -> bool:
    return isinstance(value, dict) and "mean" in value


def _write_csv(path: Path, lines: Sequence[Mapping[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    fields = list(dict.fromkeys(key for line in lines for key in line))
    partial = path.with_suffix(".partial")
    try:
        with partial.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, fields, restval="")
            writer.writeheader()
            writer.writerows(lines)
        os.replace(partial, path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise
