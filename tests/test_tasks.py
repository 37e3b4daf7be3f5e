"""The tasks of conf/task: they build and step, objects move as they should, and the smoke test finds what is wrong."""

from __future__ import annotations

import math
import re
import runpy
import subprocess
import sys
from functools import cache
from pathlib import Path
from unittest.mock import patch

import imageio.v2 as imageio
import mujoco
import numpy as np
import pytest
import torch
import trimesh
from mocks import CONF, load_config
from omegaconf import DictConfig, OmegaConf
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, check_env_specs, exploration_type

from hdmi.assembly import Task, make_env, make_task, make_transforms, scene_parts
from hdmi.assets import default_joint_pos, g1, g1_robot
from hdmi.config import ConfigError, task_files
from hdmi.evaluation import EvalResult
from hdmi.evaluation.agents import BlindAgent
from hdmi.evaluation.protocol import evaluation_config, make_evaluation_env
from hdmi.motion import Motion, find_motion, forward_kinematics, load_motion, save_motion
from hdmi.tasks.catalogue import list_tasks, sources
from hdmi.tasks.check import Hold, Training, check_task, measure_contacts, measure_hold, returns
from hdmi.tasks.gallery import picture_frame, render_reference
from hdmi.workshop.validate import validate_motion

ROOT = CONF.parent
TASKS = list(task_files())
PAPER = {
    "move_suitcase", "push_box", "carry_bread_box", "move_foam", "push_door_hand", "open_door_feet", "traverse_door",
    "open_foldchair_sit", "topple_wood_board", "roll_ball", "move_stool", "lift_box_over_shoulder", "truman_bow",
    "move_trash_bin",
}  # fmt: skip
ARTICULATED = {"push_door_hand", "open_door_feet", "traverse_door", "open_foldchair_sit"}

# m, mean distance of end effector points to contact points in the labelled frames of the public motions
PUBLIC_DISTANCES = {
    "move_suitcase": 0.11, "push_box": 0.06, "carry_bread_box": 0.045, "move_foam": 0.03, "push_door_hand": 0.19,
    "open_door_feet": 0.19, "open_foldchair_sit": 0.13, "topple_wood_board": 0.16,
}  # fmt: skip

FRAMES = 40
HINGE_ANGLE = 0.5  # of the standing motion's objects, rad


def standing_motion(cfg: DictConfig) -> Motion:
    """The robot stands before the task's object; nothing moves, contact is intended in the second half."""
    node = cfg.task.object
    bodies, joints, values = ["pelvis"], ["left_knee_joint"], [0.669]
    places = [[0.0, 0.0, g1.ROOT_HEIGHT]]
    for item in [*([] if node is None else [node]), *cfg.task.scenery]:
        bodies.append(item.name)
        places.append([1.2, 0.0, 0.5] if len(bodies) == 2 else [4.0 + len(bodies), 0.0, 0.1])
    if node is not None and node.get("hinge") is not None:
        joints.append(node.hinge.name)
        values.append(HINGE_ANGLE)
    pos = np.tile(np.asarray(places, np.float32), (FRAMES, 1, 1))
    quat = np.tile(np.float32([1, 0, 0, 0]), (FRAMES, len(bodies), 1))
    contact = np.zeros((FRAMES, len(cfg.task.effectors)), bool)
    contact[FRAMES // 2 :] = True
    zeros = np.zeros_like(pos)
    joint_pos = np.tile(np.float32(values), (FRAMES, 1))
    return Motion(
        name=cfg.task.motion, fps=50.0, body_names=tuple(bodies), joint_names=tuple(joints), body_pos_w=pos,
        body_quat_w=quat, body_lin_vel_w=zeros, body_ang_vel_w=zeros, joint_pos=joint_pos,
        joint_vel=np.zeros_like(joint_pos), object_contact=contact if contact.size else None,
    )  # fmt: skip


# the long ones take up to half a minute each
LONG = ("traverse_door", "truman_bow", "topple_wood_board", "push_box", "open_foldchair_sit")


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in LONG)) for name in TASKS])
def test_reference_that_ships_is_worth_training_on(name: str) -> None:
    cfg = load_config(f"task={name}")
    report = validate_motion(load_motion(find_motion(cfg.task.motion)), **scene_parts(cfg))
    assert report.verdict == "good", report.reasons


def test_the_robots_masses_leave_the_chairs_seat_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its link is called as the robot's are."""
    monkeypatch.setattr("hdmi.assembly.start_tables", lambda *_: None)  # seconds, and no mass depends on them
    cfg = load_config("task=open_foldchair_sit")
    env = make_env(cfg, 64)
    env.reset()
    mass = env.base_env.backend.model("body_mass")[:, env.base_env.scene.model.body("seat_link").id]
    low, high = cfg.task.randomization.object_mass
    assert (mass >= low).all()
    assert (mass <= high).all()
    assert mass.min() < low + 0.3  # the range is used to its ends
    assert mass.max() > high - 0.3


@pytest.fixture(scope="session")
def motions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A motion for every task."""
    folder = tmp_path_factory.mktemp("motions")
    for name in TASKS:
        save_motion(standing_motion(load_config(f"task={name}")), folder / name)
    return folder


@cache
def built(name: str, motions: Path) -> tuple[DictConfig, Task]:
    cfg = load_config(f"task={name}", f"motion_root={motions}")
    return cfg, make_task(cfg)


def env_of(name: str, motions: Path, num_envs: int = 2, *overrides: str) -> TransformedEnv:
    cfg, task = built(name, motions)
    if overrides:
        cfg = load_config(f"task={name}", f"motion_root={motions}", *overrides)
    return make_env(cfg, num_envs, task)


class TestConfigs:
    def test_the_papers_fourteen_are_there(self):
        assert set(TASKS) >= PAPER | {"walk", "lift_box"}

    def test_each_has_a_reference_of_its_own(self):
        assert [name for name in TASKS if "shipped" not in sources(load_config(f"task={name}"))] == []

    @pytest.mark.parametrize("name", TASKS)
    def test_builds(self, name, motions):
        nodes = [node for node, _ in make_transforms(*built(name, motions))]
        for node in ("reward.object_joint", "termination.object_joint"):
            assert (node in nodes) == (name in ARTICULATED)
        for node in ("reward.object_pose", "termination.object_pose"):
            assert (node in nodes) == (name not in ARTICULATED | {"walk"})

    @pytest.mark.parametrize("name", ["traverse_door", "truman_bow"])
    def test_passes_the_specs(self, name, motions):
        env = env_of(name, motions)
        check_env_specs(env)
        rollout = env.rollout(3, break_when_any_done=False)
        assert rollout["next", "policy"].isfinite().all()
        assert rollout["next", "reward"].isfinite().all()

    def test_hyper_parameters_are_the_same(self, motions):
        algos = [built(name, motions)[0].algo for name in sorted(PAPER | {"walk"})]
        assert all(algo == algos[0] for algo in algos)

    def test_the_command_line_chooses_the_algorithm(self):
        algo = load_config("task=push_box", "algo=ppo_authors").algo
        assert (algo.desired_kl, algo.epochs, algo.init_noise) == (0.01, 3, 1.0)

    def test_another_object_for_a_task(self):
        assert load_config("task=push_door_hand", "object=suitcase").task.object.name == "suitcase"


class TestDoor:
    """At angle zero the panel closes the opening between the walls; beyond a quarter turn it leaves it."""

    def panel(self, motions: Path, angle: float) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner of the panel in the frame of the door."""
        _, task = built("traverse_door", motions)
        scene, data = task.scene, mujoco.MjData(task.scene.model)
        data.qpos[scene.object_hinge_qpos] = angle
        mujoco.mj_kinematics(scene.model, data)
        geom = scene.object_geoms[-1]
        corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T * scene.model.geom_size[geom]
        world = corners @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        local = world - data.xpos[scene.object_body]
        return local.min(0), local.max(0)

    def test_closed(self, motions):
        low, high = self.panel(motions, 0.0)
        np.testing.assert_allclose(low, [-0.02, -0.5, 0.025], atol=1e-6)
        np.testing.assert_allclose(high, [0.02, 0.5, 1.975], atol=1e-6)

    @pytest.mark.parametrize("side", [-1.0, 1.0])
    def test_open(self, motions, side):
        low, high = self.panel(motions, side * math.pi / 2)
        assert low[1] > 0.45
        # the hinge is at +y, the panel extends to -y: a positive turn moves it to +x
        assert (high if side > 0 else low)[0] == pytest.approx(side, abs=1e-6)

    def test_stands_still_and_weighs_what_its_panel_does(self, motions):
        env = env_of("traverse_door", motions, 3, "reset.state.start=first")
        td = env.base_env.reset()
        base, link = env.base_env.scene.object_body, env.base_env.scene.object_link
        mass = env.base_env.backend.model("body_mass")
        assert (mass[:, base] == 0).all()
        torch.testing.assert_close(td["object", "mass"].squeeze(-1), mass[:, link].float())
        env.reset()
        drawn = env.base_env.backend.model("body_mass")[:, link]
        assert ((drawn >= 5) & (drawn <= 20)).all()
        assert len(drawn.unique()) == 3

    def test_joint_friction_and_damping_are_drawn(self, motions):
        env = env_of("open_door_feet", motions, 4)
        env.reset()
        dof = env.base_env.scene.object_hinge_dof
        friction = env.base_env.backend.model("dof_frictionloss")[:, dof]
        damping = env.base_env.backend.model("dof_damping")[:, dof]
        assert ((friction >= 5) & (friction <= 10)).all()
        assert ((damping >= 1) & (damping <= 5)).all()
        assert len(friction.unique()) == len(damping.unique()) == 4

    def test_reward_is_for_the_angle(self, motions):
        still = ["+ablation=no_randomization", "reset.state.noise=null", "reset.state.start=first"]
        env = env_of("push_door_hand", motions, 2, *still)
        td = env.reset()
        scene = env.base_env.scene
        # held at 0.3 rad off the reference: the reward is exp(-0.3 / 0.5)
        env.base_env.backend.data("qpos")[:, scene.object_hinge_qpos] = HINGE_ANGLE + 0.3
        env.base_env.backend.refresh(torch.arange(2))
        after = env.step(td.set("action", torch.zeros(env.action_spec.shape)))["next"]
        term = after["reward_terms", "object_joint"]
        torch.testing.assert_close(term, torch.full_like(term, math.exp(-0.6)), atol=0.01, rtol=0)

    def test_a_door_that_stays_shut_ends_the_episode(self, motions):
        still = ["+ablation=no_randomization", "reset.state.noise=null", "reset.state.start=first"]
        env = env_of("push_door_hand", motions, 2, "termination.object_joint.min_steps=2", *still)
        td = env.reset()
        hinge, qpos = env.base_env.scene.object_hinge_qpos, env.base_env.backend.data("qpos")
        fired = []
        for _ in range(2):
            qpos[:, hinge] = HINGE_ANGLE - torch.tensor([1.15, 1.25])  # 1.2 rad is allowed
            env.base_env.backend.refresh(torch.arange(2))
            td = env.step(td.set("action", torch.zeros(env.action_spec.shape)))
            fired.append(td["next", "termination", "object_joint"].flatten().tolist())
            td = td["next"]
        assert fired == [[False, False], [False, True]]

    def test_scaled_with_its_hinge_and_contact_points(self, motions):
        env = env_of("push_door_hand", motions, 2, "randomization.object_scale.scale=[0.8,0.8]")
        env.reset()
        base = env.base_env
        place = base.backend.data("xpos")
        hinge = place[:, base.scene.object_link] - place[:, base.scene.object_body]
        torch.testing.assert_close(hinge, torch.tensor([[0.0, 0.4, 0.0]] * 2, dtype=torch.float64))
        size = base.backend.model("geom_size")[:, int(base.scene.object_geoms[-1])]
        torch.testing.assert_close(size, torch.tensor([[0.016, 0.4, 0.78]] * 2, dtype=torch.float64))


def test_folding_chair_has_its_seat_up_at_zero_and_level_when_open(motions):
    _, task = built("open_foldchair_sit", motions)
    scene, data = task.scene, mujoco.MjData(task.scene.model)
    ahead = []
    for angle in (0.0, 1.57):
        data.qpos[scene.object_hinge_qpos] = angle
        mujoco.mj_kinematics(scene.model, data)
        ahead.append(data.xmat[scene.object_link].reshape(3, 3)[:, 0].copy())
    assert ahead[0][2] > 0.99
    assert ahead[1][0] > 0.99


def test_a_board_that_is_let_go_falls_onto_the_platforms_as_in_the_reference():
    cfg = load_config("task=topple_wood_board", "reset.state.noise=null", "num_threads=1")
    task = make_task(cfg)
    loose = int(task.reference.contact.any(dim=1).nonzero().max()) + 1
    env = make_evaluation_env(evaluation_config(cfg, start=loose), task, 2)
    env.set_seed(0)
    agent = BlindAgent("zero", env.action_spec.shape[-1])
    error = env.rollout(50, agent, break_when_any_done=False)["next", "metrics", "object_ori_error"]  # [N, T, 1]
    assert error.max() < 0.2  # rad; it turns by 1.3
    assert error[:, -1].max() < 0.05


def test_stairs_rise_in_three_steps(motions):
    _, task = built("truman_bow", motions)
    scene = task.scene
    tops = scene.model.geom_pos[scene.object_geoms, 2] + scene.model.geom_size[scene.object_geoms, 2]
    np.testing.assert_allclose(tops, [0.21, 0.41, 0.61])
    assert scene.model.geom("left_foot_collision").conaffinity[0] & 1  # feet meet other parts of the robot


def test_servos_of_the_wrists_are_soft_where_the_task_says_so(motions):
    soft, table = (built(name, motions)[1].scene.model for name in ("carry_bread_box", "move_stool"))
    for joint in g1.JOINT_NAMES:
        gains = [float(model.actuator(joint).gainprm[0]) for model in (soft, table)]
        assert (gains[0] == 4.0) == ("wrist" in joint), joint
        assert (gains[0] == gains[1]) == ("wrist" not in joint), joint


class TestCheck:
    def test_distances_by_hand(self, tmp_path):
        """A box whose contact point is the left hand's, seen from a centimetre to the side."""
        cfg = load_config("task=lift_box", "task.scenery=[]", f"motion_root={tmp_path}")
        point = np.array(cfg.task.effectors[0].point)
        pos, quat = forward_kinematics(
            g1_robot(), np.array([[0, 0, g1.ROOT_HEIGHT]]), np.array([[1.0, 0, 0, 0]]), default_joint_pos()[None]
        )
        hand = g1.BODY_NAMES.index("left_wrist_yaw_link")
        turned = np.zeros(3)
        mujoco.mju_rotVecQuat(turned, point, quat[0, hand])
        motion = standing_motion(cfg)
        # the target is at +y of the box: its side is then one centimetre from the fingertip
        box = pos[0, hand] + turned - np.array(cfg.task.effectors[0].target) + [0.0, -0.01, 0.0]
        motion.body_pos_w[:, 1] = box
        save_motion(motion, tmp_path / "lift_box")
        left, right = measure_contacts(cfg)
        np.testing.assert_allclose(left.distance, 0.01, atol=1e-4)
        assert len(left.distance) == FRAMES // 2
        assert np.abs(left.gap).max() < 0.05
        assert right.distance.min() > 0.05

    def test_hands_of_lift_box_press_its_box(self):
        for contact in measure_contacts(load_config()):
            assert contact.distance.mean() < 0.03
            assert contact.gap.mean() < 0.0

    def test_finds_an_object_out_of_reach_and_missing_labels(self, tmp_path):
        motion = standing_motion(load_config("task=push_box"))
        motion.object_contact[:, 1] = False
        save_motion(motion, tmp_path / "push_box")
        check = check_task("push_box", str(tmp_path), frames=0)
        far, unlabelled = check.problems
        assert far.startswith("left_wrist_yaw_link: on average ")
        assert unlabelled == "right_wrist_yaw_link: the motion labels no contact"
        assert 0 < check.zero["survival"]["mean"] <= 1

    def test_hands_of_lift_box_hold_its_box_and_none_that_is_beside_them(self, tmp_path):
        motion = load_motion(find_motion("lift_box"))
        box = motion.body_names.index("box")
        motion.body_pos_w[:, box, 1] += 0.5
        yaw = 0.6 * np.arange(motion.num_frames) / motion.fps  # rad; the box does not follow
        motion.body_quat_w[:, box] = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=-1)
        motion.body_ang_vel_w[:, box] = 0.0
        save_motion(motion, tmp_path / "lift_box")
        found = []
        for options in ((), (f"motion_root={tmp_path}",)):
            cfg = load_config(*options)
            with patch.multiple("hdmi.tasks.check", _HOLD_STARTS=2, _EPISODES=2):
                found.append(measure_hold(cfg, make_task(cfg)))
        held, missed = found
        assert held.contacts.shape == held.turn.shape == missed.contacts.shape == (2,)
        assert held.contacts.min() > 0.8
        assert held.turn.max() < 0.2
        assert missed.contacts.max() < 0.1
        np.testing.assert_allclose(missed.turn, 0.6 * 0.5, atol=0.02)

    def test_no_hold_without_contacts(self):
        cfg = load_config("task=walk")
        hold = measure_hold(cfg, make_task(cfg))
        assert not len(hold.contacts)
        assert str(hold) == ""

    @pytest.mark.parametrize(("shares", "problems"), [([0.3, 0.6], 1), ([0.4, 0.6], 0), ([], 0)])
    def test_a_reference_that_does_not_hold_fails(self, only_training, shares, problems):
        with patch("hdmi.tasks.check.measure_hold", return_value=Hold(np.array(shares), np.zeros(len(shares)))):
            found = check_task("lift_box", frames=0).problems
        assert len(found) == problems
        assert all("45% of the contacts last 0.5 s" in problem for problem in found)

    def test_gain_is_that_of_the_same_episodes(self):
        training = Training(before=np.array([1.0, 5.0, 9.0, 4.0]), after=np.array([2.0, 8.0, 14.0, 2.0]))
        assert training.gain == pytest.approx((1.75, 2.0))
        # of the 16 ways to sign ranks 1 to 4, those of the positive ones sum up to 8 or more in three
        assert training.chance == pytest.approx(3 / 16)

    def test_one_lost_episode_does_not_outweigh_all_others(self):
        before, after = np.zeros(20), np.arange(1.0, 21.0)
        after[-1] = -200.0
        training = Training(before, after)
        assert training.gain == pytest.approx((-0.5, 9.5))
        assert training.chance < 0.01
        assert Training(after, before).chance > 0.99
        assert Training(before, before).chance == pytest.approx(0.5, abs=0.1)

    @pytest.fixture
    def only_training(self):
        """Without a policy the task is what it is: checks that are about the training alone need not look again."""
        stub = EvalResult({"survival": {"mean": 1.0, "std": 0.0}})
        known = {
            "evaluate_policy": stub,
            "check_env_specs": None,
            "measure_hold": Hold(np.array([0.4, 0.8]), np.zeros(2)),
        }
        with patch.multiple("hdmi.tasks.check", **{name: lambda *_, v=value: v for name, value in known.items()}):
            yield

    def test_trains(self, only_training):
        with patch.multiple("hdmi.tasks.check", _RETURN_ENVS=4, _RETURN_STEPS=4):
            training = check_task("lift_box", frames=64, num_envs=4, num_threads=1).training
        assert training.before.shape == training.after.shape == (4,)
        assert not np.array_equal(training.before, training.after)

    def test_a_training_that_makes_it_worse_fails(self, only_training):
        worse, better = np.arange(20.0), np.arange(1.0, 21.0)
        for training, problems in ((Training(worse, better), 0), (Training(better, worse), 1)):
            with patch("hdmi.tasks.check._train", return_value=training):
                found = check_task("lift_box", frames=1).problems
            assert len(found) == problems
            assert all("training of 2 frames: " in problem for problem in found)
            assert all("in the median by -1.000" in problem for problem in found)

    def test_a_second_training_has_twice_as_many_frames(self, only_training):
        worse, better, asked = np.arange(20.0), np.arange(1.0, 21.0), []

        def train(cfg, task):
            asked.append(cfg.total_frames)
            return Training(better, worse) if len(asked) == 1 else Training(worse, better)

        with patch("hdmi.tasks.check._train", train):
            assert check_task("lift_box", frames=64).problems == []
        assert asked == [64, 128]

    def test_the_same_policy_earns_the_same(self):
        # starts and randomization are drawn alike, so that only the policy makes a difference
        cfg = load_config()
        task, agent = make_task(cfg), BlindAgent("zero", 23)
        with patch.multiple("hdmi.tasks.check", _RETURN_ENVS=8, _RETURN_STEPS=4):
            first, second = returns(cfg, task, agent), returns(cfg, task, agent)
        assert first.shape == (8,)
        assert np.ptp(first) > 0
        assert np.array_equal(first, second)

    def test_return_is_that_of_the_policy_with_its_noise(self):
        cfg = load_config()
        modes = set()

        class Agent(BlindAgent):
            def forward(self, tensordict):
                modes.add(exploration_type())
                return super().forward(tensordict)

        with patch.multiple("hdmi.tasks.check", _RETURN_ENVS=2, _RETURN_STEPS=2):
            returns(cfg, make_task(cfg), Agent("zero", 23))
        assert modes == {ExplorationType.RANDOM}

    def test_a_negative_number_of_frames_is_refused(self):
        with pytest.raises(ConfigError, match="frames: expected 0 or more, got -1"):
            check_task("lift_box", frames=-1)

    def test_list_has_all_tasks(self, motions):
        table = list_tasks(str(motions))
        assert list(table.columns[0].cells) == TASKS
        columns = {column.header: dict(zip(TASKS, column.cells, strict=True)) for column in table.columns}
        assert columns["frames"]["push_box"] == str(FRAMES)
        assert columns["contact"]["push_box"] == f"{FRAMES // 2}-{FRAMES - 1}"
        assert columns["robot"]["push_box"] == "sphere feet, L hands"
        assert columns["object"]["traverse_door"] == "door: articulated, fixed base, 3 geoms, 20 kg"
        assert columns["sources"]["lift_box"] == "shipped, motion_root"

    COMMAND = (sys.executable, str(ROOT / "scripts" / "tasks.py"))

    @pytest.mark.slow
    def test_script(self):
        result = subprocess.run([*self.COMMAND, "check", "lift_box", "frames=0"], capture_output=True, text=True)
        assert result.returncode == 0, result.stderr
        assert "1/1 lift_box" in result.stdout
        assert "labels" not in result.stdout
        assert "specs" not in result.stdout

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["chekc"], "no command 'chekc'"),
            (["gallery", "lift_bax"], "no 'lift_bax'"),
            (["check", "jobs=0"], "jobs: expected at least 1"),
            (["check", "job=1"], "unknown option 'job'"),
        ],
    )
    def test_script_says_what_it_does_not_know(self, arguments, message, capsys):
        assert runpy.run_path(self.COMMAND[1])["main"](arguments) == 2
        assert message in capsys.readouterr().err


class TestPublicMotions:
    @pytest.mark.parametrize("name", sorted(PUBLIC_DISTANCES))
    def test_end_effectors_are_where_they_were_measured(self, name, public_motions):
        own_wrists = ("robot.unactuated=reference", "robot.default_pose={}")
        contacts = measure_contacts(load_config(f"task={name}", f"motion_root={public_motions}", *own_wrists))
        mean = np.concatenate([contact.distance for contact in contacts]).mean()
        assert mean == pytest.approx(PUBLIC_DISTANCES[name], abs=0.01)


def test_picture_is_taken_at_mid_contact(motions, tmp_path):
    _, task = built("move_stool", motions)
    assert picture_frame(task) == (FRAMES // 2 + FRAMES - 1) // 2
    assert picture_frame(built("walk", motions)[1]) == (FRAMES - 1) // 2
    try:
        path = render_reference(task, tmp_path / "stool.jpg", (120, 160))
    except RuntimeError as error:
        pytest.skip(str(error))
    image = imageio.imread(path)
    assert image.shape == (120, 160, 3)
    assert image.std() > 10


class TestFifteenth:
    """The examples of docs/tasks.md and docs/tutorial.md, as they stand there, with a mesh and a motion."""

    def config(self, tmp_path: Path, page: str = "tasks.md", name: str = "carry_vase") -> DictConfig:
        text = (ROOT / "docs" / page).read_text(encoding="utf-8")
        block = next(block for block in text.split("# @package")[1:] if f"name: {name}\n" in block).split("```")[0]
        mesh = tmp_path / "mesh.obj"
        trimesh.creation.capsule(height=20.0, radius=8.0).export(mesh)
        block, count = re.subn(r"/path/to/\w+\.obj", str(mesh), block)
        assert count == 1
        (tmp_path / "task").mkdir()
        (tmp_path / "task" / f"{name}.yaml").write_text(f"# @package{block}")
        cfg = load_config(f"hydra.searchpath=[file://{tmp_path}]", f"task={name}", f"motion_root={tmp_path}")
        save_motion(standing_motion(cfg), tmp_path / name)
        return cfg

    @pytest.mark.parametrize(("page", "name"), [("tasks.md", "carry_vase"), ("tutorial.md", "press_crate")])
    def test_steps(self, tmp_path, page, name):
        cfg = self.config(tmp_path, page, name)
        env = make_env(cfg, 2)
        assert env.rollout(3, break_when_any_done=False)["next", "policy"].isfinite().all()
        geoms = env.base_env.scene.object_geoms
        assert (env.base_env.scene.model.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_MESH).all()

    def test_its_mesh_cannot_be_scaled_per_world(self, tmp_path):
        cfg = self.config(tmp_path)
        cfg.randomization.object_scale = OmegaConf.create({"_target_": "hdmi.transforms.ObjectScale", "scale": [1, 2]})
        with pytest.raises(ConfigError, match=r"randomization\.object_scale.*mesh"):
            make_env(cfg, 2)
