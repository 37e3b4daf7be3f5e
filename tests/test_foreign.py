"""Networks of others: each term by hand, each layout that others write, what is checked, and our own policies again."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from mocks import command, load_config
from omegaconf import open_dict

from hdmi.deploy import rotations
from hdmi.deploy.description import PolicyError
from hdmi.deploy.format import DeploymentError

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from foreign_files import (  # noqa: E402
    FRAMES,
    JOINTS,
    linear,
    motion_arrays,
    save_network,
    spec_values,
    write_files,
    write_yaml,
)
from onnx import TensorProto, helper  # noqa: E402

from hdmi.deploy.foreign.check import check_terms, network_moments  # noqa: E402
from hdmi.deploy.foreign.kinematics import Kinematics  # noqa: E402
from hdmi.deploy.foreign.motion import read_motion  # noqa: E402
from hdmi.deploy.foreign.policy import ForeignPolicy  # noqa: E402
from hdmi.deploy.foreign.readers import read_foreign  # noqa: E402
from hdmi.deploy.foreign.schema import parse_spec, read_spec, write_spec  # noqa: E402
from hdmi.deploy.foreign.terms import ROTATIONS, TERMS, Moment, bind, sensors_of  # noqa: E402
from hdmi.deploy.policy import OutputError, Policy, SensorError  # noqa: E402
from hdmi.deploy.robots.mujoco import MujocoRobot, Options  # noqa: E402

ROOT = Path(__file__).parents[1]
HALF = 0.5**0.5
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])

# -- terms by hand --------------------------------------------------------------------------------------------
# The root is at (1, 2, 0.8), turned to the left, so that its x axis is the world's y; the object is 1 m ahead of it,
# turned by half a turn, a quarter turn from the root's. The motion is at frame 4: its root at (0.04, 0, 0.8).

VALUES: list[tuple[dict[str, Any], list[float]]] = [
    ({"term": "joint_pos"}, [0.1, 0.2]),
    ({"term": "joint_pos", "joints": ["knee"]}, [0.2]),
    ({"term": "joint_pos_rel"}, [0.1, -0.3]),
    ({"term": "joint_pos_rel", "default_pose": {"hip": 0.1}}, [0.0, 0.2]),
    ({"term": "joint_vel", "joints": ["knee", "hip"]}, [-1.0, 1.0]),
    ({"term": "root_ang_vel"}, [0.1, 0.2, 0.3]),
    ({"term": "root_lin_vel"}, [1.0, 0.0, 0.0]),
    ({"term": "gravity"}, [0.0, 0.0, -1.0]),
    ({"term": "gravity", "bodies": ["thigh"]}, [np.sin(0.1), 0.0, -np.cos(0.1)]),
    ({"term": "last_action"}, [0.5, -0.5]),
    ({"term": "phase"}, [4 / 19]),
    ({"term": "phase", "period": 1.6}, [0.05]),
    ({"term": "step", "steps": [0, 1, 100]}, [4, 5, 19]),
    ({"term": "constant", "value": [7.0, 8.0]}, [7.0, 8.0]),
    ({"term": "ref_joint_pos", "steps": [1, 100]}, [0.005, 0.010, 0.019, 0.038]),
    ({"term": "ref_joint_vel"}, [0.05, 0.1]),
    ({"term": "ref_joint_state"}, [0.004, 0.008, 0.05, 0.1]),
    ({"term": "ref_body_pos"}, [-2.0, 0.96, 0.0]),
    ({"term": "ref_body_pos", "axes": [1]}, [0.96]),
    ({"term": "ref_body_pos", "steps": [2], "frame": {"of": "reference", "ground": True}}, [0.02, 0.0, 0.8]),
    ({"term": "ref_body_pos", "frame": {"of": "world"}}, [0.04, 0.0, 0.8]),
    ({"term": "ref_body_pos", "frame": {"turn": "none"}}, [-0.96, -2.0, 0.0]),
    ({"term": "ref_body_pos", "max_norm": 1.0, "frame": {"of": "world", "body": "thigh"}}, [0.04, 0.0, 0.8]),
    ({"term": "ref_body_ori"}, [0, -1, 0, 1, 0, 0]),
    ({"term": "ref_body_ori", "rotation": "interleaved"}, [0, 1, -1, 0, 0, 0]),
    ({"term": "ref_body_ori", "rotation": "rows"}, [0, 1, 0, -1, 0, 0]),
    ({"term": "ref_body_ori", "rotation": "matrix"}, [0, 1, 0, -1, 0, 0, 0, 0, 1]),
    ({"term": "ref_body_ori", "rotation": "quat"}, [HALF, 0, 0, -HALF]),
    ({"term": "ref_body_ori", "rotation": "heading"}, [0, -1]),
    ({"term": "ref_body_ori", "rotation": "yaw"}, [-np.pi / 2]),
    ({"term": "ref_body_pose", "rotation": "yaw"}, [-2.0, 0.96, 0.0, -np.pi / 2]),
    ({"term": "ref_body_lin_vel"}, [0.0, -0.5, 0.0]),
    ({"term": "ref_body_ang_vel", "bodies": ["thigh"], "frame": {"of": "world"}}, [0.0, 0.05, 0.0]),
    ({"term": "body_pos", "bodies": ["thigh"]}, [0.0, 0.0, -0.1]),
    (
        {"term": "body_pos", "bodies": ["pelvis", "thigh"], "points": [[0.05, 0, 0], [0.05, 0, 0]]},
        [0.05, 0.0, 0.0, 0.05 * np.cos(0.1), 0.0, -0.1 - 0.05 * np.sin(0.1)],
    ),
    ({"term": "body_ori", "bodies": ["thigh"], "rotation": "quat"}, [np.cos(0.05), 0.0, np.sin(0.05), 0.0]),
    ({"term": "object_pos"}, [1.0, 0.0, 0.0]),
    ({"term": "object_pos", "axes": [0, 1], "frame": {"turn": "heading"}}, [1.0, 0.0]),
    ({"term": "object_pos", "max_norm": 0.25}, [0.25, 0.0, 0.0]),
    ({"term": "object_ori", "rotation": "heading"}, [0.0, 1.0]),
    ({"term": "object_pose", "rotation": "yaw"}, [1.0, 0.0, 0.0, np.pi / 2]),
    ({"term": "object_points", "points": [[0.1, 0.0, 0.0]]}, [1.0, 0.1, 0.0]),
    (
        {"term": "object_corners", "half_size": [0.1, 0.2, 0.3]},
        [0.8, 0.1, 0.3, 0.8, 0.1, -0.3, 1.2, 0.1, 0.3, 1.2, 0.1, -0.3,
         0.8, -0.1, 0.3, 0.8, -0.1, -0.3, 1.2, -0.1, 0.3, 1.2, -0.1, -0.3],
    ),
    ({"term": "object_joint_pos"}, [0.7]),
    ({"term": "ref_object_pos", "frame": {"of": "world"}}, [3.04, 0.0, 0.5]),
    ({"term": "ref_object_ori", "rotation": "quat", "frame": {"of": "reference"}}, [1.0, 0.0, 0.0, 0.0]),
    ({"term": "contact_points"}, [0.9, 0.0, 0.0]),
    ({"term": "contact", "steps": [0, 1]}, [0.0, 1.0]),
    ({"term": "contact", "steps": [1], "bodies": ["shin", "hand"]}, [0.0, 1.0]),
]  # fmt: skip


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the toy's scene and motion."""
    return write_files(tmp_path_factory.mktemp("toy"))


@pytest.fixture(scope="module")
def kinematics(toy: Path) -> Kinematics:
    return Kinematics(toy / "scene.xml", JOINTS)


def moment(kinematics: Kinematics) -> Moment:
    root, left, joints = np.array([1.0, 2.0, 0.8]), np.array([HALF, 0.0, 0.0, HALF]), np.array([0.1, 0.2])
    pos, quat = kinematics(root, left, joints)
    thing, behind = np.array([1.0, 3.0, 0.8]), np.array([0.0, 0.0, 0.0, 1.0])
    return Moment(
        step=np.array(4), joint_pos=joints, joint_vel=np.array([1.0, -1.0]), body_pos_w=pos, body_quat_w=quat,
        root_lin_vel_w=np.array([0.0, 1.0, 0.0]), root_ang_vel_b=np.array([0.1, 0.2, 0.3]),
        action=np.array([0.5, -0.5]), object_pos_w=thing, object_quat_w=behind, object_joint_pos=np.array([0.7]),
        link_pos_w=thing, link_quat_w=behind,
    )  # fmt: skip


def in_batch(now: Moment, count: int) -> Moment:
    """The same moment in several worlds."""
    tiled = {key: np.broadcast_to(value, (count, *value.shape)) for key, value in vars(now).items() if value.size}
    return Moment(**tiled)


@pytest.mark.parametrize(("values", "expected"), VALUES, ids=lambda value: str(value)[:60])
def test_terms_by_hand(values: dict[str, Any], expected: list[float], toy: Path, kinematics: Kinematics):
    spec = parse_spec(spec_values({"obs": [values]}), "toy.yaml")
    motion = read_motion(toy / "motion", spec, kinematics)
    term = bind(spec.inputs["obs"][0], spec, motion, kinematics.body_names, "toy.yaml")
    now = moment(kinematics)
    found = TERMS[term.spec.term].function(now, term)
    assert found.reshape(-1) == pytest.approx(expected, abs=1e-9)
    many = TERMS[term.spec.term].function(in_batch(now, 3), term).reshape(3, -1)
    assert many == pytest.approx(np.tile(expected, (3, 1)), abs=1e-9)


def test_every_term_and_rotation_is_among_them():
    assert {values["term"] for values, _ in VALUES} == set(TERMS)
    assert {values.get("rotation", "columns") for values, _ in VALUES} == set(ROTATIONS)


@pytest.mark.parametrize(
    ("values", "sensors"),
    [
        ({"term": "ref_body_pos", "frame": {"of": "reference"}}, set()),
        ({"term": "ref_body_pos"}, {"root_pos_w", "root_quat_w"}),
        ({"term": "ref_body_ori", "frame": {"body": "thigh"}}, {"root_quat_w", "joint_pos"}),
        ({"term": "body_pos", "bodies": ["shin"]}, {"root_quat_w", "joint_pos"}),
        ({"term": "body_pos", "frame": {"of": "world"}}, {"root_pos_w", "root_quat_w", "joint_pos"}),
        ({"term": "gravity", "bodies": ["pelvis"]}, {"root_quat_w"}),
        ({"term": "object_ori"}, {"root_quat_w", "object_quat_w"}),
        ({"term": "contact"}, set()),
    ],
)
def test_terms_ask_for_no_more_sensors_than_they_need(values: dict[str, Any], sensors: set[str]):
    spec = parse_spec(spec_values({"obs": [values]}), "toy.yaml")
    assert sensors_of(spec.inputs["obs"][0], "pelvis") == sensors


def test_a_link_turns_about_its_hinge(tmp_path: Path):
    scene = tmp_path / "scene.xml"
    door = """<body name="door" pos="0 0 1"><freejoint/><geom size="0.1"/><body name="leaf" pos="0.5 0 0">
      <joint name="hinge" axis="0 0 1" pos="-0.5 0 0"/><geom size="0.1"/></body></body></worldbody>"""
    from foreign_files import SCENE

    scene.write_text(SCENE.replace("</worldbody>", door), encoding="utf-8")
    here = Kinematics(scene, JOINTS)
    pos, quat = here.link("door", np.array([1.0, 0.0, 1.0]), IDENTITY, np.array([np.pi / 2]))
    assert pos == pytest.approx([1.0, 0.5, 1.0])
    assert quat == pytest.approx([HALF, 0.0, 0.0, HALF])
    assert here.link("box", pos, quat, None)[0] == pytest.approx(pos)


def test_rotation_vectors_and_matrices():
    vector = np.array([[0.3, -0.2, 0.5], [0.0, 0.0, 0.0], [0.0, 3.0, 0.0]])
    quat = rotations.quat_from_rotation_vector(vector)
    assert rotations.rotation_vector(quat) == pytest.approx(vector)
    assert rotations.rotation_vector(-quat) == pytest.approx(vector)
    turned = np.stack([rotations.quat_apply(quat, np.tile(axis, (3, 1))) for axis in np.eye(3)], axis=-1)
    assert rotations.matrix_of(quat) == pytest.approx(turned)


# -- running a network ----------------------------------------------------------------------------------------


def sensors(**changes: Any) -> dict[str, np.ndarray]:
    found = {
        "joint_pos": [0.1, 0.2], "joint_vel": [1.0, -1.0], "root_quat_w": IDENTITY, "root_ang_vel_b": [0.1, 0.2, 0.3],
        "root_pos_w": [0.0, 0.0, 0.8], "object_pos_w": [3.0, 0.0, 0.5], "object_quat_w": IDENTITY,
    }  # fmt: skip
    return {name: np.asarray(value, dtype=float) for name, value in (found | changes).items()}


def make_policy(folder: Path, terms: list[dict[str, Any]], weight: np.ndarray, **changes: Any) -> ForeignPolicy:
    """A linear network of one input."""
    write_files(folder)
    linear(folder / "network.onnx", weight)
    return ForeignPolicy(write_yaml(folder / "policy.yaml", spec_values({"obs": terms}, **changes)))


def seen(policy: ForeignPolicy, *ticks: dict[str, np.ndarray]) -> list[np.ndarray]:
    """What the network was given in each tick."""
    given: list[np.ndarray] = []
    run = policy.stack.graph

    class Noting:
        def __getattr__(self, name: str) -> Any:
            return getattr(run, name)

        def __call__(self, values: Mapping[str, np.ndarray], outputs: Any) -> Any:
            given.append(values["obs"][0])
            return run(values, outputs)

    policy.stack.graph = Noting()  # type: ignore[assignment]
    for tick in ticks:
        policy({name: value for name, value in tick.items() if name in policy.description.sensors})
    return given


def test_lags_fill_and_layout(tmp_path: Path):
    terms = [
        {"term": "joint_pos", "lags": [0, 2]},
        {"term": "joint_pos", "lags": [1, 0], "fill": "zero", "layout": "joint", "scale": 10.0},
        {"term": "root_ang_vel", "clip": 0.2, "scale": [1.0, 2.0, 3.0]},
    ]
    policy = make_policy(tmp_path, terms, np.zeros((11, 2)))
    ticks = [sensors(joint_pos=[k, -k]) for k in (1.0, 2.0, 3.0)]
    first, second, third = seen(policy, *ticks)
    assert first == pytest.approx([1, -1, 1, -1, 0, 10, 0, -10, 0.1, 0.4, 0.6])
    assert second == pytest.approx([2, -2, 1, -1, 10, 20, -10, -20, 0.1, 0.4, 0.6])
    assert third[:4] == pytest.approx([3, -3, 1, -1])
    policy.reset()
    assert seen(policy, ticks[2])[0][:8] == pytest.approx([3, -3, 3, -3, 0, 30, 0, -30])


def test_the_layout_of_pbhc(tmp_path: Path):
    """Sorted by name, scaled, the past of every term newest first, from zeros, and without the present."""
    current = [
        {"term": "last_action", "fill": "zero"}, {"term": "root_ang_vel", "scale": 0.25}, {"term": "joint_pos_rel"},
        {"term": "joint_vel", "scale": 0.05},
    ]  # fmt: skip
    rest = [{"term": "gravity"}, {"term": "phase"}]
    past = [term | {"lags": [1, 2], "fill": "zero"} for term in (*current, *rest)]
    policy = make_policy(tmp_path, [*current, *past, *rest], np.vstack([np.zeros((2, 2)), np.ones((37, 2))]))
    first, second = seen(policy, sensors(), sensors(joint_pos=[0.3, 0.7]))
    assert first[:9] == pytest.approx([0, 0, 0.025, 0.05, 0.075, 0.1, -0.3, 0.05, -0.05])
    assert first[9:35] == pytest.approx(np.zeros(26))
    assert first[35:] == pytest.approx([0, 0, -1, 0])
    action = first.sum()
    assert second[:2] == pytest.approx([action, action], abs=1e-6)
    assert second[6:7] == pytest.approx([0.2])
    assert second[9:13] == pytest.approx(np.zeros(4))  # of last_action, before the first
    assert second[13:19] == pytest.approx([0.025, 0.05, 0.075, 0, 0, 0])
    assert second[19:23] == pytest.approx([0.1, -0.3, 0, 0])


def test_targets_from_the_action(tmp_path: Path):
    weight = np.array([[1.0, 0.0], [0.0, 1.0]])
    policy = make_policy(tmp_path, [{"term": "joint_pos"}], weight)
    assert policy.sensors == ("joint_pos",)
    assert policy(sensors()) == pytest.approx([0.5 * 0.1, 0.5 + 0.25 * 0.2])
    one = {"base": "reference", "scale": {"kn.*": 2.0}, "joints": ["knee"], "clip": 0.05}
    policy = make_policy(tmp_path, [{"term": "joint_pos"}], weight[:, 1:], action=one)
    policy.reset(10)
    assert policy(sensors()) == pytest.approx([0.01, 0.02 + 2.0 * 0.05])
    assert policy.frame == 10
    assert policy.stack.last_action(np.array(False)) == pytest.approx([0.05])


def test_targets_from_the_motion_s_own(tmp_path: Path):
    action = {"base": "joint_target", "scale": 2.0}
    with pytest.raises(PolicyError, match="has no joint_target, which the policy's actions start from"):
        make_policy(tmp_path, [{"term": "joint_pos"}], np.eye(2), action=action)
    ahead = motion_arrays()["joint_pos"] + 0.3
    np.savez(tmp_path / "motion" / "motion.npz", **motion_arrays(), joint_target=ahead)
    policy = ForeignPolicy(tmp_path / "policy.yaml")
    policy.reset(10)
    assert policy(sensors()) == pytest.approx([0.01 + 0.3 + 2.0 * 0.1, 0.02 + 0.3 + 2.0 * 0.2])


def test_the_clock_ends_with_the_motion(tmp_path: Path):
    policy = make_policy(tmp_path, [{"term": "step"}], np.ones((1, 2)))
    steps = [value[0] for value in seen(policy, *[sensors()] * (FRAMES + 2))]
    assert steps == [*range(FRAMES), FRAMES - 1, FRAMES - 1]
    assert policy.finished
    with pytest.raises(ValueError, match=f"expected 0 to {FRAMES - 1}, got {FRAMES}"):
        policy.reset(FRAMES)


def test_the_root_s_velocity_is_that_of_its_position(tmp_path: Path):
    policy = make_policy(tmp_path, [{"term": "root_lin_vel"}], np.ones((3, 2)))
    first, second = seen(policy, sensors(), sensors(root_pos_w=[0.0, 0.02, 0.8]))
    assert first == pytest.approx([0.5, 0.0, 0.0])  # the motion's
    assert second == pytest.approx([0.0, 1.0, 0.0])


def test_wrong_sensors_and_results_are_named(tmp_path: Path):
    policy = make_policy(tmp_path, [{"term": "joint_pos"}], np.full((2, 2), 1e38))
    with pytest.raises(SensorError, match="joint_pos are missing"):
        policy({})
    with pytest.raises(SensorError, match="unknown sensors lidar"):
        policy(sensors(lidar=1.0))
    with pytest.raises(SensorError, match="joint_pos: is not finite"):
        policy(sensors(joint_pos=[np.nan, 0.0]))
    with pytest.raises(OutputError, match="not finite at frame 0"):
        policy(sensors(joint_pos=[9e37, 9e37]))
    assert policy.frame == -1


# -- layouts of others ----------------------------------------------------------------------------------------

METADATA = {
    "joint_names": "knee,hip", "joint_stiffness": "40.000,50.000", "joint_damping": "1.000,2.000",
    "default_joint_pos": "0.500,0.100", "command_names": "motion", "action_scale": "0.250,0.500",
    "observation_names": "command,motion_anchor_pos_b,motion_anchor_ori_b,base_lin_vel,base_ang_vel,joint_pos,"
    "joint_vel,actions",
    "anchor_body_name": "thigh", "body_names": "thigh,pelvis",
}  # fmt: skip


def read_and_run(folder: Path, network: Path, *ticks: dict[str, np.ndarray], **options: str) -> list[np.ndarray]:
    """The command writes the YAML, and the first input of each tick is returned."""
    arguments = [f"network={network}", f"out={folder / 'policy.yaml'}", *(f"{k}={v}" for k, v in options.items())]
    assert command("foreign").main(arguments) == 0
    return seen(ForeignPolicy(folder / "policy.yaml"), *ticks)


def test_metadata_of_mjlab(tmp_path: Path):
    write_files(tmp_path)
    history = {
        "observation_terms_history_length": "0,0,0,0,3,0,0,0", "observation_terms_scale": "1,1,1,1,1,2,1,1",
        "observation_terms_flatten_history_dim": "1,1,1,1,1.000,1,1,1",
        "observation_terms_clip": ",".join(["-inf;inf"] * 6 + ["-0.5;0.5", "-inf;inf"]),
    }  # fmt: skip
    weight = np.zeros((4 + 3 + 6 + 3 + 9 + 2 + 2 + 2, 2))
    network = linear(tmp_path / "flat.onnx", weight, metadata=METADATA | history)
    ticks = [sensors(root_ang_vel_b=[k, 0.0, 0.0]) for k in (1.0, 2.0)]
    first, second = read_and_run(tmp_path, network, *ticks, motion=str(tmp_path / "motion"))
    assert first[:4] == pytest.approx([0.0, 0.0, 0.1, 0.05])  # the network's order: knee, hip; then velocities
    thigh = np.array([0.0, 0.0, 0.7])
    turned = rotations.quat_apply_inverse(np.array([np.cos(0.1), 0.0, np.sin(0.1), 0.0]), thigh - thigh)
    assert first[4:7] == pytest.approx(turned, abs=1e-9)
    # the thigh's: the robot's hip is at 0.2 in this order of readings, the motion's at 0: r00 r01 r10 r11 r20 r21
    assert first[7:13] == pytest.approx([np.cos(0.2), 0, 0, 1, np.sin(0.2), 0])
    assert first[16:25] == pytest.approx([1, 0, 0] * 3)
    assert second[16:25] == pytest.approx([1, 0, 0, 1, 0, 0, 2, 0, 0])  # oldest first
    assert first[25:29] == pytest.approx([2 * (0.1 - 0.5), 2 * (0.2 - 0.1), 0.5, -0.5])
    about = ForeignPolicy(tmp_path / "policy.yaml").description
    assert about.joint_names == ("knee", "hip")
    assert about.stiffness.tolist() == [40.0, 50.0]
    assert about.effort_limits.tolist() == [40.0, 60.0]


def test_beyondmimic_gives_its_motion(tmp_path: Path):
    write_files(tmp_path)
    arrays = motion_arrays()
    tables = {
        "joint_pos": arrays["joint_pos"][:, ::-1], "joint_vel": np.tile([0.3, 0.4], (FRAMES, 1)),
        "body_pos_w": arrays["body_pos_w"][:, :1].repeat(2, 1), "body_quat_w": arrays["body_quat_w"],
    }  # fmt: skip
    tables["joint_vel"][-1] = 0.0
    width = 4 + 3 + 6 + 3 + 3 + 2 + 2 + 2
    constants = {f"{name}_table": value.astype(np.float32) for name, value in tables.items()}
    constants |= {"weight": np.zeros((width, 2), np.float32), "last": np.array(FRAMES - 1, np.int64)}
    constants |= {"axis": np.array([1], np.int64)}
    nodes = [
        helper.make_node("Cast", ["time_step"], ["whole"], to=TensorProto.INT64),
        helper.make_node("Squeeze", ["whole", "axis"], ["flat"]),
        helper.make_node("Min", ["flat", "last"], ["at"]),
        helper.make_node("MatMul", ["obs", "weight"], ["actions"]),
        *(helper.make_node("Gather", [f"{name}_table", "at"], [name], axis=0) for name in tables),
    ]
    inputs = {"obs": ([1, width], TensorProto.FLOAT), "time_step": ([1, 1], TensorProto.FLOAT)}
    outputs = {"actions": [1, 2], "joint_pos": [1, 2], "joint_vel": [1, 2]}
    outputs |= {"body_pos_w": [1, 2, 3], "body_quat_w": [1, 2, 4]}
    about = METADATA | {"anchor_body_name": "pelvis", "body_names": "pelvis,shin"}
    network = save_network(tmp_path / "beyond.onnx", nodes, inputs, outputs, constants, about)
    first, second = read_and_run(tmp_path, network, sensors(), sensors())
    assert first[:4] == pytest.approx([0.0, 0.0, 0.3, 0.4])
    assert second[:4] == pytest.approx([0.002, 0.001, 0.3, 0.4])
    policy = ForeignPolicy(tmp_path / "policy.yaml")
    assert policy.description.num_frames == FRAMES
    assert read_spec(tmp_path / "policy.yaml").motion == "network"
    assert policy.motion.joint_pos[:, 1] == pytest.approx(arrays["joint_pos"][:, 0], abs=1e-6)
    assert policy.motion.body_pos_w[3, 2] == pytest.approx([0.03, 0.0, 0.8])  # the shin, where the network has it


def test_yaml_and_json_of_the_authors(tmp_path: Path):
    write_files(tmp_path)
    observation = {
        "command": {
            "ref_body_pos_future_local": {
                "motion_path": "somewhere", "future_steps": [1, 2], "body_names": ["pelvis", "thigh"],
                "joint_names": JOINTS, "root_body_name": "pelvis",
            },
            "ref_motion_phase": {"motion_duration_second": 0.4, "future_steps": [1, 2]},
        },
        "policy": {
            "root_ang_vel_history": {"history_steps": [0], "noise_std": 0.05},
            "joint_pos_history": {"history_steps": [0, 2]},
            "prev_actions": {"steps": 3},
            "ref_contact_pos_b": {
                "object_name": "box", "contact_target_pos_offset": [[0.0, -0.15, 0.8]], "yaw_only": True,
            },
        },
    }  # fmt: skip
    about = {
        "observation": observation, "action_scale": {".*knee.*": 0.25, "absent.*": 1.0}, "isaac_joint_names": JOINTS,
        "policy_joint_names": ["knee"], "joint_kp": {".*": 50.0}, "joint_kd": {".*": 2.0},
        "default_joint_pos": {".*_elbow_joint": 0.8}, "use_residual_action": True,
    }  # fmt: skip
    write_yaml(tmp_path / "push.yaml", about)
    keys = {"in_keys": ["command", "policy", "is_init", "adapt_hx"], "out_keys": ["action", ["next", "adapt_hx"]]}
    (tmp_path / "push.json").write_text(json.dumps(keys), encoding="utf-8")
    nodes = [  # counts its ticks, and acts by the count
        helper.make_node("Add", ["hx", "one"], ["hx_out"]),
        helper.make_node("ReduceSum", ["command"], ["zero_command"], keepdims=1),
        helper.make_node("Mul", ["zero_command", "none"], ["nothing"]),
        helper.make_node("Add", ["hx_out", "nothing"], ["out"]),
        helper.make_node("Identity", ["policy"], ["unused"]),
        helper.make_node("Not", ["init"], ["unused_too"]),
    ]
    inputs = {"command": ([1, 13], TensorProto.FLOAT), "policy": ([1, 13], TensorProto.FLOAT)}
    inputs |= {"init": ([1], TensorProto.BOOL), "hx": ([1, 1], TensorProto.FLOAT)}
    constants = {"one": np.ones(1, np.float32), "none": np.zeros(1, np.float32)}
    save_network(tmp_path / "push.onnx", nodes, inputs, {"out": [1, 1], "hx_out": [1, 1]}, constants)
    options = {"motion": str(tmp_path / "motion"), "object": "box", "contact_bodies": "[hand]"}
    arguments = [f"network={tmp_path / 'push.yaml'}", f"out={tmp_path / 'policy.yaml'}"]
    assert command("foreign").main([*arguments, *(f"{k}={v}" for k, v in options.items())]) == 0
    policy = ForeignPolicy(tmp_path / "policy.yaml")
    targets = [policy(sensors()) for _ in range(3)]
    # the reference's present angle, and 0.25 of the count for the knee
    assert targets == [pytest.approx([0.001 * k, 0.002 * k + 0.25 * (k + 1)], abs=1e-6) for k in range(3)]
    now = policy.stack.observer(policy.in_motion(np.array([0])), np.array([True]))
    command_part, policy_part = now["command"], now["policy"]
    assert command_part[0][0, :6] == pytest.approx([0.01, 0.0, 0.8, 0.01, 0.0, 0.7])
    assert command_part[1] == pytest.approx(np.zeros((1, 1)))
    assert policy_part[3][0] == pytest.approx([3.0, -0.15, 0.5])  # (3, 0, 0.5) - (0, 0, 0.8) + (0, -0.15, 0.8)
    policy.reset()
    assert policy(sensors())[1] == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"observation_names": "base_lin_vle"}, "no 'base_lin_vle' (did you mean base_lin_vel?)"),
        ({"command_names": "twist"}, "'command_names': twist: expected a motion to follow"),
        ({"joint_damping": "1.0"}, "'joint_damping': 1 numbers for 2 joints"),
        ({"anchor_body_name": ""}, "lack 'anchor_body_name' or 'body_names', which motion_anchor_pos_b needs"),
        ({"observation_terms_clip": "-1;2" + ",-inf;inf" * 7}, "command: clipped to -1 to 2"),
        ({"observation_terms_scale": "1,1"}, "'observation_terms_scale': 2 entries for 8 terms"),
    ],
)
def test_metadata_without_an_equivalent_are_refused(changes: dict[str, str], text: str, tmp_path: Path):
    network = linear(tmp_path / "flat.onnx", np.zeros((4, 2)), metadata=METADATA | changes)
    with pytest.raises(PolicyError) as error:
        read_foreign(network)
    assert text in str(error.value)
    assert str(network) in str(error.value)


def test_a_file_without_metadata_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    network = linear(tmp_path / "bare.onnx", np.zeros((4, 2)))
    assert command("foreign").main([f"network={network}", f"out={tmp_path / 'x.yaml'}"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "its metadata lack joint_names" in said


# -- mistakes -------------------------------------------------------------------------------------------------

_TERMS = [{"term": "joint_pos"}]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"stifness": 1.0}, "policy.yaml: there is no 'stifness' (did you mean stiffness?)"),
        ({"joints": None}, "policy.yaml.joints: expected a list, got None"),
        ({"control_dt": "fast"}, "policy.yaml.control_dt: expected a number, got 'fast'"),
        ({"format": "hdmi-network/9"}, "this version reads 'hdmi-network/1'"),
        ({"inputs": {"obs": [{"term": "joint_poss"}]}}, "obs[0]: there is no 'joint_poss' (did you mean joint_pos?)"),
        ({"inputs": {"obs": [{"term": "phase", "joints": ["hip"]}]}}, "phase takes no joints; it takes clip, fill"),
        ({"inputs": {"obs": [{"term": "joint_pos", "joints": ["hipp"]}]}}, "there is no 'hipp' (did you mean hip?)"),
        ({"inputs": {"obs": [{"term": "body_pos", "bodies": ["head"]}]}}, "no 'head'; there is pelvis, thigh, shin"),
        ({"inputs": {"obs": [{"term": "constant"}]}}, "constant needs value"),
        (
            {"inputs": {"obs": [*_TERMS, {"term": "phase"}]}},
            "inputs.obs: the terms give 3 features (joint_pos 2, phase 1), and the network takes 2",
        ),
        ({"inputs": {"observation": _TERMS}}, "network.onnx: there is no 'observation'; there is obs"),
        ({"inputs": {"obs": [_TERMS[0] | {"scale": [1, 2, 3]}]}}, "inputs.obs[0].scale: 3 numbers for the 2 features"),
        ({"action": {"base": "default", "joints": ["hip"]}}, "1 joints, and the network's actions has 2 numbers"),
        ({"action": {"base": "defualt"}}, "action.base: there is no 'defualt' (did you mean default?)"),
        ({"joints": ["hip", "ankle"], "default_pose": 0.0}, "scene.xml: has no joint ankle; it has hip, knee"),
        ({"damping": {"elbow": 1.0}}, "damping: 'elbow' matches none of hip, knee"),
        ({"scene": "other.xml"}, "other.xml: there is no such file"),
        ({"network": "other.onnx"}, "other.onnx: there is no such file"),
        ({"motion": "other"}, "a motion is a folder with motion.npz and meta.json"),
        ({"motion": "network"}, "it has no joint_pos, joint_vel, body_pos_w, body_quat_w, time_step"),
        ({"object": "crate"}, "motion.npz: has no body 'crate', the object; it has pelvis, box"),
        ({"control_dt": 0.01}, "fps 50, and the policy has control steps of 0.01 s"),
        ({"tracked_bodies": ["head"]}, "tracked_bodies: there is no head"),
        (
            {"inputs": {"obs": [{"term": "object_joint_pos"}, {"term": "phase"}]}},
            "policy.yaml: object_joint_pos: depends on object_joint_pos, of an object",
        ),
    ],
)  # fmt: skip
def test_mistakes_are_one_line(changes: dict[str, Any], text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    write_files(tmp_path)
    linear(tmp_path / "network.onnx", np.zeros((2, 2)))
    path = write_yaml(tmp_path / "policy.yaml", spec_values({"obs": _TERMS}) | changes)
    assert command("deploy").main([f"policy={path}", "robot=mujoco"]) == 2
    said = capsys.readouterr().err
    assert text in said
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"joint_names": ["hip", "ankle", "wrist"]}, "joint_pos: expected shape [20, 3], got [20, 2]"),
        ({"joint_names": ["ankle", "wrist"]}, "has none of the policy's joints hip, knee"),
        ({"body_names": ["torso", "box"]}, "has no body 'pelvis', the scene's root; it has torso, box"),
        ({"body_quat_w": np.zeros((FRAMES, 2, 4))}, "body_quat_w: expected quaternions wxyz of length 1"),
        ({"object_contact": np.zeros((FRAMES, 3))}, "object_contact is of 3 bodies, contact_bodies are 1"),
        ({"joint_pos": np.full((FRAMES, 2), np.nan)}, "joint_pos: expected finite numbers"),
    ],
)
def test_motions_that_do_not_fit(changes: dict[str, Any], text: str, tmp_path: Path):
    write_files(tmp_path, **changes)
    linear(tmp_path / "network.onnx", np.zeros((2, 2)))
    path = write_yaml(tmp_path / "policy.yaml", spec_values({"obs": _TERMS}))
    with pytest.raises(PolicyError) as error:
        ForeignPolicy(path)
    assert text in str(error.value)


def test_yaml_is_read_without_making_objects(tmp_path: Path):
    path = tmp_path / "policy.yaml"
    path.write_text("!!python/object/apply:os.getcwd []", encoding="utf-8")
    with pytest.raises(PolicyError, match="is no YAML"):
        read_spec(path)


def test_what_is_written_reads_back(tmp_path: Path):
    values = spec_values({"obs": [{"term": "joint_pos", "lags": [0, 1]}]}, control_dt="2e-2")
    assert read_spec(write_spec(values, tmp_path / "policy.yaml")) == parse_spec(values, "values")
    assert read_spec(tmp_path / "policy.yaml").control_dt == 0.02


# -- the check ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("written", ["sub_div", "mul_add"])
def test_the_check_finds_a_swapped_term(written: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    terms = [{"term": "gravity"}, {"term": "object_pos"}, {"term": "joint_vel", "scale": 0.05}, {"term": "phase"}]
    mean, deviation = np.array([0, 0, -1, 3, 0, -0.3, 0, 0.005, 0.5]), np.full(9, 0.35)
    write_files(tmp_path)
    linear(tmp_path / "network.onnx", np.zeros((9, 2)), (mean, deviation), written)
    found = network_moments((tmp_path / "network.onnx").read_bytes())["obs"]
    assert found[0] == pytest.approx(mean, abs=1e-6)
    assert found[1] == pytest.approx(deviation, abs=1e-6)
    path = write_yaml(tmp_path / "policy.yaml", spec_values({"obs": terms}))
    checks = check_terms(ForeignPolicy(path))
    assert max(check.off.max() for check in checks if check.off is not None) < 1.0
    assert checks[3].mean == pytest.approx([0.5])
    assert command("foreign").main([f"policy={path}"]) == 0
    write_yaml(path, spec_values({"obs": [terms[1], terms[0], *terms[2:]]}))
    assert command("foreign").main([f"policy={path}"]) == 1
    assert "deviations off: object_pos, gravity" in capsys.readouterr().err


def test_a_network_without_normalization_is_not_judged(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    policy = make_policy(tmp_path, _TERMS, np.ones((2, 2)))
    assert network_moments(policy.stack.graph.content) == {}
    assert command("foreign").main([f"policy={policy.path}"]) == 0
    assert "no means and deviations" in capsys.readouterr().out


def test_the_documentation_has_every_key_and_term():
    from dataclasses import fields

    from hdmi.deploy.foreign.schema import Action, Frame, NetworkSpec, TermSpec

    text = (ROOT / "docs" / "foreign.md").read_text(encoding="utf-8")
    names = [item.name for part in (NetworkSpec, Action, TermSpec) for item in fields(part)]
    assert not [name for name in (*names, *TERMS, *ROTATIONS) if f"`{name}`" not in text]
    assert all(item.name in text for item in fields(Frame))


# -- the runner, without the trainer --------------------------------------------------------------------------

WITHOUT_TRAINER = """
import sys
for name in ("torch", "torchrl", "tensordict", "hydra", "omegaconf", "onnx", "scipy", "trimesh", "wandb", "matplotlib"):
    sys.modules[name] = None  # importing it fails
from hdmi.commands.deploy import main
sys.exit(main([f"policy={sys.argv[1]}", "robot=mujoco", "episodes=1", "log=" + sys.argv[2]]))
"""


def test_runs_and_replays_without_the_trainer(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    terms = [{"term": "joint_pos_rel", "lags": [0, 1]}, {"term": "object_pose"}]
    policy = make_policy(tmp_path, terms, np.full((13, 2), 0.01))
    log = str(tmp_path / "log.npz")
    call = [sys.executable, "-c", WITHOUT_TRAINER, str(policy.path), log]
    done = subprocess.run(call, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert f"1 episodes of {FRAMES - 1} steps" in done.stdout
    assert command("deploy").main([f"policy={policy.path}", f"replay={log}"]) == 0
    assert "targets differ by at most 0.00e+00 rad" in capsys.readouterr().out


# -- our own policies -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any, Any, Any]:
    """lift_box with wide untrained weights: folder of its description, config, task; graph, actor and two worlds."""
    from hdmi.assembly import make_env, make_task
    from hdmi.deploy.export import make_graph, trial_of
    from hdmi.deploy.foreign.own import write_own, write_task_files
    from hdmi.learning.networks import make_actor, network_of

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hdmi.assembly.start_tables", lambda *_: None)  # they take seconds
        cfg = load_config("task=lift_box", "+lever=feedforward")
        with open_dict(cfg):
            cfg.randomization = cfg.noise = None
            cfg.action.delay = cfg.action.smoothing = None
            cfg.reset.state = {"_target_": "hdmi.transforms.ReferenceStateInitialization", "start": 0}
        task = make_task(cfg)
        env = make_env(cfg, 2, task)
        torch.manual_seed(0)
        sizes = env.full_observation_spec["policy"].shape[-1], env.action_spec.shape[-1]
        actor = make_actor(*sizes, hidden=[32], activation="SiLU", init_noise=0.1, bf16=False)
        torch.nn.init.normal_(network_of(actor).mlp[-1].weight, std=0.3)
        norm = network_of(actor).norm
        norm.mean.normal_()
        norm.var.uniform_(0.5, 2.0)
        graph, task = make_graph(cfg, actor, task)
        folder = write_task_files(task, tmp_path_factory.mktemp("own"))
        write_own(graph, task, trial_of(cfg, task), folder)
    return folder, cfg, task, (graph, actor, env)


def test_our_own_description_gives_the_graph_s_targets(own: tuple[Path, Any, Any, Any]):
    folder, _, _, (graph, *_) = own
    policy = ForeignPolicy(folder / "policy.yaml")
    robot = MujocoRobot(policy.description, policy.scene, Options(joint_pos_noise=0.02, mocap_noise=0.01))
    state = {name: value for name, value in graph.inputs.items() if name.startswith("state.")}
    unmeasured = {name: value for name, value in graph.inputs.items() if name.startswith("unmeasured.")}
    worst, time = 0.0, 0.0
    with torch.no_grad():
        while time < 1.5:
            reading = robot.read().sensors
            target = policy({name: reading[name] for name in policy.sensors})
            given = {name: torch.tensor(reading[name], dtype=torch.float32) for name in graph.measured.sensors}
            given |= state | unmeasured
            expected, *left = graph(*(given[name] for name in graph.inputs))
            state = {n.replace("next.", "state.", 1): v for n, v in zip(graph.outputs[1:], left, strict=True)}
            worst = max(worst, float(np.abs(target - expected.numpy()).max()))
            robot.command(target, policy.description.stiffness, policy.description.damping)
            robot.wait(time := time + 0.02)
    assert policy.frame == 74
    assert worst < 1e-5


def test_our_own_terms_have_names(own: tuple[Path, Any, Any, Any]):
    from hdmi.deploy.foreign.own import own_terms

    _, _, task, (graph, *_) = own
    names = [term["term"] for term in own_terms(graph, task)]
    assert names == [
        "phase", "ref_joint_pos", "ref_body_pos", "root_ang_vel", "gravity", "joint_pos_rel", "joint_vel",
        "last_action", "ref_body_pose", "object_pose", "contact_points", "contact",
    ]  # fmt: skip
    renamed = dict(graph.stages)["observation.policy.gravity"]
    before = renamed.in_keys
    renamed.in_keys = [("robot", "other_quat")]
    try:
        with pytest.raises(DeploymentError, match=r"observation\.policy\.gravity: has no equivalent"):
            own_terms(graph, task)
    finally:
        renamed.in_keys = before


def test_the_trainer_s_worlds_get_the_same_targets(own: tuple[Path, Any, Any, Any]):
    """The description in its own environment, two worlds, beside the policy in the environment of its training."""
    from hdmi.assembly import make_env
    from hdmi.evaluation.foreign import ForeignActor, foreign_config
    from hdmi.learning.networks import network_of

    folder, cfg, task, (_, actor, env) = own
    policy = ForeignPolicy(folder / "policy.yaml")
    foreign_cfg = foreign_config(cfg, policy, task)
    envs = env, make_env(foreign_cfg, 2, task)
    runs = lambda td: td.set("action", network_of(actor)(td["policy"])[0]), ForeignActor(policy, task)
    states = [env.reset() for env in envs]
    with torch.no_grad():
        for _ in range(6):
            stepped = [env.step(run(td)) for env, run, td in zip(envs, runs, states, strict=True)]
            states = [env.step_mdp(td) for env, td in zip(envs, stepped, strict=True)]
            reached = [env.base_env._state(slice(None))["robot", "joint_target"] for env in envs]
            assert reached[1] == pytest.approx(reached[0], abs=1e-4)


def test_an_evaluation_needs_a_task(capsys: pytest.CaptureFixture[str]):
    assert command("evaluate").main(["policy=policy.yaml"]) == 2
    assert "give task=NAME, in whose environment" in capsys.readouterr().err
    assert command("evaluate").main(["policy=/nowhere/policy.yaml", "task=walk"]) == 2
    assert "PolicyError: /nowhere/policy.yaml: there is no such file" in capsys.readouterr().err


def test_a_policy_of_another_motion_is_refused(own: tuple[Path, Any, Any, Any], tmp_path: Path):
    from hdmi.config import ConfigError
    from hdmi.evaluation.foreign import foreign_config

    _, cfg, task, _ = own
    policy = make_policy(tmp_path, _TERMS, np.zeros((2, 2)))
    with pytest.raises(ConfigError, match="joints: the robot of task lift_box has no hip, knee"):
        foreign_config(cfg, policy, task)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lift_box", "walk", "open_foldchair_sit"])
def test_exported_policies_and_their_descriptions_agree(name: str, tmp_path: Path):
    from hdmi.deploy.export import export_graph

    export_graph(ROOT / "zoo" / name, tmp_path)
    graph, policy = Policy(tmp_path), ForeignPolicy(tmp_path / "policy.yaml")
    assert set(graph.sensors) == set(policy.sensors)
    robot = MujocoRobot(graph.description, tmp_path / "scene.xml", Options(joint_pos_noise=0.02, mocap_noise=0.01))
    worst, time = 0.0, 0.0
    while not graph.finished:
        reading = robot.read().sensors
        target = graph({key: reading[key] for key in graph.sensors})
        worst = max(worst, float(np.abs(target - policy({key: reading[key] for key in policy.sensors})).max()))
        robot.command(target, graph.description.stiffness, graph.description.damping)
        robot.wait(time := time + 0.02)
    assert worst < 1e-4
    assert all(check.off.max() < 3.0 for check in check_terms(policy) if check.off is not None)
