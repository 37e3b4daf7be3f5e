"""The person's body on the robot's proportions: a scale for the scene, and the robot's length for every limb."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

from hdmi.assets import g1, g1_robot
from hdmi.motion.check import MotionError
from hdmi.motion.kinematics import forward_kinematics
from hdmi.workshop.human import SMPL_JOINTS, HumanMotion
from hdmi.workshop.skeleton import UPRIGHT

SIDES = ("left", "right")
# What the robot has in place of a joint of the person: origins of bodies, near where its axes meet.
ROBOT_JOINTS = {
    "hip": "hip_roll_link",
    "knee": "knee_link",
    "ankle": "ankle_roll_link",
    "shoulder": "shoulder_roll_link",
    "elbow": "elbow_link",
    "wrist": "wrist_pitch_link",
}
PALM = (0.08, 0.0, 0.0)  # in wrist_yaw_link
TOE = (0.12, 0.0, -0.03)  # between the front contact spheres, in ankle_roll_link
HEEL = (-0.05, 0.0, -0.03)
SOLE_HEIGHT = -g1.FOOT_POINTS[0][2] + g1.FOOT_POINT_RADIUS  # of the ankle's origin above the ground, m
_PALM_SHARE = 0.054  # from wrist to palm in shares of the height: half a hand (Winter, figure 4.1)
_ANKLE_SHARE = 0.039  # of the ankle above the sole (Winter, figure 4.1)
_POINTED = 0.3  # sine of the angle between foot and shank from which on the foot is in line with it
_EXTENSION = 0.985  # of a leg's length, at most: a straight knee is singular
_REQUIRED = ("pelvis", *(f"{side}_{part}" for side in SIDES for part in ROBOT_JOINTS))


@dataclass(frozen=True)
class Robot:
    """The robot's measures at zero joint angles, left side; the right mirrors them."""

    hip: np.ndarray  # in the pelvis's frame, m. [3]
    shoulder: np.ndarray  # in the torso's frame. [3]
    torso: np.ndarray  # in the pelvis's frame. [3]
    thigh: float
    shank: float
    upper_arm: float
    forearm: float
    hand: float  # from wrist to palm

    @property
    def leg(self) -> float:
        return self.thigh + self.shank


@lru_cache(maxsize=1)
def robot_measures() -> Robot:
    """The robot's measures from its table."""
    pos, _ = forward_kinematics(
        g1_robot(), np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]]), np.zeros((1, len(g1.JOINTS)))
    )
    at = {name: pos[0, g1.BODY_NAMES.index(f"left_{body}")] for name, body in ROBOT_JOINTS.items()}
    torso = pos[0, g1.BODY_NAMES.index("torso_link")]
    palm = pos[0, g1.BODY_NAMES.index("left_wrist_yaw_link")] + PALM

    def distance(first: np.ndarray, second: np.ndarray) -> float:
        return float(np.linalg.norm(first - second))

    return Robot(
        hip=at["hip"],
        shoulder=at["shoulder"] - torso,
        torso=torso,
        thigh=distance(at["hip"], at["knee"]),
        shank=distance(at["knee"], at["ankle"]),
        upper_arm=distance(at["shoulder"], at["elbow"]),
        forearm=distance(at["elbow"], at["wrist"]),
        hand=distance(at["wrist"], palm),
    )


@dataclass(frozen=True)
class Body:
    """A person's motion, low-pass filtered, with the orientations that the robot's parts should have."""

    pos: dict[str, np.ndarray]  # joints by name; "<side>_palm", and "<side>_toe" if there is a foot joint. [T, 3]
    pelvis: Rotation
    torso: Rotation
    hands: dict[str, Rotation]  # by side
    hands_turn: bool  # whether the hands' roll about the forearm is known
    foot_pitch: dict[str, np.ndarray]  # by side, nose down, rad. [T]
    foot_yaw: dict[str, np.ndarray]  # [T]


def read_body(human: HumanMotion, cutoff: float) -> Body:
    """Filters a person's motion and finds the orientations of pelvis, torso, hands and feet.

    They come from `joint_quat` where it is given, else from the positions of the joints.

    Raises:
        MotionError: if joints are missing, or coincide.
    """
    missing = [name for name in _REQUIRED if name not in human.joint_names]
    if missing:
        others = ", ".join(name for name in human.joint_names if name not in SMPL_JOINTS)
        hint = f"; of joints with other names it has {others} (names=FILE maps a BVH's)" if others else ""
        raise MotionError(f"motion {human.name!r}: retargeting needs the joints {missing}{hint}")
    smooth = low_pass(human.joint_pos.astype(float), human.fps, cutoff)
    pos = {name: smooth[:, i] for i, name in enumerate(human.joint_names)}
    quat = {}
    if human.joint_quat is not None:
        quat = {name: human.joint_quat[:, i].astype(float) for i, name in enumerate(human.joint_names)}

    def known(joint: str, change: Rotation) -> Rotation | None:
        if joint not in quat:
            return None
        return low_pass_rotation(Rotation.from_quat(quat[joint], scalar_first=True) * change, human.fps, cutoff)

    hips, shoulders = ((pos[f"left_{part}"] + pos[f"right_{part}"]) / 2 for part in ("hip", "shoulder"))
    trunk = shoulders - hips
    rise = pos["pelvis"] - hips  # a pelvis joint above the hips tells how the pelvis leans, else the trunk does
    above = np.median((rise * trunk).sum(-1)) > 0.03 * human.height * np.median(np.linalg.norm(trunk, axis=-1))
    pelvis = known("pelvis", UPRIGHT.inv()) or _frame(
        human.name, pos["left_hip"] - pos["right_hip"], rise if above else trunk
    )
    torso = known("spine3", UPRIGHT.inv()) or _frame(human.name, pos["left_shoulder"] - pos["right_shoulder"], trunk)
    hands = {}
    for side, mirror in (("left", Rotation.identity()), ("right", Rotation.from_euler("z", np.pi))):
        forearm = pos[f"{side}_wrist"] - pos[f"{side}_elbow"]
        hands[side] = known(f"{side}_wrist", mirror) or _along(human.name, forearm, torso)
        pos[f"{side}_palm"] = pos[f"{side}_wrist"] + _PALM_SHARE * human.height * hands[side].as_matrix()[:, :, 0]
    foot_pitch, foot_yaw = {}, {}
    for side in SIDES:
        foot_pitch[side], foot_yaw[side] = _foot_angles(pos, side, pelvis)
    return Body(pos, pelvis, torso, hands, "left_wrist" in quat, foot_pitch, foot_yaw)


def low_pass(values: np.ndarray, fps: float, cutoff: float) -> np.ndarray:
    """Values without what is faster than `cutoff` Hz, and without delay (Butterworth, there and back). [T, ...]"""
    if cutoff >= fps / 2:
        return values
    sections = butter(2, cutoff, fs=fps, output="sos")
    return sosfiltfilt(sections, values, axis=0, padlen=min(int(fps / cutoff * 2), len(values) - 1))


def low_pass_rotation(rotation: Rotation, fps: float, cutoff: float) -> Rotation:
    """As `low_pass`, of rotation matrices, made orthogonal again."""
    return Rotation.from_matrix(low_pass(rotation.as_matrix(), fps, cutoff))


def _frame(name: str, left: np.ndarray, up: np.ndarray) -> Rotation:
    """Orientations whose y is `left` and whose z is nearest to `up`. [T, 3], [T, 3]"""
    y = _unit(name, left)
    x = _unit(name, np.cross(y, up))
    return Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], axis=-1))


def _along(name: str, forward: np.ndarray, like: Rotation) -> Rotation:
    """Orientations whose x is `forward`, turned about it as little as possible from an arm that hangs from `like`."""
    x = _unit(name, forward)
    hanging = like.as_matrix() @ Rotation.from_euler("y", np.pi / 2).as_matrix()
    axis = np.cross(hanging[:, :, 0], x)
    sine, cosine = np.linalg.norm(axis, axis=-1), (hanging[:, :, 0] * x).sum(-1)
    axis = np.where(sine[:, None] > 1e-6, axis / np.maximum(sine, 1e-6)[:, None], hanging[:, :, 1])
    return Rotation.from_rotvec(np.arctan2(sine, cosine)[:, None] * axis) * Rotation.from_matrix(hanging)


def _unit(name: str, vectors: np.ndarray) -> np.ndarray:
    norms = np.linalg.norm(vectors, axis=-1, keepdims=True)
    if (bad := np.flatnonzero(norms[:, 0] < 1e-4)).size:
        raise MotionError(f"motion {name!r}: joint_pos: joints coincide at frame {bad[0]}")
    return vectors / norms


def _foot_angles(pos: dict[str, np.ndarray], side: str, pelvis: Rotation) -> tuple[np.ndarray, np.ndarray]:
    """Pitch relative to the foot at rest on the ground, and yaw; without a foot joint flat, along the pelvis.

    The axis about which the foot turns against the shank tells its heading: its toes do not when it is steep, and
    point backwards where somebody kneels on their tips. So its pitch can exceed a right angle.
    """
    left = pelvis.as_matrix()[:, :, 1]
    bends = f"{side}_foot" in pos
    if bends:
        toes = _direction(pos, f"{side}_ankle", f"{side}_foot")
        axis = np.cross(_direction(pos, f"{side}_ankle", f"{side}_knee"), toes)
        # a foot in line with its shank has none
        left = axis + np.maximum(_POINTED - np.linalg.norm(axis, axis=-1, keepdims=True), 0.0) * left
    yaw = np.unwrap(np.arctan2(-left[:, 0], left[:, 1]))
    if not bends:
        return np.zeros(len(yaw)), yaw
    pitch = np.unwrap(np.arctan2(-toes[:, 2], toes[:, 0] * np.cos(yaw) + toes[:, 1] * np.sin(yaw)))
    low = pos[f"{side}_ankle"][:, 2] <= np.percentile(pos[f"{side}_ankle"][:, 2], 30)
    return pitch - np.median(pitch[low]), yaw


@dataclass(frozen=True)
class Scaling:
    """From the person's scene to the robot's: lengths by `scale`, heights so that both stand on the ground."""

    scale: float
    ankle_height: float  # of the standing person, m

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Points of the body. [..., 3]"""
        scaled = points * self.scale
        scaled[..., 2] += SOLE_HEIGHT - self.scale * self.ankle_height
        return scaled


def find_scaling(human: HumanMotion, body: Body, flat: dict[str, np.ndarray], scale: float | None) -> Scaling:
    """The scale that makes the person's legs as long as the robot's, or the one given.

    Args:
        flat: frames in which a foot stands flat, by side. bool [T]
    """
    heights = np.concatenate([body.pos[f"{side}_ankle"][flat[side], 2] for side in SIDES])
    heights = heights[heights < 0.15]
    ankle_height = float(np.median(heights)) if heights.size else _ANKLE_SHARE * human.height
    if scale is None:
        lengths = [limb_length(body, side, ("hip", "knee", "ankle")) for side in SIDES]
        scale = robot_measures().leg / float(np.mean(lengths))
    return Scaling(scale, ankle_height)


def limb_length(body: Body, side: str, joints: tuple[str, ...]) -> float:
    """Median over time of a limb's length, m."""
    points = [body.pos[f"{side}_{joint}"] for joint in joints]
    bones = [np.linalg.norm(b - a, axis=-1) for a, b in pairwise(points)]
    return float(np.median(np.sum(bones, axis=0)))


@dataclass(frozen=True)
class Keypoints:
    """Where points of the robot should be, world frame, m. [T, 3]"""

    pelvis: np.ndarray  # the body's origin
    knees: dict[str, np.ndarray]
    elbows: dict[str, np.ndarray]
    palms: dict[str, np.ndarray]


def keypoints(body: Body, scaling: Scaling, ankles: dict[str, np.ndarray], fps: float) -> Keypoints:
    """The person's pose with the robot's limbs: pelvis by the scene's scale, the rest along the limbs' directions.

    The pelvis is lowered where legs would not reach the ankles.

    Args:
        ankles: where the robot's ankles should be, by side. [T, 3]
    """
    robot = robot_measures()
    middle = np.array([robot.hip[0], 0.0, robot.hip[2]])
    pelvis = scaling((body.pos["left_hip"] + body.pos["right_hip"]) / 2) - body.pelvis.apply(middle)
    pelvis[:, 2] -= _overreach(body, pelvis, ankles, fps)
    torso = pelvis + body.pelvis.apply(robot.torso)
    knees, elbows, palms = {}, {}, {}
    for side, mirror in zip(SIDES, ([1, 1, 1], [1, -1, 1]), strict=True):
        hip = pelvis + body.pelvis.apply(robot.hip * mirror)
        knees[side] = hip + robot.thigh * _direction(body.pos, f"{side}_hip", f"{side}_knee")
        shoulder = torso + body.torso.apply(robot.shoulder * mirror)
        elbows[side] = shoulder + robot.upper_arm * _direction(body.pos, f"{side}_shoulder", f"{side}_elbow")
        wrist = elbows[side] + robot.forearm * _direction(body.pos, f"{side}_elbow", f"{side}_wrist")
        palms[side] = wrist + robot.hand * body.hands[side].as_matrix()[:, :, 0]
    return Keypoints(pelvis, knees, elbows, palms)


def _direction(pos: dict[str, np.ndarray], start: str, end: str) -> np.ndarray:
    bone = pos[end] - pos[start]
    return bone / np.maximum(np.linalg.norm(bone, axis=-1, keepdims=True), 1e-6)


def _overreach(body: Body, pelvis: np.ndarray, ankles: dict[str, np.ndarray], fps: float) -> np.ndarray:
    """How far the pelvis must come down for both legs to reach, smooth in time, m. [T]"""
    robot = robot_measures()
    drops = np.zeros(len(pelvis))
    for side, mirror in zip(SIDES, ([1, 1, 1], [1, -1, 1]), strict=True):
        leg = pelvis + body.pelvis.apply(robot.hip * mirror) - ankles[side]
        reach = (_EXTENSION * robot.leg) ** 2 - (leg[:, :2] ** 2).sum(-1)
        drops = np.maximum(drops, leg[:, 2] - np.sqrt(np.maximum(reach, 0.0)))
    window = max(round(0.1 * fps), 1)
    return gaussian_filter1d(maximum_filter1d(drops, 2 * window + 1), window / 2)
