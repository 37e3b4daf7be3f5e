"""Where the feet are: steps along a root path, swings and stances, and the ground under the robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from hdmi.assets import g1
from hdmi.motion.kinematics import minimum_jerk
from hdmi.workshop.author.paths import PosePath, about, pose_path, value_path
from hdmi.workshop.author.plan import SIDES, Plan, PlanError, PoseKey, Step, Walk

ANKLE_HEIGHT = -g1.FOOT_POINTS[0][2] + g1.FOOT_POINT_RADIUS  # soles on the floor, m
TOES = (g1.FOOT_POINTS[0][0], 0.0, -ANKLE_HEIGHT)  # in the ankle's frame
SOLE_CENTRE = 0.03  # of pressure while standing, ahead of the ankles, m
MIN_STEP_TIME = 0.4  # s
SHIFT_TIME = 0.6  # in which the weight goes onto one foot from standing, and back, s
ROOT_SMOOTHING = 0.3  # s
OVER_PLACE = 0.85  # share of a swing after which the foot is over where it lands: if it lands early, it lands there

_LEFT = {"left": 1.0, "right": -1.0}


def plan_steps(plan: Plan) -> list[Step]:
    """All steps in order of time; walks become steps.

    The root path of a walk goes straight from waypoint to waypoint in strides of at most `length` and `turn`, and in as
    many as there is time for at `step_time` each; feet land beside it, left and right in turn, and the last step brings
    them side by side at its end.

    Raises:
        PlanError: for steps that overlap in time or are shorter than `MIN_STEP_TIME`.
    """
    root = np.array([*plan.start_pos[:2], plan.start_yaw])
    stands = {side: _beside(root, side, plan.width) for side in SIDES}
    steps: list[Step] = []
    height = plan.start_pos[2]
    for item in plan.feet:
        begin = len(steps)
        if isinstance(item, Step):
            steps.append(item)
            height = item.z
        else:
            height = height if item.z is None else item.z
            steps += _walk(item, _mid(stands), plan.width, height)
        for step in steps[begin:]:
            stands[step.side] = np.array(step.to)
    for before, step in pairwise(steps):
        if step.start < before.end - 1e-9:
            raise PlanError(f"{plan.file}: feet: a step begins at {step.start} s, before that of {before.end} s ended")
    return steps


def _mid(stands: Mapping[str, np.ndarray]) -> np.ndarray:
    left, right = stands["left"], stands["right"]
    turn = (right[2] - left[2] + np.pi) % (2 * np.pi) - np.pi
    return np.array([*(left[:2] + right[:2]) / 2, left[2] + turn / 2])


def _beside(root: np.ndarray, side: str, width: float) -> np.ndarray:
    y = _LEFT[side] * width / 2
    return np.array([root[0] - y * np.sin(root[2]), root[1] + y * np.cos(root[2]), root[2]])


def _walk(walk: Walk, start: np.ndarray, width: float, height: float) -> list[Step]:
    legs = list(pairwise([start, *(np.array(waypoint) for waypoint in walk.path)]))
    strides = [
        max(np.linalg.norm(there[:2] - here[:2]) / walk.length, abs(there[2] - here[2]) / walk.turn)
        for here, there in legs
    ]
    wanted = int((walk.end - walk.start) / walk.step_time + 1e-6) - 1
    roots = [
        here + (there - here) * (i + 1) / count
        for (here, there), count in zip(legs, _step_counts(strides, wanted), strict=True)
        for i in range(count)
    ]
    roots.append(roots[-1])
    first = walk.first or ("left" if _sideways(start, np.array(walk.path[0])) >= 0 else "right")
    order = [first, "right" if first == "left" else "left"]
    period = (walk.end - walk.start) / len(roots)
    if period < MIN_STEP_TIME:
        raise PlanError(
            f"{walk.where}: {len(roots)} steps in {walk.end - walk.start:.2f} s are {period:.2f} s each; "
            f"needs {MIN_STEP_TIME} s or more: give it more time or longer steps"
        )
    steps = []
    for i, root in enumerate(roots):
        side = order[i % 2]
        begin = walk.start + i * period
        x, y, yaw = (float(value) for value in _beside(root, side, width))
        steps.append(Step(side, begin + walk.double_support * period, begin + period, (x, y, yaw), height, walk.height))
    return steps


def _step_counts(strides: Sequence[float], wanted: int) -> list[int]:
    """Steps for each leg of a walk: as many as its strides of full length, and more up to the number wanted in all,
    each where steps are longest."""
    counts = [max(1, int(np.ceil(stride - 1e-6))) for stride in strides]
    while sum(counts) < wanted:
        counts[int(np.argmax([stride / count for stride, count in zip(strides, counts, strict=True)]))] += 1
    return counts


def _sideways(start: np.ndarray, there: np.ndarray) -> float:
    """Above zero where the path turns or goes to the left."""
    dx, dy = there[:2] - start[:2]
    return float(-np.sin(start[2]) * dx + np.cos(start[2]) * dy + there[2] - start[2])


def footprints(plan: Plan, steps: Sequence[Step], time: np.ndarray) -> dict[str, np.ndarray]:
    """Where each foot stands or is on its way to: x, y, yaw and height of the ground, by side. [T, 4]"""
    root = np.array([*plan.start_pos[:2], plan.start_yaw])
    prints = {side: np.tile([*_beside(root, side, plan.width), plan.start_pos[2]], (len(time), 1)) for side in SIDES}
    for step in steps:
        there = np.array([*step.to, step.z])
        prints[step.side] += _share(step, time) * (there - prints[step.side])
    return prints


def root_path(prints: Mapping[str, np.ndarray], time: np.ndarray) -> PosePath:
    """The heading frame on the ground between the feet, without sway."""
    mid = (prints["left"] + prints["right"]) / 2
    mid = gaussian_filter1d(mid, ROOT_SMOOTHING / (time[1] - time[0]), axis=0, mode="nearest")
    return PosePath(mid[:, [0, 1, 3]], about("z", mid[:, 2]))


def foot_path(
    plan: Plan,
    side: str,
    steps: Sequence[Step],
    footprint: np.ndarray,
    time: np.ndarray,
    frames: Mapping[str, PosePath],
    effector: tuple[Sequence[float], Sequence[float]] | None = None,
) -> tuple[PosePath, np.ndarray]:
    """The ankle's path, and where the foot is in contact with what `via` keys let it touch, bool [T].

    Args:
        footprint: of this foot. [T, 4]
        frames: of `via` keys.
        effector: point on the foot and target of the task's end effector on it, if there is one.
    """
    ankle = np.array([0.0, 0.0, ANKLE_HEIGHT])
    path = PosePath(footprint[:, [0, 1, 3]] + ankle, about("z", footprint[:, 2]))
    contact = np.zeros(len(time), bool)
    for step in steps:
        if step.side != side:
            continue
        if step.via:
            swing = (time > step.start) & (time < step.end)
            swung, touches = _via_path(step, path, time, frames, effector)
            contact |= touches & swing
            rot = np.where(swing[:, None], swung.rot.as_quat(), path.rot.as_quat())
            path = PosePath(np.where(swing[:, None], swung.pos, path.pos), Rotation.from_quat(rot))
        else:
            u = np.clip((time - step.start) / (step.end - step.start), 0.0, 1.0)
            path.pos[:, 2] += step.height * 16 * (u * (1 - u)) ** 2
    return _raise_heel(path, value_path(plan.heels.get(side, ()), "pitch", time, 0.0)), contact


def stances(steps: Sequence[Step], time: np.ndarray) -> dict[str, np.ndarray]:
    """Whether each foot is on the ground, by side. bool [T]"""
    ground = {side: np.ones(len(time), bool) for side in SIDES}
    for step in steps:
        ground[step.side] &= (time <= step.start + 1e-9) | (time >= step.end - 1e-9)
    return ground


def _share(step: Step, time: np.ndarray) -> np.ndarray:
    swing = (1.0 if step.via else OVER_PLACE) * (step.end - step.start)  # a foot with a way of its own keeps to that
    return minimum_jerk((time - step.start) / swing)[:, None]


def _via_path(
    step: Step,
    path: PosePath,
    time: np.ndarray,
    frames: Mapping[str, PosePath],
    effector: tuple[Sequence[float], Sequence[float]] | None,
) -> tuple[PosePath, np.ndarray]:
    """From where the foot is lifted through the keys to where it lands. Keys place the effector's point."""
    point, target = effector or ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    t = int(np.searchsorted(time, step.start))
    lifted, landed = path.pos[t], np.array([step.to[0], step.to[1], step.z + ANKLE_HEIGHT])
    ends = {}
    for name, pos, rot in (("_lifted", lifted, path.rot[t]), ("_landed", landed, Rotation.from_euler("z", step.to[2]))):
        ends[name] = PosePath.fixed(pos + rot.apply(point), rot, len(time))
    keys = [
        PoseKey(step.start, frame="_lifted", pos=(0.0, 0.0, 0.0)),
        *step.via,
        PoseKey(step.end, frame="_landed", pos=(0.0, 0.0, 0.0)),
    ]
    through, touches = pose_path(keys, {**frames, **ends}, time, target)
    return PosePath(through.pos - through.rot.apply(point), through.rot), touches


def _raise_heel(path: PosePath, pitch: np.ndarray) -> PosePath:
    """Turns the foot about its toes."""
    if not pitch.any():
        return path
    rot = path.rot * about("y", pitch)
    return PosePath(path.apply(TOES) - rot.apply(TOES), rot)


def centre_of_pressure(
    plan: Plan, steps: Sequence[Step], prints: Mapping[str, np.ndarray], time: np.ndarray
) -> np.ndarray:
    """Planned centre of pressure and the height of the ground there: over one foot while the other swings, between
    both while standing, or where `balance` says. [T, 3]"""
    start, end = float(time[0]), float(time[-1])

    def over(moment: float, *sides: str) -> tuple[float, np.ndarray]:
        t = min(int(np.searchsorted(time, moment - 1e-9)), len(time) - 1)
        rows = np.array([prints[side][t] for side in sides])
        ahead = SOLE_CENTRE * np.column_stack([np.cos(rows[:, 2]), np.sin(rows[:, 2])])
        return moment, np.column_stack([rows[:, :2] + ahead, rows[:, 3]]).mean(0)

    knots = [over(start, *SIDES)]
    for i, step in enumerate(steps):
        other = "right" if step.side == "left" else "left"
        before = steps[i - 1].end if i else start
        if i == 0 or step.start - before > 2 * SHIFT_TIME:
            if i:
                knots.append(over(before + SHIFT_TIME, *SIDES))
            knots.append(over(max(step.start - SHIFT_TIME, before), *SIDES))
        knots += [over(step.start, other), over(step.end, other)]
    if steps:
        knots.append(over(min(steps[-1].end + SHIFT_TIME, end), *SIDES))
    out = np.tile(knots[0][1], (len(time), 1))
    for (begin, value), (finish, following) in pairwise(knots):
        if finish > begin:
            out += minimum_jerk((time - begin) / (finish - begin))[:, None] * (following - value)
    return _rebalanced(plan, out, time)


def _rebalanced(plan: Plan, pressure: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Moves the centre of pressure to where `balance` keys want it."""
    out, before = pressure, None
    for key in plan.balance:
        over = pressure.copy()
        if key.values["over"] != "feet":
            over[:, :2] = key.values["over"]
        begin = key.time - SHIFT_TIME if before is None else before.time
        out = out + minimum_jerk((time - begin) / (key.time - begin))[:, None] * (over - out)
        before = key
    return out
