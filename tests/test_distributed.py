"""Two ranks on this machine: they stay equal, and learn what one process learns from both their data."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from test_training import ROOT, config

from hdmi.learning import CheckpointError, RunningNorm, Trainer, load_checkpoint, make_trainer
from hdmi.learning.distributed import Ranks

pytestmark = pytest.mark.xdist_group("ranks")  # its runs are made once, not in each process

ONE_STEP = ("algo.epochs=1", "algo.minibatches=1")
OBSERVED = ("policy", "critic", "action", "action_log_prob", "scale", "next")


def weights(trainer: Trainer) -> dict[str, torch.Tensor]:
    return {**trainer.actor.state_dict(prefix="actor."), **trainer.critic.state_dict(prefix="critic.")}


def gradients(trainer: Trainer) -> list[torch.Tensor]:
    return [p.grad for net in (trainer.actor, trainer.critic) for p in net.parameters()]


def work(folder: Path) -> None:
    """What each rank does under torchrun; leaves its results in the folder."""
    given = torch.load(folder / "given.pt", weights_only=True)
    trainer = Trainer(config(*ONE_STEP), folder / "one_step")
    rank = trainer.ranks.rank
    start = weights(trainer)
    trainer.actor.load_state_dict(given["actor"])
    trainer.critic.load_state_dict(given["critic"])
    trainer.update(TensorDict(given["halves"][rank], batch_size=[4, 8]))
    stepped = {"start": start, "gradients": gradients(trainer), "weights": weights(trainer)}
    trainer.collector.shutdown()

    trainer = Trainer(config(), folder / "run")
    trainer.run()
    qpos = trainer.env.base_env.get_state()["backend", "data/qpos"]
    run = {"weights": weights(trainer), "frames": trainer.frames, "qpos": qpos}

    Trainer(config("total_frames=64"), folder / "half").run()
    torch.distributed.barrier()  # the first rank writes the checkpoint, the other one would look for it too early
    trainer = Trainer(config(f"resume={folder / 'half'}"), folder / "half")
    trainer.run()
    resumed = {"weights": weights(trainer), "qpos": trainer.env.base_env.get_state()["backend", "data/qpos"]}

    trainer = make_trainer(config("algo=teacher_student", "algo.teacher_share=0.5"), folder / "taught")
    trainer.run()
    taught = {"weights": weights(trainer)}

    trainer = Trainer(config("reward=hdmi_2025", f"task.episode_steps={(5, 3)[rank]}"), folder / "grouped")
    counts, step = [], trainer._step

    def counted(minibatch: TensorDictBase) -> dict[str, float] | None:
        counts.append(len(minibatch))
        return step(minibatch)

    trainer._step = counted
    trainer.run()
    moments = trainer.ranks.moments(torch.tensor(([1.0, 2.0, 3.0], [6.0])[rank]))
    grouped = {"weights": weights(trainer), "moments": moments, "counts": counts}
    results = {"stepped": stepped, "run": run, "resumed": resumed, "taught": taught, "grouped": grouped}
    torch.save(results, folder / f"rank{rank}.pt")


@pytest.fixture(scope="module")
def ranks(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Trainer, list[dict]]:
    """The folder of two ranks, a process alone on the union of their data, and what the ranks leave."""
    folder = tmp_path_factory.mktemp("ranks")
    alone = Trainer(config("num_envs=8", *ONE_STEP), folder / "alone")
    with torch.no_grad():
        batch = alone.collector.next().select(*OBSERVED)
    halves = [batch[:4].contiguous().to_dict(), batch[4:].contiguous().to_dict()]
    torch.save(
        {"actor": alone.actor.state_dict(), "critic": alone.critic.state_dict(), "halves": halves}, folder / "given.pt"
    )
    alone.update(batch)
    alone.collector.shutdown()
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", __file__]
    result = subprocess.run([*command, str(folder)], capture_output=True, text=True, cwd=ROOT / "tests", timeout=300)
    assert result.returncode == 0, result.stderr[-3000:]
    return folder, alone, [torch.load(folder / f"rank{i}.pt", weights_only=True) for i in range(2)]


def test_ranks_start_and_stay_equal(ranks: tuple[Path, Trainer, list[dict]]) -> None:
    _, _, (first, second) = ranks
    for results in ("stepped", "run"):
        for name, value in first[results]["weights"].items():
            assert torch.equal(value, second[results]["weights"][name]), name
    parameters = [name for name in first["stepped"]["start"] if ".mlp." in name]
    assert parameters
    assert all(torch.equal(first["stepped"]["start"][n], second["stepped"]["start"][n]) for n in parameters)
    assert not torch.equal(first["run"]["qpos"], second["run"]["qpos"])  # other worlds, other noise


def test_teacher_and_student_stay_equal(ranks: tuple[Path, Trainer, list[dict]]) -> None:
    first, second = (rank["taught"]["weights"] for rank in ranks[2])
    assert first["actor.student_acts"]
    for name, value in first.items():
        assert torch.equal(value, second[name]), name


def test_of_unequal_numbers_of_steps_they_learn_from_as_many(ranks: tuple[Path, Trainer, list[dict]]) -> None:
    """Without first steps, whose number differs, and with a value for each group of rewards."""
    first, second = (rank["grouped"] for rank in ranks[2])
    # of 32 steps in an iteration, 8 are the first of an episode on one rank, 12 on the other: two minibatches of 20
    assert first["counts"] == second["counts"] == [10] * 8
    for name, value in first["weights"].items():
        assert torch.equal(value, second["weights"][name]), name
    assert [float(x) for x in first["moments"]] == [float(x) for x in second["moments"]] == [3.0, 3.5]


def test_learn_what_one_process_learns_from_the_union(ranks: tuple[Path, Trainer, list[dict]]) -> None:
    _, alone, (first, _) = ranks
    for got, expected in zip(first["stepped"]["gradients"], gradients(alone), strict=True):
        torch.testing.assert_close(got, expected, rtol=1e-3, atol=1e-5)
    for name, value in weights(alone).items():
        if ".norm." in name:
            torch.testing.assert_close(first["stepped"]["weights"][name], value, rtol=1e-4, atol=1e-5)


def test_the_first_rank_leaves_one_run(ranks: tuple[Path, Trainer, list[dict]]) -> None:
    folder, _, (first, _) = ranks
    assert first["run"]["frames"] == 128
    assert len((folder / "run" / "metrics.csv").read_text().splitlines()) == 1 + 2
    state = load_checkpoint(folder / "run")
    assert state["frames"] == 128
    own = [rank["env"]["backend"]["data/qpos"] for rank in state["ranks"]]
    assert len(own) == 2
    assert not torch.equal(*own)


def test_resuming_continues_every_rank(ranks: tuple[Path, Trainer, list[dict]]) -> None:
    for results in ranks[2]:
        assert torch.equal(results["resumed"]["qpos"], results["run"]["qpos"])
        for name, value in results["run"]["weights"].items():
            assert torch.equal(results["resumed"]["weights"][name], value), name


def test_resuming_with_other_ranks_is_refused(ranks: tuple[Path, Trainer, list[dict]]) -> None:
    folder, _, _ = ranks
    with pytest.raises(CheckpointError, match="2 ranks"):
        Trainer(config(f"resume={folder / 'run'}"), folder / "resumed")


def test_alone_statistics_are_its_own() -> None:
    values = torch.tensor([[1.0, 4.0], [3.0, 0.0]])
    mean, variance = Ranks().moments(values)
    assert mean.tolist() == [2.0, 2.0]
    assert variance.tolist() == [1.0, 4.0]
    assert Ranks().mean_row({"a": 1.0}) == {"a": 1.0}
    assert Ranks().gather({"a": 1}) == [{"a": 1}]


def test_processors_are_shared_by_the_ranks_of_a_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 8)
    assert [Ranks(local_size=n).threads(0) for n in (1, 2, 3, 16)] == [0, 4, 2, 1]
    assert Ranks(local_size=2).threads(3) == 3


def test_running_norm_adds_moments() -> None:
    norm = RunningNorm(1)
    norm.update(torch.tensor([2.0]), torch.tensor([1.0]), n=2)
    assert (norm.mean.item(), norm.var.item(), norm.count.item()) == (2.0, 1.0, 2)


if __name__ == "__main__":
    work(Path(sys.argv[1]))
