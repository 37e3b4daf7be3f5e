"""End effectors on their contact points while contact is labelled, and eased there and back."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from hdmi.assets import ObjectConfig
from hdmi.assets.surface import object_surfaces
from hdmi.motion.kinematics import minimum_jerk
from hdmi.motion.playback import Playback
from hdmi.workshop.annotate import intervals

_EASE = 0.25  # s, over which an effector comes to its contact point, or longer,
_PACE = 0.5  # m/s, where it would be faster than this
_FARTHEST = 0.1  # m; a contact point further from where an effector would touch is believed


@dataclass(frozen=True)
class Reach:
    """Where an effector's point should be, and how far that counts, from 0 (free) to 1 (in contact)."""

    pos: np.ndarray  # [T, 3] m
    share: np.ndarray  # [T]
    inward: np.ndarray  # [T, 3] unit vectors into the object


def reaches(
    playback: Playback, object: ObjectConfig, press: float, tolerance: float = 0.0, reduce: str = "mean"
) -> list[Reach]:
    """The effectors' paths to and on their contact points, in the order of the scene's. [E]

    Args:
        press: how far inside the surface the contact points are taken to be, besides what the effectors ask for, m.
        tolerance: distance from a contact point that needs no mending, m.
        reduce: `max`: of several effectors that are to touch, only the nearest has to.
    """
    label = playback.reference.contact.numpy()
    points = playback.reference.contact_point.numpy().astype(float)  # [T, E, 3]
    surface = object_surfaces(object)[object.link]
    pos, mat = playback.body_poses(playback.scene.object_link)
    inward = np.einsum("tij,tej->tei", mat, surface.inward(points.reshape(-1, 3)).reshape(points.shape))
    goals = pos[:, None] + np.einsum("tij,tej->tei", mat, points) + press * inward
    actual = playback.effector_pos_w
    apart = np.linalg.norm(actual - goals, axis=-1)
    if reduce == "max":
        label = label & (apart == np.where(label, apart, np.inf).min(axis=1, keepdims=True))
    if tolerance > 0:
        near = np.minimum(tolerance / np.maximum(apart, 1e-9), 1.0)
        goals = goals + near[..., None] * (actual - goals)
        label = label & (apart > tolerance)
    local = np.einsum("tji,tej->tei", mat, goals - actual)
    out = []
    for e in range(label.shape[1]):
        change, share = _eased(label[:, e], local[:, e], playback.fps)
        out.append(Reach(actual[:, e] + np.einsum("tij,tj->ti", mat, change), share, inward[:, e]))
    return out


def pressed(playback: Playback, reaches: list[Reach], press: float) -> list[Reach]:
    """The same paths, moved along the surface's normal so that the effectors' shapes are pressed in where they touch.

    A contact point says where an effector's point should be, and may be outside of the surface by a hand's thickness.

    Args:
        playback: of a motion that follows the paths.
    """
    out = []
    for effector, reach in zip(playback.scene.effectors, reaches, strict=True):
        geoms = playback.robot_geoms[playback.on_bodies([effector.body])]
        gap = playback.distances(geoms, playback.scene.object_geoms).min(axis=1)
        missing = np.where(reach.share == 1, (gap + effector.press + press).clip(-_FARTHEST, _FARTHEST), 0.0)
        smooth = gaussian_filter1d(missing, _EASE / 3 * playback.fps, mode="nearest") * reach.share
        out.append(replace(reach, pos=reach.pos + smooth[:, None] * reach.inward))
    return out


def _eased(label: np.ndarray, change: np.ndarray, fps: float) -> tuple[np.ndarray, np.ndarray]:
    """Changes of a path where a label is on, eased in and out around it, the slower the larger they are.

    Args:
        label: bool [T]
        change: in the frame of what is touched, m. [T, 3]

    Returns:
        Changes [T, 3], and how far the label counts, from 0 to 1. [T]
    """
    frames, total = np.arange(len(label)), np.zeros_like(change)
    shares = np.zeros((1, len(label)))
    for first, last in intervals(label):
        begin, end = (fps * max(_EASE, float(np.linalg.norm(change[t])) / _PACE) for t in (first, last))
        away = np.maximum((first - frames) / begin, (frames - last) / end).clip(min=0.0)
        share = minimum_jerk(1.0 - away)
        total += share[:, None] * change[np.clip(frames, first, last)]
        shares = np.vstack([shares, share])
    return total / np.maximum(shares.sum(axis=0), 1.0)[:, None], shares.max(axis=0)
