"""What each transform does, against numbers worked out by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import pytest
import torch
from mocks import ScriptedEnv, constant, drive, lift_box, make_script, wrap
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import Compose
from torchrl.envs.utils import check_env_specs

import hdmi.functional as F
import hdmi.transforms as T
from hdmi.assets import Effector, default_joint_pos, g1
from hdmi.envs import BatchBackend, HumanoidObjectEnv, MaskedResetEnv, ResetEnv, RowResetEnv
from hdmi.functional import local_pose, quat_apply, quat_from_euler, quat_multiply

X = ("obs", "x")
E1 = math.exp(-1)


def close(actual: Tensor, expected, atol: float = 1e-6) -> None:
    torch.testing.assert_close(actual, torch.as_tensor(expected, dtype=actual.dtype), rtol=0, atol=atol)


def table(values, n: int = 1) -> Tensor:
    """A script of one scalar feature: [T] -> [T, N, 1]"""
    return torch.as_tensor(values, dtype=torch.float32).reshape(-1, 1, 1).repeat(1, n, 1)


def blank(n: int = 1, steps: int = 12) -> ScriptedEnv:
    return ScriptedEnv(make_script([], n, steps))


def next_of(steps: list, key) -> Tensor:
    """An entry of the next tensordicts, time first."""
    return torch.stack([step["next"].get(key) for step in steps])


@pytest.fixture(scope="module")
def reference():
    return lift_box().reference


@pytest.fixture(scope="module")
def model():
    return lift_box().scene.model


def physics(num_envs: int, *transforms):
    """The embedded scene under a few transforms."""
    scene = lift_box().scene
    return wrap(HumanoidObjectEnv(scene, num_envs, lambda m, n: BatchBackend(m, n, 1)), *transforms)


# -- reference and reset ----------------------------------------------------------------------------------------------


class TestMotionReference:
    def env(self, reference, start: int = 0, **kwargs):
        class Start(T.ReferenceStateInitialization):
            def sample_frames(self, batch_size, device):
                return torch.full(batch_size, start, dtype=torch.int64)

        motion = T.MotionReference(
            reference, ["pelvis", "torso_link"], ["waist_.*"], g1.BODY_NAMES, g1.JOINT_NAMES, **kwargs
        )
        return wrap(blank(2), Start(reference, g1.JOINT_RANGES), motion)

    def test_clock_starts_at_the_frame_of_the_reset_and_stays_at_the_end(self, reference):
        last = reference.num_frames - 1
        env = self.env(reference, last - 2)
        start = env.reset()
        steps = drive(env, 4, start=start.clone())
        assert start["ref", "step"].flatten().tolist() == [last - 2] * 2
        assert next_of(steps, ("ref", "step"))[:, 0].flatten().tolist() == [last - 1, last, last, last]
        close(next_of(steps, ("ref", "phase"))[:, 0, 0], [(last - 1) / last, 1, 1, 1])
        close(start["ref", "phase"][0], [(last - 2) / last])
        close(steps[-1]["next", "ref", "joint_pos"][1], reference.joint_pos[last])

    def test_without_a_frame_it_starts_at_the_first(self, reference):
        env = wrap(blank(2), T.MotionReference(reference, ["pelvis"], ["waist_.*"], g1.BODY_NAMES, g1.JOINT_NAMES))
        start = env.reset()
        assert start["ref", "step"].flatten().tolist() == [0, 0]
        close(start["ref", "phase"], [[0.0], [0.0]])
        close(start["ref", "joint_pos"][0], reference.joint_pos[0])

    def test_entries_are_those_of_the_frame(self, reference):
        td = self.env(reference, 100).reset()
        torso = g1.BODY_NAMES.index("torso_link")
        close(td["ref", "joint_vel"][0], reference.joint_vel[100])
        close(td["ref", "root_pos"][0], reference.body_pos[100, 0])
        close(td["ref", "body_lin_vel"][0], reference.body_lin_vel[100][[0, torso]])
        close(td["ref", "object_pos"][0], reference.object_pos[100])
        assert td["ref", "contact"].dtype == torch.bool
        assert td["ref", "contact"][0].tolist() == reference.contact[100].tolist() == [True, True]
        close(td["ref", "contact_point"][0], reference.contact_point[100])

    def test_future(self, reference):
        last = reference.num_frames - 1
        td = self.env(reference, last - 2, future_steps=(1, 5)).reset()
        joints = [g1.JOINT_NAMES.index(f"waist_{axis}_joint") for axis in ("yaw", "roll", "pitch")]
        close(td["ref", "future", "joint_pos"][0], reference.joint_pos[[last - 1, last]][:, sorted(joints)])
        # future bodies in the frame of the present root
        torso = g1.BODY_NAMES.index("torso_link")
        bodies = reference.body_pos[last, [0, torso]]
        root = reference.body_pos[last - 2, 0], reference.body_quat[last - 2, 0]
        expected, _ = local_pose(bodies, reference.body_quat[last, [0, torso]], *root)
        close(td["ref", "future", "body_pos_local"][0, 1], expected, 1e-5)

    def test_no_future(self, reference):
        td = self.env(reference, future_steps=()).reset()
        assert ("ref", "future", "joint_pos") not in td.keys(True)


NOISE = {"root_pos": [0.1, 0.0, 0.05], "joint_pos": 0.2, "object_pos": [0.0, 0.1, 0.0], "root_rpy": [0.0, 0.0, 0.3]}


class TestReferenceStateInitialization:
    def test_without_noise_physics_starts_in_the_reference_state(self, reference):
        motion = T.MotionReference(reference, ["pelvis"], ["waist_.*"], g1.BODY_NAMES, g1.JOINT_NAMES)
        td = physics(8, T.ReferenceStateInitialization(reference, g1.JOINT_RANGES), motion).reset()
        frames = td["ref", "step"].squeeze(-1)
        assert len(frames.unique()) > 1
        robot, object_ = td["robot"], td["object"]
        for key in ("joint_pos", "joint_vel"):
            close(robot[key], getattr(reference, key)[frames], 1e-5)
        close(robot["root_pos"], reference.body_pos[frames, 0], 1e-5)
        close(robot["root_quat"], reference.body_quat[frames, 0], 1e-5)
        close(robot["root_lin_vel"], reference.body_lin_vel[frames, 0], 1e-4)
        close(robot["root_ang_vel"], reference.body_ang_vel[frames, 0], 1e-4)
        close(robot["body_pos"], reference.body_pos[frames], 2e-3)
        close(robot["joint_target"], reference.joint_pos[frames], 1e-5)
        close(object_["pos"], reference.object_pos[frames], 1e-5)
        close(object_["quat"], reference.object_quat[frames], 1e-5)
        close(object_["lin_vel"], reference.object_lin_vel[frames], 1e-4)
        close(object_["ang_vel"], reference.object_ang_vel[frames], 1e-4)

    def test_noise_is_uniform_within_its_half_range(self, reference):
        init = T.ReferenceStateInitialization(reference, g1.JOINT_RANGES, noise=NOISE)
        frames = torch.randint(init.num_starts, (2000,), generator=torch.Generator().manual_seed(0))
        torch.manual_seed(0)
        state = init.initial_state(frames)
        for key, base, half in (
            ("root_pos", reference.body_pos[frames, 0], torch.tensor([0.1, 0.0, 0.05])),
            ("joint_pos", reference.joint_pos[frames], torch.tensor([0.2])),
            ("object_pos", reference.object_pos[frames], torch.tensor([0.0, 0.1, 0.0])),
        ):
            off = state[key] - base
            assert (off.abs() <= half + 1e-6).all()
            close(off.std(0), (half / math.sqrt(3)).expand(off.shape[-1]), 0.01)  # of a uniform distribution
        close(state["joint_vel"], reference.joint_vel[frames])
        close(state["root_quat"].norm(dim=-1), torch.ones(2000), 1e-5)
        # only yaw was asked for: the root's vertical stays
        up = torch.tensor([0.0, 0.0, 1.0]).expand(2000, 3)
        close(quat_apply(state["root_quat"], up), quat_apply(reference.body_quat[frames, 0], up), 1e-5)

    def test_starts(self, reference):
        count = torch.Size([4000])
        torch.manual_seed(0)
        first = T.ReferenceStateInitialization(reference, g1.JOINT_RANGES, start="first").sample_frames(count, None)
        assert first.unique().tolist() == [0]
        frames = T.ReferenceStateInitialization(reference, g1.JOINT_RANGES, margin=50).sample_frames(count, None)
        assert frames.min() == 0
        assert frames.max() == reference.num_frames - 51
        assert (
            T.ReferenceStateInitialization(reference, g1.JOINT_RANGES, margin=10**6).sample_frames(count, None).max()
            == 0
        )

    def test_errors_name_the_value(self, reference):
        with pytest.raises(ValueError, match=r"reset\.noise: unknown \['root_color'\]"):
            T.ReferenceStateInitialization(reference, g1.JOINT_RANGES, noise={"root_color": 1.0})
        with pytest.raises(ValueError, match=r"reset\.start.*'last'"):
            T.ReferenceStateInitialization(reference, g1.JOINT_RANGES, start="last")


class TestAdaptiveStateInitialization:
    def shares(self, init) -> Tensor:
        torch.manual_seed(0)
        frames = init.sample_frames(torch.Size([20000]), None)
        assert frames.min() >= 0
        assert frames.max() < init.num_starts
        bins = len(init.failures)
        return torch.bincount(frames * bins // init.num_starts, minlength=bins) / len(frames)

    def make(self, reference, **kwargs):
        # 300 frames: with 10 bins and this margin, 29 frames to a bin
        return T.AdaptiveStateInitialization(reference, g1.JOINT_RANGES, margin=10, bins=10, **({"lead": 0} | kwargs))

    def fail_at(self, init, *frames: int, terminated: bool = True) -> None:
        n = len(frames)
        step = torch.tensor(frames).unsqueeze(-1)
        ended = TensorDict({"ref": {"step": step}, "terminated": torch.full((n, 1), terminated)}, batch_size=[n])
        init._reset_env_preprocess(ended)

    def test_uniform_at_the_start(self, reference):
        close(self.shares(self.make(reference)), [0.1] * 10, 0.015)

    def test_failures_raise_the_share_of_their_bin(self, reference):
        init = self.make(reference, uniform_share=0.4)
        self.fail_at(init, 70, 60, 75)  # all in bin 2
        expected = torch.full((10,), 0.04)
        expected[2] += 0.6
        close(self.shares(init), expected, 0.015)

    def test_lead_moves_the_start_ahead_of_the_failure(self, reference):
        init = self.make(reference, lead=29)
        self.fail_at(init, 70, 5)
        assert init.failures.nonzero().flatten().tolist() == [0, 1]

    def test_only_terminations_count_and_old_ones_fade(self, reference):
        init = self.make(reference, decay=0.5)
        self.fail_at(init, 70, terminated=False)
        assert init.failures.sum() == 0
        self.fail_at(init, 70)
        self.fail_at(init, 299)  # beyond the last start: in the last bin
        close(init.failures[[2, 9]], [0.5, 1.0])


class TestRewind:
    def rewound(self, step: int, failed: bool = True, n: int = 500, **kwargs) -> Tensor:
        """Frames after n episodes that ended at a step; -1 where one is to be drawn. [n]"""
        ended = {"terminated": torch.full((n, 1), failed), "ref": {"step": torch.full((n, 1), step)}}
        out = T.Rewind(**kwargs)._reset_env_preprocess(TensorDict(ended, batch_size=[n]))
        return out["init", "rewind_frame"].squeeze(-1)

    def test_goes_back_by_each_number_of_steps(self):
        assert self.rewound(100, share=1.0, steps=(5, 9)).unique().tolist() == [91, 92, 93, 94, 95]

    def test_not_before_the_first_frame(self):
        assert self.rewound(6, share=1.0, steps=(5, 9)).unique().tolist() == [0, 1]

    @pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
    def test_share(self, share):
        chosen = self.rewound(100, n=4000, share=share) >= 0
        assert float(chosen.float().mean()) == pytest.approx(share, abs=0.03 if share == 0.3 else 0.0)

    def test_what_did_not_fail_is_left_to_be_drawn(self):
        assert self.rewound(100, failed=False, share=1.0).unique().tolist() == [-1]

    def test_nothing_to_do_in_the_first_reset(self):
        assert T.Rewind()._reset_env_preprocess(None) is None
        empty = TensorDict({}, batch_size=[3])
        assert T.Rewind()._reset_env_preprocess(empty).is_empty()

    @pytest.mark.parametrize("steps", [(-1, 5), (9, 5)])
    def test_bad_steps(self, steps):
        with pytest.raises(ValueError, match=r"rewind: steps: expected 0 <= least <= most, got \["):
            T.Rewind(steps=steps)

    @pytest.mark.parametrize("share", [-0.1, 1.5])
    def test_bad_share(self, share):
        with pytest.raises(ValueError, match=rf"rewind: share: expected 0 to 1, got {share}"):
            T.Rewind(share=share)

    def test_starts_are_there_unless_they_are_to_be_drawn(self, reference):
        start = T.ReferenceStateInitialization(reference, g1.JOINT_RANGES, start=7, margin=20)
        asked = TensorDict({"init": {"rewind_frame": torch.tensor([[-1], [0], [60], [299]])}}, batch_size=[4])
        init = start._reset_env_preprocess(asked.clone())["init"]
        last = reference.num_frames - 21  # no episode starts in the margin
        assert init["frame"].flatten().tolist() == [7, 0, 60, last]
        close(init["root_pos"], reference.body_pos[[7, 0, 60, last], 0])
        asked["init", "frame"] = torch.tensor([[1], [2], [3], [4]])  # of a start that is drawn again
        assert start._reset_env_preprocess(asked)["init", "frame"].flatten().tolist() == [1, 2, 3, 4]

    @pytest.mark.parametrize("redraws", [0, 1, 4])
    @pytest.mark.parametrize("cls", [RowResetEnv, MaskedResetEnv])
    def test_in_environments_that_draw_again(self, reference, cls: type[ResetEnv], redraws: int):
        """Every start counts as too deep, so that all are drawn again as often as may be."""
        scene = lift_box().scene
        clock = T.MotionReference(reference, ["pelvis"], ["waist_.*"], g1.BODY_NAMES, g1.JOINT_NAMES)
        start = T.ReferenceStateInitialization(reference, g1.JOINT_RANGES, start=20)
        stack = Compose(start, T.Rewind(share=1.0, steps=(4, 6)), clock)
        base = HumanoidObjectEnv(scene, 4, lambda m, n: BatchBackend(m, n, 1))
        env = cls(base, stack, max_penetration=-1.0, redraws=redraws)
        td = env.reset()
        for _ in range(3):
            td = env.step_mdp(env.step(td.set("action", td["robot", "joint_pos"])))
        assert td["ref", "step"].flatten().tolist() == [23] * 4
        td["done"][:3] = td["terminated"][:2] = True  # two have failed, one is complete, one goes on
        before = env.num_redrawn
        after = env.maybe_reset(td)
        frames = after["ref", "step"].flatten()
        assert all(17 <= frame <= 19 for frame in frames[:2])
        assert frames[2:].tolist() == [20, 23]
        assert env.num_redrawn - before == 3 * redraws
        close(after["robot", "root_pos"][:3], reference.body_pos[frames[:3], 0], 1e-5)
        close(after["ref", "joint_pos"], reference.joint_pos[frames])


class TestResetNoiseCurriculum:
    def env(self, reference, **kwargs) -> ResetEnv:
        clock = T.MotionReference(reference, ["pelvis"], ["waist_.*"], g1.BODY_NAMES, g1.JOINT_NAMES)
        start = T.ReferenceStateInitialization(reference, g1.JOINT_RANGES, start=20, noise={"root_lin_vel": 2.0})
        base = HumanoidObjectEnv(lift_box().scene, 50, lambda m, n: BatchBackend(m, n, 1))
        return RowResetEnv(
            base, Compose(start, T.ResetNoiseCurriculum(**kwargs), clock), max_penetration=1.0, redraws=1
        )

    def test_perturbations_grow_with_the_steps(self, reference):
        env = self.env(reference, total_steps=8, start=0.25, hold=0.25, grow=0.5)
        largest = []
        for _ in range(8):
            td = env.reset()
            largest.append(float((td["robot", "root_lin_vel"] - reference.body_lin_vel[20, 0]).abs().max()))
            env.step(td.set("action", td["robot", "joint_pos"]))
        close(torch.tensor(largest), 2.0 * torch.tensor([0.25, 0.25, 0.25, 0.4375, 0.625, 0.8125, 1.0, 1.0]), 0.1)

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ({"start": 1.5}, "start: expected a share from 0"),
            ({"grow": 0.0}, "grow: expected parts of the training"),
            ({"hold": 0.6, "grow": 0.6}, "at most 1 together, got 0.6, 0.6"),
        ],
    )
    def test_bad_shares(self, given, message):
        with pytest.raises(ValueError, match=message):
            T.ResetNoiseCurriculum(10, **given)


class TestMotionEnd:
    def test_truncates_at_the_last_frame(self):
        steps = torch.tensor([0, 1, 2, 3, 3]).reshape(-1, 1, 1)
        env = wrap(ScriptedEnv({("ref", "step"): steps}), T.MotionEnd(SimpleNamespace(num_frames=4)))
        out = drive(env, 4)
        assert next_of(out, "truncated").flatten().tolist() == [False, False, True, True]
        assert next_of(out, "done").flatten().tolist() == [False, False, True, True]
        assert not next_of(out, "terminated").any()
        assert next_of(out, "completed").flatten().tolist() == [False, False, True, True]

    def test_not_completed_when_terminated(self):
        steps = torch.tensor([0, 1, 2]).reshape(-1, 1, 1)
        env = wrap(ScriptedEnv({("ref", "step"): steps}, episode_steps=2), T.MotionEnd(SimpleNamespace(num_frames=3)))
        last = drive(env, 2)[-1]["next"]
        assert (bool(last["truncated"]), bool(last["terminated"]), bool(last["completed"])) == (True, True, False)


# -- action -----------------------------------------------------------------------------------------------------------


class TestJointPositionAction:
    def test_scatter_and_scale(self):
        names = ("hip_joint", "wrist_joint", "knee_joint")
        action = T.JointPositionAction({"knee_joint": 0.5, "hip_.*": 2.0}, names)
        td = TensorDict({"action": torch.tensor([[1.0, 3.0]])}, batch_size=[1])
        out = action.inv(td)
        close(out["action"], [[2.0, 0.0, 1.5]])
        close(out["policy_action"], [[1.0, 3.0]])
        close(td["action"], [[1.0, 3.0]])

    def test_defaults_follow_the_robot(self):
        action = T.JointPositionAction({".*_knee_joint": 0.35}, g1.JOINT_NAMES)
        knees = [g1.JOINT_NAMES.index(f"{side}_knee_joint") for side in ("left", "right")]
        assert action.index.tolist() == sorted(knees)
        env = wrap(ScriptedEnv(make_script([], 2), action_size=29), action)
        assert env.action_spec.shape == (2, 2)

    def test_unknown_joint(self):
        with pytest.raises(ValueError, match="tail_joint"):
            T.JointPositionAction({"tail_joint": 1.0}, g1.JOINT_NAMES)


def test_residual_is_added_to_the_reference_of_the_present_step():
    base = torch.arange(5.0).reshape(-1, 1, 1).expand(5, 1, 4).clone()
    env = wrap(ScriptedEnv({("ref", "joint_pos"): base}), T.ResidualAction())
    td = env.reset()
    for t in range(3):
        td = env.step(td.set("action", torch.full((1, 4), 0.5)))
        close(env.base_env.received, [[t + 0.5] * 4])
        td = env.step_mdp(td)


class TestFeedForwardTarget:
    def stack(self, reference, start: int, base_key: str) -> list:
        robot, torque = lift_box().scene.robot, lift_box().joint_torque
        servos = robot.stiffness, robot.damping, robot.effort_limits
        return [
            T.ReferenceStateInitialization(reference, g1.JOINT_RANGES, start=start),
            T.MotionReference(reference, ["pelvis"], ["waist_.*"], g1.BODY_NAMES, g1.JOINT_NAMES),
            T.FeedForwardTarget(reference, torque, *servos, effort=1.0),
            T.ResidualAction(("ref", base_key)),
        ]

    @pytest.mark.parametrize("frame", [0, 90, 150])
    def test_servos_on_the_reference_give_its_torque(self, reference, frame):
        scene = lift_box().scene
        env = physics(1, *self.stack(reference, frame, "joint_target"))
        start = env.reset()
        env.step(start.clone().set("action", torch.zeros(1, 29)))
        close(env.base_env.backend.data("ctrl")[0].float(), start["ref", "joint_target"][0])
        env.reset()
        model, data = env.base_env.backend.world(0)
        data.ctrl[:] = start["ref", "joint_target"][0].numpy()
        mujoco.mj_forward(model, data)
        torque = torch.from_numpy(data.qfrc_actuator + data.qfrc_passive)[scene.joint_dof].float()
        limit = torch.tensor(scene.robot.effort_limits)
        wanted = lift_box().joint_torque(0.5)[frame]
        assert wanted.abs().max() > 10
        close(torque, wanted.clamp(-limit, limit), 0.01)

    def test_the_robot_gives_way_less(self, reference):
        """Under a policy that does nothing."""

        def error(base_key: str) -> float:
            env = physics(1, *self.stack(reference, 0, base_key))
            step = drive(env, 25, lambda _: torch.zeros(1, 29))[-1]["next"]
            return float((step["robot", "joint_pos"] - step["ref", "joint_pos"]).norm())

        assert error("joint_target") < 0.5 * error("joint_pos")

    def test_targets_of_the_motion_take_precedence(self, reference):
        def unwanted() -> Tensor:
            raise AssertionError("computed for nothing")

        own = replace(reference, joint_target=reference.joint_pos + 0.1)
        ahead = T.FeedForwardTarget(own, unwanted, [1.0] * 29, [1.0] * 29, [1.0] * 29)
        found = ahead(TensorDict({"ref": {"step": torch.tensor([[3], [0]])}}, batch_size=[2]))["ref", "joint_target"]
        close(found, own.joint_target[[3, 0]])

    def test_effort_is_what_torques_are_clipped_to(self, reference):
        servos = {"servo_stiffness": [100.0] * 29, "servo_damping": [0.0] * 29, "effort_limits": [50.0] * 29}
        torque = torch.full_like(reference.joint_pos, 45.0)
        for effort, ahead in ((1.0, 0.45), (0.8, 0.4), (0.0, 0.0)):
            term = T.FeedForwardTarget(reference, lambda grip: torque, **servos, effort=effort)
            close(term.targets, reference.joint_pos + ahead)
        for effort in (-0.1, 1.1):
            with pytest.raises(ValueError, match=f"effort: expected a share from 0 to 1, got {effort}"):
                T.FeedForwardTarget(reference, torque, **servos, effort=effort)

    def test_torques_are_of_its_grip(self, reference):
        servos = {"servo_stiffness": [100.0] * 29, "servo_damping": [0.0] * 29, "effort_limits": [50.0] * 29}
        torque = torch.full_like(reference.joint_pos, 10.0)
        for options, ahead in (({}, 0.05), ({"grip": 0.25}, 0.025)):
            term = T.FeedForwardTarget(reference, lambda grip: grip * torque, **servos, **options)
            close(term.targets, reference.joint_pos + ahead)
        with pytest.raises(ValueError, match=r"grip: expected a share above 0, at most 1, got 0"):
            T.FeedForwardTarget(reference, torque, **servos, grip=0)

    def test_lead_is_how_far_ahead_they_are(self, reference):
        servos = {"servo_stiffness": [100.0] * 29, "servo_damping": [0.0] * 29, "effort_limits": [50.0] * 29}
        pos = torch.arange(5.0)[:, None].square().expand(5, 29)  # 0, 1, 4, 9, 16
        moved = replace(reference, joint_pos=pos, joint_vel=torch.zeros(5, 29))
        for lead, expected in ((0.0, [0, 1, 4, 9, 16]), (0.03, [2.5, 6.5, 12.5, 16, 16]), (0.04, [4, 9, 16, 16, 16])):
            term = T.FeedForwardTarget(moved, torch.zeros(5, 29), **servos, lead=lead, control_dt=0.02)
            close(term.targets[:, 0], torch.tensor(expected))
        own = replace(reference, joint_target=reference.joint_pos)  # what was sent was sent in time
        close(T.FeedForwardTarget(own, torch.zeros(1), **servos, lead=0.03).targets, reference.joint_pos)
        with pytest.raises(ValueError, match=r"lead: expected seconds, not below 0, got -0\.01"):
            T.FeedForwardTarget(moved, torch.zeros(5, 29), **servos, lead=-0.01)


class TestSpringAssist:
    def env(self, reference, *bodies: str, start: int = 0, **kwargs):
        """The embedded scene with springs of 2 Hz, starting at a frame."""
        given = {"robot_mass": g1.TOTAL_MASS, "total_steps": 1000, "frequency": 2.0, "max_acceleration": 1e3} | kwargs
        clock = T.MotionReference(reference, ["pelvis"], ["waist_.*"], g1.BODY_NAMES, g1.JOINT_NAMES)
        springs = [T.SpringAssist(reference, body=body, **given) for body in bodies]
        start = T.ReferenceStateInitialization(reference, g1.JOINT_RANGES, start=start)
        return physics(1, start, clock, T.ResidualAction(), *springs)

    def here(self, reference, frame: int = 100, **off: list[float]) -> TensorDict:
        """The root where the next frame has it, but for some offsets."""
        parts = ("root_pos", "root_lin_vel", "root_ang_vel")
        goal = (reference.body_pos, reference.body_lin_vel, reference.body_ang_vel)
        root = {
            key: value[frame + 1 : frame + 2, 0] - torch.tensor(off.get(key, [0.0, 0.0, 0.0]))
            for key, value in zip(parts, goal, strict=True)
        }
        turn = quat_from_euler(torch.tensor([off.get("root_rpy", [0.0, 0.0, 0.0])]))
        root["root_quat"] = quat_multiply(turn, reference.body_quat[frame + 1 : frame + 2, 0])
        return TensorDict({"ref": {"step": torch.tensor([[frame]])}, "robot": root}, batch_size=[1])

    def test_by_hand(self, reference):
        spring = T.SpringAssist(
            reference, robot_mass=4.0, total_steps=10, frequency=1 / math.pi, radius=0.5, max_acceleration=1e3
        )  # 2 rad/s

        def wrench(**off: list[float]) -> Tensor:
            return spring.inv(self.here(reference, **off))["wrench", "root"][0]

        close(wrench(), torch.zeros(6), 1e-4)
        close(wrench(root_pos=[0.1, 0.0, 0.2]), [1.6, 0, 3.2, 0, 0, 0], 1e-4)  # 4 kg times 4 / s^2
        close(wrench(root_lin_vel=[0.0, -0.5, 0.0]), [0, -8, 0, 0, 0, 0], 1e-4)  # 4 kg times 4 / s
        close(wrench(root_rpy=[0.0, 0.0, 0.3]), [0, 0, 0, 0, 0, -1.2], 1e-4)  # 1 kg m^2 times 4 / s^2, back
        close(wrench(root_ang_vel=[0.5, 0.0, 0.0]), [0, 0, 0, 2, 0, 0], 1e-4)

    def test_is_limited(self, reference):
        spring = T.SpringAssist(reference, robot_mass=4.0, total_steps=10, radius=0.5, max_acceleration=2.0)
        far = spring.inv(self.here(reference, root_pos=[3.0, 4.0, 0.0], root_rpy=[0.0, 2.0, 0.0]))["wrench", "root"][0]
        close(far[:3], [4.8, 6.4, 0.0], 1e-3)  # 4 kg times 2 m/s^2, its direction kept
        close(far[3:].norm(), 4.0, 1e-3)  # half a metre of that

    def test_fades_to_nothing_with_the_steps_taken(self, reference):
        env = self.env(reference, "root", total_steps=8, fade=0.5)
        spring = env.transform[-1]
        left = [float(spring.strength)]
        for _ in range(6):
            drive(env, 1, lambda _: torch.zeros(1, 29))  # resets do not count, nor start it anew
            left.append(float(spring.strength))
        assert left == [1.0, 0.75, 0.5, 0.25, 0.0, 0.0, 0.0]
        away = self.here(reference, root_pos=[1.0, 0.0, 0.0])
        assert not spring.inv(away)["wrench", "root"].any()
        spring.steps.fill_(1)
        close(spring.strength, 0.75)

    def test_of_a_training_of_no_step_lasts_one(self, reference):
        spring = T.SpringAssist(reference, robot_mass=1.0, total_steps=0)
        close(spring.strength, 1.0)
        spring.steps += 1
        close(spring.strength, 0.0)

    @pytest.mark.parametrize("body", ["root", "object"])
    def test_pulls_to_the_reference(self, reference, body):
        """In MuJoCo: what starts beside the reference's comes nearer, as a critically damped spring does."""
        key = ("robot", "root_pos") if body == "root" else ("object", "pos")
        goal = reference.body_pos[:, 0] if body == "root" else reference.object_pos
        at = 0 if body == "root" else lift_box().scene.object_free_qpos
        gaps = {}
        for bodies in ((), (body,)):
            env = self.env(reference, *bodies)
            td = env.reset()
            env.base_env.backend.data("qpos")[:, at : at + 3] += torch.tensor([0.0, 0.3, 0.3])
            env.base_env.backend.refresh(torch.arange(1))
            td.update(env.base_env._state(slice(None)))
            step = drive(env, 20, lambda _: torch.zeros(1, 29), td)[-1]["next"]
            gaps[bodies] = float((step.get(key)[0] - goal[20])[:2].norm())
        # (1 + w t) exp(-w t) of the gap is left after 0.4 s at 2 Hz: 4 %
        assert gaps[(body,)] < 0.25 * gaps[()]

    def test_both(self, reference):
        env = self.env(reference, "root", "object")
        check_env_specs(env)
        sent = env.transform.inv(env.reset().set("action", torch.zeros(1, 29)))["wrench"]
        assert set(sent.keys()) == {"root", "object"}

    def test_the_count_goes_with_the_state(self, reference):
        first, second = (self.env(reference, "root") for _ in range(2))
        drive(first, 3, lambda _: torch.zeros(1, 29))
        second.transform.load_state_dict(first.transform.state_dict())
        assert float(second.transform[-1].steps) == 3
        assert float(second.transform[-1].strength) == pytest.approx(1 - 3 / 500)

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ({"body": "left_hand"}, "assist: body: expected 'root' or 'object', got 'left_hand'"),
            ({"fade": 0.0}, "assist: fade: expected a share of the training, above 0 and up to 1, got 0.0"),
            ({"fade": 1.5}, "assist: fade: .* got 1.5"),
            ({"body": "object", "object_free": False}, "motion 'lift_box' has no object that can be pulled"),
        ],
    )
    def test_refusals(self, reference, given, message):
        with pytest.raises(ValueError, match=message):
            T.SpringAssist(reference, robot_mass=1.0, total_steps=10, **given)

    def test_reads_what_nothing_writes(self, reference):
        spring = T.SpringAssist(reference, robot_mass=1.0, total_steps=10)
        with pytest.raises(KeyError, match=r"SpringAssist: reads \('ref', 'step'\), which nothing before it writes"):
            wrap(blank(2), spring).full_state_spec  # noqa: B018


def test_default_pose_is_the_robots_unless_given():
    zero = TensorDict({"action": torch.zeros(1, 29)}, batch_size=[1])
    close(
        T.DefaultPoseAction(default_joint_pos()).inv(zero)["action"][0],
        torch.as_tensor(default_joint_pos(), dtype=torch.float32),
    )
    one = TensorDict({"action": torch.ones(1, 2)}, batch_size=[1])
    close(T.DefaultPoseAction([0.5, -0.5]).inv(one)["action"], [[1.5, 0.5]])


class TestActionSmoothing:
    def test_formula(self):
        """x_0 = u_0, then x_t = 0.25 u_t + 0.75 x_(t-1)."""
        env = wrap(blank(), T.ActionSmoothing(alpha=(0.25, 0.25), size=4))
        td, received = env.reset(), []
        for value in (4.0, 0.0, 8.0):
            td = env.step_mdp(env.step(td.set("action", torch.full((1, 4), value))))
            received.append(float(env.base_env.received[0, 0]))
        assert received == [4.0, 3.0, 4.25]

    def test_alpha_is_drawn_per_episode_within_its_range(self):
        env = wrap(blank(200), T.ActionSmoothing(alpha=(0.6, 0.9), size=4))
        torch.manual_seed(0)
        alpha = env.reset()["smoothing", "action", "alpha"]
        assert 0.6 <= alpha.min() < 0.65
        assert 0.85 < alpha.max() <= 0.9

    @pytest.mark.parametrize("alpha", [(0.9, 0.8), (0.0, 1.0), (0.5, 1.5)])
    def test_bad_range(self, alpha):
        with pytest.raises(ValueError, match=r"action\.smoothing\.alpha"):
            T.ActionSmoothing(alpha=alpha)


# age in control steps of the target of each of the four physics steps: ceil((d - k) / 4), not below 0
AGES = {
    0: (0, 0, 0, 0),
    1: (1, 0, 0, 0),
    2: (1, 1, 0, 0),
    3: (1, 1, 1, 0),
    4: (1, 1, 1, 1),
    5: (2, 1, 1, 1),
    6: (2, 2, 1, 1),
}


class TestActionDelay:
    @pytest.mark.parametrize("delay", AGES)
    def test_which_target_each_physics_step_uses(self, delay):
        env = wrap(blank(2), T.ActionDelay((delay, delay), decimation=4, size=4))
        td = env.reset()
        for t in range(5):
            td = env.step_mdp(env.step(td.set("action", torch.full((2, 4), float(t)))))
            assert env.base_env.received.shape == (2, 4, 4)
            # before the first target arrives, the first target
            expected = [float(max(t - age, 0)) for age in AGES[delay]]
            assert env.base_env.received[1, :, 2].tolist() == expected
            assert AGES[delay] == tuple(max(math.ceil((delay - k) / 4), 0) for k in range(4))

    def test_all_delays_of_the_range_are_drawn(self):
        env = wrap(blank(300), T.ActionDelay((2, 6), decimation=4, size=4))
        torch.manual_seed(0)
        assert env.reset()["delay", "action", "substeps"].unique().tolist() == [2, 3, 4, 5, 6]

    def test_a_new_episode_forgets(self):
        env = wrap(blank(2), T.ActionDelay((4, 4), decimation=4, size=4))
        td = env.step_mdp(drive(env, 3, lambda t: torch.full((2, 4), float(t)))[-1])
        td = env.reset(td.set("_reset", torch.tensor([True, False])))
        env.step(td.set("action", torch.full((2, 4), 9.0)))
        assert env.base_env.received[:, 0, 0].tolist() == [9.0, 2.0]

    def test_delays_act_in_physics(self):
        """One second of delay: the first step holds the first target, like no delay."""
        env = physics(1, T.ActionDelay((4, 4), decimation=4))
        pose = torch.as_tensor(default_joint_pos(), dtype=torch.float32).unsqueeze(0)
        targets = [pose, pose + 0.1, pose + 0.2]
        steps = drive(env, 3, lambda t: targets[t])
        close(next_of(steps, ("robot", "joint_target")), torch.stack([targets[0], targets[0], targets[1]]), 1e-6)

    @pytest.mark.parametrize("substeps", [(6, 2), (-1, 2)])
    def test_bad_range(self, substeps):
        with pytest.raises(ValueError, match=r"action\.delay\.substeps"):
            T.ActionDelay(substeps, 4)


def test_action_history():
    env = wrap(blank(), T.JointPositionAction({".*": 2.0}, list("abcd")), T.ActionHistory(3, 4))
    start = env.reset()
    close(start["action_history"], torch.zeros(1, 3, 4))
    steps = drive(env, 4, lambda t: torch.full((1, 4), t + 1.0), start=start)
    # of the policy, before its scale
    assert next_of(steps, "action_history")[:, 0, :, 0].tolist() == [[1, 0, 0], [2, 1, 0], [3, 2, 1], [4, 3, 2]]


# -- tracking ---------------------------------------------------------------------------------------------------------


def test_feet_state():
    """The left foot stands, is lifted for two steps and lands; the right one never leaves the ground."""
    left = torch.tensor([100.0, 100.0, 0.0, 1.0, 80.0, 80.0, 80.0])
    force = torch.zeros(7, 1, 2, 3)
    force[:, 0, 0, 2], force[:, 0, 1, 0] = left, 50.0
    env = wrap(ScriptedEnv({("robot", "foot_force"): force}), T.FeetState(0.02, force_threshold=5.0))
    start = env.reset()
    close(start["feet", "force"], force[0])
    close(start["feet", "previous_force"], force[0])
    steps = drive(env, 6, start=start)
    close(next_of(steps, ("feet", "air_time"))[:, 0, 0], [0, 0.02, 0.04, 0, 0, 0])
    assert next_of(steps, ("feet", "touchdown"))[:, 0, 0].tolist() == [False, False, False, True, False, False]
    # the swing lasted from the step that left the ground to the one that landed
    close(next_of(steps, ("feet", "swing_time"))[:, 0, 0], [0, 0, 0, 0.06, 0, 0])
    close(next_of(steps, ("feet", "force"))[:, 0, 0, 2], left[1:])
    close(next_of(steps, ("feet", "previous_force"))[:, 0, 0, 2], left[:-1])
    close(next_of(steps, ("feet", "air_time"))[:, 0, 1], torch.zeros(6))
    assert not next_of(steps, ("feet", "touchdown"))[:, 0, 1].any()


def test_contact_points_scale_with_the_object():
    effectors = [Effector(body="b", point=(0.0, 0.5, 0.0), target=(0, 0, 0))]
    transform = T.ContactPoints(effectors, body_names=("a", "b"))
    turn = quat_from_euler(torch.tensor([0.0, 0.0, math.pi / 2]))
    data = TensorDict(
        {
            "robot": {
                "body_pos": torch.tensor([[[9.0, 9, 9], [1.0, 2, 3]]]),
                "body_quat": torch.stack([torch.tensor([1.0, 0, 0, 0]), turn])[None],
            },
            "object": {
                "link_pos": torch.tensor([[5.0, 0, 0]]),
                "link_quat": turn[None],
                "scale": torch.tensor([[2.0]]),
            },
            "ref": {"contact_point": torch.tensor([[[0.1, 0.0, 0.3]]])},
        },
        batch_size=[1],
    )
    out = transform(data)
    close(out["contact", "eef_pos"], [[[0.5, 2.0, 3.0]]])  # a quarter turn takes y to -x
    close(out["contact", "target_pos"], [[[5.0, 0.2, 0.6]]])


def test_contact_made():
    data = TensorDict(
        {
            "contact": {"force": torch.tensor([[[0.0, 0.6, 0.8], [0.9, 0.0, 0.0], [9.0, 0, 0]]])},
            "ref": {"contact": torch.tensor([[True, True, False]])},
        },
        batch_size=[1],
    )
    out = T.ContactMade(min_force=1.0)(data)
    close(out["contact", "made"], [[1.0, 0.0, 0.0]])
    close(out["contact", "intended"], [[1.0, 1.0, 0.0]])


def test_tracked_bodies():
    """A body 1 m ahead of a root that looks along y: ahead in the root's frame, at the same height."""
    turn = quat_from_euler(torch.tensor([0.0, 0.0, math.pi / 2]))
    tilt = quat_from_euler(torch.tensor([0.3, 0.0, 0.0]))
    pos = torch.tensor([[[0.0, 0, 0], [2.0, 4.0, 1.5]]])
    data = TensorDict(
        {
            "robot": {
                "body_pos": pos,
                "body_quat": torch.stack([turn, turn])[None],
                "body_lin_vel": pos,
                "body_ang_vel": pos,
                "root_pos": torch.tensor([[2.0, 3.0, 0.7]]),
                "root_quat": quat_multiply(turn, tilt)[None],  # roll does not matter
            }
        },
        batch_size=[1],
    )
    out = T.TrackedBodies(["b"], ("a", "b"))(data)["tracked"]
    close(out["body_pos"], [[[2.0, 4.0, 1.5]]])
    close(out["body_pos_local"], [[[1.0, 0.0, 1.5]]])
    close(out["body_quat_local"].abs(), [[[1.0, 0, 0, 0]]])
    assert out["body_lin_vel"].shape == (1, 1, 3)


def test_errors():
    half = quat_from_euler(torch.tensor([0.0, 0.0, 0.5]))
    one = torch.tensor([1.0, 0, 0, 0])
    data = TensorDict(
        {
            "p": torch.tensor([[3.0, 4.0, 0.0]]),
            "q": torch.zeros(1, 3),
            "a": half[None],
            "b": -one[None],  # the same orientation as one
            "ps": torch.tensor([[[1.0, 0, 0], [0.0, 2.0, 0]]]),
            "qs": torch.zeros(1, 2, 3),
            "j": torch.tensor([[1.0, -2.0, 3.0]]),
            "k": torch.tensor([[0.0, 1.0, 1.0]]),
        },
        batch_size=[1],
    )
    T.Distance("p", "q", "distance")(data)
    T.Distance("ps", "qs", "distances")(data)
    T.Angle("a", "b", "angle")(data)
    T.AbsoluteDifference("j", "k", "all")(data)
    T.JointErrors("j", "k", "some", ["hip", "toe"], ("hip", "knee", "toe"))(data)
    close(data["distance"], [[5.0]])
    close(data["distances"], [[1.0, 2.0]])
    close(data["angle"], [[0.5]], 1e-5)
    close(data["all"], [[1.0, 3.0, 2.0]])
    close(data["some"], [[1.0, 2.0]])
    metrics = T.Metrics({"joints": "all", "left_out": None, "bodies": ["distances"]})(data)["metrics"]
    close(metrics["joints"], [[2.0]])
    close(metrics["bodies"], [[1.5]])
    assert set(metrics.keys()) == {"joints", "bodies"}


# -- observation ------------------------------------------------------------------------------------------------------


class TestHistory:
    def test_newest_first_and_the_first_fills_the_past(self):
        env = wrap(ScriptedEnv({X: table([1, 2, 3, 4])}), T.History(X, 2))
        start = env.reset()
        close(start[X], [[1.0, 1, 1]])
        close(next_of(drive(env, 3, start=start), X)[:, 0], [[2, 1, 1], [3, 2, 1], [4, 3, 2]])

    def test_noise_before_it_is_kept_as_it_was_seen(self):
        env = wrap(ScriptedEnv({X: table([0] * 4)}), T.UniformNoise(X, 1.0), T.History(X, 1))
        torch.manual_seed(0)
        seen = next_of(drive(env, 3), X)[:, 0]
        close(seen[1:, 1], seen[:-1, 0])
        assert len(seen[:, 0].unique()) == 3

    def test_steps(self):
        with pytest.raises(ValueError, match="history"):
            T.History(X, 0)


def test_episode_noise_is_constant_over_an_episode_and_drawn_anew():
    env = wrap(ScriptedEnv({X: torch.zeros(6, 500, 2)}), T.EpisodeNoise(X, 0.2))
    torch.manual_seed(0)
    start = env.reset()
    offset = start[X].clone()
    assert (offset.abs() <= 0.2).all()
    close(offset.std(0), [0.2 / math.sqrt(3)] * 2, 0.01)
    for step in drive(env, 3, start=start):
        close(step["next", *X], offset)
    assert not torch.isclose(env.reset()[X], offset).all(-1).any()


def test_uniform_noise():
    data = TensorDict({"x": torch.ones(4000, 3)}, batch_size=[4000])
    torch.manual_seed(0)
    scale = torch.tensor([0.0, 0.1, 2.0])
    off = T.UniformNoise("x", scale.tolist())(data)["x"] - 1
    assert (off.abs() <= scale + 1e-6).all()
    close(off.std(0), scale / math.sqrt(3), 0.03)
    close(off.mean(0), [0.0, 0.0, 0.0], 0.05)


def test_heading_noise_turns_about_the_vertical():
    columns = quat_apply(
        quat_from_euler(torch.tensor([0.3, -0.4, 1.0])).expand(2, 4), torch.eye(3)[:2]
    )  # of a rotation matrix
    pose = torch.cat([torch.tensor([1.0, 2.0, 3.0]), columns.flatten()]).expand(300, 9)
    torch.manual_seed(0)
    out = T.HeadingNoise("pose", 0.2)(TensorDict({"pose": pose.clone()}, batch_size=[300]))["pose"]
    turned = out[:, 3:].reshape(300, 2, 3)
    close(out[:, :3], pose[:, :3])
    close(turned[..., 2], columns[:, 2].expand(300, 2))
    close(turned.norm(dim=-1), torch.ones(300, 2), 1e-5)
    angle = torch.atan2(turned[..., 1], turned[..., 0]) - torch.atan2(columns[:, 1], columns[:, 0])
    close(angle[:, 0], angle[:, 1], 1e-5)
    assert 0.15 < angle.abs().max() <= 0.2 + 1e-5


class TestFrames:
    torch.manual_seed(0)
    root_quat = quat_from_euler(torch.tensor([[0.2, -0.3, 1.0]]))
    quat = quat_from_euler(torch.tensor([[1.0, 0.1, -2.0]]))
    root_pos, pos = torch.tensor([[1.0, 2.0, 0.8]]), torch.tensor([[1.5, 1.0, 0.4]])

    def observe(self, move: Tensor, shift: Tensor) -> TensorDict:
        """Everything moved by one rigid motion."""

        def at(point: Tensor) -> Tensor:
            return quat_apply(move.expand(len(point), 4), point) + shift

        data = TensorDict(
            {
                "robot": {"root_pos": at(self.root_pos), "root_quat": quat_multiply(move[None], self.root_quat)},
                "pos": at(self.pos),
                "quat": quat_multiply(move[None], self.quat),
                "points": torch.stack([at(self.pos), at(self.root_pos)], 1),
                "velocity": quat_apply(move[None], self.pos),
            },
            batch_size=[1],
        )
        T.PoseInRoot("pos", "quat", "pose")(data)
        T.PointInRoot("points", "points_in_root")(data)
        T.VectorInRoot("velocity", "velocity_in_root")(data)
        return data.select("pose", "points_in_root", "velocity_in_root")

    def test_moving_the_entire_scene_changes_nothing(self):
        still = self.observe(torch.tensor([1.0, 0, 0, 0]), torch.zeros(3))
        moved = self.observe(quat_from_euler(torch.tensor([0.5, 1.0, -2.5])), torch.tensor([3.0, -7.0, 2.0]))
        for key in ("pose", "points_in_root", "velocity_in_root"):
            close(moved[key], still[key], 1e-5)
        assert still["pose"].shape == (1, 9)
        close(still["points_in_root"][:, 3:], torch.zeros(1, 3), 1e-5)  # the root itself
        close(still["points_in_root"][:, :3], still["pose"][:, :3])

    def test_by_hand(self):
        """Root at (1, 0, 0), looking along y; an object 2 m along y, turned like the root, is 2 m ahead."""
        turn = quat_from_euler(torch.tensor([[0.0, 0.0, math.pi / 2]]))
        root = torch.tensor([[1.0, 0.0, 0.0]])
        data = TensorDict(
            {"robot": {"root_pos": root, "root_quat": turn}, "pos": torch.tensor([[1.0, 2.0, 0.0]]), "quat": turn},
            batch_size=[1],
        )
        close(T.PoseInRoot("pos", "quat", "pose")(data)["pose"], [[2.0, 0, 0, 1, 0, 0, 0, 1, 0]])
        # on its back, the robot feels gravity along -x of its root
        data["robot", "root_quat"] = quat_from_euler(torch.tensor([[0.0, -math.pi / 2, 0.0]]))
        close(T.ProjectedGravity("gravity")(data)["gravity"], [[-1.0, 0.0, 0.0]])

    def test_flat_features(self):
        data = TensorDict(
            {"a": torch.arange(6.0).reshape(1, 2, 3), "b": torch.ones(1, 2, 3), "flag": torch.tensor([[True, False]])},
            batch_size=[1],
        )
        close(T.Flatten("a", "flat")(data)["flat"], [[0.0, 1, 2, 3, 4, 5]])
        assert T.Flatten("flag", "flags")(data)["flags"].tolist() == [[1.0, 0.0]]
        close(T.Difference("a", "b", "off")(data)["off"], [[-1.0, 0, 1, 2, 3, 4]])
        data["joints"] = torch.tensor([[1.0, 2.0]])
        close(T.RelativeJointPos("relative", [0.5, 0.5], "joints")(data)["relative"], [[0.5, 1.5]])


# -- reward -----------------------------------------------------------------------------------------------------------

FORCE = torch.tensor([[0.0, 0, 100.0], [0.0, 0, 0]])
# transform, entries of the next step, unweighted term
TERMS = {
    "tracking": (
        lambda: T.TrackingReward("t", 2.0, ["a", "b"], [0.5, 1.0], [0.0, 0.5]),
        {"a": [0.25, 0.75], "b": [1.0]},  # mean 0.5 / 0.5; (1 - 0.5) / 1
        (E1 + math.exp(-0.5)) / 2,
    ),
    "interaction": (
        lambda: T.InteractionReward("t"),
        {
            ("contact", "eef_pos"): [[0.3, 0, 0], [0, 0, 0]],
            ("contact", "target_pos"): [[0.0, 0, 0], [0, 0, 0]],
            ("contact", "force"): [[50.0, 0, 0], [0, 2.0, 0]],  # enough, and 8 N short
            ("ref", "contact"): [True, True],
        },
        (E1 + math.exp(-0.2)) / 2,
    ),
    "survival": (lambda: T.SurvivalReward("t", 0.5), {}, 1.0),
    "action_rate": (
        lambda: T.ActionRateL2("t", -0.1),
        {"action_history": [[1.0, 2.0], [0.0, 4.0], [9.0, 9.0]]},
        5.0,
    ),
    "joint_pos_limits": (
        lambda: T.JointPosLimitsL1([(-2.0, 2.0), (0.0, 4.0)], "t", soft_limit=0.5),
        {("robot", "joint_pos"): [1.5, 0.25]},  # allowed: -1 to 1 and 1 to 3
        0.5 + 0.75,
    ),
    "joint_vel": (lambda: T.JointVelL2("t"), {("robot", "joint_vel"): [1.0, -2.0]}, 5.0),
    "joint_torque_limits": (
        lambda: T.JointTorqueLimitsL1([10.0, 20.0], "t", soft_limit=0.5),
        {("robot", "joint_torque"): [-8.0, 9.0]},
        3.0,
    ),
    "feet_impact": (
        lambda: T.FeetImpactL2(50.0 / 9.81, "t"),
        {("feet", "force"): FORCE, ("feet", "previous_force"): torch.zeros(2, 3)},
        4.0,
    ),
    "feet_slip": (
        lambda: T.FeetSlip(("l", "r"), ("a", "l", "r"), "t"),
        {("robot", "body_lin_vel"): [[9.0, 9, 9], [0.3, 0.4, 7.0], [1.0, 0, 0]], ("robot", "foot_force"): FORCE},
        0.5,
    ),
    "feet_stumble": (
        lambda: T.FeetStumble("t", ratio=2.0),
        {("robot", "foot_force"): [[6.0, 8.0, -4.0], [6.0, 8.0, 6.0]]},  # 10 N sideways against 8 N and 12 N
        1.0,
    ),
    "feet_air_time": (
        lambda: T.FeetAirTime("t", threshold=0.4),
        {("feet", "swing_time"): [0.1, 0.3], ("feet", "touchdown"): [True, False]},
        0.3,
    ),
}


@pytest.mark.parametrize("name", TERMS)
class TestRewardTerms:
    def env(self, name):
        make, entries, term = TERMS[name]
        script = {key: constant(value) for key, value in entries.items()}
        return script or make_script([]), make(), term

    def test_weighted_in_the_reward_and_raw_beside_it(self, name):
        script, transform, term = self.env(name)
        again = TERMS[name][0]()
        again.out_keys = [("reward_terms", "again")]
        step = drive(wrap(ScriptedEnv(script), transform, again), 1)[0]["next"]
        close(step["reward_terms", "t"][:1], [[term]], 1e-5)
        close(step["reward_terms", "again"][:1], [[term]], 1e-5)
        close(step["reward"][:1], [[2 * transform.weight * term]], 1e-4)

    def test_penalties_cost(self, name):
        _, transform, term = self.env(name)
        assert term > 0
        assert (transform.weight < 0) == (name not in ("tracking", "interaction", "survival"))

    def test_without_weight_it_is_logged_all_the_same(self, name):
        script, transform, term = self.env(name)
        transform.weight = 0.0
        step = drive(wrap(ScriptedEnv(script), transform), 1)[0]["next"]
        close(step["reward"][:1], [[0.0]])
        close(step["reward_terms", "t"][:1], [[term]], 1e-5)


def test_rewards_describe_the_state_after_the_step():
    env = wrap(ScriptedEnv({"e": table([0.0, 1.0, 3.0])}), T.TrackingReward("t", 1.0, ["e"], [1.0]))
    close(next_of(drive(env, 2), "reward").flatten(), [E1, math.exp(-3)])


def test_survival_stops_with_termination():
    env = wrap(ScriptedEnv(make_script([], 1), episode_steps=2), T.SurvivalReward(weight=2.0))
    close(next_of(drive(env, 2), "reward").flatten(), [2.0, 0.0])


def test_interaction_of_the_best_effector():
    entries = {key: constant(value) for key, value in TERMS["interaction"][1].items()}
    env = wrap(ScriptedEnv(entries), T.InteractionReward("t", reduce="max"))
    close(drive(env, 1)[0]["next", "reward_terms", "t"], [[math.exp(-0.2)]])
    with pytest.raises(ValueError, match="reduce"):
        T.InteractionReward(reduce="sum")


def test_tracking_refuses_unpaired_errors_and_sigmas():
    with pytest.raises(ValueError, match="'t'"):
        T.TrackingReward("t", 1.0, ["a", "b"], [1.0])
    with pytest.raises(ValueError, match="positive"):
        T.TrackingReward("t", 1.0, ["a"], [0.0])


class TestKernelReward:
    """A row of the table that is config alone."""

    def test_a_kernel_of_ones_own(self):
        def near(a, b, *, reach):
            return (reach - (a - b).abs()).clamp(min=0)

        env = wrap(
            ScriptedEnv({"a": constant([1.0]), "b": constant([3.5])}),
            T.KernelReward(near, ["a", "b"], "t", 2.0, reach=3.0),
        )
        close(drive(env, 1)[0]["next", "reward"], [[2 * 0.5]])

    def test_tensors_among_the_parameters_move_with_it(self):
        term = T.KernelReward(F.limit_excess, ["a"], "t", low=torch.zeros(2), high=torch.ones(2))
        close(drive(wrap(ScriptedEnv({"a": constant([1.5, -1.0])}), term), 1)[0]["next", "reward"], [[1.5]])
        assert term.to(torch.float64).kernel.low.dtype == torch.float64

    @pytest.mark.parametrize(
        ("function", "keys", "parameters", "message"),
        [
            ("hdmi.functional.nothing", ["a"], {}, "there is no function 'hdmi.functional.nothing'"),
            ("nothing.at.all", ["a"], {}, "there is no function 'nothing.at.all'"),
            ("hdmi.functional.tracking", ["a"], {}, r"tracking.* does not take 1 keys and \[\]: .*sigma"),
            ("hdmi.functional.tracking", ["a", "b"], {"sigma": 1.0}, "does not take 2 keys"),
            ("hdmi.functional.tracking", ["a"], {"sigma": 1.0, "width": 2.0}, "width"),
            (3, ["a"], {}, "3 is no function"),
        ],
    )
    def test_a_call_that_the_kernel_does_not_take(self, function, keys, parameters, message):
        with pytest.raises(ValueError, match=f"reward 't': .*{message}"):
            T.KernelReward(function, keys, "t", **parameters)
        with pytest.raises(ValueError, match=f"termination 't': .*{message}"):
            T.KernelTermination(function, keys, "t", **parameters)

    def test_one_figure_for_each_world(self):
        env = wrap(ScriptedEnv({"a": constant([1.0, 2.0])}), T.KernelReward(torch.abs, ["a"], "t"))
        with pytest.raises(ValueError, match=r"reward 't': expected one figure for each world, \[1, 1\], got \[1, 2\]"):
            env.output_spec  # noqa: B018

    def test_the_reward_is_the_only_one(self):
        """Terms are observations, zero after a reset, so that the environment has one reward key."""
        env = wrap(
            ScriptedEnv({"a": constant([1.0])}),
            T.KernelReward(torch.abs, ["a"], "t", 3.0),
            T.JointVelL2(joint_vel_key="a"),
        )
        assert env.reward_key == "reward"
        check_env_specs(env)
        assert env.reset()["reward_terms", "t"].tolist() == [[0.0]]

    def test_terminations(self):
        far = T.KernelTermination("hdmi.functional.error_exceeds", ["e"], "far", min_steps=2, threshold=1.0)
        steps = drive(wrap(ScriptedEnv({"e": table([0.0, 2.0, 2.0])}), far), 2)
        assert [bool(s["next", "terminated"]) for s in steps] == [False, True]
        assert steps[-1]["next", "termination", "far"].all()


class TestRewardGroups:
    def terms(self):
        kernels = (("near", "a", 2.0), ("firm", "b", 3.0), ("effort", "a", -0.5))
        return [T.KernelReward(torch.abs, [key], name, weight) for name, key, weight in kernels]

    def groups(self, groups, **parameters):
        return T.RewardGroups(groups, {term.out_keys[0]: term.weight for term in self.terms()}, **parameters)

    def env(self, groups, control_dt=1.0):
        script = {"a": table([0.0, 1.0, 4.0]), "b": table([0.0, 2.0, 0.0])}
        after = (self.groups(groups, control_dt=control_dt), T.RewardRate(control_dt))
        return wrap(ScriptedEnv(script), *self.terms(), *after)

    def test_sums_weighted_terms_and_together_they_are_the_reward(self):
        env = self.env({"tracking": ["near", "firm"], "costs": ["effort"]}, control_dt=0.5)
        check_env_specs(env)
        assert env.reward_key == "reward"
        assert env.reset()["reward_groups"].sum().to_dict() == {"tracking": 0.0, "costs": 0.0}
        steps = drive(env, 2)
        # 0.5 (2 * 1 + 3 * 2), 0.5 (2 * 4 + 3 * 0); 0.5 * -0.5 * 1, 0.5 * -0.5 * 4
        close(next_of(steps, ("reward_groups", "tracking")).flatten(), [4.0, 4.0])
        close(next_of(steps, ("reward_groups", "costs")).flatten(), [-0.25, -1.0])
        close(next_of(steps, "reward").flatten(), [3.75, 3.0])

    def test_what_no_group_names_is_one_more(self):
        env = self.env({"tracking": ["near"], "absent": ["balance"]})
        (step,) = drive(env, 1)
        rewards = step["next", "reward_groups"]
        assert sorted(rewards.keys()) == ["other", "tracking"]  # no group without terms
        close(rewards["other"], [[3.0 * 2 - 0.5]])

    @pytest.mark.parametrize(
        ("groups", "message"),
        [
            ({"a": ["near"], "b": ["firm", "near"]}, "groups: near named more than once"),
            ({"a": ["near", "near"]}, "near named more than once"),
            ({"other": ["near"]}, "'other' is made of"),
        ],
    )
    def test_refuses(self, groups, message):
        with pytest.raises(ValueError, match=message):
            self.groups(groups)


# -- termination ------------------------------------------------------------------------------------------------------


class TestTermination:
    def test_counts_consecutive_steps(self):
        """Bad, bad, good, bad, bad, bad: only the last makes three in a row."""
        errors = [9.0, 2.0, 2.0, 0.5, 2.0, 2.0, 2.0, 2.0]  # the first is the reset's and does not count
        env = wrap(ScriptedEnv({"e": table(errors)}), T.ErrorTermination("t", ["e"], [1.0], min_steps=3))
        steps = drive(env, 7)
        assert next_of(steps, ("termination_steps", "t")).flatten().tolist() == [1, 2, 0, 1, 2, 3, 4]
        fired = [False] * 5 + [True] * 2
        for key in ("terminated", "done", ("termination", "t")):
            assert next_of(steps, key).flatten().tolist() == fired
        assert not next_of(steps, "truncated").any()

    def test_any_of_the_errors(self):
        script = {"a": constant([0.0, 0.3], 3), "b": torch.tensor([[[0.0], [2.0], [1.0]]])}
        env = wrap(ScriptedEnv(script), T.ErrorTermination("t", ["a", "b"], [0.5, 1.0], min_steps=1))
        assert drive(env, 1)[0]["next", "terminated"].flatten().tolist() == [False, True, False]

    def test_two_terms(self):
        script = {"a": torch.tensor([[[0.0], [1.0]]]), "b": torch.tensor([[[1.0], [0.0]]])}
        terms = [T.ErrorTermination(name, [name], [0.5], min_steps=1) for name in ("a", "b")]
        step = drive(wrap(ScriptedEnv(script), *terms), 1)[0]["next"]
        assert step["terminated"].all()
        assert step["termination", "a"].flatten().tolist() == [False, True]
        assert step["termination", "b"].flatten().tolist() == [True, False]

    @pytest.mark.parametrize(
        ("require", "lost"), [("either", [True, True, True, False]), ("both", [True, False, False, False])]
    )
    def test_lost_contact(self, require, lost):
        """Rows: far and loose; far, but pressing; loose, but near; far and loose, but not intended."""
        far, near = [1.0, 0, 0], [0.1, 0, 0]
        script = {
            ("contact", "eef_pos"): torch.tensor([far, far, near, far])[None, :, None],
            ("contact", "target_pos"): torch.zeros(1, 4, 1, 3),
            ("contact", "force"): torch.tensor([0.0, 2.0, 0.0, 0.0])[None, :, None, None] * torch.ones(1, 1, 1, 3),
            ("ref", "contact"): torch.tensor([True, True, True, False])[None, :, None],
        }
        env = wrap(ScriptedEnv(script), T.LostContact(distance=0.2, min_force=1.0, min_steps=1, require=require))
        assert drive(env, 1)[0]["next", "terminated"].flatten().tolist() == lost

    def test_body_height(self):
        heights = torch.tensor([0.31, 0.29])
        pos = torch.ones(1, 2, 2, 3)
        pos[0, :, 1, 2] = heights
        env = wrap(
            ScriptedEnv({("robot", "body_pos"): pos}),
            T.BodyHeight("torso", ("a", "torso"), threshold=0.3, min_steps=1),
        )
        assert drive(env, 1)[0]["next", "terminated"].flatten().tolist() == [False, True]

    def test_body_height_error_is_against_the_reference(self):
        """A torso beside a stool of 0.32 m, and one that crouches where the reference does."""
        pos, ref = torch.zeros(1, 2, 2, 3), torch.zeros(1, 2, 2, 3)
        pos[0, :, 1, 2], ref[0, :, 1, 2] = torch.tensor([0.8, 0.25]), torch.tensor([1.12, 0.25])
        env = wrap(
            ScriptedEnv({("tracked", "body_pos"): pos, ("ref", "body_pos"): ref}),
            T.BodyHeightError("torso", ["b", "torso"], body_names=("a", "torso", "b")),
            T.ErrorTermination("torso_height", [("error", "torso_height")], [0.3], min_steps=1),
        )
        step = drive(env, 1)[0]["next"]
        # of the tracked bodies `torso` is the first
        assert step["error", "torso_height"].flatten().tolist() == [0.0, 0.0]
        pos, ref = pos.flip(2), ref.flip(2)
        env = wrap(
            ScriptedEnv({("tracked", "body_pos"): pos, ("ref", "body_pos"): ref}),
            T.BodyHeightError("torso", ["b", "torso"], body_names=("a", "torso", "b")),
            T.ErrorTermination("torso_height", [("error", "torso_height")], [0.3], min_steps=1),
        )
        step = drive(env, 1)[0]["next"]
        torch.testing.assert_close(step["error", "torso_height"].flatten(), torch.tensor([0.32, 0.0]))
        assert step["terminated"].flatten().tolist() == [True, False]

    def test_refusals(self):
        with pytest.raises(ValueError, match="require"):
            T.LostContact(require="any")
        with pytest.raises(ValueError, match="min_steps"):
            T.ErrorTermination("t", ["a"], [1.0], min_steps=0)
        with pytest.raises(ValueError, match="one threshold"):
            T.ErrorTermination("t", ["a"], [1.0, 2.0])


# -- randomization ----------------------------------------------------------------------------------------------------


class TestRandomization:
    N = 24

    def drawn(self, *terms, seed: int = 0):
        env = physics(self.N, *terms)
        torch.manual_seed(seed)
        env.reset()
        return env, env.base_env.backend

    def body(self, model, name: str) -> int:
        return model.body(name).id

    def test_mass_scale(self, model):
        _, backend = self.drawn(T.MassRandomization(model, ["pelvis", "torso_link"], scale=[0.5, 1.5]))
        bodies = [self.body(model, name) for name in ("pelvis", "torso_link")]
        factor = backend.model("body_mass")[:, bodies] / torch.from_numpy(model.body_mass[bodies])
        assert 0.5 <= factor.min() < 0.6
        assert 1.4 < factor.max() <= 1.5
        assert not torch.isclose(factor[:, 0], factor[:, 1]).any()  # each on its own
        inertia = backend.model("body_inertia")[:, bodies] / torch.from_numpy(model.body_inertia[bodies])
        close(inertia, factor.unsqueeze(-1).expand_as(inertia), 1e-5)
        # other bodies keep theirs, and constants that derive from masses follow
        knee = self.body(model, "left_knee_link")
        close(backend.model("body_mass")[:, knee], [float(model.body_mass[knee])] * self.N)
        total = backend.model("body_mass").sum(-1) - backend.model("body_mass")[:, self.body(model, "box")]
        world, _ = backend.world(3)
        assert world.body_subtreemass[bodies[0]] < float(total[3]) + 1e-9
        assert not math.isclose(world.body_subtreemass[bodies[0]], model.body_subtreemass[bodies[0]], rel_tol=1e-4)

    def test_total_mass(self, model):
        env, backend = self.drawn(T.MassRandomization(model, ["box"], mass=[2.0, 3.0]))
        mass = env.reset()["object", "mass"]
        assert ((mass >= 2.0) & (mass <= 3.0)).all()
        assert len(mass.unique()) == self.N
        close(backend.model("body_mass")[:, self.body(model, "box")], mass.squeeze(-1), 1e-6)

    def test_either_scale_or_mass(self, model):
        with pytest.raises(ValueError, match="either scale or mass"):
            T.MassRandomization(model, ["box"])

    def test_center_of_mass(self, model):
        _, backend = self.drawn(T.CenterOfMassRandomization(model, ["torso_link"], shift=0.05))
        torso = self.body(model, "torso_link")
        off = backend.model("body_ipos")[:, torso] - torch.from_numpy(model.body_ipos[torso])
        assert 0.04 < off.abs().max() <= 0.05 + 1e-6
        assert len(off.unique()) == 3 * self.N

    def test_friction(self, model):
        env, backend = self.drawn(T.FrictionRandomization(model, ["box"], friction=[0.6, 1.0]))
        friction = env.reset()["object", "friction"]
        assert ((friction >= 0.6) & (friction <= 1.0)).all()
        assert len(friction.unique()) == self.N
        geom = int(lift_box().scene.object_geoms[0])
        close(backend.model("geom_friction")[:, geom, 0], friction.squeeze(-1), 1e-6)
        others = [g for g in range(model.ngeom) if g not in lift_box().scene.object_geoms]
        close(backend.model("geom_friction")[0, others], torch.from_numpy(model.geom_friction[others]), 1e-6)

    def test_object_scale(self, model):
        env, backend = self.drawn(T.ObjectScale([0.8, 1.2]))
        scale = env.reset()["object", "scale"]
        assert 0.8 <= scale.min() < 0.9
        assert 1.1 < scale.max() <= 1.2
        geom = int(lift_box().scene.object_geoms[0])
        close(backend.model("geom_size")[:, geom], scale * torch.tensor(model.geom_size[geom]), 1e-5)

    def test_joint_friction_and_damping(self, model):
        term = T.ObjectJointRandomization(model, "waist_yaw_joint", friction=[0.1, 0.2], damping=[0.3, 0.4])
        _, backend = self.drawn(term)
        dof = int(model.joint("waist_yaw_joint").dofadr[0])
        for field, (low, high) in {"dof_frictionloss": (0.1, 0.2), "dof_damping": (0.3, 0.4)}.items():
            values = backend.model(field)[:, dof]
            assert ((values >= low - 1e-6) & (values <= high + 1e-6)).all()
            assert len(values.unique()) == self.N
            close(backend.model(field)[:, dof + 1], [float(getattr(model, field)[dof + 1])] * self.N, 1e-5)

    @pytest.mark.parametrize("per", ["episode", "world"])
    def test_per(self, model, per):
        env, backend = self.drawn(T.MassRandomization(model, ["box"], mass=[2.0, 3.0], per=per))
        box = self.body(model, "box")
        first = backend.model("body_mass")[:, box].clone()
        assert len(first.unique()) == self.N
        td = env.reset()
        second = backend.model("body_mass")[:, box].clone()
        assert torch.equal(first, second) == (per == "world")
        mask = torch.zeros(self.N, dtype=torch.bool)
        mask[4] = True
        env.reset(td.set("_reset", mask))
        third = backend.model("body_mass")[:, box]
        assert torch.equal(third[~mask], second[~mask])
        assert bool(third[4] != second[4]) == (per == "episode")

    def test_per_is_checked(self):
        with pytest.raises(ValueError, match="'step'"):
            T.ObjectScale([1.0, 1.0], per="step")

    def test_two_terms_on_one_field(self, model):
        """Pelvis and box both write masses; neither undoes the other, whichever draws per world."""
        terms = [
            T.MassRandomization(model, ["pelvis"], scale=[2.0, 2.0], per="world"),
            T.MassRandomization(model, ["box"], mass=[5.0, 6.0]),
        ]
        env, backend = self.drawn(*terms)
        for _ in range(3):
            mass = backend.model("body_mass")
            pelvis, box = self.body(model, "pelvis"), self.body(model, "box")
            close(mass[:, pelvis], [2 * float(model.body_mass[pelvis])] * self.N, 1e-4)
            assert ((mass[:, box] >= 5) & (mass[:, box] <= 6)).all()
            env.reset()

    def test_worlds_differ_in_what_they_do(self, model):
        """A heavier box falls as fast, but a robot with other masses moves differently under the same targets."""
        env = physics(3, T.MassRandomization(model, [".*_link"], scale=[0.5, 1.5]))
        torch.manual_seed(0)
        pose = torch.as_tensor(default_joint_pos(), dtype=torch.float32).expand(3, 29)
        height = drive(env, 10, lambda _: pose)[-1]["next", "robot", "joint_pos"]
        assert not torch.allclose(height[0], height[1], atol=1e-5)


def test_joint_offset_is_added_to_every_target():
    env = wrap(blank(50), T.JointOffset(0.1, size=4))
    torch.manual_seed(0)
    td = env.reset()
    offset = td["joint_offset", "action"].clone()
    assert 0.08 < offset.abs().max() <= 0.1
    for t in range(3):
        td = env.step(td.set("action", torch.full((50, 4), float(t))))
        close(env.base_env.received, offset + t)
        td = env.step_mdp(td)
    assert not torch.equal(env.reset()["joint_offset", "action"], offset)


def test_joint_offset_on_a_target_per_physics_step():
    env = wrap(blank(2), T.JointOffset(0.1, size=4), T.ActionDelay((2, 2), 4, size=4))
    td = env.reset()
    env.step(td.set("action", torch.ones(2, 4)))
    close(env.base_env.received, (1 + td["joint_offset", "action"]).unsqueeze(1).expand(2, 4, 4))


class TestRandomPush:
    def test_changes_the_velocity_of_the_root_when_the_countdown_ends(self):
        push = T.RandomPush([2, 2], linear=[1.0, 1.0, 0.5], angular=[0.5, 0.5, 0.5])
        pushed, still = physics(2, push), physics(2)
        pose = torch.as_tensor(default_joint_pos(), dtype=torch.float32).expand(2, 29)
        torch.manual_seed(0)
        a, b = drive(pushed, 3, lambda _: pose), drive(still, 3, lambda _: pose)
        assert [s["push_countdown", "push"].flatten().tolist() for s in a] == [[2, 2], [1, 1], [2, 2]]
        key = ("next", "robot", "root_lin_vel")
        torch.testing.assert_close(a[0].get(key), b[0].get(key), rtol=0, atol=0)
        change = (a[1].get(key) - b[1].get(key)).norm(dim=-1)
        assert (change > 0.05).all()
        assert not torch.isclose(change[0], change[1])

    def test_range(self):
        env = wrap(blank(400), T.RandomPush([1, 1], linear=[1.0, 2.0, 0.0], angular=[0.1, 0.2, 0.3]))
        torch.manual_seed(0)
        push = env.transform.inv(env.reset().set("action", torch.zeros(400, 4)))["push"]
        half = torch.tensor([1.0, 2.0, 0.0, 0.1, 0.2, 0.3])
        assert (push.abs() <= half).all()
        close(push.std(0), half / math.sqrt(3), 0.1)

    @pytest.mark.parametrize("interval", [(0, 2), (5, 3)])
    def test_bad_interval(self, interval):
        with pytest.raises(ValueError, match=r"push\.interval"):
            T.RandomPush(interval, [0.0] * 3, [0.0] * 3)
