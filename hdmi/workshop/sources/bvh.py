"""BVH files, such as those of LAFAN1."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Unpack

import numpy as np
from scipy.spatial.transform import Rotation

from hdmi.motion.check import MotionError
from hdmi.motion.files import read_text, reading
from hdmi.workshop.human import SMPL_JOINTS, SMPL_PARENTS, HumanMotion
from hdmi.workshop.skeleton import anthropometric_skeleton, height_from_legs
from hdmi.workshop.sources.joint_names import read_names, smpl_names
from hdmi.workshop.sources.world import World, checked_height, fps_of, placed, unit_of, without_blank_ends

ANGLES = ("degrees", "radians")
_CHANNELS = tuple(f"{axis}{kind}" for kind in ("position", "rotation") for axis in "XYZ")
_MAX_JOINTS = 1000
_MOTION = re.compile(r"(?<!\S)MOTION\s+Frames\s*:\s*(\S+)\s+Frame\s*Time\s*:\s*(\S+)", re.IGNORECASE)
# A file in which nothing turns by a full turn of radians, but so many channels by 45 deg if it is in radians
_TURNED, _TURNS = 0.8, 4


@dataclass
class _Joint:
    name: str
    parent: int
    offset: tuple[float, ...] = ()
    channels: list[str] = field(default_factory=list)


def read_bvh(
    path: str | Path,
    height: float | None = None,
    fps: float | None = None,
    names: str | Path | None = None,
    angles: str | None = None,
    **world: Unpack[World],
) -> HumanMotion:
    """A motion from a BVH file, in centimetres and with y up unless `world` says otherwise.

    Joints get SMPL's names by what exporters call them (`smpl_names`), others keep theirs. The rest pose is that of the
    OFFSETs; a joint with position channels is where they say in each frame, and not at its OFFSET. If they are zero
    throughout, they move it relative to that. Orientations are kept where the rest pose is a T-pose, as SMPL's is,
    whatever its heading (LAFAN1's is none); otherwise a note says why not.

    Args:
        height: of the person, m; from the length of the legs if not given.
        fps: instead of the file's Frame Time.
        names: YAML file with SMPL's names for joints, one `theirs: ours` a line.
        angles: `degrees`, what BVH files are in, or `radians`.
        world: see `World`.

    Raises:
        MotionError: if the file is not a BVH file, or its joints are not a person's.
    """
    path = Path(path)
    text = read_text(path).lstrip("\ufeff")
    header = _MOTION.search(text)
    if header is None:
        if re.search(r"(?<!\S)MOTION(?!\S)", text, re.IGNORECASE) is None:
            raise MotionError(f"{path}: not a BVH file: no MOTION section")
        raise MotionError(f"{path}: MOTION: 'Frames: N' and 'Frame Time: S' expected")
    joints = _parse_hierarchy(path, text[: header.start()].split())
    frame_time, values = _parse_motion(path, header, text[header.end() :].split(), joints)
    with reading(path):
        rate, notes = _rate(fps, frame_time)
        unit = unit_of(world, 0.01)
        kept, dropped = without_blank_ends(values)
        pos, mat = _pose(joints, values[kept], _in_radians(joints, values, angles))
        theirs = [joint.name for joint in joints]
        ours = smpl_names(theirs, None if names is None else read_names(names, theirs))
        if "pelvis" not in ours:
            raise MotionError(f"joint_names: no root Hips among {', '.join(theirs)}: say in names=FILE which it is")
        pos *= unit
        known = height
        if height is None or all(f"left_{part}" in ours for part in ("hip", "knee", "ankle")):
            known = checked_height(height_from_legs(ours, pos), unit, world, height)
        assert known is not None
        rest = _rest_frame(ours, _rest_pos(joints))
        quat = None
        if isinstance(rest, str):
            notes += (f"orientations are not used, hands and trunk are turned as positions tell: {rest}",)
        else:
            quat = Rotation.from_matrix((mat @ rest).reshape(-1, 3, 3)).as_quat(scalar_first=True)
            quat = quat.reshape(*mat.shape[:2], 4)
        motion = HumanMotion(path.stem, rate, known, ours, pos, quat, notes=notes + dropped)
        return placed(motion, "y", unit, world)


def _parse_hierarchy(path: Path, tokens: list[str]) -> list[_Joint]:
    joints: list[_Joint] = []
    stack: list[int] = []
    pending = -2  # of whom the next brace opens the block; -1: an end site
    i = 0

    def numbers(count: int) -> tuple[float, ...]:
        try:
            found = tuple(float(token) for token in tokens[i + 1 : i + 1 + count])
        except ValueError as error:
            raise MotionError(f"{path}: HIERARCHY: OFFSET: {error}") from error
        if len(found) != count or not np.isfinite(found).all():
            raise MotionError(f"{path}: HIERARCHY: OFFSET: {count} finite numbers expected")
        return found

    while i < len(tokens):
        token = tokens[i].upper()
        if token in ("ROOT", "JOINT"):
            if (token == "ROOT") == bool(joints) or i + 1 >= len(tokens) or len(joints) >= _MAX_JOINTS:
                raise MotionError(f"{path}: HIERARCHY: a single ROOT and up to {_MAX_JOINTS} named joints expected")
            parent = stack[-1] if stack else -1
            if token == "JOINT" and parent < 0:
                raise MotionError(f"{path}: HIERARCHY: JOINT {tokens[i + 1]!r} hangs from no joint")
            words = _name(tokens[i + 1 :])
            joints.append(_Joint(" ".join(words).rpartition(":")[2], parent))
            pending = len(joints) - 1
            i += 1 + len(words)
        elif token == "END":
            pending = -1
            i += 2
        elif token == "{":
            if pending == -2:
                raise MotionError(f"{path}: HIERARCHY: brace without a joint")
            stack.append(pending)
            pending = -2
            i += 1
        elif token == "}":
            if not stack:
                raise MotionError(f"{path}: HIERARCHY: unbalanced braces")
            stack.pop()
            i += 1
        elif token == "OFFSET":
            offset = numbers(3)
            if stack and stack[-1] >= 0:
                joints[stack[-1]].offset = offset
            i += 4
        elif token == "CHANNELS":
            if not stack or stack[-1] < 0 or not tokens[i + 1 : i + 2] or not tokens[i + 1].isdecimal():
                raise MotionError(f"{path}: HIERARCHY: CHANNELS of no joint, or without their count")
            count = min(int(tokens[i + 1][:9]), len(tokens))
            named = tokens[i + 2 : i + 2 + count]
            channels = [channel.capitalize() for channel in named]
            unknown = [channel for channel in named if channel.capitalize() not in _CHANNELS]
            if unknown or len(channels) != count or len(set(channels)) != count:
                wrong = f"{unknown[0][:40]!r} is none" if unknown else "each at most once"
                raise MotionError(
                    f"{path}: HIERARCHY: CHANNELS of {joints[stack[-1]].name!r}: {tokens[i + 1][:9]} of "
                    f"{', '.join(_CHANNELS)} expected; {wrong}"
                )
            joints[stack[-1]].channels = channels
            i += 2 + count
        elif token == "HIERARCHY":
            i += 1
        else:
            raise MotionError(f"{path}: HIERARCHY: unexpected {tokens[i][:40]!r}")
    if not joints or stack:
        raise MotionError(f"{path}: HIERARCHY: {'unbalanced braces' if stack else 'no ROOT'}")
    for joint in joints:
        if not joint.offset:
            raise MotionError(f"{path}: HIERARCHY: {joint.name!r} has no OFFSET")
    return joints


def _name(tokens: list[str]) -> list[str]:
    """The words of a joint's name: up to the brace, if there is one soon."""
    words = tokens[: tokens.index("{")] if "{" in tokens[1:5] else tokens[:1]
    return words or tokens[:1]


def _parse_motion(
    path: Path, header: re.Match[str], tokens: list[str], joints: list[_Joint]
) -> tuple[float, np.ndarray]:
    """Frame Time and channels [T, C]."""
    width = sum(len(joint.channels) for joint in joints)
    try:
        num_frames, frame_time = int(header[1]), float(header[2])
    except ValueError as error:
        raise MotionError(f"{path}: MOTION: Frames or Frame Time: {_shortened(error)}") from error
    try:
        values = np.array(tokens, dtype=float)
    except ValueError as error:
        bad = next((i for i, token in enumerate(tokens) if not _is_number(token)), 0)
        where = f" at frame {bad // width}, channel {bad % width}" if width else ""
        raise MotionError(f"{path}: MOTION: {_shortened(error)}{where}") from error
    if not width or num_frames < 2 or values.size != num_frames * width:
        raise MotionError(
            f"{path}: MOTION: {values.size} numbers for {num_frames} frames of {width} channels; needs 2 frames"
        )
    values = values.reshape(num_frames, width)
    if (bad_values := np.argwhere(~(np.abs(values) < 1e9))).size:
        frame, channel = bad_values[0]
        raise MotionError(f"{path}: MOTION: {values[frame, channel]} at frame {frame}, channel {channel}")
    return frame_time, values


def _shortened(error: Exception) -> str:
    text = str(error).splitlines()[0][:120]
    return f"{text}: a decimal point expected" if re.search(r"\d,\d", text) else text


def _is_number(token: str) -> bool:
    try:
        float(token)
    except ValueError:
        return False
    return True


def _rate(given: float | None, frame_time: float) -> tuple[float, tuple[str, ...]]:
    if not 1e-3 <= frame_time <= 1:
        if given is None:
            raise MotionError(
                f"MOTION: Frame Time must be from 0.001 to 1 s, got {frame_time}; give source_fps, frames per second"
            )
        return fps_of(given, None, "Frame Time")
    fps = 1.0 / frame_time
    return fps_of(given, float(round(fps)) if abs(fps - round(fps)) < 1e-3 * fps else fps, "its Frame Time")


def _in_radians(joints: list[_Joint], values: np.ndarray, angles: str | None) -> bool:
    if angles not in (None, *ANGLES):
        raise MotionError(f"angles: {' or '.join(ANGLES)} expected, got {angles!r}")
    # the root may have turned around several times
    inner = [joint.parent >= 0 and channel.endswith("rotation") for joint in joints for channel in joint.channels]
    largest = np.abs(values[:, inner]).max(0, initial=0.0)
    if angles is None and largest.max(initial=0.0) <= 2 * np.pi and (largest > _TURNED).sum() >= _TURNS:
        raise MotionError(
            f"MOTION: no joint turns by more than {largest.max():.2f}: are angles in radians? Give angles=radians, or "
            "angles=degrees"
        )
    return angles == "radians"


def _pose(joints: list[_Joint], values: np.ndarray, radians: bool) -> tuple[np.ndarray, np.ndarray]:
    """Positions [T, J, 3] in the file's unit, and orientations [T, J, 3, 3]."""
    num_frames = len(values)
    pos, mat = np.zeros((num_frames, len(joints), 3)), np.zeros((num_frames, len(joints), 3, 3))
    relative = _moves_from_offset(joints, values)
    column = 0
    for j, joint in enumerate(joints):
        local = np.tile(np.asarray(joint.offset, dtype=float), (num_frames, 1))
        order, angles = "", []
        for channel in joint.channels:
            axis, kind = channel[0], channel[1:]
            if kind == "rotation":
                order += axis
                angles.append(values[:, column])
            elif relative and joint.parent >= 0:
                local[:, "XYZ".index(axis)] += values[:, column]
            else:  # takes the place of the offset
                local[:, "XYZ".index(axis)] = values[:, column]
            column += 1
        turn = np.tile(np.eye(3), (num_frames, 1, 1))
        for axis, angle in zip(order, angles, strict=True):
            turn = turn @ Rotation.from_euler(axis.lower(), angle[:, None], degrees=not radians).as_matrix()
        if joint.parent < 0:
            pos[:, j], mat[:, j] = local, turn
        else:
            pos[:, j] = pos[:, joint.parent] + np.einsum("tij,tj->ti", mat[:, joint.parent], local)
            mat[:, j] = mat[:, joint.parent] @ turn
    return pos, mat


def _moves_from_offset(joints: list[_Joint], values: np.ndarray) -> bool:
    """Whether position channels of joints below the root are zero throughout, though their offsets are not."""
    inner = [joint.parent >= 0 and channel.endswith("position") for joint in joints for channel in joint.channels]
    return any(inner) and not values[:, inner].any()


def _rest_pos(joints: list[_Joint]) -> np.ndarray:
    """Where joints are if nothing is turned, in the file's unit. [J, 3]"""
    rest = np.array([joint.offset for joint in joints], dtype=float)
    for j, joint in enumerate(joints):
        if joint.parent >= 0:
            rest[j] += rest[joint.parent]
    return rest


def _rest_frame(names: tuple[str, ...], rest: np.ndarray) -> np.ndarray | str:
    """SMPL's axes, x to the left, y up and z forward, of a T-pose along the file's axes; or why it is none. [3, 3]

    Limbs have to point where SMPL's do at rest, to within 25 degrees.
    """
    parents = {joint: SMPL_JOINTS[parent] for joint, parent in zip(SMPL_JOINTS[1:], SMPL_PARENTS[1:], strict=True)}
    limbs = [joint for joint in parents if joint.partition("_")[2] in ("knee", "ankle", "elbow", "wrist")]
    if missing := sorted(({*limbs} | {parents[joint] for joint in limbs}) - set(names)):
        return f"the file lacks {', '.join(missing)}"
    bones = {joint: rest[names.index(joint)] - rest[names.index(parents[joint])] for joint in limbs}
    left, up = bones["left_elbow"] - bones["right_elbow"], -bones["left_knee"] - bones["right_knee"]
    axes = np.zeros((2, 3))
    for axis, direction in zip(axes, (left, up), strict=True):
        i = int(np.abs(direction).argmax())
        axis[i] = np.sign(direction[i])
    frame = np.stack([axes[0], axes[1], np.cross(*axes)], axis=-1)
    skeleton = anthropometric_skeleton(1.7)
    for joint, bone in bones.items():
        offset = skeleton.offset[skeleton.index(joint)]
        lengths = np.linalg.norm(bone) * np.linalg.norm(offset)
        if not lengths:
            return f"in its rest pose {joint} is where {parents[joint]} is"
        if not bone @ frame @ offset >= np.cos(np.radians(25)) * lengths:
            return f"its rest pose is no T-pose (from {parents[joint]} to {joint})"
    return frame
