"""Object trajectories from a few keyframes: carried along by the hands in contact, at rest otherwise."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from hdmi.motion.check import MotionError
from hdmi.motion.kinematics import minimum_jerk

X = TypeVar("X")
Pose = tuple[np.ndarray, Rotation]

_PATCH = 0.05  # m; extent of a hand, over which its own turning counts against that of the line between two hands


def complete_trajectory(
    keyframes: Mapping[int, tuple[Sequence[float], Sequence[float]]],
    hand_pos: np.ndarray,
    hand_quat: np.ndarray,
    contact: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Pose of an object in every frame.

    From each keyframe the object follows the hands in contact rigidly (several hands: the best rigid fit), and rests
    while there are none. Between two keyframes what follows from the earlier one is blended into what leads to the
    later one, over the frames in contact; if there are none, the object moves by itself and time decides.

    Args:
        keyframes: frame -> position, m, and wxyz quaternion in the world.
        hand_pos: effectors, best at their contact points, m. [T, E, 3]
        hand_quat: of the effectors' bodies. [T, E, 4]
        contact: bool [T, E]

    Returns:
        Positions [T, 3] and quaternions [T, 4].

    Raises:
        MotionError: without keyframes, or for one that is not a frame of the motion.
    """
    _check(keyframes, len(contact))
    offsets = _PATCH * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])  # [7, 3]
    axes = Rotation.from_quat(hand_quat.reshape(-1, 4), scalar_first=True).as_matrix()
    patches = hand_pos[:, :, None] + offsets @ axes.reshape(*hand_quat.shape[:2], 3, 3).transpose(0, 1, 3, 2)

    def follow(before: int, after: int, pose: Pose) -> Pose:
        holding = contact[before] & contact[after]
        if not holding.any():
            return pose
        old, new = patches[before, holding].reshape(-1, 3), patches[after, holding].reshape(-1, 3)
        turn, _ = Rotation.align_vectors(new - new.mean(0), old - old.mean(0))
        return new.mean(0) + turn.apply(pose[0] - old.mean(0)), turn * pose[1]

    def blend(early: Pose, late: Pose, weight: float) -> Pose:
        turn = Slerp([0.0, 1.0], Rotation.concatenate([early[1], late[1]]))(weight)
        return (1 - weight) * early[0] + weight * late[0], turn

    poses = _complete(
        {
            frame: (np.asarray(pos, float), Rotation.from_quat(quat, scalar_first=True))
            for frame, (pos, quat) in keyframes.items()
        },
        contact,
        follow,
        blend,
    )
    quat = np.stack([rotation.as_quat(scalar_first=True) for _, rotation in poses])
    flips = np.where((quat[1:] * quat[:-1]).sum(-1) < 0, -1.0, 1.0)
    quat[1:] *= np.cumprod(flips)[:, None]
    return np.stack([pos for pos, _ in poses]), quat


def complete_hinge(
    keyframes: Mapping[int, float], hand_pos_b: np.ndarray, contact: np.ndarray, axis: Sequence[float]
) -> np.ndarray:
    """Angle of an articulated object's hinge in every frame: turned by the hands in contact, else at rest.

    Args:
        keyframes: frame -> angle, rad.
        hand_pos_b: effectors from the hinge, in the frame that does not turn with it, m. [T, E, 3]
        contact: bool [T, E]
        axis: of the hinge in that frame. [3]

    Returns:
        Angles, rad. [T]

    Raises:
        MotionError: as `complete_trajectory`.
    """
    _check(keyframes, len(contact))
    normal = np.asarray(axis, float) / np.linalg.norm(axis)
    across = hand_pos_b - (hand_pos_b @ normal)[..., None] * normal  # [T, E, 3]

    def follow(before: int, after: int, angle: float) -> float:
        holding = contact[before] & contact[after]
        if not holding.any():
            return angle
        old, new = across[before, holding], across[after, holding]
        sine, cosine = (np.cross(old, new) @ normal).sum(), (old * new).sum()  # far from the axis counts more
        return angle + float(np.arctan2(sine, cosine))

    def blend(early: float, late: float, weight: float) -> float:
        return (1 - weight) * early + weight * late

    return np.array(_complete(dict(keyframes), contact, follow, blend))


def _check(keyframes: Mapping[int, object], num_frames: int) -> None:
    if not keyframes:
        raise MotionError("object trajectory: give the object's pose in at least one frame")
    if outside := [frame for frame in keyframes if not 0 <= frame < num_frames]:
        raise MotionError(f"object trajectory: keyframes {outside} are outside of the motion's {num_frames} frames")


def _complete(
    keyframes: Mapping[int, X],
    contact: np.ndarray,
    follow: Callable[[int, int, X], X],
    blend: Callable[[X, X, float], X],
) -> list[X]:
    frames = sorted(keyframes)
    out: dict[int, X] = dict(keyframes)
    for t in range(frames[0], 0, -1):
        out[t - 1] = follow(t, t - 1, out[t])
    for t in range(frames[-1], len(contact) - 1):
        out[t + 1] = follow(t, t + 1, out[t])
    for first, last in pairwise(frames):
        early, late = {first: keyframes[first]}, {last: keyframes[last]}
        for t in range(first, last):
            early[t + 1] = follow(t, t + 1, early[t])
        for t in range(last, first, -1):
            late[t - 1] = follow(t, t - 1, late[t])
        held = (contact[first:last] & contact[first + 1 : last + 1]).any(axis=1)
        passed = np.cumsum(held if held.any() else np.ones_like(held)).astype(float)
        weights = minimum_jerk(passed / passed[-1])
        for t in range(first + 1, last):
            out[t] = blend(early[t], late[t], float(weights[t - first - 1]))
    return [out[t] for t in range(len(contact))]
