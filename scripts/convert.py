"""Converts robot references between formats.

    python scripts/convert.py source=PATH out=PATH to=FORMAT
        [source_format=FORMAT] [fps=50] [source_fps=30] [object=NAME]

Formats: `hdmi` (a folder, the format of this project), `mjlab` and `beyondmimic` (npz), `holosoma` (npz), `csv` (root
and 29 joints, as Unitree publishes LAFAN1). The source's is guessed if not given. `fps` resamples, `source_fps` says
the rate of a CSV, `object` names the object of a holosoma motion.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

from rich.console import Console

from hdmi.build import ConfigError
from hdmi.cli import run_script
from hdmi.evaluation.options import parse_options
from hdmi.motion.sources import FORMATS, convert
from hdmi.motion.sources.formats import Options as FormatOptions


@dataclass
class Options:
    """See the module."""

    source: str | None = None
    out: str | None = None
    to: str | None = None
    source_format: str | None = None
    fps: float | None = None
    source_fps: float = 30.0
    object: str | None = None


def write(arguments: list[str], console: Console) -> int:
    """Converts a file, and says what of it the other format cannot hold."""
    options = parse_options(Options, arguments)
    if options.source is None or options.out is None or options.to is None:
        raise ConfigError(f"give source=PATH, out=PATH and to=, one of {', '.join(FORMATS)}")
    motion, path, lost = convert(
        options.source,
        options.out,
        options.to,
        options.source_format,
        FormatOptions(options.source_fps, options.object),
        options.fps,
    )
    console.print(
        f"{motion.name}: {motion.num_frames} frames at {motion.fps:g} fps, {len(motion.body_names)} bodies, "
        f"{len(motion.joint_names)} joints",
        highlight=False,
        soft_wrap=True,
    )
    for what in lost:
        console.print(f"[yellow]{options.to} cannot hold[/yellow] {what}", highlight=False, soft_wrap=True)
    print(path)
    return 0


def main(arguments: list[str]) -> int:
    """Runs the script; returns its exit status."""
    return run_script(write, arguments, __doc__)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
