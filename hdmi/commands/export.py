"""Exports a trained policy: its deployment graph, weights and normalization, config, evaluation, video and a card.

    hdmi export checkpoint=RUN out=FOLDER [num_envs=256] [seed=0] [graph=true]

`checkpoint` is a run folder (its newest checkpoint counts), an exported policy, or a checkpoint file. The graph
(policy.onnx, with scene.xml; extra `deploy`) goes from sensors to joint position targets; a policy that sees what no
robot measures is refused by the name of the observation, graph=false exports it all the same. The policy is evaluated
and rendered from what was written; `hdmi evaluate` and `hdmi play` take FOLDER as their `checkpoint`.
"""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console

from hdmi.commands.options import parse_options
from hdmi.commands.script import run_script
from hdmi.config import ConfigError
from hdmi.deploy.format import DeploymentError
from hdmi.envs.rendering import RenderingError
from hdmi.evaluation.card import export


@dataclass
class Options:
    """See the module."""

    checkpoint: str | None = None
    out: str | None = None
    num_envs: int = 256
    seed: int = 0
    graph: bool = True


def write(arguments: list[str], console: Console) -> int:
    """Exports, and shows the card."""
    del console
    options = parse_options(Options, arguments)
    if options.checkpoint is None or options.out is None:
        raise ConfigError("give checkpoint=RUN and out=FOLDER")
    if options.graph:
        from hdmi.deploy.export import export_graph  # of an extra

        export_graph(options.checkpoint, options.out)
    folder = export(options.checkpoint, options.out, options.num_envs, options.seed)
    print((folder / "README.md").read_text(encoding="utf-8"))
    return 0


def main(arguments: list[str]) -> int:
    """Runs the script; returns its exit status."""
    return run_script(write, arguments, __doc__, errors=(RenderingError, DeploymentError))
