"""The physics backend against MuJoCo itself, and resets of rows against resets of everything."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from mocks import ScriptedEnv, assert_same, drive, lift_box, load_config, make_script
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded
from torchrl.envs import Compose, EnvBase, TransformedEnv
from torchrl.envs import transforms as tt
from torchrl.envs.utils import check_env_specs

from hdmi.assembly import make_env
from hdmi.assets import ObjectConfig, RobotConfig, Scene, SimConfig, build_scene
from hdmi.config import ConfigError
from hdmi.envs import BatchBackend, HumanoidObjectEnv, Keep, MaskedResetEnv, ResetEnv, RowResetEnv, Stack
from hdmi.learning.collectors import WorldCollector

DETERMINISTIC = ("+ablation=no_randomization", "reset.state.start=first", "~reset.state.noise")


def env_of(num_envs: int, *overrides: str) -> TransformedEnv:
    return make_env(load_config(*overrides), num_envs, lift_box())


def step_alone(scene, controls: Tensor) -> mujoco.MjData:
    """One world on plain MuJoCo, one control after another. [S, nu]"""
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.default_qpos
    mujoco.mj_forward(scene.model, data)
    for control in controls:
        data.ctrl[:] = control.numpy()
        mujoco.mj_step(scene.model, data)
    mujoco.mj_step1(scene.model, data)
    return data


class TestBackend:
    @pytest.mark.parametrize(
        "runs",
        [
            [[0, 0, 0, 0]] * 3,  # one control for everyone
            [[0, 1, 1, 1], [0, 0, 1, 1], [0, 0, 0, 1]],  # delays: each world changes once
            [[0, 1, 2, 3], [0, 0, 1, 0], [0, 0, 0, 0]],  # anything
            [[0], [1], [2]],
            # several control steps: targets that arrive late, a schedule of its own between them, anything
            [
                [0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 2],
                [0, 0, 0, 1, 2, 3, 0, 1, 1, 1, 3, 3],
                [3, 2, 1, 0, 1, 1, 2, 2, 3, 3, 3, 3],
            ],
        ],
    )
    def test_steps_as_mujoco_does(self, robot_scene, runs):
        torch.manual_seed(0)
        choices = torch.from_numpy(robot_scene.default_qpos[robot_scene.joint_qpos]) + 0.3 * torch.randn(4, 29)
        controls = choices[torch.tensor(runs)]  # [N, S, nu]
        backend = BatchBackend(robot_scene.model, len(runs), num_threads=1)
        backend.data("qpos")[:] = torch.from_numpy(robot_scene.default_qpos)
        backend.refresh(torch.arange(len(runs)))
        for control_step in controls.split(4, dim=1):
            backend.step(control_step)
        for world, sequence in enumerate(controls):
            alone = step_alone(robot_scene, sequence)
            for field in ("time", "qpos", "qvel", "xpos", "cvel", "actuator_force"):
                got = backend.data(field)[world].numpy()
                np.testing.assert_array_equal(got, np.asarray(getattr(alone, field)).reshape(got.shape), field)

    def test_late_controls_leave_the_state_alone(self, robot_scene, monkeypatch: pytest.MonkeyPatch):
        """What is written into the history makes MuJoCo compute anew what it had kept: only other schedules are."""
        backend = BatchBackend(robot_scene.model, 2, num_threads=1)
        backend.refresh(torch.arange(2))
        written, write = [], backend._write_history
        monkeypatch.setattr(
            backend,
            "_write_history",
            lambda worlds, controls: (written.append(worlds.tolist()), write(worlds, controls)),
        )
        targets = 0.1 * torch.arange(4.0).view(4, 1).expand(4, 29)
        for runs in ([[0, 0, 0, 0], [1, 1, 1, 1]], [[0, 0, 0, 2], [1, 3, 3, 3]], [[2, 2, 2, 2], [3, 2, 3, 2]]):
            backend.step(targets[torch.tensor(runs)])
        assert written == [[1]]


class TestWrench:
    """Forces on the root and on an object, a cube of 2 kg whose centre is 0.3 m beside its origin; both in the air."""

    DT, MASS, INERTIA = 0.02, 2.0, 2 / 3 * 2.0 * 0.1**2  # s, kg, kg m^2
    GRAVITY = torch.tensor([0.0, 0.0, -9.81])

    @pytest.fixture(scope="class")
    def scene(self) -> Scene:
        cube = ObjectConfig("cube", [{"box": (0.1, 0.1, 0.1), "pos": (0.3, 0.0, 0.0)}], mass=self.MASS)
        return build_scene(RobotConfig(), SimConfig(), cube)

    def reset(self, env: HumanoidObjectEnv) -> TensorDictBase:
        init = {"root_pos": torch.tensor([0.0, 0.0, 5.0]), "object_pos": torch.tensor([3.0, 0.0, 5.0])}
        init = {key: value.expand(env.num_envs, 3) for key, value in init.items()}
        return env.reset(TensorDict({"init": init}, batch_size=[env.num_envs]))

    def start(self, scene: Scene, count: int = 2) -> tuple[HumanoidObjectEnv, TensorDictBase]:
        env = HumanoidObjectEnv(scene, count, lambda m, n: BatchBackend(m, n, 1))
        return env, self.reset(env)

    def step(self, env: HumanoidObjectEnv, state: TensorDictBase, **wrench: list[list[float]]) -> TensorDictBase:
        given = state.select("robot", "object").set("action", state["robot", "joint_pos"])
        for name, rows in wrench.items():
            given["wrench", name] = torch.tensor(rows)
        return env.step(given)["next"]

    def test_force_and_moment_are_about_the_origin_of_the_object(self, scene):
        env, state = self.start(scene, 4)
        force, moment = 0.4, 0.3 * 0.4  # the force at the origin turns the cube as this moment does
        rows = [
            [0, 0, force, 0, 0, 0],
            [0, 0, force, 0, -moment, 0],
            [0, 0, 0, 0, 0, 0.05],
            [0, 0, 0, 0, 0, 0],
        ]
        after = self.step(env, state, object=rows)["object"]
        turn = self.DT / self.INERTIA * torch.tensor([[0, moment, 0], [0, 0, 0], [0, 0, 0.05], [0, 0, 0]])
        torch.testing.assert_close(after["ang_vel"], turn, atol=2e-3, rtol=0)
        fall = self.DT * (self.GRAVITY + torch.tensor([[0, 0, force / self.MASS]] * 2 + [[0, 0, 0.0]] * 2))
        # of the origin, which goes round the centre
        swing = torch.linalg.cross(turn, torch.tensor([[-0.3, 0, 0]] * 4))
        torch.testing.assert_close(after["lin_vel"], fall + swing, atol=2e-3, rtol=0)

    def test_force_on_the_root_moves_the_robot(self, scene):
        env, state = self.start(scene)
        self.step(env, state, root=[[30.0, -20.0, 10.0, 0, 0, 0], [0.0] * 6])
        momentum = []
        for index in range(2):
            model, data = env.backend.world(index)
            mujoco.mj_subtreeVel(model, data)
            root = int(scene.body_ids[0])
            momentum.append(torch.from_numpy(data.subtree_linvel[root] * model.body_subtreemass[root]).float())
        change = momentum[0] - momentum[1]
        torch.testing.assert_close(change, self.DT * torch.tensor([30.0, -20.0, 10.0]), atol=2e-2, rtol=0)

    @pytest.mark.parametrize("reset", [False, True])
    def test_ends_with_the_step(self, scene, reset):
        """Then the cube falls freely, after a reset and without one."""
        env, state = self.start(scene)
        along = [[50.0, 0, 0, 0, 0, 0]] * 2  # through the cube's centre
        state = self.step(env, state, object=along, root=along)
        gained = self.DT * torch.tensor([50 / self.MASS, 0, -9.81])
        torch.testing.assert_close(state["object", "lin_vel"], gained.expand(2, 3), atol=1e-3, rtol=0)
        before = state["object", "lin_vel"]
        if reset:
            state, before = self.reset(env), torch.zeros(2, 3)
        after = self.step(env, state)["object", "lin_vel"]
        torch.testing.assert_close(after - before, (self.DT * self.GRAVITY).expand(2, 3), atol=1e-3, rtol=0)

    def test_no_wrench_is_none(self, scene):
        (env, state), (other, same) = self.start(scene), self.start(scene)
        pulled = self.step(env, state, object=[[0.0] * 6] * 2, root=[[0.0] * 6] * 2)
        assert_same(pulled, self.step(other, same))


def advance(env: TransformedEnv, tensordict: TensorDictBase, steps: int) -> TensorDictBase:
    torch.manual_seed(0)
    for _ in range(steps):
        action = 0.3 * torch.randn(env.action_spec.shape)
        tensordict = env.step_mdp(env.step(tensordict.set("action", action)))
    return tensordict.exclude("action")


class TestRowReset:
    def test_equals_a_reset_of_everything(self):
        env = env_of(4, *DETERMINISTIC)
        before = advance(env, env.reset(), 3)
        before["done"][[1, 3]] = True
        state, kept = env.base_env.get_state(), before.clone()
        rows = env.maybe_reset(before.copy())
        after_rows = env.base_env.get_state()
        env.base_env.set_state(state)
        everything = TransformedEnv.maybe_reset(env, kept.clone())
        assert set(rows.keys(True, True)) == set(everything.keys(True, True))
        for key in rows.keys(True, True):
            assert torch.equal(rows[key], everything[key]), key
        for field in ("qpos", "qvel", "ctrl"):
            assert torch.equal(after_rows["backend", f"data/{field}"], env.base_env.backend.data(field)), field
        assert rows["step_count"].flatten().tolist() == [3, 0, 3, 0]
        assert (rows["episode_reward"].flatten() == 0).tolist() == [False, True, False, True]

    def test_leaves_the_last_step_as_it_was(self):
        env = env_of(3, *DETERMINISTIC)
        before = advance(env, env.reset(), 2)
        before["done"][0] = True
        kept, given = before.clone(), before.copy()
        env.maybe_reset(before)
        for key in kept.keys(True, True):
            assert torch.equal(given[key], kept[key]), key

    def test_worlds_stay_themselves(self):
        """What is drawn per world comes back for the world that resets, at its own row."""
        env = env_of(5)
        start = env.reset()
        model = env.base_env.scene.model
        links = [i for i in range(model.nbody) if model.body(i).name.endswith("_link")]
        box = model.body("box").id
        mass = env.base_env.backend.model("body_mass")
        before = mass.clone()
        start["done"][2] = True
        env.maybe_reset(start)
        assert torch.equal(mass[:, links], before[:, links])
        assert (mass[:, box] != before[:, box]).tolist() == [False, False, True, False, False]

    def test_each_row_gets_its_own_state(self):
        class Places(tt.Transform):
            def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase | None:
                if tensordict is None:
                    return None
                return tensordict.set(("init", "root_pos"), torch.arange(12.0).view(4, 3)[tensordict["worlds"]])

        base = env_of(4, *DETERMINISTIC).base_env
        env = RowResetEnv(base, Compose(Places()))
        start = env.reset()
        start["done"][[1, 3]] = True
        rows = env.maybe_reset(start)["robot", "root_pos"]
        assert rows[[1, 3]].tolist() == [[3, 4, 5], [9, 10, 11]]
        torch.testing.assert_close(base.backend.data("qpos")[:, :3].float(), rows)


class RowsEnv(ScriptedEnv):
    """Four scripted worlds that reset alone."""

    def __init__(self) -> None:
        super().__init__(make_script([("error", "many")], n=4))

    def place(self, worlds: torch.Tensor, init: TensorDictBase | None) -> None:
        self.counter = self.counter.clone()
        self.counter[worlds] = 0

    def show(self, worlds: torch.Tensor | slice) -> TensorDictBase:
        return self._state()[worlds]


def play(env: EnvBase, ends: list[list[int]]) -> list[TensorDictBase]:
    """Steps, after each of which some worlds are done; what was stepped, and what came after the resets."""
    tensordict, out = env.reset(), []
    for done in ends:
        stepped = env.step(tensordict.set("action", torch.zeros(4, 4)))
        following = env.step_mdp(stepped)
        for key in ("done", "terminated"):
            following[key][done] = True
        tensordict = env.maybe_reset(following)
        out += [stepped["next"].clone(), tensordict.clone()]
    return out


class TestTorchRLTransforms:
    @pytest.mark.parametrize("cls", [RowResetEnv, MaskedResetEnv])
    @pytest.mark.parametrize(
        "make",
        [
            tt.StepCounter,
            tt.RewardSum,
            tt.InitTracker,
            lambda: tt.TargetReturn(3.0),
            lambda: tt.RewardScaling(1.0, 2.0),
            lambda: tt.FrameSkipTransform(2),
            lambda: tt.ObservationNorm(loc=0.0, scale=2.0, in_keys=["clock"]),
        ],
        ids=lambda make: type(make()).__name__,
    )
    def test_that_are_taken_do_as_in_torchrl(self, cls: type[ResetEnv], make: Any):
        ends = [[0, 1, 3], [2], [], [1]]
        for ours, theirs in zip(
            play(cls(RowsEnv(), make()), ends), play(TransformedEnv(RowsEnv(), make()), ends), strict=True
        ):
            assert_same(ours, theirs)

    @pytest.mark.parametrize("cls", [RowResetEnv, MaskedResetEnv])
    @pytest.mark.parametrize(
        ("make", "told"),
        [
            (lambda: tt.CatFrames(N=3, dim=-1, in_keys=["clock"]), r"CatFrames: .*; use hdmi\.transforms\.History"),
            (lambda: tt.TimeMaxPool(in_keys=["clock"], T=3), r"TimeMaxPool: .*History"),
            (lambda: tt.RandomTruncationTransform(2, 5), r"RandomTruncationTransform: .*ReferenceStateInitialization"),
            (lambda: tt.TensorDictPrimer(h=Unbounded(shape=(3,)), expand_specs=True), r"TensorDictPrimer: .*StateTr"),
            (lambda: tt.gSDENoise(state_dim=2, action_dim=4), r"gSDENoise: .*StateTransform"),
            (lambda: tt.ActionMask(), r"ActionMask: .*policy"),
            (lambda: tt.VecNormV2(in_keys=["clock"]), r"VecNormV2: .*reduce_batch_dims=True, or .*RunningNorm"),
        ],
        ids=lambda value: type(value()).__name__ if callable(value) else "",
    )
    def test_that_a_reset_of_some_would_corrupt_are_refused(self, cls: type[ResetEnv], make: Any, told: str):
        for nested in (make(), Compose(tt.StepCounter(), Compose(make()))):
            with pytest.raises(TypeError, match=told):
                cls(RowsEnv(), nested)
        env = cls(RowsEnv(), Compose())
        with pytest.raises(TypeError, match=told):
            env.append_transform(make())
        with pytest.raises(TypeError, match=told):
            env.insert_transform(0, make())
        cls(RowsEnv(), tt.VecNormV2(in_keys=["clock"], reduce_batch_dims=True))

    def test_config_nodes_are_named(self):
        node = "{_target_: torchrl.envs.CatFrames, N: 2, dim: -1, in_keys: [[robot, joint_pos]]}"
        with pytest.raises(ConfigError, match=r"^tracking\.frames: CatFrames: .*use hdmi\.transforms\.History$"):
            env_of(2, f"+tracking.frames={node}")


class TestStack:
    def test_hands_actions_from_last_to_first(self):
        stack = Stack(tt.ActionScaling(loc=1.0, scale=3.0), tt.ActionScaling(loc=0.5, scale=2.0))
        env = TransformedEnv(RowsEnv(), stack)
        env.step(env.reset().set("action", torch.ones(4, 4)))
        assert torch.equal(env.base_env.received, torch.full((4, 4), 3 * (2 * 1 + 0.5) + 1))

    def test_hands_resets_from_last_to_first(self):
        class Note(tt.Transform):
            def __init__(self, name: str):
                super().__init__()
                self.name = name

            def _reset_env_preprocess(self, tensordict: TensorDictBase) -> TensorDictBase:
                seen.append(self.name)
                return tensordict

        seen: list[str] = []
        TransformedEnv(RowsEnv(), Stack(Note("first"), Note("last"))).reset()
        assert seen == ["last", "first"]


def test_keep_does_as_torchrl_in_two_transforms():
    theirs = Compose(tt.StepCounter(), tt.SelectTransform("step_count"), tt.RemoveEmptySpecs())
    ours = Compose(tt.StepCounter(), Keep(["step_count", "absent", "reward", "done", "terminated", "truncated"]))
    envs = [TransformedEnv(RowsEnv(), transform) for transform in (ours, theirs)]
    for env in envs:
        check_env_specs(env)
        assert set(env.full_observation_spec.keys(True, True)) == {"step_count"}
        assert "error" not in env.full_observation_spec.keys(True)
    for a, b in zip(*(drive(env, 3) for env in envs), strict=True):
        assert_same(a, b)


def test_torch_threads_are_few_while_it_steps_and_as_before_afterwards(monkeypatch: pytest.MonkeyPatch):
    assert load_config().envs_per_thread == 4096
    env, seen = env_of(3, "envs_per_thread=2"), []
    start = env.reset()
    backend = env.base_env.backend
    for name in ("step", "refresh"):
        method = getattr(backend, name)
        monkeypatch.setattr(backend, name, lambda x, method=method: (seen.append(torch.get_num_threads()), method(x)))
    take_rows = TensorDict.__getitem__

    def seen_taking_rows(tensordict: TensorDict, index: Any) -> Any:
        if isinstance(index, torch.Tensor):
            seen.append(torch.get_num_threads())
        return take_rows(tensordict, index)

    monkeypatch.setattr(TensorDict, "__getitem__", seen_taking_rows)
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        start["done"][1] = True
        advance(env, env.maybe_reset(start), 1)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    # rows of the one that resets and its physics; everyone's
    assert len(seen) >= 3
    assert seen == sorted(seen)
    assert set(seen) == {1, 2}


def test_a_policy_has_no_more_threads_than_the_environment_while_experience_is_collected():
    env, seen = env_of(2), []

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        seen.append(torch.get_num_threads())
        return tensordict.set("action", env.action_spec.zero())

    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        batches = iter(WorldCollector(env, policy, frames_per_batch=4, total_frames=-1))
        seen.clear()  # TorchRL has asked the policy for its outputs
        next(batches)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    assert seen == [1, 1]


def test_forces_after_a_reset_are_those_of_its_own_targets():
    """A reset holds the joints where they are: whatever was scheduled before is forgotten."""
    env = env_of(2, *DETERMINISTIC).base_env
    first = env.reset()["robot", "joint_torque"].clone()
    action = env.scene.default_qpos[env.scene.joint_qpos]
    for _ in range(2):
        env.step(env.rand_action().set("action", torch.from_numpy(action).float().expand(2, -1) + 0.5))
    torch.testing.assert_close(env.reset()["robot", "joint_torque"], first)
    assert first.abs().max() < 1e-3


@pytest.mark.slow
def test_compiled_transforms_equal_eager_ones():
    """The whole default stack is one graph, in a step and in a reset of some rows, and computes the same."""
    results = []
    for compiled in (False, True):
        torch.manual_seed(0)
        env = env_of(5)
        start = env.reset()
        if compiled:
            env.compile_transforms(backend="eager", fullgraph=True)
        for ended in ([1, 3], [0], [2, 3, 4]):
            start["done"][ended] = True
            start = advance(env, env.maybe_reset(start), 2)
        results.append(start)
    eager, compiled = results
    assert set(eager.keys(True, True)) == set(compiled.keys(True, True))
    for key in eager.keys(True, True):
        assert torch.equal(eager[key], compiled[key]), key
