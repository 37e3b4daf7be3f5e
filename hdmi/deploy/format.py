"""What an exported policy consists of: names of its files, sensors with their units and frames. No torch in here."""

from __future__ import annotations

from pathlib import Path


class DeploymentError(ValueError):
    """A policy that cannot leave the trainer; the message names what is wrong with it."""


FORMAT = "hdmi-policy/1"
GRAPH_FILE = "policy.onnx"
SCENE_FILE = "scene.xml"
REFERENCE_FILE = "reference.npz"
NETWORK_FILE, SPEC_FILE, MOTION_FOLDER = "network.onnx", "policy.yaml", "motion"  # for other runners
TARGET = "joint_pos_target"  # rad, [J]

# World frame, quaternions wxyz, SI units.
SENSORS: dict[str, dict[str, str]] = {
    "joint_pos": {"unit": "rad", "frame": "joint", "source": "encoders"},
    "joint_vel": {"unit": "rad/s", "frame": "joint", "source": "encoders"},
    "root_quat_w": {"unit": "1", "frame": "world", "source": "IMU, its heading from motion capture"},
    "root_ang_vel_b": {"unit": "rad/s", "frame": "root", "source": "IMU"},
    "root_pos_w": {"unit": "m", "frame": "world", "source": "motion capture"},
    "object_pos_w": {"unit": "m", "frame": "world", "source": "motion capture"},
    "object_quat_w": {"unit": "1", "frame": "world", "source": "motion capture"},
    "object_joint_pos": {"unit": "rad", "frame": "joint", "source": "motion capture"},
}

# float32, a row for each frame of the motion; the object's only with an object.
REFERENCE = (
    "joint_pos", "root_pos_w", "root_quat_w", "object_pos_w", "object_quat_w", "object_joint_pos",
)  # fmt: skip


def scene_of(files: Path) -> Path:
    """The scene's file, of a policy's folder, or that file itself."""
    return files if files.suffix == ".xml" else files / SCENE_FILE
