"""Plots learning curves of runs against frames and minutes.

hdmi plot RUN [RUN ...] --out curves.png
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from hdmi.evaluation.curves import plot_runs


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; returns its exit status."""
    parser = argparse.ArgumentParser("hdmi plot", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="run folder, or a metrics.csv")
    parser.add_argument("--out", type=Path, default=Path("curves.png"), help="picture to write (default: %(default)s)")
    parser.add_argument("--smooth", type=int, default=1, metavar="ROWS", help="trailing mean over so many rows")
    options = parser.parse_args(arguments)
    try:
        plot_runs(options.runs, options.out, max(options.smooth, 1))
    except (OSError, ValueError) as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 2
    print(options.out)
    return 0
