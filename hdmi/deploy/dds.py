"""Unitree's topics over Cyclone DDS. Needs the extra `robot`.

The low-level messages go through as bytes: Cyclone's Python serializer takes 0.6 ms for a command of 35 motors, a third
of its period. The types are declared all the same, since discovery compares them.
"""

import socket
from typing import Any
from xml.sax.saxutils import quoteattr

from hdmi.deploy.g1 import COMMAND_TOPIC, MOTORS, STATE_TOPIC
from hdmi.deploy.robot import RobotError

try:
    from cyclonedds.core import DDSException, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.idl import annotations, make_idl_struct, types
    from cyclonedds.internal import InvalidSample
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration
except ImportError as error:
    raise ImportError(f"{error}; a robot needs the extra robot: pip install 'hdmi[robot]'") from error

t: Any = types
_HEADER = b"\x00\x01\x00\x00"  # of CDR: plain, little-endian


def _struct(name: str, **fields: Any) -> Any:
    """A type of Unitree's IDL: `package.Name_`, with its members."""
    package, _, short = name.partition(".")
    kind = make_idl_struct(short, f"{package}.msg.dds_.{short}", fields)
    return annotations.final(annotations.autoid("sequential")(kind))


def _by_bytes(kind: Any) -> Any:
    """The type with its serialized form at hand, as `payload`."""

    def deserialize(data: bytes, *_: Any, **__: Any) -> Any:
        message = object.__new__(kind)
        message.payload = bytes(data[4:]) if bytes(data[:2]) == _HEADER[:2] else b""
        return message

    kind.serialize = lambda message, *_, **__: _HEADER + message.payload
    kind.deserialize = staticmethod(deserialize)
    return kind


_MotorCmd = _struct(
    "unitree_hg.MotorCmd_", mode=t.byte, q=t.float32, dq=t.float32, tau=t.float32, kp=t.float32, kd=t.float32,
    reserve=t.uint32,
)  # fmt: skip
LowCmd = _by_bytes(
    _struct(
        "unitree_hg.LowCmd_", mode_pr=t.byte, mode_machine=t.byte, motor_cmd=t.array[_MotorCmd, MOTORS],
        reserve=t.array[t.uint32, 4], crc=t.uint32,
    )
)  # fmt: skip
_IMUState = _struct(
    "unitree_hg.IMUState_", quaternion=t.array[t.float32, 4], gyroscope=t.array[t.float32, 3],
    accelerometer=t.array[t.float32, 3], rpy=t.array[t.float32, 3], temperature=t.int16,
)  # fmt: skip
_MotorState = _struct(
    "unitree_hg.MotorState_", mode=t.byte, q=t.float32, dq=t.float32, ddq=t.float32, tau_est=t.float32,
    temperature=t.array[t.int16, 2], vol=t.float32, sensor=t.array[t.uint32, 2], motorstate=t.uint32,
    reserve=t.array[t.uint32, 4],
)  # fmt: skip
LowState = _by_bytes(
    _struct(
        "unitree_hg.LowState_", version=t.array[t.uint32, 2], mode_pr=t.byte, mode_machine=t.byte, tick=t.uint32,
        imu_state=_IMUState, motor_state=t.array[_MotorState, MOTORS], wireless_remote=t.array[t.byte, 40],
        reserve=t.array[t.uint32, 4], crc=t.uint32,
    )
)  # fmt: skip
Identity = _struct("unitree_api.RequestIdentity_", id=t.int64, api_id=t.int64)
Lease = _struct("unitree_api.RequestLease_", id=t.int64)
RequestPolicy = _struct("unitree_api.RequestPolicy_", priority=t.int32, noreply=bool)
RequestHeader = _struct("unitree_api.RequestHeader_", identity=Identity, lease=Lease, policy=RequestPolicy)
Request = _struct("unitree_api.Request_", header=RequestHeader, parameter=str, binary=t.sequence[t.byte])
Status = _struct("unitree_api.ResponseStatus_", code=t.int32)
ResponseHeader = _struct("unitree_api.ResponseHeader_", identity=Identity, status=Status)
Response = _struct("unitree_api.Response_", header=ResponseHeader, data=str, binary=t.sequence[t.byte])

_TYPES = {COMMAND_TOPIC: LowCmd, STATE_TOPIC: LowState}


class Bus:
    """A participant of a DDS domain on one network interface.

    Args:
        interface: its name, such as eth0.
        domain: id of the domain; the robot's is 0.

    Raises:
        RobotError: if there is no such interface, or DDS cannot use it.
    """

    def __init__(self, interface: str, domain: int = 0):
        names = [name for _, name in socket.if_nameindex()]
        if interface not in names:
            raise RobotError(f"interface: there is no {interface!r}; there is {', '.join(names)}")
        config = (
            "<CycloneDDS><Domain Id='any'><General><Interfaces>"
            f"<NetworkInterface name={quoteattr(interface)} priority='default' multicast='default'/>"
            "</Interfaces></General></Domain></CycloneDDS>"
        )
        try:
            self._domain = Domain(domain, config)
            self.participant = DomainParticipant(domain)
        except DDSException as error:
            raise RobotError(f"interface {interface}, domain {domain}: DDS cannot start: {error.msg}") from error

    def topic(self, name: str, kind: type | None = None) -> Any:
        """A topic, of the type that Unitree gives it."""
        return Topic(self.participant, name, kind or _TYPES[name])


class Reader:
    """What arrives on a topic.

    Args:
        depth: messages that are kept until they are taken; older ones are lost.
        foreign: leaves out what this participant writes itself.
    """

    def __init__(self, bus: Bus, topic: Any, depth: int = 16, foreign: bool = False):
        policies = [Policy.Reliability.Reliable(duration(milliseconds=100)), Policy.History.KeepLast(depth)]
        if foreign:
            policies.append(Policy.IgnoreLocal.Participant)
        self._bus = bus  # which would leave the domain if nobody held it
        self._reader, self._depth = DataReader(bus.participant, topic, Qos(*policies)), depth
        self._waits = WaitSet(bus.participant)
        self._waits.attach(ReadCondition(self._reader, ViewState.Any | InstanceState.Any | SampleState.Any))

    def take(self, timeout: float) -> list[Any]:
        """Messages since the last call, in their order; waits up to `timeout` s for one."""
        if timeout > 0:
            self._waits.wait(duration(seconds=timeout))
        return [message for message in self._reader.take(self._depth) if not isinstance(message, InvalidSample)]


def writer_of(bus: Bus, topic: Any) -> Any:
    """What writes to a topic, and keeps the last message only."""
    return DataWriter(bus.participant, topic)


class Port:
    """Low-level messages out and in, as bytes without the header of CDR.

    Args:
        out, into: topics, one of which is the commands' and the other the states'.
    """

    def __init__(self, bus: Bus, out: str, into: str):
        self._kind = _TYPES[out]
        self._writer = writer_of(bus, bus.topic(out))
        self._reader = Reader(bus, bus.topic(into))

    def send(self, payload: bytes) -> None:
        """Writes a message.

        Raises:
            RobotError: if DDS does not take it.
        """
        message = object.__new__(self._kind)
        message.payload = payload
        try:
            self._writer.write(message)
        except DDSException as error:
            raise RobotError(f"{self._writer.topic.name}: DDS does not take a message: {error.msg}") from error

    def receive(self, timeout: float) -> list[bytes]:
        """Messages since the last call, in their order; waits up to `timeout` s for one. Foreign formats are empty."""
        return [message.payload for message in self._reader.take(timeout)]


def others_command(bus: Bus, timeout: float) -> bool:
    """Whether another participant sends commands; listens for up to `timeout` s."""
    return bool(Reader(bus, bus.topic(COMMAND_TOPIC), depth=1, foreign=True).take(timeout))
