"""Converts robot references between formats.

    hdmi convert source=PATH out=PATH to=FORMAT
        [source_format=FORMAT] [fps=50] [source_fps=30] [object=NAME] [clip=NAME] [joints=g1_23dof]
        [quat=xyzw|wxyz] [angles=radians|degrees] [unit=0.01] [up=y] [ground=shift|keep]

Formats: `hdmi` (a folder, the format of this project), `mjlab` and `beyondmimic` (npz), `holosoma` (npz), `csv` (root
and joints, as Unitree publishes LAFAN1), and, to read only, `pickle` (of GMR, PHC, ASAP and PBHC). The source's is
guessed if not given. `fps` resamples, `source_fps` says the rate of a CSV, `object` names the object of a holosoma
motion, `clip` one of several in a pickle, `joints` which joints a CSV or pickle has, if it does not name them.

The last five say how the source means its numbers, where it is not as its format usually does: order of quaternions,
joint angles, the length of a unit in m, which axis points up (x, y, z, -x, -y, -z); `ground=shift` puts the robot's
lowest point on the ground. What looks wrong is refused with the option that would put it right; what is given is
believed.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

from rich.console import Console
from rich.markup import escape

from hdmi.commands.options import parse_options
from hdmi.commands.script import run_script
from hdmi.config import ConfigError
from hdmi.workshop.sources import FORMATS, Conventions, convert
from hdmi.workshop.sources.formats import Options as FormatOptions


@dataclass
class Options:
    """See the module."""

    source: str | None = None
    out: str | None = None
    to: str | None = None
    source_format: str | None = None
    fps: float | None = None
    source_fps: float | None = None
    object: str | None = None
    clip: str | None = None
    joints: str | None = None
    quat: str | None = None
    angles: str | None = None
    unit: float | None = None
    up: str | None = None
    ground: str | None = None


def write(arguments: list[str], console: Console) -> int:
    """Converts a file, and says what of it the other format cannot hold."""
    options = parse_options(Options, arguments)
    if options.source is None or options.out is None or options.to is None:
        raise ConfigError(f"give source=PATH, out=PATH and to=, one of {', '.join(FORMATS)}")
    given = Conventions(options.quat, options.angles, options.unit, options.up, options.ground)
    source = FormatOptions(options.source_fps, options.object, options.clip, options.joints, given)
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always")
        motion, path, lost = convert(
            options.source, options.out, options.to, options.source_format, source, options.fps
        )
    for note in notes:
        console.print(f"[yellow]note:[/yellow] {escape(str(note.message))}", highlight=False, soft_wrap=True)
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
