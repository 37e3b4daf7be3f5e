"""Training end to end on tiny budgets: it runs, resumes exactly, and survives what goes wrong."""

from __future__ import annotations

import csv
import math
import os
import pickle
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.objectives.value import GAE

from hdmi.commands.train import open_run, run_folder
from hdmi.learning import CheckpointError, RunningNorm, Trainer, load_checkpoint, load_policy, save_checkpoint
from hdmi.learning.checkpoint import BEST_FILE, FORMAT, checkpoints, claim
from hdmi.learning.networks import bound_noise, make_actor, network_of, normalised_actor, normalised_critic
from hdmi.learning.policy import export_policy, make_networks
from hdmi.learning.resume import find_run
from hdmi.learning.trainer import DivergenceError, Evaluate
from hdmi.metrics import read_rows

ROOT = Path(__file__).parents[1]
TINY = [
    "num_envs=4", "algo.frames_per_env=8", "algo.minibatches=2", "algo.epochs=2", "total_frames=128",
    "algo.actor_hidden=[32]", "algo.critic_hidden=[32]", "algo.bf16=false", "checkpoint_interval=2",
    "logger=csv", "video=false", "num_threads=1", "eval_envs=2",
    "algo.average=0.5",  # of four iterations: the mean is none of them
    "algo.final_kl=${algo.desired_kl}",  # no fall: it depends on the budget, and budgets are extended below
]  # fmt: skip


def config(*overrides: str) -> DictConfig:
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return compose("config", overrides=[*TINY, *overrides])


def parameters(trainer: Trainer) -> list[torch.Tensor]:
    """Of the actor, and of the mean that leaves the training."""
    return [*trainer.actor.parameters(), *trainer.averaged.module.parameters()]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Trainer, Path]:
    folder = tmp_path_factory.mktemp("run")
    trainer = Trainer(config(), folder)
    trainer.run()
    return trainer, folder


class TestRun:
    def test_leaves_config_metrics_and_rotated_checkpoints(self, trained: tuple[Trainer, Path]) -> None:
        _, folder = trained
        rows = list(csv.DictReader((folder / "metrics.csv").open()))
        assert [int(row["iteration"]) for row in rows] == [1, 2, 3, 4]
        assert [int(row["frames"]) for row in rows] == [32, 64, 96, 128]
        for key in ("reward", "reward/interaction", "joint_error", "contact_rate", "termination/root_pose", "kl"):
            assert all(row[key] for row in rows), key
        assert (folder / "config.yaml").is_file()
        assert [path.name for path in checkpoints(folder / "checkpoints")] == [
            "checkpoint_000002.pt",
            "checkpoint_000004.pt",
        ]

    def test_counts_starts_that_are_drawn_again(self, tmp_path: Path) -> None:
        trainer = Trainer(config("starts.max_penetration=-1", "total_frames=32"), tmp_path)  # every start is too deep
        trainer.run()
        (row,) = csv.DictReader((tmp_path / "metrics.csv").open())
        assert float(row["redrawn_starts"]) == trainer.env.num_redrawn == 4 * trainer.env.num_deep > 0
        assert float(row["deep_starts"]) == trainer.env.num_deep

    def test_weights_moved(self, trained: tuple[Trainer, Path], fresh: Trainer) -> None:
        trainer, _ = trained
        moved = [
            not torch.equal(a, b) for a, b in zip(trainer.actor.parameters(), fresh.actor.parameters(), strict=True)
        ]
        assert all(moved)

    def test_divergence_is_to_fall_linearly(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        trainer = Trainer(config("algo.desired_kl=0.016", "algo.final_kl=0.004", "algo.epochs=1"), tmp_path)
        wanted: list[float] = []
        monkeypatch.setattr(trainer.schedule, "step", lambda kl: wanted.append(trainer.schedule.target_kl))
        trainer.run()
        # two minibatches in each of four iterations
        assert wanted[::2] == wanted[1::2] == pytest.approx([0.016, 0.013, 0.010, 0.007])

    def test_rates_fall_no_further_than_asked(self, tmp_path: Path) -> None:
        bounds = ("algo.desired_kl=1e-12", "algo.final_kl=1e-12", "algo.actor_lr=5e-4", "algo.min_lr=4.9e-4")
        Trainer(config(*bounds), tmp_path).run()
        assert {row["actor_lr"] for row in csv.DictReader((tmp_path / "metrics.csv").open())} == {"0.00049"}

    def test_policy_loads_and_repeats(self, trained: tuple[Trainer, Path]) -> None:
        trainer, folder = trained
        actor, cfg, info = load_policy(folder)
        assert cfg.task.name == "lift_box"
        assert info["frames"] == 128
        observation = torch.randn(3, trainer.sizes["policy"])
        expected = trainer.averaged.module.module[0].module(observation)[0]
        torch.testing.assert_close(actor.module[0].module(observation)[0], expected)
        assert not torch.equal(expected, trainer.actor.module[0].module(observation)[0])

    def test_what_leaves_is_the_mean_of_the_last_weights(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        trainer = Trainer(config(), tmp_path)
        seen: list[torch.Tensor] = []
        update = trainer.update

        def noted(batch: TensorDictBase) -> dict[str, float]:
            figures = update(batch)
            seen.append(next(trainer.actor.parameters()).detach().clone())
            return figures

        monkeypatch.setattr(trainer, "update", noted)
        trainer.run()
        _, second, third, fourth = seen
        # shares of the newest: all, all (0.5 * 2 is one), 1 / 1.5, 1 / 2
        expected = ((second + 2 * third) / 3 + fourth) / 2
        torch.testing.assert_close(next(trainer.averaged.module.parameters()), expected)
        mean, actor = network_of(trainer.averaged.module).norm, network_of(trainer.actor).norm
        torch.testing.assert_close(mean.mean, actor.mean, rtol=0, atol=0)

    def test_that_mean_is_what_is_evaluated(self, tmp_path: Path) -> None:
        evaluated: list[torch.nn.Module] = []

        def noted(actor: torch.nn.Module, *_: object) -> dict[str, float]:
            evaluated.append(actor)
            return {"eval/success_rate": 0.5}

        trainer = Trainer(config("eval_interval=4"), tmp_path, noted)
        trainer.run()
        assert evaluated == [trainer.averaged.module]
        assert [row["eval/success_rate"] for row in read_rows(tmp_path / "metrics.csv")[1]][-1] == "0.5"

    def test_the_best_of_the_evaluations_is_kept(self, tmp_path: Path) -> None:
        figures = [(0.5, 0.6), (0.7, 0.8), (0.7, 0.8), (0.7, 0.7)]

        def evaluations(rows: list[tuple[float, float]]) -> Evaluate:
            left = iter(rows)
            return lambda *_: dict(zip(("eval/success_rate", "eval/survival"), next(left), strict=True))

        Trainer(config("eval_interval=1"), tmp_path, evaluations(figures)).run()
        best = load_checkpoint(tmp_path / "checkpoints" / BEST_FILE)
        assert best["iteration"] == 3  # of equals the one that has trained longer
        assert load_policy(tmp_path)[2]["iteration"] == 4  # a run is still its newest policy
        resume = (f"resume={tmp_path}", "eval_interval=1")
        Trainer(config(*resume, "total_frames=160"), tmp_path, evaluations([(0.6, 0.9)])).run()
        assert load_checkpoint(tmp_path / "checkpoints" / BEST_FILE)["iteration"] == 3
        Trainer(config(*resume, "total_frames=192"), tmp_path, evaluations([(0.8, 0.8)])).run()
        assert load_checkpoint(tmp_path / "checkpoints" / BEST_FILE)["iteration"] == 6
        (tmp_path / "checkpoints" / "checkpoint_000006.pt").unlink()  # one of an iteration that is trained again
        Trainer(config(*resume, "total_frames=192"), tmp_path, evaluations([(0.1, 0.1)])).run()
        assert load_checkpoint(tmp_path / "checkpoints" / BEST_FILE)["merit"] == [0.1, 0.1]
        with pytest.raises(CheckpointError, match=r"best\.pt holds networks, but no worlds to continue"):
            find_run(tmp_path / "checkpoints" / BEST_FILE)


class TestResume:
    def test_continues_exactly(self, trained: tuple[Trainer, Path], tmp_path: Path) -> None:
        straight, _ = trained
        first = Trainer(config("total_frames=64"), tmp_path)
        first.run()
        second = Trainer(config(f"resume={tmp_path}"), tmp_path)
        assert second.iteration == 2
        second.run()
        for a, b in zip(parameters(straight), parameters(second), strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=0)
        rows = list(csv.DictReader((tmp_path / "metrics.csv").open()))
        assert [int(row["iteration"]) for row in rows] == [1, 2, 3, 4]

    def test_an_exported_policy_cannot_be_continued(self, trained: tuple[Trainer, Path], tmp_path: Path) -> None:
        policy = export_policy(trained[1], tmp_path / "policy.pt")
        with pytest.raises(CheckpointError, match="an exported policy, without critic"):
            Trainer(config(f"resume={policy}"), tmp_path)

    def test_an_exported_policy_does_not_say_where_it_was_trained(
        self, trained: tuple[Trainer, Path], tmp_path: Path
    ) -> None:
        run = load_checkpoint(trained[1])
        run["config"] |= {
            "output_dir": "/here",
            "run_name": "it",
            "overrides": ["seed=1", "output_dir=/here", "run_name=it"],
        }
        save_checkpoint(tmp_path / "run.pt", {key: value for key, value in run.items() if key != "format"})
        policy = load_checkpoint(export_policy(tmp_path / "run.pt", tmp_path / "policy.pt"))
        config = policy["config"]
        assert policy["motion"] == run["motion"]  # but what it tracks
        assert config["overrides"] == ["seed=1"]
        assert set(run["config"]) - set(config) == {"output_dir", "run_name", "resume"}

    def test_after_kill_9(self, tmp_path: Path) -> None:
        command = [
            sys.executable, str(ROOT / "train.py"), *TINY, "checkpoint_interval=1", "total_frames=1000000",
            f"output_dir={tmp_path}", "run_name=run",
        ]  # fmt: skip
        process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        folder = tmp_path / "run" / "checkpoints"
        deadline = time.monotonic() + 120
        while len(checkpoints(folder)) < 2 and time.monotonic() < deadline:
            assert process.poll() is None, "training ended by itself"
            time.sleep(0.1)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        reached = load_checkpoint(tmp_path / "run")["iteration"]
        assert reached >= 2
        budget = f"total_frames={32 * (reached + 1)}"
        resumed = Trainer(config(budget, f"resume={tmp_path / 'run'}"), tmp_path / "run")
        assert resumed.iteration == reached
        resumed.run()
        straight = Trainer(config(budget), tmp_path / "straight")
        straight.run()
        assert resumed.iteration == straight.iteration == reached + 1
        for a, b in zip(parameters(straight), parameters(resumed), strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=0)

    def test_refuses_another_task(self, trained: tuple[Trainer, Path], tmp_path: Path) -> None:
        _, folder = trained
        state = load_checkpoint(folder)
        state["task"] = "push_box"
        save_checkpoint(tmp_path / "checkpoints" / "checkpoint_000001.pt", state)
        with pytest.raises(CheckpointError, match=r"'push_box'.*'lift_box'"):
            Trainer(config(f"resume={tmp_path}"), tmp_path)


class TestCheckpoint:
    def test_missing_damaged_and_foreign(self, tmp_path: Path) -> None:
        with pytest.raises(CheckpointError, match="no checkpoint"):
            load_checkpoint(tmp_path)
        path = tmp_path / "checkpoint_000001.pt"
        for content in (
            b"",
            b"not a checkpoint",
            b"a: yaml\n",
            pickle.dumps({"format": FORMAT}, protocol=2),
            b"\x89PNG\r\n\x1a\n",
            b"PK\3\4",
        ):
            path.write_bytes(content)
            with pytest.raises(
                CheckpointError, match=r"checkpoint_000001\.pt: damaged or not a checkpoint; "
            ) as failed:
                load_checkpoint(tmp_path)
            assert len(str(failed.value).splitlines()) == 1
            assert "weights_only" not in str(failed.value)
        for content in ({"something": torch.zeros(1)}, {"format": "other"}, [1]):
            torch.save(content, path)
            with pytest.raises(CheckpointError, match="not an hdmi checkpoint of format"):
                load_checkpoint(path)

    def test_of_an_older_version(self, tmp_path: Path) -> None:
        """Says what its config has elsewhere, in one line."""
        path = tmp_path / "policy.pt"
        torch.save({"format": 3, "config": {"termination": {"motion_end": {}}}}, path)
        told = (
            r"policy\.pt: of format 3, made by an older version of hdmi.*motion_end and step_count are nodes of horizon"
        )
        with pytest.raises(CheckpointError, match=told) as failed:
            load_checkpoint(path)
        assert len(str(failed.value).splitlines()) == 1

    def test_never_unpickles_code(self, tmp_path: Path) -> None:
        class Hostile:
            def __reduce__(self) -> tuple:
                return (Path.touch, (tmp_path / "executed",))

        torch.save({"format": FORMAT, "x": Hostile()}, tmp_path / "checkpoint_000001.pt")
        with pytest.raises(CheckpointError):
            load_checkpoint(tmp_path)
        assert not (tmp_path / "executed").exists()

    def test_failed_write_keeps_what_was_there(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        path = tmp_path / "checkpoint_000001.pt"
        save_checkpoint(path, {"value": 1})

        def full_disk(*args: object, **kwargs: object) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(torch, "save", full_disk)
        with pytest.raises(OSError, match="No space left"):
            save_checkpoint(path, {"value": 2})
        monkeypatch.undo()
        assert load_checkpoint(path)["value"] == 1
        assert list(tmp_path.iterdir()) == [path]


@pytest.fixture(scope="module")
def fresh(tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    return Trainer(config(), tmp_path_factory.mktemp("fresh"))


class TestRecovery:
    def test_full_disk_does_not_stop_training(
        self, fresh: Trainer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
    ) -> None:
        trainer = fresh

        def full_disk(*args: object, **kwargs: object) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(torch, "save", full_disk)
        lost = trainer.lost_checkpoints
        trainer.save()
        assert trainer.lost_checkpoints == lost + 1
        assert "No space left" in capsys.readouterr().err

    def test_bad_minibatch_is_skipped_and_many_stop(self, fresh: Trainer) -> None:
        trainer = fresh
        torch.manual_seed(0)
        with torch.no_grad():
            batch = trainer.env.rollout(4, trainer.actor, break_when_any_done=False)
        data = trainer.prepare(batch)
        data["advantage"].fill_(float("nan"))
        before = [p.clone() for p in trainer.actor.parameters()]
        assert trainer._step(data) is None
        assert all(torch.equal(a, b) for a, b in zip(before, trainer.actor.parameters(), strict=True))

        def step_on() -> None:
            for _ in range(100):
                trainer._step(data)

        with pytest.raises(DivergenceError, match="without finite loss"):
            step_on()


def test_without_groups_of_rewards_there_is_one_value(fresh: Trainer) -> None:
    assert fresh.groups == []
    assert set(fresh.sizes) == {"policy", "critic", "action"}
    assert network_of(fresh.critic).mlp[-1].out_features == 1


class TestPrepare:
    """What the learner takes of a batch is what it would get from raw observations."""

    @pytest.fixture(scope="class")
    def batch(self, fresh: Trainer) -> TensorDictBase:
        torch.manual_seed(0)
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):  # the probabilities of means say little
            batch = fresh.env.rollout(6, fresh.actor, break_when_any_done=False)
        # the middle of one world's rollout becomes the end of an episode; of another's, one that is only cut off
        for world, terminated in ((0, True), (1, False)):
            batch["next", "done"][world, 2] = True
            batch["next", "terminated"][world, 2] = terminated
            batch["next", "critic"][world, 2] += 1.0
        return batch

    def test_values_and_advantages_are_those_of_every_next_state(self, fresh: Trainer, batch: TensorDictBase) -> None:
        algo = fresh.cfg.algo
        expected = GAE(gamma=algo.gamma, lmbda=algo.lmbda, value_network=fresh.critic)(batch.clone()).reshape(-1)
        data = fresh.prepare(batch)
        for key in ("state_value", "advantage", "value_target"):
            torch.testing.assert_close(data[key], expected[key], rtol=1e-4, atol=1e-5)

    def test_loss_begins_at_the_policy_that_acted_and_the_values_it_was_given(
        self, fresh: Trainer, batch: TensorDictBase
    ) -> None:
        data = fresh.prepare(batch)
        losses = fresh.objective.loss(data)
        critic = torch.nn.functional.smooth_l1_loss(data["state_value"], data["value_target"])
        torch.testing.assert_close(losses["loss_critic"], critic)
        torch.testing.assert_close(losses["kl_approx"], torch.tensor(0.0), rtol=0, atol=1e-4)
        torch.testing.assert_close(losses["clip_fraction"], torch.tensor(0.0))

    @pytest.mark.parametrize("bf16", [False, True])
    def test_networks_answer_alike_and_share_parameters(self, batch: TensorDictBase, bf16: bool) -> None:
        sizes = {key: batch[key].shape[-1] for key in ("policy", "critic", "action")}
        cfg = config(f"algo.bf16={bf16}")
        actor, critic = make_networks(cfg, sizes, torch.device("cpu"))
        network_of(actor).norm.update(torch.full((sizes["policy"],), 0.3), torch.full((sizes["policy"],), 2.0), n=9)
        own_actor, own_critic = normalised_actor(actor), normalised_critic(critic)
        data = batch.select("policy", "critic").clone()
        for key, network in (("policy", actor), ("critic", critic)):
            data[key] = network_of(network).normalise(data[key])
            assert data[key].dtype == (torch.bfloat16 if bf16 else torch.float32)
        actor_out, own_out = actor(batch.select("policy")), own_actor(data)
        for key in ("loc", "scale"):
            torch.testing.assert_close(own_out[key], actor_out[key], rtol=0, atol=0)
        torch.testing.assert_close(
            own_critic(data)["state_value"], critic(batch.select("critic"))["state_value"], rtol=0, atol=0
        )
        assert {id(p) for p in own_actor.parameters()} == {id(p) for p in actor.parameters()}
        assert {id(p) for p in own_critic.parameters()} == {id(p) for p in critic.parameters()}


def test_first_moments_come_from_sampled_actions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    batches: list[TensorDictBase] = []
    update = Trainer._update_moments
    monkeypatch.setattr(Trainer, "_update_moments", lambda self, batch: (batches.append(batch), update(self, batch)))
    trainer = Trainer(config(), tmp_path)
    assert len(batches) == 1
    spread = (batches[0]["action"] - batches[0]["loc"]).std()
    torch.testing.assert_close(spread, torch.tensor(trainer.cfg.algo.init_noise), rtol=0.1, atol=0)
    trainer.collector.shutdown()


class TestNoise:
    def actor(self, log_std: list[float]) -> torch.nn.Module:
        torch.manual_seed(0)
        actor = make_actor(3, len(log_std), [8], "SiLU", init_noise=1.0, bf16=False)
        with torch.no_grad():
            network_of(actor).log_std.copy_(torch.tensor(log_std))
        return actor

    def scale(self, actor: torch.nn.Module) -> torch.Tensor:
        return actor(TensorDict({"policy": torch.zeros(5, 3)}, [5]))["scale"]

    def test_is_what_the_parameter_says_within_bounds_and_the_bound_beyond(self) -> None:
        values = [-8.0, -2.9, -1.3, 0.5, 3.0]
        expected = torch.tensor([0.05, math.exp(-2.9), math.exp(-1.3), math.exp(0.5), 2.0])
        torch.testing.assert_close(self.scale(self.actor(values))[0], expected)

    @pytest.mark.parametrize(("start", "direction", "bound"), [(-8.0, 1.0, 0.05), (3.0, -1.0, 2.0)])
    def test_comes_back_from_beyond_a_bound(self, start: float, direction: float, bound: float) -> None:
        actor = self.actor([start])
        optimizer = torch.optim.Adam(actor.parameters(), lr=0.05)
        for _ in range(3):
            optimizer.zero_grad()
            (-direction * self.scale(actor).mean()).backward()
            optimizer.step()
            bound_noise(actor)
        assert direction * (float(self.scale(actor)[0, 0].detach()) - bound) > 0.01 * bound

    def test_does_not_move_away_behind_a_bound(self) -> None:
        actor = self.actor([-2.9])
        optimizer = torch.optim.Adam(actor.parameters(), lr=0.5)
        for _ in range(5):
            optimizer.zero_grad()
            self.scale(actor).mean().backward()
            optimizer.step()
            bound_noise(actor)
        assert network_of(actor).log_std.item() == pytest.approx(math.log(0.05))


def test_running_norm_matches_moments_of_all_batches() -> None:
    torch.manual_seed(0)
    norm = RunningNorm(3)
    batches = [torch.randn(50, 3) * 2 + 1, torch.randn(20, 3) - 4, torch.randn(7, 2, 3)]
    for batch in batches:
        values = batch.reshape(-1, 3)
        norm.update(values.mean(0), values.var(0, unbiased=False), len(values))
    everything = torch.cat([batch.reshape(-1, 3) for batch in batches])
    torch.testing.assert_close(norm.mean, everything.mean(0), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(norm.var, everything.var(0, unbiased=False), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (["task.motion=nowhere"], "MotionError.*nowhere"),
        (["reward.interaction.sigma=1"], "ConfigError.*reward.interaction"),
        (["robot.feet=wheels"], "ConfigError.*feet"),
        (["resume=/nonexistent"], "CheckpointError.*/nonexistent"),
    ],
)
def test_bad_input_is_one_clear_error(overrides: list[str], expected: str, tmp_path: Path) -> None:
    overrides = [f"+{o}" if o.startswith("reward") else o for o in overrides]
    command = [sys.executable, str(ROOT / "train.py"), *TINY, *overrides, f"output_dir={tmp_path}"]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=120)
    assert result.returncode == 2
    text = " ".join(result.stdout.split())
    assert re.search(expected, text), result.stdout + result.stderr
    assert "Traceback" not in result.stdout + result.stderr


class TestRunFolder:
    def test_admits_one_training_at_a_time(self, tmp_path: Path) -> None:
        trainer = Trainer(config("total_frames=32"), tmp_path)
        with claim(tmp_path), pytest.raises(CheckpointError, match="another process trains there"):
            trainer.run()
        trainer.run()
        assert checkpoints(tmp_path / "checkpoints")

    def test_of_an_old_run_is_not_used_for_a_new_one(self, trained: tuple[Trainer, Path]) -> None:
        _, folder = trained
        cfg = config(f"output_dir={folder.parent}", f"run_name={folder.name}")
        with pytest.raises(CheckpointError, match="holds a run already"):
            run_folder(cfg)
        cfg.resume = str(folder)
        assert open_run(cfg)[1] == folder
