"""A teacher that sees everything, and the student that leaves the training."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.modules import ProbabilisticActor

from hdmi.learning.networks import network_of, normalised_actor
from hdmi.learning.policy import make_actor_of
from hdmi.learning.trainer import Objective, Trainer


class TeacherStudentTrainer(Trainer):
    """PPO of a teacher that sees what the critic sees; a student, distilled on the way, takes over and is tuned.

    For a share `algo.teacher_share` of `total_frames` the teacher acts and learns by PPO, while the student learns to
    act likewise on the states that the teacher comes to. Then the student acts and learns by PPO, and is still drawn to
    what the teacher would do, with a weight that falls from `algo.imitation` to zero. What is evaluated and leaves the
    training is the student all along.

    Examples:
        >>> from pathlib import Path
        >>> from omegaconf import open_dict
        >>> from hdmi.config import task_config
        >>> cfg = task_config("walk")
        >>> cfg.merge_with({"num_envs": 2, "num_threads": 1, "total_frames": 32, "logger": {"wandb": None}})
        >>> cfg.algo.merge_with({"frames_per_env": 8, "minibatches": 1, "actor_hidden": [8], "critic_hidden": [8]})
        >>> with open_dict(cfg):  # as algo=teacher_student does
        ...     cfg.algo.merge_with({"teacher_share": 0.5, "imitation": 1.0})
        >>> trainer = TeacherStudentTrainer(cfg, Path("run"))
        >>> trainer.run()
        2/2 reward ... steps/s
        >>> bool(trainer.roles.student_acts)
        True
    """

    def _acting(self) -> TensorDictModuleBase:
        self.teacher = make_actor_of(self.cfg, self.sizes["critic"], self.sizes["action"], self.device, "critic")
        # the same observation, and the same moments of it
        network_of(self.teacher).norm = network_of(self.critic).norm
        self.roles = TeacherOrStudent(self.teacher, self.policy)
        return self.roles

    def _objective(self) -> torch.nn.Module:
        of_teacher, of_student = (Objective(self._loss(actor)) for actor in (self.teacher, self.policy))
        self.lesson = _Lesson(of_teacher, of_student, normalised_actor(self.teacher), normalised_actor(self.policy))
        return self.lesson

    def _actors(self) -> list[torch.nn.Module]:
        return [self.teacher, self.policy]

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """As of `Trainer`; afterwards it may be the student's turn."""
        algo, lesson, total = self.cfg.algo, self.lesson, self.cfg.total_frames
        # a collector that overlaps with updates may still bring what the teacher did
        lesson.of_student = bool(batch["student_acts"].all())
        if lesson.of_student:
            left = max(1 - self.frames / total, 0.0) / (1 - algo.teacher_share)
            lesson.imitation = algo.imitation * min(left, 1.0)
        stats = super().update(batch)
        if not self.roles.student_acts and self.frames + batch.numel() * self.ranks.size >= algo.teacher_share * total:
            self.roles.hand_over()
        return {**stats, "student_acts": float(lesson.of_student)}


class TeacherOrStudent(TensorDictModuleBase):
    """Acts as one of two actors, and says which: `student_acts` bool [..., 1].

    Args:
        teacher, student: actors; the teacher's turn is first.
    """

    def __init__(self, teacher: ProbabilisticActor, student: ProbabilisticActor):
        super().__init__()
        self.in_keys = [*teacher.in_keys, *student.in_keys]
        self.out_keys = [*student.out_keys, "student_acts"]
        self.teacher, self.student = teacher, student
        self.student_acts: Tensor
        self.register_buffer("student_acts", torch.zeros((), dtype=torch.bool))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = (self.student if self.student_acts else self.teacher)(tensordict)
        return tensordict.set("student_acts", self.student_acts.expand(*tensordict.batch_size, 1).clone())

    @torch.no_grad()
    def hand_over(self) -> None:
        """From now on the student acts, with the teacher's noise."""
        self.student_acts.fill_(True)
        network_of(self.student).log_std.copy_(network_of(self.teacher).log_std)


class _Lesson(torch.nn.Module):
    """PPO's loss of whoever acted, and how far the student is from the teacher.

    Attributes:
        in_turns: some parameters have no part in a loss: the teacher's while the student acts.
    """

    in_turns = True

    def __init__(
        self,
        teacher_loss: Objective,
        student_loss: Objective,
        teacher: ProbabilisticActor,
        student: ProbabilisticActor,
    ):
        super().__init__()
        self.teacher_loss, self.student_loss = teacher_loss, student_loss
        self.teacher, self.student = teacher, student
        self.of_student, self.imitation = False, 1.0

    def forward(self, minibatch: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        total, losses = (self.student_loss if self.of_student else self.teacher_loss)(minibatch)
        with torch.no_grad():
            goal = self.teacher.get_dist(minibatch)
        mean = self.student.get_dist(minibatch).mean
        # the divergence of two Gaussians of the teacher's deviation
        apart = 0.5 * ((mean - goal.mean) / goal.base_dist.scale).square().sum(-1).mean()
        losses.set("imitation", apart.detach())
        return total + self.imitation * apart, losses
