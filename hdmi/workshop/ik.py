"""Whole-body inverse kinematics of the robot over a sequence of frames (extra `retarget`: mink and daqp).

Every frame is a weighted least-squares problem over all targets, solved by quadratic programs in a trust region that
start from the frame before, within joint ranges and the joints' velocity limits:

    min_dq  1/2 sum_k |w_k (J_k dq + e_k)|^2    s.t.  q + dq in [q_min, q_max],  |q + dq - q_before| <= v_max dt,
                                                      d_c + n_c J_c dq >= 0 for every contact c in reach,  |dq| <= r

A weight says how many units of cost one metre or one radian of error is; what matters is their ratio. Contacts are
those of the robot with itself, with the floor and with obstacles. The programs always have a solution in exact
arithmetic: what already penetrates may not go deeper, and is pushed out as a heavily weighted target.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib import import_module
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from hdmi.assets import RobotConfig, add_robot, default_joint_pos, g1
from hdmi.assets.objects import add_geoms
from hdmi.assets.robot import WORLD_BIT

PLANTED_WEIGHT = (300.0, 100.0)  # per m and per rad: a hundred times what hands and pelvis usually get
_REACH = 0.04  # distance from which on a contact limits the motion, m
_PUSH_WEIGHT = 100.0  # per m of penetration
_PERSISTENCE = 0.8  # of speed from one frame to the next, where nothing else decides
_STALLED = 1e-5  # a frame has settled, too, when a step lowers its cost by a smaller share
_NUM_JOINTS = len(g1.JOINT_NAMES)
_ROBOT = range(1, 1 + len(g1.BODY_NAMES))  # body ids


@dataclass(frozen=True)
class PointTarget:
    """A point of a body that should be at given places.

    Args:
        body: name in the robot table.
        pos: world, m. [T, 3] or [3]
        weight: per m; one figure, one per frame [T, 1], per world axis [3], or both [T, 3]. Zero: no target there.
        point: in the body's frame, m.
        name: under which the residual is reported; the body's if absent.

    Examples:
        >>> reach = PointTarget("left_wrist_yaw_link", pos=[0.3, 0.2, 0.9], weight=10.0)
        >>> result = solve([reach, PostureTarget(standing()[7:], weight=0.05)], num_frames=1, fps=50.0)
        >>> bool(result.residuals["left_wrist_yaw_link"][0] < 0.01)  # m
        True
    """

    body: str
    pos: ArrayLike
    weight: ArrayLike
    point: Sequence[float] = (0.0, 0.0, 0.0)
    name: str | None = None


@dataclass(frozen=True)
class OrientationTarget:
    """An orientation that a body should have.

    Args:
        body: name in the robot table.
        quat: wxyz, world. [T, 4] or [4]
        weight: per rad; as for `PointTarget`, but about the axes of the target's frame.
        name: under which the residual is reported; `<body> orientation` if absent.

    Examples:
        >>> level = OrientationTarget("left_wrist_yaw_link", quat=[1.0, 0.0, 0.0, 0.0], weight=3.0)
        >>> result = solve([level, PostureTarget(standing()[7:], weight=0.05)], num_frames=1, fps=50.0)
        >>> bool(result.residuals["left_wrist_yaw_link orientation"][0] < 0.01)  # rad
        True
    """

    body: str
    quat: ArrayLike
    weight: ArrayLike
    name: str | None = None


@dataclass(frozen=True)
class ComTarget:
    """Where the robot's centre of mass should be: `pos` [T, 3] or [3] in m, weight as for `PointTarget`.

    Examples:
        >>> lower = ComTarget(pos=[0.0, 0.0, 0.6], weight=10.0)
        >>> result = solve([lower, PostureTarget(standing()[7:], weight=0.05)], num_frames=1, fps=50.0)
        >>> bool(result.residuals["com"][0] < 0.01)  # m
        True
    """

    pos: ArrayLike
    weight: ArrayLike
    name: str = "com"


@dataclass(frozen=True)
class PostureTarget:
    """Joint angles that resolve what other targets leave open.

    Args:
        joint_pos: in table order, rad. [T, 29] or [29]
        weight: per rad; one figure, [T, 1], [29] or [T, 29].

    Examples:
        >>> result = solve([PostureTarget(standing()[7:], weight=1.0)], num_frames=1, fps=50.0)
        >>> bool(np.allclose(result.joint_pos[0], standing()[7:], atol=1e-3))
        True
    """

    joint_pos: ArrayLike
    weight: ArrayLike
    name: str = "posture"


Target = PointTarget | OrientationTarget | ComTarget | PostureTarget


@dataclass(frozen=True)
class Obstacle:
    """A body that the robot may touch but not enter.

    Args:
        name: not one of the robot's bodies.
        geoms: in its frame, as those of `hdmi.assets.ObjectConfig`.
        pos, quat: world. [T, 3] or [3], [T, 4] or [4]
        yields: how deep bodies of the robot may enter nevertheless, m; those not named may not. [T] or one figure

    Examples:
        >>> wall = Obstacle("wall", geoms=[{"box": (0.1, 2.0, 2.0)}], pos=[0.45, 0.0, 0.0], quat=[1.0, 0.0, 0.0, 0.0])
        >>> reach = PointTarget("left_wrist_yaw_link", pos=[0.5, 0.2, 0.9], weight=10.0)
        >>> result = solve([reach, PostureTarget(standing()[7:], weight=0.5)], num_frames=1, fps=50.0, obstacles=[wall])
        >>> bool(result.penetration["wall"].max() < 0.005)  # m
        True
    """

    name: str
    geoms: Sequence[Any]
    pos: ArrayLike
    quat: ArrayLike
    yields: Mapping[str, ArrayLike] = field(default_factory=dict)


@dataclass(frozen=True)
class IkOptions:
    """How frames are solved.

    Args:
        max_iterations: quadratic programs for a frame; the first frame gets `first_iterations`.
        tolerance: a frame has settled when its last step was smaller, rad and m, or its cost hardly fell.
        damping: of the steps; keeps them finite without moving the solution.
        max_step: largest trust region: of a joint, and of the root in any direction, in one iteration; rad, m.
        limit_margin: distance kept from the ends of the joint ranges, rad.
        velocity_scale: of the joints' velocity limits.
        smoothing: weight per rad, of going on at the joints' present speed.
        self_collision: clearance kept between parts of the robot, m; None: they may pass through each other.
        floor: height that nothing of the robot may be below, m; None: there is no floor.

    Examples:
        >>> options = IkOptions(floor=0.0)
        >>> down = PointTarget("left_ankle_roll_link", pos=[0.0, 0.12, -0.5], weight=10.0)
        >>> result = solve([down, PostureTarget(standing()[7:], weight=0.5)], num_frames=1, fps=50.0, options=options)
        >>> bool(result.penetration["floor"].max() < 0.005)  # m
        True
    """

    max_iterations: int = 20
    first_iterations: int = 300
    tolerance: float = 1e-4
    damping: float = 1e-4
    max_step: float = 0.3
    limit_margin: float = 0.02
    velocity_scale: float = 1.0
    smoothing: float = 0.0
    self_collision: float | None = 0.005
    floor: float | None = None


@dataclass(frozen=True)
class IkResult:
    """Solved frames and how well they meet their targets.

    Examples:
        >>> result = solve([PostureTarget(standing()[7:], weight=1.0)], num_frames=3, fps=50.0)
        >>> result.qpos.shape, result.failures.tolist()
        ((3, 36), [])
    """

    root_pos: np.ndarray  # [T, 3] m
    root_quat: np.ndarray  # [T, 4] wxyz
    joint_pos: np.ndarray  # [T, 29] rad, in table order
    residuals: dict[str, np.ndarray]  # of each target, m or rad (posture: largest joint); NaN without weight. [T]
    penetration: dict[str, np.ndarray]  # deepest, into "floor", obstacles and "robot" (itself), m. [T]
    iterations: np.ndarray  # [T]
    failures: np.ndarray  # frames in which a quadratic program had no solution: they keep the last that had one
    unsettled: np.ndarray  # frames that were still moving after their last iteration

    @property
    def qpos(self) -> np.ndarray:
        """Positions of `robot_model`. [T, 36]"""
        return np.concatenate([self.root_pos, self.root_quat, self.joint_pos], axis=-1)


def planted(body: str, pos: ArrayLike, quat: ArrayLike, active: ArrayLike = True) -> list[Target]:
    """Targets that hold a body at a pose while `active` (bool [T]), against everything but limits and contacts."""
    on = np.atleast_1d(np.asarray(active, float))[:, None]
    return [
        PointTarget(body, pos, on * PLANTED_WEIGHT[0], name=f"{body} planted"),
        OrientationTarget(body, quat, on * PLANTED_WEIGHT[1], name=f"{body} planted orientation"),
    ]


def standing(pos: ArrayLike = (0.0, 0.0, g1.ROOT_HEIGHT), yaw: float = 0.0) -> np.ndarray:
    """The default pose with the pelvis at `pos`, facing `yaw`: where to start from. [36]"""
    quat = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
    return np.concatenate([np.asarray(pos, float), quat, default_joint_pos()])


def solve(
    targets: Sequence[Target],
    num_frames: int,
    fps: float,
    *,
    initial: np.ndarray | None = None,
    obstacles: Sequence[Obstacle] = (),
    options: IkOptions | None = None,
    robot: RobotConfig | None = None,
    on_frame: Callable[[int], None] | None = None,
) -> IkResult:
    """Finds the robot's motion that meets the targets best.

    Args:
        targets: see their classes.
        num_frames: T.
        fps: of the frames, for the velocity limits.
        initial: where the first frame starts from; standing at the origin if absent. [36]
        obstacles: what the robot may not enter.
        options: see the class.
        robot: the G1 with the collision shapes of a task; joints that it holds stay at its default pose.
        on_frame: called with the index of every frame once it is solved.

    Raises:
        ImportError: if the extra is not installed; says what to install.
        ValueError: for a body that the robot lacks, two targets of one name, a shape that does not fit, or a value
            that is not finite where it has weight: names the target and frame.
    """
    mink = _require_mink()
    options = options or IkOptions()
    model, mocap = _model(options, obstacles, robot)
    rows = _Rows(model, targets, num_frames, options.smoothing)
    poses = [_obstacle_poses(obstacle, num_frames) for obstacle in obstacles]
    configuration = mink.Configuration(model, q=standing() if initial is None else np.asarray(initial, float))
    data = configuration.data
    bounds = _Bounds(model, options, robot or RobotConfig(), fps, mink.Constraint)
    contacts = _Contacts(model, options, _yields(model, obstacles, num_frames), mink.Constraint)
    before: np.ndarray | None = None
    qpos, iterations = np.empty((num_frames, model.nq)), np.zeros(num_frames, int)
    failures, unsettled = [], []
    residuals = {name: np.full(num_frames, np.nan) for name in rows.names}
    penetration = {name: np.zeros(num_frames) for name in contacts.others}

    def measure() -> float:
        return contacts.find(data) + rows.measure(data)

    for t in range(num_frames):
        for i, (pos, quat) in zip(mocap, poses, strict=True):
            data.mocap_pos[i], data.mocap_quat[i] = pos[t], quat[t]
        rows.frame, contacts.frame, settled = t, t, False
        bounds.set_window(before)
        if t > 0:
            rows.expected = qpos[t - 1, 7:] + _PERSISTENCE * (qpos[t - 1, 7:] - qpos[max(t - 2, 0), 7:])
        configuration.update()
        cost = measure()
        for _ in range(options.first_iterations if t == 0 else options.max_iterations):
            iterations[t] += 1
            try:
                step = mink.solve_ik(
                    configuration, [rows, contacts], 1.0, "daqp", options.damping, limits=[bounds, contacts]
                )
            except mink.NoSolutionFound:
                failures.append(t)
                break
            size, start = np.abs(step).max(), configuration.q
            configuration.integrate_inplace(step, 1.0)
            found = measure()
            if found <= cost * (1 + 1e-9) + 1e-12:
                settled = cost - found < _STALLED * cost
                cost = found
                bounds.radius = min(2 * bounds.radius, options.max_step)
            else:
                configuration.update(start)
                measure()
                bounds.radius = size = size / 4
            settled = settled or size < options.tolerance
            if settled:
                break
        if not settled:
            unsettled.append(t)
        qpos[t] = before = configuration.q
        for name, value in rows.errors(data).items():
            residuals[name][t] = value
        for name, depth in contacts.depths(data).items():
            penetration[name][t] = max(penetration[name][t], depth)
        if on_frame is not None:
            on_frame(t)
    return IkResult(
        root_pos=qpos[:, :3],
        root_quat=qpos[:, 3:7],
        joint_pos=qpos[:, 7:],
        residuals=residuals,
        penetration=penetration,
        iterations=iterations,
        failures=np.array(failures, int),
        unsettled=np.array(unsettled, int),
    )


def _require_mink() -> Any:
    try:
        import_module("daqp")
        return import_module("mink")
    except ImportError as error:
        raise ImportError(
            f"inverse kinematics needs {error.name}, which is not installed: pip install 'hdmi[retarget]'"
        ) from error


def _model(
    options: IkOptions, obstacles: Sequence[Obstacle], robot: RobotConfig | None = None
) -> tuple[mujoco.MjModel, list[int]]:
    """The robot, the floor and the obstacles as mocap bodies; and the obstacles' mocap indices."""
    if not obstacles and robot is None:
        return _bare_model(options.self_collision is not None, options.floor), []
    spec = _spec(options.self_collision is not None, options.floor, robot or RobotConfig())
    for obstacle in obstacles:
        if obstacle.name in g1.BODY_NAMES:
            raise ValueError(f"obstacle {obstacle.name!r}: is the name of a body of the robot")
        body = spec.worldbody.add_body(name=obstacle.name, mocap=True)
        add_geoms(spec, body, obstacle.geoms, mass=0.0, friction=1.0, rgba=(0.5, 0.5, 0.5, 1.0))
    model = _with_reach(spec.compile())
    return model, [int(model.body(obstacle.name).mocapid[0]) for obstacle in obstacles]


@lru_cache(maxsize=4)
def _bare_model(self_collisions: bool, floor: float | None) -> mujoco.MjModel:
    return _with_reach(_spec(self_collisions, floor, RobotConfig()).compile())


def _spec(self_collisions: bool, floor: float | None, robot: RobotConfig) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec = add_robot(spec, replace(robot, self_collisions=self_collisions))
    if floor is not None:
        spec.worldbody.add_geom(
            name="floor",
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[1.0, 1.0, 1.0],
            pos=[0.0, 0.0, floor],
            contype=WORLD_BIT,
            conaffinity=WORLD_BIT | 1,
        )
    return spec


def _with_reach(model: mujoco.MjModel) -> mujoco.MjModel:
    model.geom_margin[:] = _REACH
    return model


def _obstacle_poses(obstacle: Obstacle, num_frames: int) -> tuple[np.ndarray, np.ndarray]:
    return (
        _per_frame(f"obstacle {obstacle.name!r}: pos", obstacle.pos, num_frames, 3),
        _per_frame(f"obstacle {obstacle.name!r}: quat", obstacle.quat, num_frames, 4),
    )


def _yields(model: mujoco.MjModel, obstacles: Sequence[Obstacle], num_frames: int) -> dict[tuple[int, int], np.ndarray]:
    """Depths to which obstacles yield, by the ids of the robot's body and theirs, m. [T]"""
    out = {}
    for obstacle in obstacles:
        for body, depth in obstacle.yields.items():
            if body not in g1.BODY_NAMES:
                raise ValueError(f"obstacle {obstacle.name!r}: yields: the robot has no body {body!r}")
            column = np.asarray(depth, float).reshape(-1, 1)
            where = f"obstacle {obstacle.name!r}: yields: {body}"
            out[model.body(body).id, model.body(obstacle.name).id] = _per_frame(where, column, num_frames, 1)[:, 0]
    return out


def _per_frame(where: str, value: ArrayLike, num_frames: int, width: int) -> np.ndarray:
    array = np.asarray(value, float)
    try:
        return np.broadcast_to(array, (num_frames, width))
    except ValueError:
        raise ValueError(f"{where}: shape {array.shape} does not fit {num_frames} frames of {width}") from None


@dataclass
class _Row:
    """A target, checked: values [T, W] and weights [T, D]."""

    name: str
    kind: type
    body: int
    point: np.ndarray
    value: np.ndarray
    weight: np.ndarray


class _Rows:
    """All targets as one stacked task; what `mink.solve_ik` asks of a task is `compute_qp_residual`."""

    def __init__(self, model: mujoco.MjModel, targets: Sequence[Target], num_frames: int, smoothing: float):
        self._model, self._smoothing = model, smoothing
        self._rows = [_checked(model, target, num_frames) for target in targets]
        self.names = [row.name for row in self._rows]
        if len(set(self.names)) < len(self.names):
            twice = sorted({name for name in self.names if self.names.count(name) > 1})
            raise ValueError(f"targets: {twice} occur more than once; give them names")
        self.frame = 0
        self.expected: np.ndarray | None = None  # joints, if they went on as they move; None: at the start. [29]
        self._active: list[tuple[_Row, np.ndarray]] = []
        self._errors = np.zeros(0)  # weighted, with their sign turned
        self._joints = np.eye(model.nv)[6:]

    def measure(self, data: mujoco.MjData) -> float:
        """Cost of the present positions in this frame."""
        self._active = [(row, row.weight[self.frame]) for row in self._rows if row.weight[self.frame].any()]
        errors = [-weight * self._error(row, data) for row, weight in self._active]
        if self._smooths:
            errors.append(-self._smoothing * (data.qpos[7 : 7 + _NUM_JOINTS] - self.expected))
        self._errors = np.concatenate(errors) if errors else np.zeros(0)
        return float(self._errors @ self._errors)

    def compute_qp_residual(self, configuration: Any) -> tuple[np.ndarray, np.ndarray, float]:
        """Weighted Jacobian [R, nv], the errors last measured [R], and no further damping."""
        jacobians = [weight[:, None] * self._jacobian(row, configuration.data) for row, weight in self._active]
        if self._smooths:
            jacobians.append(self._smoothing * self._joints)
        return np.vstack([np.zeros((0, self._model.nv)), *jacobians]), self._errors, 0.0

    @property
    def _smooths(self) -> bool:
        return self._smoothing > 0 and self.expected is not None

    def errors(self, data: mujoco.MjData) -> dict[str, float]:
        """Of each target that has weight in this frame: distance in m or angle in rad, along the weighted axes."""
        out = {}
        for row in self._rows:
            if (weighted := row.weight[self.frame] > 0).any():
                error = self._error(row, data)[weighted]
                out[row.name] = float(np.abs(error).max() if row.kind is PostureTarget else np.linalg.norm(error))
        return out

    def _error(self, row: _Row, data: mujoco.MjData) -> np.ndarray:
        value = row.value[self.frame]
        if row.kind is PointTarget:
            return data.xpos[row.body] + data.xmat[row.body].reshape(3, 3) @ row.point - value
        if row.kind is ComTarget:
            return data.subtree_com[row.body] - value
        if row.kind is PostureTarget:
            return data.qpos[7 : 7 + _NUM_JOINTS] - value
        error = np.empty(3)
        mujoco.mju_subQuat(error, data.xquat[row.body], value)
        return error

    def _jacobian(self, row: _Row, data: mujoco.MjData) -> np.ndarray:
        if row.kind is PostureTarget:
            return self._joints
        jac = np.zeros((3, self._model.nv))
        if row.kind is ComTarget:
            mujoco.mj_jacSubtreeCom(self._model, data, jac, row.body)
            return jac
        rotation = data.xmat[row.body].reshape(3, 3)
        if row.kind is PointTarget:
            mujoco.mj_jac(self._model, data, jac, None, data.xpos[row.body] + rotation @ row.point, row.body)
            return jac
        mujoco.mj_jacBody(self._model, data, None, jac, row.body)
        return rotation.T @ jac


def _checked(model: mujoco.MjModel, target: Target, num_frames: int) -> _Row:
    body, point = 1, np.zeros(3)  # the pelvis: all of the robot is below it
    if isinstance(target, PointTarget | OrientationTarget):
        if target.body not in g1.BODY_NAMES:
            raise ValueError(f"target: the robot has no body {target.body!r}; it has {', '.join(g1.BODY_NAMES)}")
        body = model.body(target.body).id
    if isinstance(target, PointTarget):
        name, value, width, point = target.name or target.body, target.pos, 3, np.asarray(target.point, float)
    elif isinstance(target, OrientationTarget):
        name, value, width = target.name or f"{target.body} orientation", target.quat, 4
    elif isinstance(target, ComTarget):
        name, value, width = target.name, target.pos, 3
    else:
        name, value, width = target.name, target.joint_pos, _NUM_JOINTS
    where = f"target {name!r}"
    values = _per_frame(where, value, num_frames, width)
    weights = _per_frame(f"{where}: weight", target.weight, num_frames, 3 if width == 4 else width)
    if not (np.isfinite(weights) & (weights >= 0)).all():
        raise ValueError(f"{where}: weight: must be finite and not negative")
    weighted = (weights > 0).any(axis=1)
    bad = weighted & ~np.isfinite(values).all(axis=1)
    if width == 4:
        norms = np.linalg.norm(values, axis=1, keepdims=True)
        bad |= weighted & ~(norms[:, 0] > 1e-6)
        values = values / np.where(norms > 1e-6, norms, 1.0)
    if bad.any():
        raise ValueError(f"{where}: frame {int(np.argmax(bad))}: value is not finite or has no direction")
    return _Row(name, type(target), body, point, values, weights)


class _Bounds:
    """Joint ranges, velocity limits against the frame before, and the longest step, as one limit.

    A joint that the robot holds has no range.
    """

    def __init__(self, model: mujoco.MjModel, options: IkOptions, robot: RobotConfig, fps: float, constraint: Any):
        low, high = np.array(g1.JOINT_RANGES).T
        held, pose = np.isin(g1.JOINT_NAMES, robot.held_joints), robot.default_joint_pos
        self._low = np.where(held, pose, low + options.limit_margin)
        self._high = np.where(held, pose, high - options.limit_margin)
        speeds = np.array([joint.velocity_limit for joint in g1.JOINTS])
        self._reach = options.velocity_scale * speeds / fps
        self._max_step = options.max_step
        self.radius = options.max_step
        self._matrix = np.vstack([np.eye(model.nv), -np.eye(model.nv)])
        self._window = self._low, self._high
        self._constraint = constraint

    def set_window(self, before: np.ndarray | None) -> None:
        """Bounds the joints to what they reach from the frame before; None: the first frame."""
        self.radius = self._max_step  # not that of the frame before: a step that it cuts short has not settled
        if before is not None:
            joints = before[7 : 7 + _NUM_JOINTS]
            low, high = joints - self._reach, joints + self._reach
            self._window = (
                np.maximum(self._low, np.minimum(low, self._high)),
                np.minimum(self._high, np.maximum(high, self._low)),
            )

    def compute_qp_inequalities(self, configuration: Any, dt: float) -> Any:
        del dt  # steps, not velocities
        joints = configuration.data.qpos[7 : 7 + _NUM_JOINTS]
        low, high = self._window
        root = np.full(6, self.radius)
        up = np.clip(high - joints, -self.radius, self.radius)
        down = np.clip(joints - low, -self.radius, self.radius)
        return self._constraint(G=self._matrix, h=np.concatenate([root, up, root, down]))


@dataclass
class _Contacts:
    """Contacts in reach: a limit on approaching, and a task that pushes out what penetrates."""

    model: mujoco.MjModel
    options: IkOptions
    yields: Mapping[tuple[int, int], np.ndarray]  # by body ids of robot and obstacle, m. [T]
    constraint: Any
    frame: int = 0
    _gaps: np.ndarray = field(default_factory=lambda: np.zeros(0))  # [C] m
    _normals: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # [C, nv] of the gap by the positions

    def find(self, data: mujoco.MjData) -> float:
        """Looks for contacts at the present positions; returns the cost of those that penetrate."""
        mujoco.mj_collision(self.model, data)
        gaps, normals = [], []
        for contact in data.contact[: data.ncon]:
            first, second = self.model.geom_bodyid[contact.geom]
            normal = np.zeros(self.model.nv)
            for body, sign in ((first, -1.0), (second, 1.0)):
                jac = np.zeros((3, self.model.nv))
                mujoco.mj_jac(self.model, data, jac, None, contact.pos, body)
                normal += sign * (contact.frame[:3] @ jac)
            if normal.any():  # not obstacle against floor
                gaps.append(contact.dist - self._clearance(int(first), int(second)))
                normals.append(normal)
        self._gaps, self._normals = np.array(gaps), np.array(normals).reshape(-1, self.model.nv)
        return float((_PUSH_WEIGHT * np.minimum(self._gaps, 0.0)) @ (_PUSH_WEIGHT * np.minimum(self._gaps, 0.0)))

    def _clearance(self, first: int, second: int) -> float:
        """Distance that two bodies have to keep, negative where one may enter the other, m."""
        if first in _ROBOT and second in _ROBOT:
            return self.options.self_collision or 0.0
        depth = self.yields.get((min(first, second), max(first, second)))  # obstacles come after the robot
        return 0.0 if depth is None else -float(depth[self.frame])

    @property
    def others(self) -> list[str]:
        """What the robot can touch, itself included."""
        names = [self.model.body(i).name for i in range(len(g1.BODY_NAMES) + 1, self.model.nbody)]
        names += ["floor"] if self.options.floor is not None else []
        return names + (["robot"] if self.options.self_collision is not None else [])

    def depths(self, data: mujoco.MjData) -> dict[str, float]:
        """How deep the robot is in what it touches, at the contacts last found, m."""
        out: dict[str, float] = {}
        for contact in data.contact[: data.ncon]:
            bodies = self.model.geom_bodyid[contact.geom]
            if not any(body in _ROBOT for body in bodies):
                continue
            other = next((int(body) for body in bodies if body not in _ROBOT), None)
            name = "robot" if other is None else self.model.body(other).name if other else "floor"
            out[name] = max(out.get(name, 0.0), -float(contact.dist))
        return out

    def compute_qp_inequalities(self, configuration: Any, dt: float) -> Any:
        del configuration, dt
        if not len(self._gaps):
            return self.constraint()
        return self.constraint(G=-self._normals, h=np.maximum(self._gaps, 0.0))

    def compute_qp_residual(self, configuration: Any) -> tuple[np.ndarray, np.ndarray, float]:
        del configuration
        inside = self._gaps < 0
        return _PUSH_WEIGHT * self._normals[inside], -_PUSH_WEIGHT * self._gaps[inside], 0.0
