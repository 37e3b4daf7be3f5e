"""What the transforms share: derived keys, state kept in the tensordict, specs inferred from the kernels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded, UnboundedDiscrete
from torchrl.envs import Transform


def spec_like(value: Tensor) -> TensorSpec:
    """An unbounded spec of a tensor's shape, dtype and device."""
    if value.dtype == torch.bool:
        return Binary(n=value.shape[-1], shape=value.shape, dtype=torch.bool, device=value.device)
    cls = Unbounded if value.dtype.is_floating_point else UnboundedDiscrete
    return cls(shape=value.shape, dtype=value.dtype, device=value.device)


def add_keys(spec: Composite, values: TensorDictBase, keys: Sequence[NestedKey]) -> Composite:
    """Adds to `spec` the specs of the named entries of `values`."""
    for key in keys:
        spec[unravel_key(key)] = spec_like(values.get(key))
    return spec


def without_drawing(method: Callable[[Any, Composite], Composite]) -> Callable[[Any, Composite], Composite]:
    """Keeps torch's random state: specs are computed at first use, which must not move a seeded run."""

    @wraps(method)
    def wrapped(self: Any, spec: Composite) -> Composite:
        with torch.random.fork_rng():
            return method(self, spec)

    return wrapped


class SpecTransform(Transform):
    """Base that edits specs in place.

    TorchRL's Transform copies all specs for each transform, which makes building a stack of n transforms over m keys
    cost n m tensors of the batch's size; the environment has copied them once already.
    """

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        for name, transform in (
            ("full_observation_spec", self.transform_observation_spec),
            ("full_reward_spec", self.transform_reward_spec),
            ("full_done_spec", self.transform_done_spec),
        ):
            output_spec[name] = transform(output_spec[name])
        return output_spec

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        input_spec["full_state_spec"] = self.transform_state_spec(input_spec["full_state_spec"])
        input_spec["full_action_spec"] = self.transform_action_spec(input_spec["full_action_spec"])
        return input_spec


class FunctionTransform(SpecTransform):
    """Writes `out_keys = function(*in_keys)` after every step and reset; specs follow from the function."""

    def __init__(self, in_keys: Sequence[NestedKey], out_keys: Sequence[NestedKey]):
        super().__init__(in_keys=list(in_keys), out_keys=list(out_keys))

    def function(self, *inputs: Tensor) -> Tensor | tuple[Tensor, ...]:
        """The tensor function; one output per out_key."""
        raise NotImplementedError

    def _call(self, tensordict: TensorDictBase) -> TensorDictBase:
        # functions see one batch dimension, whatever the batch
        batch = tensordict.batch_size
        inputs = [tensordict.get(key) for key in self.in_keys]
        if len(batch) != 1:
            inputs = [value.reshape(-1, *value.shape[len(batch) :]) for value in inputs]
        outputs = self.function(*inputs)
        outputs = (outputs,) if isinstance(outputs, Tensor) else outputs
        for key, value in zip(self.out_keys, outputs, strict=True):
            tensordict.set(key, value if len(batch) == 1 else value.reshape(*batch, *value.shape[1:]))
        return tensordict

    forward = _call

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    @without_drawing
    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        inputs = TensorDict({}, batch_size=observation_spec.shape, device=observation_spec.device)
        for key in self.in_keys:
            if unravel_key(key) not in observation_spec.keys(True, True):
                raise KeyError(
                    f"{type(self).__name__}: reads {key!r}, which nothing before it writes; "
                    f"there is {sorted(map(str, observation_spec.keys(True, True)))}"
                )
            inputs.set(key, observation_spec[unravel_key(key)].zero())
        return add_keys(observation_spec, self._call(inputs), self.out_keys)


class StateTransform(SpecTransform):
    """Base of transforms that carry state from step to step in the tensordict, never in themselves.

    Subclasses give `initial_state`; its keys become observation keys (so that they travel on) and state keys (so
    that a parallel environment sends them back to its workers).
    """

    def initial_state(self, batch_size: torch.Size, device: torch.device | None) -> dict[NestedKey, Tensor]:
        """State of fresh episodes, for all rows."""
        raise NotImplementedError

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        # for all rows: TorchRL keeps those of the environments that reset
        for key, value in self.initial_state(tensordict_reset.batch_size, tensordict_reset.device).items():
            tensordict_reset.set(key, value)
        return tensordict_reset

    @without_drawing
    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        for key, value in self.initial_state(observation_spec.shape, observation_spec.device).items():
            observation_spec[unravel_key(key)] = spec_like(value)
        return observation_spec

    @without_drawing
    def transform_input_spec(self, input_spec: Composite) -> Composite:
        input_spec = super().transform_input_spec(input_spec)
        state = self.initial_state(input_spec.shape, input_spec.device)
        return add_state_specs(input_spec, {key: spec_like(value) for key, value in state.items()})

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise NotImplementedError(
            f"{type(self).__name__} carries state from step to step and works in an environment only"
        )


def add_state_specs(input_spec: Composite, specs: Mapping[NestedKey, TensorSpec]) -> Composite:
    """Declares keys that a step reads from the tensordict besides the action."""
    if input_spec["full_state_spec"] is None:
        input_spec["full_state_spec"] = Composite(shape=input_spec.shape, device=input_spec.device)
    for key, spec in specs.items():
        input_spec[unravel_key(("full_state_spec", key))] = spec
    return input_spec


def soft_limits(limits: Sequence[Sequence[float]], share: float) -> tuple[Tensor, Tensor]:
    """Ends of a share of each range, about its middle. [J, 2] -> [J], [J]"""
    low, high = torch.tensor([list(pair) for pair in limits], dtype=torch.float32).unbind(-1)
    middle, half = (low + high) / 2, (high - low) / 2 * share
    return middle - half, middle + half


def set_terminated(next_tensordict: TensorDictBase, flag: Tensor, key: str = "terminated") -> None:
    """Raises `terminated` (or `truncated`) where `flag`, and `done` with it: `any_done` reads only `done`."""
    present = next_tensordict.get(key, None)
    next_tensordict.set(key, flag if present is None else present | flag)
    next_tensordict.set("done", next_tensordict.get("done") | flag)
