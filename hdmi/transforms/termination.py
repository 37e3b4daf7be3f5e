"""The paper's termination conditions as transforms: an error that stays above its threshold ends the episode.

A row of the table is a kernel bound to keys. `KernelTermination` binds any; the classes below it are the paper's rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from hdmi import functional as F
from hdmi.names import match_names
from hdmi.transforms.common import BoundKernel, StateTransform, below, key_of, raise_done, spec_like


class TerminationTerm(StateTransform):
    """Terminates when a condition has held for `min_steps` consecutive steps.

    Reads its in_keys from the next tensordict and the count from the present one; writes `count_key` int64 [N, 1], its
    state, and `flag_key` bool [N, 1]; raises `terminated` and `done`.

    Args:
        flag_key, count_key: `termination/<name>` and `termination_steps/<name>` if absent.

    Examples:
        >>> class Fallen(TerminationTerm):
        ...     def condition(self, *inputs):
        ...         return inputs[0][:, 2:] < 2.0  # the whole robot
        >>> env = TransformedEnv(base, Fallen("fallen", [("robot", "root_pos")], min_steps=3))
        >>> env.rollout(10)["next", "termination", "fallen"][0].flatten().tolist()
        [False, False, True]
    """

    def __init__(
        self,
        name: str,
        in_keys: Sequence[NestedKey | Sequence[str]],
        min_steps: int,
        terminated_key: NestedKey = "terminated",
        done_key: NestedKey = "done",
        flag_key: NestedKey | None = None,
        count_key: NestedKey | None = None,
    ):
        flag_key = below("termination", name) if flag_key is None else key_of(flag_key)
        super().__init__(in_keys=[key_of(key) for key in in_keys], out_keys=[flag_key])
        if min_steps < 1:
            raise ValueError(f"termination {name!r}: min_steps must be at least 1, got {min_steps}")
        self.min_steps = min_steps
        self.count_key = below("termination_steps", name) if count_key is None else key_of(count_key)
        self.terminated_key, self.done_key = key_of(terminated_key), key_of(done_key)

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
        raise_done(next_tensordict, fired, self.terminated_key, self.done_key)
        return next_tensordict

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec = super().transform_observation_spec(observation_spec)
        flag = torch.zeros(*observation_spec.shape, 1, dtype=torch.bool, device=observation_spec.device)
        observation_spec[self.out_keys[0]] = spec_like(flag)
        return observation_spec


class KernelTermination(TerminationTerm):
    """A termination whose condition is a kernel bound to keys: `function(*next[keys], **parameters)`.

    Args:
        function: gives bool [N, 1] from the entries; itself, or its dotted name, such as
            `hdmi.functional.contact_lost`.
        keys: of its tensors, in its order.
        parameters: its keyword arguments.

    Raises:
        ValueError: if there is no such function, or it does not take these keys and parameters.

    Examples:
        >>> term = KernelTermination("hdmi.functional.error_exceeds", ["speed"], "fast", min_steps=2, threshold=1.0)
        >>> term.condition(torch.tensor([[0.5], [1.5]]))
        tensor([[False],
                [ True]])
    """

    def __init__(
        self,
        function: Callable[..., Tensor] | str,
        keys: Sequence[NestedKey | Sequence[str]],
        name: str,
        min_steps: int = 25,
        terminated_key: NestedKey = "terminated",
        done_key: NestedKey = "done",
        flag_key: NestedKey | None = None,
        count_key: NestedKey | None = None,
        **parameters: Any,
    ):
        super().__init__(name, keys, min_steps, terminated_key, done_key, flag_key, count_key)
        self.kernel = BoundKernel(function, len(self.in_keys), f"termination {name!r}", parameters)

    def condition(self, *inputs: Tensor) -> Tensor:
        return self.kernel(*inputs)


class ErrorTermination(KernelTermination):
    """Root, body-local and object pose errors: any of the errors above its threshold.

    Args:
        errors: keys of errors [N, K].
        thresholds: one per error, in its unit.

    Examples:
        >>> term = ErrorTermination("far", errors=["position", "angle"], thresholds=[0.5, 1.0], min_steps=25)
        >>> term.condition(torch.tensor([[0.1, 0.6], [0.1, 0.2]]), torch.tensor([[0.2], [0.2]]))
        tensor([[ True],
                [False]])
    """

    def __init__(
        self,
        name: str,
        errors: Sequence[NestedKey],
        thresholds: Sequence[float],
        min_steps: int = 25,
        terminated_key: NestedKey = "terminated",
        done_key: NestedKey = "done",
        flag_key: NestedKey | None = None,
        count_key: NestedKey | None = None,
    ):
        thresholds = tuple(float(t) for t in thresholds)
        if len(thresholds) != len(errors):
            raise ValueError(f"termination {name!r}: give one threshold for each of {list(errors)}")
        keys = (terminated_key, done_key, flag_key, count_key)
        super().__init__(F.any_error_exceeds, errors, name, min_steps, *keys, thresholds=thresholds)


class LostContact(KernelTermination):
    """An intended contact is lost: too far from its contact point, or without force; see `functional.contact_lost`.

    Reads `contact/{eef_pos, target_pos, force}` [N, E, 3] (m, m, N) and `ref/contact` bool [N, E].

    Args:
        distance: m.
        min_force: N.
        require: for a loss, `either` of the two, or `both`.

    Raises:
        ValueError: for another `require`.

    Examples:
        >>> hand, target, force = torch.full((1, 1, 3), 0.3), torch.zeros(1, 1, 3), torch.zeros(1, 1, 3)
        >>> LostContact(distance=0.2).condition(hand, target, force, torch.tensor([[True]]))  # 0.52 m off
        tensor([[True]])
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
        terminated_key: NestedKey = "terminated",
        done_key: NestedKey = "done",
        flag_key: NestedKey | None = None,
        count_key: NestedKey | None = None,
    ):
        if require not in ("either", "both"):
            raise ValueError(f"termination {name!r}: require is 'either' or 'both', got {require!r}")
        super().__init__(
            F.contact_lost, [eef_pos_key, target_pos_key, force_key, active_key], name, min_steps,
            terminated_key, done_key, flag_key, count_key,
            distance=distance, min_force=min_force, require=require,
        )  # fmt: skip


class BodyHeight(TerminationTerm):
    """A body (the torso) is lower over the floor than a threshold, m, whatever the reference does.

    Args:
        body: among `body_names`, those of `body_pos_key` [N, B, 3].

    Examples:
        >>> low = BodyHeight("torso", body_names=["pelvis", "torso"], threshold=0.3)
        >>> low.condition(torch.tensor([[[0.0, 0.0, 0.2], [0.0, 0.0, 0.4]]]))  # the torso is 0.4 m high
        tensor([[False]])
    """

    def __init__(
        self,
        body: str,
        body_names: Sequence[str],
        name: str = "torso_height",
        threshold: float = 0.3,
        min_steps: int = 25,
        body_pos_key: NestedKey = ("robot", "body_pos"),
        terminated_key: NestedKey = "terminated",
        done_key: NestedKey = "done",
        flag_key: NestedKey | None = None,
        count_key: NestedKey | None = None,
    ):
        super().__init__(name, [body_pos_key], min_steps, terminated_key, done_key, flag_key, count_key)
        self.body = match_names([body], body_names, f"termination {name!r}")[0]
        self.threshold = threshold

    def condition(self, *inputs: Tensor) -> Tensor:
        return inputs[0][..., self.body, 2:] < self.threshold
