"""Figures of a study: one colour for each variant everywhere, intervals as bands and whiskers, n in the caption."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import PercentFormatter

from hdmi.evaluation.curves import COLOURS
from hdmi.evaluation.protocol import HORIZON, unit_of
from hdmi.studies.measure import NONE
from hdmi.studies.plan import Figure, Study, of_tasks
from hdmi.studies.probes import Poses, Starts
from hdmi.studies.rows import Row, samples
from hdmi.studies.statistics import Estimate, iqm

_PANELS = 4  # in a row
_NAMES = {"success_rate": "success", "survival": "survival", "contact_rate": "contacts made"}


def label_of(figure: str) -> str:
    """What an axis says of a figure of evaluations.

    Examples:
        >>> label_of("body_error_horizon"), label_of("success_rate")
        ('body error, whole motion (m)', 'success')
    """
    unit = unit_of(figure)
    name = figure.removesuffix(HORIZON)
    words = _NAMES.get(name, name.replace("_", " ")) + (", whole motion" if figure.endswith(HORIZON) else "")
    return words if unit in ("%", "") else f"{words} ({unit})"


def condition_of(without: str) -> str:
    """Which terminations count."""
    return "all terminations" if without == NONE else f"without {without.replace('_', ' ')}"


def colours(study: Study) -> dict[str, str]:
    """Of the variants, the same in all figures."""
    return {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(study.variants)}


def draw_bars(study: Study, figure: Figure, rows: Sequence[Row]) -> Canvas:
    """A figure over tasks: a bar for each variant, the interquartile mean over seeds, and a dot for each of these."""
    tasks, conditions = of_tasks(study, figure), figure.without or study.without
    canvas = _canvas(max(6.4, 1.1 * len(tasks) + 2.2), 2.6 * len(conditions) + 0.9)
    axes = canvas.subplots(len(conditions), 1, sharex=True, squeeze=False)[:, 0]
    width = 0.8 / len(study.variants)
    for ax, without in zip(axes, conditions, strict=True):
        for i, (name, variant) in enumerate(study.variants.items()):
            found = samples(rows, name, tasks, figure.of, without)
            x = np.arange(len(tasks)) + (i - (len(study.variants) - 1) / 2) * width
            estimates = [iqm([sample]) for sample in found]
            _bars(ax, x, estimates, 0.92 * width, colours(study)[name], variant.label)
            for at, sample in zip(x, found, strict=True):
                ax.plot(np.full(len(sample), at), sample, ".", color="black", markersize=3, alpha=0.6, zorder=3)
        _finish(ax, figure.of, condition_of(without))
    axes[-1].set_xticks(np.arange(len(tasks)), [task.replace("_", "\n", 1) for task in tasks], fontsize=8)
    return _titled(canvas, figure, axes[0])


def draw_summary(study: Study, figure: Figure, rows: Sequence[Row]) -> Canvas:
    """Interquartile means over all tasks and seeds, a line for each variant."""
    tasks, conditions = of_tasks(study, figure), figure.without or study.without
    canvas = _canvas(7.0, (0.42 * len(study.variants) + 0.75) * len(conditions) + 0.4)
    axes = canvas.subplots(len(conditions), 1, sharex=True, squeeze=False)[:, 0]
    for ax, without in zip(axes, conditions, strict=True):
        for i, (name, _variant) in enumerate(study.variants.items()):
            found = iqm(samples(rows, name, tasks, figure.of, without))
            if np.isfinite(found.low):
                ax.barh(i, found.high - found.low, left=found.low, height=0.5, color=colours(study)[name], alpha=0.35)
            ax.plot([found.value], [i], "|", color=colours(study)[name], markersize=16, markeredgewidth=3)
        ax.set_yticks(range(len(study.variants)), [variant.label for variant in study.variants.values()], fontsize=8)
        ax.set_ylim(len(study.variants) - 0.5, -0.5)
        ax.set_title(condition_of(without), fontsize=9, loc="left")
        ax.grid(alpha=0.3, axis="x")
        ax.spines[["top", "right"]].set_visible(False)
        if unit_of(figure.of) == "%":
            ax.xaxis.set_major_formatter(PercentFormatter(1.0))
    axes[-1].set_xlabel(f"{label_of(figure.of)}, interquartile mean")
    return _titled(canvas, figure, None)


def draw_curves(study: Study, figure: Figure, rows: Sequence[Row]) -> Canvas:
    """A figure over frames of the training, a panel for each task, a row for each set of terminations."""
    tasks, conditions = of_tasks(study, figure), figure.without or study.without
    canvas = _canvas(
        max(6.4, 3.1 * min(len(tasks), _PANELS) + 0.6), 2.5 * len(conditions) * -(-len(tasks) // _PANELS) + 0.9
    )
    columns = min(len(tasks), _PANELS)
    axes = canvas.subplots(len(conditions) * -(-len(tasks) // columns), columns, sharey=True, squeeze=False)
    panels = [(without, task) for without in conditions for task in _padded(tasks, columns)]
    for ax, (without, task) in zip(axes.flat, panels, strict=True):
        if task is None:
            ax.axis("off")
            continue
        for name, variant in study.variants.items():
            of = [row for row in rows if (row.job.variant.name, row.job.task) == (name, task)]
            frames = sorted(set.intersection(*(set(row.points) for row in of))) if of else []
            estimates = [iqm([np.array([row.figure(figure.of, without, at) for row in of])]) for at in frames]
            x = np.array(frames) / 1e6
            ax.plot(
                x, [one.value for one in estimates], "o-", ms=3, lw=1.6, color=colours(study)[name], label=variant.label
            )
            ax.fill_between(
                x, [one.low for one in estimates], [one.high for one in estimates],
                color=colours(study)[name], alpha=0.18, lw=0,
            )  # fmt: skip
        _finish(ax, figure.of, f"{task}, {condition_of(without)}")
        ax.set_xlim(left=0)
    for ax in axes[-1]:
        ax.set_xlabel("frames (million)")
    for ax in axes[:, 1:].flat:
        ax.set_ylabel("")
    return _titled(canvas, figure, axes[0, 0])


def draw_poses(study: Study, figure: Figure, found: Mapping[tuple[str, str], Poses]) -> Canvas:
    """Pictures of the variants at the same frame, a row for each task; by (task, variant)."""
    tasks = [task for task in of_tasks(study, figure) if any(key[0] == task for key in found)]
    canvas = _canvas(2.9 * len(study.variants), 2.75 * len(tasks) + 0.5)
    axes = canvas.subplots(max(len(tasks), 1), len(study.variants), squeeze=False)
    for line, task in zip(axes, tasks, strict=False):
        for ax, (name, variant) in zip(line, study.variants.items(), strict=True):
            ax.axis("off")
            poses = found.get((task, name))
            if poses is None:
                continue
            if poses.picture is not None:
                ax.imshow(poses.picture)
            ax.set_title(
                f"{variant.label}\n{task}, frame {poses.frame}: knee {100 * poses.height:.0f} cm "
                f"(reference {100 * poses.reference:.0f})",
                fontsize=7,
            )
    return _titled(canvas, figure, None)


def draw_starts(study: Study, figure: Figure, found: Mapping[tuple[str, str], Starts]) -> Canvas:
    """Height of the root over the first second of untrained policies, and how many are left; by (task, variant)."""
    tasks = [task for task in of_tasks(study, figure) if any(key[0] == task for key in found)]
    canvas = _canvas(max(6.4, 3.3 * len(tasks) + 0.6), 5.2)
    axes = canvas.subplots(2, max(len(tasks), 1), sharex=True, squeeze=False)
    for (above, below), task in zip(axes.T, tasks, strict=False):
        for name, variant in study.variants.items():
            starts = found.get((task, name))
            if starts is None:
                continue
            colour = colours(study)[name]
            time = np.arange(len(starts.height)) * starts.control_dt
            low, middle, high = np.percentile(starts.height, [25, 50, 75], axis=1)
            above.plot(time, middle, color=colour, lw=1.6, label=variant.label)
            above.fill_between(time, low, high, color=colour, alpha=0.18, lw=0)
            below.plot(time, starts.alive.mean(1), color=colour, lw=1.6)
            if name == list(study.variants)[-1]:
                above.plot(time, starts.reference, "k--", lw=1, label="reference")
        above.set_title(f"{task}, from its lowest frame", fontsize=9, loc="left")
        below.set_xlabel("time (s)")
        below.yaxis.set_major_formatter(PercentFormatter(1.0))
        below.set_ylim(-0.03, 1.03)
        for ax, label in ((above, "height of the root (m)"), (below, "episodes left")):
            ax.set_ylabel(label)
            ax.grid(alpha=0.3)
            ax.spines[["top", "right"]].set_visible(False)
    return _titled(canvas, figure, axes[0, 0])


def save(canvas: Canvas, stem: Path) -> Path:
    """Writes PNG and PDF; returns the PNG's path.

    Raises:
        OSError: if they cannot be written.
    """
    stem.parent.mkdir(parents=True, exist_ok=True)
    for suffix in (".pdf", ".png"):
        canvas.savefig(stem.with_suffix(suffix), dpi=150)
    return stem.with_suffix(".png")


def _canvas(width: float, height: float) -> Canvas:
    canvas = Canvas(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(canvas)
    return canvas


def _bars(ax: Axes, x: np.ndarray, found: Sequence[Estimate], width: float, colour: str, label: str) -> None:
    values = np.array([one.value for one in found])
    errors = np.array([[one.value - one.low for one in found], [one.high - one.value for one in found]])
    there = np.isfinite(values)
    if there.any():
        ax.bar(x[there], values[there], width, color=colour, label=label, alpha=0.85)
        ax.errorbar(
            x[there], values[there], np.nan_to_num(errors[:, there]), fmt="none", ecolor="black", lw=1, capsize=2
        )


def _finish(ax: Axes, of: str, title: str) -> None:
    ax.set_ylabel(label_of(of))
    ax.set_title(title, fontsize=9, loc="left")
    ax.grid(alpha=0.3, axis="y")
    ax.spines[["top", "right"]].set_visible(False)
    if unit_of(of) == "%":
        ax.yaxis.set_major_formatter(PercentFormatter(1.0))
        ax.set_ylim(-0.03, 1.03)


def _titled(canvas: Canvas, figure: Figure, ax: Axes | None) -> Canvas:
    """Adds the title, and a legend from one of the panels."""
    if ax is not None:
        handles, labels = ax.get_legend_handles_labels()
        kept: dict[str, Any] = dict(zip(labels, handles, strict=True))
        if kept:
            canvas.legend(
                kept.values(),
                kept.keys(),
                loc="outside lower center",
                ncols=min(len(kept), 2),
                frameon=False,
                fontsize=8,
            )
    if figure.title:
        canvas.suptitle(figure.title, fontsize=10)
    return canvas


def _padded(tasks: Sequence[str], columns: int) -> list[str | None]:
    return [*tasks, *[None] * (-len(tasks) % columns)]
