"""The paper's reward table as transforms: each adds one weighted, logged term to the reward.

A row of the table is a kernel bound to keys. `KernelReward` binds any; the classes below it are the paper's rows with
their names, weights and keys as defaults.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from hdmi import functional as F
from hdmi.names import match_names
from hdmi.transforms.common import BoundKernel, SpecTransform, below, copied, key_of, soft_limits, spec_like

_GRAVITY = 9.81  # m/s^2
_OTHER = "other"  # group of reward terms that no group names


class RewardTerm(SpecTransform):
    """Adds `weight * function(next[in_keys])` to the reward and writes the raw term beside it.

    Reads its in_keys from the next tensordict; writes `term_key` [N, 1], an observation that is zero after a reset, and
    adds to `reward_key`. A term of zero weight is computed and logged all the same.

    Args:
        term_key: `reward_terms/<name>` if absent.

    Raises:
        ValueError: from the specs, if the function does not give [N, 1].

    Examples:
        >>> class Stillness(RewardTerm):
        ...     def function(self, *inputs):
        ...         return inputs[0].square().sum(-1, keepdim=True)
        >>> after = TensorDict({"velocity": torch.tensor([[1.0, 2.0]]), "reward": torch.zeros(1, 1)}, [1])
        >>> Stillness("stillness", ["velocity"], weight=-0.5)(TensorDict({"next": after}, [1]))["next", "reward"]
        tensor([[-2.5000]])
    """

    def __init__(
        self,
        name: str,
        in_keys: Sequence[NestedKey | Sequence[str]],
        weight: float,
        reward_key: NestedKey = "reward",
        term_key: NestedKey | None = None,
    ):
        term_key = below("reward_terms", name) if term_key is None else key_of(term_key)
        super().__init__(in_keys=[key_of(key) for key in in_keys], out_keys=[term_key])
        self.name, self.weight = name, weight
        self.reward_key = key_of(reward_key)

    def function(self, *inputs: Tensor) -> Tensor:
        """The unweighted term. [..., 1]"""
        raise NotImplementedError

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        term = self.function(*(next_tensordict.get(key) for key in self.in_keys))
        next_tensordict.set(self.out_keys[0], term)
        # out of place: the collector keeps references to what it is given
        next_tensordict.set(self.reward_key, next_tensordict.get(self.reward_key) + self.weight * term)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        zero = torch.zeros(*tensordict_reset.batch_size, 1, device=tensordict_reset.device)
        return tensordict_reset.set(self.out_keys[0], zero)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Recomputes the term on recorded transitions, in their `next`."""
        # shallow copies: a replay buffer may hand out what it stores
        return tensordict.copy().set("next", self._step(tensordict, tensordict.get("next").copy()))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec = copied(observation_spec)
        term = torch.zeros(*observation_spec.shape, 1, device=observation_spec.device)
        there = observation_spec.keys(True, True)
        if all(key in there for key in self.in_keys):  # else some are of the done spec
            found = self.function(*(observation_spec[key].zero() for key in self.in_keys))
            if found.shape != term.shape:
                raise ValueError(
                    f"reward {self.name!r}: expected one figure for each world, {list(term.shape)}, got "
                    f"{list(found.shape)} from {self.in_keys}"
                )
        observation_spec[self.out_keys[0]] = spec_like(term)
        return observation_spec


class KernelReward(RewardTerm):
    """A reward term that is a kernel bound to keys: `weight * function(*next[keys], **parameters)`.

    Args:
        function: gives [N, 1] from the entries; itself, or its dotted name, such as `hdmi.functional.feet_slip`.
        keys: of its tensors, in its order.
        parameters: its keyword arguments.

    Raises:
        ValueError: if there is no such function, or it does not take these keys and parameters.

    Examples:
        >>> term = KernelReward("hdmi.functional.tracking", ["error"], "near", weight=2.0, sigma=0.5)
        >>> after = TensorDict({"error": torch.tensor([[0.5]]), "reward": torch.zeros(1, 1)}, [1])
        >>> term(TensorDict({"next": after}, [1]))["next", "reward"]  # 2 exp(-1)
        tensor([[0.7358]])
    """

    def __init__(
        self,
        function: Callable[..., Tensor] | str,
        keys: Sequence[NestedKey | Sequence[str]],
        name: str,
        weight: float = 1.0,
        reward_key: NestedKey = "reward",
        term_key: NestedKey | None = None,
        **parameters: Any,
    ):
        super().__init__(name, keys, weight, reward_key, term_key)
        self.kernel = BoundKernel(function, len(self.in_keys), f"reward {name!r}", parameters)

    def function(self, *inputs: Tensor) -> Tensor:
        return self.kernel(*inputs)


class TrackingReward(KernelReward):
    """Mean of the kernels exp(-mean error / sigma) of several errors; see `functional.tracking_mean`.

    Serves Body Local Pose, Root Global Pose, Body Global Velocity, Joint Tracking, Object Pose and the object's
    joint: which errors and how wide is configuration.

    Args:
        errors: keys of non-negative errors [N, K].
        sigmas, tolerances: one per error, in its unit.

    Examples:
        >>> term = TrackingReward("pose", weight=1.0, errors=["pos", "rot"], sigmas=[0.1, 0.2])
        >>> after = {"pos": torch.tensor([[0.1]]), "rot": torch.tensor([[0.2]]), "reward": torch.zeros(1, 1)}
        >>> term(TensorDict({"next": after}, [1]))["next", "reward_terms", "pose"]  # exp(-1), twice
        tensor([[0.3679]])
    """

    def __init__(
        self,
        name: str,
        weight: float,
        errors: Sequence[NestedKey],
        sigmas: Sequence[float],
        tolerances: Sequence[float] | None = None,
        reward_key: NestedKey = "reward",
        term_key: NestedKey | None = None,
    ):
        sigmas = tuple(float(s) for s in sigmas)
        tolerances = (0.0,) * len(sigmas) if tolerances is None else tuple(float(t) for t in tolerances)
        if not len(errors) == len(sigmas) == len(tolerances):
            raise ValueError(f"reward {name!r}: give one sigma and tolerance for each of {list(errors)}")
        if min(sigmas) <= 0:
            raise ValueError(f"reward {name!r}: sigmas must be positive, got {list(sigmas)}")
        super().__init__(
            F.tracking_mean, errors, name, weight, reward_key, term_key, sigmas=sigmas, tolerances=tolerances
        )  # fmt: skip


class InteractionReward(KernelReward):
    """Unified interaction reward (section III-B-3); see `functional.interaction`.

    Examples:
        >>> zero, firm = torch.zeros(1, 1, 3), torch.full((1, 1, 3), 9.0)
        >>> contact = {"eef_pos": zero, "target_pos": zero, "force": firm}
        >>> after = {"contact": contact, "ref": {"contact": torch.tensor([[True]])}, "reward": torch.zeros(1, 1)}
        >>> td = TensorDict({"next": after}, [1])
        >>> InteractionReward(weight=5.0)(td)["next", "reward"]  # the hand is at its point and firm: 15.6 N
        tensor([[5.]])
    """

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
        term_key: NestedKey | None = None,
    ):
        if reduce not in ("mean", "max"):
            raise ValueError(f"reward {name!r}: reduce is 'mean' or 'max', got {reduce!r}")
        super().__init__(
            F.interaction, [eef_pos_key, target_pos_key, force_key, active_key], name, weight, reward_key, term_key,
            sigma_pos=sigma_pos, sigma_frc=sigma_frc, force_threshold=force_threshold, tolerance=tolerance,
            reduce=reduce,
        )  # fmt: skip


class SurvivalReward(KernelReward):
    """One for every step that does not terminate; stands behind the terminations.

    Examples:
        >>> after = {"terminated": torch.tensor([[True], [False]]), "reward": torch.zeros(2, 1)}
        >>> SurvivalReward(weight=1.0)(TensorDict({"next": after}, [2]))["next", "reward"].flatten()
        tensor([0., 1.])
    """

    def __init__(
        self,
        name: str = "survival",
        weight: float = 1.0,
        terminated_key: NestedKey = "terminated",
        reward_key: NestedKey = "reward",
        term_key: NestedKey | None = None,
    ):
        super().__init__(F.alive, [terminated_key], name, weight, reward_key, term_key)


class ActionRateL2(RewardTerm):
    """Squared change of the policy's action; see `functional.action_rate`. Reads a history [N, H >= 2, A].

    Examples:
        >>> after = {"action_history": torch.tensor([[[1.0, 2.0], [0.0, 0.0]]]), "reward": torch.zeros(1, 1)}
        >>> ActionRateL2(weight=-0.1)(TensorDict({"next": after}, [1]))["next", "reward"]
        tensor([[-0.5000]])
    """

    def __init__(
        self,
        name: str = "action_rate",
        weight: float = -0.1,
        history_key: NestedKey = "action_history",
        reward_key: NestedKey = "reward",
        term_key: NestedKey | None = None,
    ):
        super().__init__(name, [history_key], weight, reward_key, term_key)

    def function(self, *inputs: Tensor) -> Tensor:
        return F.action_rate(inputs[0][..., 0, :], inputs[0][..., 1, :])


class JointPosLimitsL1(KernelReward):
    """Distance of joints beyond a share of their range, rad; see `functional.limit_excess`.

    Args:
        joint_ranges: rad. [J, 2]
        soft_limit: share of the range, about its middle, that costs nothing.

    Examples:
        >>> term = JointPosLimitsL1(joint_ranges=[(-1.0, 1.0)], weight=-10.0, soft_limit=0.5)
        >>> after = {"robot": {"joint_pos": torch.tensor([[0.75]])}, "reward": torch.zeros(1, 1)}
        >>> term(TensorDict({"next": after}, [1]))["next", "reward"]  # 0.25 rad beyond 0.5
        tensor([[-2.5000]])
    """

    def __init__(
        self,
        joint_ranges: Sequence[Sequence[float]],
        name: str = "joint_pos_limits",
        weight: float = -10.0,
        soft_limit: float = 0.95,
        joint_pos_key: NestedKey = ("robot", "joint_pos"),
        reward_key: NestedKey = "reward",
        term_key: NestedKey | None = None,
    ):
        low, high = soft_limits(joint_ranges, soft_limit)
        super().__init__(F.limit_excess, [joint_pos_key], name, weight, reward_key, term_key, low=low, high=high)


class JointTorqueLimitsL1(KernelReward):
    """Torque beyond a share of the effort limit, N m; see `functional.limit_excess`.

    Args:
        effort_limits: N m. [J]
        soft_limit: share of them that costs nothing.

    Examples:
        >>> term = JointTorqueLimitsL1(effort_limits=[100.0], weight=-0.01, soft_limit=0.5)
        >>> after = {"robot": {"joint_torque": torch.tensor([[-80.0]])}, "reward": torch.zeros(1, 1)}
        >>> term(TensorDict({"next": after}, [1]))["next", "reward"]  # 30 N m beyond 50
        tensor([[-0.3000]])
    """

    def __init__(
        self,
        effort_limits: Sequence[float],
        name: str = "joint_torque_limits",
        weight: float = -0.01,
        soft_limit: float = 0.9,
        joint_torque_key: NestedKey = ("robot", "joint_torque"),
        reward_key: NestedKey = "reward",
        term_key: NestedKey | None = None,
    ):
        limit = soft_limit * torch.tensor(list(effort_limits), dtype=torch.float32)
        super().__init__(
            F.limit_excess, [joint_torque_key], name, weight, reward_key, term_key, low=-limit, high=limit
        )  # fmt: skip


class JointVelL2(KernelReward):
    """Squared joint velocity, (rad/s)^2, summed over joints.

    Examples:
        >>> after = {"robot": {"joint_vel": torch.tensor([[1.0, 2.0]])}, "reward": torch.zeros(1, 1)}
        >>> JointVelL2(weight=-1.0)(TensorDict({"next": after}, [1]))["next", "reward"]
        tensor([[-5.]])
    """

    def __init__(
        self,
        name: str = "joint_vel",
        weight: float = -5.0e-4,
        joint_vel_key: NestedKey = ("robot", "joint_vel"),
        reward_key: NestedKey = "reward",
        term_key: NestedKey | None = None,
    ):
        super().__init__(F.sum_of_squares, [joint_vel_key], name, weight, reward_key, term_key)


class FeetImpactL2(KernelReward):
    """Hard landings; see `functional.feet_impact`.

    Args:
        robot_mass: kg.

    Examples:
        >>> landed = torch.tensor([[[0.0, 0.0, 981.0], [0.0, 0.0, 0.0]]])  # a robot of 50 kg, with twice its weight
        >>> after = {"feet": {"force": landed, "previous_force": torch.zeros(1, 2, 3)}, "reward": torch.zeros(1, 1)}
        >>> FeetImpactL2(robot_mass=50.0, weight=-1.0)(TensorDict({"next": after}, [1]))["next", "reward"]
        tensor([[-4.]])
    """

    def __init__(
        self,
        robot_mass: float,
        name: str = "feet_impact",
        weight: float = -1.0,
        force_key: NestedKey = ("feet", "force"),
        previous_key: NestedKey = ("feet", "previous_force"),
        reward_key: NestedKey = "reward",
        term_key: NestedKey | None = None,
    ):
        super().__init__(
            F.feet_impact, [force_key, previous_key], name, weight, reward_key, term_key,
            weight_force=_GRAVITY * robot_mass,
        )  # fmt: skip


class FeetSlip(RewardTerm):
    """Feet that move under load; see `functional.feet_slip`.

    Args:
        feet: names of their bodies, among `body_names`.

    Examples:
        >>> velocity = torch.tensor([[[0.0, 0.0, 0.0], [0.3, 0.4, 0.0], [1.0, 0.0, 0.0]]])  # of root and feet
        >>> load = torch.tensor([[[0.0, 0.0, 200.0], [0.0, 0.0, 0.0]]])  # the right foot is in the air
        >>> after = {"robot": {"body_lin_vel": velocity, "foot_force": load}, "reward": torch.zeros(1, 1)}
        >>> term = FeetSlip(["left", "right"], body_names=["root", "left", "right"], weight=-1.0)
        >>> term(TensorDict({"next": after}, [1]))["next", "reward"]
        tensor([[-0.5000]])
    """

    def __init__(
        self,
        feet: Sequence[str],
        body_names: Sequence[str],
        name: str = "feet_slip",
        weight: float = -0.5,
        force_threshold: float = 5.0,
        velocity_key: NestedKey = ("robot", "body_lin_vel"),
        force_key: NestedKey = ("robot", "foot_force"),
        reward_key: NestedKey = "reward",
        term_key: NestedKey | None = None,
    ):
        super().__init__(name, [velocity_key, force_key], weight, reward_key, term_key)
        index = torch.as_tensor(match_names(feet, body_names, f"reward {name!r}"))
        self.register_buffer("feet", index, persistent=False)
        self.force_threshold = force_threshold

    def function(self, *inputs: Tensor) -> Tensor:
        velocity, force = inputs
        return F.feet_slip(velocity.index_select(-2, self.feet), force, force_threshold=self.force_threshold)


class FeetStumble(KernelReward):
    """Feet that run into the edge of a step; see `functional.feet_stumble`. Reads `robot/foot_force` [N, 2, 3].

    Examples:
        >>> load = torch.tensor([[[50.0, 0.0, 10.0], [0.0, 0.0, 200.0]]])  # the left foot runs into something
        >>> after = {"robot": {"foot_force": load}, "reward": torch.zeros(1, 1)}
        >>> FeetStumble(weight=-1.0, ratio=4.0)(TensorDict({"next": after}, [1]))["next", "reward"]
        tensor([[-1.]])
    """

    def __init__(
        self,
        name: str = "feet_stumble",
        weight: float = -1.0,
        ratio: float = 4.0,
        force_key: NestedKey = ("robot", "foot_force"),
        reward_key: NestedKey = "reward",
        term_key: NestedKey | None = None,
    ):
        super().__init__(F.feet_stumble, [force_key], name, weight, reward_key, term_key, ratio=ratio)


class FeetAirTime(KernelReward):
    """Swings shorter than a threshold; see `functional.feet_air_time`.

    Examples:
        >>> feet = {"swing_time": torch.tensor([[0.15, 0.0]]), "touchdown": torch.tensor([[True, False]])}
        >>> td = TensorDict({"next": {"feet": feet, "reward": torch.zeros(1, 1)}}, [1])
        >>> FeetAirTime(weight=-4.0, threshold=0.4)(td)["next", "reward"]  # 0.25 s short
        tensor([[-1.]])
    """

    def __init__(
        self,
        name: str = "feet_air_time",
        weight: float = -5.0,
        threshold: float = 0.4,
        swing_time_key: NestedKey = ("feet", "swing_time"),
        touchdown_key: NestedKey = ("feet", "touchdown"),
        reward_key: NestedKey = "reward",
        term_key: NestedKey | None = None,
    ):
        keys = [swing_time_key, touchdown_key]
        super().__init__(F.feet_air_time, keys, name, weight, reward_key, term_key, threshold=threshold)


class RewardRate(SpecTransform):
    """Takes the reward for a rate: a control step earns its share of a second. [..., 1]

    TorchRL's RewardScaling does the same, but branches on a tensor, which stops `torch.compile`.

    Args:
        control_dt: s.

    Examples:
        >>> RewardRate(control_dt=0.02)(TensorDict({"next": {"reward": torch.tensor([[5.0]])}}, [1]))["next", "reward"]
        tensor([[0.1000]])
    """

    def __init__(self, control_dt: float, reward_key: NestedKey = "reward"):
        super().__init__(in_keys=[key_of(reward_key)], out_keys=[key_of(reward_key)])
        self.control_dt = control_dt

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set(self.out_keys[0], self.control_dt * next_tensordict.get(self.in_keys[0]))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Scales the reward of recorded transitions, in their `next`."""
        return tensordict.copy().set("next", self._step(tensordict, tensordict.get("next").copy()))


class RewardGroups(SpecTransform):
    """Writes what groups of reward terms come to, for a learner that values each group by itself.

    A group's reward is `control_dt * sum(weight * term)` over its terms, so that all groups together are the reward
    behind `RewardRate`, which stays as it is. Terms that no group names are one more group, `other`; a group that has
    no terms is left out. Reads the terms [N, 1] of the next tensordict; writes `groups_key/<group>` [N, 1],
    observations that are zero after a reset.

    Args:
        groups: group -> names of its terms, each the last part of a key.
        term_weights: key of a term -> what it counts for.
        control_dt: s; one where the reward is not taken for a rate.

    Raises:
        ValueError: for a term that is named twice, or a group of the name `other`.

    Examples:
        >>> terms = {("reward_terms", "near"): 2.0, ("reward_terms", "effort"): -0.5}
        >>> groups = RewardGroups({"tracking": ["near"], "costs": ["effort"]}, terms, control_dt=0.02)
        >>> after = TensorDict({"reward_terms": {"near": torch.ones(1, 1), "effort": torch.full((1, 1), 4.0)}}, [1])
        >>> rewards = groups(TensorDict({"next": after}, [1]))["next", "reward_groups"]
        >>> rewards["tracking"], rewards["costs"]  # 0.02 * 2, 0.02 * -0.5 * 4
        (tensor([[0.0400]]), tensor([[-0.0400]]))
    """

    def __init__(
        self,
        groups: Mapping[str, Sequence[str]],
        term_weights: Mapping[NestedKey, float],
        control_dt: float = 1.0,
        groups_key: NestedKey = "reward_groups",
    ):
        named = [name for names in groups.values() for name in names]
        if twice := sorted({name for name in named if named.count(name) > 1}):
            raise ValueError(f"groups: {', '.join(twice)} named more than once")
        if _OTHER in groups:
            raise ValueError(f"groups: {_OTHER!r} is made of the terms that no group names")
        group_of = {name: group for group, names in groups.items() for name in names}
        terms: dict[str, list[tuple[NestedKey, float]]] = {group: [] for group in (*groups, _OTHER)}
        for key, weight in term_weights.items():
            name = key if isinstance(key, str) else key[-1]
            terms[group_of.get(name, _OTHER)].append((key_of(key), weight))
        self.terms = {below(groups_key, group): members for group, members in terms.items() if members}
        super().__init__(in_keys=[key_of(key) for key in term_weights], out_keys=list(self.terms))
        self.control_dt = control_dt

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        for group, terms in self.terms.items():
            reward = sum(weight * next_tensordict.get(key) for key, weight in terms)
            next_tensordict.set(group, self.control_dt * reward)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        zero = torch.zeros(*tensordict_reset.batch_size, 1, device=tensordict_reset.device)
        for group in self.terms:
            tensordict_reset.set(group, zero.clone())
        return tensordict_reset

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Adds the groups' rewards to recorded transitions, in their `next`."""
        return tensordict.copy().set("next", self._step(tensordict, tensordict.get("next").copy()))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec = copied(observation_spec)
        for group in self.terms:
            observation_spec[group] = spec_like(torch.zeros(*observation_spec.shape, 1, device=observation_spec.device))
        return observation_spec
