"""Metrics of a run: a CSV file, and W&B if it is configured."""

from __future__ import annotations

import csv
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf


class RunLogger:
    """Appends rows to `metrics.csv` and sends them to W&B.

    A row that cannot be written (full disk) is reported and counted, not fatal.

    Args:
        cfg: the whole config; `cfg.logger.wandb` is null or {mode, project}.
        last_iteration: of a run to continue; rows after it are dropped.
    """

    def __init__(self, folder: Path, cfg: DictConfig, last_iteration: int = 0):
        self.path = folder / "metrics.csv"
        self.lost_rows = 0
        self._fields: list[str] = []
        if self.path.is_file():
            with self.path.open(newline="") as file:
                reader = csv.DictReader(file)
                rows = [row for row in reader if int(row["iteration"] or 0) <= last_iteration]
                self._fields = list(reader.fieldnames or [])
            self._rewrite(rows)
        self._wandb = _start_wandb(folder, cfg) if cfg.logger.wandb is not None else None

    def log(self, iteration: int, values: Mapping[str, float]) -> None:
        """One row of figures."""
        row: dict[str, Any] = {"iteration": iteration, **values}
        try:
            if new := [key for key in row if key not in self._fields]:
                self._widen(new)
            with self.path.open("a", newline="") as file:
                csv.DictWriter(file, self._fields).writerow(row)
        except OSError as error:
            self.lost_rows += 1
            print(f"metrics of iteration {iteration} not written to {self.path}: {error}", file=sys.stderr)
        if self._wandb is not None:
            self._wandb.log(row, step=iteration)

    def _widen(self, new: list[str]) -> None:
        rows: list[dict[str, Any]] = []
        if self.path.is_file():
            with self.path.open(newline="") as file:
                rows = list(csv.DictReader(file))
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
    import wandb

    return wandb.init(
        project=cfg.logger.wandb.project,
        mode=cfg.logger.wandb.mode,
        dir=folder,
        name=folder.name,
        config=dict(OmegaConf.to_container(cfg, resolve=True)),  # type: ignore[arg-type]
        settings=wandb.Settings(silent=True, console="off"),
    )
