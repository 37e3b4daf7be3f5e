"""Shared fixtures: synthetic motions, scenes and the public motions."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from filelock import FileLock
from hydra.core.hydra_config import HydraConfig
from hypothesis import settings
from mocks import lift_box, load_config

from hdmi.assets import RobotConfig, Scene, SimConfig, build_scene, default_joint_pos, g1, g1_robot
from hdmi.envs.rendering import RenderingError, WorldRenderer
from hdmi.motion import forward_kinematics

settings.register_profile("hdmi", derandomize=True, deadline=None, max_examples=60)
settings.load_profile("hdmi")

FPS = 50.0
NUM_FRAMES = 21
BODIES = ("pelvis", "torso_link", "left_wrist_yaw_link", "box")
JOINTS = ("left_knee_joint", "waist_yaw_joint")


@pytest.fixture(autouse=True)
def drawings() -> None:
    """Whatever a test draws from torch's generator is the same in every run."""
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def gl() -> None:
    """Skips where nothing can be rendered."""
    scene = lift_box().scene
    try:
        WorldRenderer(scene.model, scene.robot, 64, 64).close()
    except RenderingError as error:
        pytest.skip(str(error))


@pytest.fixture(autouse=True)
def no_job() -> Iterator[None]:
    """What a command leaves behind that ran as Hydra's job in this process: the next one is none."""
    yield
    HydraConfig.instance().cfg = None


@pytest.fixture
def motion_arrays() -> dict[str, np.ndarray]:
    """A robot that walks along x at 0.5 m/s, swinging two joints, beside a box that turns at 0.8 rad/s.

    0.4 s at 50 fps; all joints but `JOINTS` hold the default pose. Contact from frame 10 on.
    """
    t = np.arange(NUM_FRAMES) / FPS
    joint_pos = np.stack([0.6 + 0.3 * np.sin(4 * t), 0.2 * t], axis=-1)
    full = np.tile(default_joint_pos(), (NUM_FRAMES, 1))
    for i, name in enumerate(JOINTS):
        full[:, g1.JOINT_NAMES.index(name)] = joint_pos[:, i]
    root_pos = np.stack([0.5 * t, 0 * t, 0.76 + 0 * t], axis=-1)
    root_quat = np.tile([1.0, 0.0, 0.0, 0.0], (NUM_FRAMES, 1))
    pos, quat = forward_kinematics(g1_robot(), root_pos, root_quat, full)
    rows = [g1.BODY_NAMES.index(name) for name in BODIES[:-1]]
    box_pos = np.stack([1.0 + 0 * t, 0.2 * t, 0.3 + 0 * t], axis=-1)
    box_quat = np.stack([np.cos(0.4 * t), 0 * t, 0 * t, np.sin(0.4 * t)], axis=-1)
    return {
        "body_pos_w": np.concatenate([pos[:, rows], box_pos[:, None]], axis=1).astype(np.float32),
        "body_quat_w": np.concatenate([quat[:, rows], box_quat[:, None]], axis=1).astype(np.float32),
        "joint_pos": joint_pos.astype(np.float32),
        "object_contact": (np.arange(NUM_FRAMES) >= 10)[:, None],
    }


@pytest.fixture
def write_motion(tmp_path: Path, motion_arrays: dict[str, np.ndarray]) -> Callable[..., Path]:
    """Writes the synthetic motion, changed as asked, with plain numpy and json: the format, not our writer."""

    def write(
        name: str = "stroll", *, meta: dict[str, Any] | None = None, drop: Iterable[str] = (), **arrays: np.ndarray
    ) -> Path:
        folder = tmp_path / name
        folder.mkdir()
        kept = {key: value for key, value in (motion_arrays | arrays).items() if key not in drop}
        np.savez_compressed(folder / "motion.npz", **kept)
        header = {"body_names": list(BODIES), "joint_names": list(JOINTS), "fps": FPS} | (meta or {})
        header = {key: value for key, value in header.items() if key not in drop}
        (folder / "meta.json").write_text(json.dumps(header), encoding="utf-8")
        return folder

    return write


@pytest.fixture(scope="session")
def public_motions() -> Path:
    """Folder of the public HDMI motions; skips the test where the environment names none."""
    if "HDMI_MOTIONS" not in os.environ:
        pytest.skip("set HDMI_MOTIONS to the folder of the public motions")
    return Path(os.environ["HDMI_MOTIONS"])


@pytest.fixture(scope="session")
def robot_scene() -> Scene:
    """The default robot alone on the floor. Shared: do not change its model."""
    return build_scene(RobotConfig(), SimConfig())


@pytest.fixture
def pose() -> Callable[..., mujoco.MjData]:
    """Fresh data of a scene with the robot at a height and joint angles, the default pose if not given."""

    def make(scene: Scene, joint_pos: np.ndarray | None = None, height: float = g1.ROOT_HEIGHT) -> mujoco.MjData:
        data = mujoco.MjData(scene.model)
        joint_pos = default_joint_pos() if joint_pos is None else joint_pos
        data.qpos[:7] = [0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0]
        data.qpos[scene.joint_qpos] = joint_pos
        data.ctrl[:] = joint_pos
        mujoco.mj_forward(scene.model, data)
        return data

    return make


@pytest.fixture(scope="session")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of lift_box with untrained weights: its targets are close to the motion. One for all test processes."""
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder = shared / "exported"
    with FileLock(shared / "exported.lock"):
        if not folder.is_dir():
            partial = tmp_path_factory.mktemp("partial")
            export_untrained(partial)
            partial.rename(folder)
    return folder


def export_untrained(folder: Path) -> None:
    """Exports lift_box with weights that are drawn at random."""
    from hdmi.assembly import make_env, make_task
    from hdmi.deploy.export import make_graph, write_graph
    from hdmi.learning.networks import make_actor

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hdmi.assembly.start_tables", lambda *_: None)  # they take seconds
        cfg = load_config("task=lift_box")
        task = make_task(cfg)
        env = make_env(cfg, 1, task)
        sizes = env.full_observation_spec["policy"].shape[-1], env.action_spec.shape[-1]
        torch.manual_seed(0)
        actor = make_actor(*sizes, hidden=[32], activation="SiLU", init_noise=0.1, bf16=False)
        graph, task = make_graph(cfg, actor, task)
        write_graph(cfg, graph, task, folder)
