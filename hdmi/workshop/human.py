"""The neutral human motion that every source is read into and retargeting starts from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hdmi.motion.check import MotionError, checked, checked_fps, checked_labels, checked_names, checked_quat
from hdmi.motion.kinematics import interpolate, interpolate_quat, nearest_frames, resampled_times

SMPL_JOINTS = (
    "pelvis",
    "left_hip",
    "right_hip",
    "spine1",
    "left_knee",
    "right_knee",
    "spine2",
    "left_ankle",
    "right_ankle",
    "spine3",
    "left_foot",
    "right_foot",
    "neck",
    "left_collar",
    "right_collar",
    "head",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
)
SMPL_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)


@dataclass(frozen=True)
class ObjectTrajectory:
    """Where an object is in each frame of a motion. Float32, world frame, z up.

    Examples:
        >>> box = ObjectTrajectory("box", pos=np.zeros((2, 3)), quat=np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)))
        >>> motion = HumanMotion("reach", 30.0, 1.7, ("pelvis",), joint_pos=np.zeros((2, 1, 3)), object=box)
        >>> motion.shifted(np.array([0.0, 0.0, 0.5])).object.pos[0].tolist()
        [0.0, 0.0, 0.5]
    """

    name: str
    pos: np.ndarray  # [T, 3] m
    quat: np.ndarray  # [T, 4] wxyz
    joint_pos: np.ndarray | None = None  # [T] of its hinge or slide, rad or m


@dataclass(frozen=True)
class HumanMotion:
    """A motion of a person, with an object if there is one. Float32, world frame, z up.

    Joints have SMPL's names where they are SMPL's joints (`SMPL_JOINTS`); a source may have fewer or more.
    `joint_quat` is the orientation of SMPL's joint frames: upright in a T-pose, x is the person's left, y up and
    z forward. On construction, arrays are converted and checked.

    Raises:
        MotionError: for names that are not distinct, wrong shapes, values that are not finite, quaternions that are
            not unit, a rate or height that cannot be.

    Examples:
        >>> motion = HumanMotion("sway", fps=30.0, height=1.7, joint_names=("pelvis",), joint_pos=np.zeros((31, 1, 3)))
        >>> motion.resample(60.0).num_frames  # of the same second
        61
    """

    name: str
    fps: float
    height: float  # of the person, m
    joint_names: tuple[str, ...]
    joint_pos: np.ndarray  # [T, J, 3] m
    joint_quat: np.ndarray | None = None  # [T, J, 4] wxyz
    object: ObjectTrajectory | None = None
    contact: np.ndarray | None = None  # bool [T, E]: which effectors touch the object
    contact_names: tuple[str, ...] = ()  # of the E effectors: names of joints
    notes: tuple[str, ...] = ()  # what its reader did or could not do, for people; one sentence each

    def __post_init__(self) -> None:
        where = f"motion {self.name!r}"
        checked_fps(where, self.fps)
        if not 0.5 <= self.height <= 2.5:
            raise MotionError(f"{where}: height must be from 0.5 to 2.5 m, got {self.height:g}")
        names = checked_names(where, "joint_names", self.joint_names)
        num_frames = len(np.atleast_1d(self.joint_pos))
        if num_frames < 2:
            raise MotionError(f"{where}: joint_pos: needs at least 2 frames, has {num_frames}")
        values: dict[str, Any] = {"joint_names": names}
        values["joint_pos"] = checked(where, "joint_pos", self.joint_pos, (num_frames, len(names), 3))
        if self.joint_quat is not None:
            quat = checked(where, "joint_quat", self.joint_quat, (num_frames, len(names), 4))
            values["joint_quat"] = checked_quat(where, "joint_quat", quat, names, "joint")
        if self.object is not None:
            values["object"] = _checked_object(where, self.object, num_frames)
        values["contact_names"] = checked_names(where, "contact_names", self.contact_names)
        if self.contact is not None:
            shape = (num_frames, len(self.contact_names))
            values["contact"] = checked_labels(where, "contact", self.contact, shape)
        elif self.contact_names:
            raise MotionError(f"{where}: contact_names are given, contact is not")
        for key, value in values.items():
            object.__setattr__(self, key, value)

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.joint_pos)

    def index(self, joint: str) -> int:
        """Column of a joint.

        Raises:
            MotionError: if the motion lacks it; says what it has.
        """
        if joint not in self.joint_names:
            raise MotionError(f"motion {self.name!r}: lacks the joint {joint!r}; it has {', '.join(self.joint_names)}")
        return self.joint_names.index(joint)

    def pos(self, joint: str) -> np.ndarray:
        """Path of a joint. [T, 3]"""
        return self.joint_pos[:, self.index(joint)]

    def shifted(self, offset: np.ndarray) -> HumanMotion:
        """The motion, object included, moved by `offset`. [3]"""
        moved = self.object and replace(self.object, pos=self.object.pos + offset)
        return replace(self, joint_pos=self.joint_pos + offset, object=moved)

    def turned(self, rotation: Rotation) -> HumanMotion:
        """The motion, object included, turned about the origin by one rotation."""
        quat = self.joint_quat
        if quat is not None:
            quat = (rotation * Rotation.from_quat(quat.reshape(-1, 4), scalar_first=True)).as_quat(scalar_first=True)
            quat = quat.reshape(*self.joint_pos.shape[:2], 4)
        thing = self.object
        if thing is not None:
            poses = rotation * Rotation.from_quat(thing.quat, scalar_first=True)
            thing = replace(thing, pos=_turned(thing.pos, rotation), quat=poses.as_quat(scalar_first=True))
        return replace(self, joint_pos=_turned(self.joint_pos, rotation), joint_quat=quat, object=thing)

    def resample(self, fps: float) -> HumanMotion:
        """The motion at another rate: positions linear, orientations slerp, labels nearest."""
        if abs(self.fps - fps) < 1e-6:
            return self
        old, new = resampled_times(self.num_frames, self.fps, checked_fps(f"motion {self.name!r}", fps))
        thing = self.object
        if thing is not None:
            thing = replace(
                thing,
                pos=interpolate(thing.pos, old, new),
                quat=interpolate_quat(thing.quat, old, new),
                joint_pos=None if thing.joint_pos is None else interpolate(thing.joint_pos, old, new),
            )
        return replace(
            self,
            fps=fps,
            joint_pos=interpolate(self.joint_pos, old, new),
            joint_quat=None if self.joint_quat is None else interpolate_quat(self.joint_quat, old, new),
            object=thing,
            contact=None if self.contact is None else self.contact[nearest_frames(old, new)],
        )


def _turned(points: np.ndarray, rotation: Rotation) -> np.ndarray:
    return points @ rotation.as_matrix().T


def _checked_object(where: str, thing: ObjectTrajectory, num_frames: int) -> ObjectTrajectory:
    quat = checked(where, "object.quat", thing.quat, (num_frames, 4))
    return replace(
        thing,
        pos=checked(where, "object.pos", thing.pos, (num_frames, 3)),
        quat=checked_quat(where, "object.quat", quat[:, None], [thing.name], "object")[:, 0],
        joint_pos=None
        if thing.joint_pos is None
        else checked(where, "object.joint_pos", thing.joint_pos, (num_frames,)),
    )
