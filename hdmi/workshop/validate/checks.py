"""The checks: each turns a motion in its scene into series of quantities that `LIMITS` bounds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import binary_erosion
from scipy.spatial.transform import Rotation

from hdmi.assets import g1
from hdmi.motion.dynamics import Dynamics
from hdmi.motion.format import Motion
from hdmi.motion.kinematics import derivative, forward_kinematics
from hdmi.motion.playback import FAR, TOUCH, Playback
from hdmi.workshop.annotate import label_contacts
from hdmi.workshop.validate.report import Series

_PLANTED = 0.01  # m; a foot's point this near the ground (or the height at which it stands) stands on it
_SWING = 0.7  # m/s
_AT_REST = 0.05  # m/s
_SETTLING = 2  # frames after landing and before taking off in which a foot may move


def consistency(motion: Motion, playback: Playback) -> dict[str, Series]:
    """Joints that are there, bodies against forward kinematics, velocities against differences of positions."""
    robot = [name for name in motion.body_names if name in g1.BODY_NAMES]
    rows, columns = [g1.BODY_NAMES.index(n) for n in robot], [motion.body_names.index(n) for n in robot]
    qpos = playback.qpos
    pos, quat = forward_kinematics(playback.scene.robot, qpos[:, :3], qpos[:, 3:7], qpos[:, playback.scene.joint_qpos])
    along = np.abs((quat[:, rows] * motion.body_quat_w[:, columns]).sum(-1))
    absent = sum(name not in motion.joint_names for name in g1.JOINT_NAMES)
    return {
        "missing_joints": Series(np.full((playback.num_frames, 1), float(absent)), ["robot"]),
        "fk_position": Series(np.linalg.norm(pos[:, rows] - motion.body_pos_w[:, columns], axis=-1), robot),
        "fk_orientation": Series(2 * np.arccos(np.minimum(along, 1.0)), robot),
        "joint_velocity_error": Series(
            _velocity_error(motion.joint_pos[..., None], motion.joint_vel[..., None], motion.fps), motion.joint_names
        ),
        "body_velocity_error": Series(_body_velocity_error(motion, robot), robot),
    }


def _body_velocity_error(motion: Motion, bodies: Sequence[str]) -> np.ndarray:
    """Of the bodies' origins or of their centres of mass, whose velocity some simulators write: what fits. [T, K]"""
    columns = [motion.body_names.index(name) for name in bodies]
    pos, quat = motion.body_pos_w[:, columns], motion.body_quat_w[:, columns]
    com = np.array([g1.BODIES[g1.BODY_NAMES.index(name)].com_pos for name in bodies])
    rotated = Rotation.from_quat(quat.reshape(-1, 4), scalar_first=True).apply(np.tile(com, (len(pos), 1)))
    velocity = motion.body_lin_vel_w[:, columns]
    errors = [_velocity_error(p, velocity, motion.fps) for p in (pos, pos + rotated.reshape(pos.shape))]
    return min(errors, key=lambda error: float(error.mean()))


def _velocity_error(pos: np.ndarray, vel: np.ndarray, fps: float) -> np.ndarray:
    """Distance of velocities from the nearest of forward, backward and central differences. [T, K, D] -> [T, K]"""
    pos = pos.astype(np.float64)
    step = np.diff(pos, axis=0) * fps
    forward, backward = np.concatenate([step, step[-1:]]), np.concatenate([step[:1], step])
    errors = [np.linalg.norm(vel - other, axis=-1) for other in (forward, backward, derivative(pos, fps))]
    return np.min(errors, axis=0)


def limits(playback: Playback) -> dict[str, Series]:
    """Joint angles and speeds against the robot table."""
    joint_pos = playback.qpos[:, playback.scene.joint_qpos]
    low, high = np.array(g1.JOINT_RANGES).T
    speed = np.abs(derivative(joint_pos, playback.fps))
    return {
        "joint_limit": Series(np.maximum(low - joint_pos, joint_pos - high).clip(min=0), g1.JOINT_NAMES),
        "joint_velocity": Series(speed / [joint.velocity_limit for joint in g1.JOINTS], g1.JOINT_NAMES),
    }


def torque(dynamics: Dynamics) -> Series:
    """Torques that the motion asks of the joints, relative to their effort limits."""
    return Series(np.abs(dynamics.torque) / np.array(g1.EFFORT_LIMITS), g1.JOINT_NAMES)


def smoothness(motion: Motion) -> dict[str, Series]:
    """Second and third differences; a jump shows as a large acceleration in the frames around it."""
    fps = motion.fps
    acceleration = np.linalg.norm(_difference(motion.body_pos_w, 2), axis=-1) * fps**2
    jerk = np.linalg.norm(_difference(motion.body_pos_w, 3), axis=-1) * fps**3
    joint_acceleration = np.abs(_difference(motion.joint_pos, 2)) * fps**2
    return {
        "acceleration": Series(acceleration, motion.body_names),
        "joint_acceleration": Series(joint_acceleration, motion.joint_names),
        "jerk": Series(jerk, motion.body_names),
    }


def _difference(values: np.ndarray, order: int) -> np.ndarray:
    """Differences of an order, each at the frame in its middle; NaN at the ends. [T, ...]"""
    out = np.full(values.shape, np.nan)
    if len(values) > order:
        start = (order + 1) // 2
        out[start : start + len(values) - order] = np.diff(values.astype(np.float64), order, axis=0)
    return out


def ground(playback: Playback, dynamics: Dynamics) -> dict[str, Series]:
    """Standing: clearance, penetration, slide, and what inverse dynamics asks of the ground."""
    names = [playback.geom_name(g) for g in playback.robot_geoms]
    to_ground, from_support = playback.ground_distance, playback.clearance
    floating = from_support.min(axis=1, keepdims=True).clip(min=0)
    floating[dynamics.in_flight] = np.nan
    return {
        "standing_height": Series(floating, ["robot"]),
        "floating": Series(floating, ["robot"]),
        "ground_penetration": Series((-to_ground).clip(min=0), names),
        "foot_slide": Series(_slide(playback, _standing_clearance(playback, from_support)), g1.FEET),
        "ground_force": Series(dynamics.missing_force[:, None], ["robot"]),
        "centre_of_pressure": Series(dynamics.cop_distance[:, None], ["robot"]),
    }


def _standing_clearance(playback: Playback, from_support: np.ndarray) -> np.ndarray:
    """`from_support`, but a foot that pushes the object, as labels say, does not stand on it. [T, R]"""
    out = from_support.copy()
    label = playback.reference.contact.numpy()  # [T, E]
    for e, effector in enumerate(playback.scene.effectors):
        own = playback.on_bodies([effector.body])
        out[:, own] = np.where(label[:, e, None], playback.ground_distance[:, own], out[:, own])
    return out


def _slide(playback: Playback, from_support: np.ndarray) -> np.ndarray:
    """Horizontal speed of the slowest of a foot's points on the ground; NaN while it swings or has just landed. [T, 2]

    A foot close to the ground that is fast while the other one stands is taken to swing.
    """
    of_foot = [playback.on_bodies([foot]) for foot in g1.FEET]
    pos = np.stack([data.geom_xpos[playback.robot_geoms] for data in playback.frames()])  # [T, R, 3]
    speed = np.linalg.norm(derivative(pos, playback.fps)[..., :2], axis=-1)
    speed = np.where(from_support <= playback.ground_gap + _PLANTED, speed, np.inf)
    slide = np.stack([speed[:, geoms].min(axis=1, initial=np.inf) for geoms in of_foot], axis=1)
    swings = (slide > _SWING) & (slide[:, ::-1] < _SWING)
    planted = np.isfinite(slide) & ~swings
    settled = binary_erosion(planted, np.ones((2 * _SETTLING + 1, 1), bool), border_value=1)
    return np.where(settled, slide, np.nan)


def objects(playback: Playback, dynamics: Dynamics) -> dict[str, Series]:
    """Robot and ground inside the object, and whether anything holds the object."""
    scene = playback.scene
    if not scene.object_geoms.size:
        return {}
    names = np.array([playback.geom_name(geom) for geom in playback.robot_geoms])
    of_effectors = playback.on_bodies([effector.body for effector in scene.effectors])
    depth = (-playback.object_distance).clip(min=0)
    out = {
        "object_penetration": Series(depth[:, ~of_effectors], names[~of_effectors]),
        "object_force": Series(dynamics.object_force[:, None], ["object"]),
    }
    if of_effectors.any():
        out["grip_depth"] = Series(depth[:, of_effectors], names[of_effectors])
    if scene.object_free_dof is not None:
        clearance = playback.object_clearance
        geoms = [playback.geom_name(g) for g in scene.object_geoms]
        out["object_in_ground"] = Series((-clearance).clip(min=0), geoms)
        floating = clearance.min(axis=1, keepdims=True).clip(min=0)
        floating[~_left_alone(playback)] = np.nan
        out["object_floating"] = Series(floating, ["object"])
    return out


def _left_alone(playback: Playback) -> np.ndarray:
    """Whether the object is at rest, not touched and not to be touched. bool [T]"""
    reference = playback.reference
    at_rest = np.linalg.norm(derivative(reference.object_pos.numpy(), playback.fps), axis=-1) < _AT_REST
    touched = playback.object_distance.min(axis=1) < TOUCH
    return at_rest & ~touched & ~reference.contact.numpy().any(axis=1)


def labels(playback: Playback, tolerance: float = 0.0, reduce: str = "mean") -> dict[str, Series]:
    """Contact labels and points against the geometry.

    Args:
        tolerance: distance from a contact point that costs nothing, m.
        reduce: `max`: of the effectors that are to touch in a frame, the nearest one counts.
    """
    scene, reference = playback.scene, playback.reference
    if not scene.effectors:
        return {}
    label = reference.contact.numpy()  # [T, E]
    names = [effector.body for effector in scene.effectors]
    gaps = [playback.object_distance[:, playback.on_bodies([name])].min(axis=1, initial=FAR) for name in names]
    surface = np.stack(gaps, axis=1)  # [T, E]
    apart = np.linalg.norm(playback.effector_pos_w - playback.contact_pos_w, axis=-1)
    found, speed = label_contacts(playback, surface)

    def intended(distance: np.ndarray) -> np.ndarray:
        """Of the effectors that count, NaN of the others. [T, E]"""
        counts = label
        if reduce == "max":
            nearest = np.where(label, distance, np.inf).min(axis=1, keepdims=True)
            counts = label & (distance == nearest)
        return np.where(counts, distance.clip(min=0), np.nan)

    return {
        "contact_gap": Series(intended(surface), names),
        "contact_point": Series(intended(apart - tolerance), names),
        "unlabelled_contact": Series(np.where(label, np.nan, np.where(found, speed, 0.0)), names),
    }


def missing_parts(motion: Motion, playback: Playback, described: Sequence[str]) -> list[str]:
    """Notes on what was filled in and what nothing is known about."""
    notes = []
    if absent := [name for name in g1.JOINT_NAMES if name not in motion.joint_names]:
        notes.append(f"{len(absent)} joints are absent and hold the default pose: {', '.join(absent)}")
    known = {*g1.BODY_NAMES, *described}
    # bodies of other robot descriptions stand for no object: they are rigid with the robot's
    unknown = [name for name in motion.body_names if name not in known and not moves_with_robot(motion, playback, name)]
    if unknown:
        notes.append(f"no geometry is known of {', '.join(unknown)}: name the task that describes them")
    return notes


def moves_with_robot(motion: Motion, playback: Playback, name: str) -> bool:
    """Whether a body moves, and keeps its distance from one of the robot's all along."""
    pos = motion.body_pos_w[:, motion.body_names.index(name)]
    apart = np.linalg.norm(playback.reference.body_pos.numpy() - pos[:, None], axis=-1)  # [T, B]
    return bool(np.ptp(pos, axis=0).max() > 0.01 and (np.ptp(apart, axis=0) < 1e-3).any())
