"""Robot and object models, built with MjSpec from plain tables of figures."""

from hdmi.assets import g1
from hdmi.assets.objects import GeomConfig, HingeConfig, ObjectConfig, SceneryConfig, parse_geom
from hdmi.assets.robot import RobotConfig, default_joint_pos, per_joint
from hdmi.assets.scene import Effector, Scene, SimConfig, build_scene
from hdmi.names import match_names

__all__ = [
    "Effector",
    "GeomConfig",
    "HingeConfig",
    "ObjectConfig",
    "RobotConfig",
    "Scene",
    "SceneryConfig",
    "SimConfig",
    "build_scene",
    "default_joint_pos",
    "g1",
    "match_names",
    "parse_geom",
    "per_joint",
]
