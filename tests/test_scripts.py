"""Scripts as a user runs them, on tiny budgets."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_benchmark_ends_with_its_figures_as_json(tmp_path: Path) -> None:
    options = ["num_envs=4", "algo.frames_per_env=4", "algo.bf16=false", "num_threads=1", "logger=csv"]
    command = [sys.executable, str(ROOT / "scripts" / "benchmark.py"), *options]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=200)
    assert result.returncode == 0, result.stderr
    figures = json.loads(result.stdout.strip().splitlines()[-1])
    assert {"raw_physics_sps", "env_sps", "env_ratio", "train_sps", "train_ratio"} <= set(figures)
    assert figures["task"] == "lift_box"
    assert 0 < figures["train_sps"] < figures["raw_physics_sps"]
    assert 0 < figures["env_ratio"] < 1
    assert "tracking.bodies" in result.stdout
    assert list(tmp_path.iterdir()) == []


def test_author_writes_a_motion_that_its_task_takes(tmp_path: Path) -> None:
    from hdmi.motion import load_motion

    plan = tmp_path / "hold.yaml"
    plan.write_text(
        "duration: 0.3\ncorrections: 0\nobject: {path: [{at: 0, pos: [0.35, 0, 0.78]}]}\n"
        "scenery: {stand: {pos: [0.35, 0, 0.34]}}\n"
    )
    command = [sys.executable, str(ROOT / "scripts" / "author.py"), "task=lift_box", f"plan={plan}", f"out={tmp_path}"]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=200)
    assert result.returncode == 0, result.stderr
    assert "15 frames" in result.stdout
    motion = load_motion(tmp_path / "hold")
    assert motion.body_names == ("pelvis", "box", "stand")
    assert motion.object_contact is not None
    assert motion.object_contact.shape == (15, 2)
    plan.write_text("duration: 0.3\nhands: {left: [{at: soon}]}\n")
    refused = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=200)
    assert refused.returncode == 2
    assert f"{plan}: hands.left[0].at: no phase 'soon'" in refused.stderr


def test_adaptive_starts_count_the_terminations_of_the_whole_stack() -> None:
    from hydra import compose, initialize_config_dir

    from hdmi.build import make_env
    from hdmi.transforms import AdaptiveStateInitialization

    # every step terminates
    strict = ["termination.root_pose.thresholds=[-1.0,-1.0]", "termination.root_pose.min_steps=1"]
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        cfg = compose("config", overrides=["reset=adaptive", "num_envs=2", "num_threads=1", *strict])
    env = make_env(cfg)
    env.rollout(3, break_when_any_done=False)
    adaptive = next(t for t in env.transform.transforms if isinstance(t, AdaptiveStateInitialization))
    assert 5.9 < float(adaptive.failures.sum()) <= 6.0
