"""What figures need besides success: poses at one frame of the motion, and the first second of untrained policies."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from omegaconf import DictConfig
from torchrl.envs import ExplorationType, set_exploration_type

from hdmi.assembly import Task, make_task
from hdmi.config import ConfigError
from hdmi.envs.backend import PhysicsBackend
from hdmi.envs.rendering import WorldRenderer
from hdmi.evaluation.protocol import evaluation_config, has_early_end, make_evaluation_env, on_device
from hdmi.evaluation.video import SIZE, Moment, Overlay, picture, play, replay
from hdmi.learning.policy import load_policy, make_networks

_SECONDS = 1.0  # of a start that is looked at
LAUNCH = 0.1  # s over which upward acceleration is taken: later what popped up has come to rest


def deepest_frame(task: Task) -> int:
    """The frame of a reference in which the robot's root is lowest: kneeling, where there is any."""
    return int(task.reference.body_pos[:, 0, 2].argmin())


# -- poses ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Poses:
    """What a policy and its reference do at one frame of the motion.

    Args:
        frame: of the reference.
        picture: of the policy's world, the reference as a ghost; None without a renderer. uint8 [height, width, 3]
        height: of the lowest of the bodies that were asked for, m.
        reference: that height in the reference, m.
        root: height of the root, m.
        reference_root: that height in the reference, m.
    """

    frame: int
    picture: np.ndarray | None
    height: float
    reference: float
    root: float
    reference_root: float


def poses_at(run: Path, frame: int | None = None, bodies: str = ".*knee.*", render: bool = True) -> Poses:
    """Plays a run's policy from the first frame, no termination ending the episode, and looks at one frame.

    Args:
        run: run folder or checkpoint.
        frame: of the reference; None for `deepest_frame`.
        bodies: regular expression of whole names of robot bodies, whose lowest counts.
        render: whether a picture is wanted.

    Raises:
        CheckpointError, ConfigError, MotionError: if it cannot be played here, or its world diverges before.
        RenderingError: without OpenGL, where a picture is wanted.
    """
    actor, cfg, _ = load_policy(run)
    cfg = evaluation_config(cfg, terminations=[])
    task = make_task(cfg)
    frame = deepest_frame(task) if frame is None else frame
    ids = _bodies(task, bodies)
    still = next(replay(task, frame))
    with torch.random.fork_rng():
        torch.manual_seed(0)
        env = make_evaluation_env(cfg, task, 1)
        try:
            policy = on_device(actor, env.device)
            moment = next((moment for moment in play(env, task, policy, ()) if moment.frame == frame), None)
            if moment is None:
                raise ConfigError(f"{run}: its world diverges before frame {frame}")
            image = _photograph(task, moment) if render else None
            return Poses(
                frame, image, _lowest(moment, ids), _lowest(still, ids), _root(task, moment), _root(task, still)
            )
        finally:
            env.close()


def _bodies(task: Task, pattern: str) -> list[int]:
    names = [name for name in task.scene.robot.body_names if re.fullmatch(pattern, name)]
    if not names:
        there = ", ".join(task.scene.robot.body_names)
        raise ConfigError(f"bodies: the robot has none that {pattern!r} matches; it has {there}")
    return [task.scene.model.body(name).id for name in names]


def _lowest(moment: Moment, ids: list[int]) -> float:
    return float(moment.data.xpos[ids, 2].min())


def _root(task: Task, moment: Moment) -> float:
    return float(moment.data.body(task.scene.robot.root).xpos[2])


def _photograph(task: Task, moment: Moment) -> np.ndarray:
    renderer = WorldRenderer(moment.model, task.scene.robot, *SIZE)
    try:
        return picture(renderer, moment, Overlay(task), SIZE)
    finally:
        renderer.close()


# -- starts ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Starts:
    """The first second of episodes from one frame under a policy that has learned nothing, with its exploration noise.

    Args:
        frame: of the reference, from which episodes start.
        control_dt: s.
        height: of the root, m, from the start on. [T + 1, N]
        reference: that of the reference, m. [T + 1]
        alive: no termination or early end so far. [T + 1, N]
        acceleration: upward, of the root, mean over the first `LAUNCH` seconds, m/s^2. [N]
    """

    frame: int
    control_dt: float
    height: np.ndarray
    reference: np.ndarray
    alive: np.ndarray
    acceleration: np.ndarray


@torch.no_grad()
def first_second(cfg: DictConfig, num_envs: int = 64, frame: int | None = None, seed: int = 0) -> Starts:
    """Plays untrained networks of a training config for a second.

    Args:
        cfg: of a training.
        num_envs: N.
        frame: of the reference to start from; None for `deepest_frame`.
        seed: of networks, starts, randomization and noise.

    Raises:
        ConfigError, MotionError: if it cannot be built.
    """
    task = make_task(cfg)
    frame = deepest_frame(task) if frame is None else frame
    control_dt = task.scene.sim.control_dt
    steps = min(round(_SECONDS / control_dt), task.reference.num_frames - 1 - frame)
    if steps < round(LAUNCH / control_dt):
        raise ConfigError(f"frame: {frame} of {task.reference.num_frames} leaves less than {LAUNCH} s")
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        env = make_evaluation_env(evaluation_config(cfg, start=frame, early_end=has_early_end(cfg)), task, num_envs)
        try:
            tensordict = env.reset()
            sizes = {"policy": tensordict["policy"].shape[-1], "critic": tensordict["critic"].shape[-1]}
            actor, _ = make_networks(cfg, sizes | {"action": env.action_spec.shape[-1]}, torch.device("cpu"))
            policy = on_device(actor, env.device)
            backend = env.base_env.backend
            heights, alive = [_heights(backend)], [torch.ones(num_envs, dtype=torch.bool)]
            velocities = [_climb(backend)]
            with set_exploration_type(ExplorationType.RANDOM):
                for _ in range(steps):
                    stepped = env.step(policy(tensordict))
                    heights.append(_heights(backend))
                    velocities.append(_climb(backend))
                    alive.append(alive[-1] & ~stepped["next", "terminated"].reshape(-1).cpu())
                    tensordict = env.step_mdp(stepped)
        finally:
            env.close()
    launch = round(LAUNCH / control_dt)
    return Starts(
        frame,
        control_dt,
        np.stack(heights),
        task.reference.body_pos[frame : frame + steps + 1, 0, 2].numpy(),
        torch.stack(alive).numpy(),
        (velocities[launch] - velocities[0]) / LAUNCH,
    )


def _heights(backend: PhysicsBackend) -> np.ndarray:
    return backend.data("qpos")[:, 2].cpu().numpy().copy()


def _climb(backend: PhysicsBackend) -> np.ndarray:
    return backend.data("qvel")[:, 2].cpu().numpy().copy()
