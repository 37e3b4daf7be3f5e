"""MuJoCo Warp, on its CPU device, against MuJoCo."""

from __future__ import annotations

import pytest
import torch
from mocks import lift_box, load_config
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from hdmi.assembly import make_env
from hdmi.assets import Effector, HingeConfig, ObjectConfig, RobotConfig, Scene, SimConfig, build_scene, g1
from hdmi.envs import HumanoidObjectEnv
from hdmi.envs.backend import STATE_FIELDS

warp = pytest.importorskip("warp", reason="needs the extra gpu")
pytest.importorskip("mujoco_warp", reason="needs the extra gpu")
warp.config.optimization_level = 0  # kernels are compiled for seconds and run for less

from hdmi.envs.warp_backend import WarpBackend  # noqa: E402

pytestmark = pytest.mark.xdist_group("warp")  # one process compiles the kernels, not each
N, SUBSTEPS = 4, 4
WRENCHES = {"root": [10.0, -5.0, 20.0, 0.5, 1.0, -0.5], "object": [0.5, 0.2, 1.0, 0.0, 0.005, -0.005]}  # N, N m
# After one control step from the same state.
TOLERANCES = {"qpos": 2e-5, "qvel": 2e-3, "sensordata": 0.5, "actuator_force": 0.1, "xpos": 2e-5, "xquat": 2e-5}


def warp_env(scene: Scene, num_envs: int = N, **options: int) -> HumanoidObjectEnv:
    return HumanoidObjectEnv(scene, num_envs, lambda model, n: WarpBackend(model, n, "cpu", **options))


def randomized(scene: Scene, generator: torch.Generator) -> TensorDict:
    """What a reset may be given: a state that differs between worlds, and every model field that terms draw."""

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(N, *shape, generator=generator)

    def rows(field: str) -> Tensor:
        return torch.from_numpy(getattr(scene.model, field)).float().expand(N, *getattr(scene.model, field).shape)

    model = scene.model
    mass, friction = uniform(0.8, 1.2, model.nbody), rows("geom_friction").clone()
    friction[..., 0] = uniform(0.3, 1.2, model.ngeom)
    com = rows("body_ipos").clone()
    com[:, scene.body_ids] += uniform(-0.02, 0.02, len(scene.body_ids), 3)
    fields = {
        "body_mass": rows("body_mass") * mass,
        "body_inertia": rows("body_inertia") * mass.unsqueeze(-1),
        "body_ipos": com,
        "geom_friction": friction,
    }
    joints = torch.from_numpy(scene.default_qpos[scene.joint_qpos]).float()
    init = {
        "model": TensorDict(fields, batch_size=[N]),
        "root_pos": torch.tensor([0.0, 0.0, g1.ROOT_HEIGHT]) + uniform(-0.02, 0.02, 3),
        "root_lin_vel": uniform(-0.3, 0.3, 3),
        "root_ang_vel": uniform(-0.3, 0.3, 3),
        "joint_pos": joints + uniform(-0.1, 0.1, 29),
        "joint_vel": uniform(-0.5, 0.5, 29),
    }
    if scene.object_hinge_dof is not None:
        fields["dof_damping"] = rows("dof_damping") * uniform(0.8, 1.2, 1)
        fields["dof_frictionloss"] = rows("dof_frictionloss") + 0.5
    if scene.object_body is not None:
        init["object_scale"] = uniform(0.9, 1.1, 1)
    return TensorDict(init, batch_size=[N])


def synchronize(target: HumanoidObjectEnv, source: HumanoidObjectEnv) -> None:
    for field in STATE_FIELDS:
        target.backend.data(field).copy_(source.backend.data(field))
    target.backend.refresh(torch.arange(N))


def assert_near(warp: HumanoidObjectEnv, mujoco: HumanoidObjectEnv, where: str) -> None:
    for field, tolerance in TOLERANCES.items():
        got, wanted = warp.backend.data(field), mujoco.backend.data(field)
        error = (got - wanted).abs().max().item()
        assert error < tolerance, f"{where}: {field} is off by {error:.2g}, {tolerance} allowed"


def lift_box_scene() -> Scene:
    return lift_box().scene


def box_to_push(sim: SimConfig) -> Scene:
    """A heavy box that the hooks of the hands touch, in front of a robot with flat feet."""
    box = ObjectConfig("box", [{"box": (0.15, 0.3, 0.4)}], mass=8.0, friction=0.5)
    hands = [Effector(f"{side}_wrist_yaw_link") for side in ("left", "right")]
    return build_scene(
        RobotConfig(feet="box", effector="L"), sim, box, effectors=hands,
        placements={"box": ((0.46, 0.0, 0.4), (1.0, 0.0, 0.0, 0.0))},
    )  # fmt: skip


def door() -> Scene:
    """An object with a hinge, dry friction and a fixed base."""
    hinge = HingeConfig("hinge", "leaf", [{"box": (0.02, 0.4, 0.9), "pos": (0.0, 0.4, 0.9)}], axis=(0.0, 0.0, 1.0))
    frame = ObjectConfig("door", [{"box": (0.02, 0.02, 0.9)}], hinge=hinge, fixed_base=True)
    return build_scene(RobotConfig(), SimConfig(), frame, placements={"door": ((0.4, -0.4, 0.9), (1.0, 0.0, 0.0, 0.0))})


SCENES = {
    "lift_box": lift_box_scene,
    "push_box": lambda: box_to_push(SimConfig()),
    # at 10 iterations the solver stops early now and then, and each engine elsewhere
    "elliptic cones, implicit": lambda: box_to_push(
        SimConfig(cone="elliptic", impratio=10.0, integrator="implicitfast", iterations=100, ls_iterations=50)
    ),
    "door": door,
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name.startswith("elliptic") else []) for name in SCENES]
)
def test_parity(name: str):
    """States, controls and randomization are the same, and so are states, forces and resets of some worlds after it."""
    scene, generator = SCENES[name](), torch.Generator().manual_seed(0)
    mujoco, warp = HumanoidObjectEnv(scene, N), warp_env(scene)
    both = (mujoco, warp)
    start = randomized(scene, generator)
    for env in both:
        env._reset(TensorDict({"init": start}, batch_size=[N]))
    assert_near(warp, mujoco, "reset")
    touched = torch.zeros(N, dtype=torch.bool)
    for step in range(6):
        if step == 3:  # all but one
            mask = torch.tensor([True, False, True, True]).unsqueeze(-1)
            start, others = randomized(scene, generator), warp.backend.data("qpos")[1].clone()
            for env in both:
                env._reset(TensorDict({"init": start, "_reset": mask}, batch_size=[N]))
            assert_near(warp, mujoco, f"reset of some before step {step}")
            assert torch.equal(warp.backend.data("qpos")[1], others)
        synchronize(warp, mujoco)
        joints = mujoco.backend.data("qpos")[:, mujoco._joint_qpos].float()
        action = joints.unsqueeze(1) + 0.2 * torch.randn(N, SUBSTEPS, 29, generator=generator)
        push = torch.randn(N, 6, generator=generator) * torch.tensor([0.0, 0.0, 0.3, 0.3]).unsqueeze(-1)
        inputs = TensorDict({"action": action, "push": push}, batch_size=[N])
        for body, wrench in WRENCHES.items() if step == 1 else ():
            if body == "root" or scene.object_free_dof is not None:
                inputs["wrench", body] = torch.tensor(wrench).expand(N, 6)
        wanted, got = (env._step(inputs.clone()) for env in both)
        assert_near(warp, mujoco, f"step {step}")
        assert set(got.keys(True, True)) == set(wanted.keys(True, True))
        for key in wanted.keys(True, True):
            assert (got[key].dtype, got[key].shape) == (wanted[key].dtype, wanted[key].shape), key
        touched |= (mujoco.backend.data("sensordata") != 0).any(-1)
    assert touched.all()
    assert warp.backend.overflows() == 0


def lift_box_env(num_envs: int = 4) -> TransformedEnv:
    return make_env(load_config("sim=gpu", "sim.device=cpu"), num_envs, lift_box())


@pytest.fixture(scope="module")
def env() -> TransformedEnv:
    """The config `sim=gpu`, with everything that the default stack does. Reset it first."""
    return lift_box_env()


def advance(env: TransformedEnv, carry: TensorDictBase, steps: int) -> TensorDictBase:
    torch.manual_seed(0)
    for _ in range(steps):
        action = 0.3 * torch.randn(env.action_spec.shape)
        _, carry = env.step_and_maybe_reset(carry.set("action", action))
    return carry.exclude("action")


def test_resets_the_worlds_that_are_done_and_no_other(env: TransformedEnv):
    carry = advance(env, env.reset(), 2)
    carry["done"][[1, 3]] = True
    before, backend = carry.clone(), env.base_env.backend
    state = {f: backend.data(f).clone() for f in (*STATE_FIELDS, "sensordata", "xpos", "actuator_force")}
    mass = backend.model("body_mass").clone()
    after = env.maybe_reset(carry.copy())
    for key in before.keys(True, True):
        assert torch.equal(after[key][[0, 2]], before[key][[0, 2]]), key
    for field, values in state.items():
        assert torch.equal(backend.data(field)[[0, 2]], values[[0, 2]]), field
    assert after["step_count"].flatten().tolist() == [2, 0, 2, 0]
    assert (backend.data("time") == 0).tolist() == [False, True, False, True]
    box = env.base_env.scene.object_body
    assert (backend.model("body_mass")[:, box] != mass[:, box]).tolist() == [False, True, False, True]


def test_continues_from_a_saved_state_bit_for_bit(env: TransformedEnv):
    start = advance(env, env.reset(), 5)
    state, kept = env.base_env.get_state(), start.clone()
    wanted = advance(env, start, 5)
    other = lift_box_env()
    other.reset()
    other.transform.load_state_dict(env.transform.state_dict())
    other.base_env.set_state(state)
    got = advance(other, kept, 5)
    for key in wanted.keys(True, True):
        assert torch.equal(got[key], wanted[key]), key


def test_a_diverged_world_ends_alone_and_comes_back(env: TransformedEnv):
    carry, backend, before = env.reset(), env.base_env.backend, env.base_env.num_diverged
    backend.data("qpos")[1] = float("nan")
    backend.data("qvel")[2] = 1e9
    stepped, carry = env.step_and_maybe_reset(carry.set("action", torch.zeros(env.action_spec.shape)))
    assert stepped["next", "diverged"].flatten().tolist() == [False, True, True, False]
    assert stepped["next", "terminated"].flatten().tolist() == [False, True, True, False]
    for _ in range(2):
        for key, value in (*stepped.items(True, True), *carry.items(True, True)):
            assert value.isfinite().all(), key
        stepped, carry = env.step_and_maybe_reset(carry.set("action", torch.zeros(env.action_spec.shape)))
    assert env.base_env.num_diverged == before + 2


def test_a_world_for_pictures(env: TransformedEnv):
    advance(env, env.reset(), 3)
    backend = env.base_env.backend
    model, data = backend.world(2)
    for got, wanted in (
        (data.qpos, backend.data("qpos")),
        (data.xpos, backend.data("xpos")),
        (model.body_mass, backend.model("body_mass")),
        (model.geom_size, backend.model("geom_size")),
    ):
        torch.testing.assert_close(torch.from_numpy(got.copy()).float(), wanted[2], atol=1e-5, rtol=0)


def test_too_little_room_is_counted_and_the_warning_says_what_to_set():
    env = warp_env(lift_box().scene, constraints=16)
    env.reset()
    env.step(env.rand_action())
    with pytest.warns(UserWarning, match=r"all of their constraints.*sim\.backend\.constraints=\d+ \(now 16"):
        assert env.backend.overflows() == N
    assert env.backend.overflows() == N  # and warns once


def test_refuses_what_is_not_there(robot_scene):
    if not torch.cuda.is_available():
        with pytest.raises(ValueError, match=r"device: 'cuda'.*GPU"):
            WarpBackend(robot_scene.model, 1)
    with pytest.raises(KeyError, match=r"qpos_spring.*geom_size"):
        WarpBackend(robot_scene.model, 1, "cpu").model("qpos_spring")
