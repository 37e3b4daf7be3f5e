"""What starts from a reference depend on: how robot and object move with the object's size, and what it stands on.

A reference is made for an object of one size. In a world whose object is s times as large it would stand in its support
or float, the hands would be inside of it or beside it, and feet on top of it likewise. To first order in s - 1 the
tables say what to add.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from torch import Tensor

from hdmi.assets import Scene
from hdmi.motion.playback import reference_qpos
from hdmi.motion.reference import Reference

NEAR = 0.02  # m; what is closer touches
REACH = 0.1  # m; what the robot is closer to, it keeps its distance from, the less the farther it is
_UPRIGHT = 0.7  # of a contact's normal: a support carries from below
_LARGEST_TURN = 4.0  # rad per unit of size: 0.4 rad for an object that is a tenth larger
# Of the least squares: feet stay on the ground, contacts slide rather than open, and the robot is lifted as a whole
# (per m) rather than bent (per rad).
_GROUND_WEIGHT, _SLIDE_WEIGHT, _JOINT_WEIGHT, _ROOT_WEIGHT = 5.0, 0.05, 0.04, 0.03


@dataclass(frozen=True)
class StartTables:
    """By frame of the reference, T frames, S pieces of scenery."""

    object_height: Tensor  # [T, 1] m that the object's origin rises per unit of size, so that its lowest point stays
    root_pos: Tensor  # [T, 3] m per unit of size, that keep hands, feet and whatever else touches where they touch
    joint_pos: Tensor  # [T, J] rad per unit of size, likewise
    carries: Tensor  # bool [T, S] scenery on which the object stands, and the robot does not
    scenery_pos: Tensor  # [S, 3] m, where the scenery is


def start_tables(scene: Scene, reference: Reference) -> StartTables:
    """The tables of a reference in its scene, from the kinematics of its frames."""
    num_frames, num_joints = reference.num_frames, len(scene.joint_dof)
    height, root = np.zeros((num_frames, 1)), np.zeros((num_frames, 3))
    joints, carries = np.zeros((num_frames, num_joints)), np.zeros((num_frames, len(scene.scenery_bodies)), bool)
    if scene.object_body is not None:
        model = copy.copy(scene.model)
        model.geom_margin[:] = REACH
        data = mujoco.MjData(model)
        contact, point = reference.contact.cpu().numpy(), reference.contact_point.cpu().numpy()
        for t, qpos in enumerate(reference_qpos(scene, reference.to("cpu"))):
            data.qpos[:] = qpos
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_collision(model, data)
            frame = _Frame(scene, model, data)
            height[t] = frame.rise
            carries[t] = frame.carries()
            root[t], joints[t] = frame.response(contact[t], point[t])

    def tensor(array: np.ndarray) -> Tensor:
        return torch.from_numpy(array if array.dtype == bool else array.astype(np.float32))

    places = scene.model.body_pos[scene.scenery_bodies]
    return StartTables(tensor(height), tensor(root), tensor(joints), tensor(carries), tensor(places))


@dataclass(frozen=True)
class _Touch:
    bodies: set[int]
    pos: np.ndarray  # [3] m, world
    normal: np.ndarray  # [3]
    distance: float  # m


class _Frame:
    """One frame of a reference, in `data`: what touches what."""

    def __init__(self, scene: Scene, model: mujoco.MjModel, data: mujoco.MjData):
        self.scene, self.model, self.data = scene, model, data
        assert scene.object_body is not None
        self.base = scene.object_body
        self.robot, self.object = set(scene.body_ids.tolist()), {scene.object_body, scene.object_link}
        # what is fixed in the world stays where it is
        self.rise = 0.0
        if scene.object_free_qpos is not None:
            lowest = min(_lowest(model, data, geom) for geom in scene.object_geoms)
            self.rise = float(data.xpos[self.base, 2] - lowest)
        bodies = model.geom_bodyid[data.contact.geom]  # [C, 2]
        apart = np.isin(bodies, scene.body_ids).sum(1) < 2  # the robot's own contacts stay as they are
        self.touching = [
            _Touch(set(pair), pos, normal, distance)
            for pair, pos, normal, distance in zip(
                bodies[apart].tolist(),
                data.contact.pos[apart],
                data.contact.frame[apart, :3],
                data.contact.dist[apart].tolist(),
                strict=True,
            )
        ]

    def carries(self) -> np.ndarray:
        """Whether each piece of scenery carries the object, and not the robot. bool [S]"""
        out = []
        for body in self.scene.scenery_bodies:
            touches = [touch for touch in self.touching if body in touch.bodies and touch.distance < NEAR]
            stands = any(touch.bodies & self.object and abs(touch.normal[2]) > _UPRIGHT for touch in touches)
            out.append(stands and not any(touch.bodies & self.robot for touch in touches))
        return np.array(out, bool)

    def growth(self, body: int, pos: np.ndarray) -> np.ndarray:
        """Velocity of a point of the object per unit of size, m. [3]"""
        base = self.data.xpos[self.base]
        origin = self.data.xpos[body]
        # everything scales about the base's origin, which itself rises
        return (pos - origin) + (origin - base) + [0.0, 0.0, self.rise]

    def response(self, contact: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What root [3] and joints [J] have to do, per unit of size, for contacts to stay."""
        rows: list[np.ndarray] = []
        wanted: list[float] = []

        def ask(body: int, pos: np.ndarray, move: np.ndarray, weights: np.ndarray) -> None:
            jacobian = np.empty((3, self.model.nv))
            mujoco.mj_jac(self.model, self.data, jacobian, None, pos, body)
            own = np.concatenate([jacobian[:, :3], jacobian[:, self.scene.joint_dof]], axis=1)
            rows.extend(weights @ own)
            wanted.extend(weights @ move)

        for touch in self.touching:
            own, others = touch.bodies & self.robot, touch.bodies - self.robot
            if not own or not others:
                continue
            body, other = own.pop(), others.pop()
            on_object = other in self.object
            move = self.growth(other, touch.pos) if on_object else np.zeros(3)
            across = np.outer(touch.normal, touch.normal)
            weight = (1.0 if on_object else _GROUND_WEIGHT) * (1 - max(touch.distance, 0.0) / REACH)
            ask(body, touch.pos, move, weight * (across + _SLIDE_WEIGHT * (np.eye(3) - across)))
        for effector, active, target in zip(self.scene.effectors, contact, point, strict=True):
            if active:
                body, link = self.model.body(effector.body).id, self.scene.object_link
                pos = self.data.xpos[body] + self.data.xmat[body].reshape(3, 3) @ np.asarray(effector.point, float)
                assert link is not None
                place = self.data.xpos[link] + self.data.xmat[link].reshape(3, 3) @ target
                ask(body, pos, self.growth(link, place), np.eye(3))
        num_joints = len(self.scene.joint_dof)
        if not np.any(wanted):
            return np.zeros(3), np.zeros(num_joints)
        damping = np.diag([*[_ROOT_WEIGHT] * 3, *[_JOINT_WEIGHT] * num_joints])
        matrix = np.concatenate([np.stack(rows), damping])
        moves, *_ = np.linalg.lstsq(matrix, np.concatenate([wanted, np.zeros(len(damping))]), rcond=None)
        return moves[:3], moves[3:].clip(-_LARGEST_TURN, _LARGEST_TURN)


def _lowest(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> float:
    """Height of a geom's lowest point, m."""
    pos, mat = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
    size, kind, down = model.geom_size[geom], mujoco.mjtGeom(model.geom_type[geom]), mat[2]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return float(pos[2] - size[0])
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return float(pos[2] - size[0] - size[1] * abs(down[2]))
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return float(pos[2] - size[0] * np.hypot(down[0], down[1]) - size[1] * abs(down[2]))
    centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    return float(pos[2] + down @ centre - np.abs(down) @ half)
