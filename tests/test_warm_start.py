"""Networks that start from those of another training."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from mocks import load_config
from torch import nn

from hdmi.assembly import make_env, make_task, network_inputs
from hdmi.learning import export_policy
from hdmi.learning.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from hdmi.learning.networks import RunningNorm, make_critic, network_of
from hdmi.learning.trainer import Trainer
from hdmi.learning.warm_start import take_over


class Net(nn.Module):
    """As the networks: moments and layers."""

    def __init__(self, in_size: int):
        super().__init__()
        self.norm = RunningNorm(in_size)
        self.mlp = nn.Sequential(nn.Linear(in_size, 4), nn.Tanh(), nn.Linear(4, 2))

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        return self.mlp(self.norm(values))


def test_shared_terms_do_what_they_did_and_new_ones_nothing_yet():
    source, target = Net(5), Net(6)
    source.norm.update(torch.arange(5.0), torch.full((5,), 4.0), 10)
    of, inputs = {"a": 2, "b": 1, "c": 2}, {"c": 2, "new": 1, "a": 2, "b": 1}
    taken = take_over(target, source.state_dict(), inputs, of, "net")
    a, b, c, new = torch.randn(8, 2), torch.randn(8, 1), torch.randn(8, 2), torch.randn(8, 1)
    before = source(torch.cat([a, b, c], -1))
    torch.testing.assert_close(target(torch.cat([c, new, a, b], -1)), before)
    assert (taken.terms, taken.new) == (("c", "a", "b"), ("new",))
    assert str(taken) == "net: 3 of 4 terms of its observation; new to it: new"
    target(torch.cat([c, new, a, b], -1)).sum().backward()
    assert target.mlp[0].weight.grad[:, 2].abs().min() > 0  # and can be learned


def test_a_term_of_another_width_is_new():
    source, target = Net(3), Net(4)
    taken = take_over(target, source.state_dict(), {"a": 1, "points": 3}, {"a": 1, "points": 2}, "net")
    assert taken.new == ("points",)
    assert target.mlp[0].weight[:, 1:].abs().max() == 0


def test_moments_come_over_gently():
    """Of new terms they are those of the new task; the next samples weigh little."""
    source, target = Net(1), Net(2)
    source.norm.update(torch.tensor([2.0]), torch.tensor([9.0]), 10_000_000)
    target.norm.update(torch.tensor([5.0, 7.0]), torch.tensor([1.0, 1.0]), 10)
    take_over(target, source.state_dict(), {"a": 1, "new": 1}, {"a": 1}, "net")
    assert target.norm.mean.tolist() == [2.0, 7.0]
    assert target.norm.var.tolist() == [9.0, 1.0]
    target.norm.update(torch.tensor([3.0, 7.0]), torch.tensor([9.0, 1.0]), 4096)
    assert target.norm.mean[0] == pytest.approx(2 + 4096 / 104_096)


def test_networks_of_other_layers_are_refused():
    critic, other = (network_of(make_critic(3, hidden, "SiLU", False)) for hidden in ([4], [8]))
    with pytest.raises(CheckpointError, match=r"the critic's mlp\.0\.weight is \[8\], the config's \[4\]"):
        take_over(critic, other.state_dict(), {"a": 3}, {"a": 3}, "critic")
    deeper = network_of(make_critic(3, [4, 4], "SiLU", False))
    with pytest.raises(CheckpointError, match=r"has other parts than the config's: mlp\.4\.bias"):
        take_over(critic, deeper.state_dict(), {"a": 3}, {"a": 3}, "critic")


SMALL = (
    "num_envs=4", "num_threads=1", "algo.actor_hidden=[8]", "algo.critic_hidden=[8]", "algo.minibatches=1",
    "algo.frames_per_env=4", "total_frames=16", "logger=csv",
)  # fmt: skip


@pytest.fixture
def stub_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Start tables take seconds."""
    monkeypatch.setattr("hdmi.assembly.start_tables", lambda *_: None)


@pytest.mark.usefixtures("stub_starts")
def test_inputs_are_terms_in_the_order_of_the_network():
    cfg = load_config("task=walk")
    env = make_env(cfg, 1, make_task(cfg))
    inputs = network_inputs(env)
    assert set(inputs) == {"policy", "critic"}
    assert sum(inputs["policy"].values()) == env.full_observation_spec["policy"].shape[-1]
    assert list(inputs["policy"])[:2] == ["obs/phase", "obs/future_joint_pos"]
    assert inputs["policy"]["obs/root_ang_vel"] == 9  # with its history
    assert inputs["critic"]["obs/root_ang_vel"] == 3


@pytest.mark.usefixtures("stub_starts")
def test_a_training_starts_from_one_of_another_task(tmp_path: Path):
    first = Trainer(load_config("task=walk", *SMALL), tmp_path / "walk")
    first.run()
    policy = export_policy(tmp_path / "walk", tmp_path / "policy.pt")
    for source, networks in ((tmp_path / "walk", ["policy", "critic"]), (policy, ["policy"])):
        cfg = load_config("task=move_suitcase", *SMALL, f"warm_start={source}")
        trainer = Trainer(cfg, tmp_path / "suitcase")
        assert [taken.network for taken in trainer.taken] == networks
        assert "obs/object_pose" in trainer.taken[0].new
        weights = load_checkpoint(source)["actor"]
        for key, value in trainer.policy.state_dict().items():
            if "mlp.2" in key or "log_std" in key:
                assert torch.equal(value, weights[key])
        averaged = trainer.averaged.module.state_dict()
        assert all(torch.equal(averaged[key], value) for key, value in trainer.policy.state_dict().items())
        assert trainer.frames == 0


@pytest.mark.usefixtures("stub_starts")
def test_what_no_training_can_start_from_is_refused(tmp_path: Path):
    old = tmp_path / "old.pt"
    save_checkpoint(old, {"config": {}, "actor": {}})
    with pytest.raises(CheckpointError, match=r"warm_start: .*old\.pt: made by an older version"):
        Trainer(load_config("task=walk", *SMALL, f"warm_start={old}"), tmp_path / "run")
    with pytest.raises(CheckpointError, match=r"nowhere"):
        Trainer(load_config("task=walk", *SMALL, "warm_start=nowhere"), tmp_path / "run")
