"""An object that stands on its support while nobody holds it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hdmi.motion.kinematics import angular_velocity, derivative
from hdmi.motion.playback import FAR, Playback
from hdmi.workshop.annotate import intervals
from hdmi.workshop.retarget.feet import carried_over

_SLOW = 0.05  # m/s; of an object at rest
_LEVER = 0.3  # m; at which turning counts as speed


class Poses(NamedTuple):
    """Of one body over time: positions, m, and orientations, wxyz. [T, 3], [T, 4]"""

    pos: np.ndarray
    quat: np.ndarray


def at_rest(pos: np.ndarray, quat: np.ndarray, fps: float, held: np.ndarray) -> list[tuple[int, int]]:
    """First and last frames of the phases in which an object does not move, and stands on its own.

    It does not where it is held all along, nor where it is held mostly, and then let go and falls.

    Args:
        held: frames in which an effector is to touch it. bool [T]
    """
    speed = np.linalg.norm(derivative(pos, fps), axis=-1)
    speed += _LEVER * np.linalg.norm(angular_velocity(quat, fps), axis=-1)
    out = []
    for first, last in intervals(speed < _SLOW):
        within, falls = held[first : last + 1], last + 1 < len(held) and not held[last + 1]
        if not within.all() and not (falls and within.mean() > 0.5):
            out.append((first, last))
    return out


def settled_object(playback: Playback) -> Poses:
    """The object's path with every phase of rest on the ground, in one pose each; the rest is carried along in between.

    An object that is fixed in the world, or far above anything, stays as it is.
    """
    reference = playback.reference
    pos, quat = reference.object_pos.numpy().astype(float), reference.object_quat.numpy().astype(float)
    held: np.ndarray = reference.contact.numpy().sum(axis=1) > 0
    rotation = Rotation.from_quat(quat, scalar_first=True)
    clearance = playback.object_clearance.min(axis=1)
    rests, moved = np.zeros(len(pos), bool), np.zeros((len(pos), 6))
    if playback.scene.object_free_dof is None:
        return Poses(pos, quat)
    for first, last in at_rest(pos, quat, playback.fps, held):
        frames = slice(first, last + 1)
        gap = float(np.median(clearance[frames]))
        if gap >= FAR:
            continue
        rests[frames] = True
        place = np.median(pos[frames], axis=0) - [0.0, 0.0, gap]
        moved[frames, :3] = place - pos[frames]
        moved[frames, 3:] = (rotation[frames].mean() * rotation[frames].inv()).as_rotvec()
    eased = carried_over(moved, rests)
    turned = Rotation.from_rotvec(eased[:, 3:]) * rotation
    return Poses(pos + eased[:, :3], turned.as_quat(scalar_first=True))
