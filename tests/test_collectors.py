"""Collection by workers: their batches, the age of the policy in them, and what continues exactly."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy

import pytest
import torch
from mocks import lift_box
from tensordict import TensorDictBase
from test_training import config

from hdmi.config import ConfigError
from hdmi.learning import CheckpointError, Trainer, load_checkpoint
from hdmi.learning.collectors import InlineCollector, ProcessCollector
from hdmi.transforms import ResetNoiseCurriculum

pytestmark = pytest.mark.xdist_group("collectors")  # its runs are made once, not in each process

WORKERS = ("collector.num_workers=2", "collector.threads_per_worker=1")
# every step ends an episode, by failure
FAILING = ("reset=adaptive", "termination.root_pose.thresholds=[-1.0,-1.0]", "termination.root_pose.min_steps=1")

RayRun = tuple[list[TensorDictBase], list[torch.nn.Module], dict]


@pytest.fixture(scope="module")
def trainer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Trainer]:
    """Two processes of two worlds each, which wait while the learner updates. Tests leave it as it was saved."""
    folder = tmp_path_factory.mktemp("process")
    trainer = Trainer(config("collector=process", *WORKERS, "collector.overlap=false", "reset=adaptive"), folder)
    trainer.update(trainer.collector.next())
    trainer.save()
    yield trainer
    trainer.collector.shutdown()


def weights(trainer: Trainer) -> dict[str, torch.Tensor]:
    state = {**trainer.actor.state_dict(prefix="actor."), **trainer.critic.state_dict(prefix="critic.")}
    return {name: value.clone() for name, value in state.items()}


def iterate(trainer: Trainer, count: int) -> list[TensorDictBase]:
    """Batches of so many iterations."""
    batches = []
    for _ in range(count):
        batches.append(trainer.collector.next())
        trainer.update(batches[-1].clone())
    return batches


def restored(trainer: Trainer) -> Trainer:
    trainer.restore(load_checkpoint(trainer.folder))
    return trainer


def assert_from_policy(batch: TensorDictBase, actor: torch.nn.Module) -> None:
    """The batch's actions are of this actor, whose observation moments are part of it."""
    with torch.no_grad():
        loc, scale = actor.module[0].module(batch["policy"])
    torch.testing.assert_close(batch["loc"], loc, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(batch["scale"], scale)


def test_what_changes_with_time_does_so_in_workers_as_in_their_rank(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two ranks, each is through with its own half of the frames."""
    for module in ("assembly", "learning.collectors"):
        monkeypatch.setattr(f"hdmi.{module}.num_ranks", lambda: 2)
    cfg = config("+lever=noise_curriculum", "total_frames=160")  # of 4 worlds: 20 steps on each of the ranks
    collector = ProcessCollector(cfg, lift_box(), 0, num_workers=2, threads_per_worker=1)
    monkeypatch.setattr("hdmi.assembly.num_ranks", lambda: 1)  # nobody has told the worker
    for env in (collector.env, collector._make_envs[0]()):
        (curriculum,) = (t for t in env.transform if isinstance(t, ResetNoiseCurriculum))
        assert (curriculum.hold_steps, curriculum.grow_steps) == pytest.approx((8.0, 6.0))


def test_batches_are_rows_of_contiguous_steps(trainer: Trainer) -> None:
    first, second = iterate(restored(trainer), 2)
    assert first.batch_size == second.batch_size == (4, 8)
    both = torch.cat([first, second], dim=1)
    going_on = ~both["next", "done"][:, :-1, 0]
    assert going_on.any()
    for key in ("policy", "critic", ("ref", "step"), "step_count", "episode_reward"):
        assert torch.equal(both["next"][:, :-1].get(key)[going_on], both[:, 1:].get(key)[going_on]), key
    assert not torch.equal(both["policy"][:2], both["policy"][2:])  # other worlds, other noise


def test_without_overlap_each_batch_is_on_policy(trainer: Trainer) -> None:
    restored(trainer)
    for _ in range(2):
        actor = deepcopy(trainer.actor)
        batch = trainer.collector.next()
        assert_from_policy(batch, actor)
        trainer.update(batch)


def test_continues_exactly(trainer: Trainer) -> None:
    batches = iterate(restored(trainer), 2)
    reached = weights(trainer)
    again = iterate(restored(trainer), 2)
    for one, other in zip(batches, again, strict=True):
        assert torch.equal(one["next", "policy"], other["next", "policy"])
    for name, value in weights(trainer).items():
        assert torch.equal(value, reached[name]), name


def test_another_number_of_workers_or_worlds_is_refused(trainer: Trainer) -> None:
    state = load_checkpoint(trainer.folder)["ranks"][0]
    with pytest.raises(CheckpointError, match=r"1 workers.*num_workers=2"):
        trainer.collector.load_state_dict({"workers": state["workers"][:1]})
    with pytest.raises(CheckpointError, match="collector=inline"):
        trainer.collector.load_state_dict(state["workers"][0])
    inline = InlineCollector(config(), trainer.task)
    with pytest.raises(CheckpointError, match="2 workers"):
        inline.load_state_dict(state)


def test_worlds_that_cannot_be_shared_are_refused(trainer: Trainer) -> None:
    with pytest.raises(ConfigError, match=r"collector.num_workers: 3 do not share num_envs=4"):
        ProcessCollector(config(), trainer.task, seed=0, num_workers=3)


@pytest.fixture(scope="module")
def ray_run(tmp_path_factory: pytest.TempPathFactory) -> RayRun:
    """A local Ray cluster: batches of three iterations and two from the state after them, the policies that waited for
    them, and the state."""
    pytest.importorskip("ray")
    trainer = Trainer(config("collector=ray", "collector.num_workers=1", *FAILING), tmp_path_factory.mktemp("ray"))
    batches, actors = [], []
    for _ in range(3):
        actors.append(deepcopy(trainer.actor))
        batches += iterate(trainer, 1)
    state = trainer.collector.state_dict()
    for _ in range(2):
        trainer.collector.load_state_dict(state)
        batches.append(trainer.collector.next())
    trainer.collector.shutdown()
    return batches, actors, state


def test_with_overlap_batches_are_one_update_older(ray_run: RayRun) -> None:
    batches, actors, _ = ray_run
    assert batches[0].batch_size == (4, 8)
    for batch, actor in zip(batches[:3], [actors[0], *actors[:2]], strict=True):
        assert_from_policy(batch, actor)
    with pytest.raises(AssertionError):
        assert_from_policy(batches[2], actors[2])


def test_continues_from_the_end_of_the_rollout_under_way(ray_run: RayRun) -> None:
    (*_, last, one, other), _, _ = ray_run
    assert torch.equal(one["next", "policy"], other["next", "policy"])
    assert not torch.equal(one["next", "policy"], last["next", "policy"])


@pytest.mark.slow
def test_adaptive_starts_count_the_failures_in_workers(ray_run: RayRun) -> None:
    batches, _, state = ray_run
    batches = batches[:3]
    assert all(batch["next", "terminated"].all() for batch in batches)
    (worker,) = state["workers"]
    (failures,) = [value for key, value in worker["transforms"].items() if key.endswith("failures")]
    # four worlds that fail in each of 8 steps of three batches and of one under way
    assert 120 < float(failures.sum()) <= 128
