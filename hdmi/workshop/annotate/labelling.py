"""Annotation of a whole motion: trajectory, labels and points, as found and as a person says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hdmi.assets import Effector, ObjectConfig, RobotConfig, SceneryConfig
from hdmi.motion.check import MotionError
from hdmi.motion.complete import complete_robot
from hdmi.motion.format import Motion
from hdmi.motion.kinematics import angular_velocity, derivative
from hdmi.motion.playback import make_playback
from hdmi.workshop.annotate.contacts import ContactCriteria, contact_points, find_contacts
from hdmi.workshop.annotate.overrides import FILE, Overrides
from hdmi.workshop.annotate.trajectory import complete_hinge, complete_trajectory

_GIVE_POSE = f"give its pose in at least one frame, under `object` in {FILE}"


def annotate_motion(
    motion: Motion,
    *,
    object: ObjectConfig,
    effectors: Sequence[Effector],
    robot: RobotConfig | None = None,
    scenery: Sequence[SceneryConfig] = (),
    overrides: Overrides | None = None,
    criteria: ContactCriteria | None = None,
) -> Motion:
    """The motion with contact labels [T, E] and contact points [T, E, 3]; those it has are not looked at.

    If the overrides have keyframes of the object or its hinge, its trajectory is completed from them first, which takes
    the contact intervals from the overrides, or from the motion's labels.

    Raises:
        MotionError: if motion, task and overrides do not fit together.
    """
    overrides = overrides or Overrides()
    names = [effector.body for effector in effectors]
    if unknown := (set(overrides.contacts) | set(overrides.points)) - set(names):
        raise MotionError(f"annotation: {sorted(unknown)} are no effectors of the task; those are {names}")
    if overrides.object or overrides.hinge:
        motion = complete_object(motion, object=object, effectors=effectors, overrides=overrides, robot=robot)
    if object.name not in motion.body_names:
        raise MotionError(f"motion {motion.name!r}: lacks the task's object {object.name!r}: {_GIVE_POSE}")
    playback = make_playback(
        replace(motion, object_contact=None, contact_points=None),
        robot=robot,
        object=object,
        scenery=scenery,
        effectors=effectors,
    )
    label = _override_labels(find_contacts(playback, object, criteria), names, overrides)
    point = contact_points(playback, object, label)
    for e, name in enumerate(names):
        if name in overrides.points:
            point[:, e] = overrides.points[name]
        for interval in overrides.contacts.get(name, ()):
            if interval.point is not None:
                point[interval.first : interval.last + 1, e] = interval.point
    return replace(motion, object_contact=label, contact_points=point.astype(np.float32))


def complete_object(
    motion: Motion,
    *,
    object: ObjectConfig,
    effectors: Sequence[Effector],
    overrides: Overrides,
    robot: RobotConfig | None = None,
) -> Motion:
    """The motion with the object's trajectory, and its hinge's if it has one, made from keyframes.

    Contacts are the overrides'; for an effector that they do not name, the motion's labels; an object that is fixed
    needs none. An articulated object's base follows its own keyframes only: what is in the hands is its link. Hands
    that the motion lacks come from its joints, see `complete_robot`.

    Raises:
        MotionError: without contacts of an object that moves, without keyframes of the object's pose where the
            motion lacks it, or if the robot cannot be completed.
    """
    names = [effector.body for effector in effectors]
    if object.fixed_base and not overrides.hinge:
        contact = np.zeros((motion.num_frames, len(names)), bool)  # nothing that touches it moves it
    else:
        contact = _given_labels(motion, names, overrides)
    full = complete_robot(motion, None if robot is None else RobotConfig(robot.model))
    hands = [_body(full, name) for name in names]
    hand_pos = np.stack(
        [pos + _rotate(quat, np.asarray(e.point, float)) for (pos, quat), e in zip(hands, effectors, strict=True)], 1
    )
    hand_quat = np.stack([quat for _, quat in hands], axis=1)
    if overrides.object:
        carried = contact if object.hinge is None else np.zeros_like(contact)
        pos, quat = complete_trajectory(overrides.object, hand_pos, hand_quat, carried)
        motion = _with_body(motion, object.name, pos, quat)
    elif object.name not in motion.body_names:
        raise MotionError(f"annotation: the motion has no body {object.name!r}: {_GIVE_POSE}")
    if object.hinge is None:
        if overrides.hinge:
            raise MotionError(f"annotation: hinge: the object {object.name!r} has none")
        return motion
    if not overrides.hinge:
        return motion
    pos, quat = _body(motion, object.name)
    base = Rotation.from_quat(quat, scalar_first=True)
    origin = pos + base.apply(object.hinge.pos)
    tilt = base * Rotation.from_quat(object.hinge.quat, scalar_first=True)
    from_hinge = np.stack([tilt.inv().apply(hand_pos[:, e] - origin) for e in range(len(names))], axis=1)
    angle = complete_hinge(overrides.hinge, from_hinge, contact, object.hinge.axis)
    return _with_joint(motion, object.hinge.name, angle)


def _given_labels(motion: Motion, names: Sequence[str], overrides: Overrides) -> np.ndarray:
    label = np.zeros((motion.num_frames, len(names)), bool)
    if motion.object_contact is not None and motion.object_contact.shape[1] in (1, len(names)):
        label |= motion.object_contact
    elif missing := [name for name in names if name not in overrides.contacts]:
        raise MotionError(
            f"annotation: a trajectory needs contacts, and neither motion nor overrides have those of {missing}; "
            f"`contacts: {{{missing[0]}: []}}` says that there are none"
        )
    return _override_labels(label, names, overrides)


def _override_labels(label: np.ndarray, names: Sequence[str], overrides: Overrides) -> np.ndarray:
    label = label.copy()
    for e, name in enumerate(names):
        if name not in overrides.contacts:
            continue
        label[:, e] = False
        for interval in overrides.contacts[name]:
            if interval.last >= len(label):
                raise MotionError(
                    f"annotation: contacts.{name}: frame {interval.last} is beyond the motion's {len(label)} frames"
                )
            label[interval.first : interval.last + 1, e] = True
    return label


def _body(motion: Motion, name: str) -> tuple[np.ndarray, np.ndarray]:
    if name not in motion.body_names:
        raise MotionError(f"annotation: body_names lacks {name!r}")
    index = motion.body_names.index(name)
    return motion.body_pos_w[:, index].astype(np.float64), motion.body_quat_w[:, index].astype(np.float64)


def _rotate(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(quat, scalar_first=True).apply(vector)


def _with_body(motion: Motion, name: str, pos: np.ndarray, quat: np.ndarray) -> Motion:
    new = {
        "body_pos_w": pos,
        "body_quat_w": quat,
        "body_lin_vel_w": derivative(pos, motion.fps),
        "body_ang_vel_w": angular_velocity(quat, motion.fps),
    }
    names, arrays = _with_column(motion.body_names, name, {key: getattr(motion, key) for key in new}, new)
    return replace(motion, body_names=names, **arrays)


def _with_joint(motion: Motion, name: str, angle: np.ndarray) -> Motion:
    new = {"joint_pos": angle, "joint_vel": derivative(angle, motion.fps)}
    if motion.joint_target is not None:
        new["joint_target"] = angle  # no servo drives it
    names, arrays = _with_column(motion.joint_names, name, {key: getattr(motion, key) for key in new}, new)
    return replace(motion, joint_names=names, **arrays)


def _with_column(
    names: tuple[str, ...], name: str, old: dict[str, np.ndarray], new: dict[str, np.ndarray]
) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Arrays [T, N, ...] with a column replaced, or added at the end."""
    columns = [i for i, other in enumerate(names) if other != name]
    arrays = {key: np.concatenate([old[key][:, columns], new[key][:, None]], axis=1).astype(np.float32) for key in new}
    return (*(names[i] for i in columns), name), arrays


@dataclass(frozen=True)
class Agreement:
    """How found labels compare with given ones, over all frames and effectors.

    Examples:
        >>> found, given = np.array([[True], [True], [False]]), np.array([[True], [False], [False]])
        >>> agreement(found, given)
        Agreement(precision=0.5, recall=1.0)
    """

    precision: float
    recall: float


def agreement(found: np.ndarray, given: np.ndarray) -> Agreement:
    """Precision and recall of labels; NaN where nothing was found, or given. bool [T, E] or [T, 1], each"""
    found, given = np.broadcast_arrays(found, given)
    both = float((found & given).sum())
    with np.errstate(invalid="ignore", divide="ignore"):
        return Agreement(float(np.divide(both, found.sum())), float(np.divide(both, given.sum())))
