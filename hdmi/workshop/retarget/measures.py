"""What a retargeting did: residuals, slide, penetration, speed."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table


@dataclass(frozen=True)
class RetargetReport:
    """Figures of one retargeting. Statistics are over frames.

    Examples:
        >>> from hdmi.workshop.skeleton import anthropometric_skeleton, pose_skeleton
        >>> rotation, transl = np.zeros((5, 22, 3)), np.zeros((5, 3))  # a T-pose
        >>> human = pose_skeleton("person", anthropometric_skeleton(1.75), rotation, transl, 50.0, y_up=True)
        >>> motion, report = retarget(human, options=RetargetOptions(ground="shift"))
        >>> report.frames, report.height, report.solver_failures
        (5, 1.75, [])
    """

    name: str
    frames: int
    fps: float
    height: float  # of the person, as taken, m
    scale: float  # of the scene
    milliseconds: float  # per frame, of processor time for inverse kinematics
    iterations: float  # per frame
    solver_failures: list[int]  # frames
    unsettled: list[int]  # frames
    residuals: dict[str, dict[str, float]]  # by target: mean, p99, max; m, or rad for orientations
    stance_frames: dict[str, int]  # by side, in which the foot stands
    slide: dict[str, float] | None  # speed of standing soles: mean, p99, max, m/s; None: no foot ever stands
    penetration: dict[str, dict[str, float]]  # into floor, object and itself: p99 and max, m
    joint_speed: float  # largest, in shares of the joint's limit
    jerk: float  # root mean square of the joints', rad/s^3
    notes: list[str] = field(default_factory=list)  # of the source's reader: what it changed, or could not use

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for json."""
        return asdict(self)

    def to_json(self) -> str:
        """Those values as json."""
        return json.dumps(self.as_dict(), indent=1) + "\n"

    def table(self) -> RenderableType:
        """For people."""
        title = (
            f"{self.name}: {self.frames} frames at {self.fps:g} fps, person of {self.height:.2f} m, "
            f"scene scaled by {self.scale:.3f}"
        )
        bodies = Table()
        for column, justify in (("target", "left"), ("mean", "right"), ("p99", "right"), ("max", "right")):
            bodies.add_column(column, justify=justify)  # type: ignore[arg-type]
        for name, figures in self.residuals.items():
            factor, unit = (180 / np.pi, "deg") if name.endswith("orientation") else (100.0, "cm")
            bodies.add_row(name, *(f"{factor * figures[key]:.2f} {unit}" for key in ("mean", "p99", "max")))
        rest = Table(show_header=False)
        rest.add_column()
        rest.add_column()
        rest.add_row("inverse kinematics", f"{self.milliseconds:.1f} ms and {self.iterations:.1f} programs per frame")
        rest.add_row("solver failures", _frames(self.solver_failures))
        rest.add_row("not settled", _frames(self.unsettled))
        rest.add_row("feet stand", ", ".join(f"{side} {count} frames" for side, count in self.stance_frames.items()))
        if self.slide is not None:
            rest.add_row("slide of standing feet", _statistics(self.slide, 100, "cm/s"))
        for name, figures in self.penetration.items():
            rest.add_row(f"penetration: {name}", _statistics(figures, 100, "cm"))
        rest.add_row("fastest joint", f"{100 * self.joint_speed:.0f} % of its limit")
        rest.add_row("joint jerk", f"{self.jerk:.0f} rad/s^3 rms")
        return Group(title, bodies, rest, *(f"note: {note}" for note in self.notes))

    def save(self, path: str | Path) -> Path:
        """Writes the report as json."""
        path = Path(path)
        path.write_text(self.to_json(), encoding="utf-8")
        return path


def statistics(values: np.ndarray) -> dict[str, float]:
    """Mean, 99th percentile and maximum of what is not NaN."""
    values = values[np.isfinite(values)]
    return {"mean": float(values.mean()), "p99": float(np.percentile(values, 99)), "max": float(values.max())}


def _statistics(figures: dict[str, float], factor: float, unit: str) -> str:
    return ", ".join(f"{key} {factor * value:.2f}" for key, value in figures.items()) + f" {unit}"


def _frames(frames: list[int]) -> str:
    if not frames:
        return "none"
    shown = ", ".join(map(str, frames[:8])) + (", ..." if len(frames) > 8 else "")
    return f"{len(frames)} frames: {shown}"
