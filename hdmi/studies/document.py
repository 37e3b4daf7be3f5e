"""The report of a study: tables, figures, and every command that made them."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from hdmi.config import ConfigError
from hdmi.envs.rendering import RenderingError
from hdmi.evaluation.protocol import unit_of
from hdmi.learning.checkpoint import CheckpointError
from hdmi.motion import MotionError
from hdmi.studies.figures import (
    condition_of,
    draw_bars,
    draw_curves,
    draw_poses,
    draw_starts,
    draw_summary,
    label_of,
    save,
)
from hdmi.studies.plan import Figure, Job, Study, of_tasks
from hdmi.studies.probes import LAUNCH, Poses, Starts, first_second, poses_at
from hdmi.studies.rows import Row, command_of, paired, read_rows_of, samples, write_rows
from hdmi.studies.statistics import CONFIDENCE, Estimate, improvement, iqm, paired_difference

REPORT_FILE = "report.md"
# Where fewer of the episodes succeed in all variants, errors and successes do not tell them apart.
_ENOUGH = 0.05
_PROBLEMS = (CheckpointError, ConfigError, MotionError, RenderingError, OSError)

Say = Callable[[str], None]


def write_report(study: Study, runs: Path, folder: Path, say: Say = print) -> Path:
    """Writes runs.csv, curves.csv, the figures as PNG and PDF, and report.md, from what is there of a study.

    Args:
        runs: folder of the run folders.
        folder: for the report.
        say: takes what could not be drawn, a line at a time.

    Returns:
        The report's path.

    Raises:
        CheckpointError, ConfigError: for a run folder that cannot be read.
        OSError: if something cannot be written.
    """
    rows = read_rows_of(study, runs, folder)
    write_rows(rows, folder)
    parts = [_head(study, rows), _verdicts(study, rows)]
    drawable = [figure for figure in study.figures if of_tasks(study, figure)]  # a study may have some of its tasks
    for i, figure in enumerate(drawable):
        try:
            stem, caption = _draw(study, figure, rows, folder / f"figure_{i + 1}_{figure.kind}", say)
        except _PROBLEMS as error:
            say(f"figure {i + 1}, {figure.kind}: {error}")
            parts.append(f"Figure {i + 1} ({figure.kind}) could not be drawn: {error}\n")
            continue
        parts.append(f"![{figure.title or figure.kind}]({stem.name})\n\n*Figure {i + 1}. {caption}*\n")
    parts += [_tables(study, rows), _commands(study, rows)]
    path = folder / REPORT_FILE
    partial = path.with_suffix(".partial")
    partial.write_text("\n".join(parts), encoding="utf-8")
    os.replace(partial, path)
    return path


# -- figures --------------------------------------------------------------------------------------------------


def _draw(study: Study, figure: Figure, rows: Sequence[Row], stem: Path, say: Say) -> tuple[Path, str]:
    """Draws a figure; returns its path and caption."""
    tasks, n = of_tasks(study, figure), _seeds(study, rows)
    what = label_of(figure.of)
    interval = f"{CONFIDENCE:.0%} bootstrap interval over seeds"
    if figure.kind == "bars":
        drawn = draw_bars(study, figure, rows)
        said = (
            f"{_capital(what)} after {_millions(study)} frames, interquartile mean and {interval}; dots are seeds, {n}."
        )
    elif figure.kind == "summary":
        drawn = draw_summary(study, figure, rows)
        said = (
            f"{_capital(what)} over {_counted(len(tasks), 'task')}: interquartile mean over runs, "
            f"{CONFIDENCE:.0%} stratified bootstrap interval; {n}."
        )
    elif figure.kind == "curves":
        drawn = draw_curves(study, figure, rows)
        said = f"{_capital(what)} during training, interquartile mean and {interval}; {n}."
    elif figure.kind == "poses":
        poses = _poses(study, figure, rows, say)
        drawn = draw_poses(study, figure, poses)
        said = (
            "The same frame of the motion, in which the reference's root is lowest, played from the first frame "
            f"without terminations; the ghost is the reference. Policies of seed 0. {_heights(study, poses)}"
        )
    else:
        starts = _starts(study, figure)
        drawn = draw_starts(study, figure, starts)
        said = (
            "Untrained policies, with exploration noise, from the lowest frame of the reference: height of the root "
            f"(median and quartiles of {_episodes(starts)} episodes), and episodes without a termination or early end. "
            + _launches(study, starts)
        )
    return save(drawn, stem), said


def _poses(study: Study, figure: Figure, rows: Sequence[Row], say: Say) -> dict[tuple[str, str], Poses]:
    found = {}
    tasks = of_tasks(study, figure)
    for row in rows:
        if row.folder is not None and row.job.seed == 0 and row.job.task in tasks:
            try:
                found[row.job.task, row.job.variant.name] = poses_at(row.folder)
            except RenderingError as error:
                say(f"no pictures: {error}")
                found[row.job.task, row.job.variant.name] = poses_at(row.folder, render=False)
    if not found:
        raise ConfigError(f"no run of seed 0 of {', '.join(tasks)} is here")
    return found


def _starts(study: Study, figure: Figure) -> dict[tuple[str, str], Starts]:
    return {
        (task, name): first_second(Job(study, variant, task, 0).config())
        for task in of_tasks(study, figure)
        for name, variant in study.variants.items()
        if variant.reference is None
    }


def _episodes(starts: Mapping[tuple[str, str], Starts]) -> int:
    return max((one.height.shape[1] for one in starts.values()), default=0)


def _heights(study: Study, poses: Mapping[tuple[str, str], Poses]) -> str:
    said = [
        f"{study.variants[name].label} ({task}): lowest knee {100 * one.height:.0f} cm, root {100 * one.root:.0f} cm; "
        f"reference {100 * one.reference:.0f} and {100 * one.reference_root:.0f} cm"
        for (task, name), one in poses.items()
    ]
    return ". ".join(said) + "." if said else ""


def _launches(study: Study, starts: Mapping[tuple[str, str], Starts]) -> str:
    said = [
        f"{study.variants[name].label} ({task}): upward acceleration over the first {LAUNCH:g} s "
        f"{one.acceleration.mean():.1f} ± {one.acceleration.std():.1f} m/s², {100 * one.alive[-1].mean():.0f} % left "
        "after a second"
        for (task, name), one in starts.items()
    ]
    return ". ".join(said) + "."


# -- text -----------------------------------------------------------------------------------------------------


def _head(study: Study, rows: Sequence[Row]) -> str:
    whole = len(study.jobs)
    frames, minutes = sum(row.frames for row in rows), sum(row.minutes for row in rows)
    lines = [
        f"# {study.title}",
        "",
        study.question.strip(),
        "",
        f"{len(rows)} of {whole} trainings are there: {_counted(len(study.variants), 'variant')}, "
        f"{_counted(len(study.tasks), 'task')}, {_counted(study.seeds, 'seed')}, {_millions(study)} frames each; "
        f"{frames / 1e6:.1f} M frames and {minutes:.0f} minutes "
        "of collection and learning altogether. Evaluations are of "
        f"{study.num_envs} episodes from the first frame, under the terminations of the task "
        f"({'; '.join(condition_of(name) for name in study.without)}), with the starts of the training.",
        "",
        "| variant | arguments beside the study's |",
        "|---|---|",
    ]
    for variant in study.variants.values():
        recorded = [] if variant.reference is None else [f"motion recorded from {variant.reference}"]
        lines.append(
            f"| {variant.label} | {', '.join([f'`{text}`' for text in variant.arguments] + recorded) or 'none'} |"
        )
    return "\n".join(lines) + "\n"


def _verdicts(study: Study, rows: Sequence[Row]) -> str:
    """All variants over all tasks, each against the first."""
    first, *_ = study.variants
    lines = []
    for without in study.without:
        lines += [
            f"**Success, {condition_of(without)}** (interquartile mean over tasks and seeds, {CONFIDENCE:.0%} "
            "intervals)",
            "",
            f"| variant | n | success | difference from {study.variants[first].label}, paired | "
            f"probability that {study.variants[first].label} is better |",
            "|---|---|---|---|---|",
        ]
        for name, variant in study.variants.items():
            found = samples(rows, name, study.tasks, "success_rate", without)
            whole = iqm([sample for sample in found if len(sample)])
            cells = ["", ""]
            if name != first:
                own, other = paired(rows, name, first, study.tasks, "success_rate", without)
                own, other = _there(own, other)
                cells = [_percent(paired_difference(own, other), signed=True), _percent(improvement(other, own))]
            lines.append(f"| {variant.label} | {whole.n} | {_percent(whole)} | {cells[0]} | {cells[1]} |")
        successes = [row.figure("success_rate", without) for row in rows]
        if not successes or max(successes) < _ENOUGH:
            lines += [
                "",
                f"Fewer than {_ENOUGH:.0%} of the episodes of any run succeed: too few to tell variants apart by it.",
            ]
        lines.append("")
    return "\n".join(lines)


def _there(*sides: list[np.ndarray]) -> list[list[np.ndarray]]:
    """Only the tasks for which all sides have runs."""
    kept = [i for i in range(len(sides[0])) if all(len(side[i]) for side in sides)]
    return [[side[i] for i in kept] for side in sides]


def _percent(one: Estimate, signed: bool = False) -> str:
    return f"{one:{'+' if signed else ''}.1%}"


def _tables(study: Study, rows: Sequence[Row]) -> str:
    """Figures of each task: mean over seeds and standard deviation."""
    without = study.without[0]
    names = ["success_rate", "survival"] + [f.of for f in study.figures if f.kind in ("bars", "summary", "curves")]
    figures = [name for name in dict.fromkeys(names) if any(np.isfinite(row.figure(name, without)) for row in rows)]
    lines = [
        f"## Tasks, {condition_of(without)}",
        "",
        f"| task | variant | n | {' | '.join(label_of(name) for name in figures)} |",
        "|---|---|---|" + "---|" * len(figures),
    ]
    for task in study.tasks:
        for name, variant in study.variants.items():
            cells, n = [], 0
            for figure in figures:
                (sample,) = samples(rows, name, [task], figure, without)
                n = max(n, len(sample))
                cells.append(_mean(sample, figure))
            lines.append(f"| {task} | {variant.label} | {n} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _mean(sample: np.ndarray, figure: str) -> str:
    if not len(sample):
        return "-"
    factor, digits = (100, 1) if unit_of(figure) == "%" else (1, 3)
    unit = " %" if factor == 100 else ""
    spread = f" ± {factor * sample.std():.{digits}f}" if len(sample) > 1 else ""
    return f"{factor * sample.mean():.{digits}f}{spread}{unit}"


def _commands(study: Study, rows: Sequence[Row]) -> str:
    lines = [
        "## Commands",
        "",
        f"`python scripts/study.py study={study.name}` makes all of it; figures of each run are in `runs.csv`, of each "
        "evaluation on the way in `curves.csv`.",
        "",
        "| variant | task | seed | frames | minutes | command |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row.job.variant.label} | {row.job.task} | {row.job.seed} | {row.frames} | {row.minutes:.1f} | "
        f"`{command_of(row)}` |"
        for row in rows
    ]
    return "\n".join(lines) + "\n"


def _seeds(study: Study, rows: Sequence[Row]) -> str:
    counts = {
        sum((row.job.variant.name, row.job.task) == (name, task) for row in rows)
        for name in study.variants
        for task in study.tasks
    }
    low, high = min(counts), max(counts)
    return f"n = {_counted(low, 'seed')} each" if low == high else f"n = {low} to {high} seeds each"


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def _millions(study: Study) -> str:
    return f"{study.total_frames / 1e6:g} M"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
