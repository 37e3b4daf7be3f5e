"""Makes a reference of the robot from a person's motion, with inverse kinematics (extra `retarget`).

    hdmi retarget source=PATH out=FOLDER [format=FORMAT] [object=TASK] [height=1.75] [source_fps=30]
        [fps=50] [scale=0.72] [cutoff=6] [body_model=PATH] [up=y] [unit=0.01] [ground=shift] [names=FILE]
        [angles=degrees] [self_collision=true] [name=NAME]

Formats: `gvhmr` (hmr4d_results.pt; needs source_fps, the video's), `amass` (npz), `omomo` (npz), `intermimic` (pt),
`bvh`; guessed from the file if not given. Where a file's world is not as usual: `source_fps` overrules its rate, `up`
is the axis that points up (x, y, z, -x, -y or -z), `unit` its unit of length in metres, `ground` whether to `shift` the
lowest sole onto the ground or to `keep` its height (shifted if more than 5 cm off). For a BVH, `names` is a YAML file
with SMPL's names by the file's (`Bip01_L_Thigh: left_hip`), and `angles` may be `radians`. The report has notes of what
was changed or not used.
`object` is the task that describes the object of the motion, and the end effectors, whose contact labels the source may
have; `config_dir=FOLDER` adds the tasks of FOLDER/task. Lengths of the scene
are scaled so that the person's legs become as long as the robot's, unless `scale` says
otherwise; `height` is the person's, if the file does not tell. What is faster than `cutoff` Hz is taken for noise.

The reference is written to FOLDER (motion.npz, meta.json), with a report beside it (retarget.json). The exit status is
0, 1 if frames could not be solved (they are in the report), 2 for wrong arguments or files.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from hdmi.assembly import scene_parts
from hdmi.commands.options import parse_options
from hdmi.commands.script import run_script
from hdmi.config import ConfigError, task_config
from hdmi.motion import save_motion
from hdmi.workshop.ik import IkOptions
from hdmi.workshop.retarget import RetargetOptions, RetargetReport, retarget
from hdmi.workshop.retarget.pipeline import SMOOTHING
from hdmi.workshop.sources import read_person


@dataclass
class Options:
    """See the module."""

    source: str | None = None
    out: str | None = None
    format: str | None = None
    object: str | None = None
    config_dir: str | None = None  # of the task, where conf/task lacks it
    name: str | None = None
    height: float | None = None
    source_fps: float | None = None
    body_model: str | None = None
    up: str | None = None
    unit: float | None = None
    ground: str | None = None
    names: str | None = None
    angles: str | None = None
    fps: float = 50.0
    scale: float | None = None
    cutoff: float = 6.0
    self_collision: bool = True


def run(options: Options, console: Console) -> tuple[Path, RetargetReport]:
    """Reads, retargets and writes; returns the folder and the report."""
    if options.source is None or options.out is None:
        raise ConfigError("give source=PATH and out=FOLDER")
    for key in ("fps", "cutoff", "scale"):
        if (value := getattr(options, key)) is not None and not value > 0:
            raise ConfigError(f"{key}: expected more than 0, got {value:g}")
    parts: dict[str, Any] = {}
    if options.object is not None:
        parts = scene_parts(task_config(options.object, config_dir=options.config_dir))
    human = read_person(
        options.source,
        options.format,
        source_fps=options.source_fps,
        height=options.height,
        body_model=options.body_model,
        names=options.names,
        angles=options.angles,
        up=options.up,
        unit=options.unit,
        ground=options.ground,
    )
    human = replace(human, name=options.name or Path(options.out).name)
    how = RetargetOptions(
        fps=options.fps,
        cutoff=options.cutoff,
        scale=options.scale,
        ground=options.ground,
        ik=IkOptions(floor=0.0, smoothing=SMOOTHING, self_collision=0.005 if options.self_collision else None),
    )
    num_frames = human.resample(options.fps).num_frames
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task(human.name, total=num_frames)
        motion, report = retarget(
            human,
            parts.get("object"),
            effectors=parts.get("effectors", ()),
            options=how,
            on_frame=lambda frame: progress.update(bar, completed=frame + 1),
        )
    folder = save_motion(motion, options.out)
    report.save(folder / "retarget.json")
    return folder, report


def show(arguments: list[str], console: Console) -> int:
    """Retargets, and shows the report."""
    folder, report = run(parse_options(Options, arguments), console)
    console.print(report.table())
    print(folder)
    return 1 if report.solver_failures else 0


def main(arguments: list[str]) -> int:
    """Runs the script; returns its exit status."""
    return run_script(show, arguments, __doc__)
