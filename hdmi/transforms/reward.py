"""The paper's reward table as transforms: each adds one weighted, logged term to the reward."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec

from hdmi import functional as F
from hdmi.assets import g1, match_names
from hdmi.transforms.common import SpecTransform, soft_limits


def _keys(keys: Sequence[NestedKey | Sequence[str]]) -> list[NestedKey]:
    """Nested keys that may have come from a config as lists."""
    return [key if isinstance(key, str) else tuple(key) for key in keys]


class RewardTerm(SpecTransform):
    """Adds `weight * function(next[in_keys])` to the reward and writes the raw term beside it.

    Reads its in_keys from the next tensordict; writes `reward_terms/<name>` [N, 1] and adds to `reward_key`.
    A term of zero weight is computed and logged all the same.
    """

    def __init__(
        self, name: str, in_keys: Sequence[NestedKey | Sequence[str]], weight: float, reward_key: NestedKey = "reward"
    ):
        super().__init__(in_keys=_keys(in_keys), out_keys=[("reward_terms", name)])
        self.weight = weight
        self.reward_key = reward_key

    def function(self, *inputs: Tensor) -> Tensor:
        """The unweighted term. [..., 1]"""
        raise NotImplementedError

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        term = self.function(*(next_tensordict.get(key) for key in self.in_keys))
        next_tensordict.set(self.out_keys[0], term)
        # out of place: the collector keeps references to what it is given
        next_tensordict.set(self.reward_key, next_tensordict.get(self.reward_key) + self.weight * term)
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Recomputes the term on recorded transitions, in their `next`."""
        # shallow copies: a replay buffer may hand out what it stores
        return tensordict.copy().set("next", self._step(tensordict, tensordict.get("next").copy()))

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        reward_spec[self.out_keys[0]] = reward_spec[self.reward_key].clone()
        return reward_spec


class TrackingReward(RewardTerm):
    """Mean of the kernels exp(-mean error / sigma) of several errors; see `functional.tracking`.

    Serves Body Local Pose, Root Global Pose, Body Global Velocity, Joint Tracking, Object Pose and the object's
    joint: which errors and how wide is configuration.

    Args:
        errors: keys of non-negative errors [N, K].
        sigmas, tolerances: one per error, in its unit.
    """

    def __init__(
        self,
        name: str,
        weight: float,
        errors: Sequence[NestedKey],
        sigmas: Sequence[float],
        tolerances: Sequence[float] | None = None,
        reward_key: NestedKey = "reward",
    ):
        super().__init__(name, errors, weight, reward_key)
        self.sigmas = [float(s) for s in sigmas]
        self.tolerances = [0.0] * len(self.sigmas) if tolerances is None else [float(t) for t in tolerances]
        if not len(self.in_keys) == len(self.sigmas) == len(self.tolerances):
            raise ValueError(f"reward {name!r}: give one sigma and tolerance for each of {self.in_keys}")
        if min(self.sigmas) <= 0:
            raise ValueError(f"reward {name!r}: sigmas must be positive, got {self.sigmas}")

    def function(self, *inputs: Tensor) -> Tensor:
        kernels = [
            F.tracking(error, sigma=sigma, tolerance=tolerance)
            for error, sigma, tolerance in zip(inputs, self.sigmas, self.tolerances, strict=True)
        ]
        return torch.stack(kernels).mean(0)


class InteractionReward(RewardTerm):
    """Unified interaction reward (section III-B-3); see `functional.interaction`."""

    def __init__(
        self,
        name: str = "interaction",
        weight: float = 5.0,
        sigma_pos: float = 0.3,
        sigma_frc: float = 40.0,
        force_threshold: float = 10.0,
        tolerance: float = 0.0,
        reduce: Literal["mean", "max"] = "mean",
        eef_pos_key: NestedKey = ("contact", "eef_pos"),
        target_pos_key: NestedKey = ("contact", "target_pos"),
        force_key: NestedKey = ("contact", "force"),
        active_key: NestedKey = ("ref", "contact"),
        reward_key: NestedKey = "reward",
    ):
        if reduce not in ("mean", "max"):
            raise ValueError(f"reward {name!r}: reduce is 'mean' or 'max', got {reduce!r}")
        super().__init__(name, [eef_pos_key, target_pos_key, force_key, active_key], weight, reward_key)
        self.sigma_pos, self.sigma_frc, self.force_threshold = sigma_pos, sigma_frc, force_threshold
        self.tolerance, self.reduce = tolerance, reduce

    def function(self, *inputs: Tensor) -> Tensor:
        return F.interaction(
            *inputs,
            sigma_pos=self.sigma_pos,
            sigma_frc=self.sigma_frc,
            force_threshold=self.force_threshold,
            tolerance=self.tolerance,
            reduce=self.reduce,
        )


class SurvivalReward(RewardTerm):
    """One for every step that does not terminate."""

    def __init__(self, name: str = "survival", weight: float = 1.0, reward_key: NestedKey = "reward"):
        super().__init__(name, ["terminated"], weight, reward_key)

    def function(self, *inputs: Tensor) -> Tensor:
        return (~inputs[0]).float()


class ActionRateL2(RewardTerm):
    """Squared change of the policy's action; see `functional.action_rate`. Reads a history [N, H >= 2, A]."""

    def __init__(
        self,
        name: str = "action_rate",
        weight: float = -0.1,
        history_key: NestedKey = "action_history",
        reward_key: NestedKey = "reward",
    ):
        super().__init__(name, [history_key], weight, reward_key)

    def function(self, *inputs: Tensor) -> Tensor:
        return F.action_rate(inputs[0][..., 0, :], inputs[0][..., 1, :])


class JointPosLimitsL1(RewardTerm):
    """Distance of joints beyond a share of their range, rad; see `functional.limit_excess`.

    Args:
        soft_limit: share of the range, about its middle, that costs nothing.
    """

    def __init__(
        self,
        name: str = "joint_pos_limits",
        weight: float = -10.0,
        soft_limit: float = 0.95,
        joint_pos_key: NestedKey = ("robot", "joint_pos"),
        limits: Sequence[Sequence[float]] = g1.JOINT_RANGES,
        reward_key: NestedKey = "reward",
    ):
        super().__init__(name, [joint_pos_key], weight, reward_key)
        low, high = soft_limits(limits, soft_limit)
        self.register_buffer("low", low, persistent=False)
        self.register_buffer("high", high, persistent=False)

    def function(self, *inputs: Tensor) -> Tensor:
        return F.limit_excess(inputs[0], self.low, self.high)


class JointTorqueLimitsL1(RewardTerm):
    """Torque beyond a share of the effort limit, N m; see `functional.limit_excess`."""

    def __init__(
        self,
        name: str = "joint_torque_limits",
        weight: float = -0.01,
        soft_limit: float = 0.9,
        joint_torque_key: NestedKey = ("robot", "joint_torque"),
        limits: Sequence[float] = g1.EFFORT_LIMITS,
        reward_key: NestedKey = "reward",
    ):
        super().__init__(name, [joint_torque_key], weight, reward_key)
        self.register_buffer("limit", soft_limit * torch.tensor(list(limits), dtype=torch.float32), persistent=False)

    def function(self, *inputs: Tensor) -> Tensor:
        return F.limit_excess(inputs[0], -self.limit, self.limit)


class JointVelL2(RewardTerm):
    """Squared joint velocity, (rad/s)^2, summed over joints."""

    def __init__(
        self,
        name: str = "joint_vel",
        weight: float = -5.0e-4,
        joint_vel_key: NestedKey = ("robot", "joint_vel"),
        reward_key: NestedKey = "reward",
    ):
        super().__init__(name, [joint_vel_key], weight, reward_key)

    def function(self, *inputs: Tensor) -> Tensor:
        return inputs[0].square().sum(-1, keepdim=True)


class FeetImpactL2(RewardTerm):
    """Hard landings; see `functional.feet_impact`."""

    def __init__(
        self,
        name: str = "feet_impact",
        weight: float = -1.0,
        weight_force: float = 9.81 * g1.TOTAL_MASS,
        force_key: NestedKey = ("feet", "force"),
        previous_key: NestedKey = ("feet", "previous_force"),
        reward_key: NestedKey = "reward",
    ):
        super().__init__(name, [force_key, previous_key], weight, reward_key)
        self.weight_force = weight_force

    def function(self, *inputs: Tensor) -> Tensor:
        return F.feet_impact(*inputs, weight_force=self.weight_force)


class FeetSlip(RewardTerm):
    """Feet that move under load; see `functional.feet_slip`."""

    def __init__(
        self,
        name: str = "feet_slip",
        weight: float = -0.5,
        force_threshold: float = 5.0,
        velocity_key: NestedKey = ("robot", "body_lin_vel"),
        force_key: NestedKey = ("robot", "foot_force"),
        body_names: Sequence[str] = g1.BODY_NAMES,
        feet: Sequence[str] = g1.FEET,
        reward_key: NestedKey = "reward",
    ):
        super().__init__(name, [velocity_key, force_key], weight, reward_key)
        index = torch.as_tensor(match_names(feet, body_names, f"reward {name!r}"))
        self.register_buffer("feet", index, persistent=False)
        self.force_threshold = force_threshold

    def function(self, *inputs: Tensor) -> Tensor:
        velocity, force = inputs
        return F.feet_slip(velocity[..., self.feet, :], force, force_threshold=self.force_threshold)


class FeetStumble(RewardTerm):
    """Feet that run into the edge of a step; see `functional.feet_stumble`. Reads `robot/foot_force` [N, 2, 3]."""

    def __init__(
        self,
        name: str = "feet_stumble",
        weight: float = -1.0,
        ratio: float = 4.0,
        force_key: NestedKey = ("robot", "foot_force"),
        reward_key: NestedKey = "reward",
    ):
        super().__init__(name, [force_key], weight, reward_key)
        self.ratio = ratio

    def function(self, *inputs: Tensor) -> Tensor:
        return F.feet_stumble(inputs[0], ratio=self.ratio)


class FeetAirTime(RewardTerm):
    """Swings shorter than a threshold; see `functional.feet_air_time`."""

    def __init__(
        self,
        name: str = "feet_air_time",
        weight: float = -5.0,
        threshold: float = 0.4,
        swing_time_key: NestedKey = ("feet", "swing_time"),
        touchdown_key: NestedKey = ("feet", "touchdown"),
        reward_key: NestedKey = "reward",
    ):
        super().__init__(name, [swing_time_key, touchdown_key], weight, reward_key)
        self.threshold = threshold

    def function(self, *inputs: Tensor) -> Tensor:
        return F.feet_air_time(*inputs, threshold=self.threshold)


class RewardRate(SpecTransform):
    """Takes the reward for a rate: a control step earns its share of a second. [..., 1]

    TorchRL's RewardScaling does the same, but branches on a tensor, which stops `torch.compile`.

    Args:
        control_dt: s.
    """

    def __init__(self, control_dt: float, reward_key: NestedKey = "reward"):
        super().__init__(in_keys=[reward_key], out_keys=[reward_key])
        self.control_dt = control_dt

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set(self.out_keys[0], self.control_dt * next_tensordict.get(self.in_keys[0]))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Scales the reward of recorded transitions, in their `next`."""
        return tensordict.copy().set("next", self._step(tensordict, tensordict.get("next").copy()))
