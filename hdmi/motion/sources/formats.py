"""The formats of robot references, and conversion between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hdmi.motion.check import MotionError
from hdmi.motion.files import read_npz
from hdmi.motion.motion import Motion, load_motion, save_motion
from hdmi.motion.reference import resample
from hdmi.motion.sources.robot import (
    read_holosoma,
    read_mjlab,
    read_robot_csv,
    write_holosoma,
    write_mjlab,
    write_robot_csv,
)


@dataclass(frozen=True)
class Options:
    """What a file does not say.

    Args:
        fps: of a CSV.
        object_name: of the object of a holosoma motion.
    """

    fps: float = 30.0
    object_name: str | None = None


@dataclass(frozen=True)
class Format:
    """How to read and write one format; writing returns the path and what was lost."""

    suffix: str  # empty: a folder
    read: Callable[[Path, Options], Motion]
    write: Callable[[Motion, Path, Options], tuple[Path, list[str]]]


FORMATS = {
    "hdmi": Format(
        "",
        lambda path, options: load_motion(path),
        lambda motion, path, options: (save_motion(motion, path), []),
    ),
    "mjlab": Format(
        ".npz",
        lambda path, options: read_mjlab(path),
        lambda motion, path, options: write_mjlab(motion, path, "mujoco"),
    ),
    "beyondmimic": Format(
        ".npz",
        lambda path, options: read_mjlab(path),
        lambda motion, path, options: write_mjlab(motion, path, "isaac"),
    ),
    "holosoma": Format(
        ".npz",
        lambda path, options: read_holosoma(path, options.object_name),
        lambda motion, path, options: write_holosoma(motion, path, options.object_name),
    ),
    "csv": Format(
        ".csv",
        lambda path, options: read_robot_csv(path, options.fps),
        lambda motion, path, options: write_robot_csv(motion, path),
    ),
}


def guess_format(path: str | Path) -> str:
    """Name of the format of a file or folder that exists.

    Raises:
        MotionError: if it is none of them.
    """
    path = Path(path)
    if path.is_dir():
        return "hdmi"
    if path.suffix == ".csv":
        return "csv"
    if path.suffix == ".npz":
        return "holosoma" if read_npz(path, {"joint_names"}) else "mjlab"
    raise MotionError(
        f"{path}: neither a motion folder nor an .npz or .csv; the formats of robot motions are {', '.join(FORMATS)}"
    )


def convert(
    source: str | Path,
    out: str | Path,
    to: str,
    source_format: str | None = None,
    options: Options | None = None,
    fps: float | None = None,
) -> tuple[Motion, Path, list[str]]:
    """Converts a robot reference from one format to another.

    Args:
        to, source_format: names in `FORMATS`; the source's is guessed if not given.
        fps: to resample to; the source's if not given.

    Returns:
        The motion, the path that was written, and what of the motion the format cannot hold.

    Raises:
        MotionError: if the source cannot be read, or a format is unknown.
    """
    options = options or Options()
    for name in (to, source_format):
        if name is not None and name not in FORMATS:
            raise MotionError(f"there is no format {name!r}; there is {', '.join(FORMATS)}")
    source, out = Path(source), Path(out)
    if not source.exists():
        raise MotionError(f"{source}: no such file or folder")
    suffix = FORMATS[to].suffix
    if out.suffix != suffix and suffix:
        raise MotionError(f"{out}: a motion in the format {to!r} ends in {suffix}")
    motion = FORMATS[source_format or guess_format(source)].read(source, options)
    motion = motion if fps is None else resample(motion, fps)
    path, lost = FORMATS[to].write(motion, out, options)
    return motion, path, lost
