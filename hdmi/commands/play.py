"""Plays a policy, or an agent that needs none, and writes a video or opens a window.

    hdmi play checkpoint=RUN [start=FRAME] [out=play.mp4] [window=true]
    hdmi play agent=zero|random|reference [task=lift_box] [config_dir=FOLDER] ...

`zero` and `random` act on the environment of the default config; `reference` shows the motion without physics. The
reference is drawn as a ghost, contact points are yellow while contact is intended, contact forces are red. The video
ends a second after a failure, those pictures with a red frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from hdmi.assembly import Task, make_task
from hdmi.commands.options import parse_options
from hdmi.commands.script import run_script
from hdmi.config import ConfigError, task_config
from hdmi.envs.rendering import RenderingError
from hdmi.evaluation.agents import AGENTS, blind_agent
from hdmi.evaluation.protocol import Policy, load_checked_policy, run_folder_of
from hdmi.evaluation.video import STRIDE, Moment, Overlay, every, play_moments, replay, show, write_video


@dataclass
class Options:
    """See the module."""

    checkpoint: str | None = None
    agent: str | None = None
    task: str | None = None  # for an agent: lift_box; for a checkpoint: that it must be of
    motion_root: str | None = None
    config_dir: str | None = None  # of an agent's task, where conf/task lacks it
    start: int = 0  # frame of the reference
    seed: int = 0
    out: str | None = None  # play.mp4 in the run folder, or play_<task>_<agent>.mp4 here
    window: bool = False
    stride: int = STRIDE  # control steps per picture
    width: int = 640
    height: int = 480


def prepare(options: Options) -> tuple[Task, Iterator[Moment], Path]:
    """What the options ask to play: its task, its moments, and where the video goes.

    Raises:
        ConfigError, MotionError, CheckpointError: for options that cannot be met.
    """
    if (options.checkpoint is None) == (options.agent is None):
        raise ConfigError(f"give either checkpoint=RUN or agent=, one of {', '.join((*AGENTS, 'reference'))}")
    for name in ("stride", "width", "height"):
        if getattr(options, name) < 1:
            raise ConfigError(f"{name}: expected at least 1, got {getattr(options, name)}")
    policy: Policy | None = None
    if options.checkpoint is not None:
        policy, cfg, info = load_checked_policy(options.checkpoint, options.task)
        cfg.motion_root = options.motion_root or cfg.motion_root
        out = run_folder_of(Path(info["file"])) / "play.mp4"
    else:
        if options.agent not in (agents := (*AGENTS, "reference")):
            raise ConfigError(f"agent: there is no {options.agent!r}; there is {', '.join(agents)}")
        cfg = task_config(options.task or "lift_box", options.motion_root, options.config_dir)
        out = Path(f"play_{cfg.task.name}_{options.agent}.mp4")
    task = make_task(cfg)
    if options.agent in AGENTS:
        policy = blind_agent(options.agent, cfg, task)
    last = task.reference.num_frames - 1
    if not 0 <= options.start < last:
        raise ConfigError(f"start: expected a frame from 0 to {last - 1}, got {options.start}")
    if policy is None:
        moments = replay(task, options.start)
    else:
        moments = play_moments(cfg, task, policy, options.start, options.seed)
    return task, moments, Path(options.out or out)


def play(arguments: list[str], console: Console) -> int:
    """Opens the window, or writes the video."""
    del console
    options = parse_options(Options, arguments)
    task, moments, out = prepare(options)
    control_dt = task.scene.sim.control_dt
    overlay = Overlay(task, ghost=options.agent != "reference")
    if options.window:
        show(moments, overlay, control_dt)
        return 0
    size = (options.height, options.width)
    fps = 1 / (control_dt * options.stride)
    print(write_video(out, every(moments, options.stride), overlay, fps, size))
    return 0


def main(arguments: list[str]) -> int:
    """Runs the script; returns its exit status."""
    return run_script(play, arguments, __doc__, errors=(RenderingError,))
