"""The G1's low-level messages as Unitree's SDK 2 lays them out: structs with a CRC, and their form on the wire.

`unitree_hg::msg::dds_::LowCmd_` and `LowState_`. Both structs hold 35 motors, of which the G1 has the first 29. A
message is a numpy record of the C struct, over which the robot computes its CRC; in CDR, the form on the wire, the
padding before the first motor is another. Pure functions on bytes; numpy only.
"""

from __future__ import annotations

import zlib

import numpy as np

_LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
_ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch", "wrist_yaw")
# In the SDK's order; ankles and waist in pitch and roll (`mode_pr` 0), not by their parallel motors.
JOINTS: tuple[str, ...] = (
    *(f"{side}_{joint}_joint" for side in ("left", "right") for joint in _LEG),
    *(f"waist_{axis}_joint" for axis in ("yaw", "roll", "pitch")),
    *(f"{side}_{joint}_joint" for side in ("left", "right") for joint in _ARM),
)
MOTORS = 35
COMMAND_TOPIC, STATE_TOPIC = "rt/lowcmd", "rt/lowstate"

_MOTOR_CMD = np.dtype(
    [("mode", "<u1"), ("q", "<f4"), ("dq", "<f4"), ("tau", "<f4"), ("kp", "<f4"), ("kd", "<f4"), ("reserve", "<u4")],
    align=True,
)
_MOTOR_STATE = np.dtype(
    [
        ("mode", "<u1"), ("q", "<f4"), ("dq", "<f4"), ("ddq", "<f4"), ("tau_est", "<f4"),
        ("temperature", "<i2", 2),  # degrees C: of the surface, of the winding
        ("vol", "<f4"), ("sensor", "<u4", 2), ("motorstate", "<u4"), ("reserve", "<u4", 4),
    ],
    align=True,
)  # fmt: skip
_IMU = np.dtype(
    [
        ("quaternion", "<f4", 4), ("gyroscope", "<f4", 3), ("accelerometer", "<f4", 3), ("rpy", "<f4", 3),
        ("temperature", "<i2"),
    ],
    align=True,
)  # fmt: skip
LOW_CMD = np.dtype(
    [
        ("mode_pr", "<u1"), ("mode_machine", "<u1"), ("motor_cmd", _MOTOR_CMD, MOTORS), ("reserve", "<u4", 4),
        ("crc", "<u4"),
    ],
    align=True,
)  # fmt: skip
LOW_STATE = np.dtype(
    [
        ("version", "<u4", 2), ("mode_pr", "<u1"), ("mode_machine", "<u1"), ("tick", "<u4"), ("imu_state", _IMU),
        ("motor_state", _MOTOR_STATE, MOTORS), ("wireless_remote", "<u1", 40), ("reserve", "<u4", 4), ("crc", "<u4"),
    ],
    align=True,
)  # fmt: skip
# End of what stands before the first motor, in both forms.
_BEFORE_MOTORS = {LOW_CMD: 2, LOW_STATE: 70}


def _used(dtype: np.dtype) -> np.ndarray:
    """Which bytes of a struct are not padding. bool [bytes]"""
    if dtype.subdtype is not None:
        element, shape = dtype.subdtype
        return np.tile(_used(element), int(np.prod(shape)))
    used = np.full(dtype.itemsize, dtype.fields is None)
    for part, offset, *_ in (dtype.fields or {}).values():
        used[offset : offset + part.itemsize] = _used(part)
    return used


_USED = {dtype: _used(dtype) for dtype in (LOW_CMD, LOW_STATE)}
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))

# Bits of wireless_remote's bytes 2 and 3.
BUTTONS = (
    "R1", "L1", "start", "select", "R2", "L2", "F1", "F2", "A", "B", "X", "Y", "up", "right", "down", "left",
)  # fmt: skip
_SHOULDERS = frozenset(("R1", "L1", "R2", "L2"))
REQUESTS = {"A": "to_start", "Y": "run", "X": "hold", "B": "damping", "select": "quit"}


def crc32(words: bytes) -> int:
    """The SDK's CRC over little-endian 32-bit words: polynomial 0x04C11DB7, initially all ones, highest bit first.

    zlib's is the same with all bits mirrored and the result inverted.
    """
    mirrored = np.frombuffer(words, "<u4").byteswap().tobytes().translate(_REVERSED)
    return int(f"{zlib.crc32(mirrored) ^ 0xFFFFFFFF:032b}"[::-1], 2)


def pack(message: np.ndarray) -> bytes:
    """A record of LOW_CMD or LOW_STATE as it goes onto the wire, CDR without its header; sets its CRC."""
    struct = _without_padding(message.tobytes(), message.dtype)
    message["crc"] = crc = crc32(struct[:-4])
    struct, at = struct[:-4] + crc.to_bytes(4, "little"), _BEFORE_MOTORS[message.dtype]
    return struct[:at] + struct[at + 2 : at + 3] + b"\0" + struct[at + 6 :]


def unpack(payload: bytes, dtype: np.dtype) -> np.ndarray | None:
    """The record of a message from the wire, or None if its length or its CRC is wrong."""
    if len(payload) != dtype.itemsize - 4:
        return None
    at = _BEFORE_MOTORS[dtype]
    struct = payload[:at] + b"\0\0" + payload[at : at + 1] + b"\0\0\0" + payload[at + 2 :]
    struct = _without_padding(struct, dtype)
    message = np.frombuffer(struct, dtype)[0]
    return message if message["crc"] == crc32(struct[:-4]) else None


def _without_padding(struct: bytes, dtype: np.dtype) -> bytes:
    """A struct whose padding, which may be anything, is zero, as the CRC wants it."""
    return (np.frombuffer(struct, np.uint8) * _USED[dtype]).tobytes()


def pressed(remote: np.ndarray) -> frozenset[str]:
    """Buttons that are down on the remote control. uint8 [40]"""
    bits = int(remote[2]) | int(remote[3]) << 8
    return frozenset(name for i, name in enumerate(BUTTONS) if bits >> i & 1)


def remote_of(buttons: frozenset[str]) -> np.ndarray:
    """`wireless_remote` with these buttons down. uint8 [40]"""
    bits = sum(1 << BUTTONS.index(name) for name in buttons)
    return np.frombuffer(bytes((0, 0, bits & 0xFF, bits >> 8)).ljust(40, b"\0"), np.uint8)


def requests_of(before: frozenset[str], now: frozenset[str]) -> tuple[str, ...]:
    """States that newly pressed buttons ask for.

    While a shoulder button is down, the others belong to the robot's own combinations; B counts even then.
    """
    allowed = {"B"} if now & _SHOULDERS else set(REQUESTS)
    return tuple(request for name, request in REQUESTS.items() if name in (now - before) & allowed)
