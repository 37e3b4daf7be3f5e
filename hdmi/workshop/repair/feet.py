"""Feet that stand where they touch down: planted phases of a robot's motion, and paths of the feet through them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_closing, distance_transform_edt, gaussian_filter1d, label
from scipy.spatial.transform import Rotation

from hdmi.assets import g1
from hdmi.motion.playback import Playback
from hdmi.workshop.repair.ground import support_height
from hdmi.workshop.retarget.body import HEEL, TOE
from hdmi.workshop.retarget.feet import carried_over, keeps_still, lasting

_NEAR = 0.06  # m; toes or heel of a planted foot are no further from the ground
_LEVEL = 0.35  # rad; a planted foot that leans less is meant to be flat
_SPEED = 0.3  # m/s; of toes and heel of a planted foot, at most
_PAUSE = 0.3  # s; a sole that is off the ground for less between being flat stays flat
_RAMP = 0.06  # s, over which a foot rolls onto or off its toes
_EASE = 0.02  # s; standard deviation over which corrections of the path are smoothed
_CLEAR = 0.02  # m; a foot that swings is at least that far above the ground,
_TAKE_OFF = 0.1  # s after it has left it


@dataclass(frozen=True)
class FootPath:
    """Where a foot's body should be, and when it stands."""

    pos: np.ndarray  # [T, 3] m
    rotation: Rotation  # [T]
    planted: np.ndarray  # bool [T]; at least the toes
    flat: np.ndarray  # bool [T]; the whole sole

    @property
    def toe(self) -> np.ndarray:
        """Where the front of the sole should be. [T, 3]"""
        return self.pos + self.rotation.apply(TOE)

    @property
    def soles(self) -> np.ndarray:
        """The points of the sole. [T, 4, 3]"""
        turned = [self.rotation.apply(point) for point in g1.FOOT_POINTS]
        return self.pos[:, None] + np.stack(turned, axis=1)

    @property
    def standing(self) -> np.ndarray:
        """Which of them stand: the front ones are on the toes. bool [T, 4]"""
        front = np.array([point[0] > 0 for point in g1.FOOT_POINTS])
        return np.where(front, self.planted[:, None], self.flat[:, None])


def foot_path(playback: Playback, foot: str, away: np.ndarray) -> FootPath:
    """The path of a foot whose planted phases have one place each, and one level pose where the sole is flat.

    A foot is planted while it hardly moves near the ground. In a planted phase the toes keep the place and heading that
    they have on average, on the ground, and the foot rolls about them. What that changes is carried over into the
    swings before and after.

    Args:
        away: frames in which the foot is not to stand, whatever it does. bool [T]
    """
    pos, mat = playback.body_poses(foot)
    rotation, fps = Rotation.from_matrix(mat), playback.fps
    ends = pos[:, None] + np.stack([rotation.apply(TOE), rotation.apply(HEEL)], axis=1)  # [T, 2, 3]
    ground = support_height(playback, ends) + g1.FOOT_POINT_RADIUS
    near = (np.abs(ends[..., 2] - ground) < _NEAR) & ~away[:, None]
    toe, heel = (lasting(keeps_still(ends[:, i], fps, _SPEED) & near[:, i], fps) for i in range(2))
    flat = lasting(toe & heel & (np.arccos(np.clip(mat[:, 2, 2], -1.0, 1.0)) < _LEVEL), fps)
    planted = toe | flat
    flat = binary_closing(np.pad(flat, pause := round(_PAUSE * fps)), np.ones(pause + 1, bool))[pause:-pause] & planted
    heading = np.unwrap(np.arctan2(mat[:, 1, 0], mat[:, 0, 0]))
    fixed_pos, turn = pos.copy(), np.zeros_like(pos)
    stances, count = label(planted)
    for stance in range(1, count + 1):
        frames = stances == stance
        level = frames & flat
        if level.any():
            upright = Rotation.from_euler("z", heading[level].mean())
            share = np.minimum(distance_transform_edt(~level)[frames] / (_RAMP * fps), 1.0)
            share = 1 - share**2 * (3 - 2 * share)
            turn[frames] = share[:, None] * (upright * rotation[frames].inv()).as_rotvec()
        at = level if level.any() else frames
        pivot = np.append(ends[at, 0, :2].mean(axis=0), np.median(ground[at, 0]))
        fixed_pos[frames] = pivot - (Rotation.from_rotvec(turn[frames]) * rotation[frames]).apply(TOE)
    moved = carried_over(np.column_stack([fixed_pos - pos, turn]), planted)
    moved = gaussian_filter1d(moved, _EASE * fps, axis=0, mode="nearest")  # a foot does not stop at once
    pos, rotation = pos + moved[:, :3], Rotation.from_rotvec(moved[:, 3:]) * rotation
    pos[:, 2] += _lift(playback, pos, rotation, planted)
    return FootPath(pos, rotation, planted, flat)


def _lift(playback: Playback, pos: np.ndarray, rotation: Rotation, planted: np.ndarray) -> np.ndarray:
    """How far a foot has to be raised so as not to drag where it swings low over the ground, m. [T]"""
    if not planted.any():
        return np.zeros(len(pos))
    ends = pos[:, None] + np.stack([rotation.apply(TOE), rotation.apply(HEEL)], axis=1)
    height = (ends[..., 2] - support_height(playback, ends)).min(axis=1) - g1.FOOT_POINT_RADIUS
    away = np.minimum(distance_transform_edt(~planted) / (_TAKE_OFF * playback.fps), 1.0)
    low = (height < _CLEAR) & (height > -_NEAR)
    raised: np.ndarray = gaussian_filter1d(
        np.where(low, away**2 * (3 - 2 * away) * (_CLEAR - height), 0.0), _EASE * playback.fps
    )
    return np.where(planted, 0.0, raised)
