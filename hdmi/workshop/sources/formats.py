"""The formats of robot references, and conversion between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from hdmi.assets import g1
from hdmi.motion.check import MotionError
from hdmi.motion.complete import resample, without_fingers
from hdmi.motion.files import read_npz
from hdmi.motion.format import Motion, load_motion, save_motion
from hdmi.workshop.sources.conventions import Conventions, reread, settle
from hdmi.workshop.sources.robot import read_holosoma, read_mjlab, write_holosoma, write_mjlab
from hdmi.workshop.sources.robot_csv import read_robot_csv, write_robot_csv
from hdmi.workshop.sources.robot_pickle import read_robot_pickle

_PICKLES = (".pkl", ".pickle", ".p", ".joblib")


@dataclass(frozen=True)
class Options:
    """What a file does not say.

    Args:
        fps: of a CSV, or of a pickle that does not say.
        object_name: of the object of a holosoma motion.
        clip: of a pickle that holds several.
        joints: of a CSV or pickle that does not name them, a name in `hdmi.workshop.sources.layouts.LAYOUTS`.
        given: how the file means its numbers.
    """

    fps: float | None = None
    object_name: str | None = None
    clip: str | None = None
    joints: str | None = None
    given: Conventions = field(default_factory=Conventions)


@dataclass(frozen=True)
class Format:
    """How to read and write one format; writing returns the path and what was lost."""

    suffix: str  # empty: a folder
    read: Callable[[Path, Options], Motion]
    write: Callable[[Motion, Path, Options], tuple[Path, list[str]]] | None  # None: is only read
    takes: tuple[str, ...] = ()  # of the options


def _read_hdmi(path: Path, options: Options) -> Motion:
    motion = reread(load_motion(path), options.given)
    return settle(motion, path / "motion.npz", options.given, has_scenery=True)


# what `convert` reads and writes, by name
FORMATS = {
    "hdmi": Format(
        "",
        _read_hdmi,
        lambda motion, path, options: (save_motion(motion, path), []),
    ),
    "mjlab": Format(
        ".npz",
        lambda path, options: read_mjlab(path, given=options.given),
        lambda motion, path, options: write_mjlab(motion, path, "mujoco"),
    ),
    "beyondmimic": Format(
        ".npz",
        lambda path, options: read_mjlab(path, given=options.given),
        lambda motion, path, options: write_mjlab(motion, path, "isaac"),
    ),
    "holosoma": Format(
        ".npz",
        lambda path, options: read_holosoma(path, options.object_name, options.given),
        lambda motion, path, options: write_holosoma(motion, path, options.object_name),
    ),
    "csv": Format(
        ".csv",
        lambda path, options: read_robot_csv(path, options.fps, joints=options.joints, given=options.given),
        lambda motion, path, options: write_robot_csv(motion, path),
        ("joints",),
    ),
    "pickle": Format(
        ".pkl",
        lambda path, options: read_robot_pickle(
            path, options.fps, clip=options.clip, joints=options.joints, given=options.given
        ),
        None,
        ("clip", "joints"),
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
    suffix = path.suffix.lower()
    if suffix in (".csv", ".tsv"):
        return "csv"
    if suffix in _PICKLES:
        return "pickle"
    if suffix == ".npz":
        return "holosoma" if read_npz(path, {"joint_names"}) else "mjlab"
    raise MotionError(
        f"{path}: neither a motion folder nor an .npz or .csv, nor a .pkl; the formats of robot motions are "
        f"{', '.join(FORMATS)}"
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
        MotionError: if the source cannot be read, a format is unknown or only read, or does not take an option.

    Joints of hands, which the robot lacks, are dropped; warnings say what was assumed and what was left out.
    """
    options = options or Options()
    for name in (to, source_format):
        if name is not None and name not in FORMATS:
            raise MotionError(f"there is no format {name!r}; there is {', '.join(FORMATS)}")
    source, out = Path(source), Path(out)
    if not source.exists():
        raise MotionError(f"{source}: no such file or folder")
    write, suffix = FORMATS[to].write, FORMATS[to].suffix
    if write is None:
        written = ", ".join(name for name in FORMATS if FORMATS[name].write)
        raise MotionError(f"the format {to!r} is only read; written are {written}")
    if out.suffix != suffix and suffix:
        raise MotionError(f"{out}: a motion in the format {to!r} ends in {suffix}")
    source_format = source_format or guess_format(source)
    for key in ("clip", "joints"):
        if getattr(options, key) is not None and key not in FORMATS[source_format].takes:
            raise MotionError(f"{source}: {source_format} takes no {key}")
    motion = without_fingers(FORMATS[source_format].read(source, options), keep=g1.JOINT_NAMES)
    motion = motion if fps is None else resample(motion, fps)
    path, lost = write(motion, out, options)
    return motion, path, lost
