"""Mends a reference's geometry: planted feet, contacts, and the object on its support (extra `retarget`).

    hdmi repair PATH [task=NAME] [out=FOLDER] [press=0.01] [config_dir=FOLDER]

PATH is a motion's folder. `task` describes the robot, the object, the scenery and the end effectors: the task whose
motion has the folder's name, if not given; `task=none` mends the feet of a robot alone; `config_dir` adds the tasks of
its folder `task`. Planted feet get one place each on what they stand on, end effectors are `press` metres inside the
object at their contact points while contact is labelled, the object stands on its support where it rests, and all else
stays near the reference. Joints that the task holds at the default pose are there. Labels stay as they are.

The result goes to `out`, PATH with `_repaired` if not given, which must not exist; what the validator says of both is
shown side by side. The exit status is 0, 1 if a check is worse than before, 2 for wrong arguments or files.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from hdmi.assembly import contact_tolerance, scene_parts
from hdmi.commands.options import parse_motion_options
from hdmi.commands.script import run_script
from hdmi.config import ConfigError, task_config
from hdmi.motion import load_motion, save_motion
from hdmi.workshop.repair import Comparison, repair_motion
from hdmi.workshop.validate import validate_motion


@dataclass
class Options:
    """See the module."""

    task: str | None = None
    out: str | None = None
    press: float = 0.01
    config_dir: str | None = None


def repair(arguments: list[str], console: Console) -> int:
    """Repairs a motion, writes it, and shows both reports."""
    path, options = parse_motion_options(Options, arguments)
    if not 0 <= options.press <= 0.05:
        raise ConfigError(f"press: expected 0 to 0.05 m, got {options.press:g}")
    motion = load_motion(path)
    out = Path(options.out) if options.out else path.resolve().with_name(f"{motion.name}_repaired")
    if out.exists():
        raise ConfigError(f"out: {out} exists; name a folder that does not")
    parts: dict[str, Any] = {}
    if options.task != "none":
        cfg = task_config(options.task or motion.name, config_dir=options.config_dir)
        parts = scene_parts(cfg) | contact_tolerance(cfg)
    before = validate_motion(motion, **parts)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task(motion.name, total=None)
        repaired = repair_motion(
            motion,
            **parts,
            press=options.press,
            on_frame=lambda done, total: progress.update(bar, total=total, completed=done),
        )
    comparison = Comparison(before, validate_motion(repaired.motion, **parts))
    folder = save_motion(repaired.motion, out)
    console.print(comparison.table())
    stands = ", ".join(f"{foot} {100 * share:.0f} %" for foot, share in repaired.planted.items())
    console.print(f"planted, of all frames: {stands}", soft_wrap=True, highlight=False)
    if repaired.unsolved:
        console.print(f"frames without a solution: {', '.join(map(str, repaired.unsolved))}", soft_wrap=True)
    for reason in comparison.worse:
        console.print(f"worse: {reason}", soft_wrap=True, highlight=False)
    print(folder)
    return 1 if comparison.worse else 0


def main(arguments: list[str]) -> int:
    """Runs the script; returns its exit status."""
    return run_script(repair, arguments, __doc__)
