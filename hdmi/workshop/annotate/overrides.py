"""What a person says of a motion: a short YAML file beside it, `annotation.yaml`.

    object:                       # its pose in a few frames; a trajectory follows from them and the contacts
      - {frame: 0, pos: [0.6, 0.0, 0.2], quat: [1, 0, 0, 0]}
      - {frame: 210, pos: [1.4, 0.0, 0.2]}            # as turned as before
    hinge:                        # the angle of an articulated object's hinge, rad
      - {frame: 0, angle: 0.0}
    contacts:                     # instead of the intervals found for that effector; frames inclusive
      left_wrist_yaw_link:
        - {frames: [40, 180], point: [0.0, 0.15, 0.1]}   # in the object's frame, m; found if absent
      right_wrist_yaw_link: []    # never touches
    points:                       # instead of the point found, in all of that effector's intervals
      left_ankle_roll_link: [0.0, -0.75, 0.1]

Every part may be absent.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from hdmi.motion.check import MotionError

FILE = "annotation.yaml"  # beside the motion
_IDENTITY = (1.0, 0.0, 0.0, 0.0)

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Interval:
    """Frames from `first` to `last` in which an effector touches the object, at `point` in its link's frame.

    Examples:
        >>> from pathlib import Path
        >>> Path(FILE).write_text("contacts: {left_wrist_yaw_link: [{frames: [40, 80]}]}") > 0
        True
        >>> load_overrides(FILE).contacts["left_wrist_yaw_link"]
        (Interval(first=40, last=80, point=None),)
    """

    first: int
    last: int
    point: Point | None = None


@dataclass(frozen=True)
class Overrides:
    """The contents of an annotation file.

    Args:
        object: frame -> position and quaternion (wxyz) in the world.
        hinge: frame -> angle, rad.
        contacts: effector's body -> its intervals.
        points: effector's body -> point in the frame of the object's link, m.

    Examples:
        >>> from pathlib import Path
        >>> Path(FILE).write_text("object: [{frame: 0, pos: [0.4, 0.2, 0.8]}]") > 0
        True
        >>> load_overrides(FILE).object  # position and quaternion
        {0: ((0.4, 0.2, 0.8), (1.0, 0.0, 0.0, 0.0))}
    """

    object: Mapping[int, tuple[Sequence[float], Sequence[float]]] = field(default_factory=dict)
    hinge: Mapping[int, float] = field(default_factory=dict)
    contacts: Mapping[str, tuple[Interval, ...]] = field(default_factory=dict)
    points: Mapping[str, Point] = field(default_factory=dict)


def load_overrides(path: str | Path) -> Overrides:
    """Reads an annotation file.

    Raises:
        MotionError: if it is no YAML of the form above; names the entry.
    """
    try:
        values: Any = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
    except (OSError, UnicodeDecodeError, YAMLError, OmegaConfBaseException) as error:
        raise MotionError(f"{path}: cannot be read: {error}") from error
    _keys(path, "it", values, {"object", "hinge", "contacts", "points"})
    poses: dict[int, tuple[Sequence[float], Sequence[float]]] = {}
    turned: Sequence[float] = _IDENTITY
    for i, row in enumerate(_list(path, "object", values.get("object"))):
        where = f"object[{i}]"
        _keys(path, where, row, {"frame", "pos", "quat"}, {"frame", "pos"})
        turned = _numbers(path, f"{where}.quat", row.get("quat", turned), 4)
        if abs(np.linalg.norm(turned) - 1) > 1e-2:
            raise MotionError(f"{path}: {where}.quat: {list(turned)} is not a unit quaternion")
        poses[_frame(path, f"{where}.frame", row["frame"])] = _numbers(path, f"{where}.pos", row["pos"], 3), turned
    hinge = {}
    for i, row in enumerate(_list(path, "hinge", values.get("hinge"))):
        _keys(path, f"hinge[{i}]", row, {"frame", "angle"}, {"frame", "angle"})
        (hinge[_frame(path, f"hinge[{i}].frame", row["frame"])],) = _numbers(
            path, f"hinge[{i}].angle", [row["angle"]], 1
        )
    spans = _mapping(path, "contacts", values)
    contacts = {
        body: tuple(
            _interval(path, f"contacts.{body}[{i}]", row) for i, row in enumerate(_list(path, f"contacts.{body}", rows))
        )
        for body, rows in spans.items()
    }
    points: dict[str, Any] = {
        body: _numbers(path, f"points.{body}", point, 3) for body, point in _mapping(path, "points", values).items()
    }
    return Overrides(poses, hinge, contacts, points)


def _interval(path: str | Path, where: str, row: Any) -> Interval:
    _keys(path, where, row, {"frames", "point"}, {"frames"})
    frames = row["frames"]
    if not isinstance(frames, list) or len(frames) != 2:
        raise MotionError(f"{path}: {where}.frames: first and last frame expected, got {frames!r}")
    first, last = (_frame(path, f"{where}.frames", frame) for frame in frames)
    if last < first:
        raise MotionError(f"{path}: {where}.frames: the last, {last}, comes before the first, {first}")
    point: Any = None if row.get("point") is None else _numbers(path, f"{where}.point", row["point"], 3)
    return Interval(first, last, point)


def _keys(path: str | Path, where: str, row: Any, known: Collection[str], needed: Collection[str] = ()) -> None:
    if not isinstance(row, dict) or set(row) - set(known) or set(needed) - set(row):
        got = sorted(map(str, row)) if isinstance(row, dict) else repr(row)
        raise MotionError(f"{path}: {where}: a mapping with {sorted(known)} expected, got {got}")


def _list(path: str | Path, where: str, rows: Any) -> list[Any]:
    if not isinstance(rows or [], list):
        raise MotionError(f"{path}: {where}: a list expected, got {rows!r}")
    return rows or []


def _mapping(path: str | Path, key: str, values: dict[str, Any]) -> dict[str, Any]:
    rows = values.get(key) or {}
    if not isinstance(rows, dict):
        raise MotionError(f"{path}: {key}: a mapping of effectors expected, got {rows!r}")
    return rows


def _frame(path: str | Path, where: str, value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise MotionError(f"{path}: {where}: a frame number expected, got {value!r}")
    return value


def _numbers(path: str | Path, where: str, value: Any, count: int) -> tuple[float, ...]:
    try:
        numbers = tuple(float(number) for number in value)
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise MotionError(f"{path}: {where}: {count} numbers expected, got {value!r}")
    return numbers
