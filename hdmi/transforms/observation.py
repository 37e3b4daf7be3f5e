"""Observation terms: quantities in the robot's root frame, noise on them, and the exit of the stack."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from hdmi.functional import (
    quat_apply,
    quat_apply_inverse,
    quat_conjugate,
    quat_from_euler,
    quat_multiply,
    quat_to_rot6d,
)
from hdmi.transforms.common import (
    FunctionTransform,
    SpecTransform,
    add_state,
    add_state_specs,
    below,
    copied,
    key_of,
    spec_like,
    without_drawing,
)

_ROOT_POS: NestedKey = ("robot", "root_pos")
_ROOT_QUAT: NestedKey = ("robot", "root_quat")


class VectorInRoot(FunctionTransform):
    """A world vector (velocity, force) in the root frame. [N, 3] or [N, E, 3] -> [N, 3] or [N, 3 E]

    Examples:
        >>> half_turn = torch.tensor([[0.0, 0.0, 0.0, 1.0]])  # about z
        >>> td = TensorDict({("robot", "root_quat"): half_turn, "velocity": torch.tensor([[1.0, 2.0, 3.0]])}, [1])
        >>> VectorInRoot("velocity", ("obs", "velocity"))(td)["obs", "velocity"]
        tensor([[-1., -2.,  3.]])
    """

    def __init__(self, in_key: NestedKey, out_key: NestedKey, root_quat_key: NestedKey = _ROOT_QUAT):
        super().__init__([in_key, root_quat_key], [out_key])

    def function(self, *inputs: Tensor) -> Tensor:
        vector, quat = inputs
        return _flat(quat_apply_inverse(_like(quat, vector), vector), quat)


class PointInRoot(FunctionTransform):
    """World points in the root frame. [N, 3] or [N, E, 3] -> [N, 3] or [N, 3 E]

    Examples:
        >>> root = {("robot", "root_pos"): torch.tensor([[1.0, 0.0, 0.8]]), ("robot", "root_quat"): torch.eye(4)[3:]}
        >>> td = TensorDict(root | {"hands": torch.tensor([[[0.0, 0.0, 0.8], [1.0, 1.0, 1.0]]])}, [1])
        >>> PointInRoot("hands", "hands_b")(td)["hands_b"]  # half a turn about z, where the root is
        tensor([[ 1.0000,  0.0000,  0.0000,  0.0000, -1.0000,  0.2000]])
    """

    def __init__(
        self,
        in_key: NestedKey,
        out_key: NestedKey,
        root_pos_key: NestedKey = _ROOT_POS,
        root_quat_key: NestedKey = _ROOT_QUAT,
    ):
        super().__init__([in_key, root_pos_key, root_quat_key], [out_key])

    def function(self, *inputs: Tensor) -> Tensor:
        point, pos, quat = inputs
        return _flat(quat_apply_inverse(_like(quat, point), point - _like(pos, point)), quat)


class PoseInRoot(FunctionTransform):
    """A world pose in the root frame: position and the first two columns of its rotation.

    The unified object representation (section III-B-1). [N, 3], [N, 4] -> [N, 9]

    Examples:
        >>> root = {("robot", "root_pos"): torch.tensor([[1.0, 0.0, 1.0]]), ("robot", "root_quat"): torch.eye(4)[:1]}
        >>> td = TensorDict(root | {"pos": torch.tensor([[3.0, 0.0, 1.0]]), "quat": torch.eye(4)[:1]}, [1])
        >>> PoseInRoot("pos", "quat", "pose")(td)["pose"]  # 2 m ahead, not turned
        tensor([[2., 0., 0., 1., 0., 0., 0., 1., 0.]])
    """

    def __init__(
        self,
        pos_key: NestedKey,
        quat_key: NestedKey,
        out_key: NestedKey,
        root_pos_key: NestedKey = _ROOT_POS,
        root_quat_key: NestedKey = _ROOT_QUAT,
    ):
        super().__init__([pos_key, quat_key, root_pos_key, root_quat_key], [out_key])

    def function(self, *inputs: Tensor) -> Tensor:
        pos, quat, root_pos, root_quat = inputs
        return torch.cat(
            [
                quat_apply_inverse(root_quat, pos - root_pos),
                quat_to_rot6d(quat_multiply(quat_conjugate(root_quat), quat)),
            ],
            dim=-1,
        )


class ProjectedGravity(FunctionTransform):
    """Direction of gravity in the root frame. [N, 4] -> [N, 3]

    Examples:
        >>> upside_down = torch.tensor([[0.0, 1.0, 0.0, 0.0]])
        >>> ProjectedGravity("gravity")(TensorDict({("robot", "root_quat"): upside_down}, [1]))["gravity"]
        tensor([[0., 0., 1.]])
    """

    def __init__(self, out_key: NestedKey, root_quat_key: NestedKey = _ROOT_QUAT):
        super().__init__([root_quat_key], [out_key])
        self.register_buffer("down", torch.tensor([0.0, 0.0, -1.0]), persistent=False)

    def function(self, *inputs: Tensor) -> Tensor:
        return quat_apply_inverse(inputs[0], self.down.expand(*inputs[0].shape[:-1], 3))


class RelativeJointPos(FunctionTransform):
    """Joint positions relative to the default pose, rad. [N, J] -> [N, J]

    Args:
        default_pos: joint angles, rad. [J]

    Examples:
        >>> td = TensorDict({("robot", "joint_pos"): torch.tensor([[0.5, 1.0]])}, [1])
        >>> RelativeJointPos("out", default_pos=[0.5, 0.5])(td)["out"]
        tensor([[0.0000, 0.5000]])
    """

    def __init__(self, out_key: NestedKey, default_pos: Sequence[float], in_key: NestedKey = ("robot", "joint_pos")):
        super().__init__([in_key], [out_key])
        self.register_buffer("default_pos", torch.as_tensor(default_pos, dtype=torch.float32), persistent=False)

    def function(self, *inputs: Tensor) -> Tensor:
        return inputs[0] - self.default_pos


class Flatten(FunctionTransform):
    """An entry as one feature vector per world, float32. [N, ...] -> [N, D]

    TorchRL's FlattenObservation flattens between two dimensions that are given; how many there are differs here, and
    flags become numbers.

    Examples:
        >>> td = TensorDict({"contact": torch.tensor([[[True, False], [True, True]]])}, [1])
        >>> Flatten("contact", "out")(td)["out"]
        tensor([[1., 0., 1., 1.]])
    """

    def __init__(self, in_key: NestedKey, out_key: NestedKey):
        super().__init__([in_key], [out_key])

    def function(self, *inputs: Tensor) -> Tensor:
        value = inputs[0]
        return value.reshape(value.shape[0], -1).float()


class Difference(FunctionTransform):
    """a - b as one feature vector per world. [N, ...], [N, ...] -> [N, D]

    Examples:
        >>> td = TensorDict({"a": torch.tensor([[[1.0], [2.0]]]), "b": torch.tensor([[[0.5], [0.0]]])}, [1])
        >>> Difference("a", "b", "out")(td)["out"]
        tensor([[0.5000, 2.0000]])
    """

    def __init__(self, a_key: NestedKey, b_key: NestedKey, out_key: NestedKey):
        super().__init__([a_key, b_key], [out_key])

    def function(self, *inputs: Tensor) -> Tensor:
        return (inputs[0] - inputs[1]).flatten(1)


def _like(root: Tensor, value: Tensor) -> Tensor:
    """Root quantity [N, D] broadcast against [N, D] or [N, E, D]."""
    return root.unsqueeze(-2).expand(*value.shape[:-1], -1) if value.ndim > root.ndim else root


def _flat(value: Tensor, root: Tensor) -> Tensor:
    return value.flatten(-2) if value.ndim > root.ndim else value


class UniformNoise(FunctionTransform):
    """Adds fresh uniform noise in [-scale, scale] to an entry, in place of it.

    Args:
        scale: half range: one figure, or one per feature.

    Examples:
        >>> noisy = UniformNoise("x", scale=0.1)(TensorDict({"x": torch.ones(1, 1000)}, [1]))["x"]
        >>> bool((noisy - 1).abs().max() < 0.101), bool(noisy.std() > 0.05)
        (True, True)
    """

    training_only = True

    def __init__(self, key: NestedKey, scale: float | Sequence[float]):
        super().__init__([key], [key])
        self.register_buffer("scale", torch.as_tensor(scale, dtype=torch.float32), persistent=False)

    def function(self, *inputs: Tensor) -> Tensor:
        value = inputs[0]
        return value + (2 * torch.rand_like(value) - 1) * self.scale


class _EntryState(SpecTransform):
    """Base of transforms that rewrite an entry with state of their own, whose shape follows from the entry."""

    def __init__(self, key: NestedKey, state_key: NestedKey):
        super().__init__(in_keys=[key_of(key)], out_keys=[key_of(key)])
        self.state_key = key_of(state_key)
        self._features: torch.Size | None = None  # of the entry, once specs have been asked for

    def fresh_state(self, value: Tensor) -> Tensor:
        """State of a new episode that starts with this value of the entry."""
        raise NotImplementedError

    def update(self, value: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """New value of the entry, and state of the next step."""
        raise NotImplementedError

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        value = tensordict_reset.get(self.in_keys[0])
        return self._write(tensordict_reset, value, self.fresh_state(value))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._write(next_tensordict, next_tensordict.get(self.in_keys[0]), tensordict.get(self.state_key))

    def _write(self, tensordict: TensorDictBase, value: Tensor, state: Tensor) -> TensorDictBase:
        value, state = self.update(value, state)
        tensordict.set(self.in_keys[0], value)
        tensordict.set(self.state_key, state)
        return tensordict

    @without_drawing
    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec = copied(observation_spec)
        value = observation_spec[self.in_keys[0]].zero()
        self._features = value.shape[len(observation_spec.shape) :]
        value, state = self.update(value, self.fresh_state(value))
        observation_spec[self.in_keys[0]] = spec_like(value)
        add_state(observation_spec, self.state_key, state, self)
        return observation_spec

    @without_drawing
    def transform_input_spec(self, input_spec: Composite) -> Composite:
        input_spec = super().transform_input_spec(input_spec)
        if self._features is None and self.parent is not None:
            value = self.parent.full_observation_spec[self.in_keys[0]]
            self._features = value.shape[len(input_spec.shape) :]
        if self._features is not None:
            value = torch.zeros(*input_spec.shape, *self._features, device=input_spec.device)
            add_state_specs(input_spec, {self.state_key: spec_like(self.fresh_state(value))})
        return input_spec

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise NotImplementedError(
            f"{type(self).__name__} carries state from step to step and works in an environment only"
        )


class EpisodeNoise(_EntryState):
    """Adds a uniform offset that is drawn once per episode to an entry, in place of it.

    State: the offset, [N, D].

    Args:
        scale: half range.
        state_key: `episode_noise/<key>` if absent.

    Examples:
        >>> env = TransformedEnv(base, EpisodeNoise(("robot", "joint_pos"), scale=0.1))
        >>> td = env.reset()
        >>> after = env.rollout(3)["next", "episode_noise", "robot", "joint_pos"]
        >>> after.shape, bool((after[:, 0] == after[:, -1]).all()), bool((after.abs() <= 0.1).all())
        (torch.Size([2, 3, 29]), True, True)
    """

    training_only = True

    def __init__(self, key: NestedKey, scale: float, state_key: NestedKey | None = None):
        super().__init__(key, below("episode_noise", key_of(key)) if state_key is None else state_key)
        self.scale = scale

    def fresh_state(self, value: Tensor) -> Tensor:
        return (2 * torch.rand_like(value) - 1) * self.scale

    def update(self, value: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        return value + state, state.clone()


class HeadingNoise(FunctionTransform):
    """Turns an observed pose [N, 9] (see `PoseInRoot`) about the root's z axis by fresh uniform noise.

    Args:
        scale: half range, rad.

    Examples:
        >>> pose = torch.tensor([[2.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]])  # ahead, not turned
        >>> turned = HeadingNoise("pose", scale=0.1)(TensorDict({"pose": pose}, [1]))["pose"]
        >>> turned[:, :3], bool(turned[0, 4].abs() < 0.1)  # the sine of the angle
        (tensor([[2., 0., 0.]]), True)
    """

    training_only = True

    def __init__(self, key: NestedKey, scale: float):
        super().__init__([key], [key])
        self.noise = scale

    def function(self, *inputs: Tensor) -> Tensor:
        pose = inputs[0]
        yaw = (2 * torch.rand_like(pose[..., :1]) - 1) * self.noise
        turn = quat_from_euler(torch.cat([torch.zeros_like(yaw), torch.zeros_like(yaw), yaw], dim=-1)).unsqueeze(-2)
        columns = pose[..., 3:].unflatten(-1, (2, 3))
        return torch.cat([pose[..., :3], quat_apply(turn.expand(*columns.shape[:-1], 4), columns).flatten(-2)], dim=-1)


class History(_EntryState):
    """Stacks an observation with its past, newest first, in place of it: [N, D] -> [N, (1 + steps) D].

    At the start of an episode the first observation fills the past. State: the past, [N, steps, D]; TorchRL's CatFrames
    keeps it in the module, where a reset of some rows, a worker or a checkpoint does not find it.

    Args:
        steps: past observations to keep.
        state_key: `history/<key>` if absent.

    Examples:
        >>> env = TransformedEnv(base, History(("robot", "joint_pos"), steps=2))
        >>> env.rollout(3)["robot", "joint_pos"].shape  # 29 joints, now and twice before
        torch.Size([2, 3, 87])
    """

    def __init__(self, key: NestedKey, steps: int, state_key: NestedKey | None = None):
        super().__init__(key, below("history", key_of(key)) if state_key is None else state_key)
        if steps < 1:
            raise ValueError(f"history of {key}: steps must be at least 1, got {steps}")
        self.steps = steps

    def fresh_state(self, value: Tensor) -> Tensor:
        return value.unsqueeze(-2).expand(*value.shape[:-1], self.steps, value.shape[-1])

    def update(self, value: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        stacked = torch.cat([value.unsqueeze(-2), state], dim=-2)  # [N, 1 + steps, D]
        return stacked.flatten(-2), stacked[..., :-1, :].contiguous()
