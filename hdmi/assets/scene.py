"""A scene: floor, robot, object, scenery and the sensors that the environment reads, compiled to one MjModel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from hdmi.assets.objects import ObjectConfig, SceneryConfig, add_object, add_scenery, check_numbers
from hdmi.assets.robot import ROBOT_BIT, WORLD_BIT, Robot
from hdmi.assets.robot_config import RobotConfig, add_robot

Pose = tuple[Sequence[float], Sequence[float]]
_MINDIST, _NETFORCE = 1, 3  # contact sensor reductions: the deepest contact; the sum of all, in the world frame


@dataclass(frozen=True)
class SimConfig:
    """Physics of the scene.

    Args:
        timestep: of physics, s.
        decimation: physics steps per control step.
        integrator, cone: MuJoCo's; Euler treats joint damping implicitly.
        impratio: of frictional to normal contact stiffness, for elliptic cones: above 1, what is held creeps less.
        iterations, ls_iterations: of the constraint solver.

    Examples:
        >>> SimConfig(timestep=0.005, decimation=4).control_dt
        0.02
        >>> build_scene(RobotConfig(), SimConfig(iterations=50)).model.opt.iterations
        50
    """

    timestep: float = 0.005
    decimation: int = 4
    integrator: Literal["euler", "implicitfast"] = "euler"
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"
    impratio: float = 1.0
    iterations: int = 10
    ls_iterations: int = 20

    @property
    def control_dt(self) -> float:
        """Seconds per control step."""
        return self.timestep * self.decimation


@dataclass(frozen=True)
class Effector:
    """An end effector that is meant to touch the object.

    Args:
        body: of the robot.
        point: on that body, in its frame, m.
        target: on the object's link, in its frame, m; the reference motion's contact points take precedence.
        press: how far into the object the contact point is moved along the surface's normal, m: what rewards,
            terminations and observations see. On the surface it asks for a touch, deeper for a grip.

    Examples:
        >>> palm = Effector("left_wrist_yaw_link", point=(0.1, 0.0, 0.0), target=(0.0, 0.2, 0.0))
        >>> ball = ObjectConfig("ball", geoms=[{"sphere": 0.2}])
        >>> build_scene(RobotConfig(), SimConfig(), ball, effectors=[palm]).effector_sensors.shape
        (1, 3)
        >>> build_scene(RobotConfig(), SimConfig(), ball, effectors=[Effector("left_hand")])
        Traceback (most recent call last):
        ValueError: effectors: robot has no body 'left_hand'; it has ['pelvis', ...
    """

    body: str
    point: Sequence[float] = (0.0, 0.0, 0.0)
    target: Sequence[float] = (0.0, 0.0, 0.0)
    press: float = 0.0

    def check(self, where: str, robot: Robot) -> None:
        """Raises a ValueError that names the field for what cannot be used, or is not of the robot."""
        if self.body not in robot.body_names:
            raise ValueError(f"{where}.body: robot has no body {self.body!r}; it has {', '.join(robot.body_names)}")
        check_numbers(self.point, 3, f"{where}.point")
        check_numbers(self.target, 3, f"{where}.target")
        check_numbers(self.press, 1, f"{where}.press")
        if self.press < 0:
            raise ValueError(f"{where}.press: at least 0 m expected, got {self.press}")


@dataclass(frozen=True)
class Scene:
    """A compiled scene and where its parts are in MuJoCo's arrays.

    Examples:
        >>> scene = build_scene(RobotConfig(), SimConfig())
        >>> scene.default_qpos.shape, scene.object_body  # a free root and 29 joints; no object
        ((36,), None)
        >>> scene.default_qpos[scene.joint_qpos].shape
        (29,)
    """

    model: mujoco.MjModel
    xml: str  # MJCF of the model, for other programs
    sim: SimConfig
    robot: Robot  # with the servos and default pose of its config
    effectors: tuple[Effector, ...]
    default_qpos: np.ndarray  # [nq] standing robot, object where it was placed
    body_ids: np.ndarray  # [B] robot bodies in table order
    joint_qpos: np.ndarray  # [J] addresses
    joint_dof: np.ndarray  # [J]
    foot_sensors: np.ndarray  # [F, 3] addresses in sensordata
    effector_sensors: np.ndarray  # [E, 3]
    penetration_sensor: int | None  # address of the smallest distance of the object's contacts, m; 0 without contact
    scenery_bodies: np.ndarray  # [S] ids
    object_body: int | None
    object_link: int | None  # the body that contact points are fixed to
    object_free_qpos: int | None  # address of the free joint; None when fixed or absent
    object_free_dof: int | None
    object_hinge_qpos: int | None
    object_hinge_dof: int | None
    object_geoms: np.ndarray  # ids

    @property
    def num_object_joints(self) -> int:
        """Joints of the object besides its root: 1 if it is articulated."""
        return 0 if self.object_hinge_qpos is None else 1


def build_scene(
    robot: RobotConfig,
    sim: SimConfig,
    object: ObjectConfig | None = None,
    scenery: Sequence[SceneryConfig] = (),
    effectors: Sequence[Effector] = (),
    placements: Mapping[str, Pose] | None = None,
) -> Scene:
    """Composes and compiles a scene.

    Args:
        placements: body name -> (pos, quat), from the reference's first frame, for the object and scenery.

    Raises:
        ValueError: if scenery has no placement, an effector names no robot body, or effectors have no object.
    """
    placements = placements or {}
    for effector in effectors:
        if effector.body not in robot.model.body_names:
            raise ValueError(f"effectors: robot has no body {effector.body!r}; it has {list(robot.model.body_names)}")
    if effectors and object is None:
        raise ValueError("effectors: the task has no object to touch")
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    _set_options(spec, sim)
    _add_floor(spec)
    spec = add_robot(spec, robot)
    record = robot.robot
    for actuator in spec.actuators:
        actuator.nsample = sim.decimation  # room for a control per physics step; no delay
    if object is not None:
        add_object(spec, object, *placements.get(object.name, ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))))
    for item in scenery:
        if item.name in placements:
            add_scenery(spec, item, *placements[item.name])
        elif item.pos is not None:
            add_scenery(spec, item, item.pos, item.quat)
        else:
            raise ValueError(f"scenery {item.name!r}: the reference has no body of that name; give it a pos")
    _add_contact_sensors(spec, record, object, effectors)
    model = spec.compile()

    joint_ids = [model.joint(name).id for name in record.joint_names]
    # not in model.qpos0: hinges turn by qpos - qpos0
    default_qpos = model.qpos0.copy()
    default_qpos[2] = record.root_height
    default_qpos[model.jnt_qposadr[joint_ids]] = record.default_joint_pos
    link = None if object is None else model.body(object.link).id
    hinge = None if object is None or object.hinge is None else model.joint(object.hinge.name).id
    free = None if object is None or object.fixed_base else model.joint("object_root").id
    body = None if object is None else model.body(object.name).id
    return Scene(
        model=model,
        xml=spec.to_xml(),
        sim=sim,
        robot=record,
        effectors=tuple(effectors),
        default_qpos=default_qpos,
        body_ids=np.array([model.body(name).id for name in record.body_names]),
        joint_qpos=model.jnt_qposadr[joint_ids].copy(),
        joint_dof=model.jnt_dofadr[joint_ids].copy(),
        foot_sensors=_sensor_addresses(model, [f"{foot}_force" for foot in record.foot_bodies]),
        effector_sensors=_sensor_addresses(model, [f"effector{i}_force" for i in range(len(effectors))]),
        penetration_sensor=None if object is None else int(model.sensor("object_penetration").adr[0]),
        scenery_bodies=np.array([model.body(item.name).id for item in scenery], dtype=int),
        object_body=body,
        object_link=link,
        object_free_qpos=None if free is None else int(model.jnt_qposadr[free]),
        object_free_dof=None if free is None else int(model.jnt_dofadr[free]),
        object_hinge_qpos=None if hinge is None else int(model.jnt_qposadr[hinge]),
        object_hinge_dof=None if hinge is None else int(model.jnt_dofadr[hinge]),
        object_geoms=np.flatnonzero(np.isin(model.geom_bodyid, [b for b in (body, link) if b is not None])),
    )


def _set_options(spec: mujoco.MjSpec, sim: SimConfig) -> None:
    integrators = {
        "euler": mujoco.mjtIntegrator.mjINT_EULER,
        "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    }
    cones = {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC}
    if sim.integrator not in integrators:
        raise ValueError(f"sim.integrator: expected one of {list(integrators)}, got {sim.integrator!r}")
    if sim.cone not in cones:
        raise ValueError(f"sim.cone: expected one of {list(cones)}, got {sim.cone!r}")
    spec.option.timestep = sim.timestep
    spec.option.integrator = integrators[sim.integrator]
    spec.option.cone = cones[sim.cone]
    spec.option.impratio = sim.impratio
    spec.option.iterations = sim.iterations
    spec.option.ls_iterations = sim.ls_iterations
    # A diverged world must be seen and reset by the environment, not silently by MuJoCo.
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)


def _add_floor(spec: mujoco.MjSpec) -> None:
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.headlight.diffuse = [0.35, 0.35, 0.35]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1920, 1080
    spec.visual.quality.shadowsize = 4096
    spec.visual.map.shadowclip = 8.0  # the edge of what the light sees is speckled: out of view
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.93, 0.95, 0.98],
        rgb2=[0.62, 0.70, 0.80],
        width=256,
        height=256,
    )
    spec.add_texture(
        name="checker",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.78, 0.80, 0.82],
        rgb2=[0.70, 0.72, 0.75],
        width=512,
        height=512,
    )
    material = spec.add_material(name="checker", texrepeat=[2, 2], texuniform=True, reflectance=0.05)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "checker"
    spec.worldbody.add_light(
        pos=[1.5, -2.0, 5.0], dir=[-0.25, 0.35, -0.9], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=[0.6, 0.6, 0.6], castshadow=True,
    )  # fmt: skip
    # MuJoCo takes the larger sliding friction of a pair: the floor, with the least there is, leaves it to the other
    spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.5], material="checker",
        contype=WORLD_BIT, conaffinity=ROBOT_BIT | WORLD_BIT, condim=3, friction=[mujoco.mjMINMU, 0.005, 0.0001],
    )  # fmt: skip


def _add_contact_sensors(
    spec: mujoco.MjSpec, robot: Robot, object: ObjectConfig | None, effectors: Sequence[Effector]
) -> None:
    force = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE)
    common = {"type": mujoco.mjtSensor.mjSENS_CONTACT, "intprm": [force, _NETFORCE, 1]}
    if object is not None:
        spec.add_sensor(
            name="object_penetration",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_XBODY,
            objname=object.name,
            intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_DIST), _MINDIST, 1],
        )
    for foot in robot.foot_bodies:
        spec.add_sensor(name=f"{foot}_force", objtype=mujoco.mjtObj.mjOBJ_BODY, objname=foot, **common)
    for i, effector in enumerate(effectors):
        assert object is not None
        # XBODY is the whole subtree: for an articulated object its base and its link
        spec.add_sensor(
            name=f"effector{i}_force",
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            objname=effector.body,
            reftype=mujoco.mjtObj.mjOBJ_XBODY,
            refname=object.name,
            **common,
        )


def _sensor_addresses(model: mujoco.MjModel, names: Sequence[str]) -> np.ndarray:
    starts = np.array([model.sensor(name).adr[0] for name in names], dtype=int)
    return starts[:, None] + np.arange(3)  # [S, 3]
