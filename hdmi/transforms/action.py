"""From a policy's normalised action to joint position targets: scale, residual, smoothing, delay.

Inverse transforms run last to first, so the stack lists them from the environment outwards: delay, smoothing,
residual, joint position.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from hdmi.names import match_names
from hdmi.transforms.common import SpecTransform, StateTransform, add_read_state, below, key_of


def width_of_action(transform: Transform, action_key: NestedKey) -> int:
    """Width of the action of the environment that a transform stands on.

    Raises:
        ValueError: if it stands on none.
    """
    if transform.parent is None:
        raise ValueError(f"{type(transform).__name__}: give `size`, the width of the action, outside of an environment")
    return int(transform.parent.full_action_spec[action_key].shape[-1])


class _ActionTransform(SpecTransform):
    """Rewrites the action on its way to the environment with what the tensordict holds."""

    def __init__(self, action_key: NestedKey = "action", state_keys: Sequence[NestedKey] = ()):
        self.action_key = key_of(action_key)
        super().__init__(in_keys_inv=[self.action_key], out_keys_inv=[self.action_key])
        self.state_keys = [key_of(key) for key in state_keys]

    def inverse(self, action: Tensor, *state: Tensor) -> Tensor:
        raise NotImplementedError

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get(self.action_key, None)
        if action is not None:
            state = [tensordict.get(key) for key in self.state_keys]
            tensordict.set(self.action_key, self.inverse(action, *state))
        return tensordict

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        return add_read_state(super().transform_input_spec(input_spec), self, self.state_keys)


class JointPositionAction(_ActionTransform):
    """Scales the policy's action for each actuated joint and spreads it over all joints (zero elsewhere).

    Action: [..., A] for the A joints with a scale -> offsets [..., J], rad. The policy's own action stays in the
    stepped tensordict at `policy_action_key`. TorchRL's ActionScaling scales what it is given; it does not spread it.

    Args:
        scale: joint name pattern -> rad per unit of action; joints that match none are not actuated by the policy.
        joint_names: of the J joints.

    Examples:
        >>> action = JointPositionAction({".*_knee": 0.5}, joint_names=["hip", "left_knee", "right_knee"])
        >>> action.inv(TensorDict({"action": torch.tensor([[1.0, -1.0]])}, [1]))["action"]
        tensor([[ 0.0000,  0.5000, -0.5000]])
    """

    def __init__(
        self,
        scale: Mapping[str, float],
        joint_names: Sequence[str],
        action_key: NestedKey = "action",
        policy_action_key: NestedKey = "policy_action",
    ):
        super().__init__(action_key)
        table = torch.zeros(len(joint_names))
        for pattern, value in scale.items():
            table[match_names([pattern], joint_names, "action.joint_position.scale")] = float(value)
        index = table.nonzero().squeeze(-1)
        self.register_buffer("index", index, persistent=False)
        self.register_buffer("scale", table[index], persistent=False)
        self.num_joints = len(joint_names)
        self.policy_action_key = key_of(policy_action_key)

    def inverse(self, action: Tensor, *state: Tensor) -> Tensor:
        offsets = action.new_zeros(*action.shape[:-1], self.num_joints)
        offsets[..., self.index] = action * self.scale
        return offsets

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get(self.action_key, None)
        if action is not None:
            tensordict.set(self.policy_action_key, action)
        return super()._inv_call(tensordict)

    def transform_action_spec(self, action_spec: TensorSpec) -> TensorSpec:
        action_spec = action_spec.clone()
        outer: Composite | None = action_spec if isinstance(action_spec, Composite) else None
        leaf = action_spec if outer is None else outer[unravel_key(self.action_key)]
        new = Unbounded(shape=(*leaf.shape[:-1], len(self.index)), device=leaf.device, dtype=leaf.dtype)
        if outer is None:
            return new
        outer[unravel_key(self.action_key)] = new
        return outer


class ResidualAction(_ActionTransform):
    """Residual action space: target = theta_ref + a (section III-B-2).

    Reads `base_key` [..., J] of the present step, rad.

    Examples:
        >>> td = TensorDict({"action": torch.tensor([[0.1, -0.1]]), "nominal": torch.tensor([[1.0, 2.0]])}, [1])
        >>> ResidualAction(base_key="nominal").inv(td)["action"]
        tensor([[1.1000, 1.9000]])
    """

    def __init__(self, base_key: NestedKey = ("ref", "joint_pos"), action_key: NestedKey = "action"):
        super().__init__(action_key, [base_key])

    def inverse(self, action: Tensor, *state: Tensor) -> Tensor:
        return state[0] + action


class DefaultPoseAction(_ActionTransform):
    """Action space of the paper's ablation: target = theta_default + a.

    TorchRL's ActionScaling with this loc and a scale of one does the same to the action; it bounds the specs by it.

    Args:
        default_pos: joint angles, rad, such as the robot's standing pose. [J]

    Examples:
        >>> td = TensorDict({"action": torch.tensor([[0.1, -0.1]])}, [1])
        >>> DefaultPoseAction(default_pos=[0.5, 0.0]).inv(td)["action"]
        tensor([[ 0.6000, -0.1000]])
    """

    def __init__(self, default_pos: Sequence[float], action_key: NestedKey = "action"):
        super().__init__(action_key)
        self.register_buffer("default_pos", torch.as_tensor(default_pos, dtype=torch.float32), persistent=False)

    def inverse(self, action: Tensor, *state: Tensor) -> Tensor:
        return self.default_pos + action


class ActionStateTransform(_ActionTransform, StateTransform):
    """Base of action transforms with state of their own in the tensordict.

    Args:
        size: width of the action; None asks the environment below, once.
    """

    def __init__(self, action_key: NestedKey = "action", size: int | None = None):
        super().__init__(action_key)
        self._size = size

    @property
    def size(self) -> int:
        """Width of the action."""
        if self._size is None:
            self._size = width_of_action(self, self.action_key)
        return self._size

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        return StateTransform.transform_input_spec(self, input_spec)


class ActionSmoothing(ActionStateTransform):
    """Low-pass filter of the targets: x_t = alpha u_t + (1 - alpha) x_{t-1}, alpha drawn per episode.

    Reads and writes `{previous, alpha, fresh}` under `state_key`; the first step of an episode is not filtered.

    Args:
        alpha: range of the filter coefficient.
        size: width of the action; None asks the environment.
        state_key: `smoothing/<action_key>` if absent.

    Examples:
        >>> env = TransformedEnv(base, ActionSmoothing(alpha=(0.5, 0.5)))
        >>> td = env.reset()
        >>> for target in (0.2, 0.4):
        ...     td = env.step_mdp(env.step(td.set("action", torch.full((2, 29), target))))
        >>> td["robot", "joint_target"][0, 0]  # 0.5 * 0.4 + 0.5 * 0.2
        tensor(0.3000)
    """

    training_only = True

    def __init__(
        self,
        alpha: Sequence[float] = (0.8, 1.0),
        size: int | None = None,
        action_key: NestedKey = "action",
        state_key: NestedKey | None = None,
    ):
        super().__init__(action_key, size)
        key = below("smoothing", self.action_key) if state_key is None else state_key
        self._previous, self._alpha, self._fresh = (below(key, name) for name in ("previous", "alpha", "fresh"))
        self._smoothed = below(key, "smoothed")  # from the way in to the end of the same step
        low, high = alpha
        if not 0 < low <= high <= 1:
            raise ValueError(f"action.smoothing.alpha: expected 0 < low <= high <= 1, got {list(alpha)}")
        self.low, self.high = float(low), float(high)

    @property
    def own_keys(self) -> list[NestedKey]:
        return [self._previous, self._alpha, self._fresh]

    def initial_state(self, batch_size: torch.Size, device: torch.device | None) -> dict[NestedKey, Tensor]:
        alpha = self.low + (self.high - self.low) * torch.rand(*batch_size, 1, device=device)
        return {
            self._previous: torch.zeros(*batch_size, self.size, device=device),
            self._alpha: alpha,
            self._fresh: torch.ones(*batch_size, 1, dtype=torch.bool, device=device),
        }

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get(self.action_key, None)
        if action is not None:
            previous, alpha, fresh = (tensordict.get(key) for key in (self._previous, self._alpha, self._fresh))
            smoothed = torch.where(fresh, action, alpha * action + (1 - alpha) * previous)
            tensordict.set(self.action_key, smoothed)
            tensordict.set(self._smoothed, smoothed)
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        next_tensordict.set(self._previous, tensordict.get(self._smoothed))
        next_tensordict.set(self._alpha, tensordict.get(self._alpha))
        next_tensordict.set(self._fresh, torch.zeros_like(tensordict.get(self._fresh)))
        return next_tensordict


class ActionDelay(ActionStateTransform):
    """Delays targets by a number of physics steps, drawn per episode.

    The environment receives one target per physics step: [..., J] -> [..., decimation, J]. With delay d, physics
    step k of control step t uses the target of control step t - ceil((d - k) / decimation); before an episode's
    first target arrives, that target is used. Reads and writes `{history, substeps, fresh}` under `state_key`.

    Args:
        substeps: smallest and largest delay, physics steps.
        decimation: physics steps per control step.
        size: width of the action, J; None asks the environment.
        state_key: `delay/<action_key>` if absent.

    Examples:
        >>> env = TransformedEnv(base, ActionDelay(substeps=(4, 4), decimation=4))  # of one control step
        >>> td = env.reset()
        >>> for target in (0.1, 0.2, 0.3):
        ...     td = env.step_mdp(env.step(td.set("action", torch.full((2, 29), target))))
        >>> td["robot", "joint_target"][0, 0]
        tensor(0.2000)
    """

    training_only = True

    def __init__(
        self,
        substeps: Sequence[int],
        decimation: int,
        size: int | None = None,
        action_key: NestedKey = "action",
        state_key: NestedKey | None = None,
    ):
        super().__init__(action_key, size)
        self.low, self.high = (int(s) for s in substeps)
        if not 0 <= self.low <= self.high:
            raise ValueError(f"action.delay.substeps: expected 0 <= low <= high, got {list(substeps)}")
        self.decimation = decimation
        key = below("delay", self.action_key) if state_key is None else state_key
        self._history, self._substeps, self._fresh = (below(key, name) for name in ("history", "substeps", "fresh"))
        self._targets = below(key, "targets")  # from the way in to the end of the same step
        self.depth = -(-self.high // decimation)  # control steps to remember

    @property
    def own_keys(self) -> list[NestedKey]:
        return [self._history, self._substeps, self._fresh]

    def initial_state(self, batch_size: torch.Size, device: torch.device | None) -> dict[NestedKey, Tensor]:
        return {
            self._history: torch.zeros(*batch_size, max(self.depth, 1), self.size, device=device),
            self._substeps: torch.randint(self.low, self.high + 1, (*batch_size, 1), device=device),
            self._fresh: torch.ones(*batch_size, 1, dtype=torch.bool, device=device),
        }

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get(self.action_key, None)
        if action is not None:
            history, delay, fresh = (tensordict.get(key) for key in (self._history, self._substeps, self._fresh))
            present = action.unsqueeze(-2)  # [..., 1, J]
            history = torch.where(fresh.unsqueeze(-1), present.expand_as(history), history)
            targets = torch.cat([present, history], dim=-2)  # newest first [..., 1 + depth, J]
            substep = torch.arange(self.decimation, device=action.device)
            age = (delay - substep + self.decimation - 1).clamp(min=0) // self.decimation  # [..., decimation]
            index = age.unsqueeze(-1).expand(*age.shape, action.shape[-1])
            tensordict.set(self.action_key, targets.gather(-2, index))
            tensordict.set(self._targets, targets)
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        kept = tensordict.get(self._history).shape[-2]
        next_tensordict.set(self._history, tensordict.get(self._targets)[..., :kept, :].contiguous())
        next_tensordict.set(self._substeps, tensordict.get(self._substeps))
        next_tensordict.set(self._fresh, torch.zeros_like(tensordict.get(self._fresh)))
        return next_tensordict


class ActionHistory(StateTransform):
    """Keeps the policy's latest actions, newest first, zeros before the episode: `out_key` [..., H, A].

    Reads `action_key` of the stepped tensordict.

    Args:
        steps: H.
        size: A; None asks the environment, for the width of its `env_action_key`.

    Examples:
        >>> env = TransformedEnv(base, ActionHistory(steps=3, action_key="action"))
        >>> td = env.reset()
        >>> for target in (0.1, 0.2):
        ...     td = env.step_mdp(env.step(td.set("action", torch.full((2, 29), target))))
        >>> td["action_history"][0, :, 0]
        tensor([0.2000, 0.1000, 0.0000])
    """

    def __init__(
        self,
        steps: int,
        size: int | None = None,
        action_key: NestedKey = "policy_action",
        out_key: NestedKey = "action_history",
        env_action_key: NestedKey = "action",
    ):
        super().__init__(out_keys=[key_of(out_key)])
        self.steps, self._size = steps, size
        self.action_key, self.env_action_key = key_of(action_key), key_of(env_action_key)

    @property
    def own_keys(self) -> list[NestedKey]:
        return [self.out_keys[0]]

    def initial_state(self, batch_size: torch.Size, device: torch.device | None) -> dict[NestedKey, Tensor]:
        if self._size is None:
            self._size = width_of_action(self, self.env_action_key)
        return {self.out_keys[0]: torch.zeros(*batch_size, self.steps, self._size, device=device)}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        history = tensordict.get(self.out_keys[0])
        newest = tensordict.get(self.action_key).unsqueeze(-2)
        next_tensordict.set(self.out_keys[0], torch.cat([newest, history[..., :-1, :]], dim=-2))
        return next_tensordict
