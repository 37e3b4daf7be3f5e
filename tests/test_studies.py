"""Studies: what they are, the queue that trains them, their statistics, and the report."""

from __future__ import annotations

import csv
import json
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from mocks import lift_box, load_config
from omegaconf import OmegaConf

from hdmi.assembly import make_env, make_task
from hdmi.commands import study as command
from hdmi.config import ConfigError, task_config
from hdmi.envs.rendering import RenderingError
from hdmi.evaluation import EvalResult
from hdmi.evaluation.agents import BlindAgent
from hdmi.evaluation.protocol import evaluate_excused, evaluate_policy, evaluation_config
from hdmi.learning.checkpoint import checkpoints, save_checkpoint
from hdmi.learning.policy import make_networks
from hdmi.motion import find_motion, load_motion, save_motion
from hdmi.studies import Job, Study, Variant, measure, read_study, run_study, study_files, write_report
from hdmi.studies import run as queue
from hdmi.studies.measure import NONE, POINTS_FILE, is_measured, measure_run, read_points, task_terminations_config
from hdmi.studies.plan import Figure, subset
from hdmi.studies.probes import deepest_frame, first_second, poses_at
from hdmi.studies.rows import paired, read_rows_of, samples
from hdmi.studies.statistics import improvement, interquartile_mean, iqm, paired_difference

VARIANTS = {
    "full": Variant("full", "whole"),
    "no_rsi": Variant("no_rsi", arguments=("+ablation=no_rsi",)),
}


def small(**changes: Any) -> Study:
    """A study of two variants on two tasks."""
    fields = {"name": "small", "title": "A small one", "question": "Why?", "variants": VARIANTS}
    fields |= {"tasks": ("lift_box", "walk"), "seeds": 2, "total_frames": 8192, "points": 2, "num_envs": 4}
    return Study(**(fields | changes))


def result(success: float, error: float = 0.1, num_envs: int = 4) -> dict[str, Any]:
    """What an evaluation may have come to."""
    figures = {"success_rate": success, "survival": 0.5 + success / 2, "joint_error_horizon": error}
    return {key: {"mean": value, "std": 0.0} for key, value in figures.items()} | {"num_envs": num_envs, "task": "walk"}


def leave_run(runs: Path, job: Job, success: Sequence[float], num_envs: int = 4, extra: Sequence[str] = ()) -> Path:
    """A run folder as a finished training leaves it, with evaluations at even points of it."""
    run, total = runs / job.name, job.study.total_frames
    config = {"total_frames": total, "overrides": [*job.arguments, *extra, f"output_dir={run.parent}"]}
    state = {"frames": total, "elapsed": 90.0, "config": config}
    save_checkpoint(run / "checkpoints" / "checkpoint_000002.pt", state)
    points = {
        str(total * (i + 1) // len(success)): {
            NONE: result(0.8 * value, num_envs=num_envs),
            "lost_contact": result(value, num_envs=num_envs),
        }
        for i, value in enumerate(success)
    }
    (run / POINTS_FILE).write_text(json.dumps(points))
    return run


# -- statistics -----------------------------------------------------------------------------------------------


def test_the_interquartile_mean_leaves_out_a_quarter_at_both_ends():
    assert interquartile_mean([9.0, 1.0, 2.0, 0.0]) == pytest.approx(1.5)
    assert interquartile_mean([0.0, 3.0, 9.0]) == pytest.approx(4.0)  # too few to leave any out


def test_an_interval_holds_the_value_and_widens_with_the_spread_over_seeds():
    narrow = iqm([np.array([0.50, 0.51, 0.49]), np.array([0.80, 0.81, 0.79])])
    wide = iqm([np.array([0.30, 0.50, 0.70]), np.array([0.60, 0.80, 1.00])])
    assert narrow.value == pytest.approx(0.65, abs=0.01)
    assert narrow.low <= narrow.value <= narrow.high
    assert wide.high - wide.low > 3 * (narrow.high - narrow.low)
    assert narrow.n == 6


def test_resampling_draws_seeds_within_tasks_and_never_tasks():
    """With no spread over seeds there is no interval, however far tasks are apart."""
    found = iqm([np.full(3, 0.1), np.full(3, 0.9)])
    assert (found.low, found.high) == (found.value, found.value)


def test_one_seed_has_no_interval():
    found = iqm([np.array([0.4]), np.array([0.6])])
    assert found.value == pytest.approx(0.5)
    assert np.isnan(found.low)
    assert f"{found:.0%}" == "50%"
    assert f"{iqm([]):.0%}" == "-"


def test_probability_of_improvement_counts_pairs_of_runs_on_the_same_task():
    better = [np.array([0.9, 0.8]), np.array([0.1, 0.4])]
    than = [np.array([0.5, 0.1]), np.array([0.2, 0.4])]
    # 4 of 4 on the first task; on the second 0.1 loses twice, 0.4 wins and ties
    assert improvement(better, than).value == pytest.approx((1 + (0 + 1.5) / 4) / 2)


def test_paired_differences_are_of_the_same_task_and_seed():
    found = paired_difference([np.array([0.5, 0.9])], [np.array([0.4, 0.8])])
    assert (found.value, found.low, found.high) == pytest.approx((0.1, 0.1, 0.1))


# -- what a study is ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", study_files())
def test_studies_of_the_package_compose_on_every_task(name: str):
    study = read_study(name)
    assert study.seeds >= 3
    for job in subset(study, list(study.variants)).jobs:
        if job.seed == 0 and job.task in (study.tasks[0], study.tasks[-1]):
            assert job.config().task.name == job.task


def test_variants_of_one_name_have_the_same_arguments_in_all_studies():
    """Studies share run folders."""
    found: dict[str, set[tuple[str, ...]]] = {}
    for name in study_files():
        study = read_study(name)
        for variant in study.variants.values():
            if not name.startswith("perfect"):
                found.setdefault(variant.name, set()).add((*study.arguments, *variant.arguments))
    assert {name: len(arguments) for name, arguments in found.items() if len(arguments) > 1} == {}


def test_jobs_go_through_all_variants_before_the_next_seed():
    names = [job.name for job in small().jobs]
    assert names[:4] == ["lift_box/full_seed0", "lift_box/no_rsi_seed0", "walk/full_seed0", "walk/no_rsi_seed0"]
    assert names[4] == "lift_box/full_seed1"
    assert small().jobs[1].arguments == ["task=lift_box", "+ablation=no_rsi", "seed=0", "total_frames=8192"]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"tasks": ["fly"]}, "tasks: there is no fly; there is carry_bread_box"),
        ({"colour": "red"}, r"unknown \['colour'\]; there is"),
        ({"variants": {"full": {"argument": []}}}, r"variants\.full: unknown \['argument'\]"),
        ({"variants": {"full": {"arguments": "task=walk"}}}, r"variants\.full\.arguments: expected a list of texts"),
        (
            {"variants": {"full": {"reference": "none"}}},
            r"variants\.full\.reference: expected a variant that is trained",
        ),
        ({"variants": ["full"]}, "variants: expected fields by name"),
        ({"variants": {}}, "variants: none"),
        ({"seeds": 0}, "seeds: expected a whole number from 1 on, got 0"),
        ({"figures": [{"kind": "pie"}]}, r"figures\[0\]: kind: expected one of bars, .*, got 'pie'"),
        ({"figures": [{"kind": "bars", "without": ["root_pose"]}]}, r"figures\[0\]\.without: root_pose is not among"),
    ],
)
def test_a_mistake_in_a_study_is_named(tmp_path: Path, changes: dict[str, Any], said: str):
    path = tmp_path / "mine.yaml"
    fields = {"title": "T", "question": "Q", "tasks": ["walk"], "variants": {"full": {"label": "whole"}}}
    OmegaConf.save(OmegaConf.create(fields | changes), path)
    with pytest.raises(ConfigError, match=said) as error:
        read_study(str(path))
    assert str(path) in str(error.value)


def test_an_unknown_study_is_told_which_there_are():
    with pytest.raises(ConfigError, match=r"there is no 'residuals'; there is .*residual_action"):
        read_study("residuals")


def test_arguments_that_do_not_compose_are_named():
    study = small(variants={"odd": Variant("odd", arguments=("+ablation=nothing",))})
    with pytest.raises(ConfigError, match=r"study small: odd of lift_box: .*nothing"):
        study.jobs[0].config()


# -- the queue ------------------------------------------------------------------------------------------------


class Trainings:
    """Stands in for `hdmi train` and evaluations in processes of their own; notes what was asked."""

    def __init__(self, study: Study, runs: Path, status: int = 0):
        self.jobs = {runs / job.name: job for job in study.jobs}
        self.runs, self.status, self.calls, self.measured = runs, status, [], []

    def __call__(self, arguments: list[str], stdout: Any, **kwargs: Any) -> subprocess.CompletedProcess:
        options = [text for text in arguments[4:] if "=" in text]
        place = dict(text.split("=", 1) for text in options if text.startswith(("output_dir", "run_name", "resume")))
        run = Path(place["resume"]) if "resume" in place else Path(place["output_dir"]) / place["run_name"]
        self.calls.append((self.jobs[run].name, options))
        if self.status:
            stdout.write("ConfigError: no\n")
        else:
            leave_run(self.runs, self.jobs[run], [0.5, 1.0], extra=[t for t in options if t.startswith("motion_root")])
            (run / POINTS_FILE).unlink()
        return subprocess.CompletedProcess(arguments, self.status)

    def measure(self, run: Path, num_envs: int, num_threads: int) -> None:
        """As `measure_run`."""
        self.measured.append(self.jobs[run].name)
        leave_run(self.runs, self.jobs[run], [0.5, 1.0])


class Here:
    """An executor that works where it is asked."""

    def __init__(self, *args: Any, **kwargs: Any):
        pass

    def __enter__(self) -> Here:
        return self

    def __exit__(self, *args: object) -> None:
        pass

    def submit(self, function: Callable[..., Any], *args: Any) -> Here:
        function(*args)
        return self

    def result(self) -> None:
        """Nothing."""


@pytest.fixture
def trainings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Trainings]:
    """What trains a study, in place of processes."""

    def make(study: Study, status: int = 0) -> Trainings:
        there = Trainings(study, tmp_path / "runs", status)
        monkeypatch.setattr(subprocess, "run", there)
        monkeypatch.setattr(queue, "ProcessPoolExecutor", Here)
        monkeypatch.setattr(queue, "measure_run", there.measure)
        return there

    return make


def start(study: Study, folder: Path) -> tuple[dict[str, str], list[str]]:
    """Runs a study; what went wrong, and what was said."""
    said: list[str] = []
    return run_study(study, folder / "runs", folder / "out", jobs=1, say=said.append), said


def test_a_study_trains_and_evaluates_what_is_missing_and_repeats_nothing(
    trainings: Callable[..., Trainings], tmp_path: Path
):
    study = small(tasks=("walk",))
    there = trainings(study)
    leave_run(tmp_path / "runs", study.jobs[0], [0.5, 1.0])
    unmeasured = leave_run(tmp_path / "runs", study.jobs[1], [1.0])
    (unmeasured / POINTS_FILE).unlink()
    problems, said = start(study, tmp_path)
    assert problems == {}
    assert [name for name, _ in there.calls] == ["walk/full_seed1", "walk/no_rsi_seed1"]
    assert there.measured == ["walk/no_rsi_seed0", "walk/full_seed1", "walk/no_rsi_seed1"]
    assert "4/4 walk/no_rsi_seed1: done" in said
    options = there.calls[1][1]
    # 8192 frames are 2 iterations of 512 environments and 8 steps: a checkpoint of each is to be evaluated
    assert {"+ablation=no_rsi", "checkpoint_interval=1", "keep_checkpoints=3", "seed=1", "video=false"} <= set(options)
    start(study, tmp_path)
    assert len(there.calls) == 2


def test_a_training_that_was_interrupted_continues(trainings: Callable[..., Trainings], tmp_path: Path):
    study = small(tasks=("walk",), seeds=1, variants={"full": VARIANTS["full"]})
    there = trainings(study)
    run = tmp_path / "runs" / study.jobs[0].name
    config = {"total_frames": 8192, "overrides": study.jobs[0].arguments}
    save_checkpoint(run / "checkpoints" / "checkpoint_000001.pt", {"frames": 4096, "config": config})
    start(study, tmp_path)
    assert f"resume={run}" in there.calls[0][1]


def test_more_episodes_are_evaluated_anew(trainings: Callable[..., Trainings], tmp_path: Path):
    study = small(tasks=("walk",), seeds=1, num_envs=8)
    there = trainings(study)
    for job in study.jobs:
        leave_run(tmp_path / "runs", job, [1.0], num_envs=4)
    start(study, tmp_path)
    assert there.calls == []
    assert len(there.measured) == 2


def test_a_folder_with_another_training_is_refused_before_anything_begins(
    trainings: Callable[..., Trainings], tmp_path: Path
):
    study = small(tasks=("walk",))
    there = trainings(study)
    leave_run(tmp_path / "runs", study.jobs[-1], [1.0], extra=["algo.clip=0.1"])
    with pytest.raises(ConfigError, match=r"walk/no_rsi_seed1: holds a training of other arguments \(algo.clip=0.1\)"):
        start(study, tmp_path)
    assert there.calls == []


def test_a_training_that_fails_is_named_and_the_others_go_on(trainings: Callable[..., Trainings], tmp_path: Path):
    study = small(tasks=("walk",), seeds=1)
    trainings(study, status=2)
    problems, said = start(study, tmp_path)
    assert set(problems) == {"walk/full_seed0", "walk/no_rsi_seed0"}
    assert problems["walk/full_seed0"].endswith("ConfigError: no")
    assert any(line.startswith("1/2 walk/full_seed0: hdmi train ended with status 2") for line in said)


def test_a_recorded_variant_is_trained_on_what_the_best_run_of_its_source_did(
    trainings: Callable[..., Trainings], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    variants = {"full": VARIANTS["full"], "perfect": Variant("perfect", reference="full")}
    study = small(tasks=("walk",), variants=variants)
    there = trainings(study)
    for job, success in zip(study.jobs[::2], ([0.2], [0.7]), strict=True):
        leave_run(tmp_path / "runs", job, success)
    recorded = []
    monkeypatch.setattr(queue, "load_policy", lambda run: (run, task_config("walk"), {}))
    monkeypatch.setattr(queue, "record_motion", lambda policy, cfg, name, points: recorded.append((policy, name)))

    def save(motion: None, folder: Path) -> None:
        folder.mkdir(parents=True)
        (folder / "motion.npz").touch()

    monkeypatch.setattr(queue, "save_motion", save)
    problems, _ = start(study, tmp_path)
    assert problems == {}
    assert recorded == [(tmp_path / "runs" / "walk" / "full_seed1", "walk")]
    root = tmp_path / "out" / "motions" / "walk_full"
    assert (root / "walk" / "motion.npz").is_file()
    assert [f"motion_root={root}" in options for _, options in there.calls] == [True, True]
    start(study, tmp_path)
    assert len(recorded) == 1


def test_what_cannot_be_recorded_is_a_problem_of_its_variants_alone(
    trainings: Callable[..., Trainings], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    variants = {"full": VARIANTS["full"], "perfect": Variant("perfect", reference="full")}
    study = small(tasks=("walk",), seeds=1, variants=variants)
    trainings(study)

    def refuse(*_: Any, **__: Any) -> None:
        raise ConfigError("root_pose ended it at frame 8")

    monkeypatch.setattr(queue, "load_policy", lambda run: (run, task_config("walk"), {}))
    monkeypatch.setattr(queue, "record_motion", refuse)
    problems, _ = start(study, tmp_path)
    assert problems == {"walk/perfect_seed0": "no recorded motion: root_pose ended it at frame 8"}


# -- evaluations ----------------------------------------------------------------------------------------------


@pytest.fixture
def brief(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Argument of a config that has the first 40 frames of lift_box, and no start tables, which take seconds."""
    monkeypatch.setattr("hdmi.assembly.start_tables", lambda *_: None)
    whole = load_motion(find_motion("lift_box"))
    cut = {key: value[:40] for key, value in vars(whole).items() if isinstance(value, np.ndarray)}
    save_motion(replace(whole, **cut), tmp_path / "brief" / "lift_box")
    return f"motion_root={tmp_path / 'brief'}"


def test_one_run_through_the_motion_judges_every_set_of_terminations(brief: str):
    """As if each had been evaluated by itself."""
    strict = ["termination.object_pose.thresholds=[0,9]", "termination.object_pose.min_steps=5"]
    cfg = load_config("task=lift_box", brief, *strict, "num_threads=1")
    agent, task = BlindAgent("zero", 23), make_task(cfg)
    left_out = {"none": (), "box": ("object_pose",), "absent": ("torso_height",)}
    found = evaluate_excused(agent, cfg, 3, left_out, task)
    assert dict(found["box"]) == dict(evaluate_policy(agent, cfg, 3, task, without=["object_pose"]))
    assert found["none"]["failure_frames"]["object_pose"] == 5
    assert found["box"]["success_rate"]["mean"] == 1.0
    assert dict(found["absent"]) == dict(found["none"])
    assert "object_pose" not in found["box"]["terminations"]


def test_a_study_evaluates_under_the_terminations_of_the_task():
    cfg = load_config("task=walk", "+preset=laptop", "+ablation=no_residual_no_body_termination")
    assert cfg.termination.body_local_pose is None
    judged = task_terminations_config(cfg)
    assert judged.termination.body_local_pose.thresholds == [0.5, 1.2]
    assert evaluation_config(judged).termination.root_pose.min_steps == 25
    assert cfg.termination.root_pose.min_steps == 3


def untrained(folder: Path, frames: Sequence[int], motion: str) -> Path:
    """A run of lift_box whose checkpoints have weights that are drawn at random."""
    small_nets = ["algo.actor_hidden=[8]", "algo.critic_hidden=[8]", "num_threads=1"]
    cfg = load_config("task=lift_box", motion, *small_nets)
    env = make_env(evaluation_config(cfg), 1, make_task(cfg))
    sizes = {key: env.full_observation_spec[key].shape[-1] for key in ("policy", "critic")}
    sizes["action"] = env.action_spec.shape[-1]
    actor, _ = make_networks(cfg, sizes, torch.device("cpu"))
    for i, count in enumerate(frames):
        state = {
            "iteration": i, "frames": count, "elapsed": 60.0, "sizes": sizes, "task": "lift_box",
            "actor": actor.state_dict(), "config": OmegaConf.to_container(cfg, resolve=True),
        }  # fmt: skip
        save_checkpoint(folder / "checkpoints" / f"checkpoint_{i:06d}.pt", state)
    return folder


def test_a_run_is_measured_once_and_keeps_its_last_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, brief: str
):
    def evaluate(actor: Any, cfg: Any, num_envs: int, excused: Any, task: Any, seed: int) -> dict[str, EvalResult]:
        assert cfg.num_threads == 1
        assert excused["lost_contact"] == ("lost_contact",)
        return {name: EvalResult(result(0.5, num_envs=num_envs)) for name in excused}

    monkeypatch.setattr(measure, "evaluate_excused", evaluate)
    run = untrained(tmp_path / "run", [100, 200], brief)
    measure_run(run, num_envs=2, num_threads=1)
    points = read_points(run)
    assert sorted(points) == [100, 200]
    assert set(points[100]) == {NONE, "root_pose", "body_local_pose", "object_pose", "lost_contact"}
    assert points[100][NONE]["num_envs"] == 2
    assert len(checkpoints(run / "checkpoints")) == 1
    assert is_measured(run, 2)
    assert not is_measured(run, 3)
    before = (run / POINTS_FILE).stat().st_mtime_ns
    measure_run(run, num_envs=2, num_threads=1)
    assert (run / POINTS_FILE).stat().st_mtime_ns == before


def test_a_damaged_file_of_evaluations_is_named(tmp_path: Path):
    (tmp_path / POINTS_FILE).write_text('{"100": ')
    with pytest.raises(ConfigError, match=r"points\.json: damaged"):
        read_points(tmp_path)


# -- probes ---------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("gl")
def test_poses_compare_the_robot_with_the_reference_at_its_lowest_frame(tmp_path: Path, brief: str):
    run = untrained(tmp_path / "run", [100], brief)
    frame = deepest_frame(lift_box())
    heights = lift_box().reference.body_pos[:, 0, 2]
    assert heights[frame] == heights.min()
    poses = poses_at(run, frame=10)
    assert poses.reference_root == pytest.approx(float(heights[10]), abs=1e-5)  # of that frame, not of the last one
    assert poses.frame == 10
    assert poses.picture.shape == (480, 640, 3)
    assert 0.2 < poses.reference < 0.4  # of a standing G1's knees
    assert poses.height == pytest.approx(poses.reference, abs=0.05)
    assert poses.root == pytest.approx(poses.reference_root, abs=0.05)
    with pytest.raises(ConfigError, match="the robot has none that 'fin' matches; it has pelvis"):
        poses_at(run, bodies="fin")


def test_from_the_default_pose_an_untrained_policy_pops_up_where_the_reference_is_low(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr("hdmi.assembly.start_tables", lambda *_: None)
    few = ["task=move_suitcase", "+preset=laptop", "num_threads=1", "algo.actor_hidden=[8]", "algo.critic_hidden=[8]"]
    residual = ["reference.target=null", "action.target.base_key=[ref,joint_pos]"]
    cfgs = [load_config(*few, *more) for more in (residual, ["reference.target=null", "+ablation=no_residual"])]
    follows, pops = (first_second(cfg, num_envs=4) for cfg in cfgs)
    assert follows.height.shape == (51, 4)
    assert follows.height[0] == pytest.approx(follows.reference[0], abs=0.03)
    assert np.abs(follows.height - follows.reference[:, None]).max() < 0.1
    assert pops.acceleration.mean() > 10 > abs(follows.acceleration.mean())
    assert follows.alive[-1].mean() > pops.alive[-1].mean()


# -- the report -----------------------------------------------------------------------------------------------


def finished(folder: Path, **changes: Any) -> Study:
    """A study all of whose runs are there; the first variant is better."""
    study = small(without=("lost_contact", "none"), **changes)
    for job in study.jobs:
        good = 0.9 if job.variant.name == "full" else 0.4
        leave_run(folder, job, [good / 2, good + 0.05 * job.seed])
    return study


def test_rows_have_a_line_for_each_run_and_each_evaluation(tmp_path: Path):
    figures = (Figure("bars"), Figure("curves", tasks=("walk",)), Figure("summary", "joint_error_horizon"))
    study = finished(tmp_path / "runs", figures=figures)
    path = write_report(study, tmp_path / "runs", tmp_path / "out")
    runs = list(csv.DictReader((tmp_path / "out" / "runs.csv").open()))
    assert len(runs) == 8
    assert runs[0]["variant"] == "full"
    assert (runs[0]["success_rate"], runs[0]["success_rate/without_lost_contact"]) == ("0.72", "0.9")
    assert runs[0]["command"].startswith("hdmi train task=lift_box seed=0 total_frames=8192")
    assert str(tmp_path) not in runs[0]["command"]
    curves = list(csv.DictReader((tmp_path / "out" / "curves.csv").open()))
    assert [row["frames"] for row in curves[:2]] == ["4096", "8192"]
    text = path.read_text()
    assert str(tmp_path) not in text
    # 0.4, 0.45 on both tasks against 0.9, 0.95
    assert "| no rsi | 4 | 42.5% [40.0%, 45.0%] | -50.0% [-50.0%, -50.0%] | 100.0% [100.0%, 100.0%] |" in text
    assert "n = 2 seeds each" in text
    for kind in ("figure_1_bars", "figure_2_curves", "figure_3_summary"):
        assert f"]({kind}.png)" in text
        assert (tmp_path / "out" / f"{kind}.pdf").stat().st_size > 1000


def test_a_report_of_what_is_there_says_how_much_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(*_: Any, **__: Any) -> None:
        raise RenderingError("no OpenGL")

    monkeypatch.setattr("hdmi.studies.document.poses_at", refuse)
    study = small(without=("none",), figures=(Figure("bars"), Figure("poses")))
    leave_run(tmp_path / "runs", study.jobs[0], [0.0])
    said: list[str] = []
    text = write_report(study, tmp_path / "runs", tmp_path / "out", said.append).read_text()
    assert "1 of 8 trainings are there" in text
    assert "n = 0 to 1 seeds each" in text
    assert "too few to tell variants apart" in text
    assert said == ["no pictures: no OpenGL", "figure 2, poses: no OpenGL"]
    assert "Figure 2 (poses) could not be drawn: no OpenGL" in text


def test_rows_of_an_earlier_report_stay_and_are_not_trained_again(trainings: Callable[..., Trainings], tmp_path: Path):
    study = finished(tmp_path / "elsewhere", tasks=("walk",))
    before = write_report(study, tmp_path / "elsewhere", tmp_path / "out").read_text()
    there = trainings(study)
    problems, _ = start(study, tmp_path)
    assert (problems, there.calls) == ({}, [])
    assert write_report(study, tmp_path / "runs", tmp_path / "out").read_text() == before
    longer = replace(study, total_frames=16384)
    assert read_rows_of(longer, tmp_path / "runs", tmp_path / "out") == []
    with (tmp_path / "out" / "curves.csv").open("a") as file:
        file.write("full,walk,0,12")  # written in part
    assert len(read_rows_of(study, tmp_path / "runs", tmp_path / "out")) == 4
    (tmp_path / "out" / "curves.csv").write_text("variant,task,seed\nfull,walk,0\n")
    with pytest.raises(ConfigError, match=r"out: runs\.csv or curves\.csv is damaged \(KeyError\('frames'\)\)"):
        read_rows_of(study, tmp_path / "runs", tmp_path / "out")


def test_pairs_are_of_the_seeds_that_both_have(tmp_path: Path):
    study = small(tasks=("walk",), seeds=3, without=("lost_contact",))
    for job, success in zip(study.jobs, (0.1, 0.2, 0.3, None, 0.5, 0.6), strict=True):
        if success is not None:
            leave_run(tmp_path, job, [success])
    rows = read_rows_of(study, tmp_path)
    assert [list(s) for s in samples(rows, "full", ["walk"], "success_rate", "lost_contact")] == [[0.1, 0.3, 0.5]]
    own, other = paired(rows, "no_rsi", "full", ["walk"], "success_rate", "lost_contact")
    assert (list(own[0]), list(other[0])) == ([0.2, 0.6], [0.1, 0.5])


# -- the command ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["study=fly"], "study: there is no 'fly'; there is interaction_reward"),
        (["study=residual_action", "tasks=[fly]"], "tasks: there is no fly"),
        (["study=residual_action", "variants=[half]"], "variants: residual_action has no half; there is"),
        (["tasks=[walk]"], "give study=NAME; there is interaction_reward"),
        (["plot", "study=residual_action"], "there is no command 'plot'; there is list, report"),
        (["study=residual_action", "jobs=0"], "jobs: expected at least 1, got 0"),
    ],
)
def test_mistakes_are_one_line(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]):
    assert command.main(arguments) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_studies_and_their_trainings_are_listed(capsys: pytest.CaptureFixture[str]):
    assert command.main([]) == 0
    assert "residual_action" in capsys.readouterr().out
    assert command.main(["list", "study=interaction_reward", "tasks=[walk]", "seeds=1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    assert "run_name=no_interaction_reward_seed0" in lines[1]
    assert "+ablation=no_interaction_reward" in lines[1]


@pytest.mark.slow
@pytest.mark.usefixtures("gl")
def test_a_study_from_trainings_to_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "tiny.yaml"
    few = ["num_envs=8", "algo.minibatches=2", "algo.actor_hidden=[8]", "algo.critic_hidden=[8]"]
    fields = {
        "title": "Tiny", "question": "Does it run?", "tasks": ["lift_box"], "seeds": 1, "total_frames": 128,
        "points": 2, "num_envs": 2, "without": ["lost_contact", "none"], "arguments": few,
        "variants": {"full": {}, "no_residual": {"arguments": ["+ablation=no_residual"]}},
        "figures": [{"kind": kind} for kind in ("bars", "summary", "curves", "poses", "starts")],
    }  # fmt: skip
    OmegaConf.save(OmegaConf.create(fields), path)
    call = [f"study={path}", f"runs={tmp_path / 'runs'}", f"out={tmp_path / 'out'}"]
    assert command.main(call) == 0
    text = (tmp_path / "out" / "report.md").read_text()
    assert "2 of 2 trainings are there" in text
    assert "could not be drawn" not in text
    assert {path.suffix for path in (tmp_path / "out").glob("figure_*")} == {".png", ".pdf"}
    capsys.readouterr()
    assert command.main(call) == 0
    assert "begins" not in capsys.readouterr().out
