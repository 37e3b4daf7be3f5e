"""The graph of a deployment: what it consists of, and that it gives the trainer's targets."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
from mocks import load_config
from omegaconf import DictConfig, open_dict
from torch import Tensor

from hdmi.assembly import Task, make_env, make_task, make_transforms
from hdmi.config import task_files
from hdmi.deploy.export import make_graph, metadata_of, to_onnx
from hdmi.deploy.format import DeploymentError
from hdmi.deploy.graph import PolicyGraph, forward_part, inverse_part, name_of
from hdmi.envs import RowResetEnv
from hdmi.functional import quat_apply_inverse
from hdmi.learning.networks import make_actor, network_of

onnxruntime = pytest.importorskip("onnxruntime")
STEPS = 24
Tick = Callable[[dict[str, Tensor]], Sequence[Tensor]]


def untrained(env: RowResetEnv) -> torch.nn.Module:
    """A policy for an environment, its weights drawn wide enough for its actions to matter."""
    sizes = env.full_observation_spec["policy"].shape[-1], env.action_spec.shape[-1]
    actor = make_actor(*sizes, hidden=[32], activation="SiLU", init_noise=0.1, bf16=False)
    torch.nn.init.normal_(network_of(actor).mlp[-1].weight, std=0.3)
    return actor


def quiet(cfg: DictConfig, frame: int = 0) -> DictConfig:
    """The config without what only training needs, starting at a frame without perturbation."""
    with open_dict(cfg):
        cfg.randomization = cfg.noise = None
        cfg.action.delay = cfg.action.smoothing = None
        cfg.reset.state = {"_target_": "hdmi.transforms.ReferenceStateInitialization", "start": frame}
        cfg.termination = None
    return cfg


def sensors_of(env: RowResetEnv, graph: PolicyGraph) -> dict[str, Tensor]:
    """What the sensors of a robot would give, from the raw state."""
    raw = env.base_env._state(slice(None))[0]
    quat = raw["robot", "root_quat"]
    found = {
        "joint_pos": raw["robot", "joint_pos"],
        "joint_vel": raw["robot", "joint_vel"],
        "root_quat_w": quat,
        "root_ang_vel_b": quat_apply_inverse(quat, raw["robot", "root_ang_vel"]),
        "root_pos_w": raw["robot", "root_pos"],
    }
    for sensor, key in (("object_pos_w", "pos"), ("object_quat_w", "quat"), ("object_joint_pos", "joint_pos")):
        if sensor in graph.measured.sensors:
            found[sensor] = raw["object", key]
    return found


def follow(env: RowResetEnv, actor: torch.nn.Module, graph: PolicyGraph, tick: Tick, frame: int = 0) -> float:
    """Steps the environment under the policy, and a graph beside it; the largest difference of their targets, rad."""
    tensordict = env.reset()
    state = {name: value for name, value in graph.inputs.items() if name.startswith("state.")}
    if "state.ref.step" in state:
        state["state.ref.step"] = torch.full_like(state["state.ref.step"], frame)
    worst = 0.0
    with torch.no_grad():
        for _ in range(STEPS):
            target, *left = tick(sensors_of(env, graph) | state)
            state = {name.replace("next.", "state.", 1): v for name, v in zip(graph.outputs[1:], left, strict=True)}
            tensordict["action"] = network_of(actor)(tensordict["policy"])[0]
            stepped = env.step(tensordict)
            reached = env.base_env._state(slice(None))["robot", "joint_target"][0]
            worst = max(worst, float((reached - target).abs().max()))
            tensordict = env.step_mdp(stepped)
    return worst


def in_torch(graph: PolicyGraph) -> Tick:
    """A tick of the graph itself."""

    def tick(given: dict[str, Tensor]) -> tuple[Tensor, ...]:
        return graph(*(given.get(name, value) for name, value in graph.inputs.items()))

    return tick


def in_runtime(graph: PolicyGraph) -> Tick:
    """A tick of the exported graph."""
    session = onnxruntime.InferenceSession(to_onnx(graph).SerializeToString(), providers=["CPUExecutionProvider"])
    names = [value.name for value in session.get_inputs()]

    def tick(given: dict[str, Tensor]) -> list[Tensor]:
        found = session.run(graph.outputs, {name: given[name].numpy() for name in names})
        return [torch.from_numpy(np.asarray(value)) for value in found]

    return tick


@pytest.fixture
def task_of(monkeypatch: pytest.MonkeyPatch):
    """A task without the tables of its starts, which take seconds and matter for perturbed starts only."""
    monkeypatch.setattr("hdmi.assembly.start_tables", lambda *_: None)
    return make_task


# one of each kind; the others take the same paths
QUICK = ("lift_box", "walk", "push_box", "open_foldchair_sit", "truman_bow")


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in task_files()]
)
def test_graph_gives_the_trainers_targets(name: str, task_of):
    """On every task, with untrained weights, from the middle of the motion, where contact may be labelled."""
    cfg = load_config(f"task={name}")
    task = task_of(cfg)
    middle = task.reference.num_frames // 2
    env = make_env(quiet(cfg, middle), 1, task)
    actor = untrained(env)
    graph, _ = make_graph(cfg, actor, task)
    assert follow(env, actor, graph, in_torch(graph), middle) < 1e-5


@pytest.mark.parametrize(
    "overrides",
    [["task=walk", "+lever=[feedforward,root_history]"], ["task=push_door_hand"]],
    ids=" ".join,
)
def test_exported_graph_gives_the_trainers_targets(overrides: list[str], task_of):
    """Robot alone, with actions that start from what is computed of the reference, and articulated."""
    cfg = quiet(load_config(*overrides))
    task = task_of(cfg)
    env = make_env(cfg, 1, task)
    actor = untrained(env)
    graph, _ = make_graph(cfg, actor, task)
    assert follow(env, actor, graph, in_runtime(graph)) < 1e-4


class TestLiftBox:
    @pytest.fixture
    def parts(self, task_of) -> tuple[DictConfig, PolicyGraph, Task]:
        cfg = load_config()
        task = task_of(cfg)
        graph, _ = make_graph(cfg, untrained(make_env(cfg, 1, task)), task)
        return cfg, graph, task

    def test_noise_delay_and_randomization_stay_behind(self, parts):
        _, graph, _ = parts
        nodes = [name for name, _ in (*graph.stages, *graph.inverse)]
        groups = {name.partition(".")[0] for name in nodes}
        assert groups == {"reference", "action", "tracking", "observation", "history", "input"}
        assert [name for name, _ in graph.inverse] == ["action.joint_position", "action.target"]
        assert "tracking.contact_points" in nodes
        assert "tracking.bodies" not in nodes

    def test_aids_of_training_stay_behind(self, task_of):
        cfg = load_config("+lever=[early_end,springs,springs_object,rewind]")
        stack = make_transforms(cfg, task_of(cfg))
        nodes = {name for name, _ in stack}
        assert {"assist.root", "assist.object", "early_end.early_root_pose", "reset.rewind"} <= nodes
        kept = {name for name, _ in (*forward_part(stack, "policy"), *inverse_part(stack, "action"))}
        assert {"reference.motion", "action.target", "input.policy"} <= kept
        assert not [name for name in kept if name.startswith(("assist", "early_end", "reset"))]

    def test_what_actions_start_from_comes_along(self, task_of, monkeypatch: pytest.MonkeyPatch):
        monkeypatch.setattr("hdmi.assembly.reference_torque", lambda _, reference, grip: reference.joint_pos.numpy())
        cfg = load_config("+lever=feedforward")
        stack = make_transforms(cfg, task_of(cfg))
        without = [name for name, _ in forward_part(stack, "policy")]
        along = [name for name, _ in forward_part(stack, "policy", ("ref", "joint_target"))]
        assert set(along) - set(without) == {"reference.target"}
        assert along.index("reference.motion") < along.index("reference.target")

    def test_state_is_what_the_next_tick_reads(self, parts):
        _, graph, _ = parts
        assert {name_of(key) for key in graph.state} == {
            "action_history", "policy_action", "ref.step",
            "history.obs.gravity", "history.obs.joint_pos", "history.obs.root_ang_vel",
        }  # fmt: skip
        assert graph.outputs[0] == "joint_pos_target"

    def test_metadata_is_what_a_runner_needs(self, parts):
        cfg, graph, task = parts
        data = metadata_of(cfg, graph, task)
        assert len(data["joint_names"].split(",")) == len(data["joint_stiffness"].split(",")) == 29
        scale = dict(zip(data["joint_names"].split(","), map(float, data["action_scale"].split(",")), strict=True))
        assert scale["left_knee_joint"] == pytest.approx(0.35)
        assert scale["left_wrist_yaw_joint"] == 0  # the policy does not drive it
        assert float(data["control_dt"]) == 0.02
        start = json.loads(data["start"])
        assert start["joint_pos"] == pytest.approx(task.reference.joint_pos[0].tolist())
        assert json.loads(data["sensors"])["root_ang_vel_b"]["unit"] == "rad/s"
        assert json.loads(data["state"])["fresh"] == [1.0]

    def test_a_term_that_no_robot_measures_is_refused_by_name(self, task_of):
        cfg = load_config(
            "+observation.policy.root_lin_vel={_target_: hdmi.transforms.VectorInRoot, "
            "in_key: [robot, root_lin_vel], out_key: [obs, velocity]}"
        )
        task = task_of(cfg)
        graph, _ = make_graph(cfg, untrained(make_env(cfg, 1, task)), task)
        told = r"^observation\.policy\.root_lin_vel: depends on 'robot.root_lin_vel'"
        with pytest.raises(DeploymentError, match=told):
            to_onnx(graph)
