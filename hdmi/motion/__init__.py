"""Reference motions: the file format, and the tensors that training reads."""

from hdmi.motion.check import MotionError
from hdmi.motion.format import Motion, load_motion, save_motion
from hdmi.motion.kinematics import forward_kinematics, robot_model
from hdmi.motion.playback import Playback, make_playback, reference_qpos
from hdmi.motion.reference import Reference, find_motion, make_reference, motion_digest

__all__ = [
    "Motion",
    "MotionError",
    "Playback",
    "Reference",
    "find_motion",
    "forward_kinematics",
    "load_motion",
    "make_playback",
    "make_reference",
    "motion_digest",
    "reference_qpos",
    "robot_model",
    "save_motion",
]
