"""Tables of a robot's root and joints, as Unitree publishes its LAFAN1."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hdmi.assets import g1
from hdmi.motion.check import MotionError, checked, checked_fps
from hdmi.motion.complete import complete_robot, is_finger_joint
from hdmi.motion.files import read_text, write_text
from hdmi.motion.format import Motion
from hdmi.workshop.sources.conventions import Conventions
from hdmi.workshop.sources.layouts import COUNTS, LAYOUTS, choose_layout
from hdmi.workshop.sources.robot import lost_by, robot_motion

_DEFAULT_FPS = 30.0
_TIME = re.compile(r"(frame|index|idx|time|timestamp|t|i)(_?(id|index|idx|number|no|s|sec|seconds))?|seconds|unnamed_0")
_SECONDS = re.compile(r"(time|timestamp|t)(_(s|sec|seconds))?|seconds")
_ROOT = r"(root|base|pelvis|floating_base)?_?(link)?_?"
_POSITION = re.compile(_ROOT + r"(pos|position|p|translate|translation|trans|transl|t|xyz)?_?([xyz])")
_ROTATION = re.compile(_ROOT + r"(quat|quaternion|q|rotate|rotation|rot|r|orientation|ori|euler)_?(q?_?[wxyz])")
_ANGLES = ("roll", "pitch", "yaw")
_JOINT_AFFIXES = re.compile(r"^(dof|joint|q)_|_(joint|dof|pos|position|angle|q|rad|deg)$")


def read_robot_csv(
    path: str | Path, fps: float | None = None, *, joints: str | None = None, given: Conventions | None = None
) -> Motion:
    """A robot's motion as a table: root position, root orientation, joints.

    Unitree's LAFAN1 has 36 columns: position, xyzw, 29 joints in table order; other numbers of joints are those of
    `LAYOUTS`. Separators are commas, semicolons, tabs or blanks; lines that begin with `#` are skipped. A header that
    names the robot's joints decides about their order, one that names frames or time about these columns, one that
    names x, y, z, w about the root's (three rotations are roll, pitch and yaw about fixed axes, in the unit of the
    joints); any other is skipped. Bodies come from forward kinematics, velocities from differences.

    Args:
        fps: of the rows; if not given, from a column of seconds, else 30.
        joints: which they are, a name in `LAYOUTS`, where the file does not name them.
        given: how the file means its numbers.

    Raises:
        MotionError: if the file is not such a table, or the robot in it looks misread, see `settle`.
    """
    path, given = Path(path), given or Conventions()
    fps = fps if fps is None else checked_fps(path, fps)
    rows, header = _read_table(path)
    if len(rows) < 2:
        raise MotionError(f"{path}: rows: needs at least 2 frames, has {len(rows)}")
    columns = _Columns.find(path, header, rows.shape)
    rows = checked(path, "rows", rows, rows.shape)
    if fps is None:
        fps = _rate(path, None if columns.seconds is None else rows[:, columns.seconds])
    angles = given.radians(rows[:, columns.joints])
    names = columns.names or choose_layout(f"{path}: rows", angles, joints)
    where = f"columns {columns.rotation[0] + 1}-{columns.rotation[-1] + 1}"
    rotation = rows[:, columns.rotation]
    usual = columns.quat or "xyzw"
    if len(columns.rotation) == 3:
        turn = Rotation.from_euler("xyz", given.radians(rotation))
        rotation, usual = turn.as_quat(scalar_first=True).astype(np.float32), "wxyz"
        given = replace(given, quat="wxyz")
    return robot_motion(
        path, path.stem, fps, rows[:, columns.position], rotation, names, angles, given, usual, ("rows", where, "rows")
    )


def _rate(path: Path, seconds: np.ndarray | None) -> float:
    if seconds is not None:
        step = float(np.median(np.diff(seconds)))
        if 1e-3 <= step <= 1:
            return float(np.round(1 / step, 3))
    warnings.warn(f"{path}: does not say its rate, taken as {_DEFAULT_FPS:g} fps; else give source_fps", stacklevel=3)
    return _DEFAULT_FPS


def _read_table(path: Path) -> tuple[np.ndarray, list[str] | None]:
    """Numbers [T, C], and the names of the columns if the file has them."""
    lines = [(n, line.strip()) for n, line in enumerate(read_text(path).lstrip("\ufeff").splitlines(), 1)]
    lines = [(n, line) for n, line in lines if line]
    # numpy writes a header as a comment
    comments = [line.lstrip("#%/ ") for _, line in lines if line.startswith(("#", "%", "//"))]
    lines = [(n, line) for n, line in lines if not line.startswith(("#", "%", "//"))]
    if not lines:
        return np.empty((0, 0)), None
    last = lines[-1][1]
    separator = next((s for s in (";", "\t", ",") if s in last), None)

    def fields(line: str) -> list[str]:
        found = [field.strip().strip("\"'") for field in line.split(separator)]
        return found[:-1] if len(found) > 1 and not found[-1] else found

    header = None
    first = fields(lines[0][1])
    # a row with a damaged number or two is none
    if 2 * sum(_number(field, separator) is None for field in first) > len(first):
        header, lines = first, lines[1:]
        if not lines:
            raise MotionError(f"{path}: not a table of numbers: {', '.join(first)[:80]!r} and nothing else")
    rows: list[list[float]] = []
    for n, line in lines:
        row = fields(line)
        if rows and len(row) != len(rows[0]):
            raise MotionError(f"{path}: line {n}: {len(row)} columns, the line before has {len(rows[0])}")
        numbers = [_number(field, separator) for field in row]
        if None in numbers:
            i = numbers.index(None)
            raise MotionError(f"{path}: not a table of numbers: line {n}, column {i + 1}: {row[i]!r:.40}")
        rows.append([number for number in numbers if number is not None])
    if header is None:
        header = next((names for line in reversed(comments) if len(names := fields(line)) == len(rows[0])), None)
    if header is not None and len(header) != len(rows[0]):
        raise MotionError(f"{path}: the header names {len(header)} columns, the rows have {len(rows[0])}")
    return np.array(rows), header


def _number(field: str, separator: str | None) -> float | None:
    try:
        return None if "_" in field else float(field.replace(",", ".") if separator == ";" else field)
    except ValueError:
        return None


def _plain(name: str) -> str:
    """A name as lower-case words with underscores."""
    apart = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name)
    return re.sub(r"[^a-z0-9]+", "_", apart.lower()).strip("_")


_JOINT_OF = {name.removesuffix("_joint"): name for name in g1.JOINT_NAMES}


def _joint(name: str) -> str | None:
    plain, before = _plain(name), ""
    while plain != before:
        before, plain = plain, _JOINT_AFFIXES.sub("", plain)
    return _JOINT_OF.get(plain)


@dataclass(frozen=True)
class _Columns:
    """Which columns hold what."""

    position: list[int]
    rotation: list[int]  # four, or three of Euler angles
    joints: list[int]
    names: tuple[str, ...] | None = None  # of the joints, where the header has them
    quat: str | None = None
    seconds: int | None = None

    @classmethod
    def find(cls, path: Path, header: Sequence[str] | None, shape: tuple[int, ...]) -> _Columns:
        left, seconds = list(range(shape[1])), None
        if header is None:
            return cls._in_order(path, left, shape)
        for i, name in enumerate(header):
            if _TIME.fullmatch(_plain(name)) or (i == 0 and not name):
                left.remove(i)
                seconds = i if _SECONDS.fullmatch(_plain(name)) else seconds
        joint_of = {i: joint for i in left if (joint := _joint(header[i])) is not None}
        if len(set(joint_of.values())) < len(joint_of):
            twice = next(name for name in joint_of.values() if list(joint_of.values()).count(name) > 1)
            raise MotionError(f"{path}: the header names {twice} twice")
        if fingers := [i for i in left if i not in joint_of and joint_of and is_finger_joint(_plain(header[i]))]:
            warnings.warn(f"{path}: joints of hands are dropped: {', '.join(header[i] for i in fingers)}", stacklevel=3)
            left = [i for i in left if i not in fingers]
        others = [i for i in left if i not in joint_of]
        position, rotation, quat = cls._root(header, others)
        root = [*position, *rotation]
        if not joint_of:
            if not root:
                names = ", ".join(header[:8])
                warnings.warn(f"{path}: the header ({names}, ...) names no joint of the robot: skipped", stacklevel=3)
                return cls._in_order(path, left, shape, seconds)
            joints = [i for i in left if i not in root]
            _check_count(path, shape, joints)
            return cls(position, rotation, joints, None, quat, seconds)
        if not root:
            if len(others) != 7:
                raise MotionError(
                    f"{path}: the header names {len(joint_of)} joints of the robot; the other columns should be the "
                    f"root's position and quaternion, and are {', '.join(header[i] for i in others) or 'none'}"
                )
            position, rotation = others[:3], others[3:]
        elif extra := [header[i] for i in others if i not in root]:
            if len(joint_of) < len(g1.JOINT_NAMES):
                raise MotionError(f"{path}: columns {', '.join(extra)} are neither the root's nor a joint of the robot")
            warnings.warn(f"{path}: columns that the robot does not have are dropped: {', '.join(extra)}", stacklevel=3)
        return cls(position, rotation, list(joint_of), tuple(joint_of.values()), quat, seconds)

    @classmethod
    def _in_order(cls, path: Path, left: list[int], shape: tuple[int, ...], seconds: int | None = None) -> _Columns:
        _check_count(path, shape, left[7:])
        return cls(left[:3], left[3:7], left[7:], seconds=seconds)

    @staticmethod
    def _root(header: Sequence[str], left: list[int]) -> tuple[list[int], list[int], str | None]:
        """Columns of the root's position and rotation, and the order of a quaternion, where the header has them all."""
        position, rotation = {}, {}
        for i in left:
            name = _plain(header[i])
            if match := _ROTATION.fullmatch(name):
                rotation[match[4][-1]] = i
            elif match := re.fullmatch(_ROOT + f"({'|'.join(_ANGLES)})", name):
                rotation["xyz"[_ANGLES.index(match[3])]] = i
            elif match := _POSITION.fullmatch(name):
                position[match[4]] = i
        if len(position) != 3 or not {"x", "y", "z"} <= rotation.keys():
            return [], [], None
        order = "xyzw" if "w" in rotation else "xyz"
        return [position[a] for a in "xyz"], [rotation[a] for a in order], "xyzw"


def _check_count(path: Path, shape: tuple[int, ...], joints: list[int]) -> None:
    if len(joints) not in COUNTS:
        known = " or ".join(str(7 + n) for n in COUNTS)
        raise MotionError(
            f"{path}: rows: shape {shape}, expected {known} columns: position, xyzw, and as many joints as "
            f"{', '.join(LAYOUTS)} have; columns of frames or time only if a header names them"
        )


def write_robot_csv(motion: Motion, path: str | Path) -> tuple[Path, list[str]]:
    """Writes the table that `read_robot_csv` reads, with all digits of float32.

    Returns:
        The file, and what of the motion it cannot hold.
    """
    full = complete_robot(motion)
    xyzw = np.roll(full.body_quat_w[:, 0], -1, axis=-1)
    rows = np.concatenate([full.body_pos_w[:, 0], xyzw, full.joint_pos[:, : len(g1.JOINT_NAMES)]], axis=1)
    text = "".join(",".join(f"{value:.9g}" for value in row) + "\n" for row in rows)
    lost = [*lost_by(full, bodies=True), "the rate", "velocities", "bodies other than the root"]
    return write_text(path, text), lost
