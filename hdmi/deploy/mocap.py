"""Poses of motion capture over ZMQ: their format, marker offsets, the object's hinge, and the root's heading.

A publisher binds a PUB socket and sends, for each frame and rigid body, a message of two parts: the body's name in
UTF-8, which is the topic, and a JSON object

    {"pos": [x, y, z], "quat": [w, x, y, z], "stamp": t}

in m, a unit quaternion from the body's frame to the world's (z up), and s of Unix time at which it was measured; the
stamp may be left out. An object's joint may come by itself, under a name of its own: `{"joint": rad, "stamp": t}`.
docs/robot.md has a publisher of ten lines.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hdmi.deploy.robot import RobotError
from hdmi.deploy.rotations import quat_apply, quat_conjugate, quat_multiply, turn_about, wrapped
from hdmi.deploy.scene import Hinge

FUTURE = 0.01  # s by which a stamp may be ahead of this machine's clock


@dataclass
class Options:
    """Where poses come from, and what the rigid bodies are called."""

    mocap: str = "tcp://127.0.0.1:5556"  # where a publisher of poses is; none: no motion capture
    root_name: str = "pelvis"  # the rigid body on the robot's pelvis
    object_name: str = "object"  # the one on the object
    part_name: str = "object_part"  # the one on the part that the object's hinge moves
    joint_name: str = "object_joint"  # messages with the hinge's angle, which then needs no second rigid body
    root_offset: list[float] = field(default_factory=list)  # x,y,z,w,x,y,z of the pelvis in its rigid body's frame
    object_offset: list[float] = field(default_factory=list)  # likewise the object's, empty: the same frame
    part_offset: list[float] = field(default_factory=list)  # likewise the moving part's
    mocap_stamps: bool = False  # age from the messages' stamps: the publisher's clock is this machine's; else arrival
    heading_time: float = 1.0  # s over which the IMU's heading is brought to that of motion capture


@dataclass(frozen=True)
class Pose:
    """Of a rigid body: m [3], wxyz [4]."""

    pos: np.ndarray
    quat: np.ndarray


@dataclass(frozen=True)
class Message:
    """What a publisher has sent: a pose or an angle in rad, and s of Unix time."""

    name: str
    pose: Pose | None
    joint: float | None
    stamp: float | None


def encode(name: str, pose: Pose | None = None, joint: float | None = None, stamp: float | None = None) -> list[bytes]:
    """The two parts of a message."""
    body: dict[str, object] = {}
    if pose is not None:
        body |= {"pos": np.asarray(pose.pos).tolist(), "quat": np.asarray(pose.quat).tolist()}
    if joint is not None:
        body["joint"] = joint
    if stamp is not None:
        body["stamp"] = stamp
    return [name.encode(), json.dumps(body).encode()]


def decode(parts: Sequence[bytes]) -> Message:
    """A message from its parts.

    Raises:
        ValueError: if it has no name, no pose and no joint, wrong shapes, or anything that is not finite.
    """
    if len(parts) != 2 or not parts[0]:
        raise ValueError(f"expected a name and a JSON object, got {len(parts)} parts")
    name, body = parts[0].decode(), json.loads(parts[1])
    if not isinstance(body, dict):
        raise ValueError(f"{name}: expected a JSON object")
    stamp, joint = (_numbers(name, body, key, 0) if key in body else None for key in ("stamp", "joint"))
    pose = None
    if joint is None:
        pos, quat = _numbers(name, body, "pos", 3), _numbers(name, body, "quat", 4)
        length = float(np.linalg.norm(quat))
        if abs(length - 1.0) > 0.01:
            raise ValueError(f"{name}: quat: expected length 1, got {length:.3f}")
        pose = Pose(pos, quat / length)
    return Message(name, pose, None if joint is None else float(joint), None if stamp is None else float(stamp))


def _numbers(name: str, body: dict, key: str, count: int) -> np.ndarray:
    try:
        values = np.asarray(body[key], dtype=float)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{name}: {key}: expected {count or 1} numbers") from error
    if values.shape != ((count,) if count else ()) or not np.isfinite(values).all():
        raise ValueError(f"{name}: {key}: expected {count or 1} finite numbers")
    return values


# -- geometry -------------------------------------------------------------------------------------------------


def offset_of(values: Sequence[float], key: str) -> Pose:
    """An offset from seven numbers, position and quaternion; none at all is none.

    Raises:
        RobotError: if they are no pose; the message names the option.
    """
    if not values:
        return Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    if len(values) != 7 or not 0.99 < math.hypot(*values[3:]) < 1.01:
        raise RobotError(f"{key}: expected x,y,z,w,x,y,z with a unit quaternion, got {list(values)}")
    return Pose(np.array(values[:3]), np.array(values[3:]) / math.hypot(*values[3:]))


def compose(pose: Pose, offset: Pose) -> Pose:
    """The pose of what is at an offset in a body's frame."""
    return Pose(pose.pos + quat_apply(pose.quat, offset.pos), quat_multiply(pose.quat, offset.quat))


def heading_between(mocap_quat: np.ndarray, imu_quat: np.ndarray) -> float:
    """The turn about the vertical, rad, that takes the IMU's orientation to that of motion capture. [4], [4]"""
    return turn_about(np.array([0.0, 0.0, 1.0]), quat_multiply(mocap_quat, quat_conjugate(imu_quat)))


def blended(before: float, measured: float, share: float) -> float:
    """An angle that goes a share of the shorter way to another, rad, in (-pi, pi]."""
    return wrapped(before + share * wrapped(measured - before))


def turned(heading: float, quat: np.ndarray) -> np.ndarray:
    """An orientation turned about the vertical by a heading, rad. [4]"""
    return quat_multiply(np.array([math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2)]), quat)


# -- what is known --------------------------------------------------------------------------------------------


class Motion:
    """The last message of each rigid body, and what the policy's sensors are by them.

    Args:
        options: see `Options`.
        hinge: of the object, None without.
        unix: the clock of the messages' stamps, s.

    Attributes:
        dropped: messages that were none; `reason` is the last one's fault.

    Raises:
        RobotError: if an offset is no pose.
    """

    def __init__(self, options: Options, hinge: Hinge | None, unix: Callable[[], float] = time.time):
        self.options, self.hinge, self._unix = options, hinge, unix
        self._offsets = {
            options.root_name: offset_of(options.root_offset, "root_offset"),
            options.object_name: offset_of(options.object_offset, "object_offset"),
            options.part_name: offset_of(options.part_offset, "part_offset"),
        }
        self._poses: dict[str, tuple[float, Pose]] = {}
        self._joint: tuple[float, float] | None = None
        self._heading: tuple[float, float] | None = None
        self.dropped, self.reason = 0, ""

    def hear(self, parts: Sequence[bytes], now: float, imu_quat: np.ndarray | None) -> None:
        """Takes a message in.

        Args:
            parts: of the message.
            now: s on the robot's clock.
            imu_quat: the IMU's orientation at present, with a heading of its own. [4]
        """
        try:
            message = decode(parts)
            stamp = now if message.stamp is None or not self.options.mocap_stamps else self._local(message, now)
        except ValueError as error:
            self.dropped, self.reason = self.dropped + 1, str(error)
            return
        if message.joint is not None:
            if message.name == self.options.joint_name:
                self._joint = stamp, message.joint
        elif message.pose is not None and message.name in self._offsets:
            pose = compose(message.pose, self._offsets[message.name])
            self._poses[message.name] = stamp, pose
            if message.name == self.options.root_name and imu_quat is not None:
                self._turn(stamp, heading_between(pose.quat, imu_quat))

    def _local(self, message: Message, now: float) -> float:
        """A message's stamp on the robot's clock."""
        age = self._unix() - float(message.stamp or 0.0)
        if age < -FUTURE:
            raise ValueError(f"{message.name}: stamp is {-age:.3f} s ahead of this machine's clock")
        return now - max(age, 0.0)

    def _turn(self, stamp: float, measured: float) -> None:
        if self._heading is None:
            self._heading = stamp, measured
            return
        before, heading = self._heading
        share = 1.0 - math.exp(-max(stamp - before, 0.0) / max(self.options.heading_time, 1e-3))
        self._heading = stamp, blended(heading, measured, share)

    @property
    def heading(self) -> float | None:
        """The turn about the vertical from the IMU's world to that of motion capture, rad; None before a pose."""
        return None if self._heading is None else self._heading[1]

    def sensors(self) -> tuple[dict[str, np.ndarray], dict[str, float]]:
        """Sensors that have measured, by the names of `hdmi.deploy.format.SENSORS`, and their stamps."""
        found: dict[str, np.ndarray] = {}
        stamps: dict[str, float] = {}
        root, thing, part = (self._poses.get(name) for name in self._offsets)
        if root is not None:
            found["root_pos_w"], stamps["root_pos_w"] = root[1].pos, root[0]
        if thing is not None:
            found |= {"object_pos_w": thing[1].pos, "object_quat_w": thing[1].quat}
            stamps |= dict.fromkeys(("object_pos_w", "object_quat_w"), thing[0])
        if self._joint is not None:
            found["object_joint_pos"], stamps["object_joint_pos"] = np.array([self._joint[1]]), self._joint[0]
        elif self.hinge is not None and thing is not None and part is not None:
            found["object_joint_pos"] = np.array([self.hinge.angle(thing[1].quat, part[1].quat)])
            stamps["object_joint_pos"] = min(thing[0], part[0])
        return found, stamps


def socket_of(kind: str, address: str, key: str) -> Any:
    """A ZMQ socket: PUB and REP bind to an address, SUB (to everything) and REQ connect to one, come up or not.

    Args:
        key: what the address is, for messages.

    Raises:
        ImportError: without the extra `robot`.
        RobotError: if the address cannot be used.
    """
    try:
        import zmq
    except ImportError as error:
        raise ImportError(f"{error}; a robot needs the extra robot: pip install 'hdmi[robot]'") from error
    socket: Any = zmq.Context.instance().socket(getattr(zmq, kind))
    socket.setsockopt(zmq.LINGER, 0)
    try:
        (socket.bind if kind in ("PUB", "REP") else socket.connect)(address)
    except zmq.ZMQError as error:
        socket.close()
        raise RobotError(f"{key}: {address}: {error}; expected such as tcp://127.0.0.1:5556") from error
    if kind == "SUB":
        socket.subscribe(b"")
    return socket
