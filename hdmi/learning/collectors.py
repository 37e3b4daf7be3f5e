"""Where experience is collected: in the learner's process, in others on this machine, or on a Ray cluster."""

from __future__ import annotations

import atexit
import os
import signal
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from copy import deepcopy
from functools import partial
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import BaseCollector, Collector, MultiSyncCollector
from torchrl.modules import ProbabilisticActor

from hdmi.assembly import Task, make_env, num_ranks
from hdmi.config import ConfigError
from hdmi.envs import ResetEnv
from hdmi.learning.checkpoint import CheckpointError
from hdmi.threads import torch_threads

_SEED_STRIDE = 2**12  # between workers; ranks are 2**20 apart


class WorkerError(RuntimeError):
    """A worker that ended or failed; what it printed says why."""


class WorldCollector(Collector):
    """TorchRL's collector with a state that determines its future: worlds, transforms, random numbers.

    The policy gets no more of torch's threads than the environment; see `torch_threads`.
    """

    _carrier: TensorDictBase  # from batch to batch; TorchRL gives no access to it

    def rollout(self) -> TensorDictBase:
        with torch_threads(self.env.batch_size.numel(), self.env.envs_per_thread):
            return super().rollout()

    def state_dict(self) -> dict[str, Any]:  # type: ignore[override]
        """`rng` of the process and its GPU, `env` and `transforms`, and the `carrier` [N] of the next step."""
        gpu = self.env.device.type == "cuda"
        return {
            "rng": torch.get_rng_state(),
            "device_rng": torch.cuda.get_rng_state(self.env.device) if gpu else None,
            "env": self.env.base_env.get_state().to_dict(),
            "transforms": dict(self.env.transform.state_dict()),
            "carrier": self._carrier.to_dict(),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any], **kwargs: Any) -> None:  # type: ignore[override]
        """Continues exactly where `state_dict` was called."""
        self.env.base_env.set_state(TensorDict(state_dict["env"]))
        self.env.transform.load_state_dict(state_dict["transforms"])
        self._carrier = TensorDict(state_dict["carrier"], self.env.batch_size, device=self._carrier.device)
        torch.set_rng_state(state_dict["rng"].cpu())
        if state_dict.get("device_rng") is not None and self.env.device.type == "cuda":
            torch.cuda.set_rng_state(state_dict["device_rng"].cpu(), self.env.device)


class InlineCollector:
    """Collects in the learner's process, between its updates: on-policy, continued exactly.

    Args:
        cfg, task: what to simulate; `cfg.num_envs` worlds.
    """

    overlap = False  # nothing is collected while the learner updates

    def __init__(self, cfg: DictConfig, task: Task):
        self.cfg = cfg
        self.env = make_env(cfg, task=task)

    def start(self, actor: ProbabilisticActor) -> None:
        """Begins to collect with a policy, whose weights are then read at each batch."""
        if self.cfg.compile:
            self.env.compile_transforms()
        self._collector = WorldCollector(
            self.env,
            actor,
            frames_per_batch=self.cfg.num_envs * self.cfg.algo.frames_per_env,
            total_frames=-1,
            trust_policy=True,
            return_same_td=True,
            track_traj_ids=False,
            auto_register_policy_transforms=False,  # nothing in the policy is recurrent
        )
        self._batches = iter(self._collector)

    def next(self) -> TensorDictBase:
        """The next batch. [N, T]"""
        with torch.no_grad():
            return next(self._batches)

    def state_dict(self) -> dict[str, Any]:
        """What `load_state_dict` continues from."""
        return self._collector.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a state.

        Raises:
            CheckpointError: if it is of another kind of collector or another number of environments.
        """
        if "workers" in state:
            raise CheckpointError(
                f"resume: the checkpoint is of {len(state['workers'])} workers (collector=process or ray), "
                "the config has collector=inline"
            )
        _check_size([dict(state)], self.cfg.num_envs)
        self._collector.load_state_dict(state)

    def shutdown(self) -> None:
        """Ends the collection."""
        self._collector.shutdown()


class _WorkerCollector(ABC):
    """Collects in workers that each simulate their share of the worlds on a CPU.

    The workers begin a rollout together, with the same weights, and their rollouts are one batch [N, T] in the
    order of the workers, so that a run can be repeated. With `overlap`, they begin the next rollout before the
    learner updates on the present one: each batch then comes from the policy before the last update, one update
    older than without.

    Args:
        cfg, task: what to simulate; `cfg.num_envs` worlds in all. Workers need neither motion nor mesh files.
        seed: of the first worker.
        num_workers: must divide `cfg.num_envs`.
        threads_per_worker: of physics and of torch; 0: an equal share of this machine's.
        overlap: whether to collect while the learner updates.

    Attributes:
        env: as large as one worker's, for its specs and for first statistics.
    """

    def __init__(
        self, cfg: DictConfig, task: Task, seed: int, num_workers: int, threads_per_worker: int, overlap: bool
    ):
        if num_workers < 1 or cfg.num_envs % num_workers:
            raise ConfigError(f"collector.num_workers: {num_workers} do not share num_envs={cfg.num_envs} equally")
        self.cfg, self.num_workers, self.overlap = cfg, num_workers, overlap
        self.threads = threads_per_worker or max(1, (cfg.num_threads or os.cpu_count() or 1) // num_workers)
        share = cfg.num_envs // num_workers
        self.env = make_env(cfg, share, task)
        own = cfg.copy()
        own.total_frames //= num_ranks()  # a worker knows of no other rank, and some transforms count to the end
        make = partial(_make_worker_env, cfg=own, task=task, num_envs=share, num_threads=self.threads)
        self._make_envs = [partial(make, seed=seed + _SEED_STRIDE * (i + 1)) for i in range(num_workers)]
        self._thread = ThreadPoolExecutor(max_workers=1)  # waits for the workers
        self._rollout: Future[TensorDictBase] | None = None

    @abstractmethod
    def _make_collector(self, policy: ProbabilisticActor, **options: Any) -> BaseCollector:
        """TorchRL's collector that has the workers, started and idle."""

    def start(self, actor: ProbabilisticActor) -> None:
        """Starts the workers with a policy, whose weights they are then sent before each rollout."""
        self._actor = actor
        self._device = next(actor.parameters()).device
        # Workers on this machine would otherwise share the actor's memory and see updates before they are complete.
        policy = deepcopy(actor).cpu().requires_grad_(False)
        self._collector = self._make_collector(
            policy,
            frames_per_batch=self.cfg.num_envs * self.cfg.algo.frames_per_env,
            trust_policy=True,
        )
        self._batches = iter(self._collector)
        atexit.register(self.shutdown)  # the interpreter would otherwise wait for workers that wait for it

    def _begin(self) -> Future[TensorDictBase]:
        self._collector.update_policy_weights_(TensorDict.from_module(self._actor).data.cpu())
        return self._thread.submit(next, self._batches)

    def next(self) -> TensorDictBase:
        """The next batch. [N, T]

        Raises:
            WorkerError: if a worker is gone.
        """
        with _worker_errors():
            if self._rollout is None:
                self._rollout = self._begin()
            batch = self._rollout.result()
            self._rollout = self._begin() if self.overlap else None
        return batch.flatten(0, 1).to(self._device)  # [W, N / W, T] -> [N, T]

    @abstractmethod
    def _worker_states(self) -> list[dict[str, Any]]: ...

    @abstractmethod
    def _load_worker_states(self, states: list[dict[str, Any]]) -> None: ...

    def state_dict(self) -> dict[str, Any]:
        """What `load_state_dict` continues from; waits for a rollout under way, which is not part of it."""
        with _worker_errors():
            self._settle()
            return {"workers": self._worker_states()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a state: exactly if it was made without `overlap`, else from the rollout that was under way.

        Raises:
            CheckpointError: if it is of another number of workers or environments.
        """
        count = len(state["workers"]) if "workers" in state else 0
        if count != self.num_workers:
            raise CheckpointError(
                f"resume: the checkpoint is of {f'{count} workers' if count else 'collector=inline'}, "
                f"the config has collector.num_workers={self.num_workers}"
            )
        _check_size(state["workers"], self.cfg.num_envs)
        with _worker_errors():
            self._settle()
            self._rollout = None
            self._load_worker_states(state["workers"])

    def _settle(self) -> None:
        """Waits for a rollout under way: only idle workers can answer."""
        if self._rollout is not None:
            self._rollout.result()

    def shutdown(self) -> None:
        """Ends the workers."""
        atexit.unregister(self.shutdown)
        if self._rollout is not None:
            wait([self._rollout])
        self._thread.shutdown()
        self._collector.shutdown()


class ProcessCollector(_WorkerCollector):
    """Collects in processes on this machine; see `MultiSyncCollector`."""

    def __init__(
        self,
        cfg: DictConfig,
        task: Task,
        seed: int,
        num_workers: int = 2,
        threads_per_worker: int = 0,
        overlap: bool = True,
    ):
        super().__init__(cfg, task, seed, num_workers, threads_per_worker, overlap)

    def _make_collector(self, policy: ProbabilisticActor, **options: Any) -> BaseCollector:
        return MultiSyncCollector(
            self._make_envs,
            policy,
            collector_class=WorldCollector,
            cat_results="stack",
            num_threads=torch.get_num_threads(),  # of the learner: unchanged
            num_sub_threads=self.threads,
            init_fn=_ignore_interrupts,
            auto_register_policy_transforms=False,
            total_frames=-1,
            **options,
        )

    def _worker_states(self) -> list[dict[str, Any]]:
        state = self._collector.state_dict()
        return [state[f"worker{i}"] for i in range(self.num_workers)]

    def _load_worker_states(self, states: list[dict[str, Any]]) -> None:
        named = {f"worker{i}": state for i, state in enumerate(states)}
        self._collector.load_state_dict({**named, "frames": 0, "iter": -1})


class RayCollector(_WorkerCollector):
    """Collects in actors of a Ray cluster, on this machine or others; see TorchRL's `RayCollector` (extra `ray`).

    Args:
        address: of a running cluster (`auto`, or host:port); null starts one on this machine.
        threads_per_worker: also the processors that Ray sets aside for each.
    """

    def __init__(
        self,
        cfg: DictConfig,
        task: Task,
        seed: int,
        num_workers: int = 2,
        threads_per_worker: int = 1,
        overlap: bool = True,
        address: str | None = None,
    ):
        super().__init__(cfg, task, seed, num_workers, threads_per_worker, overlap)
        self.address = address

    def _make_collector(self, policy: ProbabilisticActor, **options: Any) -> BaseCollector:
        from torchrl.collectors.distributed import RayCollector as TorchRLRayCollector

        try:
            return TorchRLRayCollector(
                self._make_envs,
                policy,
                collector_class=WorldCollector,
                collector_kwargs={"auto_register_policy_transforms": False},
                sync=True,
                ray_init_config={"address": self.address, "include_dashboard": False, "log_to_driver": False},
                remote_configs={"num_cpus": self.threads, "num_gpus": 0},
                total_frames=sys.maxsize,  # -1 would be none
                **options,
            )
        except RuntimeError as error:
            if isinstance(error.__cause__, ImportError):
                raise ConfigError("collector: needs ray; install hdmi[ray]") from error
            raise

    def _worker_states(self) -> list[dict[str, Any]]:
        return list(self._collector.state_dict())

    def _load_worker_states(self, states: list[dict[str, Any]]) -> None:
        self._collector.load_state_dict(states)


def _make_worker_env(cfg: DictConfig, task: Task, num_envs: int, num_threads: int, seed: int) -> ResetEnv:
    """A worker's environment, and its process's threads and random numbers."""
    torch.set_num_threads(num_threads)
    torch.manual_seed(seed)
    cfg.num_threads = num_threads
    env = make_env(cfg, num_envs, task)
    if cfg.compile:
        env.compile_transforms()
    return env


@contextmanager
def _worker_errors() -> Iterator[None]:
    try:
        yield
    except Exception as error:
        raise WorkerError(f"a worker of the collector ended or failed, see what it printed: {error!r}") from error


def _ignore_interrupts() -> None:
    """Leaves it to the learner to end a worker, after a last checkpoint."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _check_size(states: list[dict[str, Any]], num_envs: int) -> None:
    count = sum(len(state["carrier"]["done"]) for state in states)
    if count != num_envs:
        raise CheckpointError(f"resume: the checkpoint has {count} environments, the config num_envs={num_envs}")
