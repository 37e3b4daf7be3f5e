"""Speed of mjlab's tracking task on the CPU, for `hdmi benchmark`; run by the interpreter of an environment with mjlab.

    python benchmark_mjlab.py NUM_ENVS STEPS

mjlab pins another MuJoCo than this package, so the two do not share an environment. The task is mjlab's own, with its
robot, its rewards and its randomization; the reference stands still in the default pose. The last line is JSON.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.tracking.config.g1.env_cfgs import unitree_g1_flat_tracking_env_cfg

_FRAMES = 500


def standing_motion(path: Path) -> None:
    """Writes a reference in which the robot of the task stands still."""
    import mujoco
    from mjlab.asset_zoo.robots import get_g1_robot_cfg
    from mjlab.entity import Entity

    robot = Entity(get_g1_robot_cfg())
    model = robot.spec.compile()
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    still = {
        "joint_pos": data.qpos[7:],
        "joint_vel": np.zeros(model.nv - 6),
        "body_pos_w": data.xpos[1:],
        "body_quat_w": data.xquat[1:],
        "body_lin_vel_w": np.zeros((model.nbody - 1, 3)),
        "body_ang_vel_w": np.zeros((model.nbody - 1, 3)),
    }
    arrays: dict[str, Any] = {key: np.repeat(value[None], _FRAMES, axis=0) for key, value in still.items()}
    np.savez(path, fps=[50], **arrays)


def main(num_envs: int, steps: int) -> None:
    """Steps the task under random actions and prints control steps of all worlds per second."""
    cfg = unitree_g1_flat_tracking_env_cfg()
    with tempfile.TemporaryDirectory() as folder:
        motion = Path(folder) / "motion.npz"
        standing_motion(motion)
        cfg.commands["motion"].motion_file = str(motion)
        cfg.scene.num_envs = num_envs
        env = ManagerBasedRlEnv(cfg, device="cpu")
        env.reset()
        size = env.action_manager.total_action_dim
        generator = torch.Generator().manual_seed(0)
        actions = [0.25 * torch.randn(num_envs, size, generator=generator) for _ in range(steps)]
        env.step(actions[0])  # kernels are compiled
        start = time.perf_counter()
        for action in actions:
            env.step(action)
        spent = time.perf_counter() - start
        env.close()
    print(json.dumps({"sps": num_envs * steps / spent, "num_envs": num_envs}))


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
