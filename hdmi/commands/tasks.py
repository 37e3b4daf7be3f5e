"""Lists the tasks, checks them, renders a picture of each, trains policies of them, or evaluates those of a zoo.

    hdmi tasks [motion_root=FOLDER] [config_dir=FOLDER]
    hdmi tasks check [NAME ...] [frames=65536] [num_envs=128] [jobs=2] [motion_root=FOLDER] ...
    hdmi tasks gallery [NAME ...] [out=docs/images/tasks] [motion_root=FOLDER] ...
    hdmi tasks train [POLICY ...] [jobs=2] [recipes=zoo/recipes.yaml] [runs=runs/zoo] [zoo=zoo] [extra=[KEY=VALUE,...]]
    hdmi tasks zoo [POLICY ...] [jobs=2] [num_envs=256] [seed=0] [zoo=zoo] [markdown=FILE.md] [sheet=FILE.jpg]

References are those that ship with the package, or those under `motion_root`. `config_dir` adds the tasks of its folder
`task`. `check` builds each task, replays its reference to see whether end effectors meet the object where labels say,
follows it without a policy and trains for `frames` control steps (0: does not), which has to improve the return of the
policy with its exploration noise, if need be in a second training of twice as many; `jobs` tasks at a time on one
processor each. Its exit status is 1 if a task fails. Without names it checks all tasks, with `motion_root` those that
have a motion there. `gallery` renders each reference at mid-contact.

`train` trains what `recipes` names, each with its line of arguments of `hdmi train` and those of `extra`; a run that is
in `runs` is continued. What is better than the policy in `zoo` (success, then survival) replaces it, exported with
evaluations, curve, video and card. `zoo` evaluates the policies there and prints one table, which `markdown` gets,
too; `sheet` is a picture of all of them, from their videos.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console

from hdmi.assembly import make_task, scene_parts
from hdmi.commands.options import parse_options
from hdmi.commands.script import run_script
from hdmi.config import ConfigError, task_config, task_files
from hdmi.learning.checkpoint import CheckpointError
from hdmi.motion import MotionError
from hdmi.tasks.catalogue import list_tasks, sources
from hdmi.tasks.check import TaskCheck, check_table, check_task
from hdmi.tasks.gallery import render_reference
from hdmi.tasks.training import train_zoo
from hdmi.tasks.zoo import Entry, evaluate_entry, policies, read_recipes, render_sheet, zoo_markdown, zoo_table
from hdmi.threads import share_of_processors


@dataclass
class Options:
    """See the module."""

    motion_root: str | None = None
    config_dir: str | None = None
    frames: int = 65_536
    num_envs: int | None = None  # 128 of a check, 256 of an evaluation
    jobs: int = 2
    out: str = "docs/images/tasks"
    zoo: str = "zoo"
    recipes: str | None = None  # recipes.yaml in `zoo`
    runs: str = "runs/zoo"
    extra: list[str] = field(default_factory=list)
    seed: int = 0
    markdown: str | None = None
    sheet: str | None = None


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
        options_of = (options.motion_root, options.frames, options.num_envs or 128, 1, options.config_dir)
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


def train(names: list[str], options: Options, console: Console) -> int:
    """Trains policies of a zoo; fails if one of the trainings does."""
    recipes = read_recipes(options.recipes or Path(options.zoo) / "recipes.yaml")
    if unknown := [name for name in names if name not in recipes]:
        raise ConfigError(f"no recipe for {', '.join(unknown)}; there is {', '.join(recipes)}")
    wanted = {name: recipes[name] for name in names or recipes}

    def say(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True, markup=False)

    episodes = options.num_envs or 256
    outcomes = train_zoo(wanted, options.runs, options.zoo, options.jobs, episodes, options.extra, say)
    return int(any(outcome.problem for outcome in outcomes))


def zoo(names: list[str], options: Options, console: Console) -> int:
    """Evaluates the policies of a zoo; fails if one of them cannot be."""
    there = policies(options.zoo)
    if unknown := [name for name in names if name not in there]:
        raise ConfigError(f"{options.zoo} has no {', '.join(unknown)}; there is {', '.join(there)}")
    names = names or there
    entries: dict[str, Entry] = {}
    problems: list[str] = []
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(options.jobs, len(names)), spawn, initializer=_quiet) as pool:
        threads = share_of_processors(options.jobs)
        options_of = (options.num_envs or 256, options.seed, threads)
        futures = {pool.submit(evaluate_entry, options.zoo, name, *options_of): name for name in names}
        for future in as_completed(futures):
            name = futures[future]
            try:
                entries[name] = future.result()
            except (MotionError, CheckpointError, ConfigError) as error:
                problems.append(f"{name}: {error}")
            console.print(f"{len(entries) + len(problems)}/{len(names)} {name}", highlight=False)
    found = [entries[name] for name in names if name in entries]
    for problem in problems:
        console.print(problem, highlight=False, soft_wrap=True, markup=False)
    if not found:
        return 1
    console.print(zoo_table(found))
    if options.markdown is not None:
        folder = os.path.relpath(options.zoo, Path(options.markdown).parent)
        Path(options.markdown).write_text(zoo_markdown(found, Path(folder).as_posix()), encoding="utf-8")
    if options.sheet is not None:
        console.print(str(render_sheet(options.zoo, [entry.name for entry in found], options.sheet)), soft_wrap=True)
    return int(bool(problems))


def command(arguments: list[str], console: Console) -> int:
    """Runs the command that the arguments name, or lists the tasks."""
    words = [argument for argument in arguments if "=" not in argument]
    options = parse_options(Options, [argument for argument in arguments if "=" in argument])
    for key in ("num_envs", "jobs"):
        if (value := getattr(options, key)) is not None and value < 1:
            raise ConfigError(f"{key}: expected at least 1, got {value}")
    if not words:
        console.print(list_tasks(options.motion_root, options.config_dir))
        return 0
    commands = {"check": check, "gallery": gallery, "train": train, "zoo": zoo}
    if words[0] not in commands:
        raise ConfigError(f"there is no command {words[0]!r}; there is {', '.join(commands)}")
    return commands[words[0]](words[1:], options, console)


def main(arguments: list[str]) -> int:
    """Runs the script; returns its exit status."""
    return run_script(command, arguments, __doc__, width=200, errors=(RuntimeError,))
