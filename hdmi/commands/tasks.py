"""Lists the tasks, checks them, or renders a picture of each.

    hdmi tasks [motion_root=FOLDER] [config_dir=FOLDER]
    hdmi tasks check [NAME ...] [frames=65536] [num_envs=128] [jobs=2] [motion_root=FOLDER] ...
    hdmi tasks gallery [NAME ...] [out=docs/images/tasks] [motion_root=FOLDER] ...

References are those that ship with the package, or those under `motion_root`. `config_dir` adds the tasks of its folder
`task`. `check` builds each task, replays its reference to see whether end effectors meet the object where labels say,
follows it without a policy and trains for `frames` control steps (0: does not), which has to improve the return of the
policy with its exploration noise, if need be in a second training of twice as many; `jobs` tasks at a time on one
processor each. Its exit status is 1 if a task fails. Without names it checks all tasks, with `motion_root` those that
have a motion there. `gallery` renders each reference at mid-contact.
"""

from __future__ import annotations

import logging
import multiprocessing
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from hdmi.assembly import make_task, scene_parts
from hdmi.commands.options import parse_options
from hdmi.commands.script import run_script
from hdmi.config import ConfigError, task_config, task_files
from hdmi.motion import MotionError
from hdmi.tasks.catalogue import list_tasks, sources
from hdmi.tasks.check import TaskCheck, check_table, check_task
from hdmi.tasks.gallery import render_reference


@dataclass
class Options:
    """See the module."""

    motion_root: str | None = None
    config_dir: str | None = None
    frames: int = 65_536
    num_envs: int = 128
    jobs: int = 2
    out: str = "docs/images/tasks"


def chosen(names: list[str], motion_root: str | None, config_dir: str | None) -> list[str]:
    """The named tasks; without names all of them, or those with a motion under `motion_root`."""
    if names or motion_root is None:
        return names or list(task_files(config_dir))
    configs = {name: task_config(name, motion_root, config_dir) for name in task_files(config_dir)}
    return [name for name, cfg in configs.items() if "motion_root" in sources(cfg, motion_root)]


def check(names: list[str], options: Options, console: Console) -> int:
    """Checks tasks; those whose motion cannot be used fail, too."""
    names = chosen(names, options.motion_root, options.config_dir)
    if not names:
        raise ConfigError(f"motion_root: no task has its motion under {options.motion_root}")
    for name in names:  # before others have trained
        scene_parts(task_config(name, options.motion_root, options.config_dir))
    checks: dict[str, TaskCheck] = {}
    spawn = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
    with ProcessPoolExecutor(min(options.jobs, len(names)), spawn, initializer=_quiet) as pool:
        options_of = (options.motion_root, options.frames, options.num_envs, 1, options.config_dir)
        futures = {pool.submit(check_task, name, *options_of): name for name in names}
        for future in as_completed(futures):
            name = futures[future]
            try:
                checks[name] = future.result()
            except MotionError as error:
                checks[name] = TaskCheck(name, problems=[str(error)])
            verdict = "failed" if checks[name].problems else "passed"
            console.print(f"{len(checks)}/{len(names)} {name} {verdict}, {checks[name].seconds:.0f} s", highlight=False)
    console.print(check_table([checks[name] for name in names]))
    return int(any(check.problems for check in checks.values()))


def _quiet() -> None:
    """In a worker: TorchRL's reports of specs that are right."""
    logging.getLogger("torchrl").setLevel(logging.WARNING)


def gallery(names: list[str], options: Options, console: Console) -> int:
    """Renders pictures of tasks."""
    for name in chosen(names, options.motion_root, options.config_dir):
        try:
            task = make_task(task_config(name, options.motion_root, options.config_dir))
        except MotionError as error:
            if names:
                raise
            console.print(f"{name}: {error}", soft_wrap=True)
            continue
        console.print(str(render_reference(task, Path(options.out) / f"{name}.jpg")), soft_wrap=True)
    return 0


def command(arguments: list[str], console: Console) -> int:
    """Runs the command that the arguments name, or lists the tasks."""
    words = [argument for argument in arguments if "=" not in argument]
    options = parse_options(Options, [argument for argument in arguments if "=" in argument])
    for key in ("num_envs", "jobs"):
        if getattr(options, key) < 1:
            raise ConfigError(f"{key}: expected at least 1, got {getattr(options, key)}")
    if not words:
        console.print(list_tasks(options.motion_root, options.config_dir))
        return 0
    commands = {"check": check, "gallery": gallery}
    if words[0] not in commands:
        raise ConfigError(f"there is no command {words[0]!r}; there is {', '.join(commands)}")
    return commands[words[0]](words[1:], options, console)


def main(arguments: list[str]) -> int:
    """Runs the script; returns its exit status."""
    return run_script(command, arguments, __doc__, width=200, errors=(RuntimeError,))
