"""Objects to interact with and static scenery, described by a few figures and composed with MjSpec."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, Literal

import mujoco
import numpy as np

from hdmi.assets.mesh import load_mesh
from hdmi.assets.robot import ROBOT_BIT, WORLD_BIT

_IDENTITY = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class GeomConfig:
    """One geom of an object, in its body's frame: exactly one of box, sphere, capsule, cylinder, mesh.

    Args:
        box: half extents, m. [3]
        sphere: radius, m.
        capsule, cylinder: radius and half length along z, m. [2]
        mesh: path of an OBJ, STL, PLY, OFF, GLB or glTF file; collides as its convex hull.
        scale: of the mesh, one figure or three.
        pos, quat: of the geom in the body frame, m and wxyz.
        body_quat: rotates pos and quat about the body's origin (for a body frame that is tilted in the source).
        rgba: colour; the object's if absent.

    Examples:
        >>> lid = GeomConfig(box=(0.2, 0.3, 0.01), pos=(0.0, 0.0, 0.2))
        >>> parse_geom({"box": (0.2, 0.3, 0.01), "pos": (0.0, 0.0, 0.2)}, "geoms[0]") == lid
        True
        >>> parse_geom(GeomConfig(sphere=-0.1), "geoms[1]")
        Traceback (most recent call last):
        ValueError: geoms[1].sphere: 1 positive number expected, got -0.1
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
        friction: dry friction, N m.
        damping: N m s/rad.

    Examples:
        >>> panel = HingeConfig(name="door_joint", body="panel", geoms=[{"box": (0.02, 0.45, 1.0)}], range=(0.0, 1.5))
        >>> door = ObjectConfig("door", geoms=[{"box": (0.05, 0.05, 1.0)}], hinge=panel, fixed_base=True)
        >>> build_scene(RobotConfig(), SimConfig(), door).num_object_joints
        1
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

    def check(self, where: str) -> None:
        """Raises a ValueError that names the field for what cannot be used."""
        _check_geoms(self.geoms, where)
        for key, count in {"pos": 3, "quat": 4, "axis": 3, "range": 2, "friction": 1, "damping": 1}.items():
            check_numbers(getattr(self, key), count, f"{where}.{key}")
        low, high = np.asarray(self.range, float)
        if not low < high:
            raise ValueError(f"{where}.range: the lower angle first, got {self.range!r}")
        if not np.any(np.asarray(self.axis, float)):
            raise ValueError(f"{where}.axis: a direction expected, got {self.axis!r}")


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

    Examples:
        >>> box = ObjectConfig("box", geoms=[{"box": (0.1, 0.1, 0.1)}, {"box": (0.1, 0.1, 0.2)}], mass=3.0)
        >>> scene = build_scene(RobotConfig(), SimConfig(), box)
        >>> float(scene.model.body("box").mass[0])
        3.0
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
        check_numbers(self.mass, 1, f"object {self.name!r}: mass", positive=True)
        if self.friction_combine not in ("max", "object"):
            raise ValueError(
                f"object {self.name!r}: friction_combine is 'max' or 'object', got {self.friction_combine!r}"
            )
        if self.hinge is not None and not isinstance(self.hinge, HingeConfig):
            object.__setattr__(self, "hinge", _from_mapping(HingeConfig, self.hinge, "hinge"))

    def check(self, where: str) -> None:
        """Reads meshes; raises a ValueError that names the field for what cannot be used."""
        _check_geoms(self.geoms, where, needed=self.hinge is None)
        for key, count in {"mass": 1, "friction": 1, "torsional_friction": 1, "rgba": 4}.items():
            check_numbers(getattr(self, key), count, f"{where}.{key}")
        if self.hinge is not None:
            self.hinge.check(f"{where}.hinge")

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

    Examples:
        >>> stand = SceneryConfig("stand", geoms=[{"cylinder": (0.2, 0.3)}], pos=(0.5, 0.0, 0.3))
        >>> scene = build_scene(RobotConfig(), SimConfig(), scenery=[stand])
        >>> scene.model.body("stand").pos.tolist()
        [0.5, 0.0, 0.3]
    """

    name: str
    geoms: Sequence[Any] = field(default_factory=tuple)
    friction: float = mujoco.mjMINMU
    pos: Sequence[float] | None = None
    quat: Sequence[float] = _IDENTITY
    rgba: Sequence[float] = (0.55, 0.58, 0.62, 1.0)

    def check(self, where: str) -> None:
        """Reads meshes; raises a ValueError that names the field for what cannot be used."""
        _check_geoms(self.geoms, where)
        for key, count in {"friction": 1, "pos": 3, "quat": 4, "rgba": 4}.items():
            check_numbers(getattr(self, key), count, f"{where}.{key}")


_WORLD_KWARGS = {"contype": WORLD_BIT, "conaffinity": ROBOT_BIT | WORLD_BIT}
_SHAPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
}

_NUM_SIZES = {"box": 3, "sphere": 1, "capsule": 2, "cylinder": 2}


def parse_geom(geom: Any, where: str) -> GeomConfig:
    """A geom, checked; its mesh is read.

    Args:
        geom: a `GeomConfig` or the same as a mapping.
        where: what to call it in messages.

    Raises:
        ValueError: for an unknown key, no shape or several, or a value that cannot be used.
        FileNotFoundError: if there is no such mesh.
    """
    config = geom if isinstance(geom, GeomConfig) else _from_mapping(GeomConfig, geom, where)
    shapes = [shape for shape in (*_SHAPES, "mesh") if getattr(config, shape) is not None]
    if len(shapes) != 1:
        raise ValueError(f"{where}: give exactly one of {(*_SHAPES, 'mesh')}, got {shapes or 'none'}")
    for key, count in {"pos": 3, "quat": 4, "body_quat": 4, "rgba": 4}.items():
        check_numbers(getattr(config, key), count, f"{where}.{key}")
    if config.mesh is None:
        check_numbers(getattr(config, shapes[0]), _NUM_SIZES[shapes[0]], f"{where}.{shapes[0]}", positive=True)
        return config
    try:
        load_mesh(config.mesh, config.scale)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{where}.mesh: {error}") from error
    except (OSError, ValueError) as error:
        raise ValueError(f"{where}.mesh: {error}") from error
    return config


def _check_geoms(geoms: Any, where: str, needed: bool = True) -> None:
    if isinstance(geoms, str | Mapping) or not isinstance(geoms, Sequence):
        raise ValueError(f"{where}.geoms: a list expected, got {geoms!r}")
    if needed and not geoms:
        raise ValueError(f"{where}.geoms: at least one expected")
    for i, geom in enumerate(geoms):
        parse_geom(geom, f"{where}.geoms[{i}]")


def check_numbers(value: Any, count: int, where: str, *, positive: bool = False) -> None:
    """Raises a ValueError unless `value` is None or so many finite numbers; four are a quaternion, or a colour."""
    if value is None:
        return
    try:
        numbers = np.atleast_1d(np.asarray(value, float))
    except (TypeError, ValueError):
        numbers = np.array([np.nan])
    if numbers.shape != (count,) or not np.isfinite(numbers).all() or (positive and not (numbers > 0).all()):
        expected = f"{count} {'positive ' * positive}number{'s' if count > 1 else ''}"
        raise ValueError(f"{where}: {expected} expected, got {value!r}")
    if where.endswith("quat") and not numbers.any():
        raise ValueError(f"{where}: a quaternion of length 1 expected, got {value!r}")


def _from_mapping(cls: type, values: Any, where: str) -> Any:
    names = [f.name for f in fields(cls)]
    if not isinstance(values, Mapping):
        raise ValueError(f"{where}: a mapping with {', '.join(names)} expected, got {values!r}")
    if unknown := sorted(map(str, set(values) - set(names))):
        raise ValueError(f"{where}: unknown {', '.join(unknown)}; there is {', '.join(names)}")
    needed = [f.name for f in fields(cls) if f.default is MISSING and f.default_factory is MISSING]
    if missing := [name for name in needed if name not in values]:
        raise ValueError(f"{where}: lacks {', '.join(missing)}")
    return cls(**values)


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
        ValueError, FileNotFoundError: for a geom that cannot be used, see `parse_geom`.
    """
    added = []
    for i, geom in enumerate(geoms):
        config = parse_geom(geom, f"{body.name}: geoms[{i}]")
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
        shape = next(shape for shape in _SHAPES if getattr(config, shape) is not None)
        values = np.atleast_1d(np.asarray(getattr(config, shape), float))
        size = np.zeros(3)
        size[: len(values)] = values
        added.append((body.add_geom(type=_SHAPES[shape], size=size, **kwargs), _volume(shape, values)))
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
