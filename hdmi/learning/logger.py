"""Metrics of a run: a CSV file, and W&B if it is configured."""

from __future__ import annotations

import csv
import sys
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from hdmi.metrics import METRICS_FILE, read_rows

_ID_FILE = "wandb_id.txt"  # of the run in W&B, the same for all its continuations
_TAGGED = ("ablation", "preset")  # groups whose choice is a tag


class LoggerError(RuntimeError):
    """W&B does not start; the message says what to do."""


class RunLogger:
    """Appends rows to `metrics.csv` and sends them to W&B, where a run and its continuations are one.

    A row that cannot be written (full disk) is reported and counted, not fatal. TorchRL's CSVLogger writes a file for
    each figure, and its WandbLogger steps that only grow, which those of a continued run do not.

    Args:
        cfg: the whole config; `cfg.logger.wandb` is null or {mode, project}.
        last_iteration: of a run to continue; rows after it are dropped.

    Raises:
        LoggerError: if W&B does not start.
    """

    def __init__(self, folder: Path, cfg: DictConfig, last_iteration: int = 0):
        self.path = folder / METRICS_FILE
        self.lost_rows = 0
        self.iteration = last_iteration
        self._fields: list[str] = []
        self._wandb = _start_wandb(folder, cfg) if cfg.logger.wandb is not None else None
        if self.path.is_file():
            self._fields, rows = read_rows(self.path)
            self._rewrite([row for row in rows if int(row["iteration"]) <= last_iteration])

    def log(self, iteration: int, values: Mapping[str, float]) -> None:
        """One row of figures."""
        self.iteration = iteration
        row: dict[str, Any] = {"iteration": iteration, **values}
        try:
            if new := [key for key in row if key not in self._fields]:
                self._widen(new)
            with self.path.open("a", newline="") as file:
                csv.DictWriter(file, self._fields).writerow(row)
        except OSError as error:
            self._lose(f"metrics of iteration {iteration}", error)
        if self._wandb is not None:
            self._wandb.log(row)

    def finish(self, figures: Mapping[str, float]) -> None:
        """Adds figures of the trained policy to the last row, and to W&B's summary."""
        try:
            self._widen([key for key in figures if key not in self._fields], figures)
        except OSError as error:
            self._lose("last figures", error)
        if self._wandb is not None:
            self._wandb.log({"iteration": self.iteration, **figures})
            self._wandb.summary.update(dict(figures))

    def video(self, path: Path) -> None:
        """Sends a video to W&B."""
        if self._wandb is not None:
            import wandb

            self._wandb.log({"iteration": self.iteration, "video": wandb.Video(str(path), format="mp4")})

    def _lose(self, what: str, error: OSError) -> None:
        self.lost_rows += 1
        print(f"{what} not written to {self.path}: {error}", file=sys.stderr)

    def _widen(self, new: list[str], last: Mapping[str, float] | None = None) -> None:
        rows: list[dict[str, Any]] = read_rows(self.path)[1] if self.path.is_file() else []
        if last and rows:
            rows[-1] |= last
        self._fields += new
        self._rewrite(rows)

    def _rewrite(self, rows: list[dict[str, Any]]) -> None:
        partial = self.path.with_suffix(".partial")
        with partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, self._fields)
            writer.writeheader()
            writer.writerows(rows)
        partial.replace(self.path)

    def close(self) -> None:
        """Ends the W&B run."""
        if self._wandb is not None:
            self._wandb.finish()


def _start_wandb(folder: Path, cfg: DictConfig) -> Any:
    node = cfg.logger.wandb
    try:
        import wandb

        run = wandb.init(
            project=node.project,
            mode=node.mode,
            dir=folder,
            id=_wandb_id(folder),
            resume="allow",
            name=f"{cfg.task.name} {folder.name}",
            group=cfg.task.name,
            tags=_tags(cfg),
            config=dict(OmegaConf.to_container(cfg, resolve=True)),  # type: ignore[arg-type]
            settings=wandb.Settings(silent=True, console="off"),
        )
    except Exception as error:  # of the network, the account, the installation: W&B has no base class for them
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise LoggerError(
            f"logger: W&B does not start in mode {node.mode!r}: {reason[0]}; `wandb login` signs in, logger=offline "
            "needs no network, logger=csv does without W&B"
        ) from error
    # W&B's own steps only grow, but a continued run goes back to its checkpoint
    run.define_metric("iteration")
    run.define_metric("*", step_metric="iteration")
    return run


def _wandb_id(folder: Path) -> str:
    """The run's identity in W&B, made when it is first asked for."""
    file = folder / _ID_FILE
    if not file.is_file():
        file.write_text(uuid.uuid4().hex[:12] + "\n", encoding="utf-8")
    return file.read_text(encoding="utf-8").strip()


def _tags(cfg: DictConfig) -> list[str]:
    choices = (str(text).lstrip("+").partition("=") for text in cfg.get("overrides") or ())
    return [f"{key}={value}"[:64] for key, _, value in choices if key in _TAGGED] + [f"seed={cfg.seed}"]
