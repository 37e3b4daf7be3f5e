"""BVH files, such as those of LAFAN1."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from hdmi.motion.check import MotionError
from hdmi.motion.files import read_text, reading
from hdmi.motion.human import SMPL_JOINTS, SMPL_PARENTS, HumanMotion
from hdmi.motion.skeleton import anthropometric_skeleton, height_from_legs, z_up, z_up_quat

_CHANNELS = tuple(f"{axis}{kind}" for kind in ("position", "rotation") for axis in "XYZ")
_MAX_JOINTS = 1000


def _sided(**names: str) -> dict[str, str]:
    return {f"{side}{theirs}": f"{side.lower()}_{ours}" for theirs, ours in names.items() for side in ("Left", "Right")}


_TRUNK = {"Hips": "pelvis", "Spine": "spine1", "Spine1": "spine2", "Spine2": "spine3", "Neck": "neck", "Head": "head"}
# LAFAN1, Mixamo, CMU: the arm hangs from a shoulder
_ARM_NAMES = _TRUNK | _sided(
    UpLeg="hip", Leg="knee", Foot="ankle", Toe="foot", ToeBase="foot",
    Shoulder="collar", Arm="shoulder", ForeArm="elbow", Hand="wrist",
)  # fmt: skip
# others name the joints: the shoulder hangs from a collar
_JOINT_NAMES = _TRUNK | {"Chest": "spine1", "Chest2": "spine2", "Chest3": "spine3"} | _sided(
    Hip="hip", Knee="knee", Ankle="ankle", Toe="foot",
    Collar="collar", Shoulder="shoulder", Elbow="elbow", Wrist="wrist",
)  # fmt: skip


@dataclass
class _Joint:
    name: str
    parent: int
    offset: tuple[float, ...] = ()
    channels: list[str] = field(default_factory=list)


def read_bvh(
    path: str | Path, height: float | None = None, *, unit: float = 0.01, up: Literal["y", "z"] = "y"
) -> HumanMotion:
    """A motion from a BVH file.

    Joints with a name that LAFAN1, Mixamo, CMU or Vicon files use get SMPL's, others keep theirs. Orientations are
    kept where the file's rest pose is a T-pose, as SMPL's is (LAFAN1's is none).

    Args:
        height: of the person, m; from the length of the legs if not given.
        unit: of the file's lengths, m; centimetres unless said otherwise.
        up: the axis of the file that points up.

    Raises:
        MotionError: if the file is not a BVH file, or its joints are not a person's.
    """
    path = Path(path)
    head, marker, tail = read_text(path).partition("MOTION")
    if not marker:
        raise MotionError(f"{path}: not a BVH file: no MOTION section")
    joints = _parse_hierarchy(path, head.split())
    fps, values = _parse_motion(path, tail, sum(len(joint.channels) for joint in joints))
    pos, mat = _pose(joints, values)
    rest, _ = _pose(joints, np.zeros((1, values.shape[1])))
    pos, rest = pos * unit, rest * unit
    names = _smpl_names([joint.name for joint in joints])
    with reading(path):
        if "pelvis" not in names:
            raise MotionError(f"joint_names: no root Hips among {', '.join(joint.name for joint in joints)}")
        legs = height_from_legs(names, pos)
        if not 0.5 <= legs <= 2.5:
            raise MotionError(f"the legs are those of a person of {legs:.3g} m: is unit={unit} m right?")
        quat = None
        if up == "y" and _rests_in_t_pose(names, rest[0]):
            flat = Rotation.from_matrix(mat.reshape(-1, 3, 3)).as_quat(scalar_first=True)
            quat = z_up_quat(flat.reshape(*mat.shape[:2], 4))
        pos = z_up(pos) if up == "y" else pos
        return HumanMotion(path.stem, fps, legs if height is None else height, names, pos, quat)


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
        token = tokens[i]
        if token in ("ROOT", "JOINT"):
            if (token == "ROOT") == bool(joints) or i + 1 >= len(tokens) or len(joints) >= _MAX_JOINTS:
                raise MotionError(f"{path}: HIERARCHY: a single ROOT and up to {_MAX_JOINTS} named joints expected")
            parent = stack[-1] if stack else -1
            if token == "JOINT" and parent < 0:
                raise MotionError(f"{path}: HIERARCHY: JOINT {tokens[i + 1]!r} hangs from no joint")
            joints.append(_Joint(tokens[i + 1].rpartition(":")[2], parent))
            pending = len(joints) - 1
            i += 2
        elif token == "End":
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
            channels = tokens[i + 2 : i + 2 + count]
            if len(channels) != count or len(set(channels)) != count or not set(channels) <= set(_CHANNELS):
                raise MotionError(f"{path}: HIERARCHY: CHANNELS of {joints[stack[-1]].name!r}: {channels[:6]}")
            joints[stack[-1]].channels = channels
            i += 2 + count
        elif token == "HIERARCHY":
            i += 1
        else:
            raise MotionError(f"{path}: HIERARCHY: unexpected {token[:40]!r}")
    if not joints or stack:
        raise MotionError(f"{path}: HIERARCHY: {'unbalanced braces' if stack else 'no ROOT'}")
    for joint in joints:
        if not joint.offset:
            raise MotionError(f"{path}: HIERARCHY: {joint.name!r} has no OFFSET")
    return joints


def _parse_motion(path: Path, text: str, width: int) -> tuple[float, np.ndarray]:
    tokens = text.split()
    labels, times = [tokens[i : i + n] for i, n in ((0, 1), (2, 2))], (tokens[1:2], tokens[4:5])
    try:
        if labels != [["Frames:"], ["Frame", "Time:"]]:
            raise ValueError("'Frames: N' and 'Frame Time: S' expected")
        num_frames, frame_time = int(times[0][0]), float(times[1][0])
        values = np.array(tokens[5:], dtype=float)
    except (ValueError, IndexError) as error:
        raise MotionError(f"{path}: MOTION: {str(error).splitlines()[0][:120]}") from error
    if not 1e-3 <= frame_time <= 1:
        raise MotionError(f"{path}: MOTION: Frame Time must be from 0.001 to 1 s, got {frame_time}")
    if not width or num_frames < 2 or values.size != num_frames * width:
        raise MotionError(
            f"{path}: MOTION: {values.size} numbers for {num_frames} frames of {width} channels; needs 2 frames"
        )
    values = values.reshape(num_frames, width)
    if (bad := np.argwhere(~(np.abs(values) < 1e9))).size:
        raise MotionError(f"{path}: MOTION: {values[tuple(bad[0])]} at frame {bad[0][0]}, channel {bad[0][1]}")
    fps = 1.0 / frame_time
    return float(round(fps)) if abs(fps - round(fps)) < 1e-3 * fps else fps, values


def _pose(joints: list[_Joint], values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions [T, J, 3] in the file's unit, and orientations [T, J, 3, 3]."""
    num_frames = len(values)
    pos, mat = np.zeros((num_frames, len(joints), 3)), np.zeros((num_frames, len(joints), 3, 3))
    column = 0
    for j, joint in enumerate(joints):
        local = np.tile(np.asarray(joint.offset, dtype=float), (num_frames, 1))
        order, angles = "", []
        for channel in joint.channels:
            axis, kind = channel[0], channel[1:]
            if kind == "position":  # takes the place of the offset
                local[:, "XYZ".index(axis)] = values[:, column]
            else:
                order += axis
                angles.append(values[:, column])
            column += 1
        turn = np.tile(np.eye(3), (num_frames, 1, 1))
        for axis, angle in zip(order, angles, strict=True):
            turn = turn @ Rotation.from_euler(axis.lower(), angle[:, None], degrees=True).as_matrix()
        if joint.parent < 0:
            pos[:, j], mat[:, j] = local, turn
        else:
            pos[:, j] = pos[:, joint.parent] + np.einsum("tij,tj->ti", mat[:, joint.parent], local)
            mat[:, j] = mat[:, joint.parent] @ turn
    return pos, mat


def _smpl_names(theirs: list[str]) -> tuple[str, ...]:
    table = _ARM_NAMES if {"LeftArm", "LeftUpLeg"} & set(theirs) else _JOINT_NAMES
    ours: list[str] = []
    for name in theirs:
        mapped = table.get(name, name)
        ours.append(name if mapped in ours else mapped)
    return tuple(ours)


def _rests_in_t_pose(names: tuple[str, ...], rest: np.ndarray) -> bool:
    """Whether limbs point where SMPL's do at rest, to within 25 degrees."""
    offset = anthropometric_skeleton(1.7).offset
    for j, (name, parent) in enumerate(zip(SMPL_JOINTS, SMPL_PARENTS, strict=True)):
        if name.partition("_")[2] in ("knee", "ankle", "elbow", "wrist"):
            other = SMPL_JOINTS[parent]
            if name not in names or other not in names:
                return False
            bone = rest[names.index(name)] - rest[names.index(other)]
            lengths = np.linalg.norm(bone) * np.linalg.norm(offset[j])
            if bone @ offset[j] < np.cos(np.radians(25)) * lengths or not lengths:
                return False
    return True
