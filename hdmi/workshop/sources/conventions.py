"""What the numbers of a robot's file mean: order of quaternions, units, the axis that points up, the ground.

Files do not say. What a format usually has is taken, unless the caller knows better, and then the robot is looked at:
one that stands on its head, whose joints are bent beyond what joints can do or that hangs in the air is refused, with
the option that would put it right. What the caller says is believed.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from hdmi.assets import default_joint_pos, g1, g1_robot
from hdmi.motion.check import MotionError
from hdmi.motion.format import Motion
from hdmi.motion.kinematics import angular_velocity, forward_kinematics, robot_model

_CHOICES = {
    "quat": ("xyzw", "wxyz"),
    "angles": ("radians", "degrees"),
    "up": ("z", "y", "x", "-z", "-y", "-x"),
    "ground": ("shift", "keep"),
}
# what turns an axis of the file into z
_TO_Z = {
    "z": Rotation.identity(),
    "y": Rotation.from_euler("x", 90, degrees=True),
    "x": Rotation.from_euler("y", -90, degrees=True),
    "-z": Rotation.from_euler("x", 180, degrees=True),
    "-y": Rotation.from_euler("x", -90, degrees=True),
    "-x": Rotation.from_euler("y", 90, degrees=True),
}
_MAX_FRAMES = 200  # that are looked at
_UPRIGHT, _LEANS = 30.0, 45.0  # deg that the root is tilted, at most and at least
_LEANS_MORE = 10.0  # deg by which one order of quaternions must be worse than the other
_NEAR_GROUND = 0.1  # m
_WORTH_SAYING = 0.03  # m
_FAR_UP = 3.0  # m above ground: lengths are in another unit
_WALKS, _MOSTLY = 0.5, 0.7  # m of a way that tell a direction, and the share of them
_BENT = 1.0  # rad beyond a joint's range that no robot's joint goes


@dataclass(frozen=True)
class Conventions:
    """How a file means its numbers. None: as its format usually does, and checked.

    Args:
        quat: order of quaternions, `xyzw` or `wxyz`.
        angles: of joints, `radians` or `degrees`.
        unit: of lengths, m; 0.01 for centimetres.
        up: the axis of the file's world that points up: x, y, z, -x, -y or -z.
        ground: `shift` moves the motion vertically until the robot's lowest point touches z = 0, `keep` leaves it.

    Raises:
        MotionError: for any other value.

    Examples:
        >>> Conventions(angles="degrees").radians(np.array([180.0, 90.0]))
        array([3.14159265, 1.57079633])
        >>> Conventions(quat="xyzw").wxyz(np.array([0.0, 0.0, 0.0, 1.0]), usual="wxyz")
        array([1., 0., 0., 0.])
    """

    quat: str | None = None
    angles: str | None = None
    unit: float | None = None
    up: str | None = None
    ground: str | None = None

    def __post_init__(self) -> None:
        for key, choices in _CHOICES.items():
            if (value := getattr(self, key)) not in (None, *choices):
                raise MotionError(f"{key}={value}: there is {', '.join(choices)}")
        if self.unit is not None and not 1e-6 < self.unit < 1e3:
            raise MotionError(f"unit={self.unit:g}: how long the file's unit of length is in m, such as 0.01")

    def wxyz(self, quat: np.ndarray, usual: str) -> np.ndarray:
        """Quaternions in the file's order, `usual` unless said otherwise, as wxyz. [..., 4]"""
        return np.roll(quat, 1, axis=-1) if (self.quat or usual) == "xyzw" else quat

    def radians(self, angles: np.ndarray) -> np.ndarray:
        """Angles or their velocities in the file's unit as radians."""
        return np.deg2rad(angles) if self.angles == "degrees" else angles

    def metres(self, lengths: np.ndarray) -> np.ndarray:
        """Lengths or their velocities in the file's unit as metres."""
        return lengths if self.unit in (None, 1.0) else lengths * self.unit


def reread(motion: Motion, given: Conventions) -> Motion:
    """A motion that was read as wxyz, radians and metres, read as the caller says instead.

    With another order of quaternions, angular velocities are differences of the orientations.
    """
    if given.quat == "xyzw":
        quat = given.wxyz(motion.body_quat_w, "wxyz")
        ang_vel = angular_velocity(quat, motion.fps).astype(np.float32)
        motion = replace(motion, body_quat_w=quat, body_ang_vel_w=ang_vel)
    if given.angles == "degrees":
        motion = replace(
            motion,
            joint_pos=given.radians(motion.joint_pos),
            joint_vel=given.radians(motion.joint_vel),
            joint_target=None if motion.joint_target is None else given.radians(motion.joint_target),
        )
    if given.unit is not None:
        motion = replace(
            motion,
            body_pos_w=given.metres(motion.body_pos_w),
            body_lin_vel_w=given.metres(motion.body_lin_vel_w),
            contact_points=None if motion.contact_points is None else given.metres(motion.contact_points),
        )
    return motion


def settle(
    motion: Motion,
    where: object,
    given: Conventions,
    *,
    usual: str = "wxyz",
    fields: tuple[str, str, str] = ("body_pos_w", "body_quat_w", "joint_pos"),
    has_scenery: bool = False,
) -> Motion:
    """The motion with z up and, if wished, put on the ground; quaternions, angles and units are as read.

    Args:
        where: what messages start with, such as the path of a file.
        usual: order of quaternions in this format.
        fields: what holds positions, orientations and joint angles there.
        has_scenery: the robot may stand on something: its height is not looked at.

    Raises:
        MotionError: if the robot would stand upright and does not, under what was not given: order of quaternions,
            axis; if its joints or its height are out of reach.
    """
    if "pelvis" not in motion.body_names:
        return motion
    frames = np.unique(np.linspace(0, motion.num_frames - 1, _MAX_FRAMES).astype(int))
    root = motion.body_names.index("pelvis")
    if given.angles is None:
        _check_angles(where, fields[2], motion)
    points, radii = _surface(motion, frames)
    pos, quat = motion.body_pos_w[frames, root].astype(float), motion.body_quat_w[frames, root].astype(float)
    readings = _readings(given, usual, pos, quat, points, radii)
    _check_upright(f"{where}: {fields[1]}", readings, given, has_scenery)
    if given.up not in (None, "z"):
        motion = _turned(motion, _TO_Z[given.up])
    if given.ground == "shift":
        every = np.arange(motion.num_frames)
        pos, quat = motion.body_pos_w[:, root].astype(float), motion.body_quat_w[:, root].astype(float)
        lowest = _lowest(*_surface(motion, every), pos, quat)
        # a few frames may dip in
        offset = np.array([0.0, 0.0, np.percentile(lowest, 1)])
        return replace(motion, body_pos_w=(motion.body_pos_w - offset).astype(np.float32))
    if not has_scenery and given.ground is None:
        _check_height(f"{where}: {fields[0]}", readings[0], given)
    return motion


@dataclass(frozen=True)
class _Reading:
    """The robot as one way to read the file has it."""

    options: dict[str, str]  # other than as read
    tilt: np.ndarray  # of the root from upright, deg [F]
    height: np.ndarray  # of the root, m [F]
    lowest: np.ndarray  # height of the robot's lowest point, m [F]
    forward: float  # share of the way, while it walks, that it faces; nan if it does not

    @property
    def on_ground(self) -> float:
        """Share of the frames in which it touches the ground, about."""
        return float((np.abs(self.lowest) < _NEAR_GROUND).mean())

    @property
    def leans(self) -> float:
        return float(np.median(self.tilt))


def _readings(
    given: Conventions, usual: str, pos: np.ndarray, quat: np.ndarray, points: np.ndarray, radii: np.ndarray
) -> list[_Reading]:
    """As read, then all others that the caller did not rule out."""
    order, axis = given.quat or usual, given.up or "z"
    orders = [order] + [o for o in _CHOICES["quat"] if given.quat is None and o != order]
    axes = [axis] + [a for a in _CHOICES["up"] if given.up is None and a != axis]
    found = []
    for o, a in product(orders, axes):
        turn = _TO_Z[a]
        # the file's numbers, in its order, then in the other
        raw = quat if order == "wxyz" else np.roll(quat, -1, axis=-1)
        moved = turn.apply(pos)
        turned = turn * Rotation.from_quat(raw, scalar_first=o == "wxyz")
        up = turned.as_matrix()[:, 2]
        options = {key: value for key, value, own in (("quat", o, order), ("up", a, axis)) if value != own}
        tilt = np.rad2deg(np.arccos(np.clip(up[:, 2], -1, 1)))
        lowest = _lowest(points, radii, moved, turned.as_quat(scalar_first=True))
        found.append(_Reading(options, tilt, moved[:, 2], lowest, _forward(moved, turned)))
    return found


def _forward(pos: np.ndarray, turn: Rotation) -> float:
    steps = np.diff(pos[:, :2], axis=0)
    length = np.linalg.norm(steps, axis=-1).sum()
    if length < _WALKS:
        return float("nan")
    return float((steps * turn.as_matrix()[:-1, :2, 0]).sum() / length)


def _check_upright(where: str, readings: Sequence[_Reading], given: Conventions, has_scenery: bool) -> None:
    own, *others = readings
    better = []
    for other in others:
        if other.leans > _UPRIGHT or own.leans < other.leans + _LEANS_MORE:
            continue
        if other.options.keys() == {"quat"}:
            fits = True
        else:
            # where the robot may lie on something, or the order of quaternions is sure, the ground has to tell
            sure = has_scenery or given.quat is not None
            fits = own.leans > _LEANS and (not sure or other.on_ground >= 0.5 > own.on_ground)
        # a robot that lies does so on the ground
        if fits and (own.on_ground < 0.5 or other.on_ground > own.on_ground - 0.2):
            better.append(other)
    if not better:
        walks = [other for other in others if other.options.keys() == {"quat"} and other.leans < _UPRIGHT]
        if walks and own.forward < -_MOSTLY and walks[0].forward > _MOSTLY:
            turned = walks[0].options["quat"]
            warnings.warn(
                f"{where}: the robot walks backwards; if it should walk ahead, give quat={turned}", stacklevel=3
            )
        return
    best = min(better, key=lambda other: (other.on_ground < 0.5, len(other.options), -other.on_ground))
    advice = " ".join(f"{key}={value}" for key, value in best.options.items())
    usual = {"quat": "xyzw" if best.options.get("quat") == "wxyz" else "wxyz", "up": given.up or "z"}
    as_read = " ".join(f"{key}={usual[key]}" for key in best.options)
    how = "is upside down" if own.leans > 120 else "lies" if own.leans > _LEANS else "leans"
    raise MotionError(
        f"{where}: the robot {how} (tilted by {own.leans:.0f} deg in the median frame) and "
        f"stands upright with {advice}: give that, or {as_read} if it is meant as it is"
    )


def _check_height(where: str, reading: _Reading, given: Conventions) -> None:
    median = float(np.median(reading.lowest))
    if given.unit is None and median > _FAR_UP:
        for unit, name in ((0.01, "centimetres"), (0.001, "millimetres")):
            if 0.05 < float(np.median(reading.height)) * unit < 1.6:
                raise MotionError(
                    f"{where}: the root is {np.median(reading.height):.0f} m above the ground in the median frame; "
                    f"if lengths are in {name}, give unit={unit:g}, else ground=shift or ground=keep"
                )
    low, high = np.percentile(reading.lowest, [5, 95])
    miss = float(low if low > 0 else min(high, 0.0))
    if abs(miss) < _WORTH_SAYING:
        return
    how = f"{'above' if miss > 0 else 'below'} the ground by {abs(miss):.2f} m or more"
    what = f"{where}: the robot's lowest point is {how} in nearly all frames"
    if miss < -_NEAR_GROUND and reading.leans < _LEANS:
        raise MotionError(f"{what}: ground=shift puts it there, ground=keep leaves it")
    # above there may be something to stand on
    warnings.warn(f"{what}; ground=shift would put it there", stacklevel=3)


def _check_angles(where: object, field: str, motion: Motion) -> None:
    names = [name for name in motion.joint_names if name in g1.JOINT_NAMES]
    angles = motion.joint_pos[:, [motion.joint_names.index(name) for name in names]]
    beyond = beyond_range(names, angles)
    if not beyond.size or beyond.max() < _BENT:
        return
    t, j = np.unravel_index(int(beyond.argmax()), beyond.shape)
    low, high = g1.JOINT_RANGES[g1.JOINT_NAMES.index(names[j])]
    fits = beyond_range(names, np.deg2rad(angles)).max() < _BENT / 2
    advice = "give angles=degrees, or angles=radians if it is meant as it is"
    other = "another robot's, or joints in another order; angles=radians takes it as it is"
    raise MotionError(
        f"{where}: {field}: {names[j]} is at {angles[t, j]:.2f} rad at frame {t}, beyond {low:.2f} to {high:.2f}: "
        + (f"in degrees all joints are within reach: {advice}" if fits else other)
    )


def beyond_range(names: Sequence[str], angles: np.ndarray) -> np.ndarray:
    """How far joints of the robot are beyond their ranges, rad, 0 within. [T, J]"""
    ranges = np.array([g1.JOINT_RANGES[g1.JOINT_NAMES.index(name)] for name in names]).reshape(-1, 2)
    return np.maximum(np.maximum(ranges[:, 0] - angles, angles - ranges[:, 1]), 0.0)


def _turned(motion: Motion, turn: Rotation) -> Motion:
    vectors = {}
    for key in ("body_pos_w", "body_lin_vel_w", "body_ang_vel_w"):
        values = getattr(motion, key)
        vectors[key] = turn.apply(values.reshape(-1, 3)).reshape(values.shape).astype(np.float32)
    quat = turn * Rotation.from_quat(motion.body_quat_w.reshape(-1, 4), scalar_first=True)
    shaped = quat.as_quat(scalar_first=True).reshape(motion.body_quat_w.shape).astype(np.float32)
    return replace(motion, body_quat_w=shaped, **vectors)


def _surface(motion: Motion, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres, in the root's frame, and radii of the spheres at the ends of the robot's collision shapes, m.

    [F, S, 3] and [S]
    """
    angles = np.tile(default_joint_pos(), (len(frames), 1))
    for i, name in enumerate(motion.joint_names):
        if name in g1.JOINT_NAMES:
            angles[:, g1.JOINT_NAMES.index(name)] = motion.joint_pos[frames, i]
    count = len(frames)
    pos, quat = forward_kinematics(g1_robot(), np.zeros((count, 3)), np.tile([1.0, 0, 0, 0], (count, 1)), angles)
    model = robot_model(g1_robot())
    points, radii = [], []
    for g in np.flatnonzero(model.geom_contype):
        body = model.geom_bodyid[g] - 1
        axis = Rotation.from_quat(model.geom_quat[g], scalar_first=True).apply([0.0, 0.0, 1.0])
        half = model.geom_size[g, 1] if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
        turn = Rotation.from_quat(quat[:, body], scalar_first=True)
        for end in {-half, half}:
            points.append(pos[:, body] + turn.apply(model.geom_pos[g] + end * axis))
            radii.append(model.geom_size[g, 0])
    return np.stack(points, axis=1), np.array(radii)


def _lowest(points: np.ndarray, radii: np.ndarray, pos: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """Height of the lowest point of a robot whose root is at a pose. [F]"""
    up = Rotation.from_quat(quat, scalar_first=True).as_matrix()[:, 2]
    return (pos[:, 2, None] + np.einsum("fsk,fk->fs", points, up) - radii).min(axis=1)
