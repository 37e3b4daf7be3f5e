"""Checkpoints: written atomically, rotated, read without unpickling code."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock, Timeout

FORMAT = 4
# What the config of an older format has elsewhere; it builds no environment any more.
_SINCE = {
    4: "motion_end and step_count are nodes of horizon, per_second and episode_return of returns, and the stack lists "
    "observation.policy, input.critic, noise, history and input.policy",
}
POLICY_FILE = "policy.pt"  # of an exported policy
BEST_FILE = "best.pt"  # beside a run's checkpoints: the one whose policy evaluated best


class CheckpointError(RuntimeError):
    """A checkpoint that cannot be used; the message names file and cause.

    Examples:
        >>> load_checkpoint("runs/nowhere")
        Traceback (most recent call last):
        hdmi.learning.checkpoint.CheckpointError: ...
    """


@contextmanager
def claim(folder: Path) -> Iterator[None]:
    """Makes a run folder and keeps other trainings out of it; the end of the process, too, sets it free.

    Raises:
        CheckpointError: if another process trains there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / ".lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise CheckpointError(
            f"{folder}: another process trains there; wait for it, stop it, or choose another run_name"
        ) from None
    try:
        yield
    finally:
        lock.release()


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Writes a checkpoint; a crash or a full disk leaves what was there before.

    Args:
        state: tensors, numbers, strings and containers of them.

    Raises:
        OSError: if it cannot be written; the partial file is removed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    try:
        with partial.open("wb") as file:
            torch.save({"format": FORMAT, **state}, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except (OSError, RuntimeError) as error:  # torch reports a full disk as RuntimeError
        partial.unlink(missing_ok=True)
        raise OSError(f"{path}: {error}") from error


def rotate(folder: Path, keep: int) -> None:
    """Removes all but the newest `keep` checkpoints of a run."""
    for path in checkpoints(folder)[:-keep]:
        path.unlink(missing_ok=True)


def checkpoints(folder: Path) -> list[Path]:
    """Checkpoints in a folder, oldest first."""
    return sorted(folder.glob("checkpoint_*.pt"), key=lambda path: (len(path.name), path.name))


def best_checkpoint(folder: Path) -> Path | None:
    """The checkpoint of a run's folder `checkpoints` whose policy evaluated best on the way, if there is one."""
    path = folder / BEST_FILE
    return path if path.is_file() else None


def supersede(folder: Path, iteration: int) -> list[Path]:
    """Moves the checkpoints after an iteration into `superseded`: the run goes on from that one, they would be newer.

    Returns:
        Where they are now.
    """
    later = [path for path in checkpoints(folder) if _iteration(path) > iteration]
    best = best_checkpoint(folder)
    if best is not None and load_checkpoint(best)["iteration"] > iteration:
        later.append(best)
    for path in later:
        (folder / "superseded").mkdir(exist_ok=True)
        path.replace(folder / "superseded" / path.name)
    return [folder / "superseded" / path.name for path in later]


def _iteration(path: Path) -> int:
    number = path.stem.removeprefix("checkpoint_")
    return int(number) if number.isdecimal() else -1


def find_checkpoint(path: str | Path) -> Path:
    """A checkpoint file from itself or from the folder that holds it.

    Raises:
        CheckpointError: if there is none.
    """
    path = Path(path).expanduser()
    if path.is_file():
        return path
    found = [*checkpoints(path), *checkpoints(path / "checkpoints")] if path.is_dir() else []
    if not found and (path / POLICY_FILE).is_file():
        return path / POLICY_FILE
    if not found:
        raise CheckpointError(f"{path}: no checkpoint_*.pt or {POLICY_FILE} there")
    return found[-1]


def load_checkpoint(path: str | Path, map_location: str | torch.device = "cpu") -> dict[str, Any]:
    """Reads a checkpoint file or the newest of a run folder.

    Raises:
        CheckpointError: if there is none, or it is damaged, or not a checkpoint of this format.
    """
    file = find_checkpoint(path)
    try:
        state = torch.load(file, map_location=map_location, weights_only=True)
    except OSError as error:
        raise CheckpointError(f"{file}: cannot be read: {error.strerror or error}") from error
    except Exception as error:  # a file of anything else: whatever reading it as a checkpoint leads to
        raise CheckpointError(
            f"{file}: damaged or not a checkpoint; expected what hdmi train or hdmi export wrote, or its folder"
        ) from error
    found = state.get("format") if isinstance(state, dict) else None
    if isinstance(found, int) and found < FORMAT:
        changes = "; ".join(text for number, text in _SINCE.items() if number > found)
        raise CheckpointError(
            f"{file}: of format {found}, made by an older version of hdmi, whose config does not fit this one (format "
            f"{FORMAT}: {changes}); train it again, or use that version"
        )
    if found != FORMAT:
        raise CheckpointError(f"{file}: not an hdmi checkpoint of format {FORMAT}")
    return state
