"""The formats of persons' motions."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from hdmi.motion.check import MotionError
from hdmi.motion.files import read_npz, read_torch
from hdmi.motion.human import HumanMotion
from hdmi.motion.sources.bvh import read_bvh
from hdmi.motion.sources.interaction import read_intermimic, read_omomo
from hdmi.motion.sources.smpl import read_amass, read_gvhmr

# of each format its reader, and what its files do not say or may be overruled in
_FORMATS: dict[str, tuple[Callable[..., HumanMotion], tuple[str, ...]]] = {
    "gvhmr": (read_gvhmr, ("source_fps", "height", "body_model")),
    "amass": (read_amass, ("height", "body_model")),
    "omomo": (read_omomo, ()),
    "intermimic": (read_intermimic, ("height",)),
    "bvh": (read_bvh, ("height", "unit", "up")),
}
PERSON_FORMATS = tuple(_FORMATS)


def read_person(
    path: str | Path,
    format: str | None = None,
    *,
    source_fps: float | None = None,
    height: float | None = None,
    body_model: str | Path | None = None,
    unit: float | None = None,
    up: str | None = None,
) -> HumanMotion:
    """A person's motion in any format.

    Args:
        format: one of `PERSON_FORMATS`; guessed from the file if not given.
        source_fps: of the video; for `gvhmr`, which needs it.
        height, body_model, unit, up: see the readers.

    Raises:
        MotionError: for an unknown format, what the format lacks and was not given, what was given and the format does
            not take, or a file that is not of it.
    """
    path = Path(path)
    chosen = format or _guess(path)
    if chosen not in _FORMATS:
        raise MotionError(f"{path}: there is no format {chosen!r}; there is {', '.join(PERSON_FORMATS)}")
    reader, takes = _FORMATS[chosen]
    options = {"source_fps": source_fps, "height": height, "body_model": body_model, "unit": unit, "up": up}
    given: dict[str, Any] = {key: value for key, value in options.items() if value is not None}
    if extra := [key for key in given if key not in takes]:
        raise MotionError(f"{path}: {chosen} takes no {', '.join(extra)}; it takes {', '.join(takes) or 'nothing'}")
    if up not in (None, "y", "z"):
        raise MotionError(f"{path}: up: the axis that points up is y or z, got {up!r}")
    if chosen == "gvhmr":
        if source_fps is None:
            raise MotionError(f"{path}: does not say how fast the video is: give source_fps, its frames per second")
        given["fps"] = given.pop("source_fps")
    return reader(path, **given)


def _guess(path: Path) -> str:
    if path.suffix == ".bvh":
        return "bvh"
    if path.suffix == ".pt":
        return "gvhmr" if path.name.startswith("hmr4d") or isinstance(read_torch(path), dict) else "intermimic"
    if path.suffix == ".npz":
        return "omomo" if read_npz(path, {"rest_offsets"}) else "amass"
    raise MotionError(f"{path}: say which format it is; there is {', '.join(PERSON_FORMATS)}")
