"""Teacher and student: who acts, who learns what, and when the one takes over from the other."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from test_training import config, parameters

from hdmi.errors import ConfigError
from hdmi.learning import CheckpointError, TeacherStudentTrainer, Trainer, load_policy, make_actor, make_trainer
from hdmi.learning.networks import network_of
from hdmi.learning.teacher import TeacherOrStudent

ALGO = ("algo=teacher_student", "algo.teacher_share=0.5")


def weights(actor: torch.nn.Module) -> torch.Tensor:
    return torch.cat([p.detach().flatten().clone() for p in network_of(actor).mlp.parameters()])


@pytest.fixture
def pair() -> TeacherOrStudent:
    teacher, student = (
        make_actor(2, 1, [4], "Tanh", noise, False, key) for noise, key in ((0.5, "all"), (0.1, "some"))
    )
    return TeacherOrStudent(teacher, student)


def test_the_teacher_acts_until_it_hands_over(pair: TeacherOrStudent) -> None:
    seen = TensorDict({"all": torch.randn(3, 2), "some": torch.randn(3, 2)}, [3])
    first = pair(seen.clone())
    assert not first["student_acts"].any()
    assert torch.equal(first["loc"], pair.teacher(seen.clone())["loc"])
    pair.hand_over()
    then = pair(seen.clone())
    assert then["student_acts"].all()
    assert torch.equal(then["loc"], pair.student(seen.clone())["loc"])
    assert torch.allclose(then["scale"], torch.tensor(0.5))  # the teacher's noise


def test_imitation_is_the_divergence_of_the_two(tmp_path: Path) -> None:
    trainer = TeacherStudentTrainer(config(*ALGO), tmp_path)
    n = 3
    batch = TensorDict({key: torch.randn(n, trainer.sizes[key]) for key in ("policy", "critic", "action")}, [n])
    batch["action_log_prob"] = torch.zeros(n)
    for key in ("advantage", "value_target", "state_value"):
        batch[key] = torch.zeros(n, 1)
    total, losses = trainer.lesson(batch)
    goal = network_of(trainer.teacher).forward_normalised(batch["critic"])
    mean, _ = network_of(trainer.policy).forward_normalised(batch["policy"])
    expected = (0.5 * ((mean - goal[0]) / goal[1]).square().sum(-1)).mean()
    assert losses["imitation"].item() == pytest.approx(expected.item(), rel=1e-5)
    trainer.lesson.imitation = 0.0
    without, _ = trainer.lesson(batch)
    assert (total - without).item() == pytest.approx(expected.item(), rel=1e-4)
    trainer.collector.shutdown()


def test_the_student_learns_throughout_and_the_teacher_while_it_acts(tmp_path: Path) -> None:
    trainer = make_trainer(config(*ALGO), tmp_path)
    assert isinstance(trainer, TeacherStudentTrainer)
    moved = []
    for _ in range(4):  # of 32 frames, the teacher's are the first two
        before = weights(trainer.teacher), weights(trainer.policy)
        row = trainer.update(trainer.collector.next())
        trainer.frames += 32
        changed = [
            not torch.equal(a, weights(b)) for a, b in zip(before, (trainer.teacher, trainer.policy), strict=True)
        ]
        moved.append((row["student_acts"], *changed, trainer.lesson.imitation))
    trainer.collector.shutdown()
    assert moved == [(0.0, True, True, 1.0), (0.0, True, True, 1.0), (1.0, False, True, 1.0), (1.0, False, True, 0.5)]


def test_moments_are_those_of_the_critic(tmp_path: Path) -> None:
    trainer = TeacherStudentTrainer(config(*ALGO), tmp_path)
    assert network_of(trainer.teacher).norm is network_of(trainer.critic).norm
    assert network_of(trainer.policy).norm.count == network_of(trainer.critic).norm.count
    trainer.collector.shutdown()


def test_continues_exactly_across_the_change_of_roles(tmp_path: Path) -> None:
    straight = TeacherStudentTrainer(config(*ALGO), tmp_path / "straight")
    straight.run()
    first = TeacherStudentTrainer(config(*ALGO), tmp_path / "run")
    first.cfg.total_frames = 96  # as if it were interrupted, one iteration after the change
    first.cfg.algo.teacher_share = 64 / 96
    first.run()
    again = TeacherStudentTrainer(config(*ALGO, f"resume={tmp_path / 'run'}"), tmp_path / "run")
    assert again.iteration == 3
    assert bool(again.roles.student_acts)
    again.run()
    assert again.iteration == straight.iteration == 4
    for a, b in zip(parameters(straight), parameters(again), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)


def test_what_leaves_is_the_student(tmp_path: Path) -> None:
    trainer = make_trainer(config(*ALGO), tmp_path)
    trainer.run()
    policy, _, _ = load_policy(tmp_path)
    assert policy.in_keys == ["policy"]
    assert torch.equal(weights(policy), weights(trainer.averaged.module))
    with pytest.raises(CheckpointError, match=r"algo\.trainer"):
        Trainer(config(f"resume={tmp_path}"), tmp_path)


@pytest.mark.parametrize("path", ["hdmi.learning.nowhere", "hdmi.learning.RunningNorm"])
def test_what_is_no_trainer_is_named(path: str) -> None:
    with pytest.raises(ConfigError, match=rf"algo\.trainer: .*{path}"):
        make_trainer(config(f"+algo.trainer={path}"), Path("run"))


def test_parameters_are_the_actors_of_both(tmp_path: Path) -> None:
    trainer = TeacherStudentTrainer(config(*ALGO), tmp_path)
    count = sum(p.numel() for p in trainer.actor.parameters())
    assert count == sum(p.numel() for actor in (trainer.teacher, trainer.policy) for p in actor.parameters())
    assert len(parameters(trainer)) > 0
    trainer.collector.shutdown()
