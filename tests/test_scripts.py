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


def test_lift_box_reference_is_what_its_script_makes(tmp_path: Path) -> None:
    import numpy as np

    from hdmi.motion import load_motion

    command = [sys.executable, str(ROOT / "scripts" / "make_lift_box.py"), "--out", str(tmp_path / "lift_box")]
    result = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=200)
    assert result.returncode == 0, result.stderr
    made, shipped = load_motion(tmp_path / "lift_box"), load_motion(ROOT / "hdmi/motion/references/lift_box")
    assert made.body_names == shipped.body_names
    np.testing.assert_allclose(made.joint_pos, shipped.joint_pos, atol=1e-3)
    np.testing.assert_array_equal(made.object_contact, shipped.object_contact)


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
