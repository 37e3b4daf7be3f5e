"""Finds a motion's contacts with the object, completes the object's trajectory, and writes the annotated motion.

    python scripts/annotate.py PATH [task=NAME] [out=FOLDER] [overrides=FILE]

PATH is a motion's folder. `task` describes the object, the scenery and the end effectors: the task whose motion has
the folder's name, if not given. A file `annotation.yaml` in the folder, or `overrides`, has the last word on intervals
and points, and may hold keyframes from which the object's trajectory follows. Labels that the motion already has are
not looked at, but for a comparison. The result goes to `out`, annotated/NAME if not given.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from hdmi.build import ConfigError, scene_parts
from hdmi.cli import USER_ERRORS
from hdmi.evaluation.agents import task_config
from hdmi.evaluation.options import parse_options
from hdmi.motion import Motion, load_motion, save_motion
from hdmi.motion.annotate import FILE, agreement, annotate_motion, intervals, load_overrides


@dataclass
class Options:
    """See the module."""

    task: str | None = None
    out: str | None = None
    overrides: str | None = None


def table(motion: Motion, effectors: list[str], given: np.ndarray | None) -> Table:
    """Intervals and points of each effector, and how they compare with given labels."""
    assert motion.object_contact is not None
    assert motion.contact_points is not None
    out = Table(title=f"{motion.name}: contacts", title_justify="left")
    for column in ("effector", "frames", "points in the object's frame, m", "precision", "recall"):
        out.add_column(column, justify="right" if column in ("precision", "recall") else "left")
    for e, name in enumerate(effectors):
        label = motion.object_contact[:, e]
        spans = intervals(label)
        points = [motion.contact_points[first, e] for first, _ in spans]
        scores = ["", ""]
        if given is not None:
            compared = agreement(label, given[:, min(e, given.shape[1] - 1)])
            scores = [f"{compared.precision:.2f}", f"{compared.recall:.2f}"]
        out.add_row(
            name,
            "\n".join(f"{first}-{last}" for first, last in spans) or "none",
            "\n".join("[" + ", ".join(f"{x:.3f}" for x in point) + "]" for point in points),
            *scores,
        )
    return out


def main(arguments: list[str]) -> int:
    """Runs the script; returns its exit status."""
    if arguments in (["-h"], ["--help"]):
        print(__doc__)
        return 0
    console = Console() if sys.stdout.isatty() else Console(width=150)
    try:
        paths = [argument for argument in arguments if "=" not in argument]
        if len(paths) != 1:
            raise ConfigError(f"give one motion folder, got {paths or 'none'}")
        options = parse_options(Options, [argument for argument in arguments if "=" in argument])
        motion = load_motion(paths[0])
        parts = scene_parts(task_config(options.task or motion.name))
        if parts["object"] is None:
            raise ConfigError(f"task {options.task or motion.name!r}: has no object to touch")
        beside = Path(paths[0]) / FILE
        file = Path(options.overrides) if options.overrides else beside if beside.is_file() else None
        annotated = annotate_motion(motion, **parts, overrides=load_overrides(file) if file else None)
        folder = save_motion(annotated, options.out or Path("annotated") / motion.name)
    except (*USER_ERRORS, OSError) as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 2
    console.print(table(annotated, [effector.body for effector in parts["effectors"]], motion.object_contact))
    if file is not None:
        console.print(f"with {file}", soft_wrap=True, highlight=False)
    console.print(f"{folder}", soft_wrap=True, highlight=False)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
