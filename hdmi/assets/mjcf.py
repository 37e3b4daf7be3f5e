"""Any humanoid whose body tree an MJCF file describes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from hdmi.assets.robot import ROBOT_BIT, Foot, Robot, servo_gains
from hdmi.assets.robot_parts import add_box_foot, add_servo

if TYPE_CHECKING:
    from hdmi.assets.robot_config import RobotConfig


def mjcf_robot(path: str, feet: Sequence[str], keyframe: str | None = None, name: str | None = None) -> Robot:
    """A humanoid from an MJCF file: the body with a free joint and what hangs from it, nothing else of the file.

    Joints, masses, shapes, contact exclusions, tendons and equality constraints are the file's. Every joint gets a
    position servo: with the gains of the file's, or, where that has a motor, of 10 Hz with damping ratio 2 from the
    joint's armature. Effort limits are the least of the actuator's and the joint's. All shapes that collide meet
    floor, scenery and object. Velocities have no limit.

    Args:
        path: of the file.
        feet: names of the bodies that stand on the floor. The spheres with which such a body collides are its sole, if
            it has any.
        keyframe: of the file that is the standing pose; the first if not given, and the pose of the file if it has
            none.
        name: for messages; the file's if not given.

    Raises:
        ValueError: for a file that cannot be read or compiled, that has not one body with a free joint, a body or joint
            without name, a joint that is no hinge or has no range or effort limit; a motor at a joint without armature;
            an unknown foot or keyframe.
    """
    file = Path(path).expanduser().resolve()
    spec = _read(file)
    root_name = _root(spec, file).name
    with _naming(file):
        model = spec.compile()
    root = model.body(root_name).id
    bodies = np.flatnonzero(model.body_rootid == root)
    joints = np.flatnonzero(np.isin(model.jnt_bodyid, bodies) & (model.jnt_type != mujoco.mjtJoint.mjJNT_FREE))
    body_names = tuple(_named(file, model.body(b).name, f"a body of {root_name!r}") for b in bodies)
    joint_names = tuple(_named(file, model.joint(j).name, f"a joint of {body_names}") for j in joints)
    for j, joint in zip(joints, joint_names, strict=True):
        if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_HINGE:
            raise ValueError(f"{file}: joint {joint!r}: only hinges can be driven")
        if not model.jnt_limited[j]:
            raise ValueError(f"{file}: joint {joint!r} has no range")
    if not joint_names:
        raise ValueError(f"{file}: {body_names[0]!r} has no joints but the free one")
    if unknown := [foot for foot in feet if foot not in body_names]:
        raise ValueError(f"{file}: feet: there is no body {unknown[0]!r}; there is {', '.join(body_names)}")
    qpos = _standing(model, file, keyframe)
    servos = [_servo(model, int(j), f"{file}: joint {joint!r}") for j, joint in zip(joints, joint_names, strict=True)]
    stiffness, damping, effort = zip(*servos, strict=True)
    return Robot(
        name=name or file.name,
        body_names=body_names,
        body_parents=tuple(model.body(model.body_parentid[b]).name for b in bodies),
        joint_names=joint_names,
        joint_bodies=tuple(model.body(model.jnt_bodyid[j]).name for j in joints),
        joint_ranges=tuple((float(low), float(high)) for low, high in model.jnt_range[joints]),
        effort_limits=effort,
        velocity_limits=(math.inf,) * len(joints),
        stiffness=stiffness,
        damping=damping,
        armature=tuple(model.dof_armature[model.jnt_dofadr[joints]].tolist()),
        default_joint_pos=tuple(qpos[model.jnt_qposadr[joints]].tolist()),
        root_height=float(qpos[model.jnt_qposadr[model.body_jntadr[root]] + 2]),
        total_mass=float(model.body_mass[bodies].sum()),
        feet=tuple(_foot(model, foot, file) for foot in feet),
        add=_AddMjcf(str(file)),
    )


def _named(file: Path, name: str, what: str) -> str:
    if not name:
        raise ValueError(f"{file}: {what} has no name")
    return name


def _read(file: Path) -> mujoco.MjSpec:
    if not file.is_file():
        raise ValueError(f"{file}: no such file")
    with _naming(file):
        return mujoco.MjSpec.from_file(str(file))


@contextmanager
def _naming(file: Path) -> Iterator[None]:
    """Makes MuJoCo's complaints one line that names the file."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{file}: {' '.join(str(error).split())}") from error


def _root(spec: mujoco.MjSpec, file: Path) -> mujoco.MjsBody:
    free = mujoco.mjtJoint.mjJNT_FREE
    roots = [body for body in spec.worldbody.bodies if any(joint.type == free for joint in body.joints)]
    if len(roots) != 1:
        raise ValueError(f"{file}: one body with a free joint expected, got {[body.name for body in roots]}")
    _named(file, roots[0].name, "the body with the free joint")
    return roots[0]


def _standing(model: mujoco.MjModel, file: Path, keyframe: str | None) -> np.ndarray:
    """Generalised positions of the standing pose. [nq]"""
    names = [model.key(i).name for i in range(model.nkey)]
    if keyframe is None:
        return model.key_qpos[0] if names else model.qpos0
    if keyframe not in names:
        raise ValueError(f"{file}: there is no keyframe {keyframe!r}; there is {names}")
    return model.key_qpos[names.index(keyframe)]


def _servo(model: mujoco.MjModel, joint: int, where: str) -> tuple[float, float, float]:
    """Stiffness, damping and effort limit of a joint's servo, N m/rad, N m s/rad and N m."""
    dof = model.jnt_dofadr[joint]
    at_joint = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_trnid[:, 0] == joint)
    actuators = np.flatnonzero(at_joint)
    if len(actuators) > 1:
        raise ValueError(f"{where} has {len(actuators)} actuators, at most one expected")
    efforts: list[float] = []
    if model.jnt_actfrclimited[joint]:
        efforts.append(_least(model.jnt_actfrcrange[joint]))
    gains = None
    for a in actuators:
        gear, bias = abs(model.actuator_gear[a, 0]), model.actuator_biasprm[a]
        if model.actuator_forcelimited[a]:
            efforts.append(gear * _least(model.actuator_forcerange[a]))
        if bias[1] < 0:  # a position servo
            gains = -(gear**2) * bias[1], -(gear**2) * bias[2] + model.dof_damping[dof]
        elif model.actuator_ctrllimited[a]:
            efforts.append(gear * abs(model.actuator_gainprm[a, 0]) * _least(model.actuator_ctrlrange[a]))
    if gains is None:
        if model.dof_armature[dof] <= 0:
            raise ValueError(f"{where}: a position servo or an armature expected, from which its gains would follow")
        gains = servo_gains(model.dof_armature[dof])
    if not efforts:
        raise ValueError(f"{where} has no effort limit: a forcerange of its actuator or an actuatorfrcrange expected")
    return float(gains[0]), float(gains[1]), float(min(efforts))


def _least(span: Sequence[float]) -> float:
    """How far a range goes either way."""
    return min(-span[0], span[1])


def _foot(model: mujoco.MjModel, body: str, file: Path) -> Foot:
    """A body with the spheres with which it collides."""
    geoms = np.flatnonzero((model.geom_bodyid == model.body(body).id) & _collides(model))
    spheres = geoms[model.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_SPHERE]
    if not len(geoms):
        raise ValueError(f"{file}: feet: body {body!r} has no shape that collides")
    if not len(spheres):
        return Foot(body)
    points = tuple(tuple(pos) for pos in model.geom_pos[spheres].tolist())
    return Foot(body, points, float(model.geom_size[spheres, 0].max()))


def _collides(model: mujoco.MjModel) -> np.ndarray:
    return (model.geom_contype != 0) | (model.geom_conaffinity != 0)


@dataclass(frozen=True)
class _AddMjcf:
    """Adds the robot of a file to a spec; see `Robot.add`."""

    file: str

    def __call__(self, spec: mujoco.MjSpec, config: RobotConfig) -> mujoco.MjSpec:
        if config.mesh_dir is not None:
            raise ValueError(f"robot.mesh_dir: {self.file} says what the robot looks like; null expected")
        own = _read(Path(self.file))
        root = _root(own, Path(self.file))
        for element in [*own.actuators, *own.sensors, *own.keys]:
            own.delete(element)
        _find_files(own, Path(self.file).parent)
        boxes = {foot.body: foot for foot in config.model.feet if config.feet == "box"}
        for body in [root, *root.find_all("body")]:
            for geom in body.geoms:
                if not (geom.contype or geom.conaffinity):
                    continue
                geom.contype, geom.conaffinity = ROBOT_BIT, ROBOT_BIT if config.self_collisions else 0
                geom.friction[0] = config.friction
                if body.name in boxes and geom.type == mujoco.mjtGeom.mjGEOM_SPHERE:
                    geom.contype = geom.conaffinity = 0  # it still has its mass
            if body.name in boxes:
                add_box_foot(body, boxes[body.name], f"{body.name}_box_collision", config)
        with _unprefixed():
            spec.worldbody.add_frame().attach_body(root, "", "")
            spec = spec.copy()
        robot = config.robot
        for name, stiffness, damping, effort in zip(
            robot.joint_names, robot.stiffness, robot.damping, robot.effort_limits, strict=True
        ):
            spec.joint(name).damping = [damping, 0, 0]
            add_servo(spec, name, stiffness, effort)
        return spec


def _find_files(spec: mujoco.MjSpec, folder: Path) -> None:
    """Makes the paths of a spec's files absolute."""
    for elements, place in (
        (spec.meshes, spec.meshdir),
        (spec.hfields, spec.meshdir),
        (spec.textures, spec.texturedir),
    ):
        for element in elements:
            if element.file:
                element.file = str((folder / place / element.file).resolve())
    spec.meshdir = spec.texturedir = ""


@contextmanager
def _unprefixed() -> Iterator[None]:
    """Keeps MuJoCo from printing, and from logging to a file, that names may clash that have no prefix.

    They are to be the file's: motions and configs name bodies and joints. MuJoCo also marks the spec, for every
    compilation to warn; a copy has no such mark.
    """
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
