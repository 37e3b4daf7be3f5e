"""Brings in networks of others: writes the YAML that describes one, checks it, writes the scene and motion of a task.

    hdmi foreign network=FILE.onnx out=policy.yaml [scene=FILE.xml] [motion=FOLDER] [object=NAME] ...
    hdmi foreign network=FILE.yaml out=policy.yaml ...    # of HDMI's authors, with FILE.onnx and FILE.json beside it
    hdmi foreign policy=policy.yaml [most=3]              # each term beside the network's own mean and deviation
    hdmi foreign task=NAME out=FOLDER [motion_root=FOLDER] [config_dir=FOLDER]    # scene.xml and motion/ of a task

A YAML is written from what the files say: metadata of mjlab or BeyondMimic, or the authors' yaml and json; what has no
equivalent is refused by its name. `hdmi deploy policy=policy.yaml robot=mujoco episodes=50` then runs it, and
`hdmi evaluate policy=policy.yaml task=NAME` under the trainer's protocol. The exit status of a check is 1 if a term is
more than `most` of the network's deviations off. Only task= needs the trainer.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console

from hdmi.commands.deployed import run_deployed
from hdmi.commands.options import parse_options
from hdmi.deploy.foreign.check import check_table, check_terms
from hdmi.deploy.foreign.policy import ForeignPolicy
from hdmi.deploy.foreign.readers import read_foreign
from hdmi.deploy.foreign.schema import NETWORK, write_spec
from hdmi.errors import ConfigError


@dataclass
class Options:
    """See the module."""

    network: str | None = None
    policy: str | None = None
    task: str | None = None
    out: str | None = None
    most: float = 3.0
    scene: str = "scene.xml"  # beside `out`, or a path
    motion: str | None = None  # folder; the network's own if it has one
    object: str | None = None  # its body in the motion
    object_joint: str | None = None
    contact_bodies: list[str] = field(default_factory=list)  # of the motion's contact labels
    motion_root: str | None = None
    config_dir: str | None = None


def run(arguments: list[str], console: Console) -> int:
    """Does what the options ask for; returns the exit status."""
    options = parse_options(Options, arguments)
    if [options.network, options.policy, options.task].count(None) != 2:
        raise ConfigError("give one of network=FILE, policy=FILE.yaml and task=NAME")
    if options.policy is not None:
        return check(options, console)
    if options.out is None:
        raise ConfigError("give out=FILE.yaml to write" if options.network else "give out=FOLDER to write to")
    print(write(options) if options.network else write_task(options))
    return 0


def write(options: Options) -> Path:
    """Writes the description of a network."""
    out, values = Path(str(options.out)), read_foreign(str(options.network))
    if options.motion is None and values.get("motion") != NETWORK:
        raise ConfigError(f"give motion=FOLDER: {options.network} has no motion of its own")
    out.parent.mkdir(parents=True, exist_ok=True)

    def beside(path: str) -> str:
        return os.path.relpath(path, out.parent)

    values["network"] = beside(values["network"])
    values["scene"] = options.scene if options.scene == "scene.xml" else beside(options.scene)
    if options.motion is not None:
        values["motion"] = beside(options.motion)
    more = {name: getattr(options, name) for name in ("object", "object_joint", "contact_bodies")}
    return write_spec(values | {name: value for name, value in more.items() if value}, out)


def check(options: Options, console: Console) -> int:
    """Shows the terms; 1 if one is off."""
    assert options.policy is not None
    checks = check_terms(ForeignPolicy(options.policy))
    console.print(check_table(checks, options.most))
    known = [found.off for found in checks if found.off is not None]
    if not known:
        print("the network carries no means and deviations that could be found: nothing to compare with")
    if wrong := [c.term for c in checks if c.off is not None and c.off.max() > options.most]:
        print(f"more than {options.most:g} deviations off: {', '.join(wrong)}", file=sys.stderr)
    return 1 if wrong else 0


def write_task(options: Options) -> Path:
    """Writes scene and motion of a task."""
    from hdmi.assembly import make_task  # torch and hydra, which nothing else here needs
    from hdmi.config import task_config
    from hdmi.deploy.foreign.own import write_task_files
    from hdmi.motion import MotionError

    try:
        task = make_task(task_config(str(options.task), options.motion_root, options.config_dir))
    except MotionError as error:
        raise ConfigError(str(error)) from error
    return write_task_files(task, str(options.out))


def main(arguments: list[str]) -> int:
    """Runs the command; returns its exit status: 2 after a mistake."""
    return run_deployed(run, arguments, lambda: str(__doc__))
