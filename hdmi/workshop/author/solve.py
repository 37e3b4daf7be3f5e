"""From a plan to a reference motion: paths from keyframes, joints from inverse kinematics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from hdmi.assets import Effector, ObjectConfig, RobotConfig, SceneryConfig, g1, g1_robot, per_joint
from hdmi.assets.objects import add_object
from hdmi.motion.format import Motion, motion_from_poses
from hdmi.motion.kinematics import derivative, forward_kinematics, minimum_jerk
from hdmi.workshop import ik
from hdmi.workshop.author.balance import Load, centre_of_pressure, pendulum_com
from hdmi.workshop.author.footsteps import centre_of_pressure as planned_pressure
from hdmi.workshop.author.footsteps import foot_path, footprints, plan_steps, root_path
from hdmi.workshop.author.paths import PosePath, about, pose_path, rotation, value_path
from hdmi.workshop.author.plan import SIDES, Plan, PlanError, PoseKey, Step

FPS = 50.0
HANDS = {side: f"{side}_wrist_yaw_link" for side in SIDES}
FEET = dict(zip(SIDES, g1.FEET, strict=True))
REST_POINT = (0.1, 0.0, 0.0)  # of a hand that is no end effector of the task

# Per m and per rad. Feet are held, hands and balance come before height and lean.
FOOT_WEIGHT = (50.0, 20.0)
COM_WEIGHT, PELVIS_WEIGHT, HAND_WEIGHT = 10.0, (2.0, 0.5), (10.0, 3.0)
TORSO_WEIGHT = 1.0
HELD_WEIGHT = 30.0  # of joints that hold the default pose
LEG_POSTURE_WEIGHT = 0.02
LIMIT_MARGIN = 0.06  # rad
MAX_MISS = {"hand": 0.03, "foot": 0.01}  # m; beyond, a plan is out of reach
_TOLERANCE = 3e-4  # rad and m
_ROUGH_STRIDE, _ROUGH_TOLERANCE = 2, 2e-3  # of corrections: the centre of mass is smooth


@dataclass(frozen=True)
class Authored:
    """A solved plan and how well it came out.

    Examples:
        >>> from pathlib import Path
        >>> stand = author_motion(parse_plan({"duration": 0.2}, Path("stand.yaml")))
        >>> stand.motion.num_frames, stand.unsettled
        (10, 0)
    """

    motion: Motion
    misses: dict[str, float]  # largest distance of hands, feet and centre of mass from where the plan wants them, m
    pressure_error: float  # 95th percentile of the centre of pressure's distance from the planned one, m
    speed: float  # of the fastest joint, as a share of its limit
    unsettled: int  # frames in which inverse kinematics did not settle


@dataclass(frozen=True)
class _Paths:
    """Everything that the plan says, over time."""

    root: PosePath
    pressure: np.ndarray  # [T, 3]
    pelvis_height: np.ndarray  # [T]
    pelvis: Rotation
    torso: Rotation
    feet: Mapping[str, PosePath]
    object: PosePath | None
    hinge: np.ndarray | None  # [T]
    frames: dict[str, PosePath]
    contact: np.ndarray  # [T, E]


def author_motion(
    plan: Plan,
    object: ObjectConfig | None = None,
    scenery: Sequence[SceneryConfig] = (),
    effectors: Sequence[Effector] = (),
    robot: RobotConfig | None = None,
    on_frame: Callable[[int, int], None] | None = None,
) -> Authored:
    """Solves a plan for a task's object, scenery, end effectors and robot.

    Args:
        robot: whose default pose resolves what the plan leaves open. Where it holds wrists there, hands turn as far as
            arms turn them.
        on_frame: called with the index of every frame of the last pass once it is solved, and their number.

    Raises:
        PlanError: where the plan and the task do not fit together, the plan is out of the robot's reach, or the robot
            is another one than the G1.
        ImportError: without the extra `retarget`.
    """
    time = np.arange(round(plan.duration * FPS)) / FPS
    robot = robot or RobotConfig()
    if robot.model != g1_robot():
        raise PlanError(f"{plan.file}: plans are solved for the G1, and robot.model is {robot.model.name}")
    paths = _lay_out(plan, time, object, scenery, effectors)
    body = [*_foot_targets(paths), *_body_targets(plan, paths, robot)]
    hands, contact = _hand_targets(plan, paths, time, effectors, body, robot)
    contact |= paths.contact
    load = _load(plan, paths, time, object, hands)
    com = _com(paths, load, time)
    targets = [*body, *hands]
    start = ik.standing([*paths.root.pos[0, :2], paths.pelvis_height[0]], plan.start_yaw)
    options = ik.IkOptions(limit_margin=LIMIT_MARGIN, self_collision=None, tolerance=_ROUGH_TOLERANCE)
    for _ in range(plan.corrections):
        some = slice(None, None, _ROUGH_STRIDE)
        rough = ik.solve(
            [_every(target, _ROUGH_STRIDE, len(time)) for target in [*targets, ik.ComTarget(com, _over_feet())]],
            len(time[some]),
            FPS / _ROUGH_STRIDE,
            initial=start,
            options=options,
        )
        fps = FPS / _ROUGH_STRIDE
        actual = centre_of_pressure(rough.qpos, _thinned(load, some), paths.pressure[some, 2], fps)
        change = pendulum_com(paths.pressure[some, :2] - actual, fps)
        com[:, :2] += np.column_stack([np.interp(time, time[some], column) for column in change.T])
    result = ik.solve(
        [*targets, ik.ComTarget(com, _over_feet())],
        len(time),
        FPS,
        initial=start,
        options=replace(options, self_collision=0.005, tolerance=_TOLERANCE),
        on_frame=None if on_frame is None else lambda t: on_frame(t, len(time)),
    )
    points = _contact_points(plan, paths, effectors, hands, time)
    motion = _motion(plan, result, paths, object, scenery, contact, points)
    return _report(plan, result, motion, load, paths, time)


def _every(target: ik.Target, stride: int, num_frames: int) -> ik.Target:
    """The target in every `stride`-th frame."""
    changed: dict[str, Any] = {
        name: np.asarray(value)[::stride]
        for name, value in vars(target).items()
        if isinstance(value, np.ndarray) and value.ndim == 2 and len(value) == num_frames
    }
    return replace(target, **changed)


def _thinned(load: Load, some: slice) -> Load:
    return Load(load.pos[some], load.mass[some], load.force[some], load.point[some])


def _over_feet() -> tuple[float, float, float]:
    return (COM_WEIGHT, COM_WEIGHT, 0.0)


# -- the plan over time ---------------------------------------------------------------------------------------


def _lay_out(
    plan: Plan,
    time: np.ndarray,
    object: ObjectConfig | None,
    scenery: Sequence[SceneryConfig],
    effectors: Sequence[Effector],
) -> _Paths:
    steps = plan_steps(plan)
    prints = footprints(plan, steps, time)
    root = root_path(prints, time)
    pressure = planned_pressure(plan, steps, prints, time)
    height = value_path(plan.pelvis, "height", time, 0.74)
    pelvis = root.rot * about("y", value_path(plan.pelvis, "pitch", time, 0.0))
    lean, gaze, roll = (
        value_path(plan.torso, name, time, default) for name, default in (("lean", 0.05), ("gaze", 0.0), ("roll", 0.0))
    )
    torso = root.rot * Rotation.from_euler("xyz", np.column_stack([roll, lean, gaze]))
    # where the body sways to: what hangs from the torso sways along
    sway = pendulum_com(pressure[:, :2], FPS)
    frames = {
        "world": PosePath.fixed((0.0, 0.0, 0.0), Rotation.identity(), len(time)),
        "root": root,
        "torso": PosePath(np.column_stack([sway, root.pos[:, 2] + height]), torso),
    }
    for item in scenery:
        if item.name not in plan.scenery:
            raise PlanError(f"{plan.file}: scenery: does not place {item.name!r}")
        key = plan.scenery[item.name]
        frames[item.name] = PosePath.fixed(key.pos or (0.0, 0.0, 0.0), rotation(key.rpy), len(time))
    if unknown := set(plan.scenery) - {item.name for item in scenery}:
        raise PlanError(f"{plan.file}: scenery: the task has no {', '.join(sorted(unknown))}")
    object_path, hinge = _object(plan, time, object, frames)
    feet, contact = {}, np.zeros((len(time), len(effectors)), bool)
    for side in SIDES:
        effector = next((e for e in effectors if e.body == FEET[side]), None)
        at = None if effector is None else (effector.point, effector.target)
        feet[side], touches = foot_path(plan, side, steps, prints[side], time, frames, at)
        if effector is not None:
            contact[:, list(effectors).index(effector)] = touches
    return _Paths(root, pressure, height, pelvis, torso, feet, object_path, hinge, frames, contact)


def _object(
    plan: Plan, time: np.ndarray, object: ObjectConfig | None, frames: dict[str, PosePath]
) -> tuple[PosePath | None, np.ndarray | None]:
    """The object's path and the angle of its hinge; adds the frames `object` and `object_position`."""
    if object is None:
        if plan.object_path or plan.hinge:
            raise PlanError(f"{plan.file}: object: the task has none")
        return None, None
    if not plan.object_path:
        raise PlanError(f"{plan.file}: object.path: lacks the place of {object.name!r}")
    path, _ = pose_path(plan.object_path, frames, time)
    if plan.rolls is not None:
        path = PosePath(path.pos, _rolled(path, plan.rolls))
    link, hinge = path, None
    if object.hinge is not None:
        config = object.hinge
        hinge = value_path(plan.hinge, "angle", time, 0.0)
        low, high = config.range
        if (outside := (hinge < low) | (hinge > high)).any():
            t = int(np.argmax(outside))
            raise PlanError(
                f"{plan.file}: object.hinge: {hinge[t]:.2f} rad at {time[t]:.2f} s is outside {low}..{high}"
            )
        turn = Rotation.from_quat(config.quat, scalar_first=True) * Rotation.from_rotvec(
            hinge[:, None] * np.asarray(config.axis, float) / np.linalg.norm(config.axis)
        )
        link = PosePath(path.apply(config.pos), path.rot * turn)
    elif plan.hinge:
        raise PlanError(f"{plan.file}: object.hinge: {object.name!r} has none")
    frames["object"] = link
    frames["object_position"] = PosePath(link.pos, Rotation.concatenate([Rotation.identity()] * len(time)))
    return path, hinge


def _rolled(path: PosePath, radius: float) -> Rotation:
    """Orientation of a ball that rolls along a path without slipping."""
    move = np.diff(path.pos, axis=0, prepend=path.pos[:1])
    turns = Rotation.from_rotvec(np.column_stack([-move[:, 1], move[:, 0], np.zeros(len(move))]) / radius)
    out, now = [], path.rot[0]
    for turn in turns:
        now = turn * now
        out.append(now)
    return Rotation.concatenate(out)


# -- targets --------------------------------------------------------------------------------------------------


def _foot_targets(paths: _Paths) -> list[ik.Target]:
    return [
        target
        for side in SIDES
        for target in (
            ik.PointTarget(FEET[side], paths.feet[side].pos, FOOT_WEIGHT[0]),
            ik.OrientationTarget(FEET[side], paths.feet[side].quat, FOOT_WEIGHT[1]),
        )
    ]


def _body_targets(plan: Plan, paths: _Paths, robot: RobotConfig) -> list[ik.Target]:
    height = paths.root.pos[:, 2] + paths.pelvis_height
    pelvis_pos = np.column_stack([paths.root.pos[:, :2], height])
    posture = per_joint(plan.posture, g1.JOINT_NAMES, default=robot.default_joint_pos, where=f"{plan.file}: posture")
    arms = {".*_(shoulder_.*|elbow|wrist_.*)_joint": plan.arm_posture}
    weight = per_joint(arms | dict.fromkeys(robot.held_joints, HELD_WEIGHT), g1.JOINT_NAMES, default=LEG_POSTURE_WEIGHT)
    return [
        ik.PointTarget("pelvis", pelvis_pos, (0.0, 0.0, PELVIS_WEIGHT[0])),
        ik.OrientationTarget("pelvis", paths.pelvis.as_quat(scalar_first=True), PELVIS_WEIGHT[1]),
        ik.OrientationTarget("torso_link", paths.torso.as_quat(scalar_first=True), TORSO_WEIGHT),
        ik.PostureTarget(posture, weight),
    ]


def _hand_targets(
    plan: Plan,
    paths: _Paths,
    time: np.ndarray,
    effectors: Sequence[Effector],
    body: Sequence[ik.Target],
    robot: RobotConfig,
) -> tuple[list[ik.Target], np.ndarray]:
    contact = np.zeros((len(time), len(effectors)), bool)
    targets: list[ik.Target] = []
    rest = _rest_pose(paths, body)
    turning = plan.turning if any("wrist" in name for name in robot.held_joints) else HAND_WEIGHT[1]
    for side, name in HANDS.items():
        effector = next((e for e in effectors if e.body == name), None)
        own = REST_POINT if effector is None else tuple(effector.point)
        keys = plan.hands.get(side) or (PoseKey(0.0, frame="rest", pos=(0.0, 0.0, 0.0)),)
        points = {key.point or own for key in keys if key.frame != "rest"} or {own}
        if len(points) > 1:
            raise PlanError(f"{plan.file}: hands.{side}: one point for all keys, got {sorted(points)}")
        point = points.pop()
        frames = {**paths.frames, "rest": _with_torso(paths, rest[side], point)}
        target = (0.0, 0.0, 0.0) if effector is None else effector.target
        path, touches = pose_path(keys, frames, time, target)
        targets += [
            ik.PointTarget(name, path.pos, HAND_WEIGHT[0], point=point),
            ik.OrientationTarget(name, path.quat, turning),
        ]
        if effector is not None:
            contact[:, list(effectors).index(effector)] = touches
    return targets, contact


def _rest_pose(paths: _Paths, body: Sequence[ik.Target]) -> dict[str, tuple[np.ndarray, Rotation]]:
    """Where the hands hang while the robot stands as in the first frame: pose of their bodies, by side."""
    com = pendulum_com(paths.pressure[:, :2], FPS)[0]
    start = ik.standing(paths.frames["torso"].pos[0], float(paths.root.rot[0].as_euler("xyz")[2]))
    targets = [_every(target, len(paths.pressure), len(paths.pressure)) for target in body]
    options = ik.IkOptions(limit_margin=LIMIT_MARGIN, self_collision=None)
    stance = ik.solve([*targets, ik.ComTarget([*com, 0.0], _over_feet())], 1, FPS, initial=start, options=options)
    pos, quat = forward_kinematics(g1_robot(), stance.root_pos, stance.root_quat, stance.joint_pos)
    rows = {side: g1.BODY_NAMES.index(name) for side, name in HANDS.items()}
    return {side: (pos[0, b], Rotation.from_quat(quat[0, b], scalar_first=True)) for side, b in rows.items()}


def _with_torso(paths: _Paths, pose: tuple[np.ndarray, Rotation], point: Sequence[float]) -> PosePath:
    """The path of a point of a hand that hangs from the planned torso."""
    torso = paths.frames["torso"]
    pos, rot = pose
    inverse = torso.rot[0].inv()
    offset = inverse.apply(pos + rot.apply(point) - torso.pos[0])
    return PosePath(torso.apply(offset), torso.rot * (inverse * rot))


def _load(plan: Plan, paths: _Paths, time: np.ndarray, object: ObjectConfig | None, hands: Sequence[ik.Target]) -> Load:
    mass, pos = np.zeros(len(time)), np.zeros((len(time), 3))
    if plan.carried is not None:
        if object is None or paths.object is None:
            raise PlanError(f"{plan.file}: object.carried: the task has no object")
        up, held, down, left = plan.carried
        share = minimum_jerk((time - up) / max(held - up, 1e-9)) - minimum_jerk((time - down) / max(left - down, 1e-9))
        mass, pos = object.mass * share, paths.object.apply(_centre(object))
    points = [np.asarray(target.pos) for target in hands if isinstance(target, ik.PointTarget)]
    force = value_path(plan.push, "force", time, (0.0, 0.0, 0.0))
    return Load(pos, mass, force, np.mean(points, axis=0))


def _centre(object: ObjectConfig) -> np.ndarray:
    """Centre of mass of a rigid object in its frame, m. [3]"""
    spec = mujoco.MjSpec()
    add_object(spec, object, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return np.array(data.subtree_com[0])


def _com(paths: _Paths, load: Load, time: np.ndarray) -> np.ndarray:
    """Centre of mass of the robot that keeps it and its load over the planned pressure. [T, 3]"""
    over = pendulum_com(paths.pressure[:, :2], FPS)
    over -= load.mass[:, None] / g1.TOTAL_MASS * (load.pos[:, :2] - over)
    return np.column_stack([over, np.zeros(len(time))])


def _contact_points(
    plan: Plan, paths: _Paths, effectors: Sequence[Effector], hands: Sequence[ik.Target], time: np.ndarray
) -> np.ndarray:
    """The task's targets, or where keys say `contact: here`, of the one that is nearest in time; on an object that
    rolls, where the hands touch it, which moves over it. [T, E, 3]"""
    points = np.empty((len(time), len(effectors), 3))
    for e, effector in enumerate(effectors):
        here = [key for key in _keys_of(plan, effector.body) if key.here]
        nearest = np.abs(np.subtract.outer(time, [key.time for key in here])).argmin(axis=1) if here else None
        points[:, e] = effector.target if nearest is None else np.array([key.pos for key in here])[nearest]
        hand = next((h for h in hands if isinstance(h, ik.PointTarget) and h.body == effector.body), None)
        if plan.rolls is not None and paths.object is not None and hand is not None:
            inward = paths.object.rot.inv().apply(np.asarray(hand.pos) - paths.object.pos)
            points[:, e] = plan.rolls * inward / np.linalg.norm(inward, axis=1, keepdims=True)
    return points


def _keys_of(plan: Plan, body: str) -> tuple[PoseKey, ...]:
    """Of a hand, or of all steps of a foot."""
    side = body.split("_")[0]
    if body == FEET.get(side):
        return tuple(key for step in plan.feet if isinstance(step, Step) and step.side == side for key in step.via)
    return plan.hands.get(side, ())


# -- the result -----------------------------------------------------------------------------------------------


def _motion(
    plan: Plan,
    result: ik.IkResult,
    paths: _Paths,
    object: ObjectConfig | None,
    scenery: Sequence[SceneryConfig],
    contact: np.ndarray,
    points: np.ndarray,
) -> Motion:
    """The pelvis, the joints and what is not the robot: the other bodies follow by forward kinematics."""
    bodies = {"pelvis": (result.root_pos, result.root_quat)}
    joints = {name: result.joint_pos[:, j] for j, name in enumerate(g1.JOINT_NAMES)}
    if object is not None and paths.object is not None:
        bodies[object.name] = (paths.object.pos, paths.object.quat)
        if paths.hinge is not None:
            joints[object.hinge.name] = paths.hinge
    for item in scenery:
        bodies[item.name] = (paths.frames[item.name].pos, paths.frames[item.name].quat)
    pos = np.stack([pos for pos, _ in bodies.values()], axis=1)
    quat = np.stack([quat for _, quat in bodies.values()], axis=1)
    joint_pos = np.stack(list(joints.values()), axis=1)
    labels = (contact, points) if contact.shape[1] else (None, None)
    return motion_from_poses(plan.name, FPS, tuple(bodies), tuple(joints), pos, quat, joint_pos, *labels)


def _report(plan: Plan, result: ik.IkResult, motion: Motion, load: Load, paths: _Paths, time: np.ndarray) -> Authored:
    rows = {f"{side} hand": HANDS[side] for side in SIDES} | {f"{side} foot": FEET[side] for side in SIDES}
    misses = {name: float(np.nanmax(result.residuals[row])) for name, row in rows.items()}
    misses["centre of mass"] = float(np.nanmax(result.residuals["com"]))
    for name, row in rows.items():
        allowed = MAX_MISS[name.split()[1]]
        if misses[name] > allowed:
            t = int(np.nanargmax(result.residuals[row]))
            raise PlanError(
                f"{plan.file}: out of reach: at {time[t]:.2f} s the {name} is {misses[name]:.3f} m from where it "
                f"should be (at most {allowed} m)"
            )
    actual = centre_of_pressure(result.qpos, load, paths.pressure[:, 2], FPS)
    error = np.linalg.norm(actual - paths.pressure[:, :2], axis=1)
    limits = np.array([joint.velocity_limit for joint in g1.JOINTS])
    speed = np.abs(derivative(result.joint_pos, FPS) / limits).max()
    return Authored(motion, misses, float(np.percentile(error, 95)), float(speed), len(result.unsettled))
