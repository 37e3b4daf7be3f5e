"""Runs a study: trains what is missing, evaluates all of it, and writes a report with tables and figures.

    hdmi study [list]
    hdmi study study=NAME [tasks=[NAME,...]] [seeds=3] [total_frames=1000000] [jobs=2] [variants=[NAME,...]] ...
    hdmi study report study=NAME ...

A study is a file in conf/study: variants of a training (ablations, levers), tasks, seeds, a budget, which terminations
count in its evaluations, and figures. Trainings run `jobs` at a time in `runs`/<task>/<variant>_seed<n>, which studies
share; one that is there is not trained again, one that was interrupted continues, so that the same command goes on
until all is there. The report goes into `out`: report.md, runs.csv with a line for each run, curves.csv with one for
each evaluation on the way, figures as PNG and PDF. `report` writes it from what is there, without training. Lines of an
earlier report in `out` whose run folders are elsewhere stay, and are not trained again: a study can be spread over
machines.

On a cluster: `hdmi study list study=NAME` prints the command of each training, for `hdmi train` under any launcher;
`report` reads the folders.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from hdmi.commands.options import parse_options
from hdmi.commands.script import run_script
from hdmi.config import ConfigError
from hdmi.studies import Study, read_study, run_study, study_files, write_report
from hdmi.studies.plan import subset


@dataclass
class Options:
    """See the module."""

    study: str | None = None  # a name in conf/study, or a .yaml file
    tasks: list[str] | None = None
    variants: list[str] | None = None
    seeds: int | None = None
    total_frames: int | None = None
    points: int | None = None  # evaluations of each training
    num_envs: int | None = None  # episodes of an evaluation
    jobs: int = 2
    runs: str = "runs/studies"
    out: str | None = None  # runs/studies/<study>


def listed() -> Table:
    """The studies of conf/study."""
    table = Table("study", "what it asks", "variants", "tasks", "seeds", "frames")
    for name in study_files():
        study = read_study(name)
        table.add_row(
            name, study.title, str(len(study.variants)), str(len(study.tasks)), str(study.seeds),
            f"{study.total_frames / 1e6:g} M",
        )  # fmt: skip
    return table


def command(arguments: list[str], console: Console) -> int:
    """Runs a study, lists studies or trainings, or writes a report."""
    words = [argument for argument in arguments if "=" not in argument]
    options = parse_options(Options, [argument for argument in arguments if "=" in argument])
    if len(words) > 1 or not set(words) <= {"list", "report"}:
        raise ConfigError(f"there is no command {' '.join(words)!r}; there is list, report, or none to run a study")
    if options.jobs < 1:
        raise ConfigError(f"jobs: expected at least 1, got {options.jobs}")
    if options.study is None:
        if words == ["report"] or arguments not in ([], ["list"]):
            raise ConfigError(f"give study=NAME; there is {', '.join(study_files())}")
        console.print(listed())
        return 0
    study = read_study(
        options.study, tasks=options.tasks, seeds=options.seeds, total_frames=options.total_frames,
        points=options.points, num_envs=options.num_envs,
    )  # fmt: skip
    if options.variants is not None:
        study = subset(study, options.variants)
    runs = Path(options.runs)
    folder = Path(options.out) if options.out is not None else runs / study.name

    def say(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True, markup=False)

    if words == ["list"]:
        for line in commands_of(study, runs):
            say(line)
        return 0
    problems = {} if words else run_study(study, runs, folder, options.jobs, say)
    say(str(write_report(study, runs, folder, say)))
    return int(bool(problems))


def commands_of(study: Study, runs: Path) -> list[str]:
    """What trains each run of a study in its folder, as lines for a shell; not those on recorded motions."""
    lines = []
    for job in study.jobs:
        if job.variant.reference is None:
            run = runs / job.name
            place = [f"output_dir={run.parent}", f"run_name={run.name}"]
            lines.append(shlex.join(["hdmi", "train", *job.arguments, *place]))
    return lines


def main(arguments: list[str]) -> int:
    """Runs the script; returns its exit status."""
    return run_script(command, arguments, __doc__, errors=(RuntimeError,))
