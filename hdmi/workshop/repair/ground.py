"""Heights of what the robot may stand on, and how far a motion is above or in it."""

from __future__ import annotations

from copy import copy

import mujoco
import numpy as np
from scipy.ndimage import gaussian_filter1d

from hdmi.motion.kinematics import derivative
from hdmi.motion.playback import FAR, TOUCH, Playback

_STEP_UP = 0.1  # m; what is that far above a sole may still be under it
_GRAVITY = 9.81
_FALLING = 0.8  # of gravity; from here on a robot needs no ground
_EASE = 0.08  # s; standard deviation over which the robot's height is smoothed
_GROUND, _STANDING, _OTHER = range(3)  # groups of geoms


def support_height(playback: Playback, points: np.ndarray) -> np.ndarray:
    """Height of the ground, or of an object that stands, under points of the robot, m. [T, P, 3] -> [T, P]

    Minus infinity over nothing.
    """
    scene = playback.scene
    model = copy(scene.model)
    model.geom_group[:] = _OTHER
    model.geom_group[playback.ground_geoms] = _GROUND
    model.geom_group[scene.object_geoms] = _STANDING
    stands = np.zeros(playback.num_frames, bool)
    if scene.object_geoms.size:
        stands |= (playback.object_clearance.min(axis=1) < TOUCH) | (scene.object_free_dof is None)
    data, down, hit = mujoco.MjData(model), np.array([0.0, 0.0, -1.0]), np.zeros(1, np.int32)
    groups = {solid: np.array([1, solid, 0, 0, 0, 0], np.uint8) for solid in (False, True)}
    out = np.full(points.shape[:2], -np.inf)
    for t, qpos in enumerate(playback.qpos):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        for p, point in enumerate(points[t]):
            above = point + np.array([0.0, 0.0, _STEP_UP])
            distance = mujoco.mj_ray(model, data, above, down, groups[bool(stands[t])], 1, -1, hit)
            if distance >= 0:
                out[t, p] = above[2] - distance
    return out


def lowering(playback: Playback) -> np.ndarray:
    """How far to move the robot up for its lowest part to touch what it may stand on, smooth over time, m. [T]

    Where it falls freely the frames around decide.
    """
    height, fps = playback.qpos[:, 2], playback.fps
    up = -playback.clearance.min(axis=1)
    smooth = gaussian_filter1d(height, _EASE * fps, mode="nearest")
    falls = derivative(derivative(smooth, fps), fps) < -_FALLING * _GRAVITY
    known = np.flatnonzero(~falls & (up > -FAR))
    if not known.size:
        return np.zeros(len(height))
    filled = np.interp(np.arange(len(height)), known, up[known])
    eased: np.ndarray = gaussian_filter1d(filled, _EASE * fps, mode="nearest")
    return eased
