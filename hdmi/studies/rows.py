"""What the runs of a study came to, as rows: one for each run, and one for each evaluation on the way."""

from __future__ import annotations

import csv
import os
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hdmi.config import ConfigError
from hdmi.learning.checkpoint import load_checkpoint
from hdmi.studies.measure import NONE, read_points
from hdmi.studies.plan import Job, Study
from hdmi.studies.statistics import Sample

RUNS_FILE = "runs.csv"
CURVES_FILE = "curves.csv"
_TRAIN = "hdmi train "

Figures = dict[str, float]  # column of a csv -> mean over the episodes of an evaluation


@dataclass(frozen=True)
class Row:
    """One run.

    Args:
        job: what it was to be.
        folder: of the run; None where only its line in runs.csv is here.
        points: its evaluations, by the frames that it had been trained.
        minutes: of collection and learning.
    """

    job: Job
    folder: Path | None
    points: Mapping[int, Figures]
    minutes: float

    @property
    def frames(self) -> int:
        """That it was trained."""
        return max(self.points)

    def figure(self, of: str, without: str, frames: int | None = None) -> float:
        """The mean of a figure over the episodes of an evaluation, NaN where there is none.

        Args:
            of: its name.
            without: termination that does not count.
            frames: of the training; None for the last evaluation.
        """
        return self.points.get(self.frames if frames is None else frames, {}).get(column_of(of, without), np.nan)


def column_of(figure: str, without: str) -> str:
    """The column of a figure in a csv.

    Examples:
        >>> column_of("success_rate", "none"), column_of("success_rate", "lost_contact")
        ('success_rate', 'success_rate/without_lost_contact')
    """
    return figure if without == NONE else f"{figure}/without_{without}"


def read_rows_of(study: Study, runs: Path, folder: Path | None = None) -> list[Row]:
    """The runs of a study that have been trained to their end and evaluated.

    Args:
        runs: folder of the run folders.
        folder: of an earlier report: lines of its csv files count where the run folder is not here, if they are of the
            same arguments.

    Raises:
        CheckpointError, ConfigError: for a run folder or a csv that cannot be read.
    """
    kept = {} if folder is None else _read_csv(study, folder)
    rows = []
    for job in study.jobs:
        row = _row_of(study, job, runs / job.name) or kept.get(job.name)
        if row is not None:
            rows.append(row)
    return rows


def _row_of(study: Study, job: Job, folder: Path) -> Row | None:
    points = read_points(folder)
    if not points:
        return None
    state = load_checkpoint(folder)
    if state["frames"] not in points or state["frames"] < state["config"]["total_frames"]:
        return None
    figures = {
        frames: {
            column_of(key, without): float(value["mean"])
            for without in study.without
            for key, value in results.get(without, {}).items()
            if isinstance(value, dict) and "mean" in value
        }
        for frames, results in points.items()
    }
    return Row(job, folder, figures, state["elapsed"] / 60)


def _read_csv(study: Study, folder: Path) -> dict[str, Row]:
    """The rows of a report that are of this study's trainings, by the name of the job."""
    lines = _lines(folder / RUNS_FILE)
    curves: dict[tuple[str, ...], dict[int, Figures]] = {}
    about = ("variant", "task", "seed")
    try:
        for line in _lines(folder / CURVES_FILE):
            figures = {key: float(text) for key, text in line.items() if key not in (*about, "frames") and text}
            curves.setdefault(tuple(line[key] for key in about), {})[int(line["frames"])] = figures
        there = {tuple(line[key] for key in about): line for line in lines}
        rows = {}
        for job in study.jobs:
            key = (job.variant.name, job.task, str(job.seed))
            if key not in there or key not in curves:
                continue
            if shlex.split(there[key]["command"].removeprefix(_TRAIN)) == job.arguments:
                rows[job.name] = Row(job, None, curves[key], float(there[key]["minutes"]))
        return rows
    except (KeyError, ValueError) as error:
        raise ConfigError(f"{folder}: {RUNS_FILE} or {CURVES_FILE} is damaged ({error!r}); remove both") from error


def _lines(path: Path) -> list[dict[str, str]]:
    """The lines of a csv, none if there is none; a line that was written in part is left out."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        lines = list(csv.DictReader(file))
    return [line for line in lines if None not in line and None not in line.values()]


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


def write_rows(rows: Sequence[Row], folder: Path) -> None:
    """Writes runs.csv, a line for each run, and curves.csv, a line for each of its evaluations.

    Raises:
        OSError: if they cannot be written.
    """
    runs, curves = [], []
    for row in rows:
        about = {"variant": row.job.variant.name, "task": row.job.task, "seed": row.job.seed}
        last = {"frames": row.frames, "minutes": f"{row.minutes:.2f}", **_texts(row.points[row.frames])}
        runs.append({**about, **last, "command": command_of(row)})
        curves += [{**about, "frames": frames, **_texts(row.points[frames])} for frames in sorted(row.points)]
    for name, lines in ((RUNS_FILE, runs), (CURVES_FILE, curves)):
        _write_csv(folder / name, lines)


def command_of(row: Row) -> str:
    """What trains a run, but for where."""
    return _TRAIN + shlex.join(row.job.arguments)


def _texts(figures: Figures) -> dict[str, str]:
    return {key: f"{value:.6g}" for key, value in figures.items()}


def _write_csv(path: Path, lines: Sequence[Mapping[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    fields = list(dict.fromkeys(key for line in lines for key in line))
    partial = path.with_suffix(".partial")
    try:
        with partial.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, fields, restval="", lineterminator="\n")
            writer.writeheader()
            writer.writerows(lines)
        os.replace(partial, path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise
