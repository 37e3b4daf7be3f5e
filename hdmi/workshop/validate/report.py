"""The result of a validation: findings, a verdict, and how they are shown."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from rich.console import Console
from rich.table import Table

from hdmi.workshop.validate.limits import Limit

Verdict = Literal["good", "usable", "bad"]  # of a check, and of a motion
_ORDER: tuple[Verdict, ...] = ("good", "usable", "bad")
STYLE = {"good": "green", "usable": "yellow", "bad": "red"}


@dataclass(frozen=True)
class Series:
    """A checked quantity in every frame.

    Args:
        values: larger is worse, NaN where it does not apply. [T, K]
        parts: bodies, joints or effectors that the columns are about. [K]

    Examples:
        >>> from hdmi.workshop.validate.report import judge
        >>> slide = Series(values=np.array([[0.1, 0.0], [0.1, 0.3]]), parts=["left foot", "right foot"])
        >>> judge("foot_slide", slide, Limit(0.15, 0.5, "m/s", "planted foot")).reason()
        'foot_slide 0.3 m/s, above 0.15: right foot, frame 1'
    """

    values: np.ndarray
    parts: Sequence[str] | np.ndarray


@dataclass(frozen=True)
class Fault:
    """Consecutive frames above what is good, the worst of them, and which part is worst there.

    Examples:
        >>> fault = Fault(first=4, last=6, worst=5, value=0.3, part="left foot")
        >>> Finding("foot_slide", "usable", 0.3, "m/s", 0.15, 0.5, "planted foot", (fault,)).reason()
        'foot_slide 0.3 m/s, above 0.15: left foot, frames 4-6'
    """

    first: int
    last: int
    worst: int
    value: float
    part: str


@dataclass(frozen=True)
class Finding:
    """The outcome of one check; `value` is None where it applies to no frame.

    Examples:
        >>> from hdmi.motion import find_motion, load_motion
        >>> report = validate_motion(load_motion(find_motion("walk")))
        >>> report["missing_joints"].value, report["missing_joints"].verdict
        (0.0, 'good')
    """

    check: str
    verdict: Verdict
    value: float | None
    unit: str
    good: float
    bad: float | None  # None: cannot be bad
    about: str
    faults: tuple[Fault, ...] = ()

    def reason(self) -> str:
        """One line on what is wrong, where and when."""
        if self.value is None:
            return f"{self.check}: {self.about}"
        bound = f"above {self.good:g}" if self.verdict == "usable" else f"above {self.bad:g}"
        text = f"{self.check} {self.value:.3g} {self.unit}, {bound}"
        if self.faults:
            worst = max(self.faults, key=lambda fault: fault.value)
            alone = len(self.faults) == 1 and worst.first == worst.last
            text += f": {worst.part}, {'frame' if alone else 'frames'} {_frames(self.faults)}"
        return text


@dataclass(frozen=True)
class Report:
    """Whether a motion is worth training on.

    `verdict` is the worst of the findings': *good*, *usable* (tracking will have to make up for what the reasons name)
    or *bad*.

    Examples:
        >>> from hdmi.motion import find_motion, load_motion
        >>> report = validate_motion(load_motion(find_motion("walk")))
        >>> report.verdict, report.reasons, report.num_frames
        ('good', (), 550)
    """

    motion: str
    num_frames: int
    fps: float
    findings: tuple[Finding, ...]
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """The worst of the findings'."""
        return _ORDER[max((_ORDER.index(finding.verdict) for finding in self.findings), default=0)]

    @property
    def reasons(self) -> tuple[str, ...]:
        """What keeps the motion from being good, the worst first."""
        faulty = [finding for finding in self.findings if finding.verdict != "good"]
        return tuple(finding.reason() for finding in sorted(faulty, key=lambda f: -_ORDER.index(f.verdict)))

    def __getitem__(self, check: str) -> Finding:
        return next(finding for finding in self.findings if finding.check == check)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as in the JSON output."""
        return {
            "motion": self.motion,
            "verdict": self.verdict,
            "reasons": list(self.reasons),
            "num_frames": self.num_frames,
            "fps": self.fps,
            "notes": list(self.notes),
            "findings": [asdict(finding) for finding in self.findings],
        }

    def to_json(self) -> str:
        """Those values as JSON."""
        return json.dumps(self.as_dict(), indent=1, allow_nan=False)

    def table(self) -> Table:
        """All checks: value, bounds, verdict, the part and the frames at fault."""
        style = STYLE[self.verdict]
        length = f"{self.num_frames} frames at {self.fps:g} Hz: " if self.num_frames else ""
        table = Table(title=f"{self.motion}: {length}[{style}]{self.verdict}[/{style}]", title_justify="left")
        for column in ("check", "value", "good", "bad", "unit", "verdict", "worst", "frames at fault"):
            table.add_column(column, justify="right" if column in ("value", "good", "bad") else "left")
        for finding in self.findings:
            style = STYLE[finding.verdict]
            worst = max(finding.faults, key=lambda fault: fault.value, default=None)
            faulty = worst is not None and finding.verdict != "good"
            table.add_row(
                finding.check,
                "-" if finding.value is None else f"{finding.value:.3g}",
                f"{finding.good:g}",
                "-" if finding.bad is None else f"{finding.bad:g}",
                finding.unit,
                f"[{style}]{finding.verdict}[/{style}]" if finding.value is not None else "-",
                worst.part if worst is not None and faulty else "",
                _frames(finding.faults) if faulty else "",
            )
        return table

    def print(self, console: Console) -> None:
        """The table, the notes, and the reasons."""
        console.print(self.table())
        for note in self.notes:
            console.print(f"note: {note}", soft_wrap=True, highlight=False)
        for reason in self.reasons:
            console.print(reason, soft_wrap=True, highlight=False)


def _frames(faults: Sequence[Fault], most: int = 3) -> str:
    """The longest of the faults as `first-last`, in order."""
    longest = sorted(sorted(faults, key=lambda fault: fault.first - fault.last)[:most], key=lambda fault: fault.first)
    shown = [f"{fault.first}-{fault.last}" if fault.first < fault.last else f"{fault.first}" for fault in longest]
    more = len(faults) - len(longest)
    return ", ".join(shown) + (f" and {more} more" if more else "")


def judge(check: str, series: Series | None, limit: Limit) -> Finding:
    """Holds a series against its limit: the value is the worst after the allowed share of frames is left out."""
    bad = limit.bad if math.isfinite(limit.bad) else None
    common: dict[str, Any] = {"unit": limit.unit, "good": limit.good, "bad": bad, "about": limit.about}
    if series is None or np.isnan(series.values).all():
        return Finding(check, "good", None, **common)
    filled = np.where(np.isnan(series.values), -np.inf, series.values)  # [T, K]
    worst = filled.max(axis=1)
    applies = worst[worst > -np.inf]
    value = float(np.quantile(applies, 1 - limit.share, method="inverted_cdf"))
    verdict: Verdict = "good" if value <= limit.good else "usable" if value <= limit.bad else "bad"
    return Finding(check, verdict, value, **common, faults=_faults(filled, series.parts, limit.good))


def _faults(values: np.ndarray, parts: Sequence[str] | np.ndarray, bound: float, join: int = 2) -> tuple[Fault, ...]:
    """Runs of frames above a bound; gaps of up to `join` frames are bridged."""
    worst = values.max(axis=1)
    frames = np.flatnonzero(worst > bound)
    if not frames.size:
        return ()
    runs = np.split(frames, np.flatnonzero(np.diff(frames) > join + 1) + 1)
    faults = []
    for run in runs:
        t = int(run[worst[run].argmax()])
        part = str(parts[int(values[t].argmax())])
        faults.append(Fault(int(run[0]), int(run[-1]), t, float(worst[t]), part))
    return tuple(faults)
