"""Scripts as a user runs them, on tiny budgets."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from test_training import TINY

from hdmi.commands.script import run_script

ROOT = Path(__file__).parents[1]


def test_benchmark_ends_with_its_figures_as_json(tmp_path: Path) -> None:
    options = ["num_envs=4", "algo.frames_per_env=4", "algo.bf16=false", "num_threads=1", "logger=csv"]
    others = ["compare.mujoco_env_workers=1", "compare.steps=5", "compare.mjlab=/nonexistent/python", "out=grid.jsonl"]
    command = [sys.executable, str(ROOT / "scripts" / "benchmark.py"), *options, *others]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=200)
    assert result.returncode == 0, result.stderr
    figures = json.loads(result.stdout.strip().splitlines()[-1])
    assert {"raw_physics_sps", "env_sps", "env_ratio", "train_sps", "train_ratio"} <= set(figures)
    assert figures["task"] == "lift_box"
    assert 0 < figures["train_sps"] < figures["raw_physics_sps"]
    assert 0 < figures["env_ratio"] < 1
    assert figures["mujoco_env_sps"] > 0
    assert "mjlab_tracking_sps" not in figures
    assert "/nonexistent/python" in result.stderr
    assert "tracking.bodies" in result.stdout
    assert "transforms, resets and reading" in result.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["grid.jsonl"]
    assert json.loads((tmp_path / "grid.jsonl").read_text()) == figures


@pytest.mark.slow
def test_benchmark_of_workers_that_collect_during_updates(tmp_path: Path) -> None:
    options = ["num_envs=4", "algo.frames_per_env=4", "num_threads=1", "logger=csv", "compare.steps=0"]
    workers = ["collector=process", "collector.num_workers=2", "collector.threads_per_worker=1"]
    command = [sys.executable, str(ROOT / "scripts" / "benchmark.py"), *options, *workers]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=200)
    assert result.returncode == 0, result.stderr
    figures = json.loads(result.stdout.strip().splitlines()[-1])
    assert figures["num_envs"] == 4  # not the two of a worker
    assert 0 < figures["env_ratio"] < 1
    assert figures["train_ratio"] > 0
    assert "mujoco_env_sps" not in figures
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_sweep_runs_as_jobs(tmp_path: Path) -> None:
    pytest.importorskip("submitit")
    sweep = ["-m", "hydra/launcher=submitit_local", "+ablation=full,no_rsi", "seed=3"]
    folders = [f"hydra.sweep.dir={tmp_path / 'sweep'}", f"output_dir={tmp_path / 'runs'}"]
    command = [sys.executable, str(ROOT / "train.py"), *sweep, *TINY, *folders]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=200)
    assert result.returncode == 0, result.stderr
    runs = {folder.name.split("_", 2)[2]: folder for folder in (tmp_path / "runs").iterdir()}
    assert set(runs) == {"full_seed3", "no_rsi_seed3"}
    for folder in runs.values():
        assert "success_rate" in json.loads((folder / "eval.json").read_text())
    starts = {name: OmegaConf.load(folder / "config.yaml").reset.state.start for name, folder in runs.items()}
    assert starts == {"full_seed3": "uniform", "no_rsi_seed3": "first"}
    called = OmegaConf.load(runs["no_rsi_seed3"] / "config.yaml").overrides
    assert {"+ablation=no_rsi", "seed=3", *TINY} <= set(called)
    assert len(list((tmp_path / "sweep" / ".submitit").glob("*/*_0_result.pkl"))) == 2


def test_a_variable_that_a_config_names_and_nobody_set_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    cfg = OmegaConf.create({"motion_root": "${oc.env:NOWHERE}"})
    assert run_script(lambda arguments, console: cfg.motion_root, [], None) == 2
    said = capsys.readouterr().err
    assert said.startswith("ConfigError: ")
    assert said.count("\n") == 1
    assert "'NOWHERE' not found" in said
    assert "motion_root" in said


def test_slurm_launcher_is_submitit_s() -> None:
    pytest.importorskip("submitit")
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        cfg = compose("config", overrides=["hydra/launcher=slurm"], return_hydra_config=True)
    assert cfg.hydra.launcher._target_.endswith(".SlurmLauncher")
    assert cfg.hydra.launcher.cpus_per_task == 16


@pytest.mark.slow
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
    from hdmi.assembly import make_env
    from hdmi.transforms import AdaptiveStateInitialization

    # every step terminates
    strict = ["termination.root_pose.thresholds=[-1.0,-1.0]", "termination.root_pose.min_steps=1"]
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        cfg = compose("config", overrides=["reset=adaptive", "num_envs=2", "num_threads=1", *strict])
    env = make_env(cfg)
    env.rollout(3, break_when_any_done=False)
    adaptive = next(t for t in env.transform.transforms if isinstance(t, AdaptiveStateInitialization))
    # two worlds; the last step's episodes are counted when they are reset
    assert 3.9 < float(adaptive.failures.sum()) <= 4.0


@pytest.mark.slow
def test_gpu_report_keeps_what_could_not_be_measured(tmp_path: Path) -> None:
    options = ["engines=[cpu,tpu]", "worlds=[2]", f"out={tmp_path / 'report.jsonl'}"]
    tiny = "overrides=[algo.frames_per_env=4,algo.bf16=false,num_threads=1,logger=csv,nonsense]"
    command = [sys.executable, str(ROOT / "scripts" / "gpu_report.py"), *options, tiny]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=200)
    assert result.returncode == 0, result.stderr
    rows = [json.loads(line) for line in (tmp_path / "report.jsonl").read_text().splitlines()]
    assert [(row["sim"], row["num_envs"]) for row in rows] == [("cpu", 2), ("tpu", 2)]
    assert all(row["error"] for row in rows)
    assert "env steps/s" in result.stdout
