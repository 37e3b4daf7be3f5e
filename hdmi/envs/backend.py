"""Physics engines behind one interface: N worlds of one model, live state tensors, masked resets."""

from __future__ import annotations

import warnings
from typing import Protocol

import mujoco
import numpy as np
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

    def reset(self, mask: Tensor) -> None:
        """Puts the masked worlds into the model's default state; follow with `refresh`. mask: bool [N]"""
        ...

    def refresh(self, mask: Tensor) -> None:
        """Recomputes what derives from the state of the masked worlds. mask: bool [N]"""
        ...

    def commit_model(self, mask: Tensor) -> None:
        """Recomputes the constants that derive from model fields of the masked worlds. mask: bool [N]"""
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
        # One call for all but the last step: every call waits for its slowest world.
        if controls.shape[1] > 1:
            self._batch.rollout(
                controls.shape[1] - 1,
                control=controls[:, :-1].detach().double().contiguous().numpy(),
                control_spec=int(mujoco.mjtState.mjSTATE_CTRL),
                record=(),
            )
        self.data("ctrl").copy_(controls[:, -1].detach())
        # VEL: positions and velocities of the new state; contact and actuator forces of the last physics step
        self._batch.step(stage=mujoco.mjtStage.mjSTAGE_VEL)

    def reset(self, mask: Tensor) -> None:
        self._batch.reset(_ids(mask), stage=mujoco.mjtStage.mjSTAGE_NONE)

    def refresh(self, mask: Tensor) -> None:
        self._batch.forward(_ids(mask))

    def commit_model(self, mask: Tensor) -> None:
        self._batch.set_const(_ids(mask))

    def failed(self) -> Tensor:
        qvel = self.data("qvel")
        # a NaN fails the comparison
        return ~((qvel.abs().amax(-1) < MAX_VELOCITY) & self.data("qpos").sum(-1).isfinite())

    def get_state(self) -> dict[str, Tensor]:
        state = {f"data/{field}": self.data(field).clone() for field in STATE_FIELDS}
        return state | {f"model/{field}": value.clone() for field, value in self._model.items()}

    def set_state(self, state: dict[str, Tensor]) -> None:
        everyone = torch.ones(self.num_worlds, dtype=torch.bool)
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


def _ids(mask: Tensor) -> np.ndarray:
    return mask.reshape(-1).nonzero().squeeze(-1).numpy()
