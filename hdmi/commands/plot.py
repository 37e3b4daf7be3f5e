"""Plots learning curves of runs against frames and minutes.

hdmi plot RUN [RUN ...] [--seeds] --out curves.png
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
    parser.add_argument(
        "--seeds", action="store_true", help="runs that differ only in their seed are one curve, with a band around it"
    )
    options = parser.parse_args(arguments)
    try:
        plot_runs(options.runs, options.out, max(options.smooth, 1), seeds=options.seeds)
    except (OSError, ValueError) as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 2
    print(options.out)
    return 0
