"""MuJoCo Warp behind the backend interface: thousands of worlds on a GPU, or a few on Warp's CPU device."""

from __future__ import annotations

import copy
import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import mujoco
import numpy as np
import torch
from torch import Tensor

from hdmi.envs.backend import STATE_FIELDS, LiveBackend, assign

try:
    import mujoco_warp as mjw
    import warp as wp
except ImportError as error:
    raise ImportError(f"{error}; physics on a GPU needs the extra gpu: pip install 'hdmi[gpu]'") from error

_LOG = logging.getLogger(__name__)

# What may differ between worlds: what randomization writes, and what `set_const` derives from it. A derived field
# that is not listed here would be world 0's in all of them.
INDEPENDENT_FIELDS = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_iquat",
    "body_pos",
    "dof_armature",
    "dof_damping",
    "dof_frictionloss",
    "geom_friction",
    "geom_pos",
    "geom_quat",
    "geom_size",
    "geom_solimp",
    "geom_solref",
    "jnt_stiffness",
    "actuator_biasprm",
    "actuator_gainprm",
)
DERIVED_FIELDS = (
    "actuator_acc0",
    "body_invweight0",
    "body_subtreemass",
    "dof_invweight0",
    "geom_aabb",
    "geom_rbound",
    "tendon_invweight0",
    "tendon_length0",
)
# What a refresh of some worlds would change in the others: after a step they hold the forces of its last physics step.
_FORCE_FIELDS = ("sensordata", "actuator_force")
_OVERFLOWS = {
    "contacts": mjw.OverflowType.BROADPHASE | mjw.OverflowType.NARROWPHASE | mjw.OverflowType.CCD,
    "constraints": mjw.OverflowType.NEFC | mjw.OverflowType.NJMAX_NNZ,
}
_HEADROOM = 1.5  # of capacities over what was seen


class WarpBackend(LiveBackend):
    """MuJoCo Warp: all worlds step in kernels of one device; tensors are views of its arrays.

    What a control step launches is captured once in a graph and replayed, and so are resets. Nothing waits for the
    host; worlds are chosen by masks, and a refresh of any costs one of all.

    Args:
        device: torch's name of a CUDA device, or `cpu`.
        contacts: room for contacts, per world on average; None to measure what the scene needs.
        constraints: room for rows of constraints in each world; None likewise.

    Raises:
        ValueError: if there is no such device.
    """

    masked = True

    def __init__(
        self,
        model: mujoco.MjModel,
        num_worlds: int,
        device: str = "cuda",
        contacts: int | None = None,
        constraints: int | None = None,
    ):
        super().__init__()
        self.num_worlds = num_worlds
        self.device = _find_device(device)
        self._host_model = model
        if contacts is None or constraints is None:
            measured = measure_capacity(model)
            contacts, constraints = contacts or measured[0], constraints or measured[1]
        model = copy.copy(model)
        model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # Warp knows neither it nor its opposite
        self.capacity = {"contacts": contacts, "constraints": constraints}
        wp.config.log_level = wp.LOG_WARNING  # instead of a line for each of its eighty modules:
        wp.init()
        _LOG.info(
            "MuJoCo Warp on %s: kernels that are new to %s are compiled at their first use, which takes minutes",
            self.device,
            wp.config.kernel_cache_dir,
        )
        self._wp_device = wp.device_from_torch(self.device)
        with wp.ScopedDevice(self._wp_device):
            per_world = [f for f in (*INDEPENDENT_FIELDS, *DERIVED_FIELDS) if getattr(model, f).size]
            self._m = mjw.put_model(model, batch_sizes=dict.fromkeys(per_world, num_worlds))
            self._d = mjw.make_data(model, nworld=num_worlds, nconmax=contacts, njmax=constraints)
            self._m.opt.warn_overflow = 0  # it is counted here, not printed by every world
            self._mask = wp.zeros(num_worlds, dtype=bool)
            wp.synchronize_device()
        self._controls: dict[int, wp.array] = {}  # by number of physics steps [S, N, nu]
        self._loaded: set[str] = set()  # programs that have run
        self._graphs: dict[str, wp.Graph] = {}
        self._overflow = wp.to_torch(self._d.overflow)
        self._needed = {"contacts": wp.to_torch(self._d.nacon), "constraints": wp.to_torch(self._d.nefc)}
        self._overflowed = {name: self._overflow.new_zeros((), dtype=torch.int64) for name in _OVERFLOWS}
        self._peak = {name: self._overflow.new_zeros(()) for name in _OVERFLOWS}
        self._warned: set[str] = set()

    def _bind(self, field: str) -> Tensor:
        return wp.to_torch(getattr(self._d, field))

    def _expand(self, field: str) -> Tensor:
        if field not in INDEPENDENT_FIELDS:
            raise KeyError(f"{field} is the same in all worlds of MuJoCo Warp; {list(INDEPENDENT_FIELDS)} may differ")
        return wp.to_torch(getattr(self._m, field))

    # -- what runs on the device ------------------------------------------------------------------------------

    def step(self, controls: Tensor) -> None:
        count = controls.shape[1]
        if count not in self._controls:
            self._controls[count] = wp.zeros((count, *self._d.ctrl.shape), dtype=float, device=self._wp_device)
        wp.to_torch(self._controls[count]).copy_(controls.detach().transpose(0, 1))
        self._run(f"step {count}", lambda: self._advance(self._controls[count]))
        self._watch_capacity()

    def _advance(self, controls: wp.array) -> None:
        # As on the CPU: from positions and velocities of a state to those of the next one, each computed once.
        for i in range(controls.shape[0]):
            wp.copy(self._d.ctrl, controls[i])
            self._d.sensordata.zero_()
            mjw.step2(self._m, self._d)
            mjw.fwd_position(self._m, self._d)
            mjw.sensor_pos(self._m, self._d)
            mjw.fwd_velocity(self._m, self._d)
            mjw.sensor_vel(self._m, self._d)

    def reset(self, worlds: Tensor) -> None:
        wp.to_torch(self._mask).copy_(self._mask_of(worlds))
        self._run("reset", lambda: mjw.reset_data(self._m, self._d, reset=self._mask))

    def refresh(self, worlds: Tensor) -> None:
        others = ~self._mask_of(worlds)
        kept = {field: self.data(field).clone() for field in _FORCE_FIELDS}
        self._run("refresh", lambda: mjw.forward(self._m, self._d))
        for field, values in kept.items():
            assign(self.data(field), others, values)

    def _mask_of(self, worlds: Tensor) -> Tensor:
        if worlds.dtype == torch.bool:
            return worlds
        return torch.zeros(self.num_worlds, dtype=torch.bool, device=self.device).index_fill_(0, worlds, True)

    def commit_model(self, worlds: Tensor) -> None:
        # leaves all worlds in need of a refresh, which all of them get
        self._run("commit", lambda: mjw.set_const(self._m, self._d, restore=False))

    def _run(self, name: str, program: Callable[[], None]) -> None:
        """Runs a program: as it is the first time, which loads its kernels, and from then on as a graph."""
        with wp.ScopedDevice(self._wp_device):
            if name not in self._loaded:
                with self._torch_stream():
                    program()
                self._loaded.add(name)
                return
            if name not in self._graphs:
                # on Warp's own stream: torch's default one cannot be captured
                with wp.ScopedCapture() as capture:
                    program()
                self._graphs[name] = capture.graph
            wp.capture_launch(self._graphs[name], stream=self._stream())

    def _stream(self) -> wp.Stream | None:
        return wp.stream_from_torch(self.device) if self.device.type == "cuda" else None

    @contextmanager
    def _torch_stream(self) -> Iterator[None]:
        """Warp's work in the order of torch's."""
        stream = self._stream()
        if stream is None:
            yield
        else:
            with wp.ScopedStream(stream):
                yield

    # -- capacity ---------------------------------------------------------------------------------------------

    def _watch_capacity(self) -> None:
        for name, bits in _OVERFLOWS.items():
            self._overflowed[name] += ((self._overflow & int(bits)) != 0).sum()
            self._peak[name] = torch.maximum(self._peak[name], self._needed[name].amax())
        self._overflow.zero_()

    def overflows(self) -> int:
        counts = {name: int(count) for name, count in self._overflowed.items()}
        for name in [name for name, count in counts.items() if count and name not in self._warned]:
            self._warned.add(name)
            peak = int(self._peak[name]) / (self.num_worlds if name == "contacts" else 1)
            wanted = _round(max(peak, self.capacity[name]) * _HEADROOM)
            warnings.warn(
                f"physics: {counts[name]} steps of worlds had no room for all of their {name}, and lost some; "
                f"set sim.backend.{name}={wanted} (now {self.capacity[name]})",
                stacklevel=2,
            )
        return sum(counts.values())

    # -- one world --------------------------------------------------------------------------------------------

    def world(self, index: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        model = copy.copy(self._host_model)
        data = mujoco.MjData(model)
        for field, values in self._model.items():
            target = getattr(model, field)
            target[:] = values[index].cpu().numpy().reshape(target.shape)
        mujoco.mj_setConst(model, data)
        for field in STATE_FIELDS:
            value = self.data(field)[index].cpu().numpy()
            setattr(data, field, value if value.ndim else float(value))
        mujoco.mj_forward(model, data)
        return model, data


def measure_capacity(model: mujoco.MjModel, drops: int = 8, steps: int = 150) -> tuple[int, int]:
    """Room for contacts and constraint rows that a world of this model needs, with some headroom.

    Contacts are measured on MuJoCo's CPU engine: bodies fall from random heights and orientations with limp joints.
    Rows are those of so many contacts, of all joint limits and of all dry friction.

    Returns:
        Contacts and constraint rows.
    """
    rng = np.random.default_rng(0)
    data = mujoco.MjData(model)
    contacts = 1
    for _ in range(drops):
        mujoco.mj_resetData(model, data)
        for joint in range(model.njnt):
            adr = model.jnt_qposadr[joint]
            if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
                data.qpos[adr : adr + 3] += rng.uniform([-0.2, -0.2, 0.2], [0.2, 0.2, 1.0])
                data.qpos[adr + 3 : adr + 7] = rng.normal(size=4)
            elif model.jnt_limited[joint] and model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_BALL:
                data.qpos[adr] = rng.uniform(*model.jnt_range[joint])
        mujoco.mj_normalizeQuat(model, data.qpos)
        for _ in range(steps):
            mujoco.mj_step1(model, data)
            contacts = max(contacts, data.ncon)
            data.ctrl[:] = data.actuator_length  # limp: servos that hold what is
            mujoco.mj_step2(model, data)
    contacts = _round(contacts * _HEADROOM)
    dims = int(model.geom_condim.max())
    rows_per_contact = dims if model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC else max(1, 2 * (dims - 1))
    others = int(model.jnt_limited.sum()) + int((model.dof_frictionloss > 0).sum())
    return contacts, _round(contacts * rows_per_contact + others)


def _round(value: float, multiple: int = 16) -> int:
    return -(-int(np.ceil(value)) // multiple) * multiple


def _find_device(name: str) -> torch.device:
    device = torch.device(name)
    if device.type == "cpu":
        return device
    if device.type != "cuda" or not torch.cuda.is_available():
        raise ValueError(f"device: {name!r} is not there; it takes a CUDA GPU and torch built for CUDA, or cpu")
    return torch.device("cuda", torch.cuda.current_device() if device.index is None else device.index)
