"""Plans: motions written down as keyframes, read from YAML and checked.

All times are seconds or names from `phases`, lengths metres, angles radians. A key takes over whatever it does not name
from the key before it; between keys everything moves with minimum jerk and rests at them.

| node       | what it holds                                                                                       |
|------------|-----------------------------------------------------------------------------------------------------|
| duration   | of the motion                                                                                       |
| phases     | names for times: `{reach: 0.2, lift: 1.6}`                                                          |
| start      | the feet side by side: `{pos: [x, y, z], yaw: 0, width: 0.238}`                                     |
| feet       | `{walk: [[x, y, yaw], ...], start, end, length, turn, step_time, first, height, z}`: steps along a  |
|            | root path;                                                                                          |
|            | `{step: left, start, end, to: [x, y, yaw], z, height, via: [pose keys]}`: one foot, on a way of its own|
| heels      | `{left: [{at, pitch}]}`: heel raised by turning about the toes                                       |
| pelvis     | `{at, height, pitch}`: above the ground under the feet                                              |
| torso      | `{at, lean, gaze, roll}`: pitch, yaw and roll against the heading                                   |
| hands      | `left`, `right`: pose keys; `both`: the left hand's, mirrored for the right                         |
| object     | `path`: pose keys; `hinge`: `{at, angle}`; `carried`: four times between which its weight is taken  |
|            | up and put down; `rolls`: radius with which it rolls along its path                                 |
| push       | `{at, force: [x, y, z]}`: what the object exerts on the robot besides its weight, at the hands, N   |
| balance    | `{at, over}`: centre of pressure: `feet` or `[x, y]`                                                |
| scenery    | `{name: {pos, rpy}}`                                                                                |
| posture    | joint name pattern -> rad: what free joints tend to, where it is not the default pose               |
| arm_posture| weight of the arms' posture, per rad (a hand has 10 per m): less lets elbows follow further          |
| turning    | weight of the hands' orientations, per rad, where the task's robot holds its wrists             |
| corrections| rounds that move the centre of mass until the centre of pressure, dynamics included, is as planned  |

A pose key: `{at, frame, pos, rpy, point, out, gap, contact, rest, attach}`. `pos` and `rpy` are in `frame`: `world`,
`root` (heading frame on the ground between the feet), `torso`, `object` (the link that contact points are fixed to),
`object_position` (world axes at the object), or the name of a piece of scenery. For an end effector of the task, `pos`
and `point` (on the body) default to its target and point; `gap` moves it along `out`, off the surface or, below zero,
into it. `contact: true` labels the contact from there on until a key with `contact: false`; with `contact: here` the
contact point is the key's `pos` on the object instead of the task's target. `rest: true` hangs a hand at its side;
`attach: FRAME` leaves an object or hand where it is and lets it move with the frame from there on.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from hdmi.assets import g1
from hdmi.motion.format import MotionError

SIDES = ("left", "right")
_PLANS = Path(__file__).parent / "plans"

Vector = tuple[float, ...]


class PlanError(MotionError):
    """A plan that cannot be read or solved; the message names the file and the key.

    Examples:
        >>> from pathlib import Path
        >>> parse_plan({"duration": 2.0, "hips": []}, Path("squat.yaml"))
        Traceback (most recent call last):
        hdmi.workshop.author.plan.PlanError: squat.yaml: unknown 'hips'; there is duration, phases, ...
    """


@dataclass(frozen=True)
class PoseKey:
    """A pose at a time, in a frame that may move; see the module."""

    time: float
    frame: str = "world"
    pos: Vector | None = None
    rpy: Vector = (0.0, 0.0, 0.0)
    point: Vector | None = None
    out: Vector = (0.0, 0.0, 0.0)
    gap: float = 0.0
    contact: bool = False
    here: bool = False  # the contact point is `pos`, not the task's target
    attach: str | None = None
    where: str = field(default="", compare=False)  # file and key, for messages


@dataclass(frozen=True)
class ValueKey:
    """Named values at a time."""

    time: float
    values: Mapping[str, Any]


@dataclass(frozen=True)
class Step:
    """One foot leaves the ground and lands at (x, y, yaw) and height z, over `via` if given."""

    side: str
    start: float
    end: float
    to: Vector
    z: float = 0.0
    height: float = 0.06
    via: tuple[PoseKey, ...] = ()


@dataclass(frozen=True)
class Walk:
    """Steps along a root path from where the feet stand."""

    path: tuple[Vector, ...]
    start: float
    end: float
    length: float = 0.25
    turn: float = 0.4
    first: str | None = None
    height: float = 0.06
    step_time: float = 0.45  # s; slower ones need a balance between steps that soft ankles do not have
    double_support: float = 0.25  # share of a step's time
    z: float | None = None  # of the ground that it leads onto; where the feet are if absent
    where: str = field(default="", compare=False)


@dataclass(frozen=True)
class Plan:
    """A motion written down as keyframes; see the module.

    Examples:
        >>> plan = load_plan(find_plan("lift_box"))
        >>> plan.duration, sorted(plan.hands)
        (6.0, ['left', 'right'])
    """

    name: str
    file: Path
    duration: float
    start_pos: Vector = (0.0, 0.0, 0.0)
    start_yaw: float = 0.0
    width: float = 0.238
    feet: tuple[Step | Walk, ...] = ()
    heels: Mapping[str, tuple[ValueKey, ...]] = field(default_factory=dict)
    pelvis: tuple[ValueKey, ...] = ()
    torso: tuple[ValueKey, ...] = ()
    hands: Mapping[str, tuple[PoseKey, ...]] = field(default_factory=dict)
    object_path: tuple[PoseKey, ...] = ()
    hinge: tuple[ValueKey, ...] = ()
    carried: Vector | None = None
    rolls: float | None = None
    push: tuple[ValueKey, ...] = ()
    balance: tuple[ValueKey, ...] = ()
    scenery: Mapping[str, PoseKey] = field(default_factory=dict)
    posture: Mapping[str, float] = field(default_factory=dict)
    arm_posture: float = 0.05
    turning: float = 0.1
    corrections: int = 2


class _Node:
    """A mapping of the plan with its place in the file; every problem is an error that says where."""

    def __init__(self, value: Any, where: str, phases: Mapping[str, float]):
        if not isinstance(value, Mapping):
            raise PlanError(f"{where}: expected a mapping, got {value!r}")
        self.value, self.where, self.phases = value, where, phases
        self.place = where.removesuffix(": ")  # for messages about the file as a whole

    def only(self, *known: str) -> None:
        if unknown := [key for key in self.value if key not in known]:
            raise PlanError(f"{self.place}: unknown {', '.join(map(repr, unknown))}; there is {', '.join(known)}")

    def get(self, key: str, default: Any = ...) -> Any:
        if key not in self.value:
            if default is ...:
                raise PlanError(f"{self.place}: lacks {key!r}")
            return default
        return self.value[key]

    def number(self, key: str, default: Any = ...) -> float:
        value = self.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise PlanError(f"{self.at(key)}: expected a number, got {value!r}")
        return float(value)

    def time(self, key: str) -> float:
        value = self.get(key)
        if isinstance(value, str):
            if value not in self.phases:
                known = ", ".join(self.phases) or "none"
                raise PlanError(f"{self.at(key)}: no phase {value!r}; phases: {known}")
            return self.phases[value]
        return self.number(key)

    def vector(self, key: str, size: int, default: Any = ...) -> Any:
        return default if key not in self.value and default is not ... else _vector(self.get(key), size, self.at(key))

    def items(self, key: str) -> list[_Node]:
        values = self.get(key, [])
        if not isinstance(values, Sequence) or isinstance(values, str):
            raise PlanError(f"{self.at(key)}: expected a list, got {values!r}")
        return [_Node(value, f"{self.at(key)}[{i}]", self.phases) for i, value in enumerate(values)]

    def node(self, key: str) -> _Node:
        return _Node(self.get(key, {}), self.at(key), self.phases)

    def at(self, key: str) -> str:
        return f"{self.where}{'' if self.where.endswith(': ') else '.'}{key}"


def _vector(value: Any, size: int, where: str) -> Vector:
    numbers = isinstance(value, Sequence) and all(
        isinstance(item, int | float) and not isinstance(item, bool) for item in value
    )
    if not numbers or len(value) != size:
        raise PlanError(f"{where}: expected {size} numbers, got {value!r}")
    return tuple(float(item) for item in value)


def load_plan(path: str | Path) -> Plan:
    """Reads and checks a plan.

    Raises:
        PlanError: for a missing file, anything that is not as the module says, or keys that are out of order.
    """
    path = Path(path)
    if not path.is_file():
        raise PlanError(f"{path}: no such plan")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise PlanError(f"{path}: not YAML: {error}") from error
    return parse_plan(content, path)


def parse_plan(content: Any, file: Path) -> Plan:
    """Checks the content of a plan's file; raises as `load_plan`."""
    root = _Node(content, f"{file}: ", {})
    root.only(
        "duration", "phases", "start", "feet", "heels", "pelvis", "torso", "hands", "object", "push", "balance",
        "scenery", "posture", "arm_posture", "turning", "corrections",
    )  # fmt: skip
    phases = root.node("phases")
    root.phases = {str(name): phases.number(name) for name in phases.value}
    start, object_ = root.node("start"), root.node("object")
    start.only("pos", "yaw", "width")
    object_.only("path", "hinge", "carried", "rolls")
    carried = None
    if "carried" in object_.value:
        times = object_.get("carried")
        if not isinstance(times, Sequence) or isinstance(times, str) or len(times) != 4:
            raise PlanError(f"{object_.at('carried')}: expected four times, got {times!r}")
        knots = _Node(dict(enumerate(times)), object_.at("carried"), root.phases)
        carried = tuple(knots.time(i) for i in range(4))  # type: ignore[arg-type]
        if list(carried) != sorted(carried):
            raise PlanError(f"{object_.at('carried')}: times must not decrease, got {list(carried)}")
    scenery = root.node("scenery")
    placed = {name: _pose_keys([_dated(scenery.node(name))])[0] for name in scenery.value}
    posture = root.node("posture")
    for pattern in posture.value:
        if not any(re.fullmatch(pattern, joint) for joint in g1.JOINT_NAMES):
            raise PlanError(f"{posture.at(pattern)}: matches no joint of the robot")
    return Plan(
        name=file.stem,
        file=file,
        duration=root.number("duration"),
        start_pos=start.vector("pos", 3, (0.0, 0.0, 0.0)),
        start_yaw=start.number("yaw", 0.0),
        width=start.number("width", 0.238),
        feet=tuple(_foot_item(item) for item in root.items("feet")),
        heels={side: _values(root.node("heels"), side, {"pitch": 0.0}) for side in _sides(root.node("heels"))},
        pelvis=_values(root, "pelvis", {"height": 0.74, "pitch": 0.0}),
        torso=_values(root, "torso", {"lean": 0.05, "gaze": 0.0, "roll": 0.0}),
        hands=_hands(root.node("hands")),
        object_path=_pose_keys(object_.items("path")),
        hinge=_values(object_, "hinge", {"angle": 0.0}),
        carried=carried,
        rolls=object_.number("rolls") if "rolls" in object_.value else None,
        push=_values(root, "push", {"force": (0.0, 0.0, 0.0)}),
        balance=_values(root, "balance", {"over": "feet"}),
        scenery=placed,
        posture={str(pattern): posture.number(pattern) for pattern in posture.value},
        arm_posture=root.number("arm_posture", 0.05),
        turning=root.number("turning", 0.1),
        corrections=int(root.number("corrections", 2)),
    )


def _dated(node: _Node) -> _Node:
    return _Node({"at": 0.0, **node.value}, node.where, node.phases)


def _sides(node: _Node) -> list[str]:
    node.only(*SIDES)
    return list(node.value)


def _foot_item(node: _Node) -> Step | Walk:
    if ("walk" in node.value) == ("step" in node.value):
        raise PlanError(f"{node.where}: give either 'walk' or 'step'")
    if "walk" in node.value:
        node.only("walk", "start", "end", "length", "turn", "first", "height", "step_time", "double_support", "z")
        path = node.get("walk")
        if not isinstance(path, Sequence) or isinstance(path, str) or not path:
            raise PlanError(f"{node.at('walk')}: expected a list of [x, y, yaw], got {path!r}")
        first = node.get("first", None)
        if first not in (None, *SIDES):
            raise PlanError(f"{node.at('first')}: expected left or right, got {first!r}")
        item: Step | Walk = Walk(
            path=tuple(_vector(point, 3, f"{node.at('walk')}[{i}]") for i, point in enumerate(path)),
            start=node.time("start"),
            end=node.time("end"),
            length=node.number("length", 0.25),
            turn=node.number("turn", 0.4),
            first=first,
            height=node.number("height", 0.06),
            step_time=node.number("step_time", 0.45),
            double_support=node.number("double_support", 0.25),
            z=node.number("z") if "z" in node.value else None,
            where=node.where,
        )
    else:
        node.only("step", "start", "end", "to", "z", "height", "via")
        side = node.get("step")
        if side not in SIDES:
            raise PlanError(f"{node.at('step')}: expected left or right, got {side!r}")
        item = Step(
            side=side,
            start=node.time("start"),
            end=node.time("end"),
            to=node.vector("to", 3),
            z=node.number("z", 0.0),
            height=node.number("height", 0.06),
            via=_pose_keys(node.items("via")),
        )
    if not item.end > item.start:
        raise PlanError(f"{node.where}: end {item.end} s is not after start {item.start} s")
    if isinstance(item, Walk) and not min(item.length, item.turn, item.step_time) > 0:
        raise PlanError(f"{node.where}: length, turn and step_time: expected more than 0")
    return item


def _values(parent: _Node, key: str, defaults: Mapping[str, Any]) -> tuple[ValueKey, ...]:
    """Keys of named values; each holds all of them."""
    keys, values = [], dict(defaults)
    for node in parent.items(key):
        node.only("at", *defaults)
        for name, default in defaults.items():
            if name not in node.value:
                continue
            if name == "over" and node.get(name) != "feet":
                values[name] = node.vector(name, 2)
            elif name == "over":
                values[name] = "feet"
            else:
                values[name] = node.vector(name, len(default)) if isinstance(default, tuple) else node.number(name)
        keys.append(ValueKey(node.time("at"), dict(values)))
        _after(keys, node)
    return tuple(keys)


def _pose_keys(nodes: Sequence[_Node]) -> tuple[PoseKey, ...]:
    keys: list[PoseKey] = []
    for node in nodes:
        node.only("at", "frame", "pos", "rpy", "point", "out", "gap", "contact", "rest", "attach")
        before = replace(keys[-1], attach=None) if keys else PoseKey(0.0)
        if node.get("rest", False):
            key = PoseKey(0.0, frame="rest", pos=(0.0, 0.0, 0.0))
        else:
            if before.frame == "rest":
                before = PoseKey(0.0)
            if "frame" in node.value and node.get("frame") != before.frame:
                # figures of another frame mean nothing in this one
                before = replace(before, pos=None, out=(0.0, 0.0, 0.0), gap=0.0)
            contact = node.get("contact", "here" if before.here else before.contact)
            if not isinstance(contact, bool) and contact != "here":
                raise PlanError(f"{node.at('contact')}: expected true, false or here, got {contact!r}")
            key = PoseKey(
                time=0.0,
                frame=str(node.get("frame", before.frame)),
                pos=node.vector("pos", 3, before.pos),
                rpy=node.vector("rpy", 3, before.rpy),
                point=node.vector("point", 3, before.point),
                out=node.vector("out", 3, before.out),
                gap=node.number("gap", before.gap),
                contact=bool(contact),
                here=contact == "here",
                attach=node.get("attach", None),
            )
            if key.here and (key.frame != "object" or key.pos is None):
                raise PlanError(f"{node.at('contact')}: 'here' is a `pos` in the frame 'object'")
            if key.here and before.here and key.pos != before.pos:
                raise PlanError(f"{node.at('pos')}: a contact 'here' has one point, {before.pos}, got {key.pos}")
        keys.append(replace(key, time=node.time("at"), where=node.where))
        _after(keys, node)
    return tuple(keys)


def _after(keys: Sequence[PoseKey | ValueKey], node: _Node) -> None:
    if len(keys) > 1 and not keys[-1].time > keys[-2].time:
        raise PlanError(f"{node.at('at')}: {keys[-1].time} s is not after the key before it, at {keys[-2].time} s")


def _hands(node: _Node) -> dict[str, tuple[PoseKey, ...]]:
    node.only("both", *SIDES)
    if "both" in node.value and len(node.value) > 1:
        raise PlanError(f"{node.where}: give either 'both' or 'left' and 'right'")
    if "both" in node.value:
        left = _pose_keys(node.items("both"))
        return {"left": left, "right": tuple(mirrored(key) for key in left)}
    return {side: _pose_keys(node.items(side)) for side in node.value}


def mirrored(key: PoseKey) -> PoseKey:
    """The key of the other side: y, roll and yaw change sign."""

    def flip(vector: Vector | None) -> Vector | None:
        return None if vector is None else (vector[0], -vector[1], vector[2])

    roll, pitch, yaw = key.rpy
    return replace(
        key, pos=flip(key.pos), point=flip(key.point), out=flip(key.out) or key.out, rpy=(-roll, pitch, -yaw)
    )


def find_plan(task: str) -> Path:
    """The plan that ships for a task.

    Raises:
        PlanError: if there is none; says for which there is one.
    """
    path = _PLANS / f"{task}.yaml"
    if not path.is_file():
        there = ", ".join(sorted(plan.stem for plan in _PLANS.glob("*.yaml")))
        raise PlanError(f"{path}: no such plan; there is {there}")
    return path
