"""A page of plots of a log: joints against the motion and their targets, torques against limits, poses, timing."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from hdmi.deploy.description import Description
from hdmi.deploy.log import LogError
from hdmi.deploy.rotations import quat_angle

_SHADES = {"damping": "0.85", "to_start": "#dbe9f6", "run": "white", "hold": "#f6ecd6"}
_SHOWN_JOINTS = 6


def plot_log(
    header: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
    description: Description,
    out: str | Path,
    reference: dict[str, np.ndarray] | None = None,
) -> Path:
    """Draws a log's rows.

    Args:
        header, arrays: of `hdmi.deploy.log.read_log`.
        description: of the policy.
        out: the picture.
        reference: the motion, of `hdmi.deploy.trial.read_reference`; without it targets alone are shown.

    Raises:
        LogError: if the log has no ticks.
        OSError: if the picture cannot be written.
    """
    if "time" not in arrays:
        raise LogError("the log has no ticks to draw")
    time = arrays["time"] - arrays["time"][0]
    frame = arrays["frame"]
    ran = frame >= 0
    figure = Figure(figsize=(13, 15))
    FigureCanvasAgg(figure)
    axes = figure.subplots(5, 2)
    pos = arrays["sensors/joint_pos"]
    error = _joint_errors(pos, frame, ran, arrays, reference)
    # the joints that are farthest off tell most
    worst = np.argsort(-np.nan_to_num(error).max(0))[:_SHOWN_JOINTS]
    for ax, joint in zip(axes.flat, worst, strict=False):
        ax.plot(time, pos[:, joint], label="measured", linewidth=1.2)
        if "command" in arrays:
            ax.plot(time, arrays["command"][:, joint], label="command", linewidth=0.8, alpha=0.8)
        if reference is not None and ran.any():
            ax.plot(time[ran], reference["joint_pos"][frame[ran], joint], "k--", label="motion", linewidth=0.8)
        ax.set_title(description.joint_names[joint], fontsize=9)
        ax.set_ylabel("rad")
    figure.legend(*axes.flat[0].get_legend_handles_labels(), loc="upper right", fontsize=8, frameon=False, ncols=3)
    _torques(axes[3, 0], time, arrays, description)
    _poses(axes[3, 1], time, frame, ran, arrays, reference)
    _timing(axes[4, 0], axes[4, 1], time, arrays)
    states = [header["states"][i] for i in arrays["state"]]
    for ax in (*axes.flat[:_SHOWN_JOINTS], axes[3, 0], axes[3, 1], axes[4, 1]):
        _shade(ax, time, states)
        ax.set_xlabel("s", loc="right", labelpad=-2)
        ax.margins(x=0)
    for ax in axes.flat:
        ax.grid(alpha=0.3)
        ax.tick_params(labelsize=8)
        ax.spines[["top", "right"]].set_visible(False)
    events = "; ".join(f"{at - arrays['time'][0]:.2f} s {text}" for at, text in header.get("events", [])[-3:])
    figure.suptitle(f"{header.get('task', '')}   {events}"[:120], fontsize=10, x=0.01, ha="left")
    figure.tight_layout(rect=(0, 0, 1, 0.985))
    out = Path(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = out.with_name(out.name + ".partial")
    figure.savefig(partial, dpi=110, format=out.suffix.removeprefix(".") or "png")
    os.replace(partial, out)
    return out


def _joint_errors(
    pos: np.ndarray,
    frame: np.ndarray,
    ran: np.ndarray,
    arrays: Mapping[str, np.ndarray],
    reference: dict[str, np.ndarray] | None,
) -> np.ndarray:
    """Off the motion where the policy ran, else off the command. rad [T, J]"""
    if reference is not None and ran.any():
        return np.abs(pos[ran] - reference["joint_pos"][frame[ran]])
    return np.abs(pos - arrays["command"]) if "command" in arrays else np.zeros_like(pos)


def _torques(ax: Any, time: np.ndarray, arrays: Mapping[str, np.ndarray], description: Description) -> None:
    """What the servos were asked for, as shares of the effort limits."""
    ax.set_title("torque asked for / effort limit: largest, and its joints' 95 % quantile", fontsize=9)
    ax.axhline(1.0, color="tab:red", linewidth=0.8)
    if "stiffness" not in arrays:
        return
    pos, vel = arrays["sensors/joint_pos"], arrays["sensors/joint_vel"]
    torque = arrays["stiffness"] * (arrays["command"] - pos) - arrays["damping"] * vel
    share = np.abs(torque) / description.effort_limits
    ax.plot(time, share.max(1), linewidth=0.9)
    ax.plot(time, np.quantile(share, 0.95, axis=1), linewidth=0.9)
    ax.set_ylim(0, 1.15)


def _poses(
    ax: Any,
    time: np.ndarray,
    frame: np.ndarray,
    ran: np.ndarray,
    arrays: Mapping[str, np.ndarray],
    reference: dict[str, np.ndarray] | None,
) -> None:
    """Distance and angle of root and object from the motion."""
    ax.set_title("off the motion: position (m), orientation (rad, dashed)", fontsize=9)
    if reference is None or not ran.any():
        return
    for name, color in (("root", "tab:blue"), ("object", "tab:orange")):
        places, turns = arrays.get(f"sensors/{name}_pos_w"), arrays.get(f"sensors/{name}_quat_w")
        if places is not None and f"{name}_pos_w" in reference:
            off = np.linalg.norm(places[ran] - reference[f"{name}_pos_w"][frame[ran]], axis=-1)
            ax.plot(time[ran], off, color=color, label=name)
        if turns is not None and f"{name}_quat_w" in reference:
            angle = quat_angle(turns[ran].astype(float), reference[f"{name}_quat_w"][frame[ran]])
            ax.plot(time[ran], angle, "--", color=color, linewidth=0.8)
    if "sensors/object_joint_pos" in arrays and "object_joint_pos" in reference:
        off = np.abs(arrays["sensors/object_joint_pos"][ran] - reference["object_joint_pos"][frame[ran]])[:, 0]
        ax.plot(time[ran], off, ":", color="tab:green", label="object's joint (rad)")
    ax.set_ylim(bottom=0)
    ax.legend(fontsize=7, frameon=False)


def _timing(histogram: Any, ages: Any, time: np.ndarray, arrays: Mapping[str, np.ndarray]) -> None:
    """The runner's own time, lateness, and the age of what it was given."""
    ms, late = arrays["ms"], arrays["late"] * 1e3
    top = max(float(np.percentile(np.concatenate([ms, late]), 99.8)), 0.1)
    histogram.hist([ms.clip(max=top), late.clip(max=top)], bins=40, label=["the runner's work", "late"])
    histogram.set_yscale("log")
    histogram.set_title(f"ms per tick: mean {ms.mean():.2f}, 99 % {np.percentile(ms, 99):.2f}", fontsize=9)
    histogram.set_xlabel("ms", loc="right", labelpad=-2)
    histogram.legend(fontsize=7, frameon=False)
    ages.set_title("age of measurements (ms)", fontsize=9)
    for name in ("joint_pos", "root_quat_w", "root_pos_w", "object_pos_w"):
        if f"stamps/{name}" in arrays:
            ages.plot(time, (arrays["time"] - arrays[f"stamps/{name}"]) * 1e3, linewidth=0.9, label=name)
    ages.legend(fontsize=7, frameon=False)


def _shade(ax: Any, time: np.ndarray, states: list[str]) -> None:
    """The background says what the robot did."""
    first = 0
    for i in range(1, len(states) + 1):
        if i == len(states) or states[i] != states[first]:
            if (color := _SHADES.get(states[first], "white")) != "white":
                ax.axvspan(time[first], time[min(i, len(states) - 1)], color=color, linewidth=0, zorder=0)
            first = i
