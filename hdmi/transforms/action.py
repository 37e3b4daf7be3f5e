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

from hdmi.assets import default_joint_pos, g1, match_names
from hdmi.transforms.common import SpecTransform, StateTransform, add_state_specs


class _ActionTransform(SpecTransform):
    """Rewrites the action on its way to the environment with what the tensordict holds."""

    def __init__(self, action_key: NestedKey = "action", state_keys: Sequence[NestedKey] = ()):
        super().__init__(in_keys_inv=[action_key], out_keys_inv=[action_key])
        self.action_key = action_key
        self.state_keys = list(state_keys)

    def inverse(self, action: Tensor, *state: Tensor) -> Tensor:
        raise NotImplementedError

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get(self.action_key, None)
        if action is not None:
            state = [tensordict.get(key) for key in self.state_keys]
            tensordict.set(self.action_key, self.inverse(action, *state))
        return tensordict

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        input_spec = super().transform_input_spec(input_spec)
        declared = input_spec["full_state_spec"]
        missing = [
            key for key in self.state_keys if declared is None or unravel_key(key) not in declared.keys(True, True)
        ]
        if missing and self.parent is not None:
            have = self.parent.full_observation_spec
            for key in missing:
                if unravel_key(key) not in have.keys(True, True):
                    raise KeyError(f"{type(self).__name__}: reads {key!r}, which nothing before it writes")
            add_state_specs(input_spec, {key: have[unravel_key(key)].clone() for key in missing})
        return input_spec


class JointPositionAction(_ActionTransform):
    """Scales the policy's action for each actuated joint and spreads it over all joints (zero elsewhere).

    Action: [..., A] for the A joints with a scale -> offsets [..., J], rad. The policy's own action stays in the
    stepped tensordict as `policy_action`.

    Args:
        scale: joint name pattern -> rad per unit of action; joints that match none are not actuated by the policy.
    """

    def __init__(
        self,
        scale: Mapping[str, float],
        joint_names: Sequence[str] = g1.JOINT_NAMES,
        action_key: NestedKey = "action",
    ):
        super().__init__(action_key)
        table = torch.zeros(len(joint_names))
        for pattern, value in scale.items():
            table[match_names([pattern], joint_names, "action.joint_position.scale")] = float(value)
        index = table.nonzero().squeeze(-1)
        self.register_buffer("index", index, persistent=False)
        self.register_buffer("scale", table[index], persistent=False)
        self.num_joints = len(joint_names)

    def inverse(self, action: Tensor, *state: Tensor) -> Tensor:
        offsets = action.new_zeros(*action.shape[:-1], self.num_joints)
        offsets[..., self.index] = action * self.scale
        return offsets

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get(self.action_key, None)
        if action is not None:
            tensordict.set("policy_action", action)
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
    """

    def __init__(self, base_key: NestedKey = ("ref", "joint_pos"), action_key: NestedKey = "action"):
        super().__init__(action_key, [base_key])

    def inverse(self, action: Tensor, *state: Tensor) -> Tensor:
        return state[0] + action


class DefaultPoseAction(_ActionTransform):
    """Action space of the paper's ablation: target = theta_default + a.

    Args:
        default_pos: joint angles, rad; the robot's standing pose by default. [J]
    """

    def __init__(self, default_pos: Sequence[float] | None = None, action_key: NestedKey = "action"):
        super().__init__(action_key)
        values = default_joint_pos() if default_pos is None else default_pos
        self.register_buffer("default_pos", torch.as_tensor(values, dtype=torch.float32), persistent=False)

    def inverse(self, action: Tensor, *state: Tensor) -> Tensor:
        return self.default_pos + action


class _ActionStateTransform(_ActionTransform, StateTransform):
    """An action transform with state of its own in the tensordict."""

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        return StateTransform.transform_input_spec(self, input_spec)


class ActionSmoothing(_ActionStateTransform):
    """Low-pass filter of the targets: x_t = alpha u_t + (1 - alpha) x_{t-1}, alpha drawn per episode.

    Reads and writes `smoothing/{previous, alpha, fresh}`; the first step of an episode is not filtered.

    Args:
        alpha: range of the filter coefficient.
        size: width of the action, J.
    """

    def __init__(
        self, alpha: Sequence[float] = (0.8, 1.0), size: int = len(g1.JOINT_NAMES), action_key: NestedKey = "action"
    ):
        super().__init__(action_key)
        low, high = alpha
        if not 0 < low <= high <= 1:
            raise ValueError(f"action.smoothing.alpha: expected 0 < low <= high <= 1, got {list(alpha)}")
        self.low, self.high, self.size = float(low), float(high), size

    def initial_state(self, batch_size: torch.Size, device: torch.device | None) -> dict[NestedKey, Tensor]:
        alpha = self.low + (self.high - self.low) * torch.rand(*batch_size, 1, device=device)
        return {
            ("smoothing", "previous"): torch.zeros(*batch_size, self.size, device=device),
            ("smoothing", "alpha"): alpha,
            ("smoothing", "fresh"): torch.ones(*batch_size, 1, dtype=torch.bool, device=device),
        }

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get(self.action_key, None)
        if action is not None:
            previous, alpha, fresh = (tensordict.get(("smoothing", k)) for k in ("previous", "alpha", "fresh"))
            smoothed = torch.where(fresh, action, alpha * action + (1 - alpha) * previous)
            tensordict.set(self.action_key, smoothed)
            tensordict.set("smoothed_action", smoothed)
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        next_tensordict.set(("smoothing", "previous"), tensordict.get("smoothed_action"))
        next_tensordict.set(("smoothing", "alpha"), tensordict.get(("smoothing", "alpha")))
        fresh = tensordict.get(("smoothing", "fresh"))
        next_tensordict.set(("smoothing", "fresh"), torch.zeros_like(fresh))
        return next_tensordict


class ActionDelay(_ActionStateTransform):
    """Delays targets by a number of physics steps, drawn per episode.

    The environment receives one target per physics step: [..., J] -> [..., decimation, J]. With delay d, physics
    step k of control step t uses the target of control step t - ceil((d - k) / decimation); before an episode's
    first target arrives, that target is used. Reads and writes `delay/{history, substeps, fresh}`.

    Args:
        substeps: smallest and largest delay, physics steps.
        decimation: physics steps per control step.
        size: width of the action, J.
    """

    def __init__(
        self,
        substeps: Sequence[int],
        decimation: int,
        size: int = len(g1.JOINT_NAMES),
        action_key: NestedKey = "action",
    ):
        super().__init__(action_key)
        self.low, self.high = (int(s) for s in substeps)
        if not 0 <= self.low <= self.high:
            raise ValueError(f"action.delay.substeps: expected 0 <= low <= high, got {list(substeps)}")
        self.decimation, self.size = decimation, size
        self.depth = -(-self.high // decimation)  # control steps to remember

    def initial_state(self, batch_size: torch.Size, device: torch.device | None) -> dict[NestedKey, Tensor]:
        return {
            ("delay", "history"): torch.zeros(*batch_size, max(self.depth, 1), self.size, device=device),
            ("delay", "substeps"): torch.randint(self.low, self.high + 1, (*batch_size, 1), device=device),
            ("delay", "fresh"): torch.ones(*batch_size, 1, dtype=torch.bool, device=device),
        }

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get(self.action_key, None)
        if action is not None:
            history, delay, fresh = (tensordict.get(("delay", k)) for k in ("history", "substeps", "fresh"))
            present = action.unsqueeze(-2)  # [..., 1, J]
            history = torch.where(fresh.unsqueeze(-1), present.expand_as(history), history)
            targets = torch.cat([present, history], dim=-2)  # newest first [..., 1 + depth, J]
            substep = torch.arange(self.decimation, device=action.device)
            age = (delay - substep + self.decimation - 1).clamp(min=0) // self.decimation  # [..., decimation]
            index = age.unsqueeze(-1).expand(*age.shape, action.shape[-1])
            tensordict.set(self.action_key, targets.gather(-2, index))
            tensordict.set("delay_targets", targets)
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        history = tensordict.get(("delay", "history"))
        next_tensordict.set(
            ("delay", "history"), tensordict.get("delay_targets")[..., : history.shape[-2], :].contiguous()
        )
        next_tensordict.set(("delay", "substeps"), tensordict.get(("delay", "substeps")))
        next_tensordict.set(("delay", "fresh"), torch.zeros_like(tensordict.get(("delay", "fresh"))))
        return next_tensordict


class ActionHistory(StateTransform):
    """Keeps the policy's latest actions, newest first, zeros before the episode: `out_key` [..., H, A].

    Reads `action_key` of the stepped tensordict.
    """

    def __init__(
        self,
        steps: int,
        size: int,
        action_key: NestedKey = "policy_action",
        out_key: NestedKey = "action_history",
    ):
        super().__init__(out_keys=[out_key])
        self.steps, self.size, self.action_key = steps, size, action_key

    def initial_state(self, batch_size: torch.Size, device: torch.device | None) -> dict[NestedKey, Tensor]:
        return {self.out_keys[0]: torch.zeros(*batch_size, self.steps, self.size, device=device)}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        history = tensordict.get(self.out_keys[0])
        newest = tensordict.get(self.action_key).unsqueeze(-2)
        next_tensordict.set(self.out_keys[0], torch.cat([newest, history[..., :-1, :]], dim=-2))
        return next_tensordict
