"""Pure tensor functions: rotations, tracking errors, reward and termination kernels."""

from hdmi.functional.pose import body_velocity, local_pose
from hdmi.functional.reward import (
    action_rate,
    feet_air_time,
    feet_impact,
    feet_slip,
    feet_stumble,
    interaction,
    limit_excess,
    tracking,
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
    yaw_quat,
)
from hdmi.functional.termination import contact_lost, error_exceeds, persist

__all__ = [
    "action_rate",
    "body_velocity",
    "contact_lost",
    "error_exceeds",
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
    "tracking",
    "yaw_quat",
]
