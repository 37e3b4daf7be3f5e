"""What `train.py` does: check the config, show the stack, train, evaluate, render; and how every script runs."""

from __future__ import annotations

import sys
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, open_dict
from rich.console import Console

from hdmi.build import ConfigError, describe, make_transforms
from hdmi.console import make_console
from hdmi.learning.checkpoint import CheckpointError, checkpoints
from hdmi.learning.collectors import WorkerError
from hdmi.learning.trainer import DivergenceError, Trainer
from hdmi.motion import MotionError

# What a user can put right: shown as one line, without a traceback.
USER_ERRORS = (ConfigError, MotionError, CheckpointError, DivergenceError, WorkerError, FileNotFoundError)


def main(cfg: DictConfig) -> None:
    """Runs one training from a config; leaves checkpoints, metrics.csv, eval.json and a video in its run folder."""
    console = make_console()
    try:
        folder = run_folder(cfg)
        trainer = Trainer(cfg, folder)
    except USER_ERRORS as error:
        console.print(f"[red]{type(error).__name__}:[/red] {error}", highlight=False, soft_wrap=True)
        sys.exit(2)
    console.quiet = not trainer.ranks.is_first
    console.print(describe(make_transforms(cfg, trainer.task)))
    ranks = f" on each of {trainer.ranks.size} ranks" if trainer.ranks.size > 1 else ""
    console.print(
        f"task {trainer.task.name}: {trainer.task.reference.num_frames} frames, {cfg.num_envs} environments{ranks}, "
        f"observations {trainer.sizes}, run folder {folder}",
        soft_wrap=True,
    )
    try:
        trainer.run()
    except KeyboardInterrupt:
        console.print(f"interrupted; continue with resume={folder}", soft_wrap=True)
        sys.exit(130)
    except USER_ERRORS as error:
        console.print(f"[red]{type(error).__name__}:[/red] {error}", highlight=False, soft_wrap=True)
        sys.exit(2)
    if trainer.ranks.is_first:
        finish(cfg, folder, console)


def finish(cfg: DictConfig, folder: Path, console: Console) -> None:
    """Evaluates the trained policy and renders it."""
    from hdmi.evaluation import RenderingError, evaluate_checkpoint, render_checkpoint

    result = evaluate_checkpoint(folder, num_envs=cfg.eval_envs)
    console.print(result.table())
    if cfg.video:
        try:
            console.print(f"video: {render_checkpoint(folder)}", soft_wrap=True)
        except (RenderingError, OSError) as error:
            console.print(f"no video: {error}", soft_wrap=True)


def run_script(
    body: Callable[[list[str], Console], int],
    arguments: list[str],
    doc: str | None,
    *,
    width: int = 150,
    errors: tuple[type[Exception], ...] = (),
) -> int:
    """Runs a script: shows its help, or does what it is for; what a user can put right is one line, not a traceback.

    Args:
        body: does it, and returns the exit status.
        doc: the help.
        width: of tables, where the output is no terminal.
        errors: what a user can put right besides `USER_ERRORS`, missing extras and what the file system says.

    Returns:
        The exit status: the body's, 0 after the help, 2 after a mistake, 130 when interrupted.
    """
    if arguments in (["-h"], ["--help"]):
        print(doc)
        return 0
    console = make_console(width)
    caught: tuple[type[Exception], ...] = (*USER_ERRORS, ImportError, OSError, *errors)
    try:
        return body(arguments, console)
    except caught as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def run_folder(cfg: DictConfig) -> Path:
    """The folder of a new run, or the one to continue. Notes in the config what it was called with.

    Raises:
        CheckpointError: if a new run would go into the folder of an old one.
    """
    if HydraConfig.initialized():
        with open_dict(cfg):
            # a continued run is the uninterrupted one
            cfg.overrides = [text for text in HydraConfig.get().overrides.task if not text.startswith("resume=")]
    if cfg.resume is not None:
        path = Path(cfg.resume)
        folder = path if path.is_dir() else path.parent.parent
        return folder
    name = cfg.run_name
    if name is None:
        label = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
        if HydraConfig.initialized():
            ablation = HydraConfig.get().runtime.choices.get("ablation")
            label += f"_{ablation}" if ablation else ""
        name = f"{label}_seed{cfg.seed}"
    with open_dict(cfg):
        cfg.run_name = name
    folder = Path(cfg.output_dir) / name
    if checkpoints(folder / "checkpoints"):
        raise CheckpointError(
            f"run_name={name}: {folder} holds a run already; continue it with resume={folder} or choose another name"
        )
    return folder
