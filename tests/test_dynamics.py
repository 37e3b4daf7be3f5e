"""What a reference asks of physics: torques of poses that stand, hang and move, against statics."""

from __future__ import annotations

import math
from functools import partial
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch

from hdmi.assembly import make_task
from hdmi.assets import default_joint_pos, g1, g1_robot
from hdmi.config import task_config
from hdmi.evaluation.agents import blind_agent
from hdmi.evaluation.protocol import evaluation_config, make_evaluation_env
from hdmi.motion import Motion, forward_kinematics, make_playback
from hdmi.motion.dynamics import inverse_dynamics, reference_torque
from hdmi.motion.format import motion_from_poses
from hdmi.motion.playback import Playback, reference_qpos

FPS, T = 50.0, 12
FOOT = g1.BODY_NAMES.index(g1.FEET[0])
STANDING_FOOT = g1.FOOT_POINT_RADIUS - g1.FOOT_POINTS[0][2]  # height of its origin, m


def standing(knee: float, lift: float = 0.0) -> Motion:
    """Stands still with bent knees, the soles flat on the floor and always at the same place; `lift` m above it."""
    joint_pos = default_joint_pos()
    for side in ("left", "right"):
        for name, angle in (("hip_pitch", -knee / 2), ("knee", knee), ("ankle_pitch", -knee / 2)):
            joint_pos[g1.JOINT_NAMES.index(f"{side}_{name}_joint")] = angle
    root_pos, root_quat = np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]])
    feet, _ = forward_kinematics(g1_robot(), root_pos, root_quat, joint_pos[None])
    root_pos = -feet[:, FOOT] + [0.0, 0.0, STANDING_FOOT + lift]
    root_pos[:, 1] = 0.0
    joint_pos, root_pos, root_quat = (np.tile(a, (T, 1)) for a in (joint_pos, root_pos, root_quat))
    pos, quat = forward_kinematics(g1_robot(), root_pos, root_quat, joint_pos)
    return motion_from_poses("stands", FPS, g1.BODY_NAMES, g1.JOINT_NAMES, pos, quat, joint_pos)


def at_frame(playback: Playback, frame: int = 0) -> mujoco.MjData:
    """Data of a frame at rest."""
    data = mujoco.MjData(playback.scene.model)
    data.qpos[:] = playback.qpos[frame]
    mujoco.mj_forward(playback.scene.model, data)
    return data


def test_the_ground_gives_a_standing_robot_its_weight():
    dynamics = inverse_dynamics(make_playback(standing(0.6)))
    assert dynamics.torque.shape == (T, 29)
    assert dynamics.missing_force.max() < 1e-3  # body weights
    assert not dynamics.in_flight.any()
    assert dynamics.cop_distance.max() < 1e-2
    assert np.isnan(dynamics.object_force).all()  # no object
    left, right = (
        [g1.JOINT_NAMES.index(f"{side}_{name}_joint") for name in ("hip_pitch", "knee", "ankle_pitch")]
        for side in ("left", "right")
    )
    np.testing.assert_allclose(dynamics.torque[:, left], dynamics.torque[:, right], atol=0.5)


def test_torques_of_standing_carry_the_weight():
    """Virtual work: bending the knees a little more, on feet that stay, takes from torques what the weight gives."""
    poses = [make_playback(standing(knee)) for knee in (0.6, 0.62)]
    torque = np.mean([inverse_dynamics(p).torque[0] for p in poses], axis=0)
    joints = [p.reference.joint_pos[0].double().numpy() for p in poses]
    heights = []
    for p in poses:
        np.testing.assert_allclose(p.reference.body_pos[0, FOOT], poses[0].reference.body_pos[0, FOOT], atol=1e-5)
        heights.append(at_frame(p).subtree_com[int(p.scene.body_ids[0]), 2])
    fall = heights[0] - heights[1]
    assert fall > 1e-3
    work = torque @ (joints[1] - joints[0])
    assert -work == pytest.approx(9.81 * g1.TOTAL_MASS * fall, rel=0.03)
    knee = g1.JOINT_NAMES.index("left_knee_joint")
    assert torque[knee] < -10  # N m: they keep it from bending


def test_a_robot_in_the_air_misses_its_weight_and_holds_its_limbs():
    playback = make_playback(standing(0.6, lift=1.0))
    dynamics = inverse_dynamics(playback)
    np.testing.assert_allclose(dynamics.missing_force, 1.0, atol=1e-3)
    assert np.isnan(dynamics.cop_distance).all()
    bias = at_frame(playback).qfrc_bias[playback.scene.joint_dof]
    np.testing.assert_allclose(dynamics.torque, np.tile(bias, (T, 1)), atol=0.05)


def test_arms_of_a_standing_robot_hang_on_its_shoulders():
    """What no contact reaches has the torque of gravity alone."""
    playback = make_playback(standing(0.6))
    arms = [j for j, name in enumerate(g1.JOINT_NAMES) if any(part in name for part in ("shoulder", "elbow", "wrist"))]
    bias = at_frame(playback).qfrc_bias[playback.scene.joint_dof]
    np.testing.assert_allclose(inverse_dynamics(playback).torque[0, arms], bias[arms], atol=0.02)


def test_an_arm_that_swings_up_takes_more_than_one_that_hangs():
    motion = standing(0.6)
    shoulder = g1.JOINT_NAMES.index("left_shoulder_roll_joint")
    time = np.arange(T) / FPS
    joint_pos = motion.joint_pos.copy()
    joint_pos[:, shoulder] += 0.5 * 20.0 * time**2  # rad: at 20 rad/s^2
    pos, quat = forward_kinematics(g1_robot(), motion.body_pos_w[:, 0], motion.body_quat_w[:, 0], joint_pos)
    swings = motion_from_poses("swings", FPS, g1.BODY_NAMES, g1.JOINT_NAMES, pos, quat, joint_pos)
    playback, frame = make_playback(swings), T // 2
    model, data = playback.scene.model, at_frame(playback, frame)
    dof = int(playback.scene.joint_dof[shoulder])
    column = np.zeros(model.nv)
    mujoco.mj_mulM(model, data, column, np.eye(model.nv)[dof])
    expected = 20.0 * column[dof] + data.qfrc_bias[dof]
    assert 20.0 * column[dof] > 1.0
    assert inverse_dynamics(playback).torque[frame, shoulder] == pytest.approx(expected, rel=0.1)


def test_torques_of_a_reference_are_smooth(monkeypatch: pytest.MonkeyPatch):
    playback = make_playback(standing(0.6))
    still = reference_torque(playback.scene, playback.reference)
    np.testing.assert_allclose(still, inverse_dynamics(playback).torque, atol=0.2)
    jump = np.repeat((np.arange(40) >= 20)[:, None] * 100.0, 29, axis=1)  # N m
    monkeypatch.setattr("hdmi.motion.dynamics.inverse_dynamics", lambda _, grip: SimpleNamespace(torque=jump))
    smooth = reference_torque(playback.scene, playback.reference)
    assert np.diff(smooth[:, 0]).max() == pytest.approx(100 / (2 * math.sqrt(2 * math.pi)), rel=0.02)
    np.testing.assert_allclose(smooth[[0, -1]], jump[[0, -1]], atol=1e-3)


def test_torques_of_a_grip_hold_the_object(monkeypatch: pytest.MonkeyPatch):
    """From the middle of carrying, without noise, servos that follow the reference keep the box."""
    cfg = evaluation_config(task_config("carry_bread_box"), start=225)
    cfg.num_threads, cfg.randomization, cfg.reset.state.noise = 1, None, {}
    lost, torques = {}, {}
    for share in (0.5, None):
        solved = partial(inverse_dynamics, grip=share)
        monkeypatch.setattr(
            "hdmi.motion.dynamics.inverse_dynamics", lambda playback, grip, solved=solved: solved(playback)
        )
        task = make_task(cfg)
        torques[share] = task.joint_torque(0.5)
        env = make_evaluation_env(cfg, task, 1)
        steps = env.rollout(25, blind_agent("zero", cfg, task), break_when_any_done=False)["next"]
        lost[share] = float(steps["metrics", "object_pos_error"][0, -1])
        env.close()
    assert lost[0.5] < 0.3 * lost[None], lost
    effort = torch.tensor(task.scene.robot.effort_limits)
    assert (torques[0.5].abs() <= 1.01 * effort).all()


@pytest.mark.parametrize("grip", [0.5, 0.25])
def test_a_grip_needs_its_share_of_the_friction(grip: float):
    """Of lift_box, held still between two palms: what the arms' torques leave of gravity is the hands' force."""
    frame, task = 150, make_task(task_config("lift_box"))
    playback = Playback(task.reference, task.scene, reference_qpos(task.scene, task.reference), 0.02)
    model, data = task.scene.model, at_frame(playback, frame)
    torque = inverse_dynamics(playback, grip).torque[frame]
    across = data.body("box").xmat.reshape(3, 3)[:, 1]  # from palm to palm
    carried = 0.0
    for effector in task.scene.effectors:
        side = effector.body.split("_")[0]
        joints = [i for i, name in enumerate(task.scene.robot.joint_names) if name.startswith(side) and i >= 15]
        dofs = task.scene.joint_dof[joints]
        body = data.body(effector.body)
        lin, ang = np.zeros((2, 3, model.nv))
        mujoco.mj_jac(model, data, lin, ang, body.xpos + body.xmat.reshape(3, 3) @ effector.point, body.id)
        jacobian = np.vstack([lin, ang])[:, dofs]  # [6, 7]
        force = np.linalg.lstsq(jacobian.T, data.qfrc_bias[dofs] - torque[joints], rcond=None)[0][:3]  # on the hand
        pressed = abs(force @ across)
        along = np.linalg.norm(force - (force @ across) * across)
        assert 0.6 * grip * pressed < along < 1.2 * grip * pressed, effector.body  # and a little bare force
        carried -= force[2]
    assert carried == pytest.approx(9.81 * 0.5, rel=0.15)  # N, of 0.5 kg
