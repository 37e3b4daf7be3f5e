"""Networks that start from those of another training, of another task, too."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from hdmi.learning.checkpoint import CheckpointError

Inputs = Mapping[str, int]  # observation term -> width, in the order in which a network is given them

# Steps that moments of observations count as having seen, so that they come over to the new task gently.
_SEEN = 100_000.0


@dataclass(frozen=True)
class Taken:
    """Which terms of a network's observation were taken over, and which are new to it."""

    network: str
    terms: tuple[str, ...]
    new: tuple[str, ...]

    def __str__(self) -> str:
        new = f"; new to it: {', '.join(self.new)}" if self.new else ""
        return f"{self.network}: {len(self.terms)} of {len(self.terms) + len(self.new)} terms of its observation{new}"


@torch.no_grad()
def take_over(network: nn.Module, weights: Mapping[str, Tensor], inputs: Inputs, of: Inputs, name: str) -> Taken:
    """Gives a network the weights of another one, whose observation may have other terms.

    Terms of the same name and width keep their weights and moments. Others have weights of zero in the first layer, so
    that they change nothing until they are learned, and moments as they are.

    Args:
        network: an actor or a critic, with moments of its observations (`RunningNorm`) and an MLP on them.
        weights: state dict of the other.
        inputs: terms of the network's observation.
        of: terms of the other's.
        name: for messages.

    Raises:
        CheckpointError: if it has other layers or outputs.
    """
    own = network.state_dict()
    first = _first_layer(own)
    here, there = _columns(inputs), _columns(of)
    shared = [term for term, width in inputs.items() if of.get(term) == width]
    to = [column for term in shared for column in here[term]]
    out_of = [column for term in shared for column in there[term]]
    if set(weights) != set(own):
        apart = ", ".join(sorted(set(weights) ^ set(own)))
        raise CheckpointError(f"warm_start: the {name} has other parts than the config's: {apart}")
    for key, value in own.items():
        other = weights[key]
        if key == first:
            _check_shape(name, key, value.shape[:1], other.shape[:1])
            value.zero_()
            value[:, to] = other[:, out_of].to(value)
        elif key.endswith((".mean", ".var")):
            value[to] = other[out_of].to(value)
        elif key.endswith(".count"):
            value.fill_(_SEEN)
        else:
            _check_shape(name, key, value.shape, other.shape)
            value.copy_(other)
    return Taken(name, tuple(shared), tuple(term for term in inputs if term not in shared))


def _first_layer(state: Mapping[str, Tensor]) -> str:
    """The matrix that the observation meets first."""
    return next(key for key, value in state.items() if key.endswith("weight") and value.ndim == 2)


def _columns(inputs: Inputs) -> dict[str, range]:
    columns, start = {}, 0
    for term, width in inputs.items():
        columns[term] = range(start, start + width)
        start += width
    return columns


def _check_shape(name: str, key: str, own: Any, other: Any) -> None:
    if own != other:
        raise CheckpointError(
            f"warm_start: the {name}'s {key} is {list(other)}, the config's {list(own)}; networks need the same algo, "
            "robots the same actuated joints"
        )
