"""The G1 as a MuJoCo body tree: figures from `hdmi.assets.g1`, composed with MjSpec."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np

from hdmi.assets import g1
from hdmi.names import match_names

# Bit masks: robot geoms meet floor, scenery and object; each other only with self-collisions.
ROBOT_BIT, WORLD_BIT = 1, 2
VISUAL_GROUP, COLLISION_GROUP = 1, 3

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


@dataclass(frozen=True)
class RobotConfig:
    """Which G1 to build.

    Args:
        feet: four spheres per foot, or one box spanning the same points (climbing, kicking).
        effector: `capsule` keeps the hand capsule of the table; `hand` replaces it by a box around the palm,
            `L` adds two thin boxes that hook over an edge.
        self_collisions: let robot geoms collide with each other (parent and child excepted).
        stiffness, damping: joint name pattern -> N m/rad and N m s/rad, instead of the servo table's values.
        default_pose: joint name pattern -> rad, over the standing pose: where joints are that a motion lacks, what
            observations and the action space without residual are relative to.
        held: joint name patterns: these hold the default pose, whatever a motion says; see
            `hdmi.motion.make_reference`.
        friction: sliding friction of all robot geoms.
        mesh_dir: folder with Unitree's `<body>.STL` files; used as visuals instead of primitives.

    Examples:
        >>> crouched = RobotConfig(feet="box", default_pose={".*_knee_joint": 1.0})
        >>> float(crouched.default_joint_pos[g1.JOINT_NAMES.index("left_knee_joint")])
        1.0
        >>> build_scene(crouched, SimConfig()).model.nu
        29
    """

    feet: Literal["sphere", "box"] = "sphere"
    effector: Literal["capsule", "hand", "L"] = "capsule"
    self_collisions: bool = False
    stiffness: Mapping[str, float] = field(default_factory=dict)
    damping: Mapping[str, float] = field(default_factory=dict)
    default_pose: Mapping[str, float] = field(default_factory=dict)
    held: Sequence[str] = ()
    friction: float = 1.0
    mesh_dir: str | None = None

    def __post_init__(self) -> None:
        pose = self.default_joint_pos
        for name, angle, (low, high) in zip(g1.JOINT_NAMES, pose, g1.JOINT_RANGES, strict=True):
            if not low <= angle <= high:
                raise ValueError(f"robot.default_pose: {name} at {angle:g} rad is outside of its range {low}..{high}")

    @property
    def default_joint_pos(self) -> np.ndarray:
        """Joint angles of the default pose, rad. [29]"""
        return per_joint(self.default_pose, default=default_joint_pos(), where="robot.default_pose")

    @property
    def held_joints(self) -> list[str]:
        """Names of the joints that hold the default pose, in table order."""
        return [g1.JOINT_NAMES[i] for i in match_names(self.held, g1.JOINT_NAMES, "robot.held")]


def per_joint(values: Mapping[str, float], default: float | np.ndarray = 0.0, where: str = "joints") -> np.ndarray:
    """Expands `{pattern: value}` to the robot's joint order; the last matching pattern wins. [J]"""
    out = np.full(len(g1.JOINT_NAMES), default, dtype=float)
    for pattern, value in values.items():
        out[match_names([pattern], g1.JOINT_NAMES, where)] = value
    return out


def default_joint_pos() -> np.ndarray:
    """Joint angles of the default standing pose, rad. [29]"""
    return per_joint(g1.DEFAULT_POSE)


def add_robot(spec: mujoco.MjSpec, config: RobotConfig) -> None:
    """Adds the robot's bodies, joints, servos, sites and geoms to `spec`, with a free root joint `root`.

    Raises:
        ValueError: for an unknown foot or effector kind, or a gain pattern that matches no joint.
        FileNotFoundError: if `mesh_dir` lacks a body's mesh.
    """
    if config.feet not in ("sphere", "box"):
        raise ValueError(f"robot.feet: expected 'sphere' or 'box', got {config.feet!r}")
    if config.effector not in ("capsule", "hand", "L"):
        raise ValueError(f"robot.effector: expected 'capsule', 'hand' or 'L', got {config.effector!r}")
    bodies: dict[str, mujoco.MjsBody] = {"world": spec.worldbody}
    joints = {joint.body: joint for joint in g1.JOINTS}
    table = np.array([g1.servo_gains(joint.armature) for joint in g1.JOINTS])  # [29, 2]
    stiffness = per_joint(config.stiffness, default=table[:, 0], where="robot.stiffness")
    damping = per_joint(config.damping, default=table[:, 1], where="robot.damping")
    gains = dict(zip(g1.JOINT_NAMES, zip(stiffness, damping, strict=True), strict=True))

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
            # The derivative gain is joint damping: Euler integrates it implicitly, and torque limits then
            # bound the proportional part.
            body.add_joint(
                name=joint.name,
                type=mujoco.mjtJoint.mjJNT_HINGE,
                axis=joint.axis,
                range=joint.range,
                limited=True,
                armature=joint.armature,
                damping=[kd, 0, 0],
            )
            spec.add_actuator(
                name=joint.name,
                target=joint.name,
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                gaintype=mujoco.mjtGain.mjGAIN_FIXED,
                biastype=mujoco.mjtBias.mjBIAS_AFFINE,
                gainprm=[kp] + [0.0] * 9,
                biasprm=[0.0, -kp] + [0.0] * 8,
                forcerange=[-joint.effort_limit, joint.effort_limit],
                forcelimited=True,
            )
    for site in g1.SITES:
        bodies[site.body].add_site(name=site.name, pos=site.pos, size=[0.01, 0.01, 0.01], group=5)
    _add_collision(bodies, config)
    for first, second in _ALWAYS_TOUCHING:
        spec.add_exclude(bodyname1=first, bodyname2=second)
    if config.mesh_dir is None:
        _add_shells(bodies, config)
    else:
        _add_meshes(spec, bodies, Path(config.mesh_dir))


def _collision_kwargs(config: RobotConfig) -> dict:
    return {
        "group": COLLISION_GROUP,
        "contype": ROBOT_BIT,
        "conaffinity": ROBOT_BIT if config.self_collisions else 0,
        "friction": [config.friction, 0.005, 0.0001],
        "condim": 3,
        "rgba": [0.3, 0.6, 0.3, 0.4],
    }


def _add_capsule(body: mujoco.MjsBody, start: g1.Vec, end: g1.Vec, radius: float, **kwargs) -> None:
    if np.allclose(start, end):
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=start, size=[radius, 0, 0], **kwargs)
    else:
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[*start, *end], size=[radius, 0, 0], **kwargs)


def _add_collision(bodies: dict[str, mujoco.MjsBody], config: RobotConfig) -> None:
    kwargs = _collision_kwargs(config)
    for capsule in g1.COLLISION:
        if config.effector == "hand" and capsule.name.endswith("hand_collision"):
            continue
        _add_capsule(bodies[capsule.body], capsule.start, capsule.end, capsule.radius, name=capsule.name, **kwargs)
    box = mujoco.mjtGeom.mjGEOM_BOX
    points = np.asarray(g1.FOOT_POINTS)
    for foot in g1.FEET:
        side = foot.split("_")[0]
        if config.feet == "sphere":
            for i, point in enumerate(g1.FOOT_POINTS):
                _add_capsule(
                    bodies[foot], point, point, g1.FOOT_POINT_RADIUS, name=f"{side}_foot{i}_collision", **kwargs
                )
        else:
            low, high = points.min(0) - g1.FOOT_POINT_RADIUS, points.max(0) + g1.FOOT_POINT_RADIUS
            low[2], high[2] = points[0, 2] - g1.FOOT_POINT_RADIUS, points[0, 2] + 0.02
            bodies[foot].add_geom(
                name=f"{side}_foot_collision", type=box, pos=(low + high) / 2, size=(high - low) / 2, **kwargs
            )
        hand = bodies[f"{side}_wrist_yaw_link"]
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
    for foot in g1.FEET:
        bodies[foot].add_geom(type=box, pos=[0.035, 0, -0.022], size=[0.088, 0.032, 0.012], rgba=_DARK, **kwargs)
        if config.effector == "L":
            hand = bodies[foot.split("_")[0] + "_wrist_yaw_link"]
            hand.add_geom(type=box, pos=[0.13, 0, 0], size=[0.03, 0.04, 0.003], rgba=_ACCENT, **kwargs)
            hand.add_geom(type=box, pos=[0.10, 0, -0.03], size=[0.003, 0.04, 0.03], rgba=_ACCENT, **kwargs)


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
