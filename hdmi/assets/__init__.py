"""Robot and object models, built with MjSpec from plain tables of figures or from files."""

from hdmi.assets import g1
from hdmi.assets.g1_model import default_joint_pos, g1_robot
from hdmi.assets.mjcf import mjcf_robot
from hdmi.assets.objects import GeomConfig, HingeConfig, ObjectConfig, SceneryConfig, parse_geom
from hdmi.assets.robot import Foot, Robot, per_joint
from hdmi.assets.robot_config import RobotConfig, add_robot
from hdmi.assets.scene import Effector, Scene, SimConfig, build_scene
from hdmi.names import match_names

__all__ = [
    "Effector",
    "Foot",
    "GeomConfig",
    "HingeConfig",
    "ObjectConfig",
    "Robot",
    "RobotConfig",
    "Scene",
    "SceneryConfig",
    "SimConfig",
    "add_robot",
    "build_scene",
    "default_joint_pos",
    "g1",
    "g1_robot",
    "match_names",
    "mjcf_robot",
    "parse_geom",
    "per_joint",
]
