"""Where commands print."""

from __future__ import annotations

import sys

from rich.console import Console


def make_console(width: int = 150) -> Console:
    """Standard output; where that is no terminal, so wide that tables keep their columns."""
    return Console() if sys.stdout.isatty() else Console(width=width)
