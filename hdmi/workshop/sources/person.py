"""The formats of persons' motions."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from hdmi.motion.check import MotionError
from hdmi.motion.files import read_npz, read_torch
from hdmi.workshop.human import HumanMotion
from hdmi.workshop.sources.bvh import read_bvh
from hdmi.workshop.sources.interaction import read_intermimic, read_omomo
from hdmi.workshop.sources.smpl import read_amass, read_gvhmr

# what the files of no format say for sure
_WORLD = ("source_fps", "up", "unit", "ground")
# of each format its reader, and what else its files do not say or may be overruled in
_FORMATS: dict[str, tuple[Callable[..., HumanMotion], tuple[str, ...]]] = {
    "gvhmr": (read_gvhmr, ("height", "body_model")),
    "amass": (read_amass, ("height", "body_model")),
    "omomo": (read_omomo, ()),
    "intermimic": (read_intermimic, ("height",)),
    "bvh": (read_bvh, ("height", "names", "angles")),
}
PERSON_FORMATS = tuple(_FORMATS)  # names of what `read_person` reads


def read_person(
    path: str | Path,
    format: str | None = None,
    *,
    source_fps: float | None = None,
    height: float | None = None,
    body_model: str | Path | None = None,
    names: str | Path | None = None,
    angles: str | None = None,
    up: str | None = None,
    unit: float | None = None,
    ground: str | None = None,
) -> HumanMotion:
    """A person's motion in any format.

    Args:
        format: one of `PERSON_FORMATS`; guessed from the file if not given.
        source_fps: frames per second, instead of what the file says; `gvhmr`, whose file does not, needs the video's.
        height, body_model, names, angles: see the readers.
        up, unit, ground: see `hdmi.workshop.sources.world.World`.

    Raises:
        MotionError: for an unknown format, what the format lacks and was not given, what was given and the format does
            not take, or a file that is not of it.
    """
    path = Path(path)
    chosen = format or _guess(path)
    if chosen not in _FORMATS:
        raise MotionError(f"{path}: there is no format {chosen!r}; there is {', '.join(PERSON_FORMATS)}")
    reader, own = _FORMATS[chosen]
    takes = (*_WORLD, *own)
    options = {
        "source_fps": source_fps, "height": height, "body_model": body_model, "names": names, "angles": angles,
        "up": up, "unit": unit, "ground": ground,
    }  # fmt: skip
    given: dict[str, Any] = {key: value for key, value in options.items() if value is not None}
    if extra := [key for key in given if key not in takes]:
        raise MotionError(f"{path}: {chosen} takes no {', '.join(extra)}; it takes {', '.join(takes)}")
    if source_fps is not None:
        given["fps"] = given.pop("source_fps")
    elif chosen == "gvhmr":
        raise MotionError(f"{path}: does not say how fast the video is: give source_fps, its frames per second")
    return reader(path, **given)


def _guess(path: Path) -> str:
    if path.suffix.lower() == ".bvh":
        return "bvh"
    if path.suffix == ".pt":
        return "gvhmr" if path.name.startswith("hmr4d") or isinstance(read_torch(path), dict) else "intermimic"
    if path.suffix == ".npz":
        return "omomo" if read_npz(path, {"rest_offsets"}) else "amass"
    raise MotionError(f"{path}: say which format it is; there is {', '.join(PERSON_FORMATS)}")
