"""What the rest of the package knows of a robot: a record of names and figures, and how to build it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hdmi.names import match_names

if TYPE_CHECKING:
    import mujoco

    from hdmi.assets.robot_config import RobotConfig

# Bit masks: robot geoms meet floor, scenery and object; each other only with self-collisions.
ROBOT_BIT, WORLD_BIT = 1, 2
VISUAL_GROUP, COLLISION_GROUP = 1, 3

NATURAL_FREQUENCY = 2 * math.pi * 10.0  # of the joint servos, rad/s
DAMPING_RATIO = 2.0


class Foot(NamedTuple):
    """A body that stands on the floor, and the spheres that its sole consists of.

    Examples:
        >>> [foot.body for foot in g1_robot().feet]
        ['left_ankle_roll_link', 'right_ankle_roll_link']
    """

    body: str
    points: tuple[tuple[float, ...], ...] = ()  # centres in the body's frame, m; none: other shapes are its sole
    radius: float = 0.0  # m


@dataclass(frozen=True)
class Robot:
    """A humanoid with a free root: B bodies, J hinge joints with a position servo each.

    Bodies and joints are in the order that they have in a compiled model of the robot alone; parents come first. SI
    units. `RobotConfig` says what a task varies; `Scene.robot` is the record with that in it.

    Args:
        name: for messages.
        body_names: the root is the first. [B]
        body_parents: names; the root's is `world`. [B]
        joint_names: [J]
        joint_bodies: that each joint moves, with what hangs from it. [J]
        joint_ranges: rad. [J, 2]
        effort_limits: N m. [J]
        velocity_limits: rad/s; infinite where there is none. [J]
        stiffness, damping: of the servos, N m/rad and N m s/rad. [J]
        armature: reflected inertia of the motors, kg m^2. [J]
        default_joint_pos: of the standing pose, rad. [J]
        root_height: of the standing pose, m.
        total_mass: kg.
        feet: whose contact forces are measured.
        hands: bodies whose shape `RobotConfig.effector` chooses.
        add: puts the robot, as a config varies it, into a spec, with a free root joint and an actuator for each joint,
            named as the joints and in their order; returns the spec to go on with.

    Examples:
        >>> robot = g1_robot()
        >>> robot.root, len(robot.joint_names), len(robot.feet)
        ('pelvis', 29, 2)
    """

    name: str
    body_names: tuple[str, ...]
    body_parents: tuple[str, ...]
    joint_names: tuple[str, ...]
    joint_bodies: tuple[str, ...]
    joint_ranges: tuple[tuple[float, ...], ...]
    effort_limits: tuple[float, ...]
    velocity_limits: tuple[float, ...]
    stiffness: tuple[float, ...]
    damping: tuple[float, ...]
    armature: tuple[float, ...]
    default_joint_pos: tuple[float, ...]
    root_height: float
    total_mass: float
    feet: tuple[Foot, ...]
    add: Callable[[mujoco.MjSpec, RobotConfig], mujoco.MjSpec]
    hands: tuple[str, ...] = ()

    @property
    def root(self) -> str:
        """Name of the body with the free joint."""
        return self.body_names[0]

    @property
    def foot_bodies(self) -> tuple[str, ...]:
        """Names of the bodies of the feet."""
        return tuple(foot.body for foot in self.feet)

    def bodies_after(self, joints: Sequence[str]) -> set[str]:
        """Names of the bodies that joints move."""
        moved = {body for joint, body in zip(self.joint_names, self.joint_bodies, strict=True) if joint in joints}
        for body, parent in zip(self.body_names, self.body_parents, strict=True):
            if parent in moved:
                moved.add(body)
        return moved


def servo_gains(armature: float) -> tuple[float, float]:
    """Stiffness (N m/rad) and damping (N m s/rad) of a 10 Hz servo with damping ratio 2."""
    return armature * NATURAL_FREQUENCY**2, 2 * DAMPING_RATIO * armature * NATURAL_FREQUENCY


def per_joint(
    values: Mapping[str, float],
    names: Sequence[str],
    default: float | Sequence[float] | np.ndarray = 0.0,
    where: str = "joints",
) -> np.ndarray:
    """Expands `{pattern: value}` to the order of joint names; the last matching pattern wins. [J]"""
    out = np.full(len(names), default, dtype=float)
    for pattern, value in values.items():
        out[match_names([pattern], names, where)] = value
    return out
