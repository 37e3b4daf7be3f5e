"""From a reference with faults of its geometry to one near it without them.

1. The object is put on its support wherever it rests (`rest`), the robot as a whole moved until it touches the ground
   (`ground`).
2. Feet get one place for each of their planted phases (`feet`), end effectors their contact points while contact is
   labelled (`hands`).
3. Inverse kinematics finds the joints, within ranges and speeds, and without entering floor, scenery or object;
   everything that this leaves open is as in the reference. A second pass follows the path of the first, smoothed, with
   the centre of mass over the feet (`balance`) and the effectors' shapes where they touch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter1d
from scipy.spatial.transform import Rotation

from hdmi.assets import Effector, ObjectConfig, RobotConfig, SceneryConfig, g1, g1_robot
from hdmi.config import ConfigError
from hdmi.motion.check import MotionError
from hdmi.motion.format import Motion, motion_from_poses
from hdmi.motion.kinematics import forward_kinematics, minimum_jerk
from hdmi.motion.playback import Playback, make_playback
from hdmi.workshop import ik
from hdmi.workshop.human import ObjectTrajectory
from hdmi.workshop.repair.balance import balance_shift
from hdmi.workshop.repair.feet import FootPath, foot_path
from hdmi.workshop.repair.ground import lowering
from hdmi.workshop.repair.hands import Reach, pressed, reaches
from hdmi.workshop.repair.rest import Poses, settled_object
from hdmi.workshop.retarget.body import TOE
from hdmi.workshop.retarget.object import obstacles

# Weights per m and per rad: what touches the world counts most, then where the trunk is, then the reference's joints.
_REACH = 40.0
_PELVIS, _PELVIS_TURN, _TORSO_TURN = 10.0, 5.0, 20.0
_SWING, _SWING_TURN = 30.0, 8.0
_POSTURE = 1.0
_BALANCE = 8.0
_SMOOTHING = 0.5
_FOLLOW = 3.0  # how much more the smoothed path of a first pass counts in a second one than the reference in the first
_SPREAD = 0.06  # s; standard deviation over which corrections are smoothed
_JOLT = (20.0, 150.0)  # m/s^2 and rad/s^2; corrections of the root and of joints that change faster are smoothed again
_CALMINGS = 2  # at most
_RAMP = 0.08  # s, over which a foot takes hold of the ground
_RIGID = 1e-3  # m; a body whose place in the frame of one of the robot's varies less moves with it


@dataclass(frozen=True)
class Repair:
    """A repaired motion, and what inverse kinematics could not do.

    Examples:
        >>> from dataclasses import replace
        >>> from hdmi.motion import find_motion, load_motion
        >>> walk = load_motion(find_motion("walk"))
        >>> short = replace(walk, **{key: value[:5] for key, value in vars(walk).items() if np.ndim(value) > 1})
        >>> repaired = repair_motion(short)
        >>> repaired.motion.num_frames, repaired.unsolved
        (5, [])
    """

    motion: Motion
    planted: dict[str, float]  # share of the frames in which each foot stands
    unsolved: list[int]  # frames without a solution: they have the pose of the one before


def repair_motion(
    motion: Motion,
    *,
    robot: RobotConfig | None = None,
    object: ObjectConfig | None = None,
    scenery: Sequence[SceneryConfig] = (),
    effectors: Sequence[Effector] = (),
    press: float = 0.01,
    tolerance: float = 0.0,
    reduce: str = "mean",
    on_frame: Callable[[int, int], None] | None = None,
) -> Repair:
    """Mends floating and sliding feet, effectors that miss their contact points, and an object off its support.

    Names, rate, labels and contact points stay; velocities are those of the new poses. Joints that the robot of the
    task holds, or that the motion lacks, are at its default pose.

    Args:
        press: how deep effectors are in the object while contact is labelled, m.
        tolerance, reduce: of the task's interaction reward, as for `hdmi.workshop.validate.validate_motion`.
        on_frame: called with how many of how many frames are solved, all passes together.

    Raises:
        ImportError: without the extra `retarget`.
        MotionError: if motion and task do not fit together.
        ConfigError: for another robot than the G1.
    """
    robot = robot or RobotConfig()
    if robot.model != g1_robot():
        raise ConfigError(f"robot.model: motions are repaired for the G1, not for {robot.model.name}")
    if effectors and motion.object_contact is None:
        raise MotionError(f"motion {motion.name!r}: has no object_contact labels; annotate it first")
    absent = [name for name in g1.JOINT_NAMES if name not in motion.joint_names]
    robot = replace(robot, held=[*robot.held_joints, *absent])
    points = replace(robot, feet="sphere")  # points tell a foot on its toes from one on its sole
    playback = make_playback(motion, robot=points, object=object, scenery=scenery, effectors=effectors)
    thing = settled_object(playback) if object is not None else None
    playback = _placed(playback, thing)
    reference = _robot_qpos(playback)
    reference[:, 2] += lowering(playback)
    playback = _placed(playback, qpos=reference)
    feet = {foot: foot_path(playback, foot, _pushing(playback, foot)) for foot in g1.FEET}
    hands = reaches(playback, object, press, tolerance, reduce) if object is not None and effectors else []
    com = _centre_of_mass(playback)

    def solved(near: list[ik.Target], com: ik.ComTarget, hands: list[Reach], done: int) -> ik.IkResult:
        return ik.solve(
            [*near, com, *_touching(playback, feet, hands)],
            motion.num_frames,
            motion.fps,
            initial=reference[0],
            obstacles=_obstacles(playback, object, thing, scenery, hands, press),
            options=ik.IkOptions(floor=0.0, limit_margin=0.0, smoothing=_SMOOTHING, self_collision=0.0),
            robot=robot,
            on_frame=None if on_frame is None else lambda t: on_frame(done + t + 1, 2 * motion.num_frames),
        )

    first = solved(_near(reference, 1.0), _over(com, 1.0), hands, 0)
    change = _change(first.qpos, reference)
    smooth = gaussian_filter1d(change, _SPREAD * motion.fps, axis=0, mode="nearest")
    shift = balance_shift(playback, feet, object, _changed(reference, smooth))
    com[:, :2] += shift
    smooth[:, :2] += shift
    if tolerance == 0:
        hands = pressed(_placed(playback, qpos=first.qpos), hands, press)
    second = solved(_near(_changed(reference, smooth), _FOLLOW), _over(com, _FOLLOW), hands, motion.num_frames)
    qpos = _changed(reference, _calmed(_change(second.qpos, reference), motion.fps))
    qpos[:, 7:] = np.clip(qpos[:, 7:], *np.array(g1.JOINT_RANGES).T)
    held = np.isin(g1.JOINT_NAMES, robot.held_joints)
    qpos[:, 7:][:, held] = robot.default_joint_pos[held]
    planted = {foot: float(path.planted.mean()) for foot, path in feet.items()}
    unsolved = np.union1d(first.failures, second.failures).tolist()
    return Repair(_repaired(motion, object, thing, robot, qpos), planted, unsolved)


def _placed(playback: Playback, thing: Poses | None = None, qpos: np.ndarray | None = None) -> Playback:
    """The playback with its object or its robot elsewhere. [T, 3], [T, 4]; [T, 36]"""
    scene, placed = playback.scene, playback.qpos.copy()
    if qpos is not None:
        placed[:, :7], placed[:, scene.joint_qpos] = qpos[:, :7], qpos[:, 7:]
    if thing is not None and (q := scene.object_free_qpos) is not None:
        placed[:, q : q + 3], placed[:, q + 3 : q + 7] = thing
    return replace(playback, qpos=placed)


def _robot_qpos(playback: Playback) -> np.ndarray:
    """Of the robot alone. [T, 36]"""
    return np.column_stack([playback.qpos[:, :7], playback.qpos[:, playback.scene.joint_qpos]])


def _pushing(playback: Playback, body: str) -> np.ndarray:
    """Frames in which a body is to touch the object. bool [T]"""
    columns = [e for e, effector in enumerate(playback.scene.effectors) if effector.body == body]
    pushing: np.ndarray = playback.reference.contact.numpy()[:, columns].sum(axis=1) > 0
    return pushing


def _near(qpos: np.ndarray, weight: float) -> list[ik.Target]:
    """Targets near a path of the robot. [T, 36]"""
    _, quat = forward_kinematics(g1_robot(), qpos[:, :3], qpos[:, 3:7], qpos[:, 7:])
    return [
        ik.PointTarget("pelvis", qpos[:, :3], weight * _PELVIS),
        ik.OrientationTarget("pelvis", qpos[:, 3:7], weight * _PELVIS_TURN),
        ik.OrientationTarget("torso_link", quat[:, g1.BODY_NAMES.index("torso_link")], weight * _TORSO_TURN),
        ik.PostureTarget(qpos[:, 7:], weight * _POSTURE),
    ]


def _over(com: np.ndarray, weight: float) -> ik.ComTarget:
    """The centre of mass over the ground where it should be; its height follows from the rest. [T, 3]"""
    return ik.ComTarget(com, (weight * _BALANCE, weight * _BALANCE, 0.0))


def _centre_of_mass(playback: Playback) -> np.ndarray:
    """The robot's, m. [T, 3]"""
    model, out = playback.scene.model, np.empty((playback.num_frames, 3))
    for t, data in enumerate(playback.frames()):
        mujoco.mj_comPos(model, data)
        out[t] = data.subtree_com[model.body(g1.BODY_NAMES[0]).id]
    return out


def _change(qpos: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """What a path of the robot differs from the reference by: place, rotation vector and joints. [T, 36] -> [T, 35]"""
    before, after = (Rotation.from_quat(path[:, 3:7], scalar_first=True) for path in (reference, qpos))
    turn = (after * before.inv()).as_rotvec()
    return np.column_stack([qpos[:, :3] - reference[:, :3], turn, qpos[:, 7:] - reference[:, 7:]])


def _changed(reference: np.ndarray, change: np.ndarray) -> np.ndarray:
    """The inverse of `_change`."""
    turned = Rotation.from_rotvec(change[:, 3:6]) * Rotation.from_quat(reference[:, 3:7], scalar_first=True)
    place, joints = reference[:, :3] + change[:, :3], reference[:, 7:] + change[:, 6:]
    return np.column_stack([place, turned.as_quat(scalar_first=True), joints])


def _calmed(change: np.ndarray, fps: float) -> np.ndarray:
    """The change without jolts, where a contact stops the robot within a frame: smoothed around them. [T, 35]"""
    limit = np.repeat([_JOLT[0], _JOLT[1]], [3, change.shape[1] - 3])
    for _ in range(_CALMINGS):
        jolts = (np.abs(np.diff(change, 2, axis=0)) * fps**2 > limit).any(axis=1)
        if not jolts.any():
            break
        near = distance_transform_edt(~np.pad(jolts, 1)) / (3 * _SPREAD * fps)
        smooth = gaussian_filter1d(change, _SPREAD * fps, axis=0, mode="nearest")
        change = change + minimum_jerk(1.5 - near)[:, None] * (smooth - change)
    return change


def _touching(playback: Playback, feet: dict[str, FootPath], hands: Sequence[Reach]) -> list[ik.Target]:
    """Targets of the feet and of the end effectors."""
    targets: list[ik.Target] = []
    effectors = playback.scene.effectors
    pairs = list(zip(effectors, hands, strict=True)) if hands else []
    for foot, path in feet.items():
        free = np.ones(playback.num_frames)
        for effector, hand in pairs:
            if effector.body == foot:
                free = np.minimum(free, 1 - hand.share)
        place = free * _SWING + _ramped(path.planted, playback.fps) * (ik.PLANTED_WEIGHT[0] - free * _SWING)
        turn = free * _SWING_TURN + _ramped(path.flat, playback.fps) * (ik.PLANTED_WEIGHT[1] - free * _SWING_TURN)
        targets += [
            ik.PointTarget(foot, path.toe, place[:, None], TOE),
            ik.OrientationTarget(foot, path.rotation.as_quat(scalar_first=True), turn[:, None]),
        ]
    for e, (effector, hand) in enumerate(pairs):
        name = f"effector {e}"
        targets.append(ik.PointTarget(effector.body, hand.pos, _REACH * hand.share[:, None], effector.point, name))
    return targets


def _ramped(mask: np.ndarray, fps: float) -> np.ndarray:
    """A mask with soft edges outside of it. [T] in 0..1"""
    if not mask.any():
        return np.zeros(len(mask))
    return minimum_jerk(1 - distance_transform_edt(~mask) / (_RAMP * fps))


def _obstacles(
    playback: Playback,
    object: ObjectConfig | None,
    thing: Poses | None,
    scenery: Sequence[SceneryConfig],
    hands: Sequence[Reach],
    press: float,
) -> list[ik.Obstacle]:
    """The object, into which effectors may be pressed, and the scenery."""
    out = []
    for item in scenery:
        pos, quat = playback.reference.placements.get(item.name, (item.pos, item.quat))
        assert pos is not None
        out.append(ik.Obstacle(item.name, item.geoms, pos, quat))
    if object is not None and thing is not None:
        angle = playback.reference.object_joint_pos.numpy()
        trajectory = ObjectTrajectory(object.name, *thing, angle[:, 0] if angle.shape[1] else None)
        pairs = zip(playback.scene.effectors, hands, strict=False)
        yields = {effector.body: (effector.press + press) * hand.share for effector, hand in pairs}
        out += [replace(obstacle, yields=yields) for obstacle in obstacles(object, trajectory)]
    return out


def _repaired(
    motion: Motion, object: ObjectConfig | None, thing: Poses | None, robot: RobotConfig, qpos: np.ndarray
) -> Motion:
    """The motion with the new poses of the robot, of bodies that are rigid with it, and of the object."""
    new_pos, new_quat = forward_kinematics(robot.model, qpos[:, :3], qpos[:, 3:7], qpos[:, 7:])
    pos, quat = motion.body_pos_w.astype(float), motion.body_quat_w.astype(float)
    carriers = _carriers(motion)
    for i, name in enumerate(motion.body_names):
        if name in g1.BODY_NAMES:
            b = g1.BODY_NAMES.index(name)
            pos[:, i], quat[:, i] = new_pos[:, b], new_quat[:, b]
        elif object is not None and thing is not None and name == object.name:
            pos[:, i], quat[:, i] = thing
        elif name in carriers:
            column = motion.body_names.index(carriers[name])
            before = Rotation.from_quat(motion.body_quat_w[:, column], scalar_first=True)
            b = g1.BODY_NAMES.index(carriers[name])
            turn = Rotation.from_quat(new_quat[:, b], scalar_first=True) * before.inv()
            pos[:, i] = new_pos[:, b] + turn.apply(motion.body_pos_w[:, i] - motion.body_pos_w[:, column])
            quat[:, i] = (turn * Rotation.from_quat(quat[:, i], scalar_first=True)).as_quat(scalar_first=True)
    joint_pos = motion.joint_pos.astype(float)
    for i, name in enumerate(motion.joint_names):
        if name in g1.JOINT_NAMES:
            joint_pos[:, i] = qpos[:, 7 + g1.JOINT_NAMES.index(name)]
    repaired = motion_from_poses(
        motion.name,
        motion.fps,
        motion.body_names,
        motion.joint_names,
        pos,
        quat,
        joint_pos,
        motion.object_contact,
        motion.contact_points,
    )
    if motion.joint_target is None:
        return repaired
    target = motion.joint_target + repaired.joint_pos - motion.joint_pos
    return replace(repaired, joint_target=target.astype(np.float32))


def _carriers(motion: Motion) -> dict[str, str]:
    """The robot's body that each of the other bodies that move rigidly with one moves with."""
    robot = [name for name in motion.body_names if name in g1.BODY_NAMES]
    columns = [motion.body_names.index(name) for name in robot]
    out = {}
    for i, name in enumerate(motion.body_names):
        if name in robot or np.ptp(motion.body_pos_w[:, i], axis=0).max() < _RIGID:
            continue
        spread = []
        for column in columns:
            inverse = Rotation.from_quat(motion.body_quat_w[:, column], scalar_first=True).inv()
            local = inverse.apply(motion.body_pos_w[:, i] - motion.body_pos_w[:, column])
            spread.append(np.ptp(local, axis=0).max())
        if min(spread) < _RIGID:
            out[name] = robot[int(np.argmin(spread))]
    return out
