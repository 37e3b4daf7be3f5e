"""The environment on a device that cannot be asked: PyTorch's meta device, tensors that have no values."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from mocks import lift_box, load_config
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from hdmi.assembly import make_env
from hdmi.envs import BatchBackend, MaskedResetEnv
from hdmi.envs.backend import LiveBackend

N = 4
# Drawn per world, the numbers of a run come from a seed that is read once, at the first reset.
PER_EPISODE = tuple(
    f"randomization.{term}.per=episode" for term in ("object_scale", "robot_mass", "robot_com", "robot_friction")
)


class GhostBackend(LiveBackend):
    """Live tensors on the meta device, and an engine that leaves them alone."""

    masked = True

    def __init__(self, model: mujoco.MjModel, num_worlds: int):
        super().__init__()
        self.num_worlds, self.device = num_worlds, torch.device("meta")
        self._real = BatchBackend(model, num_worlds)

    def _bind(self, field: str) -> Tensor:
        return self._real.data(field).float().to(self.device)

    def _expand(self, field: str) -> Tensor:
        return self._real.model(field).float().to(self.device)

    def step(self, controls: Tensor) -> None:
        assert controls.device == self.device

    def reset(self, worlds: Tensor) -> None:
        assert (worlds.device, worlds.dtype, worlds.shape) == (self.device, torch.bool, (N,))

    refresh = commit_model = reset


class OneDevice(TorchDispatchMode):
    """Fails where a tensor of the host meets one of the device; questions of the host fail by themselves."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        tensors = [t for t in tree_leaves((args, kwargs, out)) if isinstance(t, Tensor)]
        assert all(t.is_meta for t in tensors), f"{func}: {[(t.device, tuple(t.shape)) for t in tensors]}"
        return out


class NoHostData(TorchFunctionMode):
    """Fails where lists or arrays become tensors, as indices do; on a GPU each is a copy that waits."""

    COPIES = (torch.tensor, torch.as_tensor, torch.from_numpy, Tensor.new_tensor, Tensor.cpu, Tensor.numpy)

    def __torch_function__(self, func, types, args=(), kwargs=None):
        assert func not in self.COPIES, func
        if func in (Tensor.__getitem__, Tensor.__setitem__):
            index = args[1] if isinstance(args[1], tuple) else (args[1],)
            assert not any(isinstance(i, list | np.ndarray) for i in index), index
        return func(*args, **(kwargs or {}))


HABITS = {
    "asks whether any": lambda x: bool(x.any()),
    "asks which": lambda x: x.nonzero(),
    "selects by a mask": lambda x: x[x > 0],
    "reads a number": lambda x: x[0].item(),
    "indexes by a list": lambda x: x[[0, 1]],
    "writes by a list": lambda x: x.__setitem__([0, 1], 0.0),
    "adds a tensor of the host": lambda x: x + torch.ones(3),
    "moves a tensor": lambda x: torch.ones(3).to(x.device),
    "makes a tensor of figures": lambda x: x.new_tensor([1.0]),
}


@pytest.mark.parametrize("habit", HABITS)
def test_habits_that_the_next_test_finds(habit: str):
    value = torch.zeros(3, device="meta")
    with OneDevice(), NoHostData(), pytest.raises((AssertionError, RuntimeError, NotImplementedError)):
        HABITS[habit](value)


@pytest.mark.parametrize("change", ["robot.feet=sphere", "randomization=hdmi_push", "reset=adaptive"])
def test_steps_and_resets_without_asking(change: str, monkeypatch: pytest.MonkeyPatch):
    """No step and no reset of some worlds waits for the device, or makes tensors elsewhere."""
    # what TorchRL asks when a spec with bounds is declared, and when everything is reset
    monkeypatch.setattr(torch, "allclose", lambda *_: True)
    monkeypatch.setattr(MaskedResetEnv, "_reset_check_done", lambda *_: None)
    env = make_env(load_config(*PER_EPISODE, change), N, lift_box(), backend=GhostBackend)
    action = torch.zeros(env.action_spec.shape, device="meta")
    _, carry = env.step_and_maybe_reset(env.reset().set("action", action))  # the first one fills caches of keys
    with OneDevice(), NoHostData():
        for _ in range(2):
            stepped, carry = env.step_and_maybe_reset(carry.set("action", action))
    for key, value in (*stepped.items(True, True), *carry.items(True, True)):
        assert value.is_meta, key
