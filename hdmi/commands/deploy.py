"""Runs an exported policy on a robot, real or simulated, without the trainer: needs neither torch nor hydra.

    hdmi deploy policy=FOLDER robot=mujoco [episodes=50] [log=FILE.npz] [plot=FILE.png] ...
    hdmi deploy policy=FOLDER robot=unitree interface=eth0 log=FILE.npz  # keys: s start, r run, h hold, space damping
    hdmi deploy policy=FOLDER replay=FILE.npz [plot=FILE.png]         # the graph over logged sensors

Instead of a folder, FILE.yaml: what describes a network of others, or that of `hdmi export` in the same words.

With `episodes`, a simulated robot begins each episode at the perturbed first frame, and a table shows success, errors
and timing. Without, the run goes through all states: damping, to the start, run, hold, damping; by itself if
auto=true, else as keys, a gamepad or the robot's remote control ask for. It always ends in damping.

{options}
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from hdmi.commands.deployed import run_deployed
from hdmi.commands.options import parse_parts, shown_help
from hdmi.deploy import runner, safety
from hdmi.deploy.controls import Controls, Gamepad, Keyboard
from hdmi.deploy.description import PolicyError
from hdmi.deploy.log import read_log, replay
from hdmi.deploy.policy import Policy
from hdmi.deploy.trial import read_reference
from hdmi.errors import ConfigError

# Modules of hdmi.deploy.robots.
ROBOTS = ("mujoco", "unitree")
YAML = (".yaml", ".yml")  # of descriptions
TOLERANCE = 1e-4  # rad that a replayed target may be off: another machine, another rounding


@dataclass
class Options:
    """See the module."""

    policy: str | None = None  # folder of policy.onnx, or the file; or a YAML that describes a network
    robot: str | None = None
    episodes: int = 0  # of a simulated robot
    replay: str | None = None  # a log
    log: str | None = None  # file to write
    plot: str | None = None  # picture to write
    keys: bool = True  # of the terminal, if there is one
    gamepad: str | None = None  # its device, such as /dev/input/js0


def _module(name: str) -> Any:
    if name not in ROBOTS:
        raise ConfigError(f"robot: expected one of {', '.join(ROBOTS)}, got {name!r}")
    return import_module(f"hdmi.deploy.robots.{name}")


def _parse(arguments: Sequence[str]) -> tuple[Options, dict[type, Any], Any]:
    """The command's options, those of each part by its class, and the robot's module."""
    chosen = [argument.partition("=")[2] for argument in arguments if argument.startswith("robot=")]
    module = _module(chosen[-1]) if chosen else None
    parts = [Options, runner.Options, safety.Limits] + ([] if module is None else [module.Options])
    values = parse_parts(parts, arguments)
    return values[Options], values, module


def run(arguments: list[str], console: Console) -> int:
    """Does what the options ask for; returns the exit status."""
    options, values, module = _parse(arguments)
    if options.policy is None:
        raise ConfigError("give policy=FOLDER, that of an exported policy.onnx, or policy=FILE.yaml")
    policy = _policy(options.policy)
    if options.replay is not None:
        return _replay(options, policy, console)
    if module is None:
        raise ConfigError(f"give robot=NAME, one of {', '.join(ROBOTS)}, or replay=LOG")
    files = policy.scene if policy.path.suffix in YAML else policy.path.parent
    robot = module.connect(policy.description, files, values[module.Options])
    try:
        if options.episodes > 0:
            return _episodes(options, values, policy, robot, console)
        return _drive(options, values, policy, robot, console)
    finally:
        robot.close()


def _policy(path: str) -> Any:
    """An exported policy, or what a YAML describes, which has its interface."""
    if not path.endswith(YAML):
        return Policy(path)
    from hdmi.deploy.foreign.policy import ForeignPolicy  # needs PyYAML

    return ForeignPolicy(path)


def _reference(policy: Any) -> dict[str, np.ndarray]:
    """The policy's motion."""
    return policy.reference if policy.path.suffix in YAML else read_reference(policy.path.parent, policy.description)


def _drive(options: Options, values: dict[type, Any], policy: Policy, robot: Any, console: Console) -> int:
    """One run through all states."""
    controls: list[Controls] = []
    try:
        if options.gamepad is not None:
            controls.append(Gamepad(options.gamepad))
        if options.keys and (keyboard := Keyboard()).active:
            controls.append(keyboard)
        how, limits = values[runner.Options], values[safety.Limits]
        if not how.auto and not controls:
            print("no terminal and no gamepad: only the robot's remote control can ask for states", file=sys.stderr)
        drive = runner.Runner(policy, robot, how, limits, controls, say=lambda text: console.print(text, markup=False))
        drive.run(log=options.log)
    finally:
        for source in controls:
            source.close()
        for remark in robot.remarks():
            print(remark, file=sys.stderr)
    console.print(_counts(drive), markup=False)
    _finish(options, drive, policy)
    if drive.failure is not None:
        print(f"ended in damping: {drive.failure}", file=sys.stderr)
    return 0 if drive.failure is None else 130 if drive.failure == "interrupted" else 1


def _episodes(options: Options, values: dict[type, Any], policy: Policy, robot: Any, console: Console) -> int:
    """Episodes of a simulated robot, and their figures; log and plot are of the last."""
    from hdmi.deploy.robots.mujoco import MujocoRobot
    from hdmi.deploy.trial import Judge, Result

    if not isinstance(robot, MujocoRobot):
        raise ConfigError(f"episodes: only of robot=mujoco, which can be put back to the start, not of {options.robot}")
    judge = Judge(robot, _reference(policy))
    results = []
    how = replace(values[runner.Options], hold=0.0)
    for episode in range(options.episodes):
        robot.reset(episode)
        judge.start()
        drive = runner.Runner(policy, robot, how, values[safety.Limits], watch=judge)
        drive.run(runner.State.RUN, options.log if episode == options.episodes - 1 else None)
        ms = np.array([row["ms"] for row in drive.log.rows])
        results.append(Result(drive.failure, judge.frames, judge.means(), ms, vars(drive.guard.counts)))
        if drive.failure == "interrupted":
            return 130
    about = policy.description
    console.print(f"{about.task}: {len(results)} episodes of {about.num_frames - 1} steps in MuJoCo", markup=False)
    console.print(results_table(results, policy))
    checked, unchecked = (", ".join(names) or "none" for names in (about.terminations, about.unchecked))
    console.print(f"terminations: {checked}; not checked: {unchecked}", markup=False)
    _finish(options, drive, policy)
    return 0


def results_table(results: list[Any], policy: Policy) -> Table:
    """Figures of episodes."""
    from hdmi.deploy.trial import UNITS, summarize

    description = policy.description
    table = Table()
    table.add_column("figure")
    table.add_column("mean", justify="right")
    table.add_column("unit")
    for name, value in summarize(results, description.num_frames).items():
        unit = UNITS[name]
        table.add_row(name, f"{value * 100:.1f}" if unit == "%" else f"{value:.3g}", unit)
    table.add_section()
    failures = [result.failure for result in results if result.failure is not None]
    for failure in sorted(set(failures)):
        frames = [result.frames for result in results if result.failure == failure]
        share = 100 * failures.count(failure) / len(results)
        table.add_row(f"failed by {failure}", f"{share:.1f}", f"%, median frame {np.median(frames):g}")
    return table


def _counts(drive: Any) -> str:
    if not drive.log.rows:
        return "no ticks"
    ms = np.array([row["ms"] for row in drive.log.rows])
    counts = ", ".join(f"{name} {count}" for name, count in vars(drive.guard.counts).items())
    return f"{len(ms)} ticks, {ms.mean():.2f} ms each (99 %: {np.percentile(ms, 99):.2f}); {counts}"


def _finish(options: Options, drive: Any, policy: Policy) -> None:
    if options.log is not None:
        print(options.log)
    if options.plot is not None:
        from hdmi.deploy.plots import plot_log

        header = drive.log.header | {"events": drive.log.events}
        print(plot_log(header, drive.log.arrays(), policy.description, options.plot, _shown_reference(policy)))


def _shown_reference(policy: Policy) -> dict[str, np.ndarray] | None:
    """The motion to draw, if it is there."""
    try:
        return _reference(policy)
    except PolicyError:
        return None


def _replay(options: Options, policy: Policy, console: Console) -> int:
    """The graph over a log's sensors."""
    assert options.replay is not None
    header, arrays = read_log(options.replay)
    if header.get("policy") != policy.digest:
        print(f"{options.replay}: is of another policy, {header.get('policy')}", file=sys.stderr)
    differences = replay(arrays, policy)
    console.print(f"{len(differences)} ticks replayed; targets differ by at most {differences.max():.2e} rad")
    if options.plot is not None:
        from hdmi.deploy.plots import plot_log

        print(plot_log(header, arrays, policy.description, options.plot, _shown_reference(policy)))
    if differences.max() > TOLERANCE:
        print(f"that is more than {TOLERANCE:g} rad: not what the policy has done", file=sys.stderr)
        return 1
    return 0


def _help() -> str:
    """The module's text, with the options of runner, limits and robots."""
    robots = {f"robot={name}": _module(name).Options for name in ROBOTS}
    return shown_help(__doc__, {"runner": runner.Options, "limits": safety.Limits} | robots)


def main(arguments: list[str]) -> int:
    """Runs the command; returns its exit status: 2 after a mistake, 1 when the run failed, 130 when interrupted."""
    return run_deployed(run, arguments, _help)
