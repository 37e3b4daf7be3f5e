"""Environments that play a script instead of physics, and what the tests of transforms share."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib import import_module
from types import ModuleType

import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv

from hdmi.assembly import Task, make_task
from hdmi.config import CONF
from hdmi.transforms.common import spec_like

Script = Mapping[NestedKey, Tensor]


def command(name: str) -> ModuleType:
    """The module of a command, to call its `main`."""
    return import_module(f"hdmi.commands.{name}")


class ScriptedEnv(EnvBase):
    """N worlds that read their state from tables: world i in step t of its episode shows `script[key][t, i]`.

    Past the end the last row stays. The latest action that arrived is kept in `received`.

    Args:
        script: key -> table [T, N, ...].
        action_size: width of the action.
        episode_steps: steps after which an episode terminates; None for never.
        truncates: whether there is a `truncated` entry.
        done_group: under which the three are; at the top if None.
    """

    batch_locked = True

    def __init__(
        self,
        script: Script,
        action_size: int = 4,
        episode_steps: int | None = None,
        truncates: bool = True,
        action_key: NestedKey = "action",
        reward_key: NestedKey = "reward",
        done_group: str | None = None,
    ):
        self.script = {unravel_key(key): table for key, table in script.items()}
        self.length, n = next(iter(self.script.values())).shape[:2]
        super().__init__(batch_size=[n])
        self.episode_steps, self.action_name, self.reward_name = episode_steps, action_key, reward_key
        self.counter = torch.zeros(n, dtype=torch.int64)
        self.received: Tensor | None = None
        specs = Composite(shape=(n,))
        for key, table in self.script.items():
            specs[key] = spec_like(table[0])
        self.observation_spec = specs
        self.full_action_spec = Composite({action_key: Unbounded(shape=(n, action_size))}, shape=(n,))
        self.full_reward_spec = Composite({reward_key: Unbounded(shape=(n, 1))}, shape=(n,))
        names = ("done", "terminated", "truncated") if truncates else ("done", "terminated")
        self.done_names = [name if done_group is None else (done_group, name) for name in names]
        self.full_done_spec = Composite(
            {key: Binary(n=1, shape=(n, 1), dtype=torch.bool) for key in self.done_names}, shape=(n,)
        )

    def _state(self) -> TensorDict:
        rows, steps = torch.arange(len(self.counter)), self.counter.clamp(max=self.length - 1)
        out = TensorDict({}, batch_size=self.batch_size)
        for key, table in self.script.items():
            out.set(key, table[steps, rows])
        for key in self.done_names:
            out.set(key, torch.zeros(*self.batch_size, 1, dtype=torch.bool))
        return out

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.received = tensordict.get(self.action_name).clone()
        self.counter = self.counter + 1
        out = self._state()
        out.set(self.reward_name, torch.zeros(*self.batch_size, 1))
        if self.episode_steps is not None:
            ended = (self.counter >= self.episode_steps).unsqueeze(-1)
            out.set(self.done_names[1], ended)
            out.set(self.done_names[0], ended.clone())
        return out

    def _reset(self, tensordict: TensorDictBase | None, **kwargs) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones(self.batch_size, dtype=torch.bool) if mask is None else mask.reshape(self.batch_size)
        self.counter = torch.where(mask, 0, self.counter)
        return self._state()

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            torch.manual_seed(seed)


# Shapes of one world's entries; quaternions and flags are told from their names.
SHAPES: dict[NestedKey, tuple[int, ...]] = {
    ("robot", "joint_pos"): (29,),
    ("robot", "joint_vel"): (29,),
    ("robot", "joint_torque"): (29,),
    ("robot", "body_pos"): (30, 3),
    ("robot", "body_quat"): (30, 4),
    ("robot", "body_lin_vel"): (30, 3),
    ("robot", "body_ang_vel"): (30, 3),
    ("robot", "root_pos"): (3,),
    ("robot", "root_quat"): (4,),
    ("robot", "root_lin_vel"): (3,),
    ("robot", "root_ang_vel"): (3,),
    ("robot", "foot_force"): (2, 3),
    ("object", "pos"): (3,),
    ("object", "quat"): (4,),
    ("object", "link_pos"): (3,),
    ("object", "link_quat"): (4,),
    ("object", "scale"): (1,),
    ("contact", "force"): (2, 3),
    ("contact", "eef_pos"): (2, 3),
    ("contact", "target_pos"): (2, 3),
    ("ref", "contact"): (2,),
    ("ref", "contact_point"): (2, 3),
    ("ref", "joint_pos"): (4,),
    ("ref", "step"): (1,),
    ("feet", "force"): (2, 3),
    ("feet", "previous_force"): (2, 3),
    ("feet", "swing_time"): (2,),
    ("feet", "touchdown"): (2,),
    ("error", "many"): (4,),
    ("tracked", "body_pos"): (2, 3),
    ("ref", "body_pos"): (2, 3),
    ("error", "one"): (1,),
    ("obs", "x"): (5,),
    ("obs", "y"): (5,),
    ("obs", "pose"): (9,),
    "action_history": (3, 4),
}
_FLAGS = (("ref", "contact"), ("feet", "touchdown"))


def make_script(keys: Sequence[NestedKey], n: int = 3, steps: int = 8, seed: int = 0) -> dict[NestedKey, Tensor]:
    """Tables of plausible values, different in every world and step."""
    generator = torch.Generator().manual_seed(seed)
    script: dict[NestedKey, Tensor] = {"clock": torch.arange(float(steps)).reshape(-1, 1, 1).repeat(1, n, 1)}
    for key in keys:
        value = torch.randn(steps, n, *SHAPES[key], generator=generator)
        if key in _FLAGS:
            value = value > 0
        elif key == ("ref", "step"):
            value = torch.arange(steps).reshape(-1, 1, 1) + torch.arange(n).reshape(1, -1, 1)
        elif "quat" in key[-1]:
            value = value / value.norm(dim=-1, keepdim=True)
        elif key[0] == "error":
            value = value.abs()
        script[key] = value
    return script


def constant(value: Tensor | Sequence[float], n: int = 1, steps: int = 1) -> Tensor:
    """A table that shows one value everywhere."""
    value = torch.as_tensor(value)
    return value.expand(steps, n, *value.shape).clone()


def wrap(env: EnvBase, *transforms: Transform) -> TransformedEnv:
    """The environment under the transforms, the first next to it."""
    return TransformedEnv(env, Compose(*transforms))


def action_of(step: int, shape: Sequence[int]) -> Tensor:
    """An action that differs in every step, world and column."""
    count = torch.Size(shape).numel()
    return torch.sin(torch.arange(count, dtype=torch.float32) + 0.7 * step).reshape(tuple(shape))


def drive(
    env: EnvBase, steps: int, actions: Callable[[int], Tensor] | None = None, start: TensorDictBase | None = None
) -> list[TensorDictBase]:
    """Steps without resetting, from `start` or a reset. The stepped tensordicts, as the environment gave them."""
    tensordict, out = env.reset() if start is None else start, []
    shape = env.full_action_spec[env.action_key].shape
    for t in range(steps):
        tensordict.set(env.action_key, action_of(t, shape) if actions is None else actions(t))
        out.append(env.step(tensordict))
        tensordict = env.step_mdp(out[-1])
    return out


def assert_same(a: TensorDictBase, b: TensorDictBase, rows: Tensor | None = None) -> None:
    """Two tensordicts have the same keys and values (in the given rows), bit for bit."""
    keys = set(a.keys(True, True))
    assert keys == set(b.keys(True, True))
    for key in keys:
        x, y = a.get(key), b.get(key)
        if rows is not None:
            x, y = x[rows], y[rows]
        assert x.dtype == y.dtype, key
        assert torch.equal(x, y), key


@cache
def _composed(overrides: tuple[str, ...]) -> DictConfig:
    with initialize_config_dir(str(CONF), version_base=None):
        return compose("config", overrides=["num_threads=1", *overrides])


def load_config(*overrides: str) -> DictConfig:
    """The project's config with overrides."""
    return copy.deepcopy(_composed(overrides))  # a tenth of the time that composing takes


@cache
def lift_box() -> Task:
    """The embedded task. Shared: do not change its model."""
    return make_task(load_config())
