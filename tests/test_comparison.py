"""TorchRL's environment, which ours is measured against, simulates the same thing."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from hdmi.assets import RobotConfig, SimConfig, build_scene
from hdmi.commands.comparison import SceneEnv


def test_torchrl_env_steps_the_scene() -> None:
    scene = build_scene(RobotConfig(), SimConfig())
    env = SceneEnv(scene=scene, backend="mujoco", max_episode_steps=100, seed=0)
    targets = torch.from_numpy(scene.default_qpos[scene.joint_qpos]).float() + 0.1
    carry = env.reset()
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.default_qpos
    for _ in range(3):
        carry = env.step(carry.set("action", targets.unsqueeze(0)))["next"]
        data.ctrl[:] = targets.numpy()
        mujoco.mj_step(scene.model, data, scene.sim.decimation)
    expected = np.concatenate([data.qpos, data.qvel])
    np.testing.assert_allclose(carry["observation"][0].numpy(), expected, rtol=1e-4, atol=1e-4)
