"""One value head for each group of rewards, and first steps that are not learned from: `reward=hdmi_2025`."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from mocks import load_config
from tensordict import TensorDictBase
from test_training import config
from torch import Tensor

from hdmi.learning import CheckpointError, Trainer, load_checkpoint, load_policy, make_trainer
from hdmi.learning.networks import network_of
from hdmi.metrics import read_rows

SET = "reward=hdmi_2025"
SHORT = "task.episode_steps=5"  # worlds are reset often
GROUPS = ["object", "regularization", "tracking"]
N, T = 4, 8


@pytest.fixture(scope="module")
def trainer(tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    return Trainer(config(SET), tmp_path_factory.mktemp("grouped"))


@pytest.fixture(scope="module")
def batch(trainer: Trainer) -> TensorDictBase:
    """Steps in which one world's episode fails in the middle, and another's is cut off."""
    torch.manual_seed(0)
    with torch.no_grad():
        batch = trainer.env.rollout(T, trainer.actor, break_when_any_done=False)
    for world, terminated in ((0, True), (1, False)):
        batch["next", "done"][world, 2] = True
        batch["next", "terminated"][world, 2] = terminated
        batch["step_count"][world, 3:] -= 3
    return batch


def generalized_advantage(reward: Tensor, value: Tensor, after: Tensor, batch: TensorDictBase, algo) -> Tensor:
    """Of one reward, step by step. [N, T] -> [N, T]"""
    done, terminated = (batch["next", key].squeeze(-1) for key in ("done", "terminated"))
    out, following = torch.zeros_like(reward), torch.zeros(len(reward))
    for t in reversed(range(reward.shape[1])):
        error = reward[:, t] + algo.gamma * after[:, t] * ~terminated[:, t] - value[:, t]
        following = out[:, t] = error + algo.gamma * algo.lmbda * following * ~done[:, t]
    return out


def test_one_flip_is_the_whole_set() -> None:
    cfg, paper = load_config(SET), load_config()
    assert (cfg.algo.skip_first, paper.algo.skip_first) == (True, False)
    assert list(cfg.reward.body_local_pose.sigmas) == [0.3, 0.4]
    assert [name for name in paper.reward if cfg.reward[name] is None and paper.reward[name] is not None] == [
        "feet_impact",
        "feet_slip",
        "feet_air_time",
    ]
    assert {key for key in paper if cfg[key] != paper[key]} == {"reward", "returns", "algo"}
    assert load_config(SET, "algo=teacher_student").algo.skip_first
    assert not load_config(SET, "algo.skip_first=false").algo.skip_first


class TestHeads:
    def test_are_the_groups_that_the_task_has(self, trainer: Trainer, batch: TensorDictBase) -> None:
        assert trainer.groups == GROUPS
        assert trainer.sizes["state_value"] == network_of(trainer.critic).mlp[-1].out_features == 3
        total = sum(batch["next", "reward_groups", group] for group in GROUPS)
        torch.testing.assert_close(total, batch["next", "reward"])
        assert all((batch["next", "reward_groups", group] != 0).any() for group in GROUPS)

    def test_each_has_its_own_returns(self, trainer: Trainer, batch: TensorDictBase) -> None:
        """Bootstrapped where an episode is cut off, not where it fails."""
        data, algo = trainer.prepare(batch).reshape(N, T), trainer.cfg.algo
        with torch.no_grad():
            value, after = (trainer.critic(td.select("critic"))["state_value"] for td in (batch, batch["next"]))
        total = torch.zeros(N, T)
        for i, group in enumerate(GROUPS):
            reward = batch["next", "reward_groups", group].squeeze(-1)
            # the middle of a rollout is followed by its next step, not by what the script says
            advantage = generalized_advantage(reward, value[..., i], after[..., i], batch, algo)
            torch.testing.assert_close(data["state_value"][..., i], value[..., i], rtol=1e-4, atol=1e-5)
            torch.testing.assert_close(data["value_target"][..., i], advantage + value[..., i], rtol=1e-4, atol=1e-5)
            total += advantage
        torch.testing.assert_close(data["advantage"], total.unsqueeze(-1), rtol=1e-4, atol=1e-5)
        # which is the advantage of the sum of the rewards, under the sum of the values
        whole = generalized_advantage(batch["next", "reward"].squeeze(-1), value.sum(-1), after.sum(-1), batch, algo)
        torch.testing.assert_close(total, whole, rtol=1e-4, atol=1e-5)

    def test_each_learns_from_its_own_returns_alone(self, trainer: Trainer, batch: TensorDictBase) -> None:
        data = trainer.prepare(batch)
        last = network_of(trainer.critic).mlp[-1].weight

        def gradient() -> Tensor:
            losses = trainer.objective.loss(data)
            expected = torch.nn.functional.smooth_l1_loss(data["state_value"], data["value_target"])
            torch.testing.assert_close(losses["loss_critic"].detach(), expected)
            return torch.autograd.grad(losses["loss_critic"], last)[0]

        before = gradient()
        data["value_target"] = data["value_target"] + torch.tensor([0.0, 0.5, 0.0])
        assert (gradient() != before).any(-1).tolist() == [False, True, False]

    def test_how_well_each_does_is_logged(self, trained: tuple[Trainer, Path]) -> None:
        rows = read_rows(trained[1] / "metrics.csv")[1]
        for key in ("explained_variance", *(f"explained_variance/{group}" for group in GROUPS)):
            assert all(float(row[key]) <= 1 for row in rows), key


def assert_same_weights(a: Trainer, b: Trainer) -> None:
    for name in ("actor", "averaged", "critic"):
        states = (getattr(trainer, name).state_dict() for trainer in (a, b))
        torch.testing.assert_close(*states, rtol=0, atol=0)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Trainer, Path]:
    folder = tmp_path_factory.mktemp("straight")
    trainer = Trainer(config(SET, SHORT), folder)
    trainer.run()
    return trainer, folder


class TestRun:
    def test_continues_exactly(self, trained: tuple[Trainer, Path], tmp_path: Path) -> None:
        Trainer(config(SET, SHORT, "total_frames=64"), tmp_path).run()
        again = Trainer(config(SET, SHORT, f"resume={tmp_path}"), tmp_path)
        again.run()
        assert_same_weights(trained[0], again)

    @pytest.mark.slow
    def test_continues_exactly_across_a_change_of_roles(self, tmp_path: Path) -> None:
        taught = (SET, SHORT, "algo=teacher_student")
        straight = make_trainer(config(*taught, "algo.teacher_share=0.5"), tmp_path / "straight")
        straight.run()
        # of half the frames: as if it were interrupted when the student takes over
        make_trainer(config(*taught, "algo.teacher_share=0.999", "total_frames=64"), tmp_path / "run").run()
        again = make_trainer(config(*taught, "algo.teacher_share=0.5", f"resume={tmp_path / 'run'}"), tmp_path / "run")
        again.run()
        assert_same_weights(straight, again)

    def test_policy_loads(self, trained: tuple[Trainer, Path]) -> None:
        trainer, folder = trained
        policy, cfg, _ = load_policy(folder)
        assert load_checkpoint(folder)["sizes"]["state_value"] == 3
        assert cfg.algo.skip_first
        assert sum(p.numel() for p in policy.parameters()) == sum(p.numel() for p in trainer.policy.parameters())

    def test_other_heads_are_refused(self, trained: tuple[Trainer, Path], tmp_path: Path) -> None:
        with pytest.raises(CheckpointError, match=r"returns\.groups.*not as in the run"):
            Trainer(config(f"resume={trained[1]}"), tmp_path)
        with pytest.raises(CheckpointError, match=r"sizes .*'state_value': 3"):
            Trainer(config(f"resume={trained[1]}", "resume_anyway=true"), tmp_path)


def learned(trainer: Trainer, batch: TensorDictBase) -> tuple[dict[str, Tensor], dict[str, float]]:
    """The weights after one update, which is then undone, and its figures."""
    parts = (trainer.actor, trainer.critic, trainer.averaged, trainer.actor_optim, trainer.critic_optim)
    before = [copy.deepcopy(part.state_dict()) for part in parts]
    torch.manual_seed(1)
    figures = trainer.update(batch.clone())
    weights = copy.deepcopy({**trainer.actor.state_dict(prefix="a."), **trainer.critic.state_dict(prefix="c.")})
    for part, state in zip(parts, before, strict=True):
        part.load_state_dict(state)
    return weights, figures


class TestFirstSteps:
    @pytest.mark.parametrize("skip", [True, False])
    def test_have_a_part_in_no_loss(
        self, skip: bool, trainer: Trainer, batch: TensorDictBase, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Whatever is done and earned in them, the same is learned."""
        monkeypatch.setattr(trainer.cfg.algo, "skip_first", skip)
        first = batch["step_count"] == 0
        assert first.squeeze(-1).nonzero().tolist() == [[0, 0], [0, 3], [1, 0], [1, 3], [2, 0], [3, 0]]
        other = batch.clone()
        other["next", "reward_groups", "tracking"] += 0.5 * first
        other["action_log_prob"] = other["action_log_prob"] - 0.1 * first.squeeze(-1)
        (weights, figures), (changed, others) = (learned(trainer, each) for each in (batch, other))
        assert all(torch.equal(weights[name], changed[name]) for name in weights) == skip
        assert (figures["explained_variance"] == others["explained_variance"]) == skip

    def test_minibatches_are_of_the_others(
        self, trainer: Trainer, batch: TensorDictBase, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        seen: list[TensorDictBase] = []
        step: Callable = lambda minibatch: seen.append(minibatch)  # noqa: E731
        monkeypatch.setattr(trainer, "_step", step)
        trainer.update(batch.clone())
        kept = batch["step_count"].flatten() > 0
        assert [len(minibatch) for minibatch in seen] == [int(kept.sum()) // 2] * 4  # two epochs of two
        advantage = torch.cat([minibatch["advantage"] for minibatch in seen[:2]])
        assert advantage.mean().item() == pytest.approx(0.0, abs=1e-5)
        assert advantage.std(correction=0).item() == pytest.approx(1.0, abs=1e-3)
        actions = batch["action"].flatten(0, 1)[kept]
        got = torch.cat([minibatch["action"] for minibatch in seen[:2]])
        assert torch.equal(got.sort(0).values, actions.sort(0).values)

    @pytest.mark.filterwarnings("ignore:var")
    def test_alone_teach_nothing(self, trainer: Trainer, batch: TensorDictBase) -> None:
        before = [p.detach().clone() for p in trainer.actor.parameters()]
        all_first = batch.clone()
        all_first["step_count"].zero_()
        trainer.update(all_first)
        assert all(torch.equal(a, b) for a, b in zip(before, trainer.actor.parameters(), strict=True))
