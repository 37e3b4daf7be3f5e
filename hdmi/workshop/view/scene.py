"""A motion to look at, in the scene of whose object it has."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from hdmi.assembly import scene_parts
from hdmi.assets import ObjectConfig, SceneryConfig, g1
from hdmi.config import ConfigError, task_config, task_files, task_node
from hdmi.motion import Motion, load_motion
from hdmi.motion.playback import Playback, make_playback
from hdmi.workshop.validate.checks import moves_with_robot

_CUBE = (0.05, 0.05, 0.05)  # half extents of an object that no task describes, m


def load_view(path: str | Path, task: str | None = None, config_dir: str | None = None) -> tuple[Playback, str]:
    """The motion in a folder, in the scene of a task.

    Args:
        task: whose object, scenery and effectors to show; None takes the task of this motion, else one whose object it
            has. Without any, the body that moves most is shown as a cube, and the others as cubes at their first pose.
        config_dir: folder of tasks besides conf, see `task_config`.

    Returns:
        The motion in its scene, and a line that says what was taken.

    Raises:
        MotionError: if the motion cannot be read, or does not fit the task.
        ConfigError: if there is no such task, or its scene cannot be used.
    """
    motion = load_motion(path)
    name = task or _task_of(motion, config_dir)
    if name is not None:
        return make_playback(
            motion, **scene_parts(task_config(name, config_dir=config_dir))
        ), f"object and effectors of task {name}"
    return _bare_playback(motion), "no task has its object: drawn as cubes; task=NAME takes a task's object"


def _task_of(motion: Motion, config_dir: str | None) -> str | None:
    files = task_files(config_dir)
    for name, file in files.items():
        try:
            of = OmegaConf.select(OmegaConf.load(file), "task.motion")
        except (OmegaConfBaseException, YAMLError) as error:
            raise ConfigError(f"{file}: {' '.join(str(error).split())}") from error
        if of == motion.name:
            return name
    for name in files:
        thing = task_node(task_config(name, config_dir=config_dir), "task.object")
        if thing is not None and thing.name in motion.body_names:
            return name
    return None


def _bare_playback(motion: Motion) -> Playback:
    motion = motion.with_joints(g1.JOINT_NAMES)
    robot = make_playback(motion)
    others = [
        name for name in motion.body_names if name not in g1.BODY_NAMES and not moves_with_robot(motion, robot, name)
    ]
    if not others:
        return robot
    travel = np.ptp(motion.body_pos_w, axis=0).max(axis=-1)
    others.sort(key=lambda name: -float(travel[motion.body_names.index(name)]))
    cube = [{"box": _CUBE}]
    return make_playback(
        motion, object=ObjectConfig(others[0], cube), scenery=[SceneryConfig(name, cube) for name in others[1:]]
    )
