"""Signed distances from an object's surface: primitives in closed form, meshes by trimesh as they are, not as hulls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from hdmi.assets import GeomConfig, ObjectConfig
from hdmi.assets.objects import load_mesh

_STEP = 1e-5  # m; of the numerical gradient


@dataclass(frozen=True)
class Surface:
    """The surface of one body of an object: the union of its geoms, in the body's frame."""

    geoms: Sequence[GeomConfig]

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distance from the surface, negative inside, m. [..., 3] -> [...]"""
        flat = points.reshape(-1, 3)
        distances = [_geom_distance(geom, flat) for geom in self.geoms]
        return np.min(distances, axis=0).reshape(points.shape[:-1])

    def nearest(self, points: np.ndarray) -> np.ndarray:
        """The surface's points nearest to the given ones. [N, 3] -> [N, 3]"""
        steps = _STEP * np.eye(3)
        probes = points[:, None, None] + np.stack([steps, -steps], axis=1)  # [N, 3, 2, 3]
        around = self.distance(probes)
        gradient = (around[..., 0] - around[..., 1]) / (2 * _STEP)
        norm = np.linalg.norm(gradient, axis=-1, keepdims=True)
        return points - self.distance(points)[:, None] * gradient / np.maximum(norm, 1e-9)


def object_surfaces(config: ObjectConfig) -> dict[str, Surface]:
    """The surfaces of an object's bodies by name: its base and, if it is articulated, its link; those with geoms."""
    bodies: list[tuple[str, Sequence[Any]]] = [(config.name, config.geoms)]
    if config.hinge is not None:
        bodies.append((config.hinge.body, config.hinge.geoms))
    return {name: Surface([_geom(geom) for geom in geoms]) for name, geoms in bodies if geoms}


def _geom(geom: Any) -> GeomConfig:
    return geom if isinstance(geom, GeomConfig) else GeomConfig(**geom)


def _geom_distance(geom: GeomConfig, points: np.ndarray) -> np.ndarray:
    """[N, 3] in the body's frame -> [N]"""
    tilt = Rotation.from_quat(geom.body_quat, scalar_first=True)
    rotation = tilt * Rotation.from_quat(geom.quat, scalar_first=True)
    local = rotation.inv().apply(points - tilt.apply(geom.pos))
    if geom.mesh is not None:
        return -trimesh.proximity.signed_distance(load_mesh(geom.mesh, geom.scale), local)
    if geom.sphere is not None:
        return np.linalg.norm(local, axis=-1) - np.ravel(geom.sphere)[0]
    if geom.box is not None:
        return _box(np.abs(local) - np.asarray(geom.box))
    if geom.capsule is not None:
        radius, half = geom.capsule
        local[:, 2] -= np.clip(local[:, 2], -half, half)
        return np.linalg.norm(local, axis=-1) - radius
    assert geom.cylinder is not None
    radius, half = geom.cylinder
    return _box(np.stack([np.linalg.norm(local[:, :2], axis=-1) - radius, np.abs(local[:, 2]) - half], axis=-1))


def _box(beyond: np.ndarray) -> np.ndarray:
    """From how far a point is beyond each pair of faces. [N, D] -> [N]"""
    return np.linalg.norm(beyond.clip(min=0), axis=-1) + beyond.max(axis=-1).clip(max=0)
