"""Trains a policy: check the config, show the stack, train, evaluate, render.

    hdmi train [group=choice ...] [node.key=value ...] [+ablation=NAME]

Arguments are Hydra's; `hdmi train --help` has the groups.
"""

from __future__ import annotations

import sys
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import hydra
from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.errors import ConfigCompositionException
from omegaconf import DictConfig, OmegaConf, open_dict
from rich.console import Console
from rich.markup import escape

from hdmi.assembly import describe, make_transforms
from hdmi.commands.script import USER_ERRORS, run_composed
from hdmi.config import CONF, run_container
from hdmi.console import make_console
from hdmi.envs.rendering import RenderingError
from hdmi.evaluation import evaluate_checkpoint, render_checkpoint
from hdmi.evaluation.protocol import training_figures
from hdmi.learning import make_trainer
from hdmi.learning.checkpoint import CheckpointError, checkpoints, load_checkpoint
from hdmi.learning.logger import RunLogger
from hdmi.learning.resume import KEPT, continued_config, differences, find_run, with_own_arguments


def train(cfg: DictConfig) -> None:
    """Runs one training from a config; leaves checkpoints, metrics.csv, eval.json and a video in its run folder."""
    console = make_console()
    try:
        cfg, folder, notes = open_run(cfg)
        trainer = make_trainer(cfg, folder, training_figures)
    except USER_ERRORS as error:
        console.print(f"[red]{type(error).__name__}:[/red] {escape(str(error))}", highlight=False, soft_wrap=True)
        sys.exit(2)
    console.quiet = not trainer.ranks.is_first
    console.print(describe(make_transforms(cfg, trainer.task)))
    ranks = f" on each of {trainer.ranks.size} ranks" if trainer.ranks.size > 1 else ""
    console.print(
        f"task {trainer.task.name}: {trainer.task.reference.num_frames} frames, {cfg.num_envs} environments{ranks}, "
        f"observations {trainer.sizes}, run folder {folder}",
        soft_wrap=True,
    )
    for note in [*notes, *(f"from {cfg.warm_start}: {taken}" for taken in trainer.taken)]:
        console.print(note, soft_wrap=True, markup=False)
    try:
        trainer.run(partial(finish, cfg, folder, console))
    except KeyboardInterrupt:
        console.print(f"interrupted; continue with resume={folder}", soft_wrap=True)
        sys.exit(130)
    except USER_ERRORS as error:
        console.print(f"[red]{type(error).__name__}:[/red] {escape(str(error))}", highlight=False, soft_wrap=True)
        sys.exit(2)


def finish(cfg: DictConfig, folder: Path, console: Console, logger: RunLogger) -> None:
    """Evaluates the trained policy and renders it; the log is told of both."""
    result = evaluate_checkpoint(folder, num_envs=cfg.eval_envs)
    console.print(result.table())
    logger.finish({f"eval/{name}": value["mean"] for name, value in result.figures().items()})
    if cfg.video:
        try:
            video = render_checkpoint(folder)
        except (RenderingError, OSError) as error:
            console.print(f"no video: {error}", soft_wrap=True)
        else:
            logger.video(video)
            console.print(f"video: {video}", soft_wrap=True)


def open_run(cfg: DictConfig) -> tuple[DictConfig, Path, list[str]]:
    """Where a training goes, and under which config: of a run to continue its own, changed by what was typed.

    Returns:
        The config, the run folder, and what there is to tell about a continued run, a line each.

    Raises:
        CheckpointError: for a run that cannot be continued, or a new one in the folder of an old one.
        ConfigError: for options that do not fit the run to continue.
    """
    typed: Any = None
    if HydraConfig.initialized():
        typed = OmegaConf.to_container(HydraConfig.get().overrides.task, resolve=False)
    if cfg.resume is None:
        if typed is not None:
            with open_dict(cfg):
                cfg.overrides = [text for text in typed if not text.startswith("resume")]
        return cfg, run_folder(cfg), []
    folder, checkpoint = find_run(cfg.resume)
    state = load_checkpoint(checkpoint)
    call = {"resume": str(checkpoint), "resume_anyway": cfg.resume_anyway}
    if typed is not None:  # else the config is what the caller made of it
        given = cfg
        cfg = continued_config(state["config"], typed, partial(compose, HydraConfig.get().job.config_name))
    with open_dict(cfg):
        cfg.merge_with(call)
    notes = [f"continues from iteration {state['iteration']}, {checkpoint}, under the run's config, but for:"]
    changes = differences(state["config"], run_container(cfg))
    notes += [f"  {path}: {_short(old)} -> {_short(new)}" for path, (old, new) in changes.items()]
    if not changes:
        notes = [notes[0].removesuffix(", but for:")]
    if typed is not None:
        notes += [
            f"  {key} stays {OmegaConf.select(cfg, key)}: {why}"
            for key, why in KEPT.items()
            if any(text.startswith(f"{key}=") for text in typed)
            and OmegaConf.select(given, key) != OmegaConf.select(cfg, key)
        ]
    return cfg, folder, notes


def _short(value: object) -> str:
    if isinstance(value, dict):
        return str(value.get("_target_", "{...}")).rpartition(".")[2]
    return "null" if value is None else str(value)


def run_folder(cfg: DictConfig) -> Path:
    """The folder of a new run; its name is noted in the config.

    Raises:
        CheckpointError: if a new run would go into the folder of an old one.
    """
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


@hydra.main(config_path=str(CONF), config_name="config", version_base="1.3")
def _composed(cfg: DictConfig) -> None:
    train(cfg)


def _composed_for_the_run() -> None:
    """As `_composed`; to continue a run, nodes may be typed that only its own task, levers and groups have."""
    typed = sys.argv[1:]
    sys.argv[1:] = with_own_arguments(typed)
    try:
        _composed()
    except ConfigCompositionException:
        if sys.argv[1:] == typed:
            raise
        sys.argv[1:] = typed  # configs have changed since the run was made
        _composed()


def main() -> None:
    """Trains under the config that the command line composes."""
    run_composed(_composed_for_the_run)
