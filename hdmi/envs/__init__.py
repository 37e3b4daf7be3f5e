"""One batched TorchRL environment over a small physics-backend interface."""

from hdmi.envs.backend import BatchBackend, PhysicsBackend
from hdmi.envs.humanoid import HumanoidObjectEnv
from hdmi.envs.resets import MaskedResetEnv, ResetEnv, RowResetEnv

__all__ = ["BatchBackend", "HumanoidObjectEnv", "MaskedResetEnv", "PhysicsBackend", "ResetEnv", "RowResetEnv"]
