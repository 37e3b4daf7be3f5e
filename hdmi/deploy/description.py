"""What a runner knows of a policy besides its graph: joints, servos, limits, sensors and the motion's start."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hdmi.deploy.format import FORMAT, SENSORS, DeploymentError


class PolicyError(DeploymentError):
    """A policy's files that cannot be used; the message names file and entry and says what would be right."""


@dataclass(frozen=True)
class Termination:
    """Errors that end an episode as a failure when one of them stays above its threshold.

    Args:
        errors: name -> threshold: `root_pos`, `object_pos`, `body_pos` (m); `root_ori`, `object_ori`, `body_ori`,
            `object_joint` (rad).
        min_steps: control steps in a row.
    """

    errors: Mapping[str, float]
    min_steps: int = 1


@dataclass(frozen=True)
class Description:
    """A policy's metadata. SI units, quaternions wxyz, joints in the order of `joint_names`.

    Args:
        num_frames: of the motion, one each `control_dt`.
        control_dt: s between ticks of the policy.
        stiffness, damping: of the servos that the policy was trained with, N m/rad and N m s/rad. [J]
        effort_limits: N m. [J]
        velocity_limits: rad/s; may be infinite. [J]
        joint_ranges: rad. [J, 2]
        sensors: shapes of all that the kind of robot measures; a policy may need fewer.
        start: the first frame: `joint_pos`, `root_pos_w`, `root_quat_w`, with an object `object_pos_w`,
            `object_quat_w`, `object_joint_pos`; velocities `joint_vel`, `root_lin_vel_w`, `root_ang_vel_w`.
        max_tilt: largest angle between the root's z axis and the vertical in the motion, rad.
        start_noise: half ranges of the perturbations that training starts the first frame with.
        object_joint: ranges of `friction` (N m, dry) and `damping` (N m s/rad) of the object's joint in training.
        tracked_joints, tracked_bodies: what the errors of an evaluation are of.
        terminations: what an evaluation counts as failures, as far as it can be told from poses.
        unchecked: names of those that cannot.
    """

    robot: str
    task: str
    motion: str
    num_frames: int
    control_dt: float
    joint_names: tuple[str, ...]
    stiffness: np.ndarray
    damping: np.ndarray
    default_joint_pos: np.ndarray
    effort_limits: np.ndarray
    velocity_limits: np.ndarray
    joint_ranges: np.ndarray
    root: str
    sensors: Mapping[str, tuple[int, ...]]
    start: Mapping[str, np.ndarray]
    max_tilt: float = 0.0
    start_noise: Mapping[str, Any] = field(default_factory=dict)
    object_joint: Mapping[str, np.ndarray] = field(default_factory=dict)
    tracked_joints: tuple[str, ...] = ()
    tracked_bodies: tuple[str, ...] = ()
    terminations: Mapping[str, Termination] = field(default_factory=dict)
    unchecked: tuple[str, ...] = ()

    def indices_of(self, joint_names: tuple[str, ...], where: str) -> np.ndarray:
        """Where the policy's joints are among a robot's. int [J]

        Raises:
            PolicyError: if the robot lacks some.
        """
        if missing := [name for name in self.joint_names if name not in joint_names]:
            raise PolicyError(f"{where}: has no joints {', '.join(missing)}, which the policy drives")
        return np.array([joint_names.index(name) for name in self.joint_names])


def read_description(metadata: Mapping[str, str], where: str) -> Description:
    """The description in an ONNX file's metadata, all its lists checked against the number of joints.

    Args:
        where: the file, for messages.

    Raises:
        PolicyError: if there is none, it is of another format, or an entry is missing or wrong.
    """
    if "format" not in metadata:
        raise PolicyError(f"{where}: has no metadata entry 'format'; expected a file of hdmi.deploy.export")
    if metadata["format"] != FORMAT:
        raise PolicyError(f"{where}: format {metadata['format']!r}; this version reads {FORMAT!r}")

    def entry(name: str, read: Callable[[str], Any], default: Any = None) -> Any:
        if name not in metadata:
            if default is not None:
                return default
            raise PolicyError(f"{where}: metadata lacks {name!r}")
        try:
            return read(metadata[name])
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise PolicyError(f"{where}: metadata {name!r} cannot be read: {error}") from error

    names = entry("joint_names", lambda text: tuple(text.split(",")) if text else ())
    if not names:
        raise PolicyError(f"{where}: metadata 'joint_names' is empty")

    def joints(name: str, infinite: bool = False) -> np.ndarray:
        values = entry(name, lambda text: np.array([float(item) for item in text.split(",")]))
        _check(values, (len(names),), f"{where}: metadata {name!r}", infinite)
        return values

    def arrays(text: str) -> dict[str, np.ndarray]:
        return {key: np.asarray(value, dtype=float) for key, value in json.loads(text).items()}

    ranges = entry("joint_ranges", lambda text: np.asarray(json.loads(text), dtype=float))
    _check(ranges, (len(names), 2), f"{where}: metadata 'joint_ranges'", infinite=True)
    sensors = entry("sensors", lambda text: {k: tuple(int(n) for n in v["shape"]) for k, v in json.loads(text).items()})
    if unknown := [name for name in sensors if name not in SENSORS]:
        raise PolicyError(f"{where}: metadata 'sensors': unknown {', '.join(unknown)}; there is {', '.join(SENSORS)}")
    start = entry("start", arrays)
    for name, value in start.items():
        shape = sensors.get(name, value.shape)
        _check(value, shape, f"{where}: metadata 'start': {name!r}")
    if missing := [name for name in ("joint_pos", "root_pos_w", "root_quat_w") if name not in start]:
        raise PolicyError(f"{where}: metadata 'start' lacks {', '.join(missing)}")
    control_dt = entry("control_dt", float)
    if not 0 < control_dt < 1:
        raise PolicyError(f"{where}: metadata 'control_dt': expected seconds between 0 and 1, got {control_dt}")
    return Description(
        robot=entry("robot", str),
        task=entry("task", str, "policy"),
        motion=entry("motion", str, "motion"),
        num_frames=entry("num_frames", int),
        control_dt=control_dt,
        joint_names=names,
        stiffness=joints("joint_stiffness"),
        damping=joints("joint_damping"),
        default_joint_pos=joints("default_joint_pos"),
        effort_limits=joints("effort_limits", infinite=True),
        velocity_limits=joints("velocity_limits", infinite=True),
        joint_ranges=ranges,
        root=entry("anchor_body_name", str),
        sensors=sensors,
        start=start,
        max_tilt=entry("max_tilt", float, 0.0),
        start_noise=entry("start_noise", arrays, {}),
        object_joint=entry("object_joint", arrays, {}),
        tracked_joints=entry("tracked_joints", _names, names),
        tracked_bodies=entry("tracked_bodies", _names, ()),
        terminations=entry("terminations", _terminations, {}),
        unchecked=entry("unchecked_terminations", _names, ()),
    )


def _names(text: str) -> tuple[str, ...]:
    return tuple(name for name in text.split(",") if name)


def _terminations(text: str) -> dict[str, Termination]:
    return {
        name: Termination({k: float(v) for k, v in node["errors"].items()}, int(node["min_steps"]))
        for name, node in json.loads(text).items()
    }


def _check(values: np.ndarray, shape: tuple[int, ...], where: str, infinite: bool = False) -> None:
    if values.shape != tuple(shape):
        raise PolicyError(f"{where}: expected shape {list(shape)}, got {list(values.shape)}")
    if np.isnan(values).any() or (not infinite and not np.isfinite(values).all()):
        raise PolicyError(f"{where}: expected finite numbers")
