"""A transformed environment whose steps and resets cost what they must."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

_ENVS_PER_THREAD = 4096  # with 2048, a second thread saves 0.4 ms of a step and costs physics 8


@contextmanager
def torch_threads(num_envs: int) -> Iterator[None]:
    """Lowers torch's threads to what tensors of so many rows can use, without changing them for good.

    Torch's threads wait for work by spinning, for milliseconds, on processors that physics wants. While worlds are
    stepped, a policy between the steps should therefore have no more of them than the environment.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(min(before, -(-num_envs // _ENVS_PER_THREAD)))
    try:
        yield
    finally:
        torch.set_num_threads(before)


class RowResetEnv(TransformedEnv):
    """A `TransformedEnv` that resets only rows: the stack sees a batch of the n environments that are done.

    TorchRL computes a reset for all N environments and keeps n of them; where few episodes end at a step, a deep stack
    then costs twice. Here base environment and transforms are given the n rows, with their numbers
    under `worlds` int64 [n], and results are written into copies of the others' tensors. `reset` itself is unchanged.

    While it steps, torch has one thread per 4096 environments; see `torch_threads`.

    `compile_transforms` compiles the stack with `torch.compile`.

    The base environment must have `reset_rows` (see `HumanoidObjectEnv`), and transforms must take the batch size
    from the tensordict.
    """

    def compile_transforms(self, **options: Any) -> None:
        """Compiles what the transforms do in a step and in a reset of rows; the stack must be complete.

        The first step and the first reset then take about a minute each. Actions on their way in, a reset of all
        environments and of a single one stay as they are.

        Args:
            options: of `torch.compile`.
        """
        step = torch.compile(self.transform._step, dynamic=False, **options)
        reset = torch.compile(self.transform._reset, dynamic=True, **options)

        # under the same gradient mode whoever steps the environment: another one would be compiled again
        @torch.no_grad()
        def compiled_step(tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
            return step(tensordict, next_tensordict)

        @torch.no_grad()
        def compiled_reset(tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
            # Only the number of rows varies. It must not be tied to sizes and offsets that happen to equal it: copies
            # have no offsets, and the other sizes are declared fixed.
            tensordict, tensordict_reset = tensordict.clone(), tensordict_reset.clone()
            for value in (*tensordict.values(True, True), *tensordict_reset.values(True, True)):
                torch._dynamo.mark_static(value, list(range(1, value.ndim)))
            return reset(tensordict, tensordict_reset)

        self.transform._step = compiled_step  # type: ignore[method-assign]
        self._reset_transforms = compiled_reset  # type: ignore[method-assign]

    def _reset_transforms(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self.transform._reset(tensordict, tensordict_reset)

    def step(self, tensordict: TensorDictBase) -> TensorDictBase:
        with torch_threads(self.base_env.batch_size.numel()):
            return super().step(tensordict)

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not self.any_done(tensordict):
            return tensordict
        worlds = tensordict.get("_reset").reshape(-1).nonzero().squeeze(-1)
        with torch_threads(len(worlds)):  # taking rows out of large tensors would wake the others already
            part = tensordict[worlds].set("worlds", worlds)
            tensordict = tensordict.exclude("_reset")
            part = self.transform._reset_env_preprocess(part)
            # a kernel for n rows would be compiled anew for one
            reset = self._reset_transforms if len(worlds) > 1 else self.transform._reset
            fresh = reset(part, self.base_env.reset_rows(part))
            for key, value in fresh.items(True, True):
                # out of place: the collector keeps references to the last step's tensors
                tensordict.set(key, tensordict.get(key).index_copy(0, worlds, value))
        return tensordict


class MaskedResetEnv(RowResetEnv):
    """A `TransformedEnv` whose steps and resets never wait for the device.

    How many environments are done is known on the device only. The stack therefore computes a reset of all of them in
    every step, in tensors of fixed size, and a mask says whose results count. On a CPU, where asking costs nothing,
    steps in which nobody is done are left alone.
    """

    def compile_transforms(self, **options: Any) -> None:
        """Compiles what the transforms do in a step and in a reset; the stack must be complete.

        Args:
            options: of `torch.compile`.
        """
        for name in ("_step", "_reset"):
            compiled = torch.compile(getattr(self.transform, name), dynamic=False, **options)
            setattr(self.transform, name, torch.no_grad()(compiled))

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        done = tensordict.get("done")
        if done.device.type == "cpu" and not done.any():
            return tensordict
        part = self.transform._reset_env_preprocess(tensordict.copy())
        fresh = self.transform._reset(part, self.base_env._reset(part.copy().set("_reset", done)))
        tensordict, mask = tensordict.copy(), done.reshape(-1)
        for key, value in fresh.items(True, True):
            chosen = mask.reshape(-1, *[1] * (value.ndim - 1))
            tensordict.set(key, torch.where(chosen, value, tensordict.get(key)))
        return tensordict
