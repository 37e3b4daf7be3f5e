"""A trained policy to hand on: weights and normalization, evaluation, video, and a card that says where it is from."""

from __future__ import annotations

import os
import platform
from pathlib import Path

from omegaconf import OmegaConf

from hdmi.deploy.format import GRAPH_FILE, NETWORK_FILE, SCENE_FILE, SPEC_FILE
from hdmi.evaluation.curves import plot_runs
from hdmi.evaluation.protocol import (
    EVAL_FILE,
    EvalResult,
    evaluate_conditions,
    evaluation_file,
    run_folder_of,
    unit_of,
)
from hdmi.evaluation.video import render_checkpoint
from hdmi.learning import export_policy, load_checkpoint
from hdmi.learning.checkpoint import POLICY_FILE, find_checkpoint
from hdmi.metrics import METRICS_FILE, read_rows

_CARD_FILE = "README.md"
_HEADINGS = {
    "training": "training's terminations and starts",
    "early_end": "its early ends, too",
    "task_starts": "the task's reset noise",
}
_CURVE_FILE = "curve.png"
_CURVES = {"eval/success_rate": "success in evaluation", "eval/survival": "survival in evaluation"}


def export(run_or_checkpoint: str | Path, folder: str | Path, num_envs: int = 256, seed: int = 0) -> Path:
    """Writes policy.pt, config.yaml, eval.json, video.mp4 and README.md, evaluated and rendered from that policy.pt.

    Where there are other conditions to judge it by (`protocol.conditions`) also eval_early_end.json and
    eval_task_starts.json; of a run that was evaluated on the way curve.png.

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
    for file in folder.glob("eval*.json"):  # of an earlier policy
        file.unlink()
    results = evaluate_conditions(policy, num_envs, seed, folder=folder)
    render_checkpoint(policy, seed=seed)
    curve = _plot_curve(run_folder_of(find_checkpoint(run_or_checkpoint)), folder / _CURVE_FILE)
    (folder / _CARD_FILE).write_text(_card(state, results, folder, seed, curve), encoding="utf-8")
    return folder


def _plot_curve(run: Path, path: Path) -> bool:
    """Draws how evaluations went during a training; False if the run has none, and then none from before stays."""
    metrics = run / METRICS_FILE
    rows = read_rows(metrics)[1] if metrics.is_file() else []
    there = any(row.get(key) for row in rows for key in _CURVES)
    if there:
        plot_runs([run], path, curves=_CURVES)
    elif run.resolve() != path.parent.resolve():
        path.unlink(missing_ok=True)
    return path.is_file()


def _card(state: dict, evaluations: dict[str, EvalResult], folder: Path, seed: int, curve: bool) -> str:
    """The text of README.md."""
    config, result, results = state["config"], evaluations["training"], list(evaluations.values())
    command = " ".join(["hdmi train", *config.get("overrides", ())])
    figures = [one.figures() for one in results]
    rows = [
        f"| {name} | {' | '.join(_shown(name, one[name]['mean']) if name in one else '' for one in figures)} |"
        for name in figures[0]
    ]
    for name in dict.fromkeys(cause for one in results for cause in one["termination_causes"]):
        if any(one["termination_causes"].get(name) for one in results):
            rows.append(f"| failed by {name} | {' | '.join(_failed(one, name) for one in results)} |")
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
        f"`config.yaml` is the whole config of the training, `{EVAL_FILE}` the evaluation from the first frame, under "
        "the training's reset noise and randomization"
        + "".join(f"; `{evaluation_file(name)}` likewise under {_HEADINGS[name]}" for name in list(evaluations)[1:])
        + ":",
        "",
        f"| {result['num_envs']} episodes | {' | '.join(_HEADINGS[name] for name in evaluations)} |",
        "|---" * (1 + len(results)) + "|",
        *rows,
    ]
    if curve:
        lines += ["", f"![success and survival in evaluations during the training]({_CURVE_FILE})"]
    return "\n".join(lines) + "\n"


def _failed(result: EvalResult, cause: str) -> str:
    """How often a termination ended episodes, and when."""
    share = result["termination_causes"].get(cause)
    return f"{100 * share:.1f} %, median frame {result['failure_frames'][cause]:g}" if share else ""


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
