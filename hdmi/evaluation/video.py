"""Playing policies and references in one world: videos and a window."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import imageio.v2 as imageio
import mujoco
import mujoco.viewer
import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.envs import ExplorationType, TransformedEnv, set_exploration_type

from hdmi.assembly import Task, make_task
from hdmi.envs.rendering import RenderingError, WorldRenderer, look_at
from hdmi.evaluation.protocol import (
    Policy,
    evaluation_config,
    load_checked_policy,
    make_evaluation_env,
    run_folder_of,
    termination_names,
)
from hdmi.motion import reference_qpos

VIDEO_FILE = "video.mp4"  # in a run folder, or beside an exported policy
STRIDE = 2  # control steps per picture
SIZE = (480, 640)  # height, width
AFTER_FAILURE = 1.0  # s that are still shown

_GHOST = (0.20, 0.45, 0.95, 0.22)
_GHOST_INSET = 0.015  # m
_INTENDED = (1.0, 0.82, 0.10, 1.0)
_NOT_INTENDED = (0.55, 0.55, 0.58, 0.8)
_FORCE = (0.90, 0.12, 0.12, 1.0)
_POINT_RADIUS = 0.02  # m
_FORCE_SCALE = 0.015  # m/N
_MAX_ARROW = 0.6  # m
_MIN_FORCE = 1.0  # N; less is not drawn
_FRAME_WIDTH = 6  # pixels of the red frame after a failure


@dataclass(frozen=True)
class Moment:
    """One world after a control step.

    Args:
        model, data: of the world.
        frame: of the reference that the state is compared with.
        failure: what has ended the episode, if anything.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    frame: int
    failure: str | None = None


# -- what happens ---------------------------------------------------------------------------------------------


@torch.no_grad()
def play(env: TransformedEnv, task: Task, policy: Policy, causes: Iterable[str], start: int = 0) -> Iterator[Moment]:
    """World 0 under a policy with deterministic actions, to the end of the motion or just past a failure.

    Args:
        env: that starts episodes from frame `start`.
        causes: names of the terminations.
    """

    def world() -> tuple[mujoco.MjModel, mujoco.MjData]:
        return env.base_env.backend.world(0)

    failure, left = None, round(AFTER_FAILURE / task.scene.sim.control_dt)
    tensordict = env.reset()
    yield Moment(*world(), start)
    for frame in range(start + 1, task.reference.num_frames):
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            stepped = env.step(policy(tensordict))
        failure = failure or _failure(stepped["next"], causes)
        yield Moment(*world(), frame, failure)
        left -= failure is not None
        if left <= 0:
            return
        tensordict = env.step_mdp(stepped)


def _failure(after: TensorDictBase, causes: Iterable[str]) -> str | None:
    if after["diverged"][0].any():
        return "diverged"
    for cause in causes:
        if after["termination", cause][0].any():
            return cause
    return None


def replay(task: Task, start: int = 0) -> Iterator[Moment]:
    """The reference itself, without physics."""
    model = task.scene.model
    data = mujoco.MjData(model)
    for frame in range(start, task.reference.num_frames):
        data.qpos[:] = reference_qpos(task.scene, task.reference, frame)
        mujoco.mj_forward(model, data)
        yield Moment(model, data, frame)


# -- what is drawn --------------------------------------------------------------------------------------------


class Overlay:
    """Draws the reference as a translucent ghost, contact points (yellow where intended) and contact forces (red).

    Args:
        ghost: whether to draw the reference.
        ghost_task: whose reference is drawn instead.
    """

    def __init__(self, task: Task, ghost: bool = True, ghost_task: Task | None = None):
        self.task, self.ghost = task, ghost
        self._ghost_task = ghost_task
        self._option = mujoco.MjvOption()
        self._perturb = mujoco.MjvPerturb()
        self._ghost_data = mujoco.MjData((ghost_task or task).scene.model)

    def draw(self, moment: Moment, scene: mujoco.MjvScene) -> None:
        """Adds to a scene what belongs to a moment."""
        if self.ghost:
            self._draw_ghost(moment, scene)
        for e in range(len(self.task.scene.effectors)):
            self._draw_contact(moment, scene, e)

    def _draw_ghost(self, moment: Moment, scene: mujoco.MjvScene) -> None:
        data, first = self._ghost_data, scene.ngeom
        task, model = self.task, moment.model  # of the world: objects are randomized in size
        if self._ghost_task is not None:
            task, model = self._ghost_task, self._ghost_task.scene.model
        frame = min(moment.frame, task.reference.num_frames - 1)
        data.qpos[:] = reference_qpos(task.scene, task.reference, frame)
        mujoco.mj_kinematics(model, data)
        moving = int(mujoco.mjtCatBit.mjCAT_DYNAMIC)
        mujoco.mjv_addGeoms(model, data, self._option, self._perturb, moving, scene)
        for geom in scene.geoms[first : scene.ngeom]:
            geom.rgba[:] = _GHOST
            geom.matid = -1
            # off the surfaces that it coincides with: of a perfect imitation only the robot is seen
            geom.size[:] = np.maximum(geom.size - _GHOST_INSET, 0.5 * geom.size)

    def _draw_contact(self, moment: Moment, scene: mujoco.MjvScene, e: int) -> None:
        model, data, reference = moment.model, moment.data, self.task.reference
        parts, effector = self.task.scene, self.task.scene.effectors[e]
        intended = bool(reference.contact[moment.frame, e])
        # the points are scaled with the object
        geom = parts.object_geoms[-1]
        scale = model.geom_size[geom, 0] / parts.model.geom_size[geom, 0]
        point = reference.contact_point[moment.frame, e].double().numpy() * scale
        target = data.xpos[parts.object_link] + data.xmat[parts.object_link].reshape(3, 3) @ point
        _sphere(scene, target, _POINT_RADIUS, _INTENDED if intended else _NOT_INTENDED)
        # the sensor reports what the effector exerts; drawn is what it feels
        force = -data.sensordata[parts.effector_sensors[e]]
        strength = np.linalg.norm(force)
        if strength >= _MIN_FORCE:
            body = data.body(effector.body)
            hand = body.xpos + body.xmat.reshape(3, 3) @ np.asarray(effector.point)
            length = min(_FORCE_SCALE * strength, _MAX_ARROW)
            _arrow(scene, hand, hand + length * force / strength, _FORCE)


def _add_geom(
    scene: mujoco.MjvScene, kind: int, size: np.ndarray, pos: np.ndarray, rgba: tuple[float, ...]
) -> mujoco.MjvGeom | None:
    if scene.ngeom >= scene.maxgeom:
        return None
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(geom, kind, size, pos, np.eye(3).ravel(), np.asarray(rgba, dtype=np.float32))
    scene.ngeom += 1
    return geom


def _sphere(scene: mujoco.MjvScene, pos: np.ndarray, radius: float, rgba: tuple[float, ...]) -> None:
    geom = _add_geom(scene, mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, radius), pos, rgba)
    if geom is not None:
        geom.emission = 0.6


def _arrow(scene: mujoco.MjvScene, start: np.ndarray, end: np.ndarray, rgba: tuple[float, ...]) -> None:
    geom = _add_geom(scene, mujoco.mjtGeom.mjGEOM_ARROW, np.ones(3), start, rgba)
    if geom is not None:
        mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_ARROW, 0.012, start, end)


# -- where it goes --------------------------------------------------------------------------------------------


def write_video(
    path: str | Path, moments: Iterable[Moment], overlay: Overlay, fps: float, size: tuple[int, int] = SIZE
) -> Path:
    """Renders moments into an mp4; a red frame marks those after a failure.

    Args:
        fps: pictures per second, one for each moment.
        size: height and width, pixels; multiples of 16.

    Raises:
        RenderingError: without OpenGL; says what to install.
        OSError: if the file cannot be written.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.stem}.partial.mp4")
    renderer = writer = None
    try:
        for moment in moments:
            if renderer is None:
                # the model of the world, not of the scene: objects are randomized in size
                renderer = WorldRenderer(moment.model, overlay.task.scene.robot, *size)
                writer = imageio.get_writer(partial, fps=fps, codec="libx264", quality=6, macro_block_size=16)
            assert writer is not None
            writer.append_data(picture(renderer, moment, overlay, size))
        if writer is not None:
            writer.close()
            writer = None
            os.replace(partial, path)
    finally:
        if writer is not None:
            writer.close()
        if renderer is not None:
            renderer.close()
        partial.unlink(missing_ok=True)
    return path


def picture(renderer: WorldRenderer, moment: Moment, overlay: Overlay, size: tuple[int, int] = SIZE) -> np.ndarray:
    """One picture. uint8 [height, width, 3]"""
    image = renderer(moment.model, moment.data, *size, draw=lambda scene: overlay.draw(moment, scene))
    if moment.failure is not None:
        w = _FRAME_WIDTH
        for edge in (image[:w], image[-w:], image[:, :w], image[:, -w:]):
            edge[:] = (200, 30, 30)
    return image


def show(moments: Iterable[Moment], overlay: Overlay, control_dt: float) -> None:
    """Plays moments in a window, in real time, until they end or the window is closed.

    Raises:
        RenderingError: without a display.
    """
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise RenderingError("window=true needs a display, and DISPLAY is not set; leave it out to write a video")
    window = data = None
    try:
        for moment in moments:
            begin = time.perf_counter()
            if window is None:
                data = mujoco.MjData(moment.model)
                window = mujoco.viewer.launch_passive(moment.model, data, show_left_ui=False, show_right_ui=False)
                window.cam.distance, window.cam.azimuth, window.cam.elevation = 2.8, 130.0, -14.0
            assert data is not None
            if not window.is_running():
                return
            with window.lock():
                data.qpos[:], data.qvel[:], data.ctrl[:] = moment.data.qpos, moment.data.qvel, moment.data.ctrl
                mujoco.mj_forward(moment.model, data)
                window.cam.lookat[:] = look_at(data, overlay.task.scene.robot)
                window.user_scn.ngeom = 0
                overlay.draw(moment, window.user_scn)
            window.sync()
            time.sleep(max(control_dt - (time.perf_counter() - begin), 0.0))
    finally:
        if window is not None:
            window.close()


def every(moments: Iterable[Moment], stride: int) -> Iterator[Moment]:
    """Every `stride`-th moment."""
    return (moment for i, moment in enumerate(moments) if i % stride == 0)


def play_moments(cfg: DictConfig, task: Task, policy: Policy, start: int = 0, seed: int = 0) -> Iterator[Moment]:
    """World 0 of a training config under a policy, by the evaluation protocol but from frame `start`.

    Args:
        seed: of start state, randomization and noise; the caller's random state is left alone.
    """
    cfg = evaluation_config(cfg, start=start)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        env = make_evaluation_env(cfg, task, 1)
        try:
            yield from play(env, task, policy, termination_names(cfg), start)
        finally:
            env.close()


def render_checkpoint(
    run_or_checkpoint: str | Path,
    path: str | Path | None = None,
    task: str | None = None,
    motion_root: str | None = None,
    start: int = 0,
    seed: int = 0,
    size: tuple[int, int] = SIZE,
    stride: int = STRIDE,
) -> Path:
    """Renders the policy of a checkpoint over the whole motion, with the reference as a ghost.

    Args:
        run_or_checkpoint: a run folder (its newest checkpoint counts) or a checkpoint file.
        path: of the mp4; None for video.mp4 in the run folder.
        task: that the checkpoint must be of.
        motion_root: instead of the training's.
        start: frame of the reference to start from.
        seed: of start state, randomization and noise.
        size: height and width, pixels.
        stride: control steps per picture.

    Raises:
        CheckpointError: if there is no usable checkpoint, or it is of another task.
        ConfigError, MotionError: if its environment cannot be built here.
        RenderingError: without OpenGL; says what to install.
        OSError: if the file cannot be written.
    """
    actor, cfg, info = load_checked_policy(run_or_checkpoint, task)
    if motion_root is not None:
        cfg.motion_root = motion_root
    built = make_task(cfg)
    moments = every(play_moments(cfg, built, actor, start, seed), stride)
    path = run_folder_of(Path(info["file"])) / VIDEO_FILE if path is None else path
    return write_video(path, moments, Overlay(built), 1 / (built.scene.sim.control_dt * stride), size)
