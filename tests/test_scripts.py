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
