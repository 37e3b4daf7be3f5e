"""The orders in which projects write the robot's joints where their files name none."""

from __future__ import annotations

import warnings
from collections import deque

import numpy as np

from hdmi.assets import g1
from hdmi.motion.check import MotionError
from hdmi.workshop.sources.conventions import beyond_range


def breadth_first() -> tuple[list[int], list[int]]:
    """Numbers in the table of Isaac Lab's joints and bodies, in its order."""
    bodies, queue = [], deque(["pelvis"])
    while queue:
        name = queue.popleft()
        bodies.append(g1.BODY_NAMES.index(name))
        queue.extend(body.name for body in g1.BODIES if body.parent == name)
    moved_by = {joint.body: j for j, joint in enumerate(g1.JOINTS)}
    return [moved_by[g1.BODY_NAMES[b]] for b in bodies if g1.BODY_NAMES[b] in moved_by], bodies


def _without(*parts: str) -> tuple[str, ...]:
    return tuple(name for name in g1.JOINT_NAMES if not any(part in name for part in parts))


def _with_hands() -> tuple[str, ...]:
    names: list[str] = []
    fingers = ("thumb_0", "thumb_1", "thumb_2", "middle_0", "middle_1", "index_0", "index_1")
    for name in g1.JOINT_NAMES:
        names.append(name)
        if name.endswith("wrist_yaw_joint"):
            side = name.partition("_")[0]
            names += [f"{side}_hand_{finger}_joint" for finger in fingers]
    return tuple(names)


# by the name of the robot description; of those with as many joints, the first is the usual one
LAYOUTS: dict[str, tuple[str, ...]] = {
    "g1_29dof": g1.JOINT_NAMES,
    "g1_29dof_isaac": tuple(g1.JOINT_NAMES[j] for j in breadth_first()[0]),
    "g1_29dof_with_hand": _with_hands(),
    "g1_29dof_lock_waist": _without("waist_roll", "waist_pitch"),
    "g1_23dof": _without("waist_roll", "waist_pitch", "wrist_pitch", "wrist_yaw"),
    "g1_29dof_anneal_23dof": _without("wrist"),
}
COUNTS = sorted({len(names) for names in LAYOUTS.values()})
_OUT = 0.05  # rad beyond its range that a joint may be


def choose_layout(where: str, angles: np.ndarray, given: str | None, usual: str | None = None) -> tuple[str, ...]:
    """Names of the joints whose angles a file has.

    Args:
        where: what messages start with: file and field.
        angles: rad. [T, J]
        given: a name in `LAYOUTS`, believed.
        usual: the one that is taken, if it has so many joints, and else is the first that has.

    Raises:
        MotionError: if there is none of so many joints, or the usual one bends joints beyond their ranges and another
            does not.
    """
    count = angles.shape[1]
    if given is not None:
        if given not in LAYOUTS:
            raise MotionError(f"joints={given}: there is {', '.join(LAYOUTS)}")
        if len(LAYOUTS[given]) != count:
            raise MotionError(f"{where}: {count} joints; {given} has {len(LAYOUTS[given])}")
        return LAYOUTS[given]
    fitting = [name for name, names in LAYOUTS.items() if len(names) == count]
    if not fitting:
        raise MotionError(f"{where}: {count} joints; this robot has {', '.join(map(str, COUNTS))}")
    first, *others = sorted(fitting, key=lambda name: name != usual)
    if _bent(first, angles) > 0.5:
        for other in others:
            if _bent(other, angles) < 0.1:
                raise MotionError(
                    f"{where}: joints are bent beyond their ranges in most frames in the order of {first}, "
                    f"and are not in that of {other}: give joints={other}, or joints={first} if it is meant"
                )
    if count == 23:
        warnings.warn(f"{where}: 23 joints, taken as those of {first}; else give joints={others[0]}", stacklevel=2)
    return LAYOUTS[first]


def _bent(layout: str, angles: np.ndarray) -> float:
    """Share of the frames in which a joint is beyond its range."""
    known = [i for i, name in enumerate(LAYOUTS[layout]) if name in g1.JOINT_NAMES]
    beyond = beyond_range([LAYOUTS[layout][i] for i in known], angles[:, known])
    return float((beyond.max(axis=1) > _OUT).mean())
