"""A transformed environment that steps with few threads, and whose transforms can be compiled."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, Transform, TransformedEnv

from hdmi.threads import torch_threads


class SteppedEnv(TransformedEnv):
    """A `TransformedEnv` that leaves processors to physics: while it steps, torch has few threads; see `torch_threads`.

    Args:
        env, transform: as for `TransformedEnv`.
        envs_per_thread: environments that are worth a thread of torch; None leaves torch's threads alone.
    """

    def __init__(self, env: EnvBase, transform: Transform, *, envs_per_thread: int | None = None):
        super().__init__(env, transform)
        self.envs_per_thread = envs_per_thread

    def step(self, tensordict: TensorDictBase) -> TensorDictBase:
        with torch_threads(self.base_env.batch_size.numel(), self.envs_per_thread):
            return super().step(tensordict)

    def compile_transforms(self, **options: Any) -> None:
        """Compiles what the transforms do in a step and in a reset; the stack must be complete.

        The first step and the first reset then take about a minute each. Actions on their way in stay as they are.

        Args:
            options: of `torch.compile`.
        """
        # under the same gradient mode whoever steps the environment: another one would be compiled again
        step = torch.compile(self.transform._step, dynamic=False, **options)
        self.transform._step = torch.no_grad()(step)  # type: ignore[method-assign]
