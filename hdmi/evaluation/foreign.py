"""Networks of others under the trainer's protocol: in its environment, of which only observations and action change."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, open_dict
from tensordict import TensorDictBase

from hdmi.assembly import Task, make_task
from hdmi.config import ConfigError
from hdmi.deploy.foreign.policy import ForeignPolicy
from hdmi.deploy.foreign.terms import Moment
from hdmi.evaluation.protocol import EvalResult, evaluate_policy

MAX_APART = 0.05  # rad that the joints of two motions may differ if they are the same motion
_T = "hdmi.transforms"
_MEASURED: dict[str, dict[str, Any]] = {
    "joint_pos": {"_target_": f"{_T}.Flatten", "in_key": ["robot", "joint_pos"]},
    "joint_vel": {"_target_": f"{_T}.Flatten", "in_key": ["robot", "joint_vel"]},
    "root_pos_w": {"_target_": f"{_T}.Flatten", "in_key": ["robot", "root_pos"]},
    "root_quat_w": {"_target_": f"{_T}.Flatten", "in_key": ["robot", "root_quat"]},
    "root_lin_vel_w": {"_target_": f"{_T}.Flatten", "in_key": ["robot", "root_lin_vel"]},
    "root_ang_vel": {"_target_": f"{_T}.VectorInRoot", "in_key": ["robot", "root_ang_vel"]},
}
_OBJECT = {
    "object_pos_w": ("pos", 3), "object_quat_w": ("quat", 4), "link_pos_w": ("link_pos", 3),
    "link_quat_w": ("link_quat", 4), "object_scale": ("scale", 1), "object_joint_pos": ("joint_pos", None),
}  # fmt: skip
# Noise of the training on what is measured here, too: its node, and how many of its scales.
_NOISE = {
    "joint_pos": ("joint_pos", None),
    "root_ang_vel": ("root_ang_vel", None),
    "object_pos_w": ("object_position", 3),
}


def foreign_config(cfg: DictConfig, policy: ForeignPolicy, task: Task) -> DictConfig:
    """A task's config for a network of others: its gains, raw measurements as observation, joint targets as action.

    Terminations, metrics, resets, randomization, and delay and smoothing of targets stay; of the observation noise what
    is on joint positions, angular velocity and the object's position.

    Raises:
        ConfigError: if the policy's joints or motion are not the task's; says how they differ.
    """
    _check(policy, task)
    cfg = copy.deepcopy(cfg)
    about, has_object = policy.description, task.reference.has_object
    nodes = {name: {**node, "out_key": ["measured", name]} for name, node in _MEASURED.items()}
    if has_object:
        nodes |= {
            name: {"_target_": f"{_T}.Flatten", "in_key": ["object", key], "out_key": ["measured", name]}
            for name, (key, width) in _OBJECT.items()
            if width is not None or task.reference.object_joint_pos.shape[-1]
        }
    with open_dict(cfg):
        noise = {}
        for name, (node, count) in _NOISE.items():
            if name in nodes and (found := (cfg.noise or {}).get(node)) is not None:
                scale = found.scale if count is None else list(found.scale)[:count]
                noise[node] = {"_target_": f"{_T}.UniformNoise", "key": ["measured", name], "scale": scale}
        cfg.observation.policy, cfg.noise, cfg.history = nodes, noise, None
        cfg.reward = cfg.returns = None
        cfg.action = {name: (cfg.action or {}).get(name) for name in ("delay", "smoothing")}
        for name, values in (("stiffness", about.stiffness), ("damping", about.damping)):
            own = {joint: float(value) for joint, value in zip(about.joint_names, values, strict=True)}
            cfg.robot[name] = {**(cfg.robot.get(name) or {}), **own}
    return cfg


def _check(policy: ForeignPolicy, task: Task) -> None:
    """Raises ConfigError unless the policy is of the task's robot and motion."""
    names, about, reference = task.scene.robot.joint_names, policy.description, task.reference
    if unknown := [name for name in about.joint_names if name not in names]:
        raise ConfigError(f"{policy.path}: joints: the robot of task {task.name} has no {', '.join(unknown)}")
    if about.num_frames != reference.num_frames:
        raise ConfigError(
            f"{policy.path}: motion: has {about.num_frames} frames, and that of task {task.name} {reference.num_frames}"
        )
    index = [names.index(name) for name in about.joint_names]
    apart = np.abs(reference.joint_pos.cpu().numpy()[:, index] - policy.motion.joint_pos)
    if apart.max() > MAX_APART:
        frame, joint = np.unravel_index(apart.argmax(), apart.shape)
        raise ConfigError(
            f"{policy.path}: motion: is not that of task {task.name}: {about.joint_names[joint]} differs by "
            f"{apart.max():.2f} rad at frame {frame}"
        )


class ForeignActor(torch.nn.Module):
    """`policy` [N, D], the measurements of a `foreign_config`, and `ref/step` -> `action` [N, J], targets in rad.

    An episode begins at frame 0. Joints that the policy does not command hold the task's default pose.

    Args:
        policy: which runs.
        task: whose environment it is for.
    """

    def __init__(self, policy: ForeignPolicy, task: Task):
        super().__init__()
        robot, reference = task.scene.robot, task.reference
        self.policy, self.default = policy, np.array(robot.default_joint_pos)
        self.index = [robot.joint_names.index(name) for name in policy.description.joint_names]
        count = len(robot.joint_names)
        self.widths = {"joint_pos": count, "joint_vel": count, "root_pos_w": 3, "root_quat_w": 4}
        self.widths |= {"root_lin_vel_w": 3, "root_ang_vel": 3}
        hinge = reference.object_joint_pos.shape[-1]
        if reference.has_object:
            self.widths |= {name: width or hinge for name, (_, width) in _OBJECT.items() if width or hinge}

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        values = tensordict["policy"].double().cpu().numpy()
        step = tensordict["ref", "step"].reshape(-1).cpu().numpy()
        parts = np.split(values, np.cumsum(list(self.widths.values()))[:-1], axis=-1)
        seen = dict(zip(self.widths, parts, strict=True))
        stack, fresh, joint_pos = self.policy.stack, step == 0, seen["joint_pos"][:, self.index]
        poses = self.policy.kinematics(seen["root_pos_w"], seen["root_quat_w"], joint_pos)
        now = Moment(
            step=step,
            joint_pos=joint_pos,
            joint_vel=seen["joint_vel"][:, self.index],
            body_pos_w=poses[0],
            body_quat_w=poses[1],
            root_lin_vel_w=seen["root_lin_vel_w"],
            root_ang_vel_b=seen["root_ang_vel"],
            action=stack.last_action(fresh),
            **{name: value for name, value in seen.items() if name in _OBJECT},
        )
        targets = np.tile(self.default, (len(step), 1))
        targets[:, self.index] = stack(now, fresh)
        return tensordict.set("action", torch.as_tensor(targets, dtype=torch.float32, device=tensordict.device))


def evaluate_foreign(
    policy: ForeignPolicy,
    cfg: DictConfig,
    num_envs: int,
    terminations: list[str] | None = None,
    seed: int = 0,
    without: list[str] | None = None,
) -> EvalResult:
    """Evaluates a network of others by `evaluate_policy`, in the environment of a task's config.

    Raises:
        ConfigError: if policy and task do not fit, or for a termination that the config does not have.
    """
    cfg = foreign_config(cfg, policy, make_task(cfg))
    task = make_task(cfg)  # with the policy's gains
    return evaluate_policy(ForeignActor(policy, task), cfg, num_envs, task, terminations, seed, without or ())
