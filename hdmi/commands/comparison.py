"""Speed of other environments on this machine, to hold ours against."""

from __future__ import annotations

import json
import subprocess
import time
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.custom.mujoco.base import MujocoEnv

from hdmi.assets import Scene

_MJLAB = Path(__file__).with_name("benchmark_mjlab.py")


class SceneEnv(MujocoEnv):
    """A scene in TorchRL's own MuJoCo environment: no reward and no task, as in `HumanoidObjectEnv`.

    Action: joint position targets, rad. [1, J]; observation: generalised positions and velocities.

    Args:
        scene: which; the other arguments are `MujocoEnv`'s.
    """

    def __init__(self, *, scene: Scene, **options: Any):
        self._scene_xml = scene.xml
        self._start = torch.from_numpy(scene.default_qpos).float()
        super().__init__(frame_skip=scene.sim.decimation, **options)

    def _load_xml(self, xml_path: Any, *, patch_xml: bool) -> str:
        return self._scene_xml

    def _sample_initial_state(self, n: int, tensordict: TensorDictBase | None = None) -> tuple[Tensor, Tensor]:
        return self._start.expand(n, -1), self._backend.qvel0.expand(n, -1)

    def _compute_reward(self, state: TensorDictBase, action: Tensor, next_state: TensorDictBase) -> Tensor:
        return torch.zeros(self.num_envs, 1, dtype=self.dtype)

    def _compute_done(self, state: TensorDictBase, next_state: TensorDictBase) -> Tensor:
        return torch.zeros(self.num_envs, 1, dtype=torch.bool)


def mujoco_env_speed(scene: Scene, num_envs: int, steps: int) -> float:
    """Control steps per second of TorchRL's MujocoEnv, of all environments together.

    Args:
        num_envs: 1, or a number of processes under `ParallelEnv`, one environment in each.
        steps: control steps, under random targets about the default pose.
    """
    env: EnvBase = SceneEnv(scene=scene, backend="mujoco", num_envs=num_envs, max_episode_steps=100, seed=0)
    pose = torch.tensor(scene.robot.default_joint_pos)
    generator = torch.Generator().manual_seed(0)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        noise = torch.randn(env.action_spec.shape, generator=generator)
        return tensordict.set("action", pose + 0.25 * noise)

    with torch.no_grad():
        carry = env.reset()
        _, carry = env.step_and_maybe_reset(policy(carry))
        start = time.perf_counter()
        for _ in range(steps):
            _, carry = env.step_and_maybe_reset(policy(carry))
        spent = time.perf_counter() - start
    env.close()
    return num_envs * steps / spent


def mjlab_speed(python: str, num_envs: int, steps: int) -> float:
    """Control steps per second of mjlab's tracking task on the CPU.

    Args:
        python: interpreter of an environment that has mjlab.

    Raises:
        RuntimeError: if it cannot be run, with the last line of what it said.
    """
    command = [python, str(_MJLAB), str(num_envs), str(steps)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise RuntimeError(f"mjlab: {error}") from error
    if done.returncode:
        raise RuntimeError(f"mjlab: {(done.stderr or done.stdout).strip().splitlines()[-1]}")
    return json.loads(done.stdout.strip().splitlines()[-1])["sps"]
