"""Transformed environments whose resets cost what they must."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, EnvBase, Transform

from hdmi.envs.stepping import SteppedEnv
from hdmi.names import FRAME_KEY, NOISE_SHARE_KEY
from hdmi.threads import torch_threads

# TorchRL's transforms that are about all environments in every reset: they keep something of each in themselves, or
# make entries of all. Name -> what does the same here.
_OF_ALL_ENVIRONMENTS = {
    "ActionMask": "a policy that reads the mask",
    "CatFrames": "hdmi.transforms.History",
    "ConditionalPolicySwitch": "a policy that decides by itself",
    "RandomTruncationTransform": "hdmi.transforms.ReferenceStateInitialization, which spreads starts over the motion",
    "TensorDictPrimer": "a subclass of hdmi.transforms.common.StateTransform",
    "TimeMaxPool": "hdmi.transforms.History",
    "VecNormV2": "reduce_batch_dims=True, or hdmi.learning.RunningNorm in the networks",
}


class ResetEnv(SteppedEnv):
    """Base of a `TransformedEnv` that draws starts again where they are too deep; see its two kinds.

    A start in which the object's deepest contact exceeds `max_penetration` is drawn again, up to `redraws` times: first
    from the same frame, each time with less of its noise and then with none, then from other frames without noise (see
    `ReferenceStateInitialization`). How many were is counted in `num_redrawn`, and how many stayed too deep all the
    same in `num_deep`.

    The base environment must have `place` and `show`, and `penetration` if anything is to be drawn again (see
    `HumanoidObjectEnv`). Transforms are given state and flags of the end of the episodes that ended; they must take the
    batch size from the tensordict and keep nothing of single environments in themselves.

    Args:
        env, transform, envs_per_thread: as for `SteppedEnv`.
        max_penetration: m.
        redraws: at most; with 0 every start is taken as it comes.

    Raises:
        TypeError: for a transform of TorchRL's that a reset of some environments would corrupt; says what to use.

    Examples:
        >>> from torchrl.envs import CatFrames, Compose
        >>> from hdmi.assets import RobotConfig, SimConfig, build_scene
        >>> base = HumanoidObjectEnv(build_scene(RobotConfig(), SimConfig()), num_envs=1)
        >>> try:
        ...     RowResetEnv(base, Compose(CatFrames(2, -1, in_keys=[("robot", "joint_pos")])))
        ... except TypeError as error:
        ...     print("History" in str(error))
        True
    """

    def __init__(
        self,
        env: EnvBase,
        transform: Transform,
        *,
        envs_per_thread: int | None = None,
        max_penetration: float = 0.02,
        redraws: int = 0,
    ):
        check_row_resets(transform)
        super().__init__(env, transform, envs_per_thread=envs_per_thread)
        self.max_penetration, self.redraws = max_penetration, redraws
        self._counts = torch.zeros(2, dtype=torch.int64, device=env.device)

    @property
    def num_redrawn(self) -> int:
        """Starts that were drawn again so far. Reading it waits for the device."""
        return int(self._counts[0])

    @property
    def num_deep(self) -> int:
        """Starts so far whose last drawing, too, was too deep. Reading it waits for the device."""
        return int(self._counts[1])

    def append_transform(self, transform: Any) -> Any:
        check_row_resets(transform)
        return super().append_transform(transform)

    def insert_transform(self, index: int, transform: Transform) -> Any:
        check_row_resets(transform)
        return super().insert_transform(index, transform)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        keys = [*self.reset_keys, *self.full_state_spec.keys(True, True)]
        tensordict = None if tensordict is None else tensordict.select(*keys, strict=False)
        start = self.transform._reset_env_preprocess(tensordict)
        fresh = self.base_env._reset(start, **kwargs)
        start = fresh.empty() if start is None else start
        if self.redraws:
            mask = start.get("_reset", None)
            if mask is None:
                mask = torch.ones(self.batch_size, dtype=torch.bool, device=self.device)
            self._redraw(start, mask.reshape(-1))
            fresh = self.base_env.show(slice(None))
        return self.transform._reset(start, fresh)

    @abstractmethod
    def _redraw(self, start: TensorDictBase, mask: Tensor) -> None:
        """Draws starts again where they are too deep, and writes into `start` where they are then.

        Args:
            start: what worlds were reset to, with `init`; batch [N].
            mask: which worlds are meant, bool [N].
        """

    def _too_deep(self, worlds: Tensor | slice = slice(None)) -> Tensor:
        return self.base_env.penetration()[worlds] > self.max_penetration

    def _again(self, start: TensorDictBase, attempt: int, rows: Tensor | slice = slice(None)) -> TensorDictBase:
        """Starts to draw again: what came before, how much of the noise is left, and in the first half the frame."""
        half = (self.redraws + 1) // 2
        share, frame = max(0.0, 1 - attempt / half), start.get(FRAME_KEY, None)
        again = start.exclude("init")[rows]
        again.set(NOISE_SHARE_KEY, torch.full((*again.batch_size, 1), share, device=start.device))
        if frame is not None and attempt <= half:
            again.set(FRAME_KEY, frame[rows])
        return again


class RowResetEnv(ResetEnv):
    """Resets only rows: the stack sees a batch of the n environments that are done.

    TorchRL computes a reset for all N environments and keeps n of them; where few episodes end at a step, a deep stack
    then costs twice. Here base environment and transforms are given the n rows, with their numbers
    under `worlds` int64 [n], and results are written into copies of the others' tensors. `reset` itself is unchanged.

    Examples:
        >>> from torchrl.envs import Compose, StepCounter
        >>> from hdmi.assets import RobotConfig, SimConfig, build_scene
        >>> base = HumanoidObjectEnv(build_scene(RobotConfig(), SimConfig()), num_envs=2)
        >>> env = RowResetEnv(base, Compose(StepCounter(max_steps=2)))
        >>> env.rollout(4, break_when_any_done=False)["next", "step_count"][0].flatten().tolist()
        [1, 2, 1, 2]
    """

    def _redraw(self, start: TensorDictBase, mask: Tensor) -> None:
        self._redraw_rows(start, *[mask.nonzero().squeeze(-1)] * 2)

    def _redraw_rows(self, start: TensorDictBase, worlds: Tensor, at: Tensor) -> None:
        """As `_redraw`, of the worlds of these numbers, which stand `at` these places in the batch. int64 [n]"""
        for attempt in range(1, self.redraws + 1):
            rows = self._too_deep(worlds).nonzero().squeeze(-1)
            if not len(rows):
                return
            self._counts[0] += len(rows)
            again = self._again(start, attempt, at[rows]).set("worlds", worlds[rows])
            again = self.transform._reset_env_preprocess(again)
            self.base_env.place(worlds[rows], again.get("init", None))
            if (frame := start.get(FRAME_KEY, None)) is not None:
                start.set(FRAME_KEY, frame.index_put((at[rows],), again.get(FRAME_KEY)))
        self._counts[1] += self._too_deep(worlds).sum()

    def compile_transforms(self, **options: Any) -> None:
        """Compiles the transforms; see `SteppedEnv`. Resets of all environments and of a single one stay as they are.

        Args:
            options: of `torch.compile`.
        """
        super().compile_transforms(**options)
        reset = torch.compile(self.transform._reset, dynamic=True, **options)

        @torch.no_grad()
        def compiled(tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
            # Only the number of rows varies. It must not be tied to sizes and offsets that happen to equal it: copies
            # have no offsets, and the other sizes are declared fixed.
            tensordict, tensordict_reset = tensordict.clone(), tensordict_reset.clone()
            for value in (*tensordict.values(True, True), *tensordict_reset.values(True, True)):
                torch._dynamo.mark_static(value, list(range(1, value.ndim)))
            return reset(tensordict, tensordict_reset)

        self._reset_transforms = compiled  # type: ignore[method-assign]

    def _reset_transforms(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self.transform._reset(tensordict, tensordict_reset)

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not self.any_done(tensordict):
            return tensordict
        worlds = tensordict.get("_reset").reshape(-1).nonzero().squeeze(-1)
        # taking rows out of large tensors would wake the other threads already
        with torch_threads(len(worlds), self.envs_per_thread):
            keys = [*self.reset_keys, *self.done_keys, *self.full_state_spec.keys(True, True)]
            part = tensordict.select(*keys, strict=False)[worlds].set("worlds", worlds)
            tensordict = tensordict.exclude("_reset")
            part = self.transform._reset_env_preprocess(part)
            self.base_env.place(worlds, part.get("init", None))
            if self.redraws:
                self._redraw_rows(part, worlds, torch.arange(len(worlds)))
            state = self.base_env.show(worlds)
            # a kernel for n rows would be compiled anew for one
            reset = self._reset_transforms if len(worlds) > 1 else self.transform._reset
            fresh = reset(part, state)
            for key, value in fresh.items(True, True):
                # out of place: the collector keeps references to the last step's tensors
                tensordict.set(key, tensordict.get(key).index_copy(0, worlds, value))
        return tensordict


class MaskedResetEnv(ResetEnv):
    """Resets without waiting for the device.

    How many environments are done is known on the device only. The stack therefore computes a reset of all of them in
    every step, in tensors of fixed size, and a mask says whose results count. On a CPU, where asking costs nothing,
    steps in which nobody is done are left alone.

    Examples:
        >>> from torchrl.envs import Compose, StepCounter
        >>> from hdmi.assets import RobotConfig, SimConfig, build_scene
        >>> base = HumanoidObjectEnv(build_scene(RobotConfig(), SimConfig()), num_envs=2)
        >>> env = MaskedResetEnv(base, Compose(StepCounter(max_steps=2)))
        >>> env.rollout(4, break_when_any_done=False)["next", "step_count"][0].flatten().tolist()
        [1, 2, 1, 2]
    """

    def _redraw(self, start: TensorDictBase, mask: Tensor) -> None:
        for attempt in range(1, self.redraws + 1):
            deep = mask & self._too_deep()
            self._counts[0] += deep.sum()
            again = self.transform._reset_env_preprocess(self._again(start, attempt))
            self.base_env.place(deep, again.get("init", None))
            if (frame := start.get(FRAME_KEY, None)) is not None:
                start.set(FRAME_KEY, torch.where(deep.unsqueeze(-1), again.get(FRAME_KEY), frame))
        self._counts[1] += (mask & self._too_deep()).sum()

    def compile_transforms(self, **options: Any) -> None:
        super().compile_transforms(**options)
        reset = torch.compile(self.transform._reset, dynamic=False, **options)
        self.transform._reset = torch.no_grad()(reset)  # type: ignore[method-assign]

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        done = tensordict.get("done")
        if done.device.type == "cpu" and not done.any():
            return tensordict
        mask = done.reshape(-1)
        part = self.transform._reset_env_preprocess(tensordict.copy())
        self.base_env.place(mask, part.get("init", None))
        if self.redraws:
            self._redraw(part, mask)
        state = self.base_env.show(slice(None))
        fresh, tensordict = self.transform._reset(part, state), tensordict.copy()
        for key, value in fresh.items(True, True):
            chosen = mask.reshape(-1, *[1] * (value.ndim - 1))
            tensordict.set(key, torch.where(chosen, value, tensordict.get(key)))
        return tensordict


def check_row_resets(transform: Any) -> None:
    """Checks that resets of some environments do not corrupt a transform, or those in it.

    Raises:
        TypeError: if they would; names it and what to use instead.
    """
    for part in _parts(transform):
        names = [cls.__name__ for cls in type(part).__mro__ if cls.__module__.startswith("torchrl.")]
        refused = [name for name in names if name in _OF_ALL_ENVIRONMENTS]
        if refused and not getattr(part, "reduce_batch_dims", False):  # statistics over all are of none
            raise TypeError(
                f"{type(part).__name__}: is about all environments in every reset, and this environment resets some "
                f"alone; use {_OF_ALL_ENVIRONMENTS[refused[0]]}"
            )


def _parts(transform: Any) -> Iterator[Any]:
    yield transform
    if isinstance(transform, Compose):
        for part in transform.transforms:
            yield from _parts(part)
