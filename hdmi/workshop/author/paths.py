"""Paths through keyframes: minimum jerk between keys, in frames that may move."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from hdmi.motion.kinematics import minimum_jerk
from hdmi.workshop.author.plan import PlanError, PoseKey, ValueKey, Vector


@dataclass(frozen=True)
class PosePath:
    """Poses over time in the world frame."""

    pos: np.ndarray  # [T, 3]
    rot: Rotation  # [T]

    def apply(self, points: np.ndarray | Sequence[float]) -> np.ndarray:
        """Points of this frame in the world. [3] or [T, 3] -> [T, 3]"""
        return self.pos + self.rot.apply(points)

    @property
    def quat(self) -> np.ndarray:
        """Wxyz. [T, 4]"""
        return self.rot.as_quat(scalar_first=True)

    @staticmethod
    def fixed(pos: Sequence[float], rot: Rotation, num_frames: int) -> PosePath:
        """A pose that does not move."""
        return PosePath(np.tile(np.asarray(pos, float), (num_frames, 1)), Rotation.concatenate([rot] * num_frames))


def blend(first: PosePath, second: PosePath, share: np.ndarray) -> PosePath:
    """From the first path to the second: positions linear, orientations on the shortest arc. `share` [T]"""
    turn = (first.rot.inv() * second.rot).as_rotvec()
    return PosePath(
        first.pos + share[:, None] * (second.pos - first.pos), first.rot * Rotation.from_rotvec(share[:, None] * turn)
    )


def value_path(keys: Sequence[ValueKey], name: str, time: np.ndarray, default: float | Vector) -> np.ndarray:
    """A named value over time; constant before the first key and after the last. [T] or [T, n]"""
    values = np.asarray([key.values[name] for key in keys] or [default], float)
    out = np.repeat(values[:1], len(time), axis=0)
    for i in range(1, len(values)):
        begin, end = keys[i - 1].time, keys[i].time
        share = minimum_jerk((time - begin) / (end - begin))
        out = out + (values[i] - values[i - 1]) * share.reshape(-1, *[1] * (values.ndim - 1))
    return out


def pose_path(
    keys: Sequence[PoseKey],
    frames: Mapping[str, PosePath],
    time: np.ndarray,
    target: Sequence[float] = (0.0, 0.0, 0.0),
) -> tuple[PosePath, np.ndarray]:
    """The path through pose keys, and where it is in contact.

    Between two keys, the poses that both stand for at that moment are blended: a key in a moving frame moves.

    Args:
        target: position of keys that give none, in their frame.

    Returns:
        The path, and contact bool [T]: between two contact keys, and on the way into and out of contact from where
        the path is no further from the contact pose than that one lies inside the surface (`gap` below zero).

    Raises:
        PlanError: for a frame that there is not.
    """
    held = [_key_path(keys[0], frames, time, target, None)]
    path = held[0]
    contact = np.full(len(time), keys[0].contact) & (time >= keys[0].time - 1e-9)
    if len(keys) > 1:
        contact &= time <= keys[1].time + 1e-9
    for before, key in pairwise(keys):
        here = _key_path(key, frames, time, target, held[-1])
        if key.attach is not None:  # until then it stays in the frame before
            share = (time >= key.time - 1e-9).astype(float)
        else:
            share = minimum_jerk((time - before.time) / (key.time - before.time))
        path = blend(path, here, share)
        segment = (time >= before.time - 1e-9) & (time <= key.time + 1e-9)
        if before.contact != key.contact:
            touching, depth = (held[-1], -before.gap) if before.contact else (here, -key.gap)
            near = np.linalg.norm(path.pos - touching.pos, axis=-1) <= max(depth, 0.0) + 1e-9
            contact = np.where(segment, near, contact)
        else:
            contact = np.where(segment, key.contact, contact)
        held.append(here)
    contact = np.where(time > keys[-1].time + 1e-9, keys[-1].contact, contact)
    return path, contact


def _key_path(
    key: PoseKey,
    frames: Mapping[str, PosePath],
    time: np.ndarray,
    target: Sequence[float],
    before: PosePath | None,
) -> PosePath:
    name = key.frame if key.attach is None else key.attach
    if name not in frames:
        raise PlanError(f"{key.where}: there is no frame {name!r}; there is {', '.join(frames)}")
    frame = frames[name]
    if key.attach is not None:
        if before is None:
            raise PlanError(f"{key.where}: the first key has nothing to attach")
        t = min(int(np.searchsorted(time, key.time - 1e-9)), len(time) - 1)
        inverse = frame.rot[t].inv()
        offset, turn = inverse.apply(before.pos[t] - frame.pos[t]), inverse * before.rot[t]
        return PosePath(frame.apply(offset), frame.rot * turn)
    pos = np.asarray(target if key.pos is None else key.pos, float) + key.gap * np.asarray(key.out)
    return PosePath(frame.apply(pos), frame.rot * rotation(key.rpy))


def rotation(rpy: Sequence[float]) -> Rotation:
    """Roll about x, then pitch about y, then yaw about z, of fixed axes."""
    return Rotation.from_euler("xyz", rpy)


def about(axis: str, angles: np.ndarray) -> Rotation:
    """Rotations about one axis. [T] rad"""
    return Rotation.from_euler(axis, angles[:, None])
