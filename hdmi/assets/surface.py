"""Signed distances from an object's surface: primitives in closed form, meshes as they are, not as hulls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hdmi.assets.mesh import load_mesh
from hdmi.assets.objects import GeomConfig, ObjectConfig
from hdmi.assets.solid import Solid

_STEP = 1e-5  # m; of the numerical gradient


@dataclass(frozen=True)
class Surface:
    """The surface of one body of an object: the union of its geoms, in the body's frame.

    Examples:
        >>> from hdmi.assets import ObjectConfig
        >>> ball = object_surfaces(ObjectConfig("ball", geoms=[{"sphere": 0.5}]))["ball"]
        >>> ball.distance(np.array([[2.0, 0.0, 0.0], [0.0, 0.0, 0.25]]))
        array([ 1.5 , -0.25])
    """

    geoms: Sequence[GeomConfig]

    @cached_property
    def _shapes(self) -> list[_Shape]:
        return [_Shape(geom) for geom in self.geoms]

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distance from the surface, negative inside, m. [..., 3] -> [...]"""
        flat = points.reshape(-1, 3)
        distances = [shape.distance(flat) for shape in self._shapes]
        return np.min(distances, axis=0).reshape(points.shape[:-1])

    def nearest(self, points: np.ndarray) -> np.ndarray:
        """The surface's points nearest to the given ones. [N, 3] -> [N, 3]"""
        distances, nearest = zip(*(shape.nearest(points) for shape in self._shapes), strict=True)
        return np.stack(nearest)[np.argmin(distances, axis=0), np.arange(len(points))]

    def inward(self, points: np.ndarray) -> np.ndarray:
        """Unit vectors into the object, against the gradient of the distance. [N, 3] -> [N, 3]"""
        steps = _STEP * np.eye(3)
        around = self.distance(points[:, None, None] + np.stack([-steps, steps], axis=1))  # [N, 3, 2]
        falling = around[..., 0] - around[..., 1]
        return falling / np.maximum(np.linalg.norm(falling, axis=-1, keepdims=True), 1e-12)


def object_surfaces(config: ObjectConfig) -> dict[str, Surface]:
    """The surfaces of an object's bodies by name: its base and, if it is articulated, its link; those with geoms."""
    bodies: list[tuple[str, Sequence[Any]]] = [(config.name, config.geoms)]
    if config.hinge is not None:
        bodies.append((config.hinge.body, config.hinge.geoms))
    return {name: Surface([_geom(geom) for geom in geoms]) for name, geoms in bodies if geoms}


def _geom(geom: Any) -> GeomConfig:
    return geom if isinstance(geom, GeomConfig) else GeomConfig(**geom)


class _Shape:
    """A geom in its body's frame."""

    def __init__(self, geom: GeomConfig):
        self.geom = geom
        tilt = Rotation.from_quat(geom.body_quat, scalar_first=True)
        self.pos, self.rotation = tilt.apply(geom.pos), tilt * Rotation.from_quat(geom.quat, scalar_first=True)
        self.solid = None if geom.mesh is None else Solid(load_mesh(geom.mesh, geom.scale))

    def distance(self, points: np.ndarray) -> np.ndarray:
        """[N, 3] -> [N]"""
        local = self.rotation.inv().apply(points - self.pos)
        return _primitive(self.geom, local) if self.solid is None else self.solid.nearest(local)[0]

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances and the surface's nearest points. [N, 3] -> [N], [N, 3]"""
        local = self.rotation.inv().apply(points - self.pos)
        if self.solid is not None:
            distance, nearest = self.solid.nearest(local)
            return distance, self.pos + self.rotation.apply(nearest)
        distance = _primitive(self.geom, local)
        steps = _STEP * np.eye(3)
        probes = local[:, None, None] + np.stack([steps, -steps], axis=1)  # [N, 3, 2, 3]
        around = _primitive(self.geom, probes.reshape(-1, 3)).reshape(probes.shape[:-1])
        gradient = (around[..., 0] - around[..., 1]) / (2 * _STEP)
        norm = np.linalg.norm(gradient, axis=-1, keepdims=True)
        return distance, self.pos + self.rotation.apply(local - distance[:, None] * gradient / np.maximum(norm, 1e-9))


def _primitive(geom: GeomConfig, local: np.ndarray) -> np.ndarray:
    """Distances in the geom's frame. [N, 3] -> [N]"""
    if geom.sphere is not None:
        return np.linalg.norm(local, axis=-1) - np.ravel(geom.sphere)[0]
    if geom.box is not None:
        return _box(np.abs(local) - np.asarray(geom.box))
    if geom.capsule is not None:
        radius, half = geom.capsule
        beyond = local - np.clip(local[:, 2:], -half, half) * [0, 0, 1]
        return np.linalg.norm(beyond, axis=-1) - radius
    assert geom.cylinder is not None
    radius, half = geom.cylinder
    return _box(np.stack([np.linalg.norm(local[:, :2], axis=-1) - radius, np.abs(local[:, 2]) - half], axis=-1))


def _box(beyond: np.ndarray) -> np.ndarray:
    """From how far a point is beyond each pair of faces. [N, D] -> [N]"""
    return np.linalg.norm(beyond.clip(min=0), axis=-1) + beyond.max(axis=-1).clip(max=0)
