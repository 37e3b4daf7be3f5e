"""Says whether a motion is worth training on: good, usable or bad, why, and in which frames.

    hdmi validate PATH [task=NAME] [config_dir=FOLDER] [--json]

PATH is a motion's folder. `task` describes the object, the scenery and the end effectors; without it the task whose
motion has the folder's name is taken, and `task=none` looks at the robot alone; `config_dir` adds the tasks of its
folder `task`. `--json` prints the report as JSON.
The exit status is 0 for a good or usable motion, 1 for a bad one or one that cannot be read, 2 for wrong arguments.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from hdmi.assembly import contact_tolerance, scene_parts
from hdmi.commands.options import parse_motion_options
from hdmi.commands.script import run_script
from hdmi.config import task_config, task_files
from hdmi.motion import MotionError, load_motion
from hdmi.workshop.validate import Report, unreadable, validate_motion


@dataclass
class Options:
    """See the module."""

    task: str | None = None
    config_dir: str | None = None


def report_on(path: Path, task: str | None, config_dir: str | None = None) -> Report:
    """Validates the motion in a folder in the scene of a task."""
    if not path.is_dir():
        raise MotionError(f"{path}: no such folder; a motion is a folder with motion.npz and meta.json")
    name = path.resolve().name
    if task is None:
        task = name if name in task_files(config_dir) else "none"
    parts = {}
    if task != "none":
        cfg = task_config(task, config_dir=config_dir)
        parts = scene_parts(cfg) | contact_tolerance(cfg)
    try:
        motion = load_motion(path)
    except MotionError as error:
        return unreadable(name, error)
    return validate_motion(motion, **parts)


def validate(arguments: list[str], console: Console) -> int:
    """Shows the report on a motion."""
    path, options = parse_motion_options(Options, [argument for argument in arguments if argument != "--json"])
    report = report_on(path, options.task, options.config_dir)
    if "--json" in arguments:
        print(report.to_json())
    else:
        report.print(console)
    return 0 if report.verdict != "bad" else 1


def main(arguments: list[str]) -> int:
    """Runs the script; returns its exit status."""
    return run_script(validate, arguments, __doc__)
