"""The Unitree G1: figures from `hdmi.assets.g1` as a record, and as a MuJoCo body tree composed with MjSpec."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from hdmi.assets import g1
from hdmi.assets.robot import VISUAL_GROUP, Foot, Robot, per_joint, servo_gains
from hdmi.assets.robot_parts import add_box_foot, add_servo, collision_kwargs

if TYPE_CHECKING:
    from hdmi.assets.robot_config import RobotConfig

_DARK, _LIGHT, _ACCENT = (0.16, 0.17, 0.20, 1.0), (0.82, 0.83, 0.86, 1.0), (0.24, 0.42, 0.70, 1.0)

# Primitive shells for pictures: (body, start, end, radius, colour); massless and without collision.
_SHELLS: tuple[tuple[str, g1.Vec, g1.Vec, float, g1.Vec], ...] = (
    ("pelvis", (0, -0.06, -0.07), (0, 0.06, -0.07), 0.065, _DARK),
    ("torso_link", (0, -0.045, 0.23), (0, 0.045, 0.23), 0.085, _LIGHT),
    ("torso_link", (0, 0, 0.06), (0.005, 0, 0.2), 0.08, _LIGHT),
    ("torso_link", (0.0, 0, 0.39), (0.01, 0, 0.44), 0.062, _DARK),
    *(
        shell
        for side, y in (("left", 1.0), ("right", -1.0))
        for shell in (
            (f"{side}_hip_pitch_link", (0, 0, 0), (0, 0.05 * y, -0.03), 0.05, _DARK),
            (f"{side}_hip_roll_link", (0.02, 0, 0), (0.025, 0, -0.12), 0.055, _LIGHT),
            (f"{side}_hip_yaw_link", (0, 0, 0), (-0.078, 0.002 * y, -0.177), 0.052, _LIGHT),
            (f"{side}_knee_link", (0.005, 0, 0), (0.012, 0, -0.16), 0.045, _DARK),
            (f"{side}_knee_link", (0.012, 0, -0.16), (0, 0, -0.29), 0.034, _LIGHT),
            (f"{side}_shoulder_pitch_link", (0, 0, 0), (0, 0.038 * y, -0.014), 0.042, _DARK),
            (f"{side}_shoulder_roll_link", (0, 0, 0), (0, 0.006 * y, -0.10), 0.037, _LIGHT),
            (f"{side}_shoulder_yaw_link", (0, 0, 0), (0.015, 0, -0.08), 0.036, _LIGHT),
            (f"{side}_elbow_link", (0, 0, 0), (0.1, 0.002 * y, -0.01), 0.035, _DARK),
            (f"{side}_wrist_roll_link", (0, 0, 0), (0.038, 0, 0), 0.032, _LIGHT),
            (f"{side}_wrist_pitch_link", (0, 0, 0), (0.046, 0, 0), 0.031, _LIGHT),
            (f"{side}_wrist_yaw_link", (0.03, 0, 0), (0.13, -0.01 * y, 0), 0.03, _ACCENT),
        )
    ),
)

# Bodies whose collision shapes overlap at every joint angle without being parent and child.
_ALWAYS_TOUCHING: tuple[tuple[str, str], ...] = tuple(
    pair
    for side in ("left", "right")
    for pair in (("pelvis", f"{side}_hip_roll_link"), (f"{side}_elbow_link", f"{side}_wrist_pitch_link"))
)


@lru_cache(maxsize=1)
def g1_robot() -> Robot:
    """The Unitree G1 with 29 joints and rubber hands; servos of 10 Hz with damping ratio 2."""
    stiffness, damping = zip(*(servo_gains(joint.armature) for joint in g1.JOINTS), strict=True)
    return Robot(
        name="the G1",
        body_names=g1.BODY_NAMES,
        body_parents=tuple(body.parent for body in g1.BODIES),
        joint_names=g1.JOINT_NAMES,
        joint_bodies=tuple(joint.body for joint in g1.JOINTS),
        joint_ranges=g1.JOINT_RANGES,
        effort_limits=g1.EFFORT_LIMITS,
        velocity_limits=tuple(joint.velocity_limit for joint in g1.JOINTS),
        stiffness=stiffness,
        damping=damping,
        armature=tuple(joint.armature for joint in g1.JOINTS),
        default_joint_pos=tuple(default_joint_pos().tolist()),
        root_height=g1.ROOT_HEIGHT,
        total_mass=g1.TOTAL_MASS,
        feet=tuple(Foot(body, g1.FOOT_POINTS, g1.FOOT_POINT_RADIUS) for body in g1.FEET),
        hands=g1.HANDS,
        add=_add_g1,
    )


def default_joint_pos() -> np.ndarray:
    """Joint angles of the G1's default standing pose, rad. [29]"""
    return per_joint(g1.DEFAULT_POSE, g1.JOINT_NAMES)


def _add_g1(spec: mujoco.MjSpec, config: RobotConfig) -> mujoco.MjSpec:
    bodies: dict[str, mujoco.MjsBody] = {"world": spec.worldbody}
    joints = {joint.body: joint for joint in g1.JOINTS}
    robot = config.robot
    gains = dict(zip(robot.joint_names, zip(robot.stiffness, robot.damping, strict=True), strict=True))

    for row in g1.BODIES:
        body = bodies[row.parent].add_body(
            name=row.name,
            pos=row.pos,
            quat=row.quat,
            mass=row.mass,
            ipos=row.com_pos,
            iquat=row.com_quat,
            inertia=row.principal_inertia,
            explicitinertial=True,
        )
        bodies[row.name] = body
        if row.parent == "world":
            body.add_freejoint(name="root")
        if row.name in joints:
            joint = joints[row.name]
            kp, kd = gains[joint.name]
            body.add_joint(
                name=joint.name,
                type=mujoco.mjtJoint.mjJNT_HINGE,
                axis=joint.axis,
                range=joint.range,
                limited=True,
                armature=joint.armature,
                damping=[kd, 0, 0],
            )
            add_servo(spec, joint.name, kp, joint.effort_limit)
    for site in g1.SITES:
        bodies[site.body].add_site(name=site.name, pos=site.pos, size=[0.01, 0.01, 0.01], group=5)
    _add_collision(bodies, config)
    for first, second in _ALWAYS_TOUCHING:
        spec.add_exclude(bodyname1=first, bodyname2=second)
    if config.mesh_dir is None:
        _add_shells(bodies, config)
    else:
        _add_meshes(spec, bodies, Path(config.mesh_dir))
    return spec


def _add_capsule(body: mujoco.MjsBody, start: g1.Vec, end: g1.Vec, radius: float, **kwargs) -> None:
    if np.allclose(start, end):
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=start, size=[radius, 0, 0], **kwargs)
    else:
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[*start, *end], size=[radius, 0, 0], **kwargs)


def _add_collision(bodies: dict[str, mujoco.MjsBody], config: RobotConfig) -> None:
    kwargs = collision_kwargs(config)
    for capsule in g1.COLLISION:
        if config.effector == "hand" and capsule.name.endswith("hand_collision"):
            continue
        _add_capsule(bodies[capsule.body], capsule.start, capsule.end, capsule.radius, name=capsule.name, **kwargs)
    for foot in config.model.feet:
        side = foot.body.split("_")[0]
        if config.feet == "sphere":
            for i, point in enumerate(foot.points):
                _add_capsule(bodies[foot.body], point, point, foot.radius, name=f"{side}_foot{i}_collision", **kwargs)
        else:
            add_box_foot(bodies[foot.body], foot, f"{side}_foot_collision", config)
    box = mujoco.mjtGeom.mjGEOM_BOX
    for name in config.model.hands:
        side, hand = name.split("_")[0], bodies[name]
        if config.effector == "hand":
            hand.add_geom(
                name=f"{side}_hand_collision", type=box, pos=[0.09, 0, 0], size=[0.05, 0.015, 0.035], **kwargs
            )
        elif config.effector == "L":
            hand.add_geom(name=f"{side}_L0_collision", type=box, pos=[0.13, 0, 0], size=[0.03, 0.04, 0.002], **kwargs)
            hand.add_geom(
                name=f"{side}_L1_collision", type=box, pos=[0.10, 0, -0.03], size=[0.002, 0.04, 0.03], **kwargs
            )


def _add_shells(bodies: dict[str, mujoco.MjsBody], config: RobotConfig) -> None:
    kwargs = {"group": VISUAL_GROUP, "contype": 0, "conaffinity": 0, "mass": 0.0}
    for name, start, end, radius, rgba in _SHELLS:
        _add_capsule(bodies[name], start, end, radius, rgba=rgba, **kwargs)
    box = mujoco.mjtGeom.mjGEOM_BOX
    for foot in config.model.foot_bodies:
        bodies[foot].add_geom(type=box, pos=[0.035, 0, -0.022], size=[0.088, 0.032, 0.012], rgba=_DARK, **kwargs)
    for hand in config.model.hands if config.effector == "L" else ():
        bodies[hand].add_geom(type=box, pos=[0.13, 0, 0], size=[0.03, 0.04, 0.003], rgba=_ACCENT, **kwargs)
        bodies[hand].add_geom(type=box, pos=[0.10, 0, -0.03], size=[0.003, 0.04, 0.03], rgba=_ACCENT, **kwargs)


def _add_meshes(spec: mujoco.MjSpec, bodies: dict[str, mujoco.MjsBody], folder: Path) -> None:
    for name, body in bodies.items():
        if name == "world":
            continue
        path = next((p for p in (folder / f"{name}.STL", folder / f"{name}.stl") if p.is_file()), None)
        if path is None:
            raise FileNotFoundError(f"robot.mesh_dir: {folder} has no {name}.STL")
        spec.add_mesh(name=name, file=str(path.resolve()))
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, group=VISUAL_GROUP, contype=0, conaffinity=0, mass=0.0,
            rgba=_LIGHT,
        )  # fmt: skip
