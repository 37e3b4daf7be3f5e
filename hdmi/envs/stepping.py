"""A transformed environment that steps with few threads and many transforms, which can be compiled."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import Composite
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv

from hdmi.threads import torch_threads


class Stack(Compose):
    """A `Compose` of many transforms, which does not look up each by its number, as TorchRL's does on the way in.

    Most transforms leave actions and what a reset is given alone, which takes them less time than the look-up.

    Examples:
        >>> from torchrl.envs import ActionScaling
        >>> stack = Stack(ActionScaling(loc=1.0, scale=1.0), ActionScaling(loc=0.0, scale=2.0))
        >>> stack.inv(TensorDict({"action": torch.ones(1)}, []))["action"]  # the last one acts first
        tensor([3.])
    """

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        for transform in reversed([*self.transforms]):
            tensordict = transform._inv_call(tensordict)
        return tensordict

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase | None:
        for transform in reversed([*self.transforms]):
            tensordict = transform._reset_env_preprocess(tensordict)
        return tensordict


class Keep(Transform):
    """Keeps these entries of a step or a reset and drops all others, and what they leave empty.

    TorchRL's SelectTransform and RemoveEmptySpecs do the same, but in every step they ask the environment for its specs
    and sort what is there.

    Args:
        keys: of what is kept, rewards and flags of the end among them; one that is not there is left out.

    Examples:
        >>> td = TensorDict({"policy": torch.zeros(1, 2), "raw": {"x": torch.zeros(1)}, "done": torch.zeros(1, 1)}, [1])
        >>> sorted(Keep(["policy", "reward", "done"])(td).keys())
        ['done', 'policy']
    """

    def __init__(self, keys: Sequence[NestedKey]):
        super().__init__()
        self.keys = list(keys)

    def _call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.select(*self.keys, strict=False)

    forward = _call

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        kept = observation_spec.empty()
        for key in observation_spec.keys(True, True):
            if key in self.keys:
                kept[key] = observation_spec[key]
        return kept


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
