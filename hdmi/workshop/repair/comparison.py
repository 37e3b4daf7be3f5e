"""What the validator finds before and after a repair, side by side."""

from __future__ import annotations

from dataclasses import dataclass

from rich.table import Table

from hdmi.workshop.validate import Finding, Report, Verdict
from hdmi.workshop.validate.report import STYLE

_SLACK = 1.1  # a quantity above its limit is worse from this factor on


@dataclass(frozen=True)
class Comparison:
    """Reports on a motion before and after.

    Examples:
        >>> from hdmi.motion import find_motion, load_motion
        >>> from hdmi.workshop.validate import validate_motion
        >>> report = validate_motion(load_motion(find_motion("walk")))
        >>> Comparison(report, report).worse
        ()
    """

    before: Report
    after: Report

    @property
    def worse(self) -> tuple[str, ...]:
        """Why the motion is not as good as before: checks above their limit by more than a tenth more, or newly bad."""
        earlier = {finding.check: finding for finding in self.before.findings}
        found = []
        for finding in self.after.findings:
            old = earlier.get(finding.check)
            if old is None or _is_worse(old, finding):
                was = f"it was {old.value:.3g}" if old is not None and old.value is not None else "it was not found"
                found.append(f"{finding.reason()}; {was}")
        return tuple(found)

    def table(self) -> Table:
        """All checks that apply: value before and after, limit, unit, and how the verdict changed."""
        title = f"{self.before.motion}: {_coloured(self.before.verdict)} before, {_coloured(self.after.verdict)} after"
        table = Table(title=title, title_justify="left")
        for column in ("check", "before", "after", "limit", "unit", "verdict"):
            table.add_column(column, justify="right" if column in ("before", "after", "limit") else "left")
        earlier = {finding.check: finding for finding in self.before.findings}
        for finding in self.after.findings:
            old = earlier.get(finding.check)
            if finding.value is None and (old is None or old.value is None) and finding.verdict == "good":
                continue
            verdicts = [_coloured(item.verdict) for item in (old, finding) if item is not None]
            changed = " -> ".join(dict.fromkeys(verdicts))
            table.add_row(finding.check, _value(old), _value(finding), f"{finding.good:g}", finding.unit, changed)
        return table


def _is_worse(before: Finding, after: Finding) -> bool:
    if after.verdict == "good" or before == after:
        return False
    if before.value is None or after.value is None or (after.verdict == "bad" and before.verdict != "bad"):
        return True
    return after.value > _SLACK * before.value


def _value(finding: Finding | None) -> str:
    return "-" if finding is None or finding.value is None else f"{finding.value:.3g}"


def _coloured(verdict: Verdict) -> str:
    return f"[{STYLE[verdict]}]{verdict}[/{STYLE[verdict]}]"
