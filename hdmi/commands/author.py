"""Makes a reference motion from a plan of keyframes, without any recording.

    hdmi author task=NAME [plan=FILE] [out=FOLDER] [config_dir=FOLDER]

The plan is the one that ships for the task unless `plan` names a file; what it may hold is in docs/authoring.md and
hdmi/workshop/author/plan.py. Object, scenery and end effectors are the task's, which `config_dir`/task may have instead
of conf/task. The motion is written to `out`/<plan's name>, `motions` if absent, so that `hdmi train task=NAME
motion_root=motions` trains on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from hdmi.assembly import scene_parts
from hdmi.commands.options import parse_options
from hdmi.commands.script import run_script
from hdmi.config import ConfigError, task_config
from hdmi.motion import save_motion
from hdmi.workshop.author import Authored, author_motion, find_plan, load_plan


@dataclass
class Options:
    """See the module."""

    task: str | None = None
    plan: str | None = None
    out: str = "motions"
    config_dir: str | None = None


def author(options: Options, console: Console) -> tuple[Authored, Path]:
    """Solves the plan and writes the motion; returns what came out and its folder."""
    if options.task is None:
        raise ConfigError("give task=NAME")
    parts = scene_parts(task_config(options.task, config_dir=options.config_dir))
    plan = load_plan(options.plan or find_plan(options.task))
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task(plan.name, total=None)
        authored = author_motion(
            plan,
            parts["object"],
            parts["scenery"],
            parts["effectors"],
            parts["robot"],
            on_frame=lambda frame, count: progress.update(bar, total=count, completed=frame + 1),
        )
    return authored, save_motion(authored.motion, Path(options.out) / plan.name)


def table(authored: Authored) -> Table:
    """How well the plan came out."""
    motion = authored.motion
    out = Table(
        title=f"{motion.name}: {motion.num_frames} frames, {motion.num_frames / motion.fps:.1f} s", title_justify="left"
    )
    out.add_column("what")
    out.add_column("figure", justify="right")
    for name, miss in authored.misses.items():
        out.add_row(f"{name}: furthest from the plan", f"{1000 * miss:.1f} mm")
    out.add_row("centre of pressure: from the planned one, 95th percentile", f"{1000 * authored.pressure_error:.0f} mm")
    out.add_row("fastest joint, of its limit", f"{100 * authored.speed:.0f} %")
    out.add_row("frames in which inverse kinematics did not settle", str(authored.unsettled))
    if motion.object_contact is not None:
        out.add_row("frames in contact, by end effector", ", ".join(map(str, motion.object_contact.sum(0))))
    return out


def show(arguments: list[str], console: Console) -> int:
    """Solves the plan, and shows how well it came out."""
    authored, folder = author(parse_options(Options, arguments), console)
    console.print(table(authored))
    print(folder)
    return 0


def main(arguments: list[str]) -> int:
    """Runs the script; returns its exit status."""
    return run_script(show, arguments, __doc__)
