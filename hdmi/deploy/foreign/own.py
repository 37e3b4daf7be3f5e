"""This project's own policies in the words of `hdmi.deploy.foreign.schema`: the bare network, and a YAML about it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from tensordict import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.envs import Transform

from hdmi.assembly import Task
from hdmi.assets import Scene
from hdmi.deploy.foreign.schema import write_spec
from hdmi.deploy.format import MOTION_FOLDER, NETWORK_FILE, SCENE_FILE, SPEC_FILE, DeploymentError
from hdmi.deploy.graph import PolicyGraph, name_of
from hdmi.deploy.trace import trace
from hdmi.motion import Motion, save_motion
from hdmi.transforms import (
    ActionHistory,
    Concatenate,
    DefaultPoseAction,
    FeedForwardTarget,
    History,
    JointPositionAction,
    MotionReference,
    ResidualAction,
)

_Maker = Callable[[PolicyGraph, Transform, Task], dict[str, Any]]


class _Mean(nn.Module):
    """The mean of a policy's actions. [N, D] -> [N, A]"""

    def __init__(self, network: nn.Module):
        super().__init__()
        self.network = network

    def forward(self, obs: Tensor) -> Tensor:
        out = self.network(obs)
        return out[0] if isinstance(out, tuple) else out


def network_to_onnx(network: nn.Module, width: int) -> onnx.ModelProto:
    """The network alone, `obs` [N, width] -> `actions` [N, A], with its normalization, for any N."""
    sizes = {"obs": {0: torch.export.Dim("worlds")}}
    model = trace(_Mean(network), {"obs": torch.zeros(2, width)}, ["actions"], sizes)
    onnx.checker.check_model(model)
    return model


def write_own(graph: PolicyGraph, task: Task, trial: Mapping[str, Any], folder: str | Path) -> Path:
    """Writes `network.onnx`, `motion/` and `policy.yaml` into the folder of an exported policy.

    Args:
        trial: entries of the description that the training's config gives, such as `terminations`.

    Raises:
        DeploymentError: for an observation or an action that the description has no words for; names it.
        OSError: if a file cannot be written.
    """
    folder, scene, robot = Path(folder), task.scene, task.scene.robot
    terms, action, hinge = own_terms(graph, task), own_action(graph, task), _hinge_name(task.scene)
    save_motion(_motion(task, _joint_target(graph)), folder / MOTION_FOLDER)
    model = network_to_onnx(graph.network, len(graph.network.norm.mean))
    (folder / NETWORK_FILE).write_bytes(model.SerializeToString())
    lists = ("stiffness", "damping", "default_joint_pos", "effort_limits", "velocity_limits")
    numbers = {name: [float(value) for value in getattr(robot, name)] for name in lists}
    spec = {
        "network": NETWORK_FILE, "scene": SCENE_FILE, "motion": MOTION_FOLDER, "robot": robot.name, "task": task.name,
        "control_dt": float(scene.sim.control_dt), "joints": list(robot.joint_names),
        "default_pose": numbers.pop("default_joint_pos"), **numbers,
        **({"object": _object_name(scene)} if task.reference.has_object else {}),
        **({"object_joint": hinge[0]} if hinge else {}),
        **({"contact_bodies": [effector.body for effector in scene.effectors]} if scene.effectors else {}),
        **trial, "action": action, "inputs": {"obs": terms},
    }  # fmt: skip
    return write_spec(spec, folder / SPEC_FILE)


def write_task_files(task: Task, folder: str | Path) -> Path:
    """Writes `scene.xml` and `motion/` of a task, for a description of somebody else's network; returns the folder.

    Raises:
        OSError: if a file cannot be written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / SCENE_FILE).write_text(task.scene.xml, encoding="utf-8")
    save_motion(_motion(task), folder / MOTION_FOLDER)
    return folder


def own_terms(graph: PolicyGraph, task: Task) -> list[dict[str, Any]]:
    """Terms of the policy's observation, in its order.

    Raises:
        DeploymentError: for one that has no equivalent; names it.
    """
    whole = next((t for _, t in graph.stages if unravel_key("policy") in map(unravel_key, t.out_keys or ())), None)
    if not isinstance(whole, Concatenate):
        raise DeploymentError("the policy's observation is not made by a Concatenate, of which the terms are known")
    terms = []
    for key in map(unravel_key, whole.in_keys):
        chain = [(n, t) for n, t in graph.stages if key in map(unravel_key, t.out_keys or ())]
        name, writer = chain[0] if chain else (name_of(key), whole)
        make = _EQUIVALENTS.get((type(writer).__name__, tuple(unravel_key(k) for k in writer.in_keys)))
        rest = [(n, t) for n, t in chain[1:] if not isinstance(t, History)]
        if make is None or rest or len(chain) > 2:
            name = rest[0][0] if rest else name
            raise DeploymentError(f"{name}: has no equivalent among the terms of hdmi.deploy.foreign.terms")
        term = make(graph, writer, task)
        terms.append(term if len(chain) == 1 else term | {"lags": list(range(chain[1][1].steps + 1))})
    return terms


def own_action(graph: PolicyGraph, task: Task) -> dict[str, Any]:
    """The policy's action.

    Raises:
        DeploymentError: for a transform of actions that has no equivalent; names it.
    """
    found: dict[str, Any] = {}
    bases: dict[NestedKey, str] = {("ref", "joint_pos"): "reference"}
    if _joint_target(graph) is not None:
        bases["ref", "joint_target"] = "joint_target"
    names = task.scene.robot.joint_names
    for name, transform in graph.inverse:
        if isinstance(transform, JointPositionAction):
            joints = [names[i] for i in transform.index.tolist()]
            found |= {"scale": dict(zip(joints, transform.scale.tolist(), strict=True)), "joints": joints}
        elif isinstance(transform, ResidualAction) and unravel_key(transform.state_keys[0]) in bases:
            found["base"] = bases[unravel_key(transform.state_keys[0])]
        elif isinstance(transform, DefaultPoseAction):
            found["base"] = "default"
        else:
            raise DeploymentError(f"{name}: has no equivalent in the action of hdmi.deploy.foreign.schema")
    if set(found) != {"scale", "joints", "base"}:
        raise DeploymentError("action: expected a scale and a base, of which foreign runners know")
    return found


def _joint_target(graph: PolicyGraph) -> Tensor | None:
    """Where the policy's servos are sent along the reference, rad. [T, J]"""
    return next((t.targets for _, t in graph.stages if isinstance(t, FeedForwardTarget)), None)


def _motion(task: Task, joint_target: Tensor | None = None) -> Motion:
    """The reference as a motion of robot and object; the object's hinge has no servo, and its target is where it is."""
    r, scene = task.reference, task.scene
    names, hinge = [*scene.robot.body_names], _hinge_name(scene)
    bodies = {
        "body_pos_w": [r.body_pos], "body_quat_w": [r.body_quat],
        "body_lin_vel_w": [r.body_lin_vel], "body_ang_vel_w": [r.body_ang_vel],
    }  # fmt: skip
    if r.has_object:
        names.append(_object_name(scene))
        thing = (r.object_pos, r.object_quat, r.object_lin_vel, r.object_ang_vel)
        for parts, value in zip(bodies.values(), thing, strict=True):
            parts.append(value[:, None])
    labelled = r.contact.shape[-1] > 0
    return Motion(
        name=r.name,
        fps=1.0 / scene.sim.control_dt,
        body_names=tuple(names),
        joint_names=(*scene.robot.joint_names, *hinge),
        joint_pos=torch.cat([r.joint_pos, r.object_joint_pos], dim=-1).numpy(),
        joint_vel=torch.cat([r.joint_vel, r.object_joint_vel], dim=-1).numpy(),
        joint_target=None if joint_target is None else torch.cat([joint_target, r.object_joint_pos], dim=-1).numpy(),
        object_contact=r.contact.numpy() if labelled else None,
        contact_points=r.contact_point.numpy() if labelled else None,
        **{key: torch.cat(parts, dim=1).numpy() for key, parts in bodies.items()},
    )


def _object_name(scene: Scene) -> str:
    return scene.model.body(scene.object_body).name


def _hinge_name(scene: Scene) -> list[str]:
    """Name of the object's hinge, if it has one."""
    model = scene.model
    return [model.joint(i).name for i in range(model.njnt) if model.jnt_qposadr[i] == scene.object_hinge_qpos]


def _future(graph: PolicyGraph, kind: str) -> dict[str, Any]:
    clock = next(t for _, t in graph.stages if isinstance(t, MotionReference))
    return {"steps": list(clock.future_steps), kind: list(getattr(clock, f"tracked_{kind}"))}


def _relative(graph: PolicyGraph, transform: Transform, task: Task) -> dict[str, Any]:
    pose, robot = transform.default_pos.tolist(), task.scene.robot
    own = dict(zip(robot.joint_names, pose, strict=True))
    same = np.allclose(pose, robot.default_joint_pos, atol=1e-6)
    return {"term": "joint_pos_rel"} | ({} if same else {"default_pose": own})


def _actions(graph: PolicyGraph, transform: Transform, task: Task) -> dict[str, Any]:
    steps = next(t.steps for _, t in graph.stages if isinstance(t, ActionHistory))
    return {"term": "last_action", "lags": list(range(steps)), "fill": "zero"}


def _plain(term: str) -> _Maker:
    return lambda graph, transform, task: {"term": term}


# Terms by the class of the transform and what it reads.
_POS, _QUAT = ("robot", "root_pos"), ("robot", "root_quat")
_EQUIVALENTS: dict[tuple[str, tuple[NestedKey, ...]], _Maker] = {
    ("Flatten", (("ref", "phase"),)): _plain("phase"),
    ("Flatten", (("ref", "future", "joint_pos"),)): lambda graph, transform, task: {
        "term": "ref_joint_pos", **_future(graph, "joints"),
    },
    ("Flatten", (("ref", "future", "body_pos_local"),)): lambda graph, transform, task: {
        "term": "ref_body_pos", **_future(graph, "bodies"),
        "frame": {"of": "reference", "turn": "heading", "ground": True},
    },
    ("VectorInRoot", (("robot", "root_ang_vel"), _QUAT)): _plain("root_ang_vel"),
    ("ProjectedGravity", (_QUAT,)): _plain("gravity"),
    ("RelativeJointPos", (("robot", "joint_pos"),)): _relative,
    ("Flatten", (("robot", "joint_pos"),)): _plain("joint_pos"),
    ("Flatten", (("robot", "joint_vel"),)): _plain("joint_vel"),
    ("Flatten", ("action_history",)): _actions,
    ("PoseInRoot", (("ref", "root_pos"), ("ref", "root_quat"), _POS, _QUAT)): _plain("ref_body_pose"),
    ("PoseInRoot", (("object", "pos"), ("object", "quat"), _POS, _QUAT)): _plain("object_pose"),
    ("Flatten", (("object", "joint_pos"),)): _plain("object_joint_pos"),
    ("PointInRoot", (("contact", "target_pos"), _POS, _QUAT)): _plain("contact_points"),
    ("Flatten", (("ref", "contact"),)): _plain("contact"),
}  # fmt: skip
