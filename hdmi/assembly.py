"""From a config to an environment: every part is a node with a `_target_`, every transform stands in one list."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import mujoco
import torch
from omegaconf import DictConfig, OmegaConf
from rich.table import Table
from tensordict import NestedKey
from torchrl.envs import Transform, TransformedEnv

from hdmi.assets import (
    Effector,
    GeomConfig,
    ObjectConfig,
    Robot,
    RobotConfig,
    Scene,
    SceneryConfig,
    SimConfig,
    build_scene,
    match_names,
    parse_geom,
)
from hdmi.config import ConfigError, build, build_dataclass, one_line, plain_container, task_node
from hdmi.envs import HumanoidObjectEnv, Keep, MaskedResetEnv, PhysicsBackend, ResetEnv, RowResetEnv, Stack
from hdmi.envs.resets import check_row_resets
from hdmi.motion import Reference, find_motion, make_reference
from hdmi.motion.dynamics import reference_torque
from hdmi.motion.starts import StartTables, start_tables
from hdmi.order import check_order, check_reads, listed_keys, read_keys
from hdmi.transforms import Concatenate, KernelReward, KernelTermination, RewardTerm

# What leaves the stack besides the state that steps read back.
OUTPUTS = (
    "policy",
    "critic",
    "metrics",
    "termination",
    "completed",
    "diverged",
    "episode_reward",
    "reward_terms",
    "reward_groups",
    "step_count",
    "pixels",
)
_ABSENT = object()


@dataclass(frozen=True)
class Task:
    """What a config's task, robot and sim nodes describe.

    Examples:
        >>> from hdmi.config import task_config
        >>> task = make_task(task_config("lift_box"))
        >>> task.name, task.reference.num_frames, len(task.scene.effectors)
        ('lift_box', 300, 2)
    """

    name: str
    scene: Scene
    reference: Reference
    starts: StartTables | None = None

    @cached_property
    def _torques(self) -> dict[float, torch.Tensor]:
        return {}

    def joint_torque(self, grip: float) -> torch.Tensor:
        """What the reference asks of the joints, N m, if hands count on that share of friction. [T, J]

        See `hdmi.motion.dynamics`. It is worked out once.
        """
        if grip not in self._torques:
            self._torques[grip] = torch.from_numpy(reference_torque(self.scene, self.reference, grip)).float()
        return self._torques[grip]


def scene_parts(cfg: DictConfig) -> dict[str, Any]:
    """What a config says of the scene: `robot`, `object`, `scenery` and `effectors`, as keyword arguments.

    Everything in it has been checked, and compiles: what a task's scene has at fault, its meshes included, is found
    here, before any motion is looked at.

    Raises:
        ConfigError: for a node that cannot be used; names it.
    """
    node = task_node(cfg, "task.object")
    parts: dict[str, Any] = {
        "robot": _robot(cfg),
        "object": None if node is None else _part(ObjectConfig, node, "task.object"),
        "scenery": _parts_of(SceneryConfig, cfg, "task.scenery"),
        "effectors": _parts_of(Effector, cfg, "task.effectors"),
    }
    bodies = [("task.object", parts["object"])] if parts["object"] is not None else []
    bodies += [(f"task.scenery[{i}]", item) for i, item in enumerate(parts["scenery"])]
    try:
        for where, body in bodies:
            body.check(where)
        for i, effector in enumerate(parts["effectors"]):
            effector.check(f"task.effectors[{i}]", parts["robot"].model)
        _compile(**parts)
    except (ValueError, FileNotFoundError) as error:
        raise ConfigError(one_line(error)) from error
    return parts


def contact_tolerance(cfg: DictConfig) -> dict[str, Any]:
    """How near effectors have to come by the task's interaction reward: its `tolerance`, m, and `reduce`."""
    node = cfg.reward.get("interaction")
    return {key: node[key] for key in ("tolerance", "reduce") if node is not None and key in node}


def _part(cls: type, node: Any, where: str) -> Any:
    part = build(node, where) if OmegaConf.is_dict(node) else None
    if not isinstance(part, cls):
        raise ConfigError(f"{where}: a {cls.__name__} expected, got {node}")
    return part


def _parts_of(cls: type, cfg: DictConfig, where: str) -> list[Any]:
    node = task_node(cfg, where)
    if node is not None and not OmegaConf.is_list(node):
        raise ConfigError(f"{where}: a list expected, got {node}")
    return [_part(cls, item, f"{where}[{i}]") for i, item in enumerate(node or ())]


def _compile(robot: RobotConfig, object: ObjectConfig | None, scenery: Any, effectors: Any) -> None:
    """Compiles a scene without its motion, with boxes for meshes, which take their time.

    Raises:
        ValueError: for what only shows when parts come together, such as two bodies of one name.
    """

    def boxes(body: Any) -> Any:
        geoms = [parse_geom(geom, "") for geom in body.geoms]
        geoms = [geom if geom.mesh is None else GeomConfig(box=(0.1, 0.1, 0.1)) for geom in geoms]
        return replace(body, geoms=geoms)

    if object is not None:
        hinge = None if object.hinge is None else boxes(object.hinge)
        object = boxes(replace(object, hinge=hinge))
    origin = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    placements = {item.name: origin for item in scenery}
    build_scene(robot, SimConfig(), object, [boxes(item) for item in scenery], effectors, placements)


def _robot(cfg: DictConfig) -> RobotConfig:
    values = plain_container(cfg.robot)
    # a config without it is one of a checkpoint from before robots could be chosen
    node = values.pop("model", None) or {"_target_": "hdmi.assets.g1_robot"}
    model = build(node, "robot.model")
    if not isinstance(model, Robot):
        raise ConfigError(f"robot.model: a robot expected, such as of hdmi.assets.g1_robot, got {node}")
    values["model"] = model
    if (unactuated := values.pop("unactuated", "reference")) == "default":
        # what no pattern of the scale matches, the policy does not drive
        scale = "action.joint_position.scale"
        driven = match_names(list(cfg.action.joint_position.scale), model.joint_names, scale)
        values["held"] = [name for i, name in enumerate(model.joint_names) if i not in driven]
    elif unactuated != "reference":
        raise ConfigError(f"robot.unactuated: expected 'reference' or 'default', got {unactuated!r}")
    robot: RobotConfig = build_dataclass(RobotConfig, values, "robot")
    return robot


def make_task(cfg: DictConfig) -> Task:
    """Loads the reference and compiles the scene of a config.

    Raises:
        ConfigError, MotionError: for a node or a motion that cannot be used.
    """
    parts = scene_parts(cfg)
    robot = parts.pop("robot")
    sim = build_dataclass(
        SimConfig, {k: v for k, v in cfg.sim.items() if k not in ("device", "backend", "redraws")}, "sim"
    )
    name = task_node(cfg, "task.name")
    motion = find_motion(task_node(cfg, "task.motion"), cfg.motion_root)
    reference = make_reference(motion, control_dt=sim.control_dt, robot=robot, **parts)
    try:
        scene = build_scene(robot, sim, **parts, placements=reference.placements)
    except ValueError as error:
        raise ConfigError(f"task {name!r}: {one_line(error)}") from error
    return Task(name, scene, reference, start_tables(scene, reference))


def backend_of(cfg: DictConfig) -> Callable[[mujoco.MjModel, int], PhysicsBackend]:
    """What makes the physics backend of a config's sim node from a model and a number of worlds."""

    def make(model: mujoco.MjModel, num_worlds: int) -> PhysicsBackend:
        given = {"device": cfg.sim.device, "num_threads": cfg.num_threads}
        backend: PhysicsBackend = build(cfg.sim.backend, "sim.backend", model=model, num_worlds=num_worlds, **given)
        return backend

    return make


def make_env(
    cfg: DictConfig,
    num_envs: int | None = None,
    task: Task | None = None,
    pixels: tuple[int, int] | None = None,
    backend: Callable[[mujoco.MjModel, int], PhysicsBackend] | None = None,
) -> ResetEnv:
    """The environment of a config: the base environment under the transforms that `cfg.stack` lists.

    Args:
        num_envs: instead of the config's.
        task: made from the config if absent.
        backend: instead of the config's.

    Raises:
        ConfigError: for a node that cannot be built, or that does not stand where it has to (see `hdmi.order`).
    """
    task = make_task(cfg) if task is None else task
    base = HumanoidObjectEnv(task.scene, num_envs or cfg.num_envs, backend or backend_of(cfg), pixels)
    transforms = make_transforms(cfg, task, base.device)
    check_reads(transforms, base)
    for node, transform in transforms:
        try:
            check_row_resets(transform)
        except TypeError as error:
            raise ConfigError(f"{node}: {error}") from error
    stack = Stack(*(transform for _, transform in transforms)).to(base.device)
    settings = {"envs_per_thread": cfg.get("envs_per_thread"), **cfg.get("starts", {})}
    env = (MaskedResetEnv if base.backend.masked else RowResetEnv)(base, stack, **settings)
    # raw keys are dropped, but for what steps read back and what learners and logs want
    entries = list(env.full_observation_spec.keys(True, True))
    state = set(env.full_state_spec.keys(True, True))
    wanted = [key for key in entries if key in state or _top(key) in OUTPUTS]
    env.append_transform(Keep([*wanted, *env.reward_keys, *env.done_keys]))
    return env


def network_inputs(env: TransformedEnv) -> dict[str, dict[str, int]]:
    """What networks are given by an environment: output of each `Concatenate` -> term -> width, in order."""
    _ = env.full_observation_spec  # asked for, transforms know widths
    concatenations = [transform for transform in env.transform if isinstance(transform, Concatenate)]
    return {
        str(transform.out_keys[0]): {
            "/".join((key,) if isinstance(key, str) else key): width for key, width in transform.widths.items()
        }
        for transform in concatenations
    }


def _top(key: Any) -> str:
    return key if isinstance(key, str) else key[0]


def make_transforms(cfg: DictConfig, task: Task, device: torch.device | None = None) -> list[tuple[str, Transform]]:
    """The transforms of a config with the names of their nodes, from the base environment outwards.

    Args:
        device: of the reference that transforms follow; where the task's is if absent.

    Raises:
        ConfigError: for a node that cannot be built, or that does not stand where it has to (see `hdmi.order`).
    """
    robot = task.scene.robot
    context = {
        "joint_names": robot.joint_names,
        "body_names": robot.body_names,
        "joint_ranges": robot.joint_ranges,
        "effort_limits": robot.effort_limits,
        "feet": robot.foot_bodies,
        "robot_mass": robot.total_mass,
        "default_pos": robot.default_joint_pos,
        "servo_stiffness": robot.stiffness,
        "servo_damping": robot.damping,
        "reference": task.reference if device is None else task.reference.to(device),
        "starts": task.starts,
        "total_steps": cfg.total_frames // (cfg.num_envs * num_ranks()),
        "joint_torque": task.joint_torque,  # a second of work that only some stacks need
        "model": task.scene.model,
        "robot_bodies": task.scene.body_ids.tolist(),
        "effectors": task.scene.effectors,
        "object_geoms": task.scene.object_geoms,
        "object_free": task.scene.object_free_dof is not None,
        "control_dt": task.scene.sim.control_dt,
        "decimation": task.scene.sim.decimation,
    }
    stack: list[tuple[str, Transform]] = []
    written: dict[str, list[NestedKey]] = {}  # entry of the stack -> keys
    term_weights: dict[NestedKey, float] = {}  # of the reward terms so far
    so_far = {"written": written, "term_weights": term_weights}
    for entry in cfg.stack:
        keys: list[NestedKey] = []
        for where, node in _nodes(cfg, entry):
            transform = build(node, where, name=where.rpartition(".")[2], **so_far, **context)
            stack.append((where, transform))
            if isinstance(transform, RewardTerm):
                term_weights[transform.out_keys[0]] = transform.weight
            keys += listed_keys(transform, "out_keys") or ()
        written[entry] = keys
    check_order(stack)
    return stack


def num_ranks() -> int:
    """Processes that train together: frames are counted over all of them."""
    return torch.distributed.get_world_size() if torch.distributed.is_initialized() else 1


def _nodes(cfg: DictConfig, entry: str) -> Iterator[tuple[str, Any]]:
    """The nodes of an entry of the stack, with their names: itself if it has a `_target_`, else those in it."""
    found = OmegaConf.select(cfg, entry, default=_ABSENT)
    if found is _ABSENT:
        raise ConfigError(f"stack: the config has no node {entry!r}")
    if found is not None and "_target_" in found:
        yield entry, found
        return
    for name, node in (found or {}).items():
        if node is not None:
            yield f"{entry}.{name}", node


def _class_of(transform: Transform) -> str:
    """The class, and of one that binds any kernel which one that is."""
    name = type(transform).__name__
    return f"{name}: {transform.kernel.name}" if type(transform) in (KernelReward, KernelTermination) else name


def describe(transforms: list[tuple[str, Transform]]) -> Table:
    """The transform stack as a table: node, class, keys read and written, weight."""
    table = Table(title="Transform stack, from the base environment outwards", title_justify="left")
    for column in ("node", "transform", "reads", "writes", "weight"):
        table.add_column(column, justify="right" if column == "weight" else "left", overflow="fold")

    def text(keys: Any) -> str:
        shown = [key if isinstance(key, str) else "/".join(key) for key in keys or []]
        return ", ".join(shown[:4]) + (f", ... ({len(shown)})" if len(shown) > 4 else "")

    for name, transform in transforms:
        reads = [*read_keys(transform), *(listed_keys(transform, "in_keys_inv") or ())]
        writes = [key for name in ("out_keys", "out_keys_inv") for key in listed_keys(transform, name) or ()]
        weight = getattr(transform, "weight", None)
        table.add_row(name, _class_of(transform), text(reads), text(writes), "" if weight is None else f"{weight:g}")
    return table
