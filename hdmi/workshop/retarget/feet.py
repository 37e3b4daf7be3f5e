"""Feet that stay where they stand: steps found in the person's motion, and paths of the robot's ankles through them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_closing, binary_opening, distance_transform_edt, label
from scipy.spatial.transform import Rotation

from hdmi.assets import g1
from hdmi.workshop.retarget.body import SIDES, SOLE_HEIGHT, TOE, Body, Scaling, robot_measures

_STANDING_SPEED = 0.25  # of a joint of a standing foot, below, m/s
_SLOWEST = 0.03  # m/s; what is slower stands, however far it gets
_DRIFT = 0.05  # of a standing foot from its mean place, at most, m
_SHORTEST = 0.1  # stance, s
_LEVEL = 0.35  # pitch of a foot that counts as flat, rad
_GROUND = 0.06  # toes lower than this are on the ground, m
_RAMP = 0.06  # s, over which a foot rolls onto or off its toes


@dataclass(frozen=True)
class Stances:
    """When feet stand, by side. bool [T]"""

    toe: dict[str, np.ndarray]  # at least the toes; a kneeling person's, too
    flat: dict[str, np.ndarray]  # the whole sole


@dataclass(frozen=True)
class FootPaths:
    """Where the robot's ankles should be, by side."""

    pos: dict[str, np.ndarray]  # [T, 3] m
    quat: dict[str, np.ndarray]  # [T, 4] wxyz
    stances: Stances

    def toe(self, side: str) -> np.ndarray:
        """Where the front of the sole should be. [T, 3]"""
        return self.pos[side] + Rotation.from_quat(self.quat[side], scalar_first=True).apply(TOE)


def find_stances(body: Body, fps: float) -> Stances:
    """Finds when feet stand: their joints barely move for a while, at whatever height."""
    toe, flat = {}, {}
    for side in SIDES:
        ankle = keeps_still(body.pos[f"{side}_ankle"], fps)
        front = keeps_still(body.pos[f"{side}_foot"], fps) if f"{side}_foot" in body.pos else ankle
        flat[side] = lasting(ankle & front & (np.abs(body.foot_pitch[side]) < _LEVEL), fps)
        toe[side] = lasting(front, fps) | flat[side]
    return Stances(toe, flat)


def keeps_still(path: np.ndarray, fps: float, speed: float = _STANDING_SPEED) -> np.ndarray:
    """Where a joint is slower than `speed` for a while; what drifts nevertheless has to be slower still. bool [T]"""
    still = lasting(np.linalg.norm(np.gradient(path, 1 / fps, axis=0), axis=-1) < speed, fps)
    stretches, count = label(still)
    for stretch in range(1, count + 1):
        frames = stretches == stretch
        drift = np.linalg.norm(path[frames] - path[frames].mean(0), axis=-1).max()
        if drift > _DRIFT and frames.sum() > 1 and speed > _SLOWEST:
            still[frames] = keeps_still(path[frames], fps, speed / 2)
    return still


def lasting(mask: np.ndarray, fps: float) -> np.ndarray:
    """Without short interruptions, and then without what is short. bool [T]"""
    window = np.ones(max(round(_SHORTEST * fps), 1), bool)
    padded = np.pad(mask, len(window), mode="edge")
    return binary_opening(binary_closing(padded, window), window)[len(window) : -len(window)]


def foot_paths(body: Body, stances: Stances, scaling: Scaling, fps: float) -> FootPaths:
    """Paths of the robot's ankles: fixed where the foot stands, the person's, scaled, in between.

    In a stance the toes keep the place and heading that they have, on average, while the foot is flat (if it is, at
    some time), and the foot rolls about them. What that differs from the person's scaled path is carried over into the
    swings before and after.
    """
    robot = robot_measures()
    person = np.linalg.norm(body.pos["left_hip"] - body.pos["right_hip"], axis=-1)
    widen = robot.hip[1] - scaling.scale * float(np.median(person)) / 2  # the robot's hips are wider
    forward = body.pelvis.as_matrix()[:, :, 0]
    heading = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))
    left = np.stack([-np.sin(heading), np.cos(heading), np.zeros(len(heading))], axis=-1)
    pos, quat = {}, {}
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        base = scaling(body.pos[f"{side}_ankle"]) + sign * widen * left
        # place, yaw and pitch of the foot together, so that they are corrected together. [T, 5]
        free = np.column_stack([base, body.foot_yaw[side], body.foot_pitch[side]])
        fixed = _standing(free, stances.toe[side], stances.flat[side], fps)
        path = free + carried_over(fixed - free, stances.toe[side])
        pos[side] = path[:, :3]
        quat[side] = _foot_rotation(path[:, 3], path[:, 4]).as_quat(scalar_first=True)
    return FootPaths(pos, quat, stances)


def _foot_rotation(yaw: np.ndarray, pitch: np.ndarray) -> Rotation:
    return Rotation.from_euler("ZY", np.column_stack([yaw, pitch]))


def _standing(free: np.ndarray, toe: np.ndarray, flat: np.ndarray, fps: float) -> np.ndarray:
    """The foot in its stances; elsewhere as it is. [T, 5]"""
    out = free.copy()
    labels, count = label(toe)
    for stance in range(1, count + 1):
        frames = labels == stance
        level = frames & flat
        pitch = np.maximum(free[frames, 4], 0.0)
        if level.any():
            share = np.minimum(distance_transform_edt(~level)[frames] / (_RAMP * fps), 1.0)
            pitch *= share**2 * (3 - 2 * share)
        weight = (level if level.any() else frames)[frames]
        yaws = np.full(len(pitch), free[frames, 3][weight].mean())
        lever = _foot_rotation(yaws, pitch).apply(TOE)
        pivot = (free[frames, :3] + lever)[weight].mean(0)
        if pivot[2] < _GROUND:
            pivot[2] = SOLE_HEIGHT + TOE[2]
        ankle = pivot - lever
        out[frames] = np.column_stack([ankle, yaws, pitch])
    return out


def carried_over(correction: np.ndarray, stance: np.ndarray) -> np.ndarray:
    """Corrections in stances, eased from one to the next in the swings between. [T, D]"""
    out = correction.copy()
    if not stance.any():
        return np.zeros_like(out)
    swings, count = label(~stance)
    for swing in range(1, count + 1):
        frames = np.flatnonzero(swings == swing)
        before, after = frames[0] - 1, frames[-1] + 1
        if before < 0 or after == len(stance):
            out[frames] = correction[after if before < 0 else before]
            continue
        share = (frames - before) / (after - before)
        ease = (share**2 * (3 - 2 * share))[:, None]
        out[frames] = (1 - ease) * correction[before] + ease * correction[after]
    return out


def slide(paths: FootPaths, body_pos: np.ndarray, body_quat: np.ndarray, fps: float) -> np.ndarray:
    """Speed of the soles of standing feet: of the toes, and of the heel too where the foot is flat, m/s. [S]

    Args:
        body_pos, body_quat: of all bodies. [T, B, 3], [T, B, 4]
    """
    speeds = []
    for side, foot in zip(SIDES, g1.FEET, strict=True):
        b = g1.BODY_NAMES.index(foot)
        rotation = Rotation.from_quat(body_quat[:, b], scalar_first=True)
        for stands, points in ((paths.stances.toe, g1.FOOT_POINTS[:2]), (paths.stances.flat, g1.FOOT_POINTS[2:])):
            both = stands[side][1:] & stands[side][:-1]
            for point in points:
                steps = np.diff(body_pos[:, b] + rotation.apply(point), axis=0)[both]
                speeds.append(np.linalg.norm(steps[:, :2], axis=-1) * fps)
    return np.concatenate(speeds)
