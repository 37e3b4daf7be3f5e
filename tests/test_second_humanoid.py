"""Another humanoid than the G1 trains from an MJCF file and config nodes alone."""

from __future__ import annotations

import csv
import json
import math
import re
import warnings
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from hdmi.assembly import make_env, make_task, make_transforms, scene_parts
from hdmi.assets import Effector, Robot, RobotConfig, SimConfig, build_scene, g1, g1_robot, mjcf_robot
from hdmi.config import CONF, ConfigError
from hdmi.learning import Trainer
from hdmi.motion import MotionError, forward_kinematics, load_motion, make_playback, make_reference
from hdmi.motion.dynamics import inverse_dynamics, reference_torque
from hdmi.transforms import FeedForwardTarget
from hdmi.workshop.annotate import annotate_motion
from hdmi.workshop.validate import validate_motion

FPS, T = 50.0, 40
LEG = ("hip_{0}", "thigh_{0}", "shank_{0}", "foot_{0}")
ARM = ("upperarm_{0}", "forearm_{0}")
BODIES = ("hips", *(b.format("l") for b in LEG), *(b.format("r") for b in LEG), "chest", *(b.format("l") for b in ARM),
          *(b.format("r") for b in ARM))  # fmt: skip
JOINTS = tuple(f"{body}_turn" for body in BODIES[1:])  # 13, each of the body that it moves
DRIVEN = 11  # all but the elbows
FEET = ("foot_l", "foot_r")
SOLE = 0.04  # radius of the one sphere under each foot, m
STANDING = 0.62  # height of the hips in the file's keyframe, m
KNEE, HIP = 0.5, -0.25  # of the keyframe, rad


def _leg(side: str, y: float) -> str:
    return f"""
    <body name="hip_{side}" pos="0 {y} -0.05">
      <joint name="hip_{side}_turn" class="leg" axis="1 0 0" range="-30 30"/>
      <geom type="sphere" size="0.04" mass="0.5"/>
      <body name="thigh_{side}">
        <joint name="thigh_{side}_turn" class="leg" axis="0 1 0" range="-90 60"/>
        <geom type="capsule" size="0.04" fromto="0 0 0 0 0 -0.25" mass="1.5"/>
        <body name="shank_{side}" pos="0 0 -0.25">
          <joint name="shank_{side}_turn" class="leg" axis="0 1 0" range="-5 120"/>
          <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.25" mass="1"/>
          <body name="foot_{side}" pos="0 0 -0.25">
            <joint name="foot_{side}_turn" class="leg" axis="0 1 0" range="-45 45"/>
            <geom type="sphere" size="{SOLE}" pos="0.02 0 -0.02" mass="0.3"/>
          </body>
        </body>
      </body>
    </body>"""


def _arm(side: str, y: float) -> str:
    return f"""
      <body name="upperarm_{side}" pos="0 {y} 0.2">
        <joint name="upperarm_{side}_turn" class="arm" axis="0 1 0" range="-120 120"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.2" mass="0.6"/>
        <body name="forearm_{side}" pos="0 0 -0.2">
          <joint name="forearm_{side}_turn" class="arm" axis="0 1 0" range="-120 10"/>
          <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.18" mass="0.4"/>
        </body>
      </body>"""


def _mjcf() -> str:
    """13 joints, legs with position servos, arms and waist with motors; degrees, defaults, a floor and a lamp."""
    servos = "".join(
        f'<position name="servo_{joint}" joint="{joint}" kp="150" kv="4" forcerange="-80 80"/>'
        for joint in JOINTS if "arm" not in joint and "chest" not in joint
    )  # fmt: skip
    motors = "".join(
        f'<motor name="motor_{joint}" joint="{joint}" gear="30" ctrlrange="-1 1"/>'
        for joint in JOINTS if "arm" in joint or "chest" in joint
    )  # fmt: skip
    legs = [0.0, HIP, KNEE, HIP]
    pose = " ".join(map(str, [0, 0, STANDING, 1, 0, 0, 0, *legs, *legs, 0, 0.1, -0.4, 0.1, -0.4]))
    return f"""
<mujoco model="lad">
  <compiler angle="degree"/>
  <default>
    <default class="leg"><joint armature="0.02" damping="1"/></default>
    <default class="arm"><joint armature="0.005"/></default>
  </default>
  <worldbody>
    <light pos="0 0 3"/>
    <geom name="floor" type="plane" size="5 5 0.1"/>
    <body name="hips" pos="0 0 0.7">
      <freejoint name="floating"/>
      <geom type="box" size="0.06 0.09 0.05" mass="3"/>
      {_leg("l", 0.08)}{_leg("r", -0.08)}
      <body name="chest" pos="0 0 0.1">
        <joint name="chest_turn" class="arm" axis="0 0 1" range="-60 60"/>
        <geom type="box" size="0.06 0.1 0.12" pos="0 0 0.1" mass="4"/>
        {_arm("l", 0.14)}{_arm("r", -0.14)}
      </body>
    </body>
  </worldbody>
  <contact><exclude body1="hips" body2="thigh_l"/><exclude body1="hips" body2="thigh_r"/></contact>
  <actuator>{motors}{servos}</actuator>
  <sensor><jointpos joint="chest_turn"/></sensor>
  <keyframe><key name="stand" qpos="{pose}"/></keyframe>
</mujoco>"""


MASS = 3 + 4 + 2 * (0.5 + 1.5 + 1 + 0.3) + 2 * (0.6 + 0.4)


@pytest.fixture(scope="module")
def lad(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The humanoid's file."""
    path = tmp_path_factory.mktemp("lad") / "lad.xml"
    path.write_text(_mjcf(), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def robot(lad: Path) -> Robot:
    return mjcf_robot(str(lad), feet=FEET)


def write_motion(folder: Path, lad: Path, box: bool = False) -> None:
    """0.8 s of knee bends, turning slowly, by the kinematics of the file; with `box`, a box floats before the chest."""
    model = mujoco.MjModel.from_xml_path(str(lad))
    data = mujoco.MjData(model)
    pos, quat, angles = [], [], []
    for t in np.arange(T) / FPS:
        data.qpos[:] = model.key_qpos[0]
        bend = 0.1 * (1 - math.cos(8 * t))
        data.qpos[2] -= 0.1 * bend
        data.qpos[3:7] = [math.cos(0.1 * t), 0, 0, math.sin(0.1 * t)]
        for j, joint in enumerate(JOINTS):
            data.qpos[7 + j] += {"thigh": -bend, "shank": 2 * bend, "foot_": -bend}.get(joint[:5], 0.0)
        mujoco.mj_kinematics(model, data)
        own = [model.body(name).id for name in BODIES]
        hold = data.body("chest").xmat.reshape(3, 3) @ [0.25, 0, 0] + data.body("chest").xpos
        pos.append(np.concatenate([data.xpos[own], hold[None]]))
        quat.append(np.concatenate([data.xquat[own], data.xquat[[model.body("chest").id]]]))
        angles.append(data.qpos[7:].copy())
    count = len(BODIES) + box
    arrays: dict[str, Any] = {"body_pos_w": np.stack(pos)[:, :count], "body_quat_w": np.stack(quat)[:, :count]}
    arrays["joint_pos"] = np.stack(angles)
    if box:
        arrays["object_contact"] = np.repeat(np.arange(T)[:, None] >= 5, 2, axis=1)
    folder.mkdir(parents=True)
    np.savez(folder / "motion.npz", **{k: v if v.dtype == bool else v.astype(np.float32) for k, v in arrays.items()})
    names = [*BODIES, *(["parcel"] if box else [])]
    meta = {"body_names": names, "joint_names": list(JOINTS), "fps": FPS}
    (folder / "meta.json").write_text(json.dumps(meta), encoding="utf-8")


NODES = {
    "robot/lad": """
model: {_target_: hdmi.assets.mjcf_robot, path: PATH, feet: [foot_l, foot_r]}
stiffness: {"shank_._turn": 200}
""",
    "reference_set/lad": """
bodies: [hips, chest, "(thigh|shank|foot)_.", "forearm_."]
joints: ["(?!forearm).*"]
""",
    "action/lad": """
delay: {_target_: hdmi.transforms.ActionDelay, substeps: [2, 6]}
smoothing: {_target_: hdmi.transforms.ActionSmoothing}
target: {_target_: hdmi.transforms.ResidualAction}
joint_position:
  _target_: hdmi.transforms.JointPositionAction
  scale: {"(hip|thigh|shank|foot)_._turn": 0.4, chest_turn: 0.3, "upperarm_._turn": 0.4}
history: {_target_: hdmi.transforms.ActionHistory, steps: 3}
""",
    "randomization/lad": """
defaults: [hdmi, _self_]
robot_com: {bodies: [hips, chest]}
robot_friction: {bodies: ["foot_.", "forearm_."]}
""",
    "task/bends": """
# @package _global_
defaults:
  - kind: robot
  - override /robot: lad
  - override /reference_set: lad
  - override /action: lad
  - override /randomization: lad
  - _self_
task:
  name: bends
  motion: bends
""",
    "task/parcel": """
# @package _global_
defaults:
  - kind: rigid
  - override /robot: lad
  - override /reference_set: lad
  - override /action: lad
  - override /randomization: lad
  - _self_
task:
  name: parcel
  motion: parcel
  episode_steps: 300
  object: {_target_: hdmi.assets.ObjectConfig, name: parcel, geoms: [{box: [0.06, 0.1, 0.05]}], mass: 0.3}
  effectors:
    - {_target_: hdmi.assets.Effector, body: forearm_l, point: [0, 0, -0.18], target: [0, 0.1, 0]}
    - {_target_: hdmi.assets.Effector, body: forearm_r, point: [0, 0, -0.18], target: [0, -0.1, 0]}
  randomization:
    object_mass: [0.2, 0.4]
""",
}
TRACKED_BODIES = 2 + 6 + 2
SMALL = [
    "num_envs=4", "algo.frames_per_env=8", "algo.minibatches=2", "algo.epochs=1", "total_frames=32",
    "algo.actor_hidden=[32]", "algo.critic_hidden=[32]", "algo.bf16=false", "logger=csv", "video=false",
    "num_threads=1",
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, lad: Path) -> Path:
    """What a user writes: config nodes and two motions."""
    folder = tmp_path_factory.mktemp("nodes")
    for name, text in NODES.items():
        path = folder / f"{name}.yaml"
        path.parent.mkdir(exist_ok=True)
        path.write_text(text.replace("PATH", json.dumps(str(lad))).lstrip(), encoding="utf-8")
    write_motion(folder / "motions" / "bends", lad)
    write_motion(folder / "motions" / "parcel", lad, box=True)
    return folder


@pytest.fixture
def config(folder: Path):
    def make(task: str, *overrides: str) -> DictConfig:
        own = [f"task={task}", f"motion_root={folder / 'motions'}", f"hydra.searchpath=['file://{folder}']"]
        with initialize_config_dir(str(CONF), version_base="1.3"):
            return compose("config", overrides=[*own, *SMALL, *overrides])

    return make


class TestRecord:
    def test_names_are_the_files_in_its_order(self, robot: Robot) -> None:
        assert (robot.body_names, robot.joint_names, robot.joint_bodies) == (BODIES, JOINTS, BODIES[1:])
        assert (robot.root, robot.name, robot.foot_bodies, robot.hands) == ("hips", "lad.xml", FEET, ())
        assert robot.body_parents[:3] == ("world", "hips", "hip_l")

    def test_figures_by_hand(self, robot: Robot) -> None:
        assert robot.total_mass == pytest.approx(MASS)
        of = {name: i for i, name in enumerate(JOINTS)}
        knee, elbow = of["shank_l_turn"], of["forearm_r_turn"]
        np.testing.assert_allclose(robot.joint_ranges[knee], np.radians([-5, 120]))
        # a position servo: kp, and kv on top of the joint's own damping
        assert (robot.stiffness[knee], robot.damping[knee]) == pytest.approx((150, 5))
        assert robot.effort_limits[knee] == 80
        # a motor: 10 Hz with damping ratio 2 from an armature of 0.005; a gear of 30 and controls to 1
        assert robot.stiffness[elbow] == pytest.approx(0.005 * (20 * math.pi) ** 2)
        assert robot.damping[elbow] == pytest.approx(4 * 0.005 * 20 * math.pi)
        assert (robot.effort_limits[elbow], robot.armature[elbow]) == (30, 0.005)
        assert set(robot.velocity_limits) == {math.inf}

    def test_stands_as_the_keyframe(self, robot: Robot) -> None:
        pose = dict(zip(JOINTS, robot.default_joint_pos, strict=True))
        assert (pose["shank_r_turn"], pose["thigh_l_turn"], pose["chest_turn"]) == (KNEE, HIP, 0)
        assert robot.root_height == STANDING

    def test_soles_are_the_spheres_of_the_feet(self, robot: Robot) -> None:
        assert [foot.radius for foot in robot.feet] == [SOLE, SOLE]
        np.testing.assert_allclose(robot.feet[1].points, [[0.02, 0, -0.02]])

    def test_can_be_a_key(self, lad: Path, robot: Robot) -> None:
        assert hash(mjcf_robot(str(lad), feet=FEET)) == hash(robot)
        assert mjcf_robot(str(lad), feet=FEET) == robot != g1_robot()

    def test_the_g1s_is_its_table(self) -> None:
        robot = g1_robot()
        assert (robot.joint_names, robot.body_names, robot.foot_bodies) == (g1.JOINT_NAMES, g1.BODY_NAMES, g1.FEET)
        assert (robot.joint_ranges, robot.effort_limits) == (g1.JOINT_RANGES, g1.EFFORT_LIMITS)
        assert (robot.total_mass, robot.root, robot.root_height) == (g1.TOTAL_MASS, "pelvis", g1.ROOT_HEIGHT)

    def test_what_joints_move(self, robot: Robot) -> None:
        assert robot.bodies_after(["shank_l_turn", "forearm_r_turn"]) == {"shank_l", "foot_l", "forearm_r"}


class TestFaultsOfAFile:
    @pytest.mark.parametrize(
        ("old", "new", "message"),
        [
            ("<freejoint", "<joint", "one body with a free joint expected, got []"),
            ('<body name="chest"', "<body", "a body of 'hips' has no name"),
            ('class="arm" axis="0 0 1" range="-60 60"', 'class="arm"', "joint 'chest_turn' has no range"),
            ('class="arm" axis="0 0 1"', 'class="arm" type="slide"', "joint 'chest_turn': only hinges can be driven"),
            (' gear="30" ctrlrange="-1 1"', "", "joint 'chest_turn' has no effort limit"),
            ('<joint armature="0.005"/>', "", "joint 'chest_turn': a position servo or an armature expected"),
            ("<worldbody>", "<worldbody", "XML"),
        ],
    )
    def test_is_one_line_that_names_it(self, old: str, new: str, message: str, tmp_path: Path) -> None:
        path = tmp_path / "bad.xml"
        assert old in _mjcf()
        path.write_text(_mjcf().replace(old, new), encoding="utf-8")
        with pytest.raises(ValueError, match=rf"^{re.escape(str(path))}: .*{re.escape(message)}") as caught:
            mjcf_robot(str(path), feet=FEET)
        assert "\n" not in str(caught.value)

    def test_no_file(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match=r"none\.xml: no such file"):
            mjcf_robot(str(tmp_path / "none.xml"), feet=FEET)

    def test_unknown_foot_and_keyframe(self, lad: Path) -> None:
        with pytest.raises(ValueError, match=r"feet: there is no body 'toe'; there is hips, hip_l"):
            mjcf_robot(str(lad), feet=["toe"])
        with pytest.raises(ValueError, match=r"there is no keyframe 'run'; there is \['stand'\]"):
            mjcf_robot(str(lad), feet=FEET, keyframe="run")

    def test_a_config_names_the_node(self, config) -> None:
        with pytest.raises(ConfigError, match=r"robot\.model \(mjcf_robot\): .*none\.xml: no such file"):
            scene_parts(config("bends", "robot.model.path=none.xml"))
        cfg = config("bends")
        cfg.robot.model = {"_target_": "hdmi.assets.SimConfig"}
        with pytest.raises(ConfigError, match=r"robot\.model: a robot expected.*SimConfig"):
            scene_parts(cfg)


class TestScene:
    def test_has_the_robot_and_nothing_else_of_the_file(self, lad: Path, robot: Robot) -> None:
        scene = build_scene(RobotConfig(robot), SimConfig())
        model, own = scene.model, mujoco.MjModel.from_xml_path(str(lad))
        assert (model.nbody, model.nlight, model.nu, model.nkey, model.nexclude) == (1 + 14, 1, 13, 0, 2)
        assert [model.actuator(i).name for i in range(13)] == list(JOINTS)
        assert [model.body(i).name for i in scene.body_ids] == list(BODIES)
        np.testing.assert_allclose(model.body_mass, own.body_mass)
        np.testing.assert_allclose(model.body_inertia, own.body_inertia, rtol=1e-9)
        np.testing.assert_allclose(model.jnt_range, own.jnt_range)
        np.testing.assert_allclose(scene.default_qpos, own.key_qpos[0])
        assert scene.foot_sensors.shape == (2, 3)

    def test_builds_without_a_warning_or_a_log_file(
        self, robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
    ) -> None:
        monkeypatch.chdir(tmp_path)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            build_scene(RobotConfig(robot), SimConfig())
        assert not list(tmp_path.iterdir())
        assert capfd.readouterr() == ("", "")

    def test_record_has_what_the_config_varies(self, robot: Robot) -> None:
        config = RobotConfig(robot, stiffness={"shank_._turn": 200.0}, default_pose={"chest_turn": 0.2})
        scene = build_scene(config, SimConfig())
        chest, knee = JOINTS.index("chest_turn"), JOINTS.index("shank_l_turn")
        assert (scene.robot.stiffness[knee], scene.robot.default_joint_pos[chest]) == (200, 0.2)
        assert scene.model.actuator_gainprm[knee, 0] == 200
        assert scene.default_qpos[scene.joint_qpos[chest]] == 0.2
        assert scene.robot.effort_limits == robot.effort_limits

    def test_box_feet_keep_the_mass(self, robot: Robot) -> None:
        model = build_scene(RobotConfig(robot, feet="box"), SimConfig()).model
        box = model.geom("foot_l_box_collision")
        np.testing.assert_allclose(box.pos - box.size, [0.02 - SOLE, -SOLE, -0.02 - SOLE])
        assert model.body_mass.sum() == pytest.approx(MASS)
        feet = [i for i in range(model.ngeom) if model.body(model.geom_bodyid[i]).name in FEET]
        assert model.geom_contype[feet].sum() == 2

    def test_stands_and_falls_on_the_floor(self, robot: Robot) -> None:
        scene = build_scene(RobotConfig(robot), SimConfig())
        data = mujoco.MjData(scene.model)
        data.qpos[:] = scene.default_qpos
        data.ctrl[:] = robot.default_joint_pos
        for _ in range(100):
            mujoco.mj_step(scene.model, data)
        assert np.linalg.norm(data.sensordata[scene.foot_sensors].sum(0)) > 0.5 * 9.81 * MASS

    @pytest.mark.parametrize(
        ("varied", "message"),
        [
            ({"effector": "hand"}, r"robot\.effector: lad\.xml has no hands to choose 'hand' for; use 'capsule'"),
            ({"mesh_dir": "meshes"}, r"robot\.mesh_dir: .*lad\.xml says what the robot looks like"),
            ({"damping": {"tail": 1.0}}, r"robot\.damping: 'tail' matches none"),
        ],
    )
    def test_what_the_file_has_not(self, varied: dict[str, Any], message: str, robot: Robot) -> None:
        with pytest.raises(ValueError, match=message):
            build_scene(RobotConfig(robot, **varied), SimConfig())

    def test_box_feet_need_spheres(self, tmp_path: Path) -> None:
        sphere = f'<geom type="sphere" size="{SOLE}"'
        path = tmp_path / "boots.xml"
        path.write_text(_mjcf().replace(sphere, '<geom type="box" size="0.1 0.04 0.02"'), encoding="utf-8")
        robot = mjcf_robot(str(path), feet=FEET)
        assert robot.feet[0].points == ()
        with pytest.raises(ValueError, match=r"robot\.feet: a box spans spheres, and 'foot_l' of boots\.xml has none"):
            build_scene(RobotConfig(robot, feet="box"), SimConfig())

    def test_an_effector_is_of_this_robot(self, robot: Robot) -> None:
        Effector("forearm_l").check("task.effectors[0]", robot)
        with pytest.raises(ValueError, match=r"robot has no body 'pelvis'; it has hips, hip_l"):
            Effector("pelvis").check("task.effectors[0]", robot)


class TestMotion:
    def test_forward_kinematics_are_the_files(self, folder: Path, robot: Robot) -> None:
        file = np.load(folder / "motions" / "bends" / "motion.npz")
        pos, quat = forward_kinematics(robot, file["body_pos_w"][:, 0], file["body_quat_w"][:, 0], file["joint_pos"])
        np.testing.assert_allclose(pos, file["body_pos_w"], atol=1e-5)
        np.testing.assert_allclose(np.abs((quat * file["body_quat_w"]).sum(-1)), 1, atol=1e-5)

    def test_reference_is_completed_for_this_robot(self, folder: Path, robot: Robot) -> None:
        held = RobotConfig(robot, default_pose={"chest_turn": 0.3}, held=["chest_turn"])
        reference = make_reference(folder / "motions" / "bends", control_dt=0.02, robot=held)
        assert reference.joint_pos.shape == (T, 13)
        assert reference.body_pos.shape == (T, 14, 3)
        assert (reference.joint_pos[:, JOINTS.index("chest_turn")] == 0.3).all()

    def test_torques_carry_this_robot(self, folder: Path, robot: Robot) -> None:
        playback = make_playback(load_motion(folder / "motions" / "bends"), robot=RobotConfig(robot))
        dynamics = inverse_dynamics(playback)
        assert dynamics.torque.shape == (T, 13)
        assert dynamics.missing_force.max() < 0.05  # body weights; it stands all along
        knees = [JOINTS.index(f"shank_{side}_turn") for side in "lr"]
        assert (dynamics.torque[:, knees] < -1).all()  # N m: they keep it from bending
        smooth = reference_torque(playback.scene, playback.reference)
        assert np.abs(smooth - dynamics.torque).max() < 5

    def test_feedforward_is_for_its_servos(self, config) -> None:
        cfg = config("bends", "+lever=feedforward", "reference.target.lead=0")
        task = make_task(cfg)
        (ahead,) = (t for _, t in make_transforms(cfg, task) if isinstance(t, FeedForwardTarget))
        r, robot = task.reference, task.scene.robot
        kp, kd, limit = (torch.tensor(v) for v in (robot.stiffness, robot.damping, robot.effort_limits))
        expected = r.joint_pos + (task.joint_torque(0.5).clamp(-0.8 * limit, 0.8 * limit) + kd * r.joint_vel) / kp
        torch.testing.assert_close(ahead.targets, expected)

    def test_feedforward_leads_by_seconds_of_its_control_step(self, config) -> None:
        cfg = config("bends", "+lever=feedforward")
        assert cfg.reference.target.lead == 0.03
        led, now = [], []
        for lead, found in ((0.03, led), (0.0, now)):
            cfg.reference.target.lead, cfg.sim.decimation = lead, 6  # 0.03 s: one frame
            task = make_task(cfg)
            found += [t.targets for _, t in make_transforms(cfg, task) if isinstance(t, FeedForwardTarget)]
        torch.testing.assert_close(led[0][:-1], now[0][1:])

    def test_the_g1_does_not_know_it(self, folder: Path) -> None:
        with pytest.raises(MotionError, match=r"joint_names: \['hip_l_turn'"):
            make_reference(folder / "motions" / "bends", control_dt=0.02)

    def test_is_annotated_but_not_judged(self, folder: Path, config) -> None:
        motion, parts = load_motion(folder / "motions" / "parcel"), scene_parts(config("parcel"))
        assert annotate_motion(motion, **parts).contact_points.shape == (T, 2, 3)
        with pytest.raises(ConfigError, match=r"robot\.model: .* limits of the G1, not of lad\.xml"):
            validate_motion(motion, **parts)


class TestTraining:
    def test_starts_at_the_references_first_frame(self, config) -> None:
        cfg = config("bends")
        cfg.reset.state.start, cfg.reset.state.noise = "first", {}
        task = make_task(cfg)
        env = make_env(cfg, 2, task)
        env.reset()
        data, scene, reference = env.base_env.backend.data, task.scene, task.reference
        qpos = data("qpos").float()
        torch.testing.assert_close(qpos[0, :3], reference.body_pos[0, 0])
        torch.testing.assert_close(qpos[0, 3:7], reference.body_quat[0, 0])
        torch.testing.assert_close(qpos[1, scene.joint_qpos], reference.joint_pos[0])
        torch.testing.assert_close(data("xpos")[0, scene.body_ids].float(), reference.body_pos[0], atol=1e-5, rtol=0)

    def test_widths_by_hand(self, config) -> None:
        env = make_env(config("bends"), 2)
        spec = env.full_observation_spec
        assert env.full_action_spec["action"].shape == (2, DRIVEN)
        # phase; joints and bodies of 5 future frames; angular velocity and gravity with 2 past ones each; joint
        # angles with 3, joint velocities, 3 actions, and the reference's root
        policy = 1 + 5 * (11 + 3 * TRACKED_BODIES) + 9 + 9 + 4 * 13 + 13 + 3 * DRIVEN + 9
        assert spec["policy"].shape == (2, policy)
        rollout = env.rollout(6)
        assert all(value.isfinite().all() for value in rollout["next"].values(True, True) if value.is_floating_point())

    @pytest.mark.parametrize("task", ["bends", "parcel"])
    def test_trains(self, task: str, config, tmp_path: Path) -> None:
        trainer = Trainer(config(task), tmp_path)
        before = [p.clone() for p in trainer.actor.parameters()]
        trainer.run()
        (row,) = csv.DictReader((tmp_path / "metrics.csv").open())
        for key in ("reward", "reward/feet_slip", "reward/feet_impact", "joint_error", "body_error", "kl"):
            assert math.isfinite(float(row[key])), key
        if task == "parcel":
            assert math.isfinite(float(row["reward/interaction"]))
            assert trainer.env.base_env.observation_spec["contact", "force"].shape == (4, 2, 3)
        moved = [not torch.equal(a, b) for a, b in zip(before, trainer.actor.parameters(), strict=True)]
        assert any(moved)
        assert OmegaConf.load(tmp_path / "config.yaml").robot.model._target_ == "hdmi.assets.mjcf_robot"
