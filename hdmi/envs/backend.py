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
    """What the environment needs of an engine. Tensors are live: copy before keeping them.

    Methods that concern some worlds take `worlds`: their numbers, int64 [n], or a mask, bool [N].

    Attributes:
        num_worlds: N.
        device: of all tensors.
        masked: whether worlds are better chosen by masks: a host that asks for numbers would wait for the device.

    Examples:
        >>> from hdmi.assets import RobotConfig, SimConfig, build_scene
        >>> scene = build_scene(RobotConfig(), SimConfig())
        >>> backend: PhysicsBackend = BatchBackend(scene.model, num_worlds=2, num_threads=1)
        >>> backend.data("qpos")[1, 2] = torch.nan
        >>> backend.failed()
        tensor([False,  True])
    """

    num_worlds: int
    device: torch.device
    masked: bool

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
        """Puts worlds into the model's default state; follow with `refresh`."""
        ...

    def refresh(self, worlds: Tensor) -> None:
        """Recomputes what derives from the state of the given worlds."""
        ...

    def commit_model(self, worlds: Tensor) -> None:
        """Recomputes the constants that derive from model fields of the given worlds; follow with `refresh`."""
        ...

    def failed(self) -> Tensor:
        """Worlds whose state is not finite or absurdly fast. bool [N]"""
        ...

    def overflows(self) -> int:
        """Steps of single worlds, so far, whose contacts or constraints did not all fit; warns what to raise."""
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


def assign(live: Tensor, worlds: Tensor, rows: Tensor) -> None:
    """Writes rows of some worlds into a live tensor [N, ...], in its dtype.

    Args:
        worlds: numbers, int64 [n], of n rows; or a mask, bool [N], of N rows, of which those in the mask are written.
    """
    if worlds.dtype == torch.bool:
        mask = worlds.reshape(-1, *[1] * (live.ndim - 1))
        live.copy_(torch.where(mask, rows.to(live.dtype), live))
    else:
        live[worlds] = rows.to(live.dtype)


class LiveBackend:
    """What backends share: cached live tensors, failures, and saving the state."""

    num_worlds: int
    device: torch.device

    def __init__(self) -> None:
        self._data: dict[str, Tensor] = {}
        self._model: dict[str, Tensor] = {}

    def _bind(self, field: str) -> Tensor:
        """The live tensor of a field of MjData."""
        raise NotImplementedError

    def _expand(self, field: str) -> Tensor:
        """The live tensor of a field of MjModel that is to differ between worlds."""
        raise NotImplementedError

    def data(self, field: str) -> Tensor:
        if field not in self._data:
            self._data[field] = self._bind(field)
        return self._data[field]

    def model(self, field: str) -> Tensor:
        if field not in self._model:
            self._model[field] = self._expand(field)
        return self._model[field]

    def failed(self) -> Tensor:
        qvel = self.data("qvel")
        # a NaN fails the comparison
        return ~((qvel.abs().amax(-1) < MAX_VELOCITY) & self.data("qpos").sum(-1).isfinite())

    def get_state(self) -> dict[str, Tensor]:
        state = {f"data/{field}": self.data(field).clone() for field in STATE_FIELDS}
        return state | {f"model/{field}": value.clone() for field, value in self._model.items()}

    def set_state(self, state: dict[str, Tensor]) -> None:
        everyone = torch.arange(self.num_worlds, device=self.device)
        for key, value in state.items():
            kind, field = key.split("/")
            (self.data(field) if kind == "data" else self.model(field)).copy_(value)
        self.commit_model(everyone)
        self.refresh(everyone)
        self.data("qacc_warmstart").copy_(state["data/qacc_warmstart"])

    def commit_model(self, worlds: Tensor) -> None:
        raise NotImplementedError

    def refresh(self, worlds: Tensor) -> None:
        raise NotImplementedError


class BatchBackend(LiveBackend):
    """MuJoCo's `Batch`: worlds stepped by a pool of C threads on the CPU.

    Controls that change within a control step cost next to nothing: MuJoCo's actuators keep a history of `ctrl`, and
    a delay per world and actuator makes them follow the last step's control for its first physics steps.

    Args:
        num_threads: 0 for all processors.

    Examples:
        >>> from hdmi.assets import RobotConfig, SimConfig, build_scene
        >>> scene = build_scene(RobotConfig(), SimConfig(timestep=0.005, decimation=4))
        >>> backend = BatchBackend(scene.model, num_worlds=2, num_threads=1)
        >>> backend.step(torch.zeros(2, 4, 29))  # one target per physics step
        >>> backend.data("time").flatten()
        tensor([0.0200, 0.0200], dtype=torch.float64)
    """

    masked = False

    def __init__(self, model: mujoco.MjModel, num_worlds: int, num_threads: int = 0):
        super().__init__()
        slots = set(model.actuator_history[:, 0].tolist())
        if len(slots) != 1 or 0 in slots:
            raise ValueError(
                "model: the controls of one control step are kept in its actuators' history; "
                f"all need nsample = decimation, they have {sorted(slots)}"
            )
        self._slots = slots.pop()
        self._timestep = model.opt.timestep
        # persistent: otherwise a masked forward gives reset worlds another world's contact forces
        self._batch = Batch(model, num_worlds, num_threads, persistent=True)
        self._delay = self._expand("actuator_delay")  # s [N, nu]
        self.num_worlds = num_worlds
        self.device = torch.device("cpu")

    def _bind(self, field: str) -> Tensor:
        with warnings.catch_warnings():
            # outputs are read-only arrays, which torch cannot express; nobody writes to them
            warnings.filterwarnings("ignore", message=".*not writable.*")
            return torch.from_numpy(self._batch.bind(field))

    def _expand(self, field: str) -> Tensor:
        return torch.from_numpy(self._batch.expand(field))

    def step(self, controls: Tensor) -> None:
        num_steps = controls.shape[1]
        if num_steps > self._slots:
            raise ValueError(f"{num_steps} controls in a step; the model's actuators have room for {self._slots}")
        self._schedule(controls.detach().double())
        # A step that stops at VEL has positions and velocities of the new state, forces of the last physics step, and
        # the next one continues from there: Batch.rollout would compute these stages twice.
        self._batch.step(nstep=num_steps, stage=mujoco.mjtStage.mjSTAGE_VEL)

    def _schedule(self, controls: Tensor) -> None:
        """Makes the actuators follow the controls of the next physics steps. [N, S, nu]"""
        ctrl, last = self.data("ctrl"), controls[:, -1]
        waiting = (controls != last.unsqueeze(1)).sum(1)  # physics steps before an actuator turns to the last control
        early = torch.arange(controls.shape[1]).unsqueeze(-1) < waiting.unsqueeze(1)  # [N, S, nu]
        follows = (controls == torch.where(early, ctrl.unsqueeze(1), last.unsqueeze(1))).flatten(1).all(-1)
        # half a physics step early, so that rounding cannot choose a neighbour
        self._delay.copy_((waiting - 0.5).clamp(min=0) * self._timestep)
        ctrl.copy_(last)
        if not follows.all():
            # Any other schedule is written into the history. That is part of the state: MuJoCo then computes anew
            # what it had kept of the last step, a quarter of the work.
            worlds = (~follows).nonzero().squeeze(-1)
            self._write_history(worlds, controls[worlds])
            self._delay[worlds] = self._slots * self._timestep

    def _write_history(self, worlds: Tensor, controls: Tensor) -> None:
        """Writes controls where actuators delayed by all slots find them in the next physics steps. [n, S, nu]"""
        missing = self._slots - controls.shape[1]
        plan = torch.cat([controls, controls[:, -1:].expand(-1, missing, -1)], dim=1)
        offsets = (torch.arange(self._slots) - 0.5 - self._slots) * self._timestep
        times = (self.data("time")[worlds].unsqueeze(-1) + offsets).unsqueeze(1).expand(-1, plan.shape[-1], -1)
        head = torch.tensor([0.0, self._slots - 1.0], dtype=torch.float64)  # the user's value; place of the newest
        history = torch.cat([head.expand(*times.shape[:2], 2), times, plan.transpose(1, 2)], dim=-1)
        self.data("history")[worlds] = history.flatten(1)

    def reset(self, worlds: Tensor) -> None:
        self._batch.reset(_numbers(worlds).numpy(), stage=mujoco.mjtStage.mjSTAGE_NONE)

    def refresh(self, worlds: Tensor) -> None:
        worlds = _numbers(worlds)
        if not len(worlds):
            return
        self._write_history(worlds, self.data("ctrl")[worlds].unsqueeze(1))
        self._batch.forward(worlds.numpy())

    def commit_model(self, worlds: Tensor) -> None:
        self._batch.set_const(_numbers(worlds).numpy())

    def overflows(self) -> int:
        return 0  # they share an arena that MuJoCo sizes for the model

    def world(self, index: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        model = self._batch.get_model(index)
        data = self._batch.get_data(index)
        model.actuator_delay[:] = 0.0  # the schedule is over: forces are those of `ctrl`
        mujoco.mj_forward(model, data)
        return model, data


def _numbers(worlds: Tensor) -> Tensor:
    return worlds.nonzero().squeeze(-1) if worlds.dtype == torch.bool else worlds
