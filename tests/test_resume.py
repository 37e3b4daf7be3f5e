"""Continuing a run by the command: under its own config, in its own folder, in its own worlds; and its W&B run."""

from __future__ import annotations

import copy
import csv
import os
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
import pytest
import torch
import wandb
from mocks import CONF
from omegaconf import DictConfig, OmegaConf
from test_training import TINY, config

from hdmi.commands import train as cli
from hdmi.evaluation import EvalResult
from hdmi.learning import CheckpointError, Trainer, load_checkpoint, save_checkpoint
from hdmi.learning.checkpoint import checkpoints
from hdmi.learning.logger import RunLogger
from hdmi.learning.resume import differences, find_run, problem_changes
from hdmi.motion import find_motion

# worlds are reset often: what is drawn for them would show
SHORT = [*TINY, "task.episode_steps=5", "total_frames=96"]


def command(body: Callable[[DictConfig], Any], *arguments: str) -> list[Any]:
    """What `python train.py ARGUMENTS` does, with `body` for its main function; returns what that returned."""
    results: list[Any] = []

    @hydra.main(config_path=str(CONF), config_name="config", version_base="1.3")
    def run(cfg: DictConfig) -> None:
        results.append(body(cfg))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["train.py", *arguments])
        run()
    return results


def train(*arguments: str) -> None:
    """Without evaluation and video."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "finish", lambda *_: None)
        command(cli.train, *arguments)


def interrupted(iterations: int, *arguments: str, number: signal.Signals = signal.SIGINT) -> None:
    """With a signal, a Ctrl-C, in the middle of the last of these iterations."""
    update = Trainer.update

    def stop(self: Trainer, batch: Any) -> dict[str, float]:
        if self.iteration == iterations - 1:
            assert callable(signal.getsignal(number)), f"{number.name} would end the tests"
            os.kill(os.getpid(), number)
        return update(self, batch)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Trainer, "update", stop)
        with pytest.raises(SystemExit) as end:
            train(*arguments)
    assert end.value.code == 130


def assert_same_weights(a: dict[str, Any], b: dict[str, Any]) -> None:
    for part in ("training_actor", "actor", "critic"):
        for name, value in a[part].items():
            torch.testing.assert_close(b[part][name], value, rtol=0, atol=0, msg=f"{part} {name}")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder of three iterations, all of whose checkpoints are kept."""
    root = tmp_path_factory.mktemp("runs")
    train(*SHORT, "seed=3", "checkpoint_interval=1", "keep_checkpoints=5", f"output_dir={root}", "run_name=run")
    return root / "run"


@pytest.fixture
def held(tmp_path: Path) -> Callable[..., Path]:
    """Makes a run folder that holds a config and nothing to train on."""

    def make(change: Callable[[dict], None] = lambda values: None, *overrides: str) -> Path:
        values: Any = OmegaConf.to_container(config(*overrides), resolve=True)
        values["overrides"] = [*TINY, *overrides]
        change(values)
        folder = tmp_path / "runs" / "held"
        state = {"config": values, "iteration": 2, "critic": {}}
        save_checkpoint(folder / "checkpoints" / "checkpoint_000002.pt", state)
        OmegaConf.save(OmegaConf.create(values), folder / "config.yaml")
        return folder

    return make


class TestContinuation:
    @pytest.mark.parametrize(
        "overrides",
        [
            pytest.param(["seed=3"], marks=pytest.mark.slow),
            pytest.param(["seed=1", "+ablation=no_randomization"], marks=pytest.mark.slow),
            pytest.param(["seed=2", "+ablation=no_interaction_reward_no_contact_termination"], marks=pytest.mark.slow),
            ["reset=adaptive", "+lever=[springs,springs_object,rewind,noise_curriculum]", "seed=5"],
        ],
        ids=lambda overrides: overrides[-1],
    )
    def test_by_the_bare_command_equals_the_run_that_was_never_stopped(
        self, overrides: list[str], tmp_path: Path
    ) -> None:
        out = [f"output_dir={tmp_path}", *overrides]
        train(*SHORT, *out, "run_name=straight")
        interrupted(1, *SHORT, *out, "run_name=stopped")
        assert load_checkpoint(tmp_path / "stopped")["iteration"] == 1
        train(f"resume={tmp_path / 'stopped'}")
        straight, stopped = (load_checkpoint(tmp_path / name) for name in ("straight", "stopped"))
        assert stopped["iteration"] == 3
        assert_same_weights(straight, stopped)
        assert set(differences(straight["config"], stopped["config"])) == {"run_name"}
        assert stopped["config"]["overrides"] == [*SHORT, *out, "run_name=stopped"]  # as they were typed
        kept = OmegaConf.load(tmp_path / "stopped" / "config.yaml")
        assert kept.resume is None
        assert kept.seed == straight["config"]["seed"]

    def test_a_termination_leaves_a_checkpoint_too(self, tmp_path: Path) -> None:
        usual = signal.signal(signal.SIGTERM, signal.SIG_DFL)  # libraries of other tests put handlers of their own
        try:
            interrupted(1, *SHORT, f"output_dir={tmp_path}", "run_name=run", number=signal.SIGTERM)
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
        finally:
            signal.signal(signal.SIGTERM, usual)
        assert load_checkpoint(tmp_path / "run")["iteration"] == 1

    def test_worlds_are_the_checkpoints_under_any_seed(self, run: Path) -> None:
        """Even where the seed is changed behind the command's back."""
        rows = []
        for seed in (3, 8):
            cfg = OmegaConf.create(load_checkpoint(run)["config"])
            cfg.seed, cfg.resume = seed, str(run)
            trainer = Trainer(cfg, run)
            trainer.env.reset()
            rows.append(robot_masses(trainer))
            trainer.collector.shutdown()
        torch.testing.assert_close(rows[0], rows[1], rtol=0, atol=0)
        assert len(rows[0].unique(dim=0)) == 4

    @pytest.mark.slow
    def test_from_an_older_checkpoint_leaves_one_history(self, run: Path, tmp_path: Path) -> None:
        folder = tmp_path / "run"
        shutil.copytree(run, folder)
        newest = load_checkpoint(folder)
        train(f"resume={folder / 'checkpoints' / 'checkpoint_000001.pt'}", "total_frames=64")
        assert [path.name for path in checkpoints(folder / "checkpoints")] == [
            "checkpoint_000001.pt",
            "checkpoint_000002.pt",
        ]
        assert {path.name for path in (folder / "checkpoints" / "superseded").iterdir()} == {
            "checkpoint_000002.pt",
            "checkpoint_000003.pt",
        }
        assert [row["iteration"] for row in csv.DictReader((folder / "metrics.csv").open())] == ["1", "2"]
        assert find_run(folder)[1].name == "checkpoint_000002.pt"
        train(f"resume={folder}", "total_frames=96")
        assert_same_weights(newest, load_checkpoint(folder))

    def test_the_folder_of_motions_stays_as_it_was_typed(
        self, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("HERE", str(find_motion("lift_box").parent))
        cfg = OmegaConf.create(load_checkpoint(run)["config"])
        cfg.resume, cfg.motion_root = str(run), "${oc.env:HERE}"
        trainer = Trainer(cfg, tmp_path)
        trainer.save()
        trainer.collector.shutdown()
        assert load_checkpoint(tmp_path)["config"]["motion_root"] == "${oc.env:HERE}"

    def test_another_problem_continues_the_networks_if_told_to(self, run: Path, tmp_path: Path) -> None:
        cfg = OmegaConf.create(load_checkpoint(run)["config"])
        cfg.reward.interaction = cfg.termination.lost_contact = None
        cfg.resume = str(run)
        with pytest.raises(CheckpointError, match=r"resume: .*termination\.lost_contact.*resume_anyway=true"):
            Trainer(cfg, tmp_path)
        cfg.resume_anyway, cfg.total_frames = True, 128
        trainer = Trainer(cfg, tmp_path)
        assert trainer.iteration == 3
        for name, value in load_checkpoint(run)["training_actor"].items():
            torch.testing.assert_close(trainer.actor.state_dict()[name], value, rtol=0, atol=0)
        trainer.run()
        assert load_checkpoint(tmp_path)["config"]["resume_anyway"] is False

    def test_learning_rates_are_the_adapted_ones_unless_others_are_asked_for(self, run: Path, tmp_path: Path) -> None:
        state = load_checkpoint(run)
        state["actor_optim"]["param_groups"][0]["lr"] = 3e-5
        path = tmp_path / "checkpoints" / "checkpoint_000003.pt"
        save_checkpoint(path, state)
        cfg = OmegaConf.create(state["config"])
        cfg.resume, cfg.algo.critic_lr = str(path), 7e-5
        trainer = Trainer(cfg, tmp_path)
        trainer.collector.shutdown()
        assert trainer.actor_optim.param_groups[0]["lr"] == 3e-5
        assert trainer.critic_optim.param_groups[0]["lr"] == 7e-5

    def test_another_motion_of_the_same_name_is_refused(self, run: Path, tmp_path: Path) -> None:
        state = load_checkpoint(run)
        state["motion"] = "0" * 64
        path = tmp_path / "checkpoints" / "checkpoint_000003.pt"
        save_checkpoint(path, state)
        cfg = OmegaConf.create(state["config"])
        cfg.resume = str(path)
        with pytest.raises(CheckpointError, match=r"the motion 'lift_box' is not the one of the run.*motion_root"):
            Trainer(cfg, tmp_path)


def robot_masses(trainer: Trainer) -> torch.Tensor:
    """Drawn once per world. [N, bodies]"""
    return trainer.env.base_env.backend.model("body_mass")[:, list(trainer.task.scene.body_ids)].clone()


class TestConfig:
    def open(self, *arguments: str) -> tuple[DictConfig, Path, list[str]]:
        return command(cli.open_run, *arguments)[0]

    def test_is_the_runs_and_not_the_defaults(self, held: Callable[..., Path]) -> None:
        ablated = ["+ablation=no_interaction_reward", "seed=3", "algo.clip=0.3", "reward.joint_tracking.weight=0.7"]
        folder = held(lambda values: None, *ablated)
        cfg, where, notes = self.open(f"resume={folder}")
        assert where == folder
        assert differences(load_checkpoint(folder)["config"], OmegaConf.to_container(cfg)) == {}
        assert cfg.reward.interaction is None
        assert (cfg.seed, cfg.algo.clip) == (3, 0.3)
        assert len(notes) == 1

    def test_takes_what_was_typed_and_says_so(self, held: Callable[..., Path]) -> None:
        folder = held(lambda values: None, "+ablation=no_interaction_reward", "logger=csv")
        typed = ["total_frames=4096", "logger=online", "algo.clip=0.1", "eval_interval=7", "num_threads=1"]
        cfg, _, notes = self.open(f"resume={folder}", *typed)
        assert (cfg.total_frames, cfg.algo.clip, cfg.eval_interval) == (4096, 0.1, 7)
        assert cfg.logger.wandb.mode == "online"
        assert cfg.reward.interaction is None
        told = [note.strip() for note in notes[1:]]
        assert "total_frames: 128 -> 4096" in told
        assert "algo.clip: 0.2 -> 0.1" in told
        assert len(told) == 4  # threads are as they were
        # later ones in place of earlier ones: the config can be composed again
        replaced = ("total_frames=", "logger=", "num_threads=")
        kept = [text for text in TINY if not text.startswith(replaced)]
        assert cfg.overrides == [*kept, "+ablation=no_interaction_reward", *typed]
        assert problem_changes(load_checkpoint(folder)["config"], OmegaConf.to_container(cfg)) == []

    def test_seed_and_place_stay(self, held: Callable[..., Path], tmp_path: Path) -> None:
        folder = held(lambda values: None, "seed=3")
        cfg, where, notes = self.open(f"resume={folder}", "seed=4", f"output_dir={tmp_path / 'other'}", "run_name=b")
        assert (where, cfg.seed, cfg.run_name) == (folder, 3, None)
        assert any("seed stays 3" in note for note in notes)
        assert "seed=4" not in cfg.overrides

    def test_the_noise_stays_what_was_learned(self, held: Callable[..., Path]) -> None:
        cfg, _, notes = self.open(f"resume={held()}", "algo=ppo_wide", "algo.init_noise=0.9")
        assert cfg.algo.init_noise == 0.12
        assert any("algo.init_noise stays 0.12" in note for note in notes)

    def test_what_the_run_typed_may_be_typed_again(self, held: Callable[..., Path]) -> None:
        own = ["+ablation=no_residual", "task=lift_box", "seed=3"]
        folder = held(lambda values: None, *own)
        cfg, _, notes = self.open(f"resume={folder}", *own)
        assert differences(load_checkpoint(folder)["config"], OmegaConf.to_container(cfg)) == {}
        assert len(notes) == 1

    def test_keys_that_came_later_have_the_present_default_but_transforms_do_not_come(
        self, held: Callable[..., Path]
    ) -> None:
        def older(values: dict) -> None:
            del values["algo"]["average"], values["eval_interval"], values["sim"]["impratio"]
            del values["reward"]["feet_slip"], values["overrides"], values["starts"]

        cfg, _, notes = self.open(f"resume={held(older)}")
        assert (cfg.algo.average, cfg.eval_interval, cfg.sim.impratio) == (0.1, 0, 1.0)
        assert "feet_slip" not in cfg.reward
        assert "starts" not in cfg  # its starts were taken as they came
        assert len(notes) == 4
        run = load_checkpoint(cfg.resume)["config"]
        assert problem_changes(run, OmegaConf.to_container(cfg)) == []

    @pytest.mark.parametrize(
        ("typed", "node"),
        [
            ("+ablation=no_interaction_reward", "reward.interaction"),
            ("task=walk", "task.name"),
            ("~termination.lost_contact", "termination.lost_contact"),
            ("randomization=hdmi_push", "randomization.push"),
            ("num_envs=8", "num_envs"),
        ],
    )
    def test_another_experiment_is_refused_by_name(
        self, typed: str, node: str, held: Callable[..., Path], capsys: pytest.CaptureFixture[str]
    ) -> None:
        folder = held()
        before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        with pytest.raises(SystemExit) as end:
            command(cli.train, f"resume={folder}", typed)
        assert end.value.code == 2
        told = capsys.readouterr().out.strip()
        assert len(told.splitlines()) == 1
        assert told.startswith("CheckpointError: resume: ")
        assert node in told
        assert "resume_anyway=true" in told
        assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before

    @pytest.mark.parametrize(
        ("override", "node"),
        [
            ("action.smoothing=null", "action.smoothing"),
            ("reset=adaptive", "reset.state"),
            ("robot.feet=box", "robot.feet"),
            ("robot.self_collisions=true", "robot.self_collisions"),
            ("reward.joint_tracking.weight=3", "reward.joint_tracking"),
            ("termination.root_pose.min_steps=99", "termination.root_pose"),
            ("observation.policy.contact_labels=null", "observation.policy.contact_labels"),
            ("noise.gravity=null", "noise.gravity"),
            ("tracking.metrics=null", "tracking.metrics"),
            ("reference.motion.future_steps=[1]", "reference.motion"),
            ("task.object.mass=7", "task.object"),
            ("sim.decimation=2", "sim.decimation"),
            ("stack=[reference]", "stack"),
            ("collector=process", "collector"),
            ("algo.actor_hidden=[8]", "algo.actor_hidden"),
        ],
    )
    def test_what_makes_another_experiment(self, override: str, node: str) -> None:
        old, new = (OmegaConf.to_container(config(*overrides), resolve=True) for overrides in ([], [override]))
        assert problem_changes(old, new) == [node]
        assert problem_changes(old, old) == []

    @pytest.mark.parametrize(
        "override",
        ["total_frames=7", "algo.clip=0.1", "algo.bf16=true", "logger=online", "compile=true", "eval_envs=3", "seed=9"],
    )
    def test_what_may_change(self, override: str) -> None:
        old, new = (OmegaConf.to_container(config(*overrides), resolve=True) for overrides in ([], [override]))
        assert old != new
        assert problem_changes(old, new) == []

    @pytest.mark.parametrize(
        ("own", "typed", "node", "value"),
        [
            (["+lever=springs"], "assist.root.frequency=1", "assist.root.frequency", 1),
            (["task=walk"], "termination.root_pose.min_steps=9", "termination.root_pose.min_steps", 9),
            (["task=no_such_task"], "algo.clip=0.1", "algo.clip", 0.1),  # removed or renamed since
        ],
    )
    def test_nodes_that_only_the_run_has_may_be_typed(
        self,
        own: list[str],
        typed: str,
        node: str,
        value: float,
        held: Callable[..., Path],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        there = [] if own == ["task=no_such_task"] else own
        folder = held(lambda values: values.update(overrides=[*TINY, *own]), *there)
        opened = []
        monkeypatch.setattr(cli, "train", lambda cfg: opened.append(cli.open_run(cfg)))
        monkeypatch.setattr(sys, "argv", ["train.py", f"resume={folder}", typed])
        cli.main()
        [(cfg, _, notes)] = opened
        assert OmegaConf.select(cfg, node) == value
        assert cfg.overrides == [*TINY, *own, typed]
        assert len(notes) == 2

    def test_what_neither_has_is_one_line(
        self, held: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        folder = held(lambda values: None, "+lever=springs")
        monkeypatch.setattr(sys, "argv", ["train.py", f"resume={folder}", "assist.root.frequenzy=7"])
        with pytest.raises(SystemExit) as end:
            cli.main()
        assert end.value.code == 2
        told = capsys.readouterr().err.strip()
        assert told.startswith("ConfigError")
        assert "assist" in told
        assert len(told.splitlines()) == 1

    def test_what_does_not_fit_the_run_is_one_line(
        self, held: Callable[..., Path], capsys: pytest.CaptureFixture[str]
    ) -> None:
        folder = held(lambda values: None, "+ablation=no_interaction_reward")
        with pytest.raises(SystemExit) as end:
            command(cli.train, f"resume={folder}", "reward.interaction.weight=2")
        assert end.value.code == 2
        told = capsys.readouterr().out.strip()
        assert len(told.splitlines()) == 1
        assert "reward.interaction.weight" in told


class TestFindRun:
    def test_takes_the_folder_its_checkpoints_or_one_of_them(
        self, held: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        folder = held()
        file = folder / "checkpoints" / "checkpoint_000002.pt"
        for path in (folder, folder / "checkpoints", file):
            assert find_run(path) == (folder, file)
        monkeypatch.chdir(folder / "checkpoints")
        for here in (".", "..", "checkpoint_000002.pt", "../checkpoints"):
            assert find_run(here) == (folder, file), here

    @pytest.mark.parametrize("name", ["checkpoint_000002.pt", "checkpoints/checkpoint_000002.pt", "policy.pt"])
    def test_refuses_files_that_are_in_no_run_folder(
        self, name: str, held: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        state = load_checkpoint(held())
        save_checkpoint(tmp_path / "elsewhere" / name, copy.deepcopy(state))
        before = sorted(tmp_path.rglob("*"))
        monkeypatch.chdir(tmp_path / "elsewhere")
        for path in (name, tmp_path / "elsewhere" / name, "."):
            with pytest.raises(CheckpointError, match=r"not in a run folder|exported policy"):
                find_run(path)
        assert sorted(tmp_path.rglob("*")) == before

    def test_refuses_nothing_at_all(self, tmp_path: Path) -> None:
        with pytest.raises(CheckpointError, match="no checkpoint_"):
            find_run(tmp_path)


class TestWandb:
    """Offline: W&B's own files, no network."""

    @pytest.fixture(autouse=True)
    def offline(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("WANDB_MODE", "offline")

    @pytest.mark.slow
    def test_a_run_and_its_continuation_are_one_with_the_last_evaluation_and_the_video(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        runs: list[Any] = []
        logged: list[dict] = []
        init = wandb.init

        def noted(**options: Any) -> Any:
            run = init(**options)
            runs.append({key: getattr(run, key) for key in ("id", "name", "group", "tags", "project")})
            log = run.log
            run.log = lambda row, **rest: (logged.append(row), log(row, **rest))
            return run

        def video(folder: Path) -> Path:
            (folder / "video.mp4").write_bytes(b"pictures")
            return folder / "video.mp4"

        monkeypatch.setattr(wandb, "init", noted)
        monkeypatch.setattr(cli, "render_checkpoint", video)
        started = [*SHORT, "logger=offline", "video=true", "seed=3", "+ablation=no_rsi", "total_frames=32"]
        command(cli.train, *started, f"output_dir={tmp_path}", "run_name=run")
        command(cli.train, f"resume={tmp_path / 'run'}", "total_frames=64")
        first, second = runs
        assert first == second
        assert first["name"] == "lift_box run"
        assert (first["group"], first["project"]) == ("lift_box", "hdmi")
        assert set(first["tags"]) == {"ablation=no_rsi", "seed=3"}
        assert all(row["iteration"] in (1, 2) for row in logged)
        for iteration in (1, 2):
            rows = [row for row in logged if row["iteration"] == iteration]
            assert any("kl" in row for row in rows)
            assert any("eval/success_rate" in row for row in rows)
            assert any(isinstance(row.get("video"), wandb.Video) for row in rows)
        folders = sorted((tmp_path / "run" / "wandb").glob("offline-run-*"))
        assert len(folders) == 2
        assert all(folder.name.endswith(first["id"]) for folder in folders)
        # in the run's own files, too
        metrics = list(csv.DictReader((tmp_path / "run" / "metrics.csv").open()))
        figures = EvalResult.load(tmp_path / "run" / "eval.json").figures()
        assert float(metrics[-1]["eval/survival"]) == pytest.approx(figures["survival"]["mean"])
        assert [row["iteration"] for row in metrics] == ["1", "2"]
        assert metrics[0]["eval/survival"]

    def test_what_keeps_it_from_starting_is_one_line(
        self, run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        def fail(**options: Any) -> None:
            raise wandb.errors.UsageError("No API key configured.\nUse `wandb login` to log in.")

        monkeypatch.setattr(wandb, "init", fail)
        before = (run / "metrics.csv").read_bytes()
        with pytest.raises(SystemExit) as end:
            command(cli.train, f"resume={run}", "logger=online")
        assert end.value.code == 2
        told = capsys.readouterr().out.splitlines()[-1]
        assert told.startswith("LoggerError: logger: W&B does not start in mode 'online': No API key configured.;")
        assert "logger=csv" in told
        assert (run / "metrics.csv").read_bytes() == before


def test_a_metrics_file_that_was_cut_off_is_continued(run: Path, tmp_path: Path) -> None:
    rows = (run / "metrics.csv").read_text()
    (tmp_path / "metrics.csv").write_text(rows + "4,0.1")
    logger = RunLogger(tmp_path, config(), last_iteration=9)
    logger.log(4, {"reward": 0.5})
    written = list(csv.DictReader((tmp_path / "metrics.csv").open()))
    assert [row["iteration"] for row in written] == ["1", "2", "3", "4"]
    assert written[-1]["reward"] == "0.5"
