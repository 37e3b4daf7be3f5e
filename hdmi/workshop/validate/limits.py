"""What validation asks of a motion: one row for each check."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Limit:
    """Bounds of a checked quantity; larger is worse.

    Args:
        good: up to here nothing is wrong.
        bad: above it the motion is worse than those this was set by; infinite for what alone never condemns a motion.
        unit: of both.
        about: what is measured, of the worst body, joint or effector in a frame.
        share: of the frames that the check applies to may lie above either bound.

    Examples:
        >>> from hdmi.motion import find_motion, load_motion
        >>> slow = LIMITS | {"joint_velocity": Limit(0.1, 0.2, "of limit", "joint speed")}
        >>> validate_motion(load_motion(find_motion("walk")), limits=slow).verdict
        'bad'
    """

    good: float
    bad: float
    unit: str
    about: str
    share: float = 0.0


# `good` is what can be asked of a clean reference; `bad` lies beyond the worst of the ten public HDMI motions that
# docs/motions.md lists. It is no proof: policies have been trained on others that are bad by one check or another.
LIMITS: dict[str, Limit] = {
    # names and consistency
    "missing_joints": Limit(6, 14, "joints", "joints of the robot that the motion lacks: they hold the default pose"),
    "fk_position": Limit(0.005, 0.03, "m", "body position against forward kinematics of root and joints"),
    "fk_orientation": Limit(0.02, 0.1, "rad", "body orientation against forward kinematics"),
    "joint_velocity_error": Limit(1.0, 5.0, "rad/s", "stored joint velocity against differences of positions", 0.01),
    "body_velocity_error": Limit(0.3, 1.5, "m/s", "stored body velocity against differences of positions", 0.01),
    # limits of the robot
    "joint_limit": Limit(0.005, 0.1, "rad", "joint angle beyond its range"),
    "joint_velocity": Limit(1.0, 1.3, "of limit", "joint speed"),
    "torque": Limit(0.9, 2.0, "of limit", "joint torque by inverse dynamics", 0.02),
    # smoothness
    "acceleration": Limit(80.0, 200.0, "m/s^2", "second difference of a body's position"),
    "joint_acceleration": Limit(400.0, 1500.0, "rad/s^2", "second difference of a joint angle"),
    "jerk": Limit(2500.0, 6000.0, "m/s^3", "third difference of a body's position", 0.01),
    # ground
    "standing_height": Limit(0.01, 0.1, "m", "lowest part of the robot above ground, in the median frame", 0.5),
    "floating": Limit(0.03, 0.15, "m", "lowest part of the robot above ground, while not in flight", 0.02),
    "ground_penetration": Limit(0.015, 0.06, "m", "robot inside floor or scenery", 0.02),
    "foot_slide": Limit(0.15, 0.5, "m/s", "planted foot, at its slowest point", 0.05),
    "ground_force": Limit(0.1, math.inf, "weights", "force that the robot needs and no contact can give", 0.05),
    "centre_of_pressure": Limit(0.05, 0.3, "m", "needed centre of pressure outside the support", 0.05),
    # object
    "object_penetration": Limit(0.01, 0.08, "m", "robot, effectors excepted, inside the object", 0.02),
    "grip_depth": Limit(0.03, 0.1, "m", "effector inside the object", 0.02),
    "object_in_ground": Limit(0.015, 0.06, "m", "object inside floor or scenery", 0.02),
    "object_floating": Limit(0.02, math.inf, "m", "object at rest above ground, touched by nothing", 0.02),
    "object_force": Limit(0.1, math.inf, "weights", "force that the object needs and no contact can give", 0.05),
    # labels
    "contact_gap": Limit(0.03, 0.2, "m", "effector away from the object while its label is on", 0.05),
    "contact_point": Limit(
        0.12, 0.4, "m", "effector's point away from its contact point (less the tolerance) while its label is on", 0.05
    ),
    "unlabelled_contact": Limit(0.1, math.inf, "m/s", "object that an effector moves while its label is off", 0.05),
}
