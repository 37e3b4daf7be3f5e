"""Pictures of tasks: the reference at mid-contact."""

from __future__ import annotations

import math
from pathlib import Path

import imageio.v2 as imageio
import numpy as np

from hdmi.assembly import Task
from hdmi.config import ConfigError
from hdmi.envs.rendering import WorldRenderer
from hdmi.evaluation.video import Moment, Overlay, picture, replay
from hdmi.workshop.annotate import intervals

_DISTANCE = 3.2  # of the camera, m


def picture_frame(task: Task) -> int:
    """The middle of the longest labelled contact; of the motion, if there is none."""
    contact = task.reference.contact.numpy()
    runs = [run for column in contact.T for run in intervals(column)]
    first, last = max(runs, key=lambda run: run[1] - run[0], default=(0, task.reference.num_frames - 1))
    return (first + last) // 2


def _clearest_azimuth(renderer: WorldRenderer, moment: Moment, task: Task) -> float:
    """Of twelve directions around the robot the one in which the least of what matters is hidden."""
    model, data = moment.model, moment.data
    robot, effectors = (
        model.body(task.scene.robot.root).id,
        [model.body(effector.body).id for effector in task.scene.effectors],
    )
    parts = [
        np.flatnonzero(model.body_rootid[model.geom_bodyid] == robot),
        task.scene.object_geoms,
        np.flatnonzero(np.isin(model.geom_bodyid, effectors)),
    ]
    forward = data.body(task.scene.robot.root).xmat.reshape(3, 3)[:2, 0]
    heading = math.degrees(math.atan2(forward[1], forward[0]))

    def clarity(azimuth: float) -> float:
        renderer.turn(azimuth)
        pixels = renderer.visible(model, data)
        return math.prod(int(pixels[part].sum()) + 1 for part in parts if len(part))

    return max((heading + turn for turn in range(10, 370, 30)), key=clarity)


def render_reference(task: Task, path: str | Path, size: tuple[int, int] = (360, 480)) -> Path:
    """A picture of the reference at mid-contact, from where robot, object and end effectors are seen best.

    Raises:
        RenderingError: without OpenGL; says what to install.
        ConfigError: for a format that pictures cannot have.
    """
    path = Path(path)
    if path.suffix not in (".jpg", ".png"):
        raise ConfigError(f"{path}: expected a .jpg or .png file")
    frame = picture_frame(task)
    moment: Moment = next(replay(task, frame))
    renderer = WorldRenderer(moment.model, task.scene.robot, *size, distance=_DISTANCE)
    try:
        renderer.turn(_clearest_azimuth(renderer, moment, task))
        image = picture(renderer, moment, Overlay(task, ghost=False), size)
    finally:
        renderer.close()
    path.parent.mkdir(parents=True, exist_ok=True)
    imageio.imwrite(path, image)
    return path
