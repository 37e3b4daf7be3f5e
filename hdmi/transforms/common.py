"""What the transforms share: derived keys, state kept in the tensordict, specs inferred from the kernels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from inspect import signature
from pkgutil import resolve_name
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


def key_of(key: NestedKey | Sequence[str]) -> NestedKey:
    """A nested key that may have come from a config as a list."""
    return key if isinstance(key, str) else unravel_key(tuple(key))


def below(key: NestedKey | Sequence[str], *names: NestedKey) -> NestedKey:
    """The nested key of an entry under another: `below(("a", "b"), "c") == ("a", "b", "c")`."""
    return unravel_key((key_of(key), *names))


def copied(spec: Composite) -> Composite:
    """A copy whose entries may be replaced; the specs of tensors are shared, since transforms replace them whole."""
    out = spec.empty()
    for key, value in spec.items():
        out[key] = copied(value) if isinstance(value, Composite) else value
    return out


class SpecTransform(Transform):
    """Base whose `transform_*_spec` return copies and leave what they are given alone.

    TorchRL's Transform clones all specs, tensors of the batch's size included, for each transform, so that a stack of
    n transforms over m keys takes n m tensors to build; here only the structure is copied.

    Attributes:
        training_only: whether a policy that has left the trainer does without it: noise, delays, randomization.
    """

    training_only = False

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        output_spec = copied(output_spec)
        for name, transform in (
            ("full_observation_spec", self.transform_observation_spec),
            ("full_reward_spec", self.transform_reward_spec),
            ("full_done_spec", self.transform_done_spec),
        ):
            output_spec[name] = transform(output_spec[name])
        return output_spec

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        input_spec = copied(input_spec)
        input_spec["full_state_spec"] = self.transform_state_spec(input_spec["full_state_spec"])
        input_spec["full_action_spec"] = self.transform_action_spec(input_spec["full_action_spec"])
        return input_spec


class FunctionTransform(SpecTransform):
    """Writes `out_keys = function(*in_keys)` after every step and reset; specs follow from the function."""

    def __init__(self, in_keys: Sequence[NestedKey], out_keys: Sequence[NestedKey]):
        super().__init__(in_keys=[key_of(key) for key in in_keys], out_keys=[key_of(key) for key in out_keys])

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
        observation_spec = copied(observation_spec)
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

    @property
    def own_keys(self) -> list[NestedKey]:
        """Keys of the state."""
        with torch.random.fork_rng():  # it may be drawn
            return list(self.initial_state(torch.Size([1]), None))

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
        observation_spec = copied(observation_spec)
        for key, value in self.initial_state(observation_spec.shape, observation_spec.device).items():
            add_state(observation_spec, key, value, self)
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


def add_state(observation_spec: Composite, key: NestedKey, value: Tensor, owner: Transform) -> None:
    """Adds the spec of an entry in which a transform keeps state.

    Raises:
        ValueError: if something before it writes an entry of that key: each needs one of its own.
    """
    if unravel_key(key) in observation_spec.keys(True, True):
        raise ValueError(
            f"{type(owner).__name__}: its state would be kept at {key!r}, which something before it writes already; "
            "give it another key"
        )
    observation_spec[unravel_key(key)] = spec_like(value)


def add_read_state(input_spec: Composite, owner: Transform, keys: Sequence[NestedKey]) -> Composite:
    """Declares what a transform reads of the present step besides the action, in place; specs are those of the writers.

    Raises:
        KeyError: for a key that nothing before the transform writes.
    """
    declared = input_spec["full_state_spec"]
    missing = [key for key in keys if declared is None or unravel_key(key) not in declared.keys(True, True)]
    if not missing or owner.parent is None:
        return input_spec
    have = owner.parent.full_observation_spec
    for key in missing:
        if unravel_key(key) not in have.keys(True, True):
            raise KeyError(f"{type(owner).__name__}: reads {key!r}, which nothing before it writes")
    return add_state_specs(input_spec, {key: have[unravel_key(key)].clone() for key in missing})


def add_state_specs(input_spec: Composite, specs: Mapping[NestedKey, TensorSpec]) -> Composite:
    """Declares keys that a step reads from the tensordict besides the action, in place."""
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


def raise_done(next_tensordict: TensorDictBase, flag: Tensor, key: NestedKey, done_key: NestedKey) -> None:
    """Raises `terminated` (or `truncated`) where `flag`, and `done` with it: `any_done` reads only `done`."""
    present = next_tensordict.get(key, None)
    next_tensordict.set(key, flag if present is None else present | flag)
    next_tensordict.set(done_key, next_tensordict.get(done_key) | flag)


class BoundKernel(torch.nn.Module):
    """A tensor function with its parameters; tensors among them move with the module.

    Args:
        function: itself, or its dotted name.
        num_inputs: tensors that it will be called with.
        where: for messages.
        parameters: keyword arguments; tensors stay tensors, everything else stays what it is.

    Raises:
        ValueError: if there is no such function, or it does not take such a call.
    """

    def __init__(
        self, function: Callable[..., Tensor] | str, num_inputs: int, where: str, parameters: Mapping[str, Any]
    ):
        super().__init__()
        if isinstance(function, str):
            try:
                function = resolve_name(function)
            except (ImportError, AttributeError, ValueError) as error:
                raise ValueError(f"{where}: there is no function {function!r}: {error}") from error
        if not callable(function):
            raise ValueError(f"{where}: {function!r} is no function")
        self.function, self.name = function, getattr(function, "__name__", type(function).__name__)
        try:
            taken = signature(function)
        except ValueError:  # of a function in C, which does not say what it takes
            taken = None
        try:
            if taken is not None:
                taken.bind(*[None] * num_inputs, **parameters)
        except TypeError as error:
            raise ValueError(
                f"{where}: {self.name}{taken} does not take {num_inputs} keys and {sorted(parameters)}: {error}"
            ) from error
        self._tensors = [name for name, value in parameters.items() if isinstance(value, Tensor)]
        self._numbers = {name: value for name, value in parameters.items() if name not in self._tensors}
        for name in self._tensors:
            self.register_buffer(name, parameters[name], persistent=False)

    def forward(self, *inputs: Tensor) -> Tensor:
        return self.function(*inputs, **self._numbers, **{name: getattr(self, name) for name in self._tensors})
