"""Reward, termination and tracking kernels against numbers worked out by hand."""

import math

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from hdmi.functional import (
    action_rate,
    alive,
    any_error_exceeds,
    body_velocity,
    contact_lost,
    error_exceeds,
    feedforward_target,
    feet_air_time,
    feet_impact,
    feet_slip,
    feet_stumble,
    interaction,
    limit_excess,
    local_pose,
    persist,
    quat_angle,
    quat_apply,
    quat_from_euler,
    quat_multiply,
    spring_wrench,
    sum_of_squares,
    tracking,
    tracking_mean,
)

E1 = math.exp(-1)


def close(actual: Tensor, expected, atol: float = 1e-6) -> None:
    torch.testing.assert_close(actual, torch.as_tensor(expected, dtype=actual.dtype), rtol=0, atol=atol)


def test_tracking():
    error = torch.tensor([[0.1, 0.3], [0.0, 0.0]])
    close(tracking(error, sigma=0.2), [[E1], [1.0]])  # means 0.2 and 0
    close(tracking(error, sigma=0.1, tolerance=0.1), [[E1], [1.0]])
    close(tracking(error, sigma=0.1, tolerance=0.5), [[1.0], [1.0]])


def test_tracking_of_several_errors():
    errors = torch.tensor([[0.25, 0.75]]), torch.tensor([[1.0]])  # 0.5 / 0.5; (1 - 0.5) / 1
    close(tracking_mean(*errors, sigmas=(0.5, 1.0), tolerances=(0.0, 0.5)), [[(E1 + math.exp(-0.5)) / 2]])


def test_small_ones():
    close(sum_of_squares(torch.tensor([[1.0, -2.0]])), [[5.0]])
    close(alive(torch.tensor([[True], [False]])), [[0.0], [1.0]])
    errors = torch.tensor([[0.1, 0.3], [0.1, 0.1]]), torch.tensor([[1.0], [3.0]])
    assert any_error_exceeds(*errors, thresholds=(0.2, 2.0)).tolist() == [[True], [True]]
    assert any_error_exceeds(*errors, thresholds=(0.5, 2.0)).tolist() == [[False], [True]]


class TestInteraction:
    """Two hands: the left 0.3 m off with enough force, the right on the spot with 10 N of 30 N."""

    pos = torch.tensor([[0.3, 0.0, 0.0], [1.0, 1.0, 1.0]])
    target = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    force = torch.tensor([[0.0, 30.0, 0.0], [0.0, 0.0, -10.0]])
    left, right = E1, math.exp(-0.5)

    def reward(self, *active: bool, **kwargs) -> Tensor:
        kwargs = {"sigma_pos": 0.3, "sigma_frc": 40.0, "force_threshold": 30.0} | kwargs
        return interaction(self.pos, self.target, self.force, torch.tensor(active), **kwargs)

    def test_mean_is_over_the_active_effectors(self):
        close(self.reward(True, True), [(self.left + self.right) / 2])
        close(self.reward(True, False), [self.left])
        close(self.reward(False, True), [self.right])

    def test_max_takes_the_best_active_effector(self):
        close(self.reward(True, True, reduce="max"), [self.right])
        close(self.reward(True, False, reduce="max"), [self.left])

    @pytest.mark.parametrize("reduce", ["mean", "max"])
    def test_zero_where_no_contact_is_intended(self, reduce):
        close(self.reward(False, False, reduce=reduce), [0.0])

    def test_force_beyond_the_threshold_earns_nothing_more(self):
        close(self.reward(True, False, force_threshold=30.0), self.reward(True, False, force_threshold=5.0))

    def test_tolerance_is_subtracted_from_the_distance(self):
        close(self.reward(True, False, tolerance=0.15), [math.exp(-0.5)])
        close(self.reward(True, False, tolerance=0.4), [1.0])

    def test_batched(self):
        active = torch.tensor([[True, True], [True, False], [False, False]])
        reward = interaction(
            self.pos.expand(3, 2, 3),
            self.target.expand(3, 2, 3),
            self.force.expand(3, 2, 3),
            active,
            sigma_pos=0.3,
            sigma_frc=40.0,
            force_threshold=30.0,
        )
        close(reward, [[(self.left + self.right) / 2], [self.left], [0.0]])


def test_action_rate():
    close(action_rate(torch.tensor([1.0, 0.0, -2.0]), torch.tensor([0.0, 0.0, 1.0])), [10.0])


def test_limit_excess_is_zero_inside_and_linear_outside():
    low, high = torch.tensor([-1.0, -1.0, 0.0]), torch.tensor([1.0, 1.0, 0.5])
    value = torch.tensor([[0.0, 1.0, 0.2], [-1.5, 1.25, 0.75]])
    close(limit_excess(value, low, high), [[0.0], [1.0]])


def test_feet_impact_charges_rises_only():
    before = torch.tensor([[[0.0, 0.0, 100.0], [0.0, 0.0, 300.0]]])
    after = torch.tensor([[[0.0, 0.0, 250.0], [0.0, 0.0, 0.0]]])
    close(feet_impact(after, before, weight_force=300.0), [[0.25]])  # (150 / 300)^2
    close(feet_impact(before, before, weight_force=300.0), [[0.0]])
    both = torch.tensor([[[0.0, 0.0, -300.0], [0.0, 180.0, 240.0]]])
    close(feet_impact(both, torch.zeros(1, 2, 3), weight_force=300.0), [[2.0]])


def test_feet_slip_counts_the_horizontal_speed_of_loaded_feet():
    velocity = torch.tensor([[0.3, 0.4, 9.0], [1.0, 0.0, 0.0]])
    loaded, unloaded = [0.0, 0.0, 50.0], [0.0, 0.0, 10.0]
    close(feet_slip(velocity, torch.tensor([loaded, unloaded]), force_threshold=20.0), [0.5])
    close(feet_slip(velocity, torch.tensor([loaded, loaded]), force_threshold=20.0), [1.5])
    close(feet_slip(velocity, torch.tensor([unloaded, unloaded]), force_threshold=20.0), [0.0])


def test_feet_stumble_counts_feet_pushed_sideways_more_than_they_carry():
    edge, push, stand, air = [30.0, 40.0, 5.0], [0.0, -90.0, -20.0], [100.0, 0.0, 300.0], [0.0, 0.0, 0.0]
    close(feet_stumble(torch.tensor([edge, stand]), ratio=4.0), [1.0])  # 50 N against 4 x 5 N
    close(feet_stumble(torch.tensor([edge, push]), ratio=4.0), [2.0])  # 90 N against 4 x 20 N
    close(feet_stumble(torch.tensor([push, stand]), ratio=5.0), [0.0])
    close(feet_stumble(torch.tensor([[air, air], [stand, air]]), ratio=4.0), [[0.0], [0.0]])


def test_feet_air_time_charges_short_swings_at_touchdown():
    air_time = torch.tensor([[0.1, 0.3], [0.1, 0.6]])
    touchdown = torch.tensor([[True, True], [False, True]])
    close(feet_air_time(air_time, touchdown, threshold=0.4), [[0.4], [0.0]])  # 0.3 + 0.1


def test_error_exceeds_if_any_is_above():
    error = torch.tensor([[0.1, 0.2], [0.1, 0.31], [0.3, 0.3]])
    assert error_exceeds(error, 0.3).tolist() == [[False], [True], [False]]


@pytest.mark.parametrize(
    ("offset", "newton", "require", "active", "lost"),
    [
        (0.5, 0.0, "either", True, True),  # far and loose
        (0.5, 0.0, "both", True, True),
        (0.1, 0.0, "either", True, True),  # near, but loose
        (0.1, 0.0, "both", True, False),
        (0.5, 50.0, "either", True, True),  # firm, but far
        (0.5, 50.0, "both", True, False),
        (0.1, 50.0, "either", True, False),  # held
        (0.1, 50.0, "both", True, False),
        (0.5, 0.0, "either", False, False),  # not intended
        (0.5, 0.0, "both", False, False),
    ],
)
def test_contact_is_lost(offset, newton, require, active, lost):
    pos = torch.tensor([[0.0, 0.0, offset], [0.0, 0.0, 0.0]])
    force = torch.tensor([[newton, 0.0, 0.0], [2.0, 0.0, 0.0]])
    flags = torch.tensor([active, True])
    result = contact_lost(pos, torch.zeros(2, 3), force, flags, distance=0.2, min_force=1.0, require=require)
    assert result.tolist() == [lost]


def test_where_both_are_required_they_must_be_of_the_same_effector():
    pos = torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])  # the left is far but presses, the right near and loose
    force = torch.tensor([[50.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    active = torch.tensor([True, True])
    given = {"distance": 0.2, "min_force": 1.0}
    assert not contact_lost(pos, torch.zeros(2, 3), force, active, **given, require="both").item()
    assert contact_lost(pos, torch.zeros(2, 3), force, active, **given, require="either").item()


def test_persist_counts_and_starts_over():
    count = torch.zeros(2, 1, dtype=torch.int64)
    history = []
    for held in ([True, True], [True, False], [True, True]):
        count = persist(torch.tensor(held)[:, None], count)
        history.append(count.squeeze(-1).tolist())
    assert history == [[1, 1], [2, 0], [3, 1]]
    assert count.dtype == torch.int64


class TestLocalPose:
    def test_by_hand(self):
        # the root at (2, 1) heads along y: what is a metre further along y is ahead, what is along -x is left
        root_quat = quat_from_euler(torch.tensor([0.0, 0.3, math.pi / 2]))
        pos, quat = local_pose(
            torch.tensor([[2.0, 2.0, 0.5], [1.0, 1.0, 0.9]]),
            torch.stack([root_quat, torch.tensor([1.0, 0.0, 0.0, 0.0])]),
            torch.tensor([2.0, 1.0, 0.8]),
            root_quat,
        )
        close(pos, [[1.0, 0.0, 0.5], [0.0, 1.0, 0.9]])
        expected = quat_from_euler(torch.tensor([[0.0, 0.3, 0.0], [0.0, 0.0, -math.pi / 2]]))
        close(quat_angle(quat, expected), [0.0, 0.0])

    def test_unchanged_by_moving_and_turning_the_scene(self):
        generator = torch.Generator().manual_seed(0)

        def random(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        pos, root_pos = random(7, 5, 3), random(7, 3)
        quat, root_quat = quat_from_euler(random(7, 5, 3)), quat_from_euler(0.4 * random(7, 3))
        turn = quat_from_euler(torch.tensor([0.0, 0.0, 2.1], dtype=torch.float64))
        shift = torch.tensor([3.0, -4.0, 0.0], dtype=torch.float64)
        before = local_pose(pos, quat, root_pos, root_quat)
        after = local_pose(
            quat_apply(turn, pos) + shift,
            quat_multiply(turn, quat),
            quat_apply(turn, root_pos) + shift,
            quat_multiply(turn, root_quat),
        )
        torch.testing.assert_close(after[0], before[0])
        close(quat_angle(after[1], before[1]), torch.zeros(7, 5))

    def test_height_is_kept(self):
        root = torch.tensor([0.0, 0.0, 0.8])
        pos, _ = local_pose(root[None], torch.eye(4)[:1], root, torch.eye(4)[0])
        close(pos, [[0.0, 0.0, 0.8]])


def test_body_velocity_by_hand():
    # 2 rad/s about z, half a metre ahead of the centre of mass, which moves up at 3 m/s
    cvel = torch.tensor([[0.0, 0.0, 2.0, 0.0, 0.0, 3.0]])
    lin, ang = body_velocity(cvel, torch.tensor([[1.5, 0.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0]]))
    close(lin, [[0.0, 1.0, 3.0]])
    close(ang, [[0.0, 0.0, 2.0]])


def test_body_velocity_agrees_with_mujoco(robot_scene):
    model, ids = robot_scene.model, robot_scene.body_ids
    rng = np.random.default_rng(0)
    data = mujoco.MjData(model)
    data.qpos[:3] = [1.0, -2.0, 1.5]
    data.qpos[3:7] = rng.normal(size=4)
    data.qpos[7:] = rng.uniform(-0.5, 0.5, model.nq - 7)
    data.qvel[:] = rng.normal(size=model.nv)
    mujoco.mj_normalizeQuat(model, data.qpos)
    mujoco.mj_forward(model, data)
    com = data.subtree_com[model.body_rootid[ids]]
    lin, ang = body_velocity(*(torch.as_tensor(array) for array in (data.cvel[ids], data.xpos[ids], com)))
    for row, body in enumerate(ids):
        expected = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, expected, 0)
        close(ang[row], expected[:3], atol=1e-9)
        close(lin[row], expected[3:], atol=1e-9)


class TestFeedForwardTarget:
    kp, kd, limit = torch.tensor([100.0, 50.0]), torch.tensor([2.0, 5.0]), torch.tensor([30.0, 40.0])

    def test_by_hand(self):
        pos, vel = torch.tensor([[0.5, -0.2], [0.0, 0.0]]), torch.tensor([[1.0, -2.0], [0.0, 0.0]])
        torque = torch.tensor([[10.0, -20.0], [90.0, -90.0]])
        # 0.5 + (10 + 2) / 100; -0.2 + (-20 - 10) / 50; 30 / 100; -40 / 50
        close(feedforward_target(pos, vel, torque, self.kp, self.kd, self.limit), [[0.62, -0.8], [0.3, -0.8]])

    def test_a_servo_on_the_motion_gives_the_torque(self):
        torch.manual_seed(0)
        pos, vel, torque = torch.randn(3, 7, 2)
        target = feedforward_target(pos, vel, torque, self.kp, self.kd, self.limit)
        close(self.kp * (target - pos) - self.kd * vel, torque, 1e-4)


class TestSpringWrench:
    def pull(self, mass: Tensor | float = 4.0, **away: list[float]) -> Tensor:
        terms = ("offset", "rotation", "lin_vel", "ang_vel")
        given = {name: torch.tensor(away.get(name, [0.0, 0.0, 0.0])) for name in terms}
        return spring_wrench(**given, mass=mass, radius=0.5, rate=3.0)

    def test_by_hand(self):
        close(self.pull(), torch.zeros(6))
        close(self.pull(offset=[0.1, 0.0, -0.2]), [3.6, 0, -7.2, 0, 0, 0])  # 4 kg times 9 / s^2
        close(self.pull(lin_vel=[0.0, 0.5, 0.0]), [0, 12, 0, 0, 0, 0])  # 4 kg times 6 / s
        close(self.pull(rotation=[0.2, 0.0, 0.0]), [0, 0, 0, 1.8, 0, 0])  # 1 kg m^2 times 9 / s^2
        close(self.pull(ang_vel=[0.0, 0.0, -1.0]), [0, 0, 0, 0, 0, -6])

    def test_a_mass_for_each_world(self):
        mass = torch.tensor([[1.0], [2.0]])
        close(self.pull(mass, offset=[0.1, 0.0, 0.0], ang_vel=[0.0, 1.0, 0.0])[:, [0, 4]], [[0.9, 1.5], [1.8, 3.0]])

    def test_is_critically_damped(self):
        """A mass on it arrives as (1 + w t) exp(-w t) says, without going beyond."""
        gap, speed, dt, still = torch.tensor([1.0, 0.0, 0.0]), torch.zeros(3), 1e-3, torch.zeros(3)
        gaps = []
        for _ in range(3000):
            force = spring_wrench(gap, still, -speed, still, mass=2.0, radius=1.0, rate=3.0)[:3]
            speed = speed + force / 2.0 * dt
            gap = gap - speed * dt
            gaps.append(float(gap[0]))
        time = dt * torch.arange(1, 3001)
        close(torch.tensor(gaps), (1 + 3 * time) * torch.exp(-3 * time), 2e-3)
        assert min(gaps) > 0
