"""Speed of raw physics, of the environment with all transforms, of the learner and of training, in one run.

    hdmi benchmark [any option of hdmi train]

Nothing else should run on the machine. Figures are control steps per second; blocks of the measurements alternate and
medians are reported, so that the ratios hold even where the machine's speed drifts. Beside them stand other
environments on the CPU (see conf/benchmark.yaml). The last line of the output is one JSON object. `sim=gpu` measures
MuJoCo Warp; `hdmi gpu-report` tabulates engines by number of worlds. A grid is a multirun:
`-m task=walk,push_box num_envs=256,512 out=grid.jsonl compare.steps=0`.
"""

from __future__ import annotations

import json
import os
import resource
import statistics
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
import mujoco
import torch
from mujoco.batch import Batch
from omegaconf import DictConfig
from rich.table import Table
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import ExplorationType, TransformedEnv, set_exploration_type

from hdmi.assembly import Task, backend_of, make_env, make_transforms
from hdmi.assets import Scene
from hdmi.commands.comparison import mjlab_speed, mujoco_env_speed
from hdmi.commands.script import run_composed
from hdmi.config import CONF
from hdmi.console import make_console
from hdmi.envs import BatchBackend
from hdmi.learning import make_trainer
from hdmi.threads import torch_threads

_BLOCKS, _STEPS, _ITERATIONS = 7, 20, 4


def now() -> float:
    """s, once a GPU has done what it was asked."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def peak_memory(device: torch.device) -> dict[str, float]:
    """GB of this process so far, and of the GPU."""
    peak = {"memory_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9}
    if device.type == "cuda":
        free, total = torch.cuda.mem_get_info(device)
        peak["gpu_memory_gb"] = (total - free) / 1e9  # torch's and Warp's pools give nothing back
    return peak


class HeldBatch:
    """MuJoCo's Batch as it is, each control held for the whole control step."""

    def __init__(self, model: mujoco.MjModel, num_worlds: int, num_threads: int):
        self.batch = Batch(model, num_worlds, num_threads, persistent=True)

    def data(self, field: str) -> Tensor:
        return torch.from_numpy(self.batch.bind(field))

    def refresh(self, worlds: Tensor) -> None:
        self.batch.forward(worlds.numpy())

    def step(self, controls: Tensor) -> None:
        self.data("ctrl").copy_(controls[:, 0])
        self.batch.step(nstep=controls.shape[1], stage=mujoco.mjtStage.mjSTAGE_VEL)


class RawPhysics:
    """The engine alone on the model of an environment, through what that environment has just gone through.

    It starts from the same states and is given the same joint targets, once per control step; nothing is reset, read
    or delayed. With targets that do not change, robots come to rest and physics gets cheaper than in training.
    """

    def __init__(self, env: TransformedEnv, cfg: DictConfig):
        self.base = env.base_env
        model, n = self.base.scene.model, self.base.num_envs
        on_cpu = isinstance(self.base.backend, BatchBackend)
        self.engine = HeldBatch(model, n, cfg.num_threads) if on_cpu else backend_of(cfg)(model, n)
        self.start: dict[str, Tensor] = {}
        self.targets: list[Tensor] = []

    def begin(self) -> None:
        """Remembers the states from which to start."""
        fields = ("qpos", "qvel", "ctrl", "qacc_warmstart")
        self.start = {field: self.base.backend.data(field).clone() for field in fields}
        self.targets = []

    def record(self) -> None:
        """Remembers the targets of the environment's last step."""
        self.targets.append(self.base.backend.data("ctrl").clone())

    def replay(self) -> float:
        """Control steps of all worlds per second."""
        for field, values in self.start.items():
            self.engine.data(field).copy_(values)
        self.engine.refresh(torch.arange(self.base.num_envs, device=self.base.device))
        start = now()
        for targets in self.targets:
            self.engine.step(targets.unsqueeze(1).expand(-1, self.base.scene.sim.decimation, -1))
        return self.base.num_envs * len(self.targets) / (now() - start)


def step_env(
    env: TransformedEnv, carry: TensorDictBase, policy: Any, count: int, raw: RawPhysics | None = None
) -> tuple[float, TensorDictBase]:
    """Steps with resets under the policy's actions, recorded for `raw`; policy time is not counted."""
    spent = 0.0
    if raw is not None:
        raw.begin()
    for _ in range(count):
        threads = torch_threads(env.base_env.num_envs, env.envs_per_thread)
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM), threads:
            carry = policy(carry)
        start = now()
        _, carry = env.step_and_maybe_reset(carry)
        spent += now() - start
        if raw is not None:
            raw.record()
    return env.base_env.num_envs * count / spent, carry


def transform_times(cfg: DictConfig, task: Task, policy: Any, count: int) -> dict[str, float]:
    """Milliseconds per control step that each transform takes if it is not compiled, resets included."""
    names = [name for name, _ in make_transforms(cfg, task)] + ["outputs"]
    spent: dict[str, float] = defaultdict(float)
    env = make_env(cfg, task=task)
    with torch.no_grad():
        carry = env.reset()
    _, carry = step_env(env, carry, policy, count)

    def timed(name: str, method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            start = now()
            result = method(*args, **kwargs)
            spent[name] += now() - start
            return result

        return call

    methods = ("_step", "_reset", "_inv_call", "_reset_env_preprocess")
    for name, transform in zip(names, env.transform.transforms, strict=True):
        for method in methods:
            object.__setattr__(transform, method, timed(name, getattr(transform, method)))
    step_env(env, carry, policy, count)
    return {name: 1e3 * value / count for name, value in spent.items()}


def compare(options: DictConfig, scene: Scene) -> dict[str, float]:
    """Control steps per second of other environments: TorchRL's on the same scene, mjlab's on its own."""
    if not options.steps:
        return {}
    workers = options.mujoco_env_workers or os.cpu_count() or 1
    speeds = {
        "mujoco_env_sps": mujoco_env_speed(scene, 1, options.steps),
        "mujoco_parallel_env_sps": mujoco_env_speed(scene, workers, options.steps),
    }
    if options.mjlab is not None:
        try:
            speeds["mjlab_tracking_sps"] = mjlab_speed(options.mjlab, options.mjlab_envs, options.steps)
        except RuntimeError as error:
            print(error, file=sys.stderr)
    return speeds


def part_times(result: dict[str, Any]) -> Table:
    """Where the time of a control step of all worlds goes, from what the parts reach alone."""
    n = 1e3 * result["num_envs"]
    physics, env, collect = (n / result[f"{key}_sps"] for key in ("raw_physics", "env", "collect"))
    parts = {
        "physics": physics,
        "transforms, resets and reading": env - physics,
        "policy and collector": collect - env,
        "update": n / result["learn_sps"],
    }
    table = Table(title="Time per control step by part", title_justify="left")
    table.add_column("part")
    table.add_column("ms", justify="right")
    for name, value in (parts | {"all": n / result["train_sps"]}).items():
        table.add_row(name, f"{value:.1f}")
    return table


@hydra.main(config_path=str(CONF), config_name="benchmark", version_base="1.3")
def _composed(cfg: DictConfig) -> None:
    console = make_console()
    with tempfile.TemporaryDirectory() as folder:
        trainer = make_trainer(cfg, Path(folder))
        env, policy = trainer.env, trainer.actor
        if env.base_env.num_envs != cfg.num_envs:  # workers simulate a share each
            env = make_env(cfg, task=trainer.task)
        raw = RawPhysics(env, cfg)
        with torch.no_grad():
            carry = env.reset()
        _, carry = step_env(env, carry, policy, _STEPS, raw)
        raw.replay()
        raw_sps, env_sps = [], []
        for _ in range(_BLOCKS):
            speed, carry = step_env(env, carry, policy, _STEPS, raw)
            env_sps.append(speed)
            raw_sps.append(raw.replay())
        costs = transform_times(cfg, trainer.task, policy, _STEPS)

        collect, learn, train, raw_beside = [], [], [], []
        for i in range(_ITERATIONS + 1):
            start = now()
            batch = trainer.collector.next()
            middle = now()
            trainer.update(batch)
            end = now()
            if i:  # the first one warms up
                frames = trainer.frames_per_batch
                collect.append(frames / (middle - start))
                learn.append(frames / (end - middle))
                train.append(frames / (end - start))
                if not trainer.collector.overlap:  # its workers would collect on, in time that is not counted
                    raw_beside.append(raw.replay())
        trainer.collector.shutdown()
        raw_beside = raw_beside or [raw.replay() for _ in train]
        others = compare(cfg.compare, trainer.task.scene)

    median = statistics.median
    result = {
        "raw_physics_sps": median(raw_sps + raw_beside),
        "env_sps": median(env_sps),
        "env_ratio": median(e / r for e, r in zip(env_sps, raw_sps, strict=True)),
        "collect_sps": median(collect),
        "collect_ratio": median(c / r for c, r in zip(collect, raw_beside, strict=True)),
        "learn_sps": median(learn),
        "train_sps": median(train),
        "train_ratio": median(t / r for t, r in zip(train, raw_beside, strict=True)),
        "num_envs": cfg.num_envs,
        "task": cfg.task.name,
        "engine": f"{type(env.base_env.backend).__name__} on {env.base_env.device}",
        **peak_memory(env.base_env.device),
        **others,
    }
    table = Table(title="Time per control step by transform, not compiled, resets included", title_justify="left")
    table.add_column("transform")
    table.add_column("ms", justify="right")
    for name, cost in sorted(costs.items(), key=lambda item: -item[1])[:25]:
        table.add_row(name, f"{cost:.3f}")
    table.add_row(f"all {len(costs)}", f"{sum(costs.values()):.3f}")
    console.print(table)
    step_ms = 1e3 * cfg.num_envs / result["env_sps"]
    console.print(part_times(result))
    console.print(f"one control step of {cfg.num_envs} worlds with everything on: {step_ms:.1f} ms")
    line = json.dumps({key: round(v, 4) if isinstance(v, float) else v for key, v in result.items()})
    print(line)
    if cfg.out is not None:
        with Path(cfg.out).open("a", encoding="utf-8") as file:
            file.write(line + "\n")


def main() -> None:
    """Measures under the config that the command line composes."""
    run_composed(_composed)
