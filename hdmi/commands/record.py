"""Records a policy's rollout as a reference motion to train on: a "perfect" reference.

    hdmi record checkpoint=RUN out=FOLDER [seed=0] [motion_root=FOLDER] [targets=false] [points=touch]

`checkpoint` is a run folder (its newest checkpoint counts), a checkpoint file, or an exported policy. The policy plays
its whole motion with mean actions in the nominal world: no randomization, no noise, no delay, no aids. The rollout goes
to `out`, which must not exist, under the names of the motion that was tracked, so that its task trains on it; contact
is labelled where effectors felt a force, and contact points are where they felt it, or with `points=effector` where the
effectors' own points were, which is what rewards compare. `targets=true` adds where the policy sent the servos, which
`lever/feedforward` then starts from. `motion_root` is where the motion to track is, instead of the training's.

What the validator says of the recording is shown. The exit status is 0, 1 for a bad motion, 2 for mistakes and for a
policy that fails, of which nothing is written.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig
from rich.console import Console

from hdmi.assembly import contact_tolerance, scene_parts
from hdmi.commands.options import parse_options
from hdmi.commands.script import run_script
from hdmi.config import ConfigError
from hdmi.evaluation.protocol import load_checked_policy
from hdmi.motion import load_motion, save_motion
from hdmi.workshop.recording import record_motion
from hdmi.workshop.validate import validate_motion


@dataclass
class Options:
    """See the module."""

    checkpoint: str | None = None
    out: str | None = None
    seed: int = 0
    motion_root: str | None = None
    targets: bool = False
    points: str = "touch"


def record(arguments: list[str], console: Console) -> int:
    """Records a motion, writes it, and shows what the validator says of it."""
    options = parse_options(Options, arguments)
    if options.checkpoint is None or options.out is None:
        raise ConfigError("give checkpoint=RUN and out=FOLDER")
    out = Path(options.out)
    if out.exists():
        raise ConfigError(f"out: {out} exists; name a folder that does not")
    policy, cfg, info = load_checked_policy(options.checkpoint)
    cfg.motion_root = options.motion_root or cfg.motion_root
    try:
        motion = record_motion(policy, cfg, out.resolve().name, options.seed, options.targets, options.points)
    except ConfigError as error:
        raise ConfigError(f"{info['file']}: {error}") from error
    save_motion(motion, out)
    return show(out, cfg, console)


def show(folder: Path, cfg: DictConfig, console: Console) -> int:
    """Validates the motion that was written in the scene of a config, and says how to train on it."""
    try:
        report = validate_motion(load_motion(folder), **scene_parts(cfg), **contact_tolerance(cfg))
        report.print(console)
        verdict = report.verdict
    except ConfigError as error:  # of another robot than the validator has limits for
        console.print(f"not validated: {error}", soft_wrap=True, highlight=False)
        verdict = "usable"
    place = folder.resolve()
    train = f"hdmi train task={cfg.task.name} task.motion={place.name} motion_root={place.parent}"
    console.print(f"to train on it: {train}", soft_wrap=True, highlight=False)
    print(folder)
    return 0 if verdict != "bad" else 1


def main(arguments: list[str]) -> int:
    """Runs the script; returns its exit status."""
    return run_script(record, arguments, __doc__)
