"""Starts are consistent: with the object's size, joint ranges and supports; what is too deep is drawn again."""

from __future__ import annotations

from functools import cache

import mujoco
import numpy as np
import pytest
import torch
from mocks import lift_box, load_config
from omegaconf import OmegaConf
from tensordict import TensorDict
from torch import Tensor

from hdmi import transforms as T
from hdmi.assembly import Task, make_env, make_task
from hdmi.assets import Effector, ObjectConfig, RobotConfig, SceneryConfig, SimConfig, build_scene, g1
from hdmi.config import task_files
from hdmi.envs import HumanoidObjectEnv
from hdmi.motion import Motion, make_reference
from hdmi.motion.format import motion_from_poses
from hdmi.motion.starts import start_tables

DEPTH = 0.02  # m
WORLDS = 48


@cache
def task_of(name: str) -> Task:
    return make_task(load_config(f"task={name}"))


def deepest(env: HumanoidObjectEnv, world: int) -> tuple[float, tuple[str, str]]:
    """Depth of a world's deepest contact of any two geoms, m, and their names."""
    model, data = env.backend.world(world)
    if not data.ncon:
        return 0.0, ("", "")
    i = int(np.argmin(data.contact.dist))
    first, second = (model.geom(int(g)).name for g in data.contact.geom[i])
    return -float(data.contact.dist[i]), (first, second)


@pytest.mark.parametrize("name", list(task_files()))
def test_no_contact_is_deep_whatever_the_objects_size(name: str) -> None:
    """From frames all over the motion, without noise; next to none has to be drawn again for that."""
    cfg = load_config(f"task={name}", "reset.state.first_share=0")
    cfg.reset.state.noise, cfg.stack = {}, ["reset", "randomization"]
    node = cfg.randomization.object_scale
    for size in [1.0] if node is None else [node.scale[0], 1.0, node.scale[1]]:
        if node is not None:
            node.scale = [size, size]
        torch.manual_seed(0)
        env = make_env(cfg, WORLDS, task_of(name))
        env.reset()
        assert env.num_redrawn < 0.15 * WORLDS
        assert env.num_deep == 0
        for world in range(WORLDS):
            depth, pair = deepest(env.base_env, world)
            assert depth < DEPTH + 5e-4, f"size {size}: {pair} by {depth:.4f} m"


@pytest.mark.parametrize("name", list(task_files()))
def test_noise_stays_in_the_joint_ranges(name: str) -> None:
    task, cfg = task_of(name), load_config(f"task={name}")
    noise = OmegaConf.to_container(load_config("task=move_suitcase").reset.state.noise)  # the widest
    init = T.ReferenceStateInitialization(task.reference, g1.JOINT_RANGES, noise=noise, starts=task.starts)
    torch.manual_seed(0)
    frames = torch.randint(task.reference.num_frames, (4000,))
    scale = 0.9 + 0.2 * torch.rand(4000, 1) if cfg.randomization.object_scale is not None else None
    joint_pos = init.initial_state(frames, scale)["joint_pos"]
    low, high = torch.tensor(g1.JOINT_RANGES).unbind(-1)
    assert (joint_pos >= low).all()
    assert (joint_pos <= high).all()


# -- a box on a stand between two hands ------------------------------------------------------------------------------

BOX = ObjectConfig("box", geoms=[{"box": [0.1, 0.15, 0.1]}])
STAND = SceneryConfig("stand", geoms=[{"box": [0.1, 0.1, 0.3]}])
HANDS = [
    Effector(f"{side}_wrist_yaw_link", point=(0.12, 0.0, 0.0), target=(0.0, sign * 0.15, 0.0))
    for side, sign in (("left", 1), ("right", -1))
]


def standing(object_pos: tuple[float, float, float], stand_pos: tuple[float, float, float], contact: bool) -> Motion:
    """Two frames of a robot that stands, with the box and its stand somewhere."""
    pos = np.tile(np.array([(0.0, 0.0, g1.ROOT_HEIGHT), object_pos, stand_pos]), (2, 1, 1))
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (2, 3, 1))
    joints = np.tile(RobotConfig().default_joint_pos, (2, 1))
    labels = np.full((2, 2), contact)
    return motion_from_poses("standing", 50.0, ("pelvis", "box", "stand"), g1.JOINT_NAMES, pos, quat, joints, labels)


def tables_of(object_pos, stand_pos=(5.0, 0.0, 0.3), contact=False):
    motion = standing(object_pos, stand_pos, contact)
    reference = make_reference(motion, control_dt=0.02, object=BOX, scenery=[STAND], effectors=HANDS)
    scene = build_scene(RobotConfig(), SimConfig(), BOX, [STAND], HANDS, reference.placements)
    return scene, reference, start_tables(scene, reference)


def test_objects_rise_so_that_their_lowest_point_stays():
    _, _, tables = tables_of((3.0, 0.0, 0.7))
    assert tables.object_height.flatten().tolist() == pytest.approx([0.1, 0.1])
    assert not tables.root_pos.any()
    assert not tables.joint_pos.any()


@pytest.mark.parametrize(("stand_pos", "carries"), [((3.0, 0.0, 0.3), True), ((5.0, 0.0, 0.3), False)])
def test_a_support_is_what_the_object_stands_on(stand_pos, carries):
    _, _, tables = tables_of((3.0, 0.0, 0.7), stand_pos)
    assert tables.carries.tolist() == [[carries]] * 2


def test_hands_go_where_the_contact_points_go():
    """Twice the linear answer of a tenth is that of a fifth, and the hands move as the targets do."""
    scene, reference, tables = tables_of((0.35, 0.0, 0.85), contact=True)
    assert tables.joint_pos.abs().max() > 0.1
    data = mujoco.MjData(scene.model)

    def hands(size: float) -> np.ndarray:
        data.qpos[:] = scene.default_qpos
        data.qpos[:3] = reference.body_pos[0, 0].numpy() + (size - 1) * tables.root_pos[0].numpy()
        data.qpos[scene.joint_qpos] = (reference.joint_pos[0] + (size - 1) * tables.joint_pos[0]).numpy()
        mujoco.mj_kinematics(scene.model, data)
        bodies = [scene.model.body(hand.body).id for hand in HANDS]
        return np.stack([data.xpos[b] + data.xmat[b].reshape(3, 3) @ HANDS[0].point for b in bodies])

    moved = hands(1.1) - hands(1.0)
    # the sides move apart by 15 mm each, and the box, which stands on its lowest point, rises by 10 mm
    np.testing.assert_allclose(moved, [[0, 0.015, 0.01], [0, -0.015, 0.01]], atol=0.003)


def test_supports_move_with_what_they_carry_and_only_then():
    _, reference, tables = tables_of((3.0, 0.0, 0.7), (3.0, 0.0, 0.3))
    init = T.ReferenceStateInitialization(
        reference, g1.JOINT_RANGES, noise={"object_pos": [0.05, 0.05, 0.0]}, starts=tables
    )
    state = init.initial_state(torch.zeros(5, dtype=torch.int64))
    moved = state["object_pos"] - reference.object_pos[0]
    assert moved[:, :2].abs().min() > 1e-4
    torch.testing.assert_close(state["scenery_pos"][:, 0] - torch.tensor([3.0, 0.0, 0.3]), moved)
    _, reference, tables = tables_of((3.0, 0.0, 0.7))
    init = T.ReferenceStateInitialization(
        reference, g1.JOINT_RANGES, noise={"object_pos": [0.05, 0.05, 0.0]}, starts=tables
    )
    assert "scenery_pos" not in init.initial_state(torch.zeros(5, dtype=torch.int64))


def test_the_environment_puts_scenery_where_it_is_told():
    scene, *_ = tables_of((3.0, 0.0, 0.7), (3.0, 0.0, 0.3))
    env = HumanoidObjectEnv(scene, 3)
    env.reset()
    places = torch.tensor([[[3.1, 0.0, 0.3]], [[3.0, 0.2, 0.3]]])
    env.place(torch.tensor([0, 2]), TensorDict({"scenery_pos": places}, batch_size=[2]))
    found = [env.backend.world(i)[1].body("stand").xpos.tolist() for i in range(3)]
    np.testing.assert_allclose(found, [[3.1, 0, 0.3], [3, 0, 0.3], [3, 0.2, 0.3]], atol=1e-6)


# -- drawn again -----------------------------------------------------------------------------------------------------


def starts_of(env) -> Tensor:
    return env.base_env.penetration()


def suitcase(*overrides: str, num_envs: int = 64):
    torch.manual_seed(0)
    cfg = load_config("task=move_suitcase", *overrides)
    return make_env(cfg, num_envs, task_of("move_suitcase"))


def test_deep_starts_are_drawn_again_and_counted():
    free = suitcase("starts.redraws=0")
    free.reset()
    assert (starts_of(free) > DEPTH).float().mean() > 0.2
    assert free.num_redrawn == 0
    env = suitcase()
    env.reset()
    assert env.num_deep == 0
    assert (starts_of(env) <= DEPTH).all()
    assert env.num_redrawn > 0


def test_rows_that_reset_are_drawn_again_and_others_stay():
    env = suitcase()
    start = env.reset()
    before = env.base_env.backend.data("qpos").clone()
    start["done"][::2] = True
    fresh = env.maybe_reset(start)
    after = env.base_env.backend.data("qpos")
    assert torch.equal(after[1::2], before[1::2])
    assert (after[::2] != before[::2]).any(-1).all()
    assert (starts_of(env) <= DEPTH).all()
    torch.testing.assert_close(fresh["policy"][1::2], start["policy"][1::2])


def test_a_start_keeps_its_frame_when_it_is_drawn_again():
    task = task_of("move_suitcase")
    init = T.ReferenceStateInitialization(task.reference, g1.JOINT_RANGES, noise={"joint_pos": 0.1}, starts=task.starts)
    given = {"frame": torch.tensor([[7], [30]]), "noise_share": torch.tensor([[0.0], [0.5]])}
    out = init._reset_env_preprocess(TensorDict({"init": given}, batch_size=[2]))["init"]
    assert out["frame"].flatten().tolist() == [7, 30]
    change = (out["joint_pos"] - task.reference.joint_pos[[7, 30]]).abs()
    assert change[0].max() < 1e-6
    assert 0.02 < change[1].max() <= 0.05


# -- joints that the policy does not drive ----------------------------------------------------------------------------

WRISTS = [i for i, name in enumerate(g1.JOINT_NAMES) if "wrist" in name]


def test_held_joints_are_at_the_default_pose_and_move_their_bodies():
    motion = standing((3.0, 0.0, 0.7), (5.0, 0.0, 0.3), contact=False)
    turned = motion.joint_pos.copy()
    turned[:, WRISTS] = 0.3
    motion = motion_from_poses(
        "turned", 50.0, motion.body_names, g1.JOINT_NAMES, motion.body_pos_w, motion.body_quat_w, turned
    )
    given = {"control_dt": 0.02, "object": BOX, "scenery": [STAND]}
    free = make_reference(motion, **given)
    assert free.joint_pos[:, WRISTS].unique().tolist() == pytest.approx([0.3])
    robot = RobotConfig(default_pose={"left_wrist_yaw_joint": -0.4}, held=[".*_wrist_.*"])
    held = make_reference(motion, **given, robot=robot)
    expected = [-0.4 if g1.JOINT_NAMES[i] == "left_wrist_yaw_joint" else 0.0 for i in WRISTS]
    assert held.joint_pos[0, WRISTS].tolist() == pytest.approx(expected)
    others = [i for i in range(29) if i not in WRISTS]
    assert torch.equal(held.joint_pos[:, others], free.joint_pos[:, others])
    hand, torso = (g1.BODY_NAMES.index(name) for name in ("left_wrist_yaw_link", "torso_link"))
    assert not torch.allclose(held.body_quat[:, hand], free.body_quat[:, hand])
    torch.testing.assert_close(held.body_quat[:, torso], free.body_quat[:, torso])


def test_tasks_hold_the_wrists_that_the_policy_does_not_drive():
    reference, cfg = task_of("move_suitcase").reference, load_config("task=move_suitcase")
    yaws = [g1.JOINT_NAMES.index(f"{side}_wrist_yaw_joint") for side in ("left", "right")]
    assert reference.joint_pos[:, yaws].unique(dim=0).flatten().tolist() == pytest.approx([-0.4, 0.4])
    assert cfg.robot.effector == "hand"
    follows = make_task(load_config("task=move_suitcase", "robot.unactuated=reference", "robot.default_pose={}"))
    assert not torch.equal(follows.reference.joint_pos[:, WRISTS], lift_box().reference.joint_pos[:1, WRISTS])


def test_press_moves_contact_points_into_the_object():
    motion = standing((3.0, 0.0, 0.7), (5.0, 0.0, 0.3), contact=True)
    outside = [Effector(hand.body, hand.point, (0.02, hand.target[1] * 1.2, 0.03), press=0.06) for hand in HANDS]
    reference = make_reference(motion, control_dt=0.02, object=BOX, scenery=[STAND], effectors=outside)
    expected = torch.tensor([[0.02, 0.12, 0.03], [0.02, -0.12, 0.03]]).expand(2, 2, 3)
    torch.testing.assert_close(reference.contact_point, expected, atol=1e-4, rtol=0)
