"""The formats of persons' motions."""

from __future__ import annotations

from pathlib import Path

from hdmi.motion.check import MotionError
from hdmi.motion.human import HumanMotion
from hdmi.motion.sources.bvh import read_bvh
from hdmi.motion.sources.interaction import read_intermimic, read_omomo
from hdmi.motion.sources.smpl import read_amass, read_gvhmr

PERSON_FORMATS = ("gvhmr", "amass", "omomo", "intermimic", "bvh")


def read_person(
    path: str | Path,
    format: str | None = None,
    *,
    fps: float | None = None,
    height: float | None = None,
    body_model: str | Path | None = None,
) -> HumanMotion:
    """A person's motion in any format.

    Args:
        format: one of `PERSON_FORMATS`; guessed from the file's name if not given.
        fps: of the video, for `gvhmr`.
        height, body_model: see the readers.

    Raises:
        MotionError: for an unknown format, what the format lacks and was not given, or a file that is not of it.
    """
    path = Path(path)
    chosen = format or _guess(path)
    if chosen not in PERSON_FORMATS:
        raise MotionError(f"{path}: there is no format {chosen!r}; there is {', '.join(PERSON_FORMATS)}")
    if chosen == "gvhmr":
        if fps is None:
            raise MotionError(f"{path}: results of GVHMR do not say how fast the video is: give its frames per second")
        return read_gvhmr(path, fps, height, body_model)
    if chosen == "amass":
        return read_amass(path, height, body_model)
    if chosen == "bvh":
        return read_bvh(path, height)
    return read_omomo(path) if chosen == "omomo" else read_intermimic(path, height)


def _guess(path: Path) -> str:
    if path.suffix == ".bvh":
        return "bvh"
    if path.suffix == ".pt":
        return "gvhmr" if path.name.startswith("hmr4d") else "intermimic"
    if path.suffix == ".npz":
        return "amass"
    raise MotionError(f"{path}: say which format it is; there is {', '.join(PERSON_FORMATS)}")
