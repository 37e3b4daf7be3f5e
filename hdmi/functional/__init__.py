"""Pure tensor functions: rotations, servo targets, tracking errors, reward and termination kernels."""

from hdmi.functional.control import feedforward_target, spring_wrench
from hdmi.functional.pose import body_velocity, local_pose
from hdmi.functional.reward import (
    action_rate,
    alive,
    feet_air_time,
    feet_impact,
    feet_slip,
    feet_stumble,
    interaction,
    limit_excess,
    sum_of_squares,
    tracking,
    tracking_mean,
)
from hdmi.functional.rotation import (
    quat_angle,
    quat_apply,
    quat_apply_inverse,
    quat_conjugate,
    quat_from_axis_angle,
    quat_from_euler,
    quat_multiply,
    quat_to_rot6d,
    quat_to_rotation_vector,
    yaw_quat,
)
from hdmi.functional.termination import any_error_exceeds, contact_lost, error_exceeds, persist

__all__ = [
    "action_rate",
    "alive",
    "any_error_exceeds",
    "body_velocity",
    "contact_lost",
    "error_exceeds",
    "feedforward_target",
    "feet_air_time",
    "feet_impact",
    "feet_slip",
    "feet_stumble",
    "interaction",
    "limit_excess",
    "local_pose",
    "persist",
    "quat_angle",
    "quat_apply",
    "quat_apply_inverse",
    "quat_conjugate",
    "quat_from_axis_angle",
    "quat_from_euler",
    "quat_multiply",
    "quat_to_rot6d",
    "quat_to_rotation_vector",
    "spring_wrench",
    "sum_of_squares",
    "tracking",
    "tracking_mean",
    "yaw_quat",
]
