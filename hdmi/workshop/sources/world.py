"""The world of a person's file: which of its axes points up, how long its unit is, where its ground is, its rate.

Files do not say any of it. Each format has its usual answer; where the person contradicts that, there is an error that
names the option with which to answer, and an answer that is given is believed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypedDict

import numpy as np
from scipy.spatial.transform import Rotation

from hdmi.motion.check import MotionError, checked_fps
from hdmi.workshop.human import HumanMotion
from hdmi.workshop.skeleton import grounded

# Of each axis of a file that may point up, what turns it to z. An axis that need not move does not.
AXES: dict[str, Rotation] = {
    "x": Rotation.from_matrix([[0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "y": Rotation.from_matrix([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "z": Rotation.identity(),
    "-x": Rotation.from_matrix([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "-y": Rotation.from_matrix([[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "-z": Rotation.from_matrix([[1, 0, 0], [0, -1, 0], [0, 0, -1]]),
}

_UNITS = {0.001: "millimetres", 0.01: "centimetres", 0.0254: "inches", 0.0564: "CMU's", 0.3048: "feet", 1.0: "metres"}
_ADULT = (1.3, 2.1)  # m, for guessing a unit
_PERSON = (1.0, 2.5)  # m; what is smaller is more often in inches than a child
_FASTEST = 10.0  # m/s, on average
_REMOTEST = 1e4  # m from the origin, where float32 still has millimetres
_STEADY, _TRAVELS = 0.15, 1.0  # m, of how the lowest joint's height varies: there is ground, there is none


class World(TypedDict, total=False):
    """How the world of a file is read; what is absent or None is as usual for the format.

    Attributes:
        up: the axis of the file that points up: x, y, z, -x, -y or -z.
        unit: of the file's lengths, m.
        ground: `shift` the motion vertically until the lowest sole touches the ground, or `keep` its height. Usually
            it is kept, but shifted if the body is not the one that the file was made with.
    """

    up: str | None
    unit: float | None
    ground: str | None


def unit_of(world: World, usual: float) -> float:
    """The unit of the file's lengths, m.

    Raises:
        MotionError: if it cannot be one.
    """
    unit = world.get("unit")
    unit = usual if unit is None else unit
    if not 0 < unit < np.inf:
        raise MotionError(f"unit: metres, more than 0, expected, got {unit:g}")
    return unit


def fps_of(given: float | None, told: float | None, source: str) -> tuple[float, tuple[str, ...]]:
    """The rate that is given, or else the one that is told, and a note if both are and they differ.

    Args:
        source: what tells it or would have, for the messages.

    Raises:
        MotionError: if there is none, or it cannot be one.
    """
    if given is not None:
        fps = checked_fps("source_fps", given)
        if told is None or np.isclose(fps, told, rtol=1e-3):
            return fps, ()
        return fps, (f"read at the {fps:g} fps that source_fps says; {source} says {told:g}",)
    if told is None:
        raise MotionError(f"no {source} says how many frames a second has: give source_fps")
    try:
        return checked_fps(source, told), ()
    except MotionError as error:
        raise MotionError(f"{error}; give source_fps") from error


def checked_height(legs: float, unit: float, world: World, height: float | None) -> float:
    """The height that is given, or else the one that the legs tell, m.

    Args:
        legs: height that goes with their length, with the unit taken, m.

    Raises:
        MotionError: if the legs are no person's, or not those of a person of this height. Names the unit with which
            they would be.
    """
    if height is not None and not 0.5 <= height <= _PERSON[1]:
        raise MotionError(f"height: metres, from 0.5 to {_PERSON[1]:g}, expected, got {height:g}")
    known = legs if height is None else height
    believed = world.get("unit") is not None or height is not None
    lowest, highest = (0.5, _PERSON[1]) if believed else _PERSON
    fits = lowest <= legs <= highest and (world.get("unit") is not None or 2 / 3 < legs / known < 3 / 2)
    if fits:
        return known
    others = [(other, legs / unit * other) for other in _UNITS]
    hints = [
        f"unit={other:g} ({_UNITS[other]}) makes it {person:.2f} m"
        for other, person in others
        if _ADULT[0] <= person <= _ADULT[1]
    ]
    hint = hints[0] if hints else f"give unit={unit:g} if it is"
    other = "" if height is None else f", not {height:g}"
    raise MotionError(f"height: by its legs the person is {legs:.3g} m tall{other}: is unit={unit:g} m right? {hint}")


def without_blank_ends(rows: np.ndarray) -> tuple[slice, tuple[str, ...]]:
    """Which frames are left without the blank ones before and after the motion, and a note if some are not.

    Nothing is dropped if fewer than 2 frames would be left.

    Args:
        rows: that are all zero where a frame is blank. [T, W]
    """
    full = np.flatnonzero((rows != 0).sum(1))
    if len(full) < 2 or len(full) == len(rows):
        return slice(None), ()
    first, last = int(full[0]), int(full[-1])
    dropped = [
        f"{stop - start} blank frame{'s' * (stop - start > 1)} {where}"
        for start, stop, where in ((0, first, "at the start"), (last + 1, len(rows), "at the end"))
        if stop > start
    ]
    return slice(first, last + 1), ((f"dropped {' and '.join(dropped)}",) if dropped else ())


def placed(motion: HumanMotion, usual_up: str, unit: float, world: World, *, own_body: bool = True) -> HumanMotion:
    """A motion in the file's axes, with lengths in m, in ours: z up, and on the ground if it is to be shifted there.

    Args:
        usual_up: the axis that points up in files of the format.
        unit: that was taken, m, for messages.
        own_body: whether the body is the one that the file was made with.

    Raises:
        MotionError: for unknown options, or if the person contradicts what is taken for granted: does not stand, but
            would if another axis pointed up, moves faster than persons do, or is far from the ground.
    """
    up, ground = world.get("up"), world.get("ground")
    axis = usual_up if up is None else up
    if axis not in AXES:
        raise MotionError(f"up: the axis that points up is one of {', '.join(AXES)}, got {axis!r}")
    if world.get("unit") is None:
        _check_lengths(motion, unit)
    motion = motion.turned(AXES[axis])
    lean = _lean(motion)
    if lean is not None and lean[2] < 0.5:
        better = None if up is not None else _better_axis(motion, lean)
        angle = f"in the median frame the trunk leans {_degrees(lean[2]):.0f} deg from up={axis}"
        if better is not None:
            file_axis = _name(AXES[axis].inv().apply(better))
            raise MotionError(
                f"up: {angle} and {_degrees(lean @ better):.0f} deg from {file_axis}: give up={file_axis}, or "
                f"up={axis} if the person does lie like this"
            )
        motion = replace(motion, notes=(*motion.notes, angle))
    if ground is None and own_body:
        return motion
    return motion if ground == "keep" else grounded(motion, ground, slack=0.0)


def _check_lengths(motion: HumanMotion, unit: float) -> None:
    path = motion.pos("pelvis").astype(float)
    steps = np.sort(np.linalg.norm(np.diff(path, axis=0), axis=-1))[:-1]  # one jump is no unit
    speed = float(steps.mean()) * motion.fps if len(steps) else 0.0
    if speed > _FASTEST:
        raise MotionError(
            f"the pelvis moves at {speed:.3g} m/s on average: is unit={unit:g} m right, and {motion.fps:g} fps? "
            "Give unit or source_fps"
        )
    if (distance := float(np.abs(path).max())) > _REMOTEST:
        raise MotionError(f"the pelvis is {distance:.3g} m from the origin: is unit={unit:g} m right? Give it")


def _lean(motion: HumanMotion) -> np.ndarray | None:
    """Median direction of the trunk, from the hips to the shoulders. [3]"""
    hips, shoulders = _middle(motion, "hip"), _middle(motion, "shoulder")
    if hips is None or shoulders is None:
        return None
    trunk = shoulders - hips
    length = np.linalg.norm(trunk, axis=-1, keepdims=True)
    return np.median(trunk / np.maximum(length, 1e-6), axis=0)


def _better_axis(motion: HumanMotion, lean: np.ndarray) -> np.ndarray | None:
    """The axis, if there is one, that the person would clearly stand, or sit, along. [3]

    Somebody who gets ahead in the direction of the trunk while the lowest joint keeps its height crawls, and somebody
    whose hands are below the head stands on them.
    """
    axis = np.zeros(3)
    axis[np.abs(lean).argmax()] = np.sign(lean[np.abs(lean).argmax()])
    hips, ankles = _middle(motion, "hip"), _middle(motion, "ankle")
    assert hips is not None
    if lean @ axis < 0.8 or (ankles is not None and np.median((hips - ankles) @ axis) < 0.1 * motion.height):
        return None
    if axis[2] < 0:
        hands = _middle(motion, "wrist")
        head = motion.pos("head") if "head" in motion.joint_names else _middle(motion, "shoulder")
        on_hands = hands is not None and head is not None and np.median(hands[:, 2] - head[:, 2]) < 0
        return None if on_hands else axis
    ours, its = (np.ptp(np.percentile((motion.joint_pos @ a).min(1), (5, 95))) for a in (np.array([0, 0, 1]), axis))
    return None if ours < _STEADY and its > _TRAVELS else axis


def _middle(motion: HumanMotion, part: str) -> np.ndarray | None:
    """Between the left and the right joint. [T, 3]"""
    names = [f"{side}_{part}" for side in ("left", "right")]
    if not set(names) <= set(motion.joint_names):
        return None
    return np.mean([motion.pos(name) for name in names], axis=0)


def _degrees(cosine: float) -> float:
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _name(axis: np.ndarray) -> str:
    i = int(np.abs(axis).argmax())
    return ("-" if axis[i] < 0 else "") + "xyz"[i]
