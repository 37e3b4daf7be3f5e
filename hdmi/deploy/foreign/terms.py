"""Observation terms of networks: functions of what is measured and of the motion, for one world or many at once.

Each says what it is, its shape before lags, unit, and what others call it. F are `steps`, K `bodies` or points, J
`joints`. Frames are those of `frame`; positions are relative to its origin.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from hdmi.deploy.description import PolicyError
from hdmi.deploy.foreign.motion import Motion
from hdmi.deploy.foreign.schema import Frame, NetworkSpec, TermSpec, one_of, per_joint
from hdmi.deploy.rotations import matrix_of, quat_apply_inverse, quat_conjugate, quat_multiply, yaw_of


def _absent() -> np.ndarray:
    return np.zeros(0)


@dataclass
class Moment:
    """What a tick knows; leading dimensions as wanted. SI, wxyz, joints and bodies in the order of `Motion`.

    Args:
        step: frame of the motion. int [...]
        root_lin_vel_w, root_ang_vel_b: in the world, and in the root's axes. [..., 3]
        link_pos_w, link_quat_w: of the object's moving part, of which the contact points are.
        object_scale: size of the object against the nominal one. [..., 1]
        action: the network's output in the tick before, zeros in the first. [..., A]
    """

    step: np.ndarray
    joint_pos: np.ndarray
    joint_vel: np.ndarray
    body_pos_w: np.ndarray
    body_quat_w: np.ndarray
    root_lin_vel_w: np.ndarray
    root_ang_vel_b: np.ndarray
    action: np.ndarray
    object_pos_w: np.ndarray = field(default_factory=_absent)
    object_quat_w: np.ndarray = field(default_factory=_absent)
    object_joint_pos: np.ndarray = field(default_factory=_absent)
    link_pos_w: np.ndarray = field(default_factory=_absent)
    link_quat_w: np.ndarray = field(default_factory=_absent)
    object_scale: np.ndarray = field(default_factory=lambda: np.ones(1))


@dataclass(frozen=True)
class Bound:
    """A term's options as indices into the arrays of `Moment` and `Motion`."""

    spec: TermSpec
    motion: Motion
    control_dt: float
    joints: np.ndarray  # [J]
    default_pose: np.ndarray  # [J]
    bodies: np.ndarray  # [K]
    frame_body: int
    contacts: np.ndarray  # [K], -1 for a body without labels

    def future(self, now: Moment) -> np.ndarray:
        """Frames of the motion that the term looks at. int [..., F]"""
        return np.clip(now.step[..., None] + np.array(self.spec.steps), 0, self.motion.num_frames - 1)

    def frame(self, now: Moment) -> tuple[np.ndarray, np.ndarray]:
        """Origin [..., 1, 3] and axes [..., 1, 4] of the term's frame."""
        frame: Frame = self.spec.frame
        if frame.of == "world":
            origin, axes = np.zeros((*now.step.shape, 3)), np.zeros((*now.step.shape, 4))
            axes[..., 0] = 1.0
            return origin[..., None, :], axes[..., None, :]
        if frame.of == "robot":
            origin, axes = now.body_pos_w[..., self.frame_body, :], now.body_quat_w[..., self.frame_body, :]
        else:
            at = np.clip(now.step, 0, self.motion.num_frames - 1)
            origin, axes = self.motion.body_pos_w[at, self.frame_body], self.motion.body_quat_w[at, self.frame_body]
        if frame.turn != "full":
            axes = yaw_of(axes) if frame.turn == "heading" else np.broadcast_to([1.0, 0.0, 0.0, 0.0], axes.shape)
        if frame.ground:
            origin = origin * np.array([1.0, 1.0, 0.0])
        return origin[..., None, :], axes[..., None, :]

    def positions(self, now: Moment, pos_w: np.ndarray) -> np.ndarray:
        """World positions [..., K, 3] in the term's frame, shortened and with the axes that are wanted."""
        origin, axes = self.frame(now)
        local = quat_apply_inverse(np.broadcast_to(axes, (*pos_w.shape[:-1], 4)), pos_w - origin)
        if np.isfinite(self.spec.max_norm):
            length = np.linalg.norm(local, axis=-1, keepdims=True)
            local = local * np.minimum(1.0, self.spec.max_norm / np.maximum(length, 1e-8))
        return local[..., list(self.spec.axes)] if self.spec.axes else local

    def vectors(self, now: Moment, vector_w: np.ndarray) -> np.ndarray:
        """World vectors [..., K, 3] along the axes of the term's frame."""
        return quat_apply_inverse(np.broadcast_to(self.frame(now)[1], (*vector_w.shape[:-1], 4)), vector_w)

    def rotations(self, now: Moment, quat_w: np.ndarray) -> np.ndarray:
        """World orientations [..., K, 4] in the term's frame, as features. [..., K, R]"""
        local = quat_multiply(quat_conjugate(np.broadcast_to(self.frame(now)[1], quat_w.shape)), quat_w)
        return ROTATIONS[self.spec.rotation](local)


def _yaw(quat: np.ndarray) -> np.ndarray:
    turn = yaw_of(quat)
    return 2.0 * np.arctan2(turn[..., 3:], turn[..., :1])


def _flat(matrix: np.ndarray) -> np.ndarray:
    return matrix.reshape(*matrix.shape[:-2], -1)


# How a rotation becomes features, R of them; r_ij is the matrix in row i, column j.
ROTATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "columns": lambda quat: _flat(np.swapaxes(matrix_of(quat)[..., :2], -1, -2)),  # r00 r10 r20 r01 r11 r21
    "interleaved": lambda quat: _flat(matrix_of(quat)[..., :2]),  # r00 r01 r10 r11 r20 r21: mjlab, BeyondMimic
    "rows": lambda quat: _flat(matrix_of(quat)[..., :2, :]),  # r00 r01 r02 r10 r11 r12: HDMI's authors
    "matrix": lambda quat: _flat(matrix_of(quat)),  # r00 r01 r02 r10 ... r22
    "quat": lambda quat: quat,  # w x y z
    "heading": lambda quat: np.concatenate([np.cos(_yaw(quat)), np.sin(_yaw(quat))], axis=-1),
    "yaw": _yaw,  # rad
}


@dataclass(frozen=True)
class Term:
    """A function of a moment, and which options and sensors it has; `pos` and `quat`: as its frame needs the root's."""

    function: Callable[[Moment, Bound], np.ndarray]
    options: frozenset[str]
    sensors: tuple[str, ...]


TERMS: dict[str, Term] = {}
_COMMON = frozenset(("term", "lags", "fill", "layout", "scale", "clip"))
_ROOT = {"pos": "root_pos_w", "quat": "root_quat_w"}


def _term(options: str = "", sensors: str = "") -> Callable[[Any], Any]:
    def register(function: Any) -> Any:
        TERMS[function.__name__] = Term(function, _COMMON | set(options.split()), tuple(sensors.split()))
        return function

    return register


@_term("joints", "joint_pos")
def joint_pos(now: Moment, b: Bound) -> np.ndarray:
    """Joint positions, rad [J]; authors: joint_pos_history."""
    return now.joint_pos[..., b.joints]


@_term("joints default_pose", "joint_pos")
def joint_pos_rel(now: Moment, b: Bound) -> np.ndarray:
    """Joint positions relative to the default pose, rad [J]; mjlab: joint_pos; PBHC: dof_pos."""
    return now.joint_pos[..., b.joints] - b.default_pose


@_term("joints", "joint_vel")
def joint_vel(now: Moment, b: Bound) -> np.ndarray:
    """Joint velocities, rad/s [J]; PBHC: dof_vel."""
    return now.joint_vel[..., b.joints]


@_term("", "root_ang_vel_b")
def root_ang_vel(now: Moment, b: Bound) -> np.ndarray:
    """Angular velocity of the root in its axes, rad/s [3]; base_ang_vel."""
    return now.root_ang_vel_b


@_term("", "root_quat_w root_pos_w")
def root_lin_vel(now: Moment, b: Bound) -> np.ndarray:
    """Linear velocity of the root in its axes, m/s [3]; base_lin_vel. On a robot: differences of its position."""
    return quat_apply_inverse(now.body_quat_w[..., 0, :], now.root_lin_vel_w)


@_term("bodies", "quat")
def gravity(now: Moment, b: Bound) -> np.ndarray:
    """Direction of gravity in the axes of bodies, [K, 3]; projected_gravity."""
    quat = now.body_quat_w[..., b.bodies, :]
    return quat_apply_inverse(quat, np.broadcast_to([0.0, 0.0, -1.0], (*quat.shape[:-1], 3)))


@_term()
def last_action(now: Moment, b: Bound) -> np.ndarray:
    """The network's output in the tick before, [A]; actions, prev_actions. Its lags count from there."""
    return now.action


@_term("period steps")
def phase(now: Moment, b: Bound) -> np.ndarray:
    """Time since the motion's start in periods, [F], at most 1; ref_motion_phase."""
    period = b.spec.period or (b.motion.num_frames - 1) * b.control_dt
    return np.minimum(b.future(now) * b.control_dt / period, 1.0)


@_term("steps")
def step(now: Moment, b: Bound) -> np.ndarray:
    """Frame of the motion, [F]; time_step."""
    return b.future(now).astype(float)


@_term("value")
def constant(now: Moment, b: Bound) -> np.ndarray:
    """Numbers that stay as they are, [D]."""
    return np.broadcast_to(np.array(b.spec.value), (*now.step.shape, len(b.spec.value)))


@_term("steps joints")
def ref_joint_pos(now: Moment, b: Bound) -> np.ndarray:
    """Joint positions of the motion, rad [F, J]; ref_joint_pos_future."""
    return b.motion.joint_pos[b.future(now)][..., b.joints]


@_term("steps joints")
def ref_joint_vel(now: Moment, b: Bound) -> np.ndarray:
    """Joint velocities of the motion, rad/s [F, J]; ref_joint_vel_future."""
    return b.motion.joint_vel[b.future(now)][..., b.joints]


@_term("steps joints")
def ref_joint_state(now: Moment, b: Bound) -> np.ndarray:
    """Joint positions and then velocities of the motion, rad and rad/s [F, 2 J]; mjlab's and BeyondMimic's command."""
    return np.concatenate([ref_joint_pos(now, b), ref_joint_vel(now, b)], axis=-1)


def _bodies_of(table: np.ndarray, now: Moment, b: Bound) -> np.ndarray:
    """Rows of bodies at future frames, [..., F K, *]."""
    found = table[b.future(now)][..., b.bodies, :]
    return found.reshape(*now.step.shape, -1, found.shape[-1])


@_term("steps bodies frame axes max_norm", "pos")
def ref_body_pos(now: Moment, b: Bound) -> np.ndarray:
    """Positions of bodies of the motion, m [F, K, 3]; ref_body_pos_future_local, motion_anchor_pos_b."""
    return b.positions(now, _bodies_of(b.motion.body_pos_w, now, b))


@_term("steps bodies frame rotation", "quat")
def ref_body_ori(now: Moment, b: Bound) -> np.ndarray:
    """Orientations of bodies of the motion, [F, K, R]; ref_body_ori_future_local, motion_anchor_ori_b."""
    return b.rotations(now, _bodies_of(b.motion.body_quat_w, now, b))


@_term("steps bodies frame rotation", "pos")
def ref_body_pose(now: Moment, b: Bound) -> np.ndarray:
    """Position and then orientation of each body of the motion, m [F, K, 3 + R]; OmniContact's tracking."""
    return np.concatenate([ref_body_pos(now, b), ref_body_ori(now, b)], axis=-1)


@_term("steps bodies frame", "quat")
def ref_body_lin_vel(now: Moment, b: Bound) -> np.ndarray:
    """Linear velocities of bodies' origins in the motion, m/s [F, K, 3]."""
    return b.vectors(now, _bodies_of(b.motion.body_lin_vel_w, now, b))


@_term("steps bodies frame", "quat")
def ref_body_ang_vel(now: Moment, b: Bound) -> np.ndarray:
    """Angular velocities of bodies of the motion, rad/s [F, K, 3]."""
    return b.vectors(now, _bodies_of(b.motion.body_ang_vel_w, now, b))


@_term("bodies points frame axes", "joint_pos pos")
def body_pos(now: Moment, b: Bound) -> np.ndarray:
    """Positions of bodies, or of points on them, by forward kinematics, m [K, 3]; robot_body_pos_b."""
    pos, quat = now.body_pos_w[..., b.bodies, :], now.body_quat_w[..., b.bodies, :]
    return b.positions(now, pos + _turned(quat, b) if b.spec.points else pos)


@_term("bodies frame rotation", "joint_pos quat")
def body_ori(now: Moment, b: Bound) -> np.ndarray:
    """Orientations of bodies by forward kinematics, [K, R]; robot_body_ori_b."""
    return b.rotations(now, now.body_quat_w[..., b.bodies, :])


def _turned(quat: np.ndarray, b: Bound) -> np.ndarray:
    """The term's points turned by orientations, [..., K, 3]."""
    points = np.broadcast_to(np.array(b.spec.points), (*quat.shape[:-1], 3))
    return quat_apply_inverse(quat_conjugate(quat), points)


@_term("frame axes max_norm", "pos object_pos_w")
def object_pos(now: Moment, b: Bound) -> np.ndarray:
    """Position of the object, m [3]; object_pos_b, with axes [0, 1] object_xy_b."""
    return b.positions(now, now.object_pos_w[..., None, :])


@_term("frame rotation", "quat object_quat_w")
def object_ori(now: Moment, b: Bound) -> np.ndarray:
    """Orientation of the object, [R]; object_ori_b, with rotation heading object_heading_b."""
    return b.rotations(now, now.object_quat_w[..., None, :])


@_term("frame rotation", "pos object_pos_w object_quat_w")
def object_pose(now: Moment, b: Bound) -> np.ndarray:
    """Position of the object and then its orientation, m [3 + R]."""
    return np.concatenate([object_pos(now, b), object_ori(now, b)], axis=-1)


@_term("points frame max_norm", "pos object_pos_w object_quat_w")
def object_points(now: Moment, b: Bound) -> np.ndarray:
    """Points that are fixed in the object, m [K, 3]; authors' deployment: ref_contact_pos_b."""
    quat = np.broadcast_to(now.object_quat_w[..., None, :], (*now.step.shape, len(b.spec.points), 4))
    return b.positions(now, now.object_pos_w[..., None, :] + _turned(quat, b))


@_term("half_size frame max_norm", "pos object_pos_w object_quat_w")
def object_corners(now: Moment, b: Bound) -> np.ndarray:
    """Corners of the object's box, m [8, 3], from + + + to - - -, z changing first; OmniContact's bounding box."""
    return object_points(now, b)


@_term("", "object_joint_pos")
def object_joint_pos(now: Moment, b: Bound) -> np.ndarray:
    """Angle of the object's hinge, rad [1]."""
    return now.object_joint_pos


@_term("steps frame axes max_norm", "pos")
def ref_object_pos(now: Moment, b: Bound) -> np.ndarray:
    """Positions of the object in the motion, m [F, 3]."""
    return b.positions(now, b.motion.object_pos_w[b.future(now)])


@_term("steps frame rotation", "quat")
def ref_object_ori(now: Moment, b: Bound) -> np.ndarray:
    """Orientations of the object in the motion, [F, R]."""
    return b.rotations(now, b.motion.object_quat_w[b.future(now)])


@_term("bodies frame max_norm", "pos object_pos_w object_quat_w")
def contact_points(now: Moment, b: Bound) -> np.ndarray:
    """The motion's contact points on the object, where that is measured to be, m [K, 3]; ref_contact_pos_b."""
    points = b.motion.contact_points[np.clip(now.step, 0, b.motion.num_frames - 1)][..., b.contacts, :]
    points = points * now.object_scale[..., None]
    quat = np.broadcast_to(quat_conjugate(now.link_quat_w)[..., None, :], (*points.shape[:-1], 4))
    return b.positions(now, now.link_pos_w[..., None, :] + quat_apply_inverse(quat, points))


@_term("steps bodies")
def contact(now: Moment, b: Bound) -> np.ndarray:
    """Whether bodies are meant to touch the object, 0 or 1 [F, K]; 0 for a body that the motion has no label of."""
    labels = b.motion.contact[b.future(now)]
    return np.where(b.contacts < 0, 0.0, labels[..., np.maximum(b.contacts, 0)])


def check_term(spec: TermSpec, where: str) -> Term:
    """The term of a description.

    Raises:
        PolicyError: if there is none of that name, or it does not take an option that is given.
    """
    one_of(spec.term, list(TERMS), where)
    term, plain = TERMS[spec.term], TermSpec(spec.term)
    given = [item.name for item in fields(TermSpec) if getattr(spec, item.name) != getattr(plain, item.name)]
    if wrong := [name for name in given if name not in term.options]:
        raise PolicyError(
            f"{where}: {spec.term} takes no {', '.join(wrong)}; it takes {', '.join(sorted(term.options - {'term'}))}"
        )
    one_of(spec.rotation, list(ROTATIONS), f"{where}.rotation")
    needed = {"constant": "value", "object_corners": "half_size", "object_points": "points"}.get(spec.term)
    if needed is not None and not getattr(spec, needed):
        raise PolicyError(f"{where}: {spec.term} needs {needed}")
    return term


def bind(spec: TermSpec, network: NetworkSpec, motion: Motion, body_names: Sequence[str], where: str) -> Bound:
    """A term ready to be computed.

    Raises:
        PolicyError: for joints or bodies that are not there, or what the motion lacks.
    """
    check_term(spec, where)
    joints = spec.joints or network.joints
    for key, names, there in (("joints", joints, network.joints), ("frame.body", (spec.frame.body,), body_names)):
        for name in names:
            if name or key == "joints":
                one_of(name, there, f"{where}.{key}")
    labelled = spec.term in ("contact", "contact_points")
    bodies = spec.bodies or (network.contact_bodies if labelled else (body_names[0],))
    for name in bodies:
        one_of(name, (*body_names, *network.contact_bodies) if labelled else body_names, f"{where}.bodies")
    if spec.points and spec.bodies and len(spec.points) != len(spec.bodies):
        raise PolicyError(f"{where}: {len(spec.points)} points for {len(spec.bodies)} bodies")
    if spec.term.startswith("ref_object") and not motion.object_pos_w.shape[-1]:
        raise PolicyError(f"{where}: {spec.term} needs the object's name in the motion as `object`")
    contacts = [network.contact_bodies.index(n) if n in network.contact_bodies else -1 for n in bodies]
    if labelled:
        table = motion.contact if spec.term == "contact" else motion.contact_points
        lacks = [n for n, i in zip(bodies, contacts, strict=True) if i < 0 and spec.term == "contact_points"]
        if not bodies or lacks or not table.shape[1]:
            raise PolicyError(
                f"{where}: {spec.term} needs contact_bodies, of which are {', '.join(network.contact_bodies) or 'none'}"
                f", and the motion's object_contact or contact_points; {', '.join(lacks) or 'something'} is missing"
            )
    if spec.term == "object_corners":
        signs = np.stack(np.meshgrid([1.0, -1.0], [1.0, -1.0], [1.0, -1.0], indexing="ij"), axis=-1).reshape(-1, 3)
        corners = tuple(map(tuple, (signs * np.array(spec.half_size)).tolist()))
        spec = replace(spec, points=corners)
    pose = network.default_pose if spec.default_pose is None else spec.default_pose
    index = np.array([network.joints.index(name) for name in joints])
    return Bound(
        spec=spec,
        motion=motion,
        control_dt=network.control_dt,
        joints=index,
        default_pose=per_joint(pose, network.joints, f"{where}.default_pose")[index],
        bodies=np.array([body_names.index(name) if name in body_names else 0 for name in bodies]),
        frame_body=body_names.index(spec.frame.body) if spec.frame.body else 0,
        contacts=np.array(contacts, dtype=int),
    )


def sensors_of(spec: TermSpec, root: str) -> set[str]:
    """Sensors that a term depends on, its frame included."""
    frame, found = spec.frame, set[str]()
    relative = spec.term == "body_pos" and frame.of == "robot" and not frame.ground  # the root's place cancels out
    for name in TERMS[spec.term].sensors:
        if name not in _ROOT:
            found.add(name)
        elif frame.of == "robot" or spec.term in ("body_pos", "body_ori", "gravity"):
            found |= {"root_quat_w"} if name == "quat" or relative else {"root_pos_w", "root_quat_w"}
    moving = [spec.frame.body if frame.of == "robot" else "", *(spec.bodies if spec.term == "gravity" else ())]
    if any(name and name != root for name in moving):
        found.add("joint_pos")
    return found
