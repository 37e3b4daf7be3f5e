"""Finds a motion's contacts with the object, completes the object's trajectory, and writes the annotated motion.

    hdmi annotate PATH [task=NAME] [out=FOLDER] [overrides=FILE] [config_dir=FOLDER]

PATH is a motion's folder. `task` describes the object, the scenery and the end effectors: the task whose motion has
the folder's name, if not given; `config_dir` adds the tasks of its folder `task` to those of conf/task. A file
`annotation.yaml` in the folder, or `overrides`, has the last word on intervals and points, and may hold keyframes from
which the object's trajectory follows. Labels that the motion already has are not looked at, but for a comparison. The
result goes to `out`, annotated/NAME if not given.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from hdmi.assembly import scene_parts
from hdmi.commands.options import parse_motion_options
from hdmi.commands.script import run_script
from hdmi.config import ConfigError, task_config
from hdmi.motion import Motion, load_motion, save_motion
from hdmi.workshop.annotate import FILE, agreement, annotate_motion, intervals, load_overrides


@dataclass
class Options:
    """See the module."""

    task: str | None = None
    out: str | None = None
    overrides: str | None = None
    config_dir: str | None = None


def table(motion: Motion, effectors: list[str], given: np.ndarray | None) -> Table:
    """Intervals and points of each effector, and how they compare with given labels."""
    assert motion.object_contact is not None
    assert motion.contact_points is not None
    out = Table(title=f"{motion.name}: contacts", title_justify="left")
    for column in ("effector", "frames", "points in the object's frame, m"):
        out.add_column(column)
    for column in () if given is None else ("precision", "recall"):
        out.add_column(column, justify="right")
    for e, name in enumerate(effectors):
        label = motion.object_contact[:, e]
        spans = intervals(label)
        points = [motion.contact_points[first, e] for first, _ in spans]
        scores = []
        if given is not None:
            compared = agreement(label, given[:, min(e, given.shape[1] - 1)])
            scores = [f"{x:.2f}" if np.isfinite(x) else "-" for x in (compared.precision, compared.recall)]
        out.add_row(
            name,
            "\n".join(f"{first}-{last}" for first, last in spans) or "none",
            "\n".join("[" + ", ".join(f"{x:.3f}" for x in point) + "]" for point in points),
            *scores,
        )
    return out


def annotate(arguments: list[str], console: Console) -> int:
    """Annotates a motion, writes it, and shows its contacts."""
    path, options = parse_motion_options(Options, arguments)
    motion = load_motion(path)
    parts = scene_parts(task_config(options.task or motion.name, config_dir=options.config_dir))
    if parts["object"] is None:
        raise ConfigError(f"task {options.task or motion.name!r}: has no object to touch")
    beside = path / FILE
    file = Path(options.overrides) if options.overrides else beside if beside.is_file() else None
    annotated = annotate_motion(motion, **parts, overrides=load_overrides(file) if file else None)
    folder = save_motion(annotated, options.out or Path("annotated") / motion.name)
    effectors, given = [effector.body for effector in parts["effectors"]], motion.object_contact
    if given is not None and given.shape[1] not in (1, len(effectors)):
        given = None  # of other effectors
    console.print(table(annotated, effectors, given))
    if given is not None:
        console.print("precision and recall are against the labels that the motion came with")
    if file is not None:
        console.print(f"with {file}", soft_wrap=True, highlight=False)
    console.print(f"{folder}", soft_wrap=True, highlight=False)
    return 0


def main(arguments: list[str]) -> int:
    """Runs the script; returns its exit status."""
    return run_script(annotate, arguments, __doc__)
