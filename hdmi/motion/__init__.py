"""Reference motions: the file format, and the tensors that training reads."""

from hdmi.motion.kinematics import forward_kinematics, robot_model
from hdmi.motion.motion import Motion, MotionError, load_motion, save_motion
from hdmi.motion.reference import Reference, find_motion, make_reference

__all__ = [
    "Motion",
    "MotionError",
    "Reference",
    "find_motion",
    "forward_kinematics",
    "load_motion",
    "make_reference",
    "robot_model",
    "save_motion",
]
