"""The paper's termination conditions as transforms: an error that stays above its threshold ends the episode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from hdmi import functional as F
from hdmi.assets import g1, match_names
from hdmi.transforms.common import StateTransform, set_terminated, spec_like


class TerminationTerm(StateTransform):
    """Terminates when a condition has held for `min_steps` consecutive steps.

    Reads its in_keys from the next tensordict and the count from the present one; writes
    `termination_steps/<name>` int64 [N, 1] and `termination/<name>` bool [N, 1]; raises `terminated` and `done`.
    """

    def __init__(self, name: str, in_keys: Sequence[NestedKey | Sequence[str]], min_steps: int):
        keys = [key if isinstance(key, str) else tuple(key) for key in in_keys]
        super().__init__(in_keys=keys, out_keys=[("termination", name)])
        if min_steps < 1:
            raise ValueError(f"termination {name!r}: min_steps must be at least 1, got {min_steps}")
        self.min_steps = min_steps
        self.count_key: NestedKey = ("termination_steps", name)

    def condition(self, *inputs: Tensor) -> Tensor:
        """Whether the condition holds in this step. bool [N, 1]"""
        raise NotImplementedError

    def initial_state(self, batch_size: torch.Size, device: torch.device | None) -> dict[NestedKey, Tensor]:
        return {self.count_key: torch.zeros(*batch_size, 1, dtype=torch.int64, device=device)}

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        tensordict_reset = super()._reset(tensordict, tensordict_reset)
        count = tensordict_reset.get(self.count_key)
        tensordict_reset.set(self.out_keys[0], torch.zeros_like(count, dtype=torch.bool))
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        holds = self.condition(*(next_tensordict.get(key) for key in self.in_keys))
        count = F.persist(holds, tensordict.get(self.count_key))
        fired = count >= self.min_steps
        next_tensordict.set(self.count_key, count)
        next_tensordict.set(self.out_keys[0], fired)
        set_terminated(next_tensordict, fired)
        return next_tensordict

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec = super().transform_observation_spec(observation_spec)
        flag = torch.zeros(*observation_spec.shape, 1, dtype=torch.bool, device=observation_spec.device)
        observation_spec[self.out_keys[0]] = spec_like(flag)
        return observation_spec


class ErrorTermination(TerminationTerm):
    """Root, body-local and object pose errors: any of the errors above its threshold.

    Args:
        errors: keys of errors [N, K]. thresholds: one per error, in its unit.
    """

    def __init__(self, name: str, errors: Sequence[NestedKey], thresholds: Sequence[float], min_steps: int = 25):
        super().__init__(name, errors, min_steps)
        self.thresholds = [float(t) for t in thresholds]
        if len(self.thresholds) != len(self.in_keys):
            raise ValueError(f"termination {name!r}: give one threshold for each of {self.in_keys}")

    def condition(self, *inputs: Tensor) -> Tensor:
        exceeded = [F.error_exceeds(e, t) for e, t in zip(inputs, self.thresholds, strict=True)]
        return torch.stack(exceeded).any(0)


class LostContact(TerminationTerm):
    """An intended contact is lost: too far from its contact point, or without force; see `functional.contact_lost`.

    Reads `contact/{eef_pos, target_pos, force}` [N, E, 3] (m, m, N) and `ref/contact` bool [N, E].

    Args:
        distance: m. min_force: N.
        require: for a loss, `either` of the two, or `both`.

    Raises:
        ValueError: for another `require`.
    """

    def __init__(
        self,
        name: str = "lost_contact",
        distance: float = 0.2,
        min_force: float = 1.0,
        min_steps: int = 25,
        require: Literal["either", "both"] = "either",
        eef_pos_key: NestedKey = ("contact", "eef_pos"),
        target_pos_key: NestedKey = ("contact", "target_pos"),
        force_key: NestedKey = ("contact", "force"),
        active_key: NestedKey = ("ref", "contact"),
    ):
        super().__init__(name, [eef_pos_key, target_pos_key, force_key, active_key], min_steps)
        if require not in ("either", "both"):
            raise ValueError(f"termination {name!r}: require is 'either' or 'both', got {require!r}")
        self.distance, self.min_force = distance, min_force
        self.require: Literal["either", "both"] = require

    def condition(self, *inputs: Tensor) -> Tensor:
        return F.contact_lost(*inputs, distance=self.distance, min_force=self.min_force, require=self.require)


class BodyHeight(TerminationTerm):
    """A body (the torso) is lower over the floor than a threshold, m, whatever the reference does."""

    def __init__(
        self,
        name: str = "torso_height",
        threshold: float = 0.3,
        min_steps: int = 25,
        body: str = "torso_link",
        body_pos_key: NestedKey = ("robot", "body_pos"),
        body_names: Sequence[str] = g1.BODY_NAMES,
    ):
        super().__init__(name, [body_pos_key], min_steps)
        self.body = match_names([body], body_names, f"termination {name!r}")[0]
        self.threshold = threshold

    def condition(self, *inputs: Tensor) -> Tensor:
        return inputs[0][..., self.body, 2:] < self.threshold
