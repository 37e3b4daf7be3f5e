"""Trainings in processes of their own: started, continued, and known when they have come to their end."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from hdmi.learning.checkpoint import checkpoints, load_checkpoint

LOG_FILE = "train.log"  # in the run folder: what the commands printed


def train_run(run: Path, arguments: Sequence[str], say: Callable[[str], None], name: str = "") -> str:
    """Trains in a run folder, or continues the training that is there, and waits for it.

    Args:
        run: folder.
        arguments: of `hdmi train`.
        say: takes one line when it begins.
        name: for that line; the folder's without.

    Returns:
        What went wrong, empty if nothing did.
    """
    there = bool(checkpoints(run / "checkpoints"))
    place = [f"resume={run}"] if there else [f"output_dir={run.parent}", f"run_name={run.name}"]
    say(f"{name or run.name}: {'continues' if there else 'begins'}, {run / LOG_FILE}")
    return run_hdmi(run, "train", *arguments, *place)


def run_hdmi(run: Path, *arguments: str) -> str:
    """Runs a command, its output going into the run's log; returns what went wrong, empty if nothing did."""
    run.mkdir(parents=True, exist_ok=True)
    log = run / LOG_FILE
    with log.open("a", encoding="utf-8") as output:
        done = subprocess.run(
            [sys.executable, "-m", "hdmi", *arguments], stdout=output, stderr=subprocess.STDOUT, check=False
        )
    if done.returncode == 0:
        return ""
    said = [line for line in log.read_text(encoding="utf-8").splitlines() if line.strip()] or ["no output"]
    return f"hdmi {arguments[0]} ended with status {done.returncode}, {log}: {said[-1]}"


def frames_left(run: Path) -> int | None:
    """Control steps that a run still has to train; None if it has not begun.

    Raises:
        CheckpointError: if its newest checkpoint cannot be used.
    """
    if not checkpoints(run / "checkpoints"):
        return None
    state = load_checkpoint(run)
    return max(state["config"]["total_frames"] - state["frames"], 0)


def overrides_of(run: Path) -> list[str]:
    """Arguments that a run was started with.

    Raises:
        CheckpointError: if its newest checkpoint cannot be used.
    """
    return list(load_checkpoint(run)["config"].get("overrides", ()))
