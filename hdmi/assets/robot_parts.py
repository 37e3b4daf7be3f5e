"""What the MuJoCo models of all robots have in common: servos, collision shapes, box feet."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from hdmi.assets.robot import COLLISION_GROUP, ROBOT_BIT, Foot

if TYPE_CHECKING:
    from hdmi.assets.robot_config import RobotConfig

_SOLE_HEIGHT = 0.02  # of a box over the centres of its spheres, m


def add_servo(spec: mujoco.MjSpec, joint: str, stiffness: float, effort_limit: float) -> None:
    """Adds a position servo for a joint, of its name.

    Its derivative gain is joint damping: Euler integrates it implicitly, and torque limits then bound the proportional
    part.
    """
    spec.add_actuator(
        name=joint,
        target=joint,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        gainprm=[stiffness] + [0.0] * 9,
        biasprm=[0.0, -stiffness] + [0.0] * 8,
        forcerange=[-effort_limit, effort_limit],
        forcelimited=True,
    )


def collision_kwargs(config: RobotConfig) -> dict[str, Any]:
    """Attributes of the collision geoms that a robot is given."""
    return {
        "group": COLLISION_GROUP,
        "contype": ROBOT_BIT,
        "conaffinity": ROBOT_BIT if config.self_collisions else 0,
        "friction": [config.friction, 0.005, 0.0001],
        "condim": 3,
        "rgba": [0.3, 0.6, 0.3, 0.4],
    }


def add_box_foot(body: mujoco.MjsBody, foot: Foot, name: str, config: RobotConfig) -> None:
    """Adds one box, without mass, that spans the spheres of a foot."""
    points = np.asarray(foot.points)
    low, high = points.min(0) - foot.radius, points.max(0) + foot.radius
    low[2], high[2] = points[0, 2] - foot.radius, points[0, 2] + _SOLE_HEIGHT
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=(low + high) / 2,
        size=(high - low) / 2,
        mass=0.0,
        **collision_kwargs(config),
    )
