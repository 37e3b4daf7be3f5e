"""Shows a reference: writes an mp4, or opens a viewer in the browser.

    hdmi view FOLDER [out=FOLDER.mp4] [task=NAME] [ghost=FOLDER2] [start=FRAME] [stride=2]
    hdmi view FOLDER viewer=true [task=NAME] [ghost=FOLDER2] [port=8080]

FOLDER holds motion.npz and meta.json. The object, scenery and effectors are those of the task with this motion, or of
`task`; `config_dir` adds the tasks of its folder `task`. Contact points
are yellow while contact is intended. `ghost` is another motion of the same robot, drawn
translucent; the viewer plots how far the two are apart. The viewer needs the extra `viewer`.
"""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console

from hdmi.assembly import Task
from hdmi.commands.options import parse_motion_options
from hdmi.commands.script import run_script
from hdmi.config import ConfigError
from hdmi.envs.rendering import RenderingError
from hdmi.evaluation.video import Overlay, every, replay, write_video
from hdmi.motion.playback import Playback
from hdmi.workshop.view.browser import ReferenceViewer
from hdmi.workshop.view.scene import load_view


@dataclass
class Options:
    """See the module."""

    out: str | None = None  # <name of the motion>.mp4 here
    task: str | None = None
    config_dir: str | None = None
    ghost: str | None = None
    viewer: bool = False
    host: str = "127.0.0.1"
    port: int = 8080
    start: int = 0
    stride: int = 2  # frames per picture
    width: int = 640
    height: int = 480


def as_task(playback: Playback) -> Task:
    """What videos are made of."""
    return Task(playback.reference.name, playback.scene, playback.reference)


def view(arguments: list[str], console: Console) -> int:
    """Writes the video, or runs the viewer."""
    path, options = parse_motion_options(Options, arguments)
    for name in ("stride", "width", "height"):
        if getattr(options, name) < 1:
            raise ConfigError(f"{name}: expected at least 1, got {getattr(options, name)}")
    playback, taken = load_view(path, options.task, options.config_dir)
    last = playback.num_frames - 1
    if not 0 <= options.start < last:
        raise ConfigError(f"start: expected a frame from 0 to {last - 1}, got {options.start}")
    name = playback.reference.name
    console.print(f"{name}: {last + 1} frames at {playback.fps:g} fps, {taken}", highlight=False, soft_wrap=True)
    ghost = None if options.ghost is None else load_view(options.ghost, options.task, options.config_dir)[0]
    if options.viewer:
        viewer = ReferenceViewer(playback, ghost, options.host, options.port)
        console.print(f"open {viewer.address} (Ctrl+C ends it)", highlight=False, soft_wrap=True)
        try:
            viewer.run()
        except KeyboardInterrupt:
            viewer.stop()
        return 0
    task = as_task(playback)
    overlay = Overlay(task, ghost=ghost is not None, ghost_task=None if ghost is None else as_task(ghost))
    moments = every(replay(task, options.start), options.stride)
    size = (options.height, options.width)
    print(write_video(options.out or f"{name}.mp4", moments, overlay, playback.fps / options.stride, size))
    return 0


def main(arguments: list[str]) -> int:
    """Runs the script; returns its exit status."""
    return run_script(view, arguments, __doc__, errors=(RenderingError,))
