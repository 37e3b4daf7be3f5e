"""The object in the robot's scene, and hands that keep their place on it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from hdmi.assets import GeomConfig, ObjectConfig
from hdmi.assets.mesh import load_mesh
from hdmi.assets.surface import object_surfaces
from hdmi.workshop.human import ObjectTrajectory
from hdmi.workshop.ik import Obstacle

# The hand's collision capsule: its ends from the palm's point, in the hand's frame, and its radius, m.
_HAND = np.array([[-0.01, 0.0, 0.0], [0.07, 0.0, 0.0]])
_HAND_RADIUS = 0.035
_NEAR, _FAR = 0.05, 0.30  # m; a hand nearer to the object belongs to it, one farther to the body
_RAMP = 0.1  # s, over which a labelled contact takes hold of a hand

Poses = dict[str, tuple[np.ndarray, Rotation]]


def object_poses(config: ObjectConfig, trajectory: ObjectTrajectory) -> Poses:
    """Positions [T, 3] and orientations of the object's body and, if it is articulated, of its link, by name."""
    pos, base = trajectory.pos.astype(float), Rotation.from_quat(trajectory.quat.astype(float), scalar_first=True)
    if config.hinge is None:
        return {config.name: (pos, base)}
    angle = np.zeros(len(pos)) if trajectory.joint_pos is None else trajectory.joint_pos.astype(float)
    axis = np.asarray(config.hinge.axis, float)
    turn = Rotation.from_rotvec(angle[:, None] * axis / np.linalg.norm(axis))
    link = base * Rotation.from_quat(config.hinge.quat, scalar_first=True) * turn
    return {config.name: (pos, base), config.link: (pos + base.apply(config.hinge.pos), link)}


def obstacles(config: ObjectConfig, trajectory: ObjectTrajectory) -> list[Obstacle]:
    """The object's bodies as something the robot may not enter."""
    poses = object_poses(config, trajectory)
    return [
        Obstacle(name, surface.geoms, poses[name][0], poses[name][1].as_quat(scalar_first=True))
        for name, surface in object_surfaces(config).items()
    ]


def scale_object(
    trajectory: ObjectTrajectory, scale: float, config: ObjectConfig | None, anchor: np.ndarray | None = None
) -> ObjectTrajectory:
    """The object in the scaled scene: its orientation and size stay, its place and its height above ground scale.

    Heights are those of its lowest point, so that what stands on the ground still does; without geometry, those above
    the lowest of the trajectory. What is fixed in the world keeps its height.

    Args:
        anchor: the point of the object whose place is scaled, in its frame, m; its origin if absent. [3]
    """
    pos = trajectory.pos.astype(float)
    lever = np.zeros_like(pos)
    if anchor is not None:
        lever = Rotation.from_quat(trajectory.quat.astype(float), scalar_first=True).apply(anchor)
    if config is None:
        above = pos[:, 2] - pos[:, 2].min()
    else:
        above = np.zeros(len(pos)) if config.fixed_base else np.maximum(lowest_point(config, trajectory), 0.0)
    scaled = np.column_stack([pos[:, :2] + (scale - 1) * (pos + lever)[:, :2], pos[:, 2] + (scale - 1) * above])
    return ObjectTrajectory(trajectory.name, scaled.astype(np.float32), trajectory.quat, trajectory.joint_pos)


def handled_point(palms: Sequence[np.ndarray], config: ObjectConfig, trajectory: ObjectTrajectory) -> np.ndarray:
    """Where hands are on the object while they are nearest to it, in its frame, m; its origin if none comes near. [3]

    In a scaled scene an object of true size has to grow away from those who handle it, wherever its origin is.

    Args:
        palms: in the person's scene, m. [T, 3] each
    """
    poses = object_poses(config, trajectory)
    pos, base = poses[config.name]
    gaps, points = [], []  # of each hand, [T] and [T, 3]
    for palm in palms:
        distances, nearest = [], []
        for name, surface in object_surfaces(config).items():
            link_pos, rotation = poses[name]
            local = rotation.inv().apply(palm - link_pos)
            distances.append(surface.distance(local))
            nearest.append(base.inv().apply(link_pos + rotation.apply(surface.nearest(local)) - pos))
        closest, frames = np.argmin(distances, axis=0), np.arange(len(palm))
        gaps.append(np.min(distances, axis=0))
        points.append(np.array(nearest)[closest, frames])
    nearest_ever = np.min(gaps)
    if nearest_ever > _FAR:
        return np.zeros(3)
    # of each hand that comes about as near
    near = [gap <= nearest_ever + _NEAR for gap in gaps]
    return np.mean([np.median(p[n], axis=0) for p, n in zip(points, near, strict=True) if n.any()], axis=0)


def lowest_point(config: ObjectConfig, trajectory: ObjectTrajectory) -> np.ndarray:
    """Height of the object's lowest point above the ground, m. [T]"""
    poses, heights = object_poses(config, trajectory), []
    for name, surface in object_surfaces(config).items():
        pos, rotation = poses[name]
        down = rotation.inv().apply([0.0, 0.0, -1.0])
        heights += [pos[:, 2] - _extent(geom, down) for geom in surface.geoms]
    return np.min(heights, axis=0)


def _extent(geom: GeomConfig, direction: np.ndarray) -> np.ndarray:
    """How far a geom reaches in unit directions of its body's frame, m. [T, 3] -> [T]"""
    tilt = Rotation.from_quat(geom.body_quat, scalar_first=True)
    local = (tilt * Rotation.from_quat(geom.quat, scalar_first=True)).inv().apply(direction)
    offset = direction @ tilt.apply(geom.pos)
    if geom.mesh is not None:
        corners = load_mesh(geom.mesh, geom.scale).convex_hull.vertices
        return offset + np.array([(corners @ axis).max() for axis in local])  # not [T, corners] at once
    if geom.box is not None:
        return offset + np.abs(local) @ np.asarray(geom.box, float)
    if geom.sphere is not None:
        return offset + np.ravel(geom.sphere)[0]
    if geom.capsule is not None:
        return offset + np.abs(local[:, 2]) * geom.capsule[1] + geom.capsule[0]
    size: Any = geom.cylinder
    return offset + np.abs(local[:, 2]) * size[1] + np.linalg.norm(local[:, :2], axis=-1) * size[0]


def on_object(
    points: np.ndarray,
    hand: Rotation,
    config: ObjectConfig,
    source: ObjectTrajectory,
    scaled: ObjectTrajectory,
    contact: np.ndarray | None,
    fps: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Where a palm is in the robot's scene if it keeps its place in the frame of the object's nearest body.

    It stays so far outside of the surface that the robot's hand does, too, and where contact is labelled it comes as
    near as that.

    Args:
        points: in the person's scene, m. [T, 3]
        hand: orientation that the robot's hand should have. [T]
        source, scaled: the object in the person's scene and in the robot's.
        contact: bool [T] or None.

    Returns:
        The points in the robot's scene [T, 3], and how far they count, from 0 (far from the object) to 1. [T]
    """
    hold = np.zeros(len(points)) if contact is None else _held(contact, fps)
    before, after = object_poses(config, source), object_poses(config, scaled)
    gaps, moved = [], []
    for name, surface in object_surfaces(config).items():
        pos, rotation = before[name]
        local = rotation.inv().apply(points - pos)
        gap, nearest = surface.distance(local), surface.nearest(local)
        normal = (local - nearest) * np.sign(gap)[:, None]
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
        inwards = hand.inv().apply(-rotation.apply(normal))
        depth = _HAND_RADIUS + (inwards @ _HAND.T).max(axis=1)
        wanted = np.maximum(gap, depth)
        wanted += hold * (depth - wanted)
        pos, rotation = after[name]
        gaps.append(gap)
        moved.append(pos + rotation.apply(nearest + wanted[:, None] * normal))
    closest = np.argmin(gaps, axis=0)
    gap = np.min(gaps, axis=0)
    share = np.clip((_FAR - gap) / (_FAR - _NEAR), 0.0, 1.0)
    share = share**2 * (3 - 2 * share)
    return np.array(moved)[closest, np.arange(len(points))], np.maximum(share, hold)


def _held(contact: np.ndarray, fps: float) -> np.ndarray:
    """Contact labels with soft edges outside of them. [T] in 0..1"""
    soft = gaussian_filter1d(contact.astype(float), _RAMP * fps / 2, mode="nearest")
    return np.where(contact, 1.0, np.minimum(2 * soft, 1.0))
