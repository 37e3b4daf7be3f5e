"""Reference motions: the file format, and the tensors that training reads."""

from hdmi.motion.check import MotionError
from hdmi.motion.human import SMPL_JOINTS, HumanMotion, ObjectTrajectory
from hdmi.motion.kinematics import forward_kinematics, robot_model
from hdmi.motion.motion import Motion, load_motion, save_motion
from hdmi.motion.playback import Playback, make_playback, reference_qpos
from hdmi.motion.reference import Reference, find_motion, make_reference
from hdmi.motion.skeleton import Skeleton, anthropometric_skeleton, pose_skeleton

__all__ = [
    "SMPL_JOINTS",
    "HumanMotion",
    "Motion",
    "MotionError",
    "ObjectTrajectory",
    "Playback",
    "Reference",
    "Skeleton",
    "anthropometric_skeleton",
    "find_motion",
    "forward_kinematics",
    "load_motion",
    "make_playback",
    "make_reference",
    "pose_skeleton",
    "reference_qpos",
    "robot_model",
    "save_motion",
]
