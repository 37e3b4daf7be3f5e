"""Networks, PPO, checkpoints and logs."""

from hdmi.learning.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from hdmi.learning.networks import RunningNorm, make_actor, make_critic
from hdmi.learning.policy import export_policy, load_config, load_policy
from hdmi.learning.teacher import TeacherStudentTrainer
from hdmi.learning.trainer import Trainer, make_trainer

__all__ = [
    "CheckpointError",
    "RunningNorm",
    "TeacherStudentTrainer",
    "Trainer",
    "export_policy",
    "load_checkpoint",
    "load_config",
    "load_policy",
    "make_actor",
    "make_critic",
    "make_trainer",
    "save_checkpoint",
]
