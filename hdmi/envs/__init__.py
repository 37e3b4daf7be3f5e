"""One batched TorchRL environment over a small physics-backend interface."""

from hdmi.envs.backend import BatchBackend, PhysicsBackend
from hdmi.envs.humanoid import HumanoidObjectEnv

__all__ = ["BatchBackend", "HumanoidObjectEnv", "PhysicsBackend"]
