"""Trained policies that ship: what each was trained with, and what all of them come to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.table import Table
from yaml import YAMLError, safe_load

from hdmi.assembly import make_task
from hdmi.config import ConfigError
from hdmi.evaluation.protocol import EvalResult, evaluate_conditions
from hdmi.evaluation.video import STRIDE, VIDEO_FILE
from hdmi.learning.checkpoint import POLICY_FILE, CheckpointError, load_checkpoint
from hdmi.learning.policy import load_config
from hdmi.tasks.gallery import picture_frame

_COLUMNS = (
    "policy", "frames", "minutes", "success", "survival", "with early ends", "task's noise", "joints rad", "bodies cm",
    "object", "what fails",
)  # fmt: skip
_CONDITIONS = ("early_end", "task_starts")  # of the columns after survival
_SHEET_COLUMNS = 4


def read_recipes(path: str | Path) -> dict[str, list[str]]:
    """What policies are trained with: name of a policy -> arguments of `hdmi train`.

    Args:
        path: a YAML file, `name: [task=NAME, total_frames=1000000]` a line.

    Raises:
        ConfigError: if it cannot be read, or is not of that form; names the policy.
    """
    path = Path(path)
    try:
        found: Any = safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no file there; recipes=FILE names the policies, each with its arguments") from None
    except (YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(found, Mapping) or not found:
        raise ConfigError(f"{path}: expected lines such as walk: [task=walk, total_frames=1000000]")
    for name, arguments in found.items():
        if not isinstance(arguments, list) or not all(isinstance(text, str) and "=" in text for text in arguments):
            raise ConfigError(f"{path}: {name}: expected a list of arguments such as [task=walk], got {arguments!r}")
    return {str(name): arguments for name, arguments in found.items()}


def policies(zoo: str | Path) -> list[str]:
    """Names of the policies in a folder, alphabetically.

    Raises:
        CheckpointError: if there is none.
    """
    found = sorted(path.parent.name for path in Path(zoo).glob(f"*/{POLICY_FILE}"))
    if not found:
        raise CheckpointError(f"{zoo}: no folder with a {POLICY_FILE} there")
    return found


@dataclass(frozen=True)
class Entry:
    """A policy of a zoo and its evaluations.

    Args:
        name: its folder's.
        frames: of its training, control steps.
        minutes: of collection and learning.
        results: by the paper's protocol, under each of `protocol.conditions`.
    """

    name: str
    frames: int
    minutes: float
    results: dict[str, EvalResult]

    @property
    def result(self) -> EvalResult:
        """Under the terminations and starts of its training."""
        return self.results["training"]

    def success(self, condition: str) -> float | None:
        """Share of episodes that succeed under a condition, None if it is not one of this policy's."""
        found = self.results.get(condition)
        return None if found is None else found["success_rate"]["mean"]


def evaluate_entry(
    zoo: str | Path, name: str, num_envs: int = 256, seed: int = 0, num_threads: int | None = None
) -> Entry:
    """Evaluates a policy of a zoo.

    Raises:
        CheckpointError: if there is no usable policy.
        ConfigError, MotionError: if its environment cannot be built here.
    """
    file = Path(zoo) / name / POLICY_FILE
    state = load_checkpoint(file)
    results = evaluate_conditions(file, num_envs, seed, num_threads)
    return Entry(name, state["frames"], state["elapsed"] / 60, results)


def zoo_rows(entries: Sequence[Entry]) -> list[list[str]]:
    """What the entries come to, a row of text for each; see `zoo_table`."""
    rows = []
    for entry in entries:
        figures = entry.result.figures()

        def shown(key: str, form: str, factor: float = 1.0, figures: dict[str, Any] = figures) -> str:
            return form.format(factor * figures[key]["mean"]) if key in figures else ""

        thing = shown("object_joint_error", "{:.3f} rad") or shown("object_pos_error", "{:.1f} cm", 100)
        causes = sorted(entry.result["termination_causes"].items(), key=lambda item: -item[1])
        fails = [
            f"{cause} {100 * share:.1f} % (frame {entry.result['failure_frames'][cause]:g})"
            for cause, share in causes
            if share
        ]
        rows.append([
            entry.name, f"{entry.frames / 1e6:.1f} M", f"{entry.minutes:.0f}", shown("success_rate", "{:.1f} %", 100),
            shown("survival", "{:.1f} %", 100),
            *("" if (share := entry.success(name)) is None else f"{100 * share:.1f} %" for name in _CONDITIONS),
            shown("joint_error", "{:.3f}"), shown("body_error", "{:.1f}", 100), thing, ", ".join(fails),
        ])  # fmt: skip
    return rows


def zoo_table(entries: Sequence[Entry]) -> Table:
    """What the entries come to, as a table for a terminal."""
    envs = {entry.result["num_envs"] for entry in entries}
    seeds = {entry.result["seed"] for entry in entries}
    over = "/".join(str(count) for count in sorted(envs))
    seed = "/".join(str(value) for value in sorted(seeds))
    good = sum(entry.result["success_rate"]["mean"] >= 0.9 for entry in entries)
    title = f"{good} of {len(entries)} policies succeed in 90 % or more of {over} episodes, seed {seed}"
    table = Table(title=title, title_justify="left")
    for column in _COLUMNS:
        left = column in ("policy", "what fails")
        table.add_column(column, justify="left" if left else "right", overflow="fold")
    for row in zoo_rows(entries):
        table.add_row(*row)
    return table


def zoo_markdown(entries: Sequence[Entry], folder: str) -> str:
    """The same for a document that stands beside `folder`, in which each policy has its card."""
    lines = [f"| {' | '.join(_COLUMNS)} |", "|---" * len(_COLUMNS) + "|"]
    for name, *cells in zoo_rows(entries):
        lines.append(f"| {' | '.join([f'[`{name}`]({folder}/{name})', *cells])} |")
    return "\n".join(lines) + "\n"


def render_sheet(zoo: str | Path, names: Sequence[str], path: str | Path) -> Path:
    """A contact sheet: of each policy's video the picture at mid-contact.

    Raises:
        ConfigError: for a format that pictures cannot have. OSError: if a video is missing.
    """
    path = Path(path)
    if path.suffix not in (".jpg", ".png"):
        raise ConfigError(f"{path}: expected a .jpg or .png file")
    rows = -(-len(names) // _SHEET_COLUMNS)
    figure = Figure(figsize=(3.2 * _SHEET_COLUMNS, 2.65 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    for ax, name in zip(figure.subplots(rows, _SHEET_COLUMNS, squeeze=False).flat, names, strict=False):
        ax.imshow(_still(Path(zoo) / name))
        ax.set_title(name, fontsize=11)
    for ax in figure.axes:
        ax.axis("off")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    return path


def _still(folder: Path) -> Any:
    """The picture of a policy's video at mid-contact, or its last one. uint8 [height, width, 3]"""
    wanted = picture_frame(make_task(load_config(folder))) // STRIDE
    pictures = imageio.mimread(folder / VIDEO_FILE, memtest=False)
    return pictures[min(wanted, len(pictures) - 1)]
