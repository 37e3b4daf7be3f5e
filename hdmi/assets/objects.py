"""Objects to interact with and static scenery, described by a few figures and composed with MjSpec."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
import trimesh

from hdmi.assets.robot import ROBOT_BIT, WORLD_BIT

_IDENTITY = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class GeomConfig:
    """One geom of an object, in its body's frame: exactly one of box, sphere, capsule, cylinder, mesh.

    Args:
        box: half extents, m. [3]
        sphere: radius, m.
        capsule, cylinder: radius and half length along z, m. [2]
        mesh: path of a file that trimesh reads (OBJ, STL, PLY, GLB); collides as its convex hull.
        scale: of the mesh, one figure or three.
        pos, quat: of the geom in the body frame, m and wxyz.
        body_quat: rotates pos and quat about the body's origin (for a body frame that is tilted in the source).
        rgba: colour; the object's if absent.
    """

    box: Sequence[float] | None = None
    sphere: float | None = None
    capsule: Sequence[float] | None = None
    cylinder: Sequence[float] | None = None
    mesh: str | None = None
    scale: Any = 1.0
    pos: Sequence[float] = (0.0, 0.0, 0.0)
    quat: Sequence[float] = _IDENTITY
    body_quat: Sequence[float] = _IDENTITY
    rgba: Sequence[float] | None = None


@dataclass(frozen=True)
class HingeConfig:
    """The moving link of an articulated object: a body hinged to the base.

    Args:
        name: of the joint, as the reference motion names it.
        body: of the link; the body that contact points are fixed to.
        geoms: of the link, in its frame.
        pos, quat: of the link in the base frame; the hinge passes through its origin.
        axis, range: of the hinge, in the link frame, rad.
        friction: dry friction, N m. damping: N m s/rad.
    """

    name: str
    body: str
    geoms: Sequence[Any]
    pos: Sequence[float] = (0.0, 0.0, 0.0)
    quat: Sequence[float] = _IDENTITY
    axis: Sequence[float] = (0.0, 0.0, 1.0)
    range: Sequence[float] = (-1.57, 1.57)
    friction: float = 0.1
    damping: float = 0.1


@dataclass(frozen=True)
class ObjectConfig:
    """An object to interact with.

    Args:
        name: the body that the reference motion tracks.
        geoms: in the frame of that body (`GeomConfig` or the same as a mapping).
        mass: kg, spread over the geoms (of the link, if articulated and fixed) by volume.
        friction: sliding friction.
        friction_combine: of a pair that the object is one of: `max`, MuJoCo's rule, takes the larger friction; `object`
            takes the object's (MuJoCo's `priority`), however rough the hand.
        torsional_friction: m, about the radius of the patch in which hands touch it: contacts then resist turning about
            their normal, too (condim 4); 0: they do not.
        hinge: the link of an articulated object.
        fixed_base: static in the world at the reference's first pose.
        rgba: colour.
    """

    name: str
    geoms: Sequence[Any] = ()
    mass: float = 1.0
    friction: float = 0.6
    friction_combine: Literal["max", "object"] = "max"
    torsional_friction: float = 0.0
    hinge: Any = None
    fixed_base: bool = False
    rgba: Sequence[float] = (0.80, 0.56, 0.30, 1.0)

    def __post_init__(self) -> None:
        if not self.geoms and self.hinge is None:
            raise ValueError(f"object {self.name!r}: has no geoms")
        if not (self.mass > 0 and np.isfinite(self.mass)):
            raise ValueError(f"object {self.name!r}: mass must be positive, got {self.mass}")
        if self.friction_combine not in ("max", "object"):
            raise ValueError(
                f"object {self.name!r}: friction_combine is 'max' or 'object', got {self.friction_combine!r}"
            )
        if self.hinge is not None and not isinstance(self.hinge, HingeConfig):
            object.__setattr__(self, "hinge", HingeConfig(**self.hinge))

    @property
    def link(self) -> str:
        """The body that contact points are fixed to."""
        return self.name if self.hinge is None else self.hinge.body


@dataclass(frozen=True)
class SceneryConfig:
    """A static body: never tracked, placed at the reference's pose of that name or at `pos`, `quat`.

    Args:
        friction: sliding friction. MuJoCo takes the larger one of a pair, so the least there is
            leaves it to what touches the body.
    """

    name: str
    geoms: Sequence[Any] = field(default_factory=tuple)
    friction: float = mujoco.mjMINMU
    pos: Sequence[float] | None = None
    quat: Sequence[float] = _IDENTITY
    rgba: Sequence[float] = (0.55, 0.58, 0.62, 1.0)


_WORLD_KWARGS = {"contype": WORLD_BIT, "conaffinity": ROBOT_BIT | WORLD_BIT}
_SHAPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
}

_NUM_SIZES = {"box": 3, "sphere": 1, "capsule": 2, "cylinder": 2}


def load_mesh(path: str, scale: Any = 1.0) -> trimesh.Trimesh:
    """Reads one mesh and scales it.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it holds no faces or encloses no volume.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"object mesh: no file {path}")
    mesh = trimesh.load(path, force="mesh")
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise ValueError(f"object mesh: {path} holds no faces")
    mesh.apply_scale(scale)
    if mesh.convex_hull.volume <= 0:
        raise ValueError(f"object mesh: {path} encloses no volume")
    return mesh


def _rotate(quat: Sequence[float], vec: Sequence[float]) -> np.ndarray:
    out = np.zeros(3)
    mujoco.mju_rotVecQuat(out, np.asarray(vec, float), np.asarray(quat, float))
    return out


def _multiply(a: Sequence[float], b: Sequence[float]) -> np.ndarray:
    out = np.zeros(4)
    mujoco.mju_mulQuat(out, np.asarray(a, float), np.asarray(b, float))
    return out


def add_geoms(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    geoms: Sequence[Any],
    *,
    mass: float,
    friction: float,
    rgba: Sequence[float],
    torsional_friction: float = 0.0,
    priority: int = 0,
) -> None:
    """Adds collision geoms that are also the visuals to `body`; `mass` is spread over them by volume.

    Raises:
        ValueError: for a geom that names no shape or several.
    """
    added = []
    for i, geom in enumerate(geoms):
        config = geom if isinstance(geom, GeomConfig) else GeomConfig(**geom)
        where = f"{body.name} geom {i}"
        shapes = [shape for shape in (*_SHAPES, "mesh") if getattr(config, shape) is not None]
        if len(shapes) != 1:
            raise ValueError(f"{where}: give exactly one of {(*_SHAPES, 'mesh')}, got {shapes or 'none'}")
        kwargs: dict[str, Any] = {
            **_WORLD_KWARGS,
            "name": f"{body.name}_geom{i}",
            "pos": _rotate(config.body_quat, config.pos),
            "quat": _multiply(config.body_quat, config.quat),
            "friction": [friction, torsional_friction or 0.005, 0.0001],
            "condim": 4 if torsional_friction else 3,
            "priority": priority,
            "rgba": config.rgba or rgba,
        }
        if config.mesh is not None:
            mesh = load_mesh(config.mesh, config.scale)
            name = f"{body.name}_mesh{i}"
            spec.add_mesh(name=name, uservert=mesh.vertices.ravel().tolist(), userface=mesh.faces.ravel().tolist())
            # MuJoCo re-centres a mesh at its centre of mass and undoes that in the geom's pose
            added.append(
                (body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, **kwargs), mesh.convex_hull.volume)
            )
            continue
        values = np.atleast_1d(np.asarray(getattr(config, shapes[0]), float))
        if values.shape != (_NUM_SIZES[shapes[0]],) or not (np.isfinite(values) & (values > 0)).all():
            expected = f"{_NUM_SIZES[shapes[0]]} positive sizes"
            raise ValueError(f"{where}: {shapes[0]}: {expected} expected, got {values.tolist()}")
        size = np.zeros(3)
        size[: len(values)] = values
        added.append((body.add_geom(type=_SHAPES[shapes[0]], size=size, **kwargs), _volume(shapes[0], values)))
    total = sum(volume for _, volume in added)
    for geom, volume in added:
        geom.mass = mass * volume / total


def _volume(shape: str, size: np.ndarray) -> float:
    if shape == "box":
        return float(8 * size.prod())
    ball = 4 / 3 * np.pi * size[0] ** 3
    if shape == "sphere":
        return float(ball)
    tube = 2 * np.pi * size[0] ** 2 * size[1]
    return float(tube + (ball if shape == "capsule" else 0.0))


def add_object(spec: mujoco.MjSpec, config: ObjectConfig, pos: Sequence[float], quat: Sequence[float]) -> None:
    """Adds an object at a pose: free-floating with joint `object_root`, or fixed in the world."""
    body = spec.worldbody.add_body(name=config.name, pos=pos, quat=quat)
    if not config.fixed_base:
        body.add_freejoint(name="object_root")
    hinge = config.hinge
    # what is fixed in the world needs no mass, and the object's is then that of its link
    base_mass = 0.0 if config.fixed_base else config.mass * (1.0 if hinge is None else 0.5)
    surface: dict[str, Any] = {
        "friction": config.friction,
        "torsional_friction": config.torsional_friction,
        "priority": int(config.friction_combine == "object"),
        "rgba": config.rgba,
    }
    add_geoms(spec, body, config.geoms, mass=base_mass, **surface)
    if hinge is None:
        return
    link = body.add_body(name=hinge.body, pos=hinge.pos, quat=hinge.quat)
    link.add_joint(
        name=hinge.name,
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=hinge.axis,
        range=hinge.range,
        limited=True,
        frictionloss=hinge.friction,
        damping=[hinge.damping, 0, 0],
    )
    link_mass = config.mass if config.fixed_base else config.mass * 0.5
    add_geoms(spec, link, hinge.geoms, mass=link_mass, **surface)
    spec.add_exclude(bodyname1=config.name, bodyname2=hinge.body)


def add_scenery(spec: mujoco.MjSpec, config: SceneryConfig, pos: Sequence[float], quat: Sequence[float]) -> None:
    """Adds a static body at a pose."""
    body = spec.worldbody.add_body(name=config.name, pos=pos, quat=quat)
    add_geoms(spec, body, config.geoms, mass=0.0, friction=config.friction, rgba=config.rgba)
