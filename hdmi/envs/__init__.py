"""One batched TorchRL environment over a small physics-backend interface."""

from hdmi.envs.backend import BatchBackend, PhysicsBackend
from hdmi.envs.humanoid import HumanoidObjectEnv
from hdmi.envs.resets import MaskedResetEnv, ResetEnv, RowResetEnv
from hdmi.envs.stepping import Keep, Stack

__all__ = [
    "BatchBackend",
    "HumanoidObjectEnv",
    "Keep",
    "MaskedResetEnv",
    "PhysicsBackend",
    "ResetEnv",
    "RowResetEnv",
    "Stack",
]
