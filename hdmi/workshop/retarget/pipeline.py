"""From a person's motion, with an object or without, to a reference of the robot.

1. The scene is scaled so that the person's legs become as long as the robot's; the object moves with it and keeps its
   size (`interaction`).
2. Feet that stand get a fixed place, and their path in between is adapted (`feet`); every other limb keeps its
   direction and gets the robot's length (`body`); hands near the object keep their place in the object's frame.
3. Inverse kinematics finds the joints, within ranges, speeds, and without entering floor, object or itself.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from hdmi.assets import Effector, ObjectConfig, default_joint_pos, g1, g1_robot
from hdmi.assets.robot import per_joint
from hdmi.motion.check import MotionError
from hdmi.motion.files import reading
from hdmi.motion.format import Motion, motion_from_poses
from hdmi.motion.kinematics import forward_kinematics
from hdmi.workshop import ik
from hdmi.workshop.human import HumanMotion, ObjectTrajectory
from hdmi.workshop.retarget.body import (
    PALM,
    SIDES,
    TOE,
    Body,
    Keypoints,
    find_scaling,
    keypoints,
    low_pass,
    low_pass_rotation,
    read_body,
)
from hdmi.workshop.retarget.feet import FootPaths, find_stances, foot_paths, slide
from hdmi.workshop.retarget.measures import RetargetReport, statistics
from hdmi.workshop.retarget.object import handled_point, obstacles, on_object, scale_object
from hdmi.workshop.skeleton import grounded

# Weights per m and per rad. What touches the world counts most, then hands, pelvis and trunk; knees and elbows
# only choose among the solutions that this leaves.
_PELVIS, _PELVIS_TURN, _TORSO_TURN = 10.0, 5.0, 5.0
_SWING, _SWING_TURN = 20.0, 5.0
_KNEE, _ELBOW = 8.0, 3.0
_PALM, _PALM_ON_OBJECT, _HAND_TURN = 6.0, 40.0, 1.0
_POSTURE = {".*": 0.05, ".*_hip_yaw_joint": 0.3}  # a leg turned back to front meets its targets, too
SMOOTHING = 1.0


@dataclass(frozen=True)
class RetargetOptions:
    """How a motion is retargeted.

    Args:
        fps: of the result.
        cutoff: what is faster in the person's motion is taken for noise, Hz.
        scale: of the scene; None: the length of the robot's legs over that of the person's.
        ground: `shift` the person vertically until the lowest sole touches the ground, `keep` the height, or None:
            shift if the sole misses the ground by more than 5 cm.
        ik: of the inverse kinematics; by default it keeps the robot out of floor, object and itself.

    Examples:
        >>> options = RetargetOptions(fps=30.0, cutoff=3.0)
        >>> options.ik.floor  # m
        0.0
    """

    fps: float = 50.0
    cutoff: float = 6.0
    scale: float | None = None
    ground: str | None = None
    ik: ik.IkOptions = field(default_factory=lambda: ik.IkOptions(floor=0.0, smoothing=SMOOTHING))


def retarget(
    human: HumanMotion,
    object: ObjectConfig | None = None,
    *,
    effectors: Sequence[Effector] = (),
    options: RetargetOptions | None = None,
    on_frame: Callable[[int], None] | None = None,
) -> tuple[Motion, RetargetReport]:
    """Makes a reference of the robot from a person's motion.

    Args:
        human: z up; its object's trajectory in the person's scene.
        object: what the object is; without it, it is carried over by its path alone, and neither hands nor
            collisions know it.
        effectors: of the task; the result gets a column of contact labels for each, if the source has labels.
        options: see the class.
        on_frame: called with the index of every solved frame.

    Returns:
        The reference, with a body named like the object, and what retargeting did.

    Raises:
        ImportError: if the extra is not installed.
        MotionError: if the motion lacks joints, its object, or the ground.
    """
    options = options or RetargetOptions()
    with reading(f"motion {human.name!r}"):
        human = grounded(human, options.ground).resample(options.fps)
    if object is not None and human.object is None:
        raise MotionError(
            f"motion {human.name!r}: has no object poses, so {object.name!r} cannot be placed; retarget it without the "
            "object, and give its poses as keyframes to annotation"
        )
    body = read_body(human, options.cutoff)
    stances = find_stances(body, options.fps)
    scaling = find_scaling(human, body, stances.flat, options.scale)
    feet = foot_paths(body, stances, scaling, options.fps)
    points = keypoints(body, scaling, feet.pos, options.fps)
    source = None if human.object is None else _smooth_object(human.object, options)
    anchor = None
    if object is not None and source is not None:
        anchor = handled_point([body.pos[f"{side}_palm"] for side in SIDES], object, source)
    scaled = None if source is None else scale_object(source, scaling.scale, object, anchor)
    solid: list[ik.Obstacle] = []
    palms = {side: (points.palms[side], np.zeros(human.num_frames)) for side in SIDES}
    if object is not None and source is not None and scaled is not None:
        solid = obstacles(object, scaled)
        for side in SIDES:
            contact = _labels(human, f"{side}_wrist")
            palm, hand = body.pos[f"{side}_palm"], body.hands[side]
            held, share = on_object(palm, hand, object, source, scaled, contact, options.fps)
            palms[side] = points.palms[side] + share[:, None] * (held - points.palms[side]), share
    started = time.process_time()
    result = ik.solve(
        _targets(body, points, feet, palms),
        human.num_frames,
        options.fps,
        initial=ik.standing(points.pelvis[0], float(body.pelvis[0].as_euler("ZYX")[0])),
        obstacles=solid,
        options=options.ik,
        on_frame=on_frame,
    )
    seconds = time.process_time() - started
    motion = _motion(human, object, scaled, effectors, result)
    return motion, _report(motion, result, feet, human, scaling.scale, seconds)


def _smooth_object(thing: ObjectTrajectory, options: RetargetOptions) -> ObjectTrajectory:
    turn = low_pass_rotation(Rotation.from_quat(thing.quat, scalar_first=True), options.fps, options.cutoff)
    return ObjectTrajectory(
        thing.name,
        low_pass(thing.pos, options.fps, options.cutoff).astype(np.float32),
        turn.as_quat(scalar_first=True).astype(np.float32),
        None if thing.joint_pos is None else low_pass(thing.joint_pos, options.fps, options.cutoff).astype(np.float32),
    )


def _labels(human: HumanMotion, joint: str) -> np.ndarray | None:
    if human.contact is None or joint not in human.contact_names:
        return None
    return human.contact[:, human.contact_names.index(joint)]


def _targets(
    body: Body, points: Keypoints, feet: FootPaths, palms: dict[str, tuple[np.ndarray, np.ndarray]]
) -> list[ik.Target]:
    targets: list[ik.Target] = [
        ik.PointTarget("pelvis", points.pelvis, _PELVIS),
        ik.OrientationTarget("pelvis", body.pelvis.as_quat(scalar_first=True), _PELVIS_TURN),
        ik.OrientationTarget("torso_link", body.torso.as_quat(scalar_first=True), _TORSO_TURN),
        ik.PostureTarget(default_joint_pos(), per_joint(_POSTURE, g1.JOINT_NAMES)),
    ]
    for side in SIDES:
        foot, hand = f"{side}_ankle_roll_link", f"{side}_wrist_yaw_link"
        toe, flat = feet.stances.toe[side][:, None], feet.stances.flat[side][:, None]
        target, share = palms[side]
        turn = np.array([1.0 if body.hands_turn else 0.0, 1.0, 1.0]) * _HAND_TURN
        targets += [
            ik.PointTarget(foot, feet.toe(side), toe * ik.PLANTED_WEIGHT[0], TOE, f"{side} toes planted"),
            ik.PointTarget(foot, feet.pos[side], ~toe * _SWING, name=f"{side} ankle in swing"),
            ik.OrientationTarget(
                foot,
                feet.quat[side],
                np.where(flat, ik.PLANTED_WEIGHT[1], np.where(toe, 2 * _SWING_TURN, _SWING_TURN)),
            ),
            ik.PointTarget(f"{side}_knee_link", points.knees[side], _KNEE),
            ik.PointTarget(f"{side}_elbow_link", points.elbows[side], _ELBOW * (1 - 0.9 * share[:, None])),
            ik.PointTarget(hand, target, (_PALM + share * (_PALM_ON_OBJECT - _PALM))[:, None], PALM, f"{side} palm"),
            ik.OrientationTarget(hand, body.hands[side].as_quat(scalar_first=True), turn * (1 + 3 * share[:, None])),
        ]
    return targets


def _motion(
    human: HumanMotion,
    object: ObjectConfig | None,
    scaled: ObjectTrajectory | None,
    effectors: Sequence[Effector],
    result: ik.IkResult,
) -> Motion:
    pos, quat = forward_kinematics(g1_robot(), result.root_pos, result.root_quat, result.joint_pos)
    joint_pos, body_names, joint_names = result.joint_pos, g1.BODY_NAMES, g1.JOINT_NAMES
    if scaled is not None:
        body_names = (*body_names, object.name if object is not None else scaled.name)
        pos = np.concatenate([pos, scaled.pos[:, None]], axis=1)
        quat = np.concatenate([quat, scaled.quat[:, None]], axis=1)
        if object is not None and object.hinge is not None:
            angle = np.zeros(len(pos)) if scaled.joint_pos is None else scaled.joint_pos
            joint_names = (*joint_names, object.hinge.name)
            joint_pos = np.concatenate([joint_pos, angle[:, None]], axis=1)
    contact = _contact(human, effectors)
    return motion_from_poses(human.name, human.fps, body_names, joint_names, pos, quat, joint_pos, contact)


def _contact(human: HumanMotion, effectors: Sequence[Effector]) -> np.ndarray | None:
    """Labels of the effectors from those of the joints that they stand for. bool [T, E]"""
    if human.contact is None or not effectors:
        return None
    columns = []
    for effector in effectors:
        side, _, part = effector.body.partition("_")
        joints = {"wrist_yaw_link": ["wrist"], "ankle_roll_link": ["ankle", "foot"]}.get(part, [])
        found = [label for joint in joints if (label := _labels(human, f"{side}_{joint}")) is not None]
        columns.append(np.any(found, axis=0) if found else np.zeros(human.num_frames, bool))
    return np.stack(columns, axis=1)


def _report(
    motion: Motion, result: ik.IkResult, feet: FootPaths, human: HumanMotion, scale: float, seconds: float
) -> RetargetReport:
    robot = len(g1.BODY_NAMES)
    speeds = slide(
        feet, motion.body_pos_w[:, :robot].astype(float), motion.body_quat_w[:, :robot].astype(float), motion.fps
    )
    limits = np.array([joint.velocity_limit for joint in g1.JOINTS])
    steps = np.diff(result.joint_pos, axis=0) * motion.fps
    jerk = np.diff(result.joint_pos, n=3, axis=0) * motion.fps**3
    return RetargetReport(
        name=motion.name,
        frames=motion.num_frames,
        fps=motion.fps,
        height=human.height,
        scale=scale,
        milliseconds=1000 * seconds / motion.num_frames,
        iterations=float(result.iterations.mean()),
        solver_failures=result.failures.tolist(),
        unsettled=result.unsettled.tolist(),
        residuals={
            name: statistics(values)
            for name, values in result.residuals.items()
            if name != "posture" and np.isfinite(values).any()
        },
        stance_frames={side: int(feet.stances.toe[side].sum()) for side in SIDES},
        slide=statistics(speeds) if speeds.size else None,
        penetration={
            name: {"p99": float(np.percentile(depth, 99)), "max": float(depth.max())}
            for name, depth in result.penetration.items()
        },
        joint_speed=float((np.abs(steps) / limits).max()),
        jerk=float(np.sqrt((jerk**2).mean())) if len(jerk) else 0.0,
        notes=list(human.notes),
    )
