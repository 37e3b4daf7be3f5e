"""What a motion asks of physics: the contact forces that could produce it, and the joint torques that remain."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import nnls

from hdmi.assets import Scene
from hdmi.motion.playback import TOUCH, Playback, reference_qpos
from hdmi.motion.reference import Reference

_REACH = 0.12  # m; an effector whose contact is intended can push from this far, and feet over this gap at most
_SLIDING = 0.05  # m/s; from here on friction of an object opposes its sliding
_UNSUPPORTED = 0.1  # body weights; with more than this missing there is no support to find a centre of pressure in
_GRAVITY = 9.81
_PATCH = 0.04  # m; radius of the patch in which a hand touches an object: it resists turning about the normal
_AT_ONCE = 0.01  # m; what is farther off than the nearest surface is not pressed with it
_BARE = 0.3  # price of a force that is no grip, against one that is missing
_LEVER = 1.0  # m; lever arm that weighs moments against forces, on the robot
_OBJECT_LEVER = 0.3  # m; likewise on the object
_EASE = 0.03  # weight of small torques against the balance of forces
_HOLD = 30.0  # how much more torques count beyond the effort limits
_SMOOTHING = 2.0  # frames; standard deviation


@dataclass(frozen=True)
class Dynamics:
    """Inverse dynamics of a motion with the contact forces that explain it best.

    In every frame the generalised forces tau = M(q) a + h(q, v) are split into joint torques and contact forces
    J^T f, with each f in its (four-sided) friction cone; an effector whose contact is intended can give the object any
    force, since a kinematic reference has hands near the object rather than on it. Non-negative least squares asks
    first for the balance of the unactuated degrees of freedom (root, object), and then for small torques relative to
    the effort limits. A frame without enough contact leaves a wrench unexplained.

    Examples:
        >>> from hdmi.motion import find_motion, load_motion, make_playback
        >>> dynamics = inverse_dynamics(make_playback(load_motion(find_motion("walk"))))
        >>> dynamics.torque.shape, bool(dynamics.in_flight.any())
        ((550, 29), False)
    """

    torque: np.ndarray  # [T, J] N m
    missing_force: np.ndarray  # [T] that nothing gives the robot, in body weights
    in_flight: np.ndarray  # bool [T]; falls nearly freely, so that it needs no ground
    cop_distance: np.ndarray  # [T] m, of the needed centre of pressure from the support; NaN without support
    object_force: np.ndarray  # [T] that nothing gives the object, in its weights; NaN without a free object


def inverse_dynamics(playback: Playback, grip: float | None = None) -> Dynamics:
    """Explains a motion by forces of contacts, see `Dynamics`; they bridge the `ground_gap`.

    Args:
        grip: share of its friction that effectors count on, which hold the object by pressing it, as far as that
            explains the motion. None: any bare force that the object needs; that asks for the least torques, but these
            let go of what is held between two hands.
    """
    solver = _Solver(playback, min(playback.ground_gap, _REACH - TOUCH), grip)
    qvel, qacc = playback.derivatives()
    rows = [solver.solve(t, qvel[t], qacc[t]) for t in range(playback.num_frames)]
    return Dynamics(*(np.array(column) for column in zip(*rows, strict=True)))


def reference_torque(scene: Scene, reference: Reference, grip: float = 0.5) -> np.ndarray:
    """Joint torques that a reference asks for in its scene, N m, smoothed over some frames. [T, J]

    See `inverse_dynamics`, with a grip; contacts that switch from one frame to the next make its torques jump.
    """
    reference = reference.to("cpu")
    playback = Playback(reference, scene, reference_qpos(scene, reference), 1 / scene.sim.control_dt)
    torque = inverse_dynamics(playback, grip=grip).torque
    smooth: np.ndarray = gaussian_filter1d(torque, _SMOOTHING, axis=0, mode="nearest")
    return smooth


class _Solver:
    """Explains frames of a motion.

    Args:
        ground_gap: between feet and ground that forces bridge, m.
        grip: share of its friction by which effectors press and hold the object; None: they give it any force.
    """

    def __init__(self, playback: Playback, ground_gap: float, grip: float | None):
        self.playback, self.ground_gap, self.grip = playback, ground_gap, grip
        scene = playback.scene
        model = copy(scene.model)
        model.geom_margin[:] = model.body_margin[:] = _REACH / 2  # margins of a pair add up
        model.dof_damping[:6] = model.dof_damping[scene.joint_dof] = 0.0  # of the servos
        self.model, self.data = model, mujoco.MjData(model)
        self.robot = np.isin(model.geom_bodyid, scene.body_ids)
        moving = model.body_dofnum[model.body_rootid] > 0  # not what is welded to the world
        self.object = np.zeros(model.ngeom, bool)
        self.object[scene.object_geoms] = True
        link_moves = moving | (model.body_dofnum > 0)
        self.object &= link_moves[model.geom_bodyid]
        self.effector_of_body = {model.body(e.body).id: i for i, e in enumerate(scene.effectors)}
        self.contact = playback.reference.contact.numpy()
        self.effort = np.array(scene.robot.effort_limits)

        weight = _GRAVITY * scene.robot.total_mass
        self.weight = weight
        self.row_weight = np.zeros(model.nv)
        self.row_weight[:3], self.row_weight[3:6] = 3 / weight, 1 / (weight * _LEVER)
        self.row_weight[scene.joint_dof] = _EASE / self.effort
        self.object_weight = 0.0
        if (v := scene.object_free_dof) is not None:
            self.object_weight = _GRAVITY * float(model.body_subtreemass[scene.object_body])
            self.row_weight[v : v + 3] = 1 / self.object_weight
            self.row_weight[v + 3 : v + 6] = 1 / (self.object_weight * _OBJECT_LEVER)
        if (v := scene.object_hinge_dof) is not None:
            self.row_weight[v] = 1 / (weight * _LEVER)
        self.bare_price = _BARE / (self.object_weight or weight) if grip is not None else 0.0

    def solve(self, t: int, qvel: np.ndarray, qacc: np.ndarray) -> tuple[np.ndarray, float, bool, float, float]:
        model, data, scene = self.model, self.data, self.playback.scene
        data.qpos[:], data.qvel[:], data.qacc[:] = self.playback.qpos[t], qvel, qacc
        constraint = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        model.opt.disableflags |= constraint
        mujoco.mj_inverse(model, data)
        model.opt.disableflags &= ~constraint
        mujoco.mj_collision(model, data)
        needed = data.qfrc_inverse.copy()
        left = self._explain(needed, *self._generators(t))
        lifted = max(float(np.linalg.norm(needed[:3])), 1e-9)
        missing = float(np.linalg.norm(left[:3])) / self.weight
        in_flight = needed[2] < 0.2 * self.weight
        cop = np.nan if in_flight or missing > _UNSUPPORTED else float(np.linalg.norm(left[3:6])) / lifted
        object_force = np.nan
        if (v := scene.object_free_dof) is not None:
            object_force = float(np.linalg.norm(left[v : v + 3])) / self.object_weight
        return left[scene.joint_dof], missing, bool(in_flight), cop, object_force

    def _explain(self, needed: np.ndarray, generators: np.ndarray, price: np.ndarray) -> np.ndarray:
        """What contact forces leave of the needed generalised forces. [nv]

        Args:
            needed: N and N m. [nv]
            generators: generalised forces of the contact forces, per N. [nv, K]
            price: of a N of each, against what is missing; 0 for none. [K]

        Torques beyond the effort limits are held to them, where contacts can do that, and
        balance suffers instead.
        """
        if not generators.size:
            return needed
        weight, target = self.row_weight.copy(), needed.copy()
        dofs, effort = self.playback.scene.joint_dof, self.effort
        held, left = np.zeros(len(dofs), bool), needed
        prices, nothing = np.diag(price)[price > 0], np.zeros((price > 0).sum())
        while True:
            try:
                rows = np.vstack([weight[:, None] * generators, prices])
                forces, _ = nnls(rows, np.concatenate([weight * target, nothing]), maxiter=1000)
            except RuntimeError:  # cycles between degenerate solutions: explained no better than before
                return left
            left = needed - generators @ forces
            torque = left[dofs]
            beyond = (np.abs(torque) > effort) & ~held
            if not beyond.any():
                break
            weight[dofs[beyond]] *= _HOLD
            target[dofs[beyond]] -= np.sign(torque[beyond]) * effort[beyond]
            held |= beyond
        return left

    def _generators(self, t: int) -> tuple[np.ndarray, np.ndarray]:
        """Generalised forces of the edges of all friction cones, and what each costs. [nv, K], [K]"""
        model, data = self.model, self.data
        columns: list[np.ndarray] = []
        prices: list[float] = []
        lin1, lin2, ang1, ang2 = np.zeros((4, 3, model.nv))
        intended = [self._intended(t, *map(int, contact.geom)) for contact in data.contact]
        nearest: dict[int | None, float] = {}  # effector -> m, to the object
        for contact, effector in zip(data.contact, intended, strict=True):
            nearest[effector] = min(nearest.get(effector, np.inf), contact.dist)
        for contact, effector in zip(data.contact, intended, strict=True):
            first, second = int(contact.geom[0]), int(contact.geom[1])
            reach = self._reach(first, second) if effector is None else _REACH
            if (self.robot[first] and self.robot[second]) or contact.dist > reach:
                continue
            mujoco.mj_jac(model, data, lin1, ang1, contact.pos, model.geom_bodyid[first])
            mujoco.mj_jac(model, data, lin2, ang2, contact.pos, model.geom_bodyid[second])
            jacobian = lin2 - lin1
            frame = contact.frame.reshape(3, 3)  # rows: normal from first to second, two tangents
            normal, friction = frame[0], contact.friction[0]
            slip = jacobian @ data.qvel
            slip -= normal * (normal @ slip)
            speed = np.linalg.norm(slip)
            if effector is not None:
                turning = _PATCH * (ang2 - ang1).T @ normal
                bare = [sign * column for column in (*jacobian, turning) for sign in (1, -1)]
                columns += bare
                prices += [self.bare_price] * len(bare)
                if self.grip is not None and contact.dist < nearest[effector] + _AT_ONCE:
                    edges = [*(jacobian.T @ tangent for tangent in frame[1:]), turning]
                    pressed = jacobian.T @ normal
                    cone = [pressed + sign * self.grip * friction * edge for edge in edges for sign in (1, -1)]
                    columns += cone
                    prices += [0.0] * len(cone)
                continue
            if speed > _SLIDING and not (self.robot[first] or self.robot[second]):
                directions = [normal - friction * slip / speed]
            else:
                directions = [normal + sign * friction * tangent for tangent in frame[1:] for sign in (1, -1)]
            columns += [jacobian.T @ direction for direction in directions]
            prices += [0.0] * len(directions)
        generators = np.stack(columns, axis=1) if columns else np.zeros((model.nv, 0))
        return generators, np.array(prices)

    def _intended(self, t: int, first: int, second: int) -> int | None:
        """The effector, if two geoms are one and the object that it is to touch now."""
        robot, other = (first, second) if self.robot[first] else (second, first)
        effector = self.effector_of_body.get(int(self.model.geom_bodyid[robot]))
        touches = effector is not None and self.object[other] and self.contact[t, effector]
        return effector if touches else None

    def _reach(self, first: int, second: int) -> float:
        """Up to which distance two geoms can push each other that are not meant to, m."""
        on_ground = (self.robot[first] or self.robot[second]) and not (self.object[first] or self.object[second])
        return self.ground_gap + TOUCH if on_ground else TOUCH
