"""A policy's deployment graph as a file: ONNX, with everything that a runner has to know in its metadata."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import NestedKey
from torch import Tensor, nn

import hdmi
from hdmi.assembly import Task, make_env, make_task, make_transforms
from hdmi.deploy.foreign.own import write_own
from hdmi.deploy.format import FORMAT, GRAPH_FILE, REFERENCE_FILE, SCENE_FILE, SENSORS, SPEC_FILE, DeploymentError
from hdmi.deploy.graph import UNMEASURED, Measured, PolicyGraph, name_of
from hdmi.deploy.rotations import tilt_of
from hdmi.deploy.trace import trace
from hdmi.learning.checkpoint import find_checkpoint, load_checkpoint
from hdmi.learning.policy import make_networks
from hdmi.motion import Reference
from hdmi.names import match_names

# Errors that follow from poses of robot and object and from the motion.
COMPARED = ("root_pos", "root_ori", "body_pos", "body_ori", "object_pos", "object_ori", "object_joint")


def make_graph(cfg: DictConfig, actor: nn.Module, task: Task | None = None) -> tuple[PolicyGraph, Task]:
    """The deployment graph of a policy, from the transform stack of its config.

    Args:
        actor: in float32, whatever it was trained in.
        task: made from the config if absent.

    Raises:
        ConfigError, MotionError: for a config or a motion that cannot be used.
    """
    task = make_task(cfg) if task is None else task
    env = make_env(cfg, 1, task)
    spec = env.base_env.full_observation_spec
    entries: dict[NestedKey, torch.Size] = {key: spec[key].shape[1:] for key in spec.keys(True, True)}
    names = [name for name, _ in make_transforms(cfg, task)]
    # bound to their environment, whose action they know the width of; what selects outputs stands behind them
    stack = list(zip(names, env.transform.transforms, strict=False))
    return PolicyGraph(stack, actor, Measured(entries, _hinge(task))), task


def _hinge(task: Task) -> tuple[Tensor, ...] | None:
    """Pose of the object's link in the object, and the axis that it turns about."""
    scene = task.scene
    if scene.object_hinge_qpos is None or scene.object_link is None:
        return None
    model, link = scene.model, scene.object_link
    axis = model.jnt_axis[model.body_jntadr[link]]
    pos, quat = model.body_pos[link], model.body_quat[link]
    return tuple(torch.tensor(value, dtype=torch.float32) for value in (pos, quat, axis))


def to_onnx(graph: PolicyGraph) -> onnx.ModelProto:
    """Traces a graph, and leaves away what its results do not depend on.

    Raises:
        DeploymentError: if they depend on what no sensor gives; names the observation terms.
    """
    model = trace(graph, graph.inputs, graph.outputs)
    used = _reached(model)
    for key in graph.others:
        if f"{UNMEASURED}.{name_of(key)}" in used:
            terms = ", ".join(graph.terms_that_read(key)) or "the action"
            raise DeploymentError(
                f"{terms}: depends on {name_of(key)!r}, which no robot measures; sensors are "
                f"{', '.join(graph.measured.sensors)}"
            )
    kept = [value for value in model.graph.input if value.name in used]
    del model.graph.input[:]
    model.graph.input.extend(kept)
    return model


def _reached(model: onnx.ModelProto) -> set[str]:
    """Names of all values that the outputs depend on."""
    makers = {name: node for node in model.graph.node for name in node.output}
    found: set[str] = set()
    waiting = [value.name for value in model.graph.output]
    while waiting:
        if (name := waiting.pop()) not in found:
            found.add(name)
            waiting += makers[name].input if name in makers else ()
    return found


def export_graph(checkpoint: str | Path, folder: str | Path) -> Path:
    """Writes `policy.onnx`, `scene.xml`, the scene as self-contained MJCF, and `reference.npz` into a folder.

    Beside them, for others' runners, what `hdmi.deploy.foreign.own.write_own` writes; a warning says why not, if a term
    of the policy has no name there.

    Args:
        checkpoint: a run folder (its newest checkpoint counts), an exported policy, or a checkpoint file.
        folder: is made if it is not there.

    Raises:
        CheckpointError: if there is no usable checkpoint.
        ConfigError, MotionError: if its environment cannot be built here.
        DeploymentError: if the policy needs what no robot measures.
        OSError: if a file cannot be written.
    """
    state = load_checkpoint(find_checkpoint(checkpoint))
    cfg = OmegaConf.create(state["config"])
    assert isinstance(cfg, DictConfig)
    cfg.algo.bf16 = False
    cfg.num_threads = 1
    actor, _ = make_networks(cfg, state["sizes"], torch.device("cpu"))
    actor.load_state_dict(state["actor"])
    graph, task = make_graph(cfg, actor)
    digest = hashlib.sha256(json.dumps(state["config"], sort_keys=True).encode()).hexdigest()
    path = write_graph(cfg, graph, task, folder, {"config_hash": digest, "training_frames": str(state["frames"])})
    try:
        write_own(graph, task, trial_of(cfg, task), folder)
    except DeploymentError as error:  # the graph is whole without it
        warnings.warn(f"no {SPEC_FILE}: {error}", stacklevel=2)
    return path


def write_graph(
    cfg: DictConfig, graph: PolicyGraph, task: Task, folder: str | Path, more: Mapping[str, str] | None = None
) -> Path:
    """Writes what `export_graph` says, of a graph; `more` is metadata besides `metadata_of`.

    Raises:
        DeploymentError: if the policy needs what no robot measures.
        OSError: if a file cannot be written.
    """
    model = to_onnx(graph)
    onnx.helper.set_model_props(model, metadata_of(cfg, graph, task) | dict(more or {}))
    onnx.checker.check_model(model)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / GRAPH_FILE).write_bytes(model.SerializeToString())
    (folder / SCENE_FILE).write_text(task.scene.xml, encoding="utf-8")
    np.savez_compressed(folder / REFERENCE_FILE, **reference_arrays(task.reference))  # type: ignore[arg-type]
    return folder / GRAPH_FILE


def trial_of(cfg: DictConfig, task: Task) -> dict[str, Any]:
    """What an evaluation in another simulation goes by, as `hdmi.deploy.foreign.schema.NetworkSpec` has it."""
    terminations, unchecked = _terminations(cfg)
    robot = task.scene.robot
    return {
        "start_noise": _start_noise(cfg, task.reference),
        "terminations": terminations,
        "unchecked": unchecked,
        "tracked_joints": _matching(cfg, "joints", robot.joint_names),
        "tracked_bodies": _matching(cfg, "bodies", robot.body_names),
        "object_joint_ranges": _object_joint(cfg),
    }


def metadata_of(cfg: DictConfig, graph: PolicyGraph, task: Task) -> dict[str, str]:
    """What a runner has to know, by name: lists with commas between, mappings as JSON; SI units.

    The names that others' policies have, too, mean the same: `joint_names`, `joint_stiffness`, `joint_damping`,
    `default_joint_pos`, `action_scale`, `observation_names`, `body_names`, `anchor_body_name`.
    """
    robot, reference = task.scene.robot, task.reference
    arrays = reference_arrays(reference)
    scale = torch.zeros(len(robot.joint_names))
    for _, transform in graph.inverse:
        if hasattr(transform, "scale"):
            scale[transform.index] = transform.scale
    start: dict[str, Any] = {name: value[0] for name, value in arrays.items()} | {
        "joint_vel": reference.joint_vel[0].numpy(),
        "root_lin_vel_w": reference.body_lin_vel[0, 0].numpy(),
        "root_ang_vel_w": reference.body_ang_vel[0, 0].numpy(),
    }
    trial = trial_of(cfg, task)
    inputs = {name: {"shape": list(shape)} | SENSORS[name] for name, shape in graph.measured.sensors.items()}
    return {
        "format": FORMAT,
        "hdmi_version": hdmi.__version__,
        "robot": robot.name,
        "task": task.name,
        "motion": reference.name,
        "num_frames": str(reference.num_frames),
        "control_dt": str(task.scene.sim.control_dt),
        "joint_names": ",".join(robot.joint_names),
        "joint_stiffness": _numbers(robot.stiffness),
        "joint_damping": _numbers(robot.damping),
        "default_joint_pos": _numbers(robot.default_joint_pos),
        "action_scale": _numbers(scale.tolist()),
        "observation_names": ",".join(
            name.rpartition(".")[2] for name, _ in graph.stages if name.startswith("observation.policy.")
        ),
        "body_names": ",".join(robot.body_names),
        "anchor_body_name": robot.root,
        "effort_limits": _numbers(robot.effort_limits),
        "velocity_limits": _numbers(robot.velocity_limits),
        "joint_ranges": json.dumps([list(pair) for pair in robot.joint_ranges]),
        "armature": _numbers(robot.armature),
        "sensors": json.dumps(inputs),
        "state": json.dumps({name.removeprefix("state."): value.tolist() for name, value in _state(graph).items()}),
        "start": json.dumps({name: value.tolist() for name, value in start.items()}),
        "max_tilt": str(float(tilt_of(arrays["root_quat_w"]).max())),
        "start_noise": json.dumps(trial["start_noise"]),
        "tracked_joints": ",".join(trial["tracked_joints"]),
        "tracked_bodies": ",".join(trial["tracked_bodies"]),
        "object_joint": json.dumps(trial["object_joint_ranges"]),
        "terminations": json.dumps(trial["terminations"]),
        "unchecked_terminations": ",".join(trial["unchecked"]),
        "quaternions": "wxyz",
    }


def reference_arrays(reference: Reference) -> dict[str, np.ndarray]:
    """A motion as `hdmi.deploy.format.REFERENCE` has it: the poses that sensors can be held against. float32 [T, *]"""
    arrays = {
        "joint_pos": reference.joint_pos,
        "root_pos_w": reference.body_pos[:, 0],
        "root_quat_w": reference.body_quat[:, 0],
    }
    if reference.has_object:
        arrays |= {"object_pos_w": reference.object_pos, "object_quat_w": reference.object_quat}
        if reference.object_joint_pos.shape[-1]:
            arrays["object_joint_pos"] = reference.object_joint_pos
    return {name: value.numpy().astype(np.float32) for name, value in arrays.items()}


def _terminations(cfg: DictConfig) -> tuple[dict[str, Any], list[str]]:
    """Those that compare poses with the motion's, as numbers, and the names of the others."""
    known: dict[str, Any] = {}
    unchecked: list[str] = []
    for name, node in (cfg.termination or {}).items():
        if node is None:
            continue
        errors = [str(key[-1]) if key[0] == "error" else None for key in node.get("errors", [None]) if key is not None]
        if str(node["_target_"]).endswith(".ErrorTermination") and errors and set(errors) <= set(COMPARED):
            thresholds = [float(value) for value in node.thresholds]
            known[str(name)] = {
                "errors": dict(zip(errors, thresholds, strict=True)), "min_steps": int(node.get("min_steps", 25)),
            }  # fmt: skip
        else:
            unchecked.append(str(name))
    return known, unchecked


def _start_noise(cfg: DictConfig, reference: Reference) -> dict[str, Any]:
    """Half ranges of the perturbations at the first frame, m, rad and per second; none of an object that is held."""
    node = (cfg.reset or {}).get("state") or {}
    noise = {
        str(key): OmegaConf.to_container(value) if OmegaConf.is_config(value) else float(value)
        for key, value in (node.get("noise") or {}).items()
    }
    held = float(node.get("held_noise", 1.0)) if bool(reference.contact[0].any()) else 1.0
    return {
        key: (np.asarray(value) * (held if key.startswith("object") else 1.0)).tolist() for key, value in noise.items()
    }


def _object_joint(cfg: DictConfig) -> dict[str, list[float]]:
    """Ranges of dry friction (N m) and damping (N m s/rad) of the object's joint in training, if it is randomized."""
    node = (cfg.randomization or {}).get("object_joint")
    return {} if node is None else {key: [float(value) for value in node[key]] for key in ("friction", "damping")}


def _matching(cfg: DictConfig, kind: str, names: Sequence[str]) -> list[str]:
    """What the errors of an evaluation are of, by the config's patterns; everything if it has none."""
    patterns = (cfg.get("reference_set") or {}).get(kind)
    return list(names) if patterns is None else [names[i] for i in match_names(list(patterns), names, kind)]


def _state(graph: PolicyGraph) -> Mapping[str, Tensor]:
    """State before the first tick, by the name of its input."""
    return {name: value for name, value in graph.inputs.items() if name.startswith("state.")}


def _numbers(values: Any) -> str:
    return ",".join(repr(float(value)) for value in values)
