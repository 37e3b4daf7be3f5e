"""Actor and critic: running normalisation of observations, then a multilayer perceptron."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator

_MIN_STD, _MAX_STD = 0.05, 2.0


class RunningNorm(nn.Module):
    """Normalises features by moments that `update` accumulates; gradients do not reach them.

    TorchRL's VecNormV2 updates its moments in every step; these stay as they are while a policy is compared with the
    one that collected.

    Args:
        size: features.
        clip: bound of the normalised values.

    Examples:
        >>> norm = RunningNorm(size=1)
        >>> norm.update(mean=torch.tensor([3.0]), var=torch.tensor([3.9601]), n=100)  # of 1.99 squared
        >>> norm(torch.tensor([[3.0], [5.0]]))  # (5 - 3) / (1.99 + 0.01)
        tensor([[0.],
                [1.]])
    """

    def __init__(self, size: int, clip: float = 10.0):
        super().__init__()
        self.clip = clip
        self.mean: Tensor
        self.var: Tensor
        self.count: Tensor
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("var", torch.ones(size))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    @torch.no_grad()
    def update(self, mean: Tensor, var: Tensor, n: int) -> None:
        """Adds n samples of the given mean and population variance [size] (parallel-variance formula)."""
        total = self.count + n
        share = (n / total).to(mean.dtype)
        delta = mean - self.mean
        self.var.copy_((1 - share) * self.var + share * var + share * (1 - share) * delta.square())
        self.mean.add_(delta * share)
        self.count.copy_(total)

    def forward(self, values: Tensor) -> Tensor:
        """Normalised values, at most `clip`. [..., size] -> [..., size]"""
        scale = 1 / (self.var.sqrt() + 1e-2)
        # one pass over the batch instead of two
        return torch.addcmul(-self.mean * scale, values, scale).clamp(-self.clip, self.clip)


class _Network(nn.Module):
    """RunningNorm and an MLP, the MLP in bfloat16 if asked; output in float32."""

    def __init__(self, in_size: int, out_size: int, hidden: Sequence[int], activation: str, bf16: bool, gain: float):
        super().__init__()
        if not hasattr(nn, activation):
            raise ValueError(f"algo.activation: torch.nn has no {activation!r}")
        self.norm = RunningNorm(in_size)
        self.mlp = MLP(in_size, out_size, num_cells=list(hidden), activation_class=getattr(nn, activation))
        self.bf16 = bf16
        layers = [layer for layer in self.mlp if isinstance(layer, nn.Linear)]
        for layer in layers:
            nn.init.orthogonal_(layer.weight, gain if layer is layers[-1] else 2**0.5)
            nn.init.zeros_(layer.bias)

    def normalise(self, observation: Tensor) -> Tensor:
        """Normalised observations as `forward_normalised` takes them, in the MLP's precision. [..., in_size]"""
        normalised = self.norm(observation)
        return normalised.bfloat16() if self.bf16 else normalised

    def forward_normalised(self, normalised: Tensor) -> Any:
        """The MLP's output. [..., in_size] -> [..., out_size]"""
        with torch.autocast(normalised.device.type, dtype=torch.bfloat16, enabled=self.bf16):
            out = self.mlp(normalised)
        return out.float()

    def forward(self, observation: Tensor) -> Any:
        return self.forward_normalised(self.normalise(observation))


class _ValueHead(_Network):
    """State value, of one or more rewards."""

    def __init__(self, in_size: int, out_size: int, **kwargs: Any):
        super().__init__(in_size, out_size, gain=1.0, **kwargs)


class _GaussianHead(_Network):
    """Mean from the network, standard deviation a free parameter per action, within bounds.

    Beyond a bound its gradient is the bound's, so that it can come back; `bound_noise` keeps it from moving away.
    """

    def __init__(self, in_size: int, out_size: int, init_noise: float, **kwargs: Any):
        super().__init__(in_size, out_size, gain=0.01, **kwargs)
        self.log_std = nn.Parameter(torch.full((out_size,), init_noise).log())

    def forward_normalised(self, normalised: Tensor) -> tuple[Tensor, Tensor]:
        loc = super().forward_normalised(normalised)
        within = self.log_std + (self.bounded() - self.log_std).detach()
        return loc, within.exp().expand_as(loc)

    def bounded(self) -> Tensor:
        """The parameter, or the bound that it has crossed."""
        return self.log_std.clamp(math.log(_MIN_STD), math.log(_MAX_STD))


def make_actor(
    in_size: int,
    out_size: int,
    hidden: Sequence[int],
    activation: str,
    init_noise: float,
    bf16: bool,
    in_key: NestedKey = "policy",
) -> ProbabilisticActor:
    """Gaussian policy: `in_key` [..., in_size] -> `action` [..., out_size] with `loc`, `scale`, `action_log_prob`."""
    head = _GaussianHead(in_size, out_size, init_noise, hidden=hidden, activation=activation, bf16=bf16)
    return _actor(head, in_key)


def _actor(head: nn.Module, in_key: NestedKey) -> ProbabilisticActor:
    return ProbabilisticActor(
        TensorDictModule(head, in_keys=[in_key], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )


def make_critic(in_size: int, hidden: Sequence[int], activation: str, bf16: bool, out_size: int = 1) -> ValueOperator:
    """State value from privileged observations: `critic` [..., in_size] -> `state_value` [..., out_size].

    Args:
        out_size: number of rewards that are valued each by itself.
    """
    return _critic(_ValueHead(in_size, out_size, hidden=hidden, activation=activation, bf16=bf16))


def _critic(head: nn.Module) -> ValueOperator:
    return ValueOperator(head, in_keys=["critic"])


class _AfterNorm(nn.Module):
    """A network behind its normalisation, with the same parameters."""

    def __init__(self, network: _Network):
        super().__init__()
        self.network = network

    def forward(self, normalised: Tensor) -> Any:
        return self.network.forward_normalised(normalised)


def network_of(module: nn.Module) -> Any:
    """The network of an actor or critic."""
    return next(m for m in module.modules() if isinstance(m, _Network))


@torch.no_grad()
def bound_noise(actor: nn.Module) -> None:
    """Puts parameters of an actor's standard deviations back to the bound that they have crossed.

    To call after an optimizer's step.
    """
    for head in actor.modules():
        if isinstance(head, _GaussianHead):
            head.log_std.copy_(head.bounded())


def normalised_actor(actor: ProbabilisticActor) -> ProbabilisticActor:
    """The same actor, sharing parameters, for observations that `network_of(actor).normalise` has normalised."""
    return _actor(_AfterNorm(network_of(actor)), actor.in_keys[0])


def normalised_critic(critic: ValueOperator) -> ValueOperator:
    """As `normalised_actor`, of a critic."""
    return _critic(_AfterNorm(network_of(critic)))


def use_bf16(setting: str | bool, device: torch.device) -> bool:
    """Resolves `auto`: bfloat16 where the processor multiplies it natively."""
    if setting != "auto":
        return bool(setting)
    return device.type == "cpu" and bool(torch.cpu.get_capabilities().get("avx512_bf16", False))
