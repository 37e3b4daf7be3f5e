"""Everything that went into a policy and came out of it, tick by tick, as one npz file."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

LOG_FORMAT = "hdmi-log/1"


class LogError(ValueError):
    """A log that cannot be used; the message names file and entry."""


class Replayed(Protocol):
    """What a replay needs of a policy: see `hdmi.deploy.policy.Policy`."""

    sensors: tuple[str, ...]

    def reset(self, start_frame: int = 0) -> None: ...

    def __call__(self, sensors: Mapping[str, np.ndarray]) -> np.ndarray: ...


@dataclass
class Log:
    """A row for each tick, and events between them.

    Rows (T ticks, J joints; not-a-number where there was none):
        `time`, `late`, `ms` [T]: the robot's clock, s; s after the tick's time; the runner's own work, ms;
        `state` [T]: number in `header["states"]`; `frame` int [T]: of the motion, -1 without policy;
        `reset` bool [T]: whether the policy's episode began with this tick;
        `sensors/<name>` float32 [T, *]: what the policy was given; `stamps/<name>` [T]: when it was measured, s;
        `target` float32 [T, J]: of the policy, rad; `command` [T, J]: to the servos, rad;
        `stiffness`, `damping` [T, J]: of the servos, N m/rad and N m s/rad.

    Args:
        header: what runs: `joint_names`, `states`, `policy` (its digest), options; has to survive JSON.
    """

    header: dict[str, Any] = field(default_factory=dict)
    rows: list[dict[str, Any]] = field(default_factory=list)
    events: list[tuple[float, str]] = field(default_factory=list)

    def add(self, row: Mapping[str, Any]) -> None:
        """Appends a tick."""
        self.rows.append(dict(row))

    def note(self, time: float, text: str) -> None:
        """Appends an event at a time of the robot's clock, s."""
        self.events.append((time, text))

    def arrays(self) -> dict[str, np.ndarray]:
        """The rows, by name; a row that lacks an entry has not-a-number there."""
        names = dict.fromkeys(name for row in self.rows for name in row)
        found = {}
        for name in names:
            like = np.asarray(next(row[name] for row in self.rows if name in row))
            if like.dtype.kind == "f":
                empty = np.full(like.shape, np.nan, dtype=like.dtype)
                found[name] = np.stack([np.asarray(row.get(name, empty), dtype=like.dtype) for row in self.rows])
            else:
                found[name] = np.stack([np.asarray(row[name]) for row in self.rows])
        return found

    def write(self, path: str | Path) -> Path:
        """Writes the file; a crash or a full disk leaves what was there before.

        Raises:
            OSError: if it cannot be written.
        """
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(path.name + ".partial")
        about = json.dumps({"format": LOG_FORMAT, "events": self.events} | self.header)
        try:
            with open(partial, "wb") as file:
                np.savez_compressed(file, header=np.array(about), **self.arrays())  # type: ignore[arg-type]
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)
        return path


def read_log(path: str | Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header, with `events`, and rows of a log.

    Raises:
        LogError: if there is no such file, or it is no log.
    """
    path = Path(path)
    if not path.is_file():
        raise LogError(f"{path}: there is no such file")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(str(arrays.pop("header")))
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise LogError(f"{path}: is no log of the runner: {error}") from error
    except Exception as error:  # zipfile's, of a file that was cut off
        raise LogError(f"{path}: is no log of the runner: {error}") from error
    if header.get("format") != LOG_FORMAT:
        raise LogError(f"{path}: format {header.get('format')!r}; this version reads {LOG_FORMAT!r}")
    return header, arrays


def replay(arrays: Mapping[str, np.ndarray], policy: Replayed) -> np.ndarray:
    """Largest difference between logged targets and what the policy makes of the logged sensors, rad. [ticks run]

    Args:
        arrays: rows of a log.

    Raises:
        LogError: if the log has no ticks with a policy, or lacks a sensor.
    """
    if "target" not in arrays or not len(ran := np.flatnonzero(arrays["frame"] >= 0)):
        raise LogError("the policy never ran in this log")
    names = policy.sensors
    if missing := [name for name in names if f"sensors/{name}" not in arrays]:
        raise LogError(f"the log lacks {', '.join(f'sensors/{name}' for name in missing)}, which the policy needs")
    differences = np.zeros(len(ran))
    for row, tick in enumerate(ran):
        if arrays["reset"][tick]:
            policy.reset(int(arrays["frame"][tick]))
        target = policy({name: arrays[f"sensors/{name}"][tick] for name in names})
        differences[row] = np.abs(target - arrays["target"][tick]).max()
    return differences
