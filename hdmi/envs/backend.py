"""Physics engines behind one interface: N worlds of one model, live state tensors, resets of chosen worlds."""

from __future__ import annotations

import warnings
from typing import Protocol

import mujoco
import torch
from mujoco.batch import Batch
from torch import Tensor

# The state that determines the future, besides the per-world model.
STATE_FIELDS = ("time", "qpos", "qvel", "ctrl", "qacc_warmstart")
MAX_VELOCITY = 1e3  # m/s or rad/s; beyond it a world counts as diverged


class PhysicsBackend(Protocol):
    """What the environment needs of an engine. Tensors are live: copy before keeping them."""

    num_worlds: int
    device: torch.device

    def data(self, field: str) -> Tensor:
        """A field of MjData for all worlds. [N, ...]"""
        ...

    def model(self, field: str) -> Tensor:
        """A field of MjModel with one value per world, writable; follow writes with `commit_model`. [N, ...]"""
        ...

    def step(self, controls: Tensor) -> None:
        """Advances every world by S physics steps, each under its own controls. [N, S, num_actuators]"""
        ...

    def reset(self, worlds: Tensor) -> None:
        """Puts worlds into the model's default state; follow with `refresh`. int64 [n]"""
        ...

    def refresh(self, worlds: Tensor) -> None:
        """Recomputes what derives from the state of the given worlds. int64 [n]"""
        ...

    def commit_model(self, worlds: Tensor) -> None:
        """Recomputes the constants that derive from model fields of the given worlds. int64 [n]"""
        ...

    def failed(self) -> Tensor:
        """Worlds whose state is not finite or absurdly fast. bool [N]"""
        ...

    def get_state(self) -> dict[str, Tensor]:
        """A copy of everything that determines the future: state and per-world model fields."""
        ...

    def set_state(self, state: dict[str, Tensor]) -> None:
        """Restores what `get_state` returned."""
        ...

    def world(self, index: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Model and data of one world, for rendering."""
        ...


class BatchBackend:
    """MuJoCo's `Batch`: worlds stepped by a pool of C threads on the CPU.

    Args:
        num_threads: 0 for all processors.
    """

    def __init__(self, model: mujoco.MjModel, num_worlds: int, num_threads: int = 0):
        # persistent: otherwise a masked forward gives reset worlds another world's contact forces
        self._batch = Batch(model, num_worlds, num_threads, persistent=True)
        self.num_worlds = num_worlds
        self.device = torch.device("cpu")
        self._data: dict[str, Tensor] = {}
        self._model: dict[str, Tensor] = {}

    def data(self, field: str) -> Tensor:
        if field not in self._data:
            with warnings.catch_warnings():
                # outputs are read-only arrays, which torch cannot express; nobody writes to them
                warnings.filterwarnings("ignore", message=".*not writable.*")
                self._data[field] = torch.from_numpy(self._batch.bind(field))
        return self._data[field]

    def model(self, field: str) -> Tensor:
        if field not in self._model:
            self._model[field] = torch.from_numpy(self._batch.expand(field))
        return self._model[field]

    def step(self, controls: Tensor) -> None:
        controls = controls.detach()
        num_steps = controls.shape[1]
        worlds, order = torch.arange(self.num_worlds), torch.arange(num_steps)
        # Each world goes through its runs of equal controls; worlds whose runs are equally long go together. A step
        # that stops at VEL has positions and velocities of the new state, forces of the last physics step, and the
        # next one continues from there: Batch.rollout would compute these stages twice.
        last_of_run = torch.ones(self.num_worlds, num_steps, dtype=torch.bool)
        last_of_run[:, :-1] = (controls[:, 1:] != controls[:, :-1]).any(-1)
        begin = torch.zeros(self.num_worlds, dtype=torch.int64)
        while (active := begin < num_steps).any():
            run = last_of_run & (order >= begin.unsqueeze(-1))
            end = torch.where(active, run.int().argmax(-1) + 1, begin)
            self.data("ctrl").copy_(controls[worlds, begin.clamp(max=num_steps - 1)])
            for length in (end - begin)[active].unique().tolist():
                ids = (end - begin == length).nonzero().squeeze(-1)
                self._batch.step(ids.numpy(), nstep=length, stage=mujoco.mjtStage.mjSTAGE_VEL)
            begin = end

    def reset(self, worlds: Tensor) -> None:
        self._batch.reset(worlds.numpy(), stage=mujoco.mjtStage.mjSTAGE_NONE)

    def refresh(self, worlds: Tensor) -> None:
        self._batch.forward(worlds.numpy())

    def commit_model(self, worlds: Tensor) -> None:
        self._batch.set_const(worlds.numpy())

    def failed(self) -> Tensor:
        qvel = self.data("qvel")
        # a NaN fails the comparison
        return ~((qvel.abs().amax(-1) < MAX_VELOCITY) & self.data("qpos").sum(-1).isfinite())

    def get_state(self) -> dict[str, Tensor]:
        state = {f"data/{field}": self.data(field).clone() for field in STATE_FIELDS}
        return state | {f"model/{field}": value.clone() for field, value in self._model.items()}

    def set_state(self, state: dict[str, Tensor]) -> None:
        everyone = torch.arange(self.num_worlds)
        for key, value in state.items():
            kind, field = key.split("/")
            (self.data(field) if kind == "data" else self.model(field)).copy_(value)
        self.commit_model(everyone)
        self.refresh(everyone)
        self.data("qacc_warmstart").copy_(state["data/qacc_warmstart"])

    def world(self, index: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        model = self._batch.get_model(index)
        data = self._batch.get_data(index)
        mujoco.mj_forward(model, data)
        return model, data
