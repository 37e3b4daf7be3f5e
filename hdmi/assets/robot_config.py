"""What a task varies of a robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import mujoco
import numpy as np

from hdmi.assets.g1_model import g1_robot
from hdmi.assets.robot import Robot, per_joint
from hdmi.names import match_names


@dataclass(frozen=True)
class RobotConfig:
    """Which robot to build, and how.

    Args:
        model: the robot; the Unitree G1 if none is given.
        feet: the spheres of the feet's soles, or one box spanning them for each foot (climbing, kicking).
        effector: `capsule` keeps the hands' shapes; `hand` replaces them by a box around the palm, `L` adds two thin
            boxes that hook over an edge.
        self_collisions: let robot geoms collide with each other (parent and child excepted).
        stiffness, damping: joint name pattern -> N m/rad and N m s/rad, instead of the model's servos'.
        default_pose: joint name pattern -> rad, over the standing pose: where joints are that a motion lacks, what
            observations and the action space without residual are relative to.
        held: joint name patterns: these hold the default pose, whatever a motion says; see
            `hdmi.motion.make_reference`.
        friction: sliding friction of all robot geoms.
        mesh_dir: folder with `<body>.STL` files, used as visuals instead of primitives; for the G1, Unitree's.

    Examples:
        >>> crouched = RobotConfig(feet="box", default_pose={".*_knee_joint": 1.0})
        >>> float(crouched.default_joint_pos[g1.JOINT_NAMES.index("left_knee_joint")])
        1.0
        >>> build_scene(crouched, SimConfig()).model.nu
        29
    """

    model: Robot = field(default_factory=g1_robot)
    feet: Literal["sphere", "box"] = "sphere"
    effector: Literal["capsule", "hand", "L"] = "capsule"
    self_collisions: bool = False
    stiffness: Mapping[str, float] = field(default_factory=dict)
    damping: Mapping[str, float] = field(default_factory=dict)
    default_pose: Mapping[str, float] = field(default_factory=dict)
    held: Sequence[str] = ()
    friction: float = 1.0
    mesh_dir: str | None = None

    def __post_init__(self) -> None:
        model = self.model
        for name, angle, (low, high) in zip(model.joint_names, self.default_joint_pos, model.joint_ranges, strict=True):
            if not low <= angle <= high:
                raise ValueError(f"robot.default_pose: {name} at {angle:g} rad is outside of its range {low}..{high}")

    @property
    def default_joint_pos(self) -> np.ndarray:
        """Joint angles of the default pose, rad. [J]"""
        model = self.model
        return per_joint(self.default_pose, model.joint_names, model.default_joint_pos, "robot.default_pose")

    @property
    def held_joints(self) -> list[str]:
        """Names of the joints that hold the default pose, in the model's order."""
        names = self.model.joint_names
        return [names[i] for i in match_names(self.held, names, "robot.held")]

    @property
    def robot(self) -> Robot:
        """The model with this config's servos and default pose.

        Raises:
            ValueError: for a gain pattern that matches no joint.
        """
        model = self.model
        stiffness = per_joint(self.stiffness, model.joint_names, model.stiffness, "robot.stiffness")
        damping = per_joint(self.damping, model.joint_names, model.damping, "robot.damping")
        return replace(
            model,
            stiffness=tuple(stiffness.tolist()),
            damping=tuple(damping.tolist()),
            default_joint_pos=tuple(self.default_joint_pos.tolist()),
        )


def add_robot(spec: mujoco.MjSpec, config: RobotConfig) -> mujoco.MjSpec:
    """Adds the robot's bodies, joints, servos, sites and geoms to `spec`, with a free root joint.

    Returns:
        The spec to go on with.

    Raises:
        ValueError: for an unknown foot or effector kind, or one that the robot cannot have; a gain pattern that
            matches no joint.
        FileNotFoundError: if `mesh_dir` lacks a body's mesh.
    """
    model = config.model
    if config.feet not in ("sphere", "box"):
        raise ValueError(f"robot.feet: expected 'sphere' or 'box', got {config.feet!r}")
    if config.effector not in ("capsule", "hand", "L"):
        raise ValueError(f"robot.effector: expected 'capsule', 'hand' or 'L', got {config.effector!r}")
    if config.feet == "box" and (without := [foot.body for foot in model.feet if not foot.points]):
        raise ValueError(f"robot.feet: a box spans spheres, and {without[0]!r} of {model.name} has none; use 'sphere'")
    if config.effector != "capsule" and not model.hands:
        raise ValueError(f"robot.effector: {model.name} has no hands to choose {config.effector!r} for; use 'capsule'")
    return model.add(spec, config)
