"""Rows of a run's metrics.csv."""

from __future__ import annotations

import csv
from pathlib import Path

METRICS_FILE = "metrics.csv"  # in a run folder


def read_rows(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """Columns and rows of a metrics.csv; a last row that was written in part, as by a killed run, is left out.

    Raises:
        OSError: if it cannot be read.
    """
    text = path.read_text(encoding="utf-8", errors="replace")
    whole = text[: text.rfind("\n") + 1]
    reader = csv.DictReader(whole.splitlines())
    rows = [row for row in reader if None not in row and None not in row.values()]
    return list(reader.fieldnames or []), rows
