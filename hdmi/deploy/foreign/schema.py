"""What the YAML of a network says: its inputs term by term, its action, joints and gains. See docs/foreign.md."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from difflib import get_close_matches
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from hdmi.deploy.description import PolicyError, Termination

try:
    import yaml
except ImportError as error:
    raise ImportError("descriptions of networks need PyYAML: pip install 'hdmi[deploy]'") from error

FORMAT = "hdmi-network/1"
NETWORK = "network"  # as `motion`: the network gives its motion itself
MAX_BYTES = 10_000_000  # of a YAML
PerJoint = float | tuple[float, ...] | Mapping[str, float]  # one for all, in the order of joints, or by pattern


@dataclass(frozen=True)
class Frame:
    """The frame that a term's positions, rotations or velocities are in.

    Args:
        of: `robot`, as measured; `reference`, at the present frame of the motion; or `world`.
        body: its origin and axes; the root if empty.
        turn: `full`: the body's axes; `heading`: only its rotation about the vertical; `none`: the world's axes.
        ground: take the origin down to height 0.
    """

    of: str = "robot"
    body: str = ""
    turn: str = "full"
    ground: bool = False

    def check(self, where: str) -> None:
        one_of(self.of, ("robot", "reference", "world"), f"{where}.of")
        one_of(self.turn, ("full", "heading", "none"), f"{where}.turn")


@dataclass(frozen=True)
class TermSpec:
    """One observation term of an input. Which options a term takes is in `hdmi.deploy.foreign.terms.TERMS`.

    Args:
        term: its name there.
        joints: subset and order; all of the policy's if empty.
        bodies: of the robot, in the order of the input; the root if empty.
        points: m; one for each of `bodies`, in its frame, or points in the object's frame. [K, 3]
        steps: control steps ahead of the present frame of the motion; past its end the last frame stays.
        frame: see `Frame`.
        rotation: see `hdmi.deploy.foreign.terms.ROTATIONS`.
        axes: which of x, y, z; all if empty.
        half_size: of the object's box, m. [3]
        max_norm: length that vectors are shortened to, m.
        period: s for a phase of 1; the motion's length if 0.
        default_pose: instead of the policy's.
        value: of a constant. [D]
        clip: bound of values, before `scale`.
        scale: factor, one or one for each feature.
        lags: control steps back, in the order of the input.
        fill: what the past is in the first tick: `first`, the first value, or `zero`.
        layout: of several lags: `time`, one after another, or `joint`, all lags of one feature after another.
    """

    term: str
    joints: tuple[str, ...] = ()
    bodies: tuple[str, ...] = ()
    points: tuple[tuple[float, ...], ...] = ()
    steps: tuple[int, ...] = (0,)
    frame: Frame = Frame()
    rotation: str = "columns"
    axes: tuple[int, ...] = ()
    half_size: tuple[float, ...] = ()
    max_norm: float = math.inf
    period: float = 0.0
    default_pose: Mapping[str, float] | None = None
    value: tuple[float, ...] = ()
    clip: float = math.inf
    scale: float | tuple[float, ...] = 1.0
    lags: tuple[int, ...] = (0,)
    fill: str = "first"
    layout: str = "time"

    def check(self, where: str) -> None:
        one_of(self.fill, ("first", "zero"), f"{where}.fill")
        one_of(self.layout, ("time", "joint"), f"{where}.layout")
        if not self.lags or min(self.lags) < 0:
            raise PolicyError(f"{where}.lags: expected control steps back, 0 or more, got {list(self.lags)}")
        if not self.steps:
            raise PolicyError(f"{where}.steps: expected control steps ahead, got none")
        if any(len(point) != 3 for point in self.points) or len(self.half_size) not in (0, 3):
            raise PolicyError(f"{where}: points and half_size: expected three numbers each, m")
        if not set(self.axes) <= {0, 1, 2}:
            raise PolicyError(f"{where}.axes: expected some of 0, 1, 2, got {list(self.axes)}")


@dataclass(frozen=True)
class Action:
    """From the network's output to joint position targets: base + scale * output, rad.

    Args:
        base: the motion's present joint positions, `reference`, or targets, `joint_target`; or the `default` pose.
        scale: rad per unit.
        joints: that the network drives, in its order; all if empty. The others follow the base.
        output: its name; the first if empty.
        clip: bound of the output, before `scale`.
    """

    base: str
    scale: PerJoint = 1.0
    joints: tuple[str, ...] = ()
    output: str = ""
    clip: float = math.inf

    def check(self, where: str) -> None:
        one_of(self.base, ("reference", "joint_target", "default"), f"{where}.base")


@dataclass(frozen=True)
class NetworkSpec:
    """A network and what it needs; SI units, quaternions wxyz. Paths are relative to the YAML.

    Args:
        network: ONNX file.
        joints: that are commanded: the order of every list per joint.
        inputs: terms by the name of the network's input, in the order of features.
        stiffness, damping: of the servos, N m/rad and N m s/rad.
        default_pose: rad; joints that no pattern matches are at 0.
        motion: folder of a reference motion, or `network`: its outputs joint_pos, joint_vel, body_pos_w, body_quat_w.
        motion_bodies: of these outputs.
        scene: MJCF file of robot, floor and object, with a position servo of each joint's name.
        states: recurrent input -> output that it takes in the next tick; zeros in the first.
        object, object_joint: names of the object's body and hinge in the motion.
        contact_bodies: that the motion's contact labels and points are of, in their order.
        effort_limits, velocity_limits: N m, rad/s; the scene's, and none, if absent.
        start_noise, terminations, tracked_joints, tracked_bodies, unchecked, object_joint_ranges: see `Description`.
    """

    network: str
    joints: tuple[str, ...]
    inputs: Mapping[str, tuple[TermSpec, ...]]
    action: Action
    stiffness: PerJoint
    damping: PerJoint
    default_pose: PerJoint = field(default_factory=dict)
    motion: str = "motion"
    motion_bodies: tuple[str, ...] = ()
    scene: str = "scene.xml"
    robot: str = "robot"
    task: str = "policy"
    control_dt: float = 0.02
    states: Mapping[str, str] = field(default_factory=dict)
    object: str = ""
    object_joint: str = ""
    contact_bodies: tuple[str, ...] = ()
    effort_limits: PerJoint | None = None
    velocity_limits: PerJoint | None = None
    start_noise: Mapping[str, float | tuple[float, ...]] = field(default_factory=dict)
    terminations: Mapping[str, Termination] = field(default_factory=dict)
    tracked_joints: tuple[str, ...] = ()
    tracked_bodies: tuple[str, ...] = ()
    unchecked: tuple[str, ...] = ()
    object_joint_ranges: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    format: str = FORMAT

    def check(self, where: str) -> None:
        if self.format != FORMAT:
            raise PolicyError(f"{where}.format: {self.format!r}; this version reads {FORMAT!r}")
        if not self.joints or len(set(self.joints)) != len(self.joints):
            raise PolicyError(f"{where}.joints: expected names, each once")
        if not 0 < self.control_dt < 1:
            raise PolicyError(f"{where}.control_dt: expected seconds between 0 and 1, got {self.control_dt}")
        if unknown := [name for name in self.action.joints if name not in self.joints]:
            raise PolicyError(f"{where}.action.joints: {', '.join(unknown)}: not among joints")


def read_spec(path: str | Path) -> NetworkSpec:
    """The description in a YAML file.

    Raises:
        PolicyError: if there is no such file, or a key is unknown, missing or wrong; names file and key.
    """
    return parse_spec(read_yaml(path), str(path))


def read_yaml(path: str | Path) -> Any:
    """Plain values of a YAML file; tags that would make objects are refused.

    Raises:
        PolicyError: if there is no such file, or it is no YAML.
    """
    path = Path(path)
    if not path.is_file():
        raise PolicyError(f"{path}: there is no such file")
    if path.stat().st_size > MAX_BYTES:
        raise PolicyError(f"{path}: has {path.stat().st_size} bytes, more than a description")
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise PolicyError(f"{path}: is no YAML: {' '.join(str(error).split())}") from error


def parse_spec(node: Any, where: str) -> NetworkSpec:
    """The description from plain values.

    Raises:
        PolicyError: as `read_spec`.
    """
    return _build(NetworkSpec, node, where)


def write_spec(values: Mapping[str, Any], path: str | Path) -> Path:
    """Writes plain values as YAML, after reading them as a description.

    Raises:
        PolicyError: if they are none.
        OSError: if the file cannot be written.
    """
    parse_spec(values, str(path))
    text = yaml.safe_dump({"format": FORMAT, **values}, sort_keys=False, width=120, default_flow_style=None)
    Path(path).write_text(text, encoding="utf-8")
    return Path(path)


def per_joint(values: PerJoint, names: Sequence[str], where: str, default: float = 0.0) -> np.ndarray:
    """A number for each joint: one for all, a list in their order, or by pattern, of which the last match counts.

    Raises:
        PolicyError: for a list of another length, or a pattern that is none or matches nothing.
    """
    found = np.full(len(names), default)
    if isinstance(values, Mapping):
        for pattern, value in values.items():
            try:
                hits = [i for i, name in enumerate(names) if re.fullmatch(pattern, name)]
            except re.error as error:
                raise PolicyError(f"{where}: {pattern!r} is no pattern: {error}") from error
            if not hits:
                raise PolicyError(f"{where}: {pattern!r} matches none of {', '.join(names)}")
            found[hits] = value
    elif isinstance(values, tuple):
        if len(values) != len(names):
            raise PolicyError(f"{where}: has {len(values)} numbers for {len(names)} joints")
        found[:] = values
    else:
        found[:] = values
    return found


def one_of(value: str, names: Sequence[str], where: str) -> None:
    """Raises PolicyError for a value that is none of the names; says which is closest."""
    if value not in names:
        close = get_close_matches(value, names, 1)
        hint = f" (did you mean {close[0]}?)" if close else ""
        raise PolicyError(f"{where}: there is no {value!r}{hint}; there is {', '.join(names)}")


def _build(cls: Any, node: Any, where: str) -> Any:
    """A dataclass from a mapping of its fields."""
    if not isinstance(node, Mapping):
        raise PolicyError(f"{where}: expected keys and values, got {_short(node)}")
    hints = get_type_hints(cls)
    for key in node:
        one_of(str(key), list(hints), where)
    for item in fields(cls):
        if item.default is MISSING and item.default_factory is MISSING and item.name not in node:
            raise PolicyError(f"{where}: lacks {item.name!r}")
    built = cls(**{key: _convert(hints[key], value, f"{where}.{key}") for key, value in node.items()})
    if hasattr(built, "check"):
        built.check(where)
    return built


def _convert(kind: Any, value: Any, where: str) -> Any:
    """A plain value as what a field's type says."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        chosen = [part for part in parts if _fits(part, value)]
        if not chosen:
            raise PolicyError(f"{where}: expected {' or '.join(_called(part) for part in parts)}, got {_short(value)}")
        return _convert(chosen[0], value, where)
    if not _fits(kind, value):
        raise PolicyError(f"{where}: expected {_called(kind)}, got {_short(value)}")
    if kind is NoneType:
        return None
    if origin is tuple:
        return tuple(_convert(parts[0], item, f"{where}[{i}]") for i, item in enumerate(value))
    if origin is not None:  # a mapping
        return {str(key): _convert(parts[1], item, f"{where}.{key}") for key, item in value.items()}
    if is_dataclass(kind):
        return _build(kind, value, where)
    if kind is float and not math.isfinite(float(value)):
        raise PolicyError(f"{where}: expected a finite number, got {value}")
    return kind(value)


def _fits(kind: Any, value: Any) -> bool:
    origin = get_origin(kind)
    if kind is NoneType:
        return value is None
    if origin is tuple:
        return isinstance(value, list | tuple)
    if origin is not None or is_dataclass(kind):
        return isinstance(value, Mapping)
    if kind is float:
        return (isinstance(value, int | float) and not isinstance(value, bool)) or _is_number(value)
    return isinstance(value, kind) and (kind is bool or not isinstance(value, bool))


def _is_number(value: Any) -> bool:
    """Whether a text is a number: 1e-3 is a text in YAML 1.1."""
    try:
        return isinstance(value, str) and math.isfinite(float(value))
    except ValueError:
        return False


def _called(kind: Any) -> str:
    origin = get_origin(kind)
    if origin is tuple:
        return "a list"
    if origin is not None or is_dataclass(kind):
        return "keys and values"
    return {str: "a text", bool: "true or false", int: "a whole number", float: "a number", NoneType: "null"}[kind]


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) < 60 else text[:57] + "..."
