"""Inverse kinematics: known poses are found again, limits and contacts hold, nothing fails silently."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdmi.assets import default_joint_pos, g1, g1_robot
from hdmi.motion import forward_kinematics
from hdmi.workshop import ik
from hdmi.workshop.ik import ComTarget, IkOptions, Obstacle, OrientationTarget, PointTarget, PostureTarget

pytest.importorskip("mink")

FPS = 50.0
KEY_BODIES = (
    "pelvis", "torso_link", "left_knee_link", "right_knee_link", "left_ankle_roll_link", "right_ankle_roll_link",
    "left_elbow_link", "right_elbow_link", "left_wrist_yaw_link", "right_wrist_yaw_link",
)  # fmt: skip
STAY = PostureTarget(default_joint_pos(), 0.02)


def key_targets(pos: np.ndarray, quat: np.ndarray) -> list[ik.Target]:
    rows = [g1.BODY_NAMES.index(name) for name in KEY_BODIES]
    return [
        *(PointTarget(name, pos[:, b], 10.0) for name, b in zip(KEY_BODIES, rows, strict=True)),
        *(OrientationTarget(name, quat[:, b], 3.0) for name, b in zip(KEY_BODIES, rows, strict=True)),
    ]


def feet() -> list[ik.Target]:
    pos, quat = forward_kinematics(g1_robot(), *(part[None] for part in np.split(ik.standing(), [3, 7])))
    rows = [g1.BODY_NAMES.index(name) for name in g1.FEET]
    return [t for name, b in zip(g1.FEET, rows, strict=True) for t in ik.planted(name, pos[0, b], quat[0, b])]


@given(seed=st.integers(0, 10_000))
@settings(max_examples=10)
def test_finds_the_joints_that_made_the_poses(seed: int):
    rng = np.random.default_rng(seed)
    joints = default_joint_pos() + rng.uniform(-0.3, 0.3, 29)
    low, high = np.array(g1.JOINT_RANGES).T
    joints = np.clip(joints, low + 0.03, high - 0.03)[None]
    root = np.array([[0.3, -0.2, 0.8]])
    quat = np.array([[0.9, 0.1, -0.1, 0.4]]) / np.linalg.norm([0.9, 0.1, -0.1, 0.4])
    targets = key_targets(*forward_kinematics(g1_robot(), root, quat, joints))
    result = ik.solve(targets, 1, FPS, options=IkOptions(self_collision=None))
    np.testing.assert_allclose(result.joint_pos, joints, atol=2e-3)
    np.testing.assert_allclose(result.root_pos, root, atol=1e-4)
    assert max(float(residual[0]) for residual in result.residuals.values()) < 1e-3
    assert len(result.failures) == len(result.unsettled) == 0


def test_planted_feet_stay_while_hands_and_centre_of_mass_move():
    reach = np.linspace([0.2, 0.3, 0.9], [0.35, 0.25, 0.7], 20)
    hand = PointTarget("left_wrist_yaw_link", reach, 10.0, point=(0.15, 0.0, 0.0), name="fingertip")
    result = ik.solve([*feet(), hand, ComTarget([0.03, 0.0, 0.0], [10.0, 10.0, 0.0]), STAY], 20, FPS)
    assert np.nanmax(result.residuals["left_ankle_roll_link planted"]) < 2e-4
    assert np.nanmax(result.residuals["fingertip"][5:]) < 5e-3
    pos, quat = forward_kinematics(g1_robot(), result.root_pos, result.root_quat, result.joint_pos)
    data = mujoco.MjData(model := ik._bare_model(True, None))
    data.qpos[:] = result.qpos[-1]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    np.testing.assert_allclose(data.subtree_com[1][:2], [0.03, 0.0], atol=5e-3)
    b = g1.BODY_NAMES.index("left_wrist_yaw_link")
    w, x, y, z = quat[-1, b]
    forward = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    np.testing.assert_allclose(pos[-1, b] + 0.15 * forward, reach[-1], atol=5e-3)


def test_joints_keep_to_their_ranges_and_speeds():
    away = np.tile([0.3, 0.0, 3.0], (10, 1))
    away[5:] = [0.3, 0.0, -3.0]
    options = IkOptions(velocity_scale=0.1, limit_margin=0.05, self_collision=None)
    targets = [*feet(), PointTarget("right_wrist_yaw_link", away, 10.0), STAY]
    result = ik.solve(targets, 10, FPS, options=options)
    low, high = np.array(g1.JOINT_RANGES).T
    assert (result.joint_pos >= low + 0.05 - 1e-6).all()
    assert (result.joint_pos <= high - 0.05 + 1e-6).all()
    speed = np.abs(np.diff(result.joint_pos, axis=0)) * FPS
    limit = 0.1 * np.array([joint.velocity_limit for joint in g1.JOINTS])
    assert (speed <= limit + 1e-4).all()
    assert (speed.max(axis=0) > 0.99 * limit).any()  # the hand would be faster if it could
    assert np.nanmax(result.residuals["right_wrist_yaw_link"]) > 1.0
    assert np.nanmax(result.residuals["left_ankle_roll_link planted"]) < 5e-3  # however far the hand is pulled
    assert not len(result.failures)


def lowest_gap(result: ik.IkResult, options: IkOptions, obstacles: list[Obstacle]) -> float:
    model, mocap = ik._model(options, obstacles)
    data, gap = mujoco.MjData(model), np.inf
    for qpos in result.qpos:
        for i, obstacle in zip(mocap, obstacles, strict=True):
            data.mocap_pos[i], data.mocap_quat[i] = obstacle.pos, obstacle.quat
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        moving = [c.dist for c in data.contact[: data.ncon] if model.geom_bodyid[c.geom].min() < 31]
        gap = min([gap, *moving])
    return float(gap)


@pytest.mark.parametrize("stop", [True, False])
def test_nothing_enters_floor_obstacle_or_itself(stop: bool):
    box = Obstacle("crate", [{"box": [0.1, 0.3, 0.2]}], [0.4, 0.0, 0.8], [1.0, 0.0, 0.0, 0.0])
    hand = PointTarget("left_wrist_yaw_link", np.linspace([0.2, 0.1, 0.8], [0.45, 0.1, 0.8], 15), 10.0)
    foot = PointTarget("right_ankle_roll_link", [0.0, 0.1, -0.2], 10.0)
    options = IkOptions(floor=0.0) if stop else IkOptions(floor=None, self_collision=None)
    targets = [PointTarget("pelvis", [0.0, 0.0, 0.76], 30.0), hand, foot, STAY]
    result = ik.solve(targets, 15, FPS, options=options, obstacles=[box] if stop else [])
    gap = lowest_gap(result, IkOptions(floor=0.0), [box])
    if stop:
        assert gap > -2e-3
    else:
        assert gap < -0.02  # what the limits are for


def test_smoothing_takes_jerk_out_of_a_noisy_target():
    places = np.random.default_rng(0).normal([0.25, 0.2, 0.85], 0.01, (30, 3))
    targets = [*feet(), PointTarget("left_wrist_yaw_link", places, 10.0), STAY]
    rough, smooth = (ik.solve(targets, 30, FPS, options=IkOptions(smoothing=s)).joint_pos for s in (0.0, 10.0))
    jerk = [np.sqrt((np.diff(joints, n=3, axis=0) ** 2).mean()) for joints in (rough, smooth)]
    assert jerk[1] < 0.5 * jerk[0]


def test_joints_go_on_as_they_move_where_nothing_else_decides():
    moving = np.tile(default_joint_pos(), (12, 1))
    elbow = g1.JOINT_NAMES.index("left_elbow_joint")
    moving[:, elbow] += 0.02 * np.arange(12)
    weight = np.where(np.arange(12) < 6, 1000.0, 0.0)[:, None]
    result = ik.solve([*feet(), PostureTarget(moving, weight)], 12, FPS, options=IkOptions(smoothing=10.0))
    steps = np.diff(result.joint_pos[:, elbow])
    np.testing.assert_allclose(steps[:5], 0.02, atol=1e-3)
    np.testing.assert_allclose(steps[5:8], 0.02 * 0.8 ** np.arange(1, 4), atol=1e-3)


def test_frames_without_weight_have_no_residual():
    weight = np.array([[10.0], [0.0]])
    result = ik.solve([PointTarget("pelvis", [0.0, 0.0, 0.7], weight), STAY], 2, FPS)
    assert np.isfinite(result.residuals["pelvis"]).tolist() == [True, False]


def test_a_program_without_solution_is_counted(monkeypatch: pytest.MonkeyPatch):
    import mink

    def fail(*args, **kwargs):
        raise mink.NoSolutionFound("daqp")

    monkeypatch.setattr(mink, "solve_ik", fail)
    result = ik.solve([STAY], 3, FPS)
    assert result.failures.tolist() == [0, 1, 2] == result.unsettled.tolist()
    np.testing.assert_allclose(result.qpos, np.tile(ik.standing(), (3, 1)))


@pytest.mark.parametrize(
    ("target", "message"),
    [
        (PointTarget("tail", [0.0, 0.0, 0.0], 1.0), "no body 'tail'"),
        (PointTarget("pelvis", np.zeros((4, 3)), 1.0), r"target 'pelvis': shape \(4, 3\) does not fit 3 frames"),
        (PointTarget("pelvis", [0.0, np.nan, 0.0], 1.0), "target 'pelvis': frame 0"),
        (PointTarget("pelvis", np.zeros(3), -1.0), "weight: must be"),
        (OrientationTarget("pelvis", np.zeros(4), 1.0), "no direction"),
        (PostureTarget(np.zeros(29), 1.0, name="posture"), r"\['posture'\] occur more than once"),
    ],
)
def test_bad_targets_are_named(target: ik.Target, message: str):
    with pytest.raises(ValueError, match=message):
        ik.solve([target, STAY], 3, FPS)


def test_a_missing_extra_says_what_to_install(monkeypatch: pytest.MonkeyPatch):
    def missing(name: str):
        raise ImportError(name=name)

    monkeypatch.setattr(ik, "import_module", missing)
    with pytest.raises(ImportError, match=r"needs daqp.*pip install 'hdmi\[retarget\]'"):
        ik.solve([STAY], 1, FPS)
