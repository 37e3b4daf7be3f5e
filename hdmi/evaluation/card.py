"""A trained policy to hand on: weights and normalization, evaluation, video, and a card that says where it is from."""

from __future__ import annotations

import os
import platform
from pathlib import Path

from omegaconf import OmegaConf

from hdmi.deploy.format import GRAPH_FILE, NETWORK_FILE, SCENE_FILE, SPEC_FILE
from hdmi.evaluation.protocol import EvalResult, evaluate_checkpoint, unit_of
from hdmi.evaluation.video import render_checkpoint
from hdmi.learning import export_policy, load_checkpoint
from hdmi.learning.checkpoint import POLICY_FILE

_SIZE = (240, 320)  # of the video, pixels


def export(run_or_checkpoint: str | Path, folder: str | Path, num_envs: int = 256, seed: int = 0) -> Path:
    """Writes policy.pt, config.yaml, eval.json, video.mp4 and README.md, evaluated and rendered from that policy.pt.

    Args:
        run_or_checkpoint: a run folder (its newest checkpoint counts) or a checkpoint file.
        folder: is made if it is not there; `hdmi play checkpoint=FOLDER` and `hdmi evaluate` take it.

    Raises:
        CheckpointError: if there is no usable checkpoint.
        ConfigError, MotionError: if its environment cannot be built here.
        RenderingError: without OpenGL; says what to install.
        OSError: if a file cannot be written.
    """
    folder = Path(folder)
    policy = export_policy(run_or_checkpoint, folder / POLICY_FILE)
    state = load_checkpoint(policy)
    OmegaConf.save(OmegaConf.create(state["config"]), folder / "config.yaml")
    result = evaluate_checkpoint(policy, num_envs, seed=seed, out=folder / "eval.json")
    render_checkpoint(policy, seed=seed, size=_SIZE)
    (folder / "README.md").write_text(_card(state, result, folder, seed), encoding="utf-8")
    return folder


def _card(state: dict, result: EvalResult, folder: Path, seed: int) -> str:
    """The text of README.md."""
    config = state["config"]
    command = " ".join(["hdmi train", *config.get("overrides", ())])
    rows = [f"| {name} | {_shown(name, value['mean'])} |" for name, value in result.figures().items()]
    for name, share in result["termination_causes"].items():
        if share:
            rows.append(f"| failed by {name} | {100 * share:.1f} %, median frame {result['failure_frames'][name]:g} |")
    lines = [
        f"# {state['task']}",
        "",
        f"A policy after {state['frames']:,} frames, {state['elapsed'] / 60:.0f} minutes of collection and learning, "
        f"with {config['num_envs']} environments on {config['num_threads'] or 'all'} of {os.cpu_count()} processors "
        f"({_processor()}), seed {config['seed']}.",
        "",
        "```",
        command,
        f"hdmi evaluate checkpoint={folder} num_envs={result['num_envs']} seed={seed}",
        f"hdmi play checkpoint={folder}",
        "```",
        "",
        *_graph_lines(folder),
        f"`policy.pt` holds the weights and the observations' normalization ({_megabytes(folder / POLICY_FILE)} MB); "
        "`config.yaml` is the whole config of the training, `eval.json` the evaluation from the first frame, under the "
        "training's reset noise and randomization:",
        "",
        f"| {result['num_envs']} episodes | mean |",
        "|---|---|",
        *rows,
    ]
    return "\n".join(lines) + "\n"


def _graph_lines(folder: Path) -> list[str]:
    """What the card says of the deployment graph, if there is one."""
    if not (folder / GRAPH_FILE).is_file():
        return []
    size, described = _megabytes(folder / GRAPH_FILE), (folder / SPEC_FILE).is_file()
    return [
        f"`{GRAPH_FILE}` is the policy with its observations and actions as one graph, from sensors to joint position "
        f"targets ({size} MB); `{SCENE_FILE}` is the scene that it was trained in."
        + f" `{SPEC_FILE}` describes the network alone, `{NETWORK_FILE}`, for other runners."
        * described,
        "",
    ]


def _shown(name: str, value: float) -> str:
    unit = unit_of(name)
    return f"{100 * value:.1f} %" if unit == "%" else f"{value:.3g} {unit}".rstrip()


def _megabytes(path: Path) -> str:
    return f"{path.stat().st_size / 1e6:.1f}"


def _processor() -> str:
    """Name of this machine's processor, as far as the system tells it."""
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
