"""Speed and memory of the engines by number of worlds: raw physics, environment, training.

    hdmi gpu-report [engines=[cpu,gpu]] [worlds=[512,4096]] [out=report.jsonl] [overrides=[compile=true]]

Each line of the table is `hdmi benchmark` in a process of its own, with `overrides` as for `hdmi train`; nothing else
should run on the machine. A measurement that fails (no GPU, no memory) keeps its line, with the reason. `out` gets one
JSON object per measurement.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from hdmi.commands.options import parse_options
from hdmi.commands.script import run_script
from hdmi.config import ConfigError

COLUMNS = {
    "raw_physics_sps": "raw steps/s",
    "env_sps": "env steps/s",
    "env_ratio": "env/raw",
    "train_sps": "train steps/s",
    "train_ratio": "train/raw",
    "memory_gb": "memory GB",
    "gpu_memory_gb": "GPU GB",
}


@dataclass
class Options:
    """See the module."""

    engines: list[str] = field(default_factory=lambda: ["cpu", "gpu"])  # configs in conf/sim
    worlds: list[int] = field(default_factory=lambda: [512, 1024, 2048, 4096, 8192])
    out: str = "gpu_report.jsonl"
    overrides: list[str] = field(default_factory=list)


def measure(engine: str, worlds: int, overrides: Sequence[str]) -> dict[str, Any]:
    """The benchmark's figures, or why there are none under `error`."""
    command = [sys.executable, "-m", "hdmi", "benchmark", f"sim={engine}", f"num_envs={worlds}", *overrides]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    said = {"sim": engine, "num_envs": worlds}
    if done.returncode:
        return said | {"error": (done.stderr or done.stdout).strip().splitlines()[-1:]}
    return said | json.loads(done.stdout.strip().splitlines()[-1])


def table_of(rows: Sequence[dict[str, Any]]) -> Table:
    """One line per measurement."""
    table = Table("engine", "worlds", *COLUMNS.values())
    for row in rows:
        if "error" in row:
            table.add_row(row["sim"], str(row["num_envs"]), *row["error"])
        else:
            figures = (f"{row[key]:.4g}" if key in row else "" for key in COLUMNS)
            table.add_row(row["engine"], str(row["num_envs"]), *figures)
    return table


def report(arguments: list[str], console: Console) -> int:
    """Measures one after the other, and shows the table."""
    options = parse_options(Options, arguments)
    if not options.engines or not options.worlds:
        raise ConfigError("engines and worlds: give at least one of each")
    rows = []
    with Path(options.out).open("w", encoding="utf-8") as file:
        for engine in options.engines:
            for worlds in options.worlds:
                rows.append(measure(engine, worlds, options.overrides))
                file.write(json.dumps(rows[-1]) + "\n")
                file.flush()
    console.print(table_of(rows))
    return 0


def main(arguments: list[str]) -> int:
    """Runs the script; returns its exit status."""
    return run_script(report, arguments, __doc__)
