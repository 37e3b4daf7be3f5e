"""Learning curves of runs against frames and minutes."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from omegaconf import OmegaConf

from hdmi.learning.resume import CONFIG_FILE, of_training
from hdmi.metrics import METRICS_FILE, read_rows

# column -> label; shown are those that any run has
CURVES = {
    "episode_completed": "episodes completed",
    "episode_steps": "episode length (steps)",
    "joint_error": "joint error (rad)",
    "body_error": "body error (m)",
    "contact_rate": "contacts made",
    "eval/success_rate": "success in evaluation",
    "eval/survival": "survival in evaluation",
}
_SHARES = ("episode_completed", "contact_rate", "eval/success_rate", "eval/survival")
_TIMES = ("frames", "minutes")
COLOURS = ("#2a6fbb", "#d1603d", "#3a8f5c", "#8a5bb0", "#c29a2b", "#4fa3a5", "#b5477d", "#6b6b6b")


def read_metrics(run: Path) -> dict[str, np.ndarray]:
    """Columns of a run's metrics.csv, NaN where nothing was logged; a row that is not complete is left out.

    Raises:
        FileNotFoundError: if there is none. ValueError: if it has no rows yet or is not of numbers.
    """
    path = run if run.is_file() else run / METRICS_FILE
    if not path.is_file():
        raise FileNotFoundError(f"{run}: no metrics.csv there")
    fields, rows = read_rows(path)
    if not rows:
        raise ValueError(f"{path}: no rows yet")
    if missing := [key for key in _TIMES if key not in fields]:
        raise ValueError(f"{path}: no column {missing[0]!r}")
    try:
        return {key: np.array([float(row[key] or "nan") for row in rows]) for key in fields}
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error


def labels_of(runs: Sequence[Path]) -> list[str]:
    """Names of the run folders, with their parent's where names repeat."""
    names = [run.resolve().name for run in runs]
    return [
        name if names.count(name) == 1 else f"{run.resolve().parent.name}/{name}"
        for run, name in zip(runs, names, strict=True)
    ]


def groups_of(runs: Sequence[Path]) -> dict[str, list[Path]]:
    """Runs that differ in nothing but their seed and where they ran, by the arguments that they were started with.

    A run whose config says nothing of its arguments stays by itself, under its name.
    """
    found: dict[str, list[Path]] = {}
    for run, label in zip(runs, labels_of(runs), strict=True):
        file = (run.parent if run.is_file() else run) / CONFIG_FILE
        config: Any = OmegaConf.to_container(OmegaConf.load(file)) if file.is_file() else {}
        overrides = config.get("overrides")
        own = label if overrides is None else " ".join(t for t in of_training(overrides) if not t.startswith("seed="))
        found.setdefault(own or "default", []).append(run)
    return found


def over_seeds(tables: Sequence[Mapping[str, np.ndarray]], key: str) -> tuple[np.ndarray, np.ndarray]:
    """A figure of several runs in the rows that all of them have: mean, and lowest and highest value. [T], [2, T]"""
    length = min(len(table["frames"]) for table in tables)
    values = np.stack([table.get(key, np.full(length, np.nan))[:length] for table in tables])
    return values.mean(0), np.stack([values.min(0), values.max(0)])


def smooth(values: np.ndarray, window: int) -> np.ndarray:
    """Trailing mean over up to `window` rows, ignoring NaN."""
    out = np.full_like(values, np.nan)
    for i in range(len(values)):
        part = values[max(i + 1 - window, 0) : i + 1]
        if np.isfinite(values[i]):
            out[i] = part[np.isfinite(part)].mean()
    return out


def plot_runs(
    runs: Sequence[Path], out: Path, window: int = 1, curves: Mapping[str, str] = CURVES, seeds: bool = False
) -> None:
    """Draws the curves of all runs into a picture: one row per figure, against frames and against minutes.

    A run without usable metrics.csv is told on the standard error output and left out.

    Args:
        runs: run folders, or their metrics.csv.
        out: picture to write.
        window: rows of a trailing mean.
        curves: column -> label; shown are those that any run has.
        seeds: draw runs that differ only in their seed as one curve, their mean, with a band from lowest to highest.

    Raises:
        ValueError: if no run is left.
    """
    found: dict[Path, dict[str, np.ndarray]] = {}
    problems: list[str] = []
    for run in runs:
        try:
            found[run] = read_metrics(run)
        except (OSError, ValueError) as error:
            problems.append(str(error))
    if not found:
        raise ValueError("; ".join(problems))
    for problem in problems:
        print(f"left out: {problem}", file=sys.stderr)
    runs, tables = list(found), list(found.values())
    groups = groups_of(runs) if seeds else {label: [run] for label, run in zip(labels_of(runs), runs, strict=True)}
    shown = [key for key in curves if any(np.isfinite(table.get(key, np.nan)).any() for table in tables)]
    if not shown:
        raise ValueError(f"none of the runs has any of {', '.join(curves)}")
    figure = Figure(figsize=(10, 2.1 * len(shown) + 0.6))
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(shown), 2, sharex="col", sharey="row", squeeze=False)
    for i, (label, members) in enumerate(groups.items()):
        table_of = [found[run] for run in members]
        times = [over_seeds(table_of, key)[0] for key in _TIMES]
        for row, key in enumerate(shown):
            mean, band = over_seeds(table_of, key)
            y = smooth(mean, window)
            there = np.isfinite(y)
            if not there.any():
                continue
            colour = COLOURS[i % len(COLOURS)]
            style = {"color": colour, "lw": 1.6, "marker": "o" if there.sum() < 30 else None}
            name = label if len(members) == 1 else f"{label} ({len(members)} seeds)"
            for column, x in enumerate((times[0] / 1e6, times[1])):
                axes[row, column].plot(x[there], y[there], markersize=3, label=name, **style)
                if len(members) > 1:
                    low, high = (smooth(edge, window)[there] for edge in band)
                    axes[row, column].fill_between(x[there], low, high, color=colour, alpha=0.18, lw=0)
    for row, key in enumerate(shown):
        axes[row, 0].set_ylabel(curves[key])
        if key in _SHARES:
            axes[row, 0].yaxis.set_major_formatter(PercentFormatter(1.0))
            axes[row, 0].set_ylim(-0.03, 1.03)
        for ax in axes[row]:
            ax.grid(alpha=0.3)
            ax.spines[["top", "right"]].set_visible(False)
    axes[-1, 0].set_xlabel("frames (million)")
    axes[-1, 1].set_xlabel("minutes of training")
    handles = {label: line for ax in axes.flat for line, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="upper center", ncols=min(len(handles), 3), frameon=False)
    figure.align_ylabels()
    figure.tight_layout(rect=(0, 0, 1, 1 - 0.35 * (1 + (len(handles) - 1) // 3) / figure.get_figheight()))
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=130)
