"""Evaluates a checkpoint by the paper's protocol; prints the figures and writes eval.json.

    python scripts/evaluate.py checkpoint=RUN [num_envs=256] [terminations=all] [seed=0] [task=NAME] ...

`checkpoint` is a run folder (its newest checkpoint counts) or a checkpoint file. `terminations` are those that end
an episode as a failure: `all` that the policy was trained with, `none`, or a list such as
[root_pose,object_pose].
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

from rich.console import Console

from hdmi.build import ConfigError
from hdmi.cli import USER_ERRORS
from hdmi.evaluation import evaluate_checkpoint
from hdmi.evaluation.options import parse_options, parse_terminations


@dataclass
class Options:
    """See the module."""

    checkpoint: str | None = None
    num_envs: int = 256
    terminations: Any = "all"
    seed: int = 0
    task: str | None = None  # that the checkpoint must be of
    motion_root: str | None = None  # instead of the training's
    num_threads: int | None = None  # of physics, instead of the training's
    out: str | None = None  # instead of eval.json in the run folder


def main(arguments: list[str]) -> int:
    """Runs the script; returns its exit status."""
    if arguments in (["-h"], ["--help"]):
        print(__doc__)
        return 0
    console = Console()
    try:
        options = parse_options(Options, arguments)
        if options.checkpoint is None:
            raise ConfigError("give checkpoint=RUN, a run folder or a checkpoint file")
        if options.num_envs < 1:
            raise ConfigError(f"num_envs: expected at least 1, got {options.num_envs}")
        result = evaluate_checkpoint(
            options.checkpoint,
            options.num_envs,
            parse_terminations(options.terminations),
            options.seed,
            options.out,
            options.task,
            options.motion_root,
            options.num_threads,
        )
    except (*USER_ERRORS, OSError) as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 2
    console.print(result.table())
    print(result.path)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
