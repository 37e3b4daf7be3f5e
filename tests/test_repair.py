"""Repair: references broken on purpose come back, good ones stay, and what cannot be repaired is said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hdmi.assembly import scene_parts
from hdmi.assets import RobotConfig, g1
from hdmi.commands import repair
from hdmi.config import ConfigError, task_config
from hdmi.motion import Motion, MotionError, Playback, find_motion, load_motion, make_playback, save_motion
from hdmi.motion.complete import complete_robot
from hdmi.motion.kinematics import derivative, forward_kinematics, minimum_jerk
from hdmi.workshop.ik import Obstacle, PointTarget, PostureTarget, solve, standing
from hdmi.workshop.repair import Comparison, repair_motion
from hdmi.workshop.repair.rest import at_rest
from hdmi.workshop.validate import Finding, Report

pytest.importorskip("mink")

FRAMES = slice(60, 260, 2)  # of lift_box: the hands come, lift, hold, put down and leave


def cut(motion: Motion, frames: slice, fps: float | None = None) -> Motion:
    """Some frames of a motion."""
    arrays = {key: value[frames] for key, value in vars(motion).items() if np.ndim(value) > 1}
    return replace(motion, fps=fps or motion.fps, **arrays)


@pytest.fixture(scope="module")
def lift_box() -> tuple[Motion, dict[str, Any]]:
    """A hundred frames of the shipped reference, with all bodies, and its scene."""
    motion = cut(complete_robot(load_motion(find_motion("lift_box"))), FRAMES, 25.0)
    return motion, scene_parts(task_config("lift_box"))


def with_robot(
    motion: Motion, up: np.ndarray | float, joints: dict[str, np.ndarray] | None = None, sideways: float = 0.0
) -> Motion:
    """The motion with the robot moved and its joints turned by offsets; all of its bodies follow."""
    joint_pos = np.zeros((motion.num_frames, len(g1.JOINT_NAMES)))
    for j, name in enumerate(g1.JOINT_NAMES):
        joint_pos[:, j] = motion.joint_pos[:, motion.joint_names.index(name)] + (joints or {}).get(name, 0.0)
    pelvis = motion.body_names.index("pelvis")
    root = motion.body_pos_w[:, pelvis].astype(float)
    root[:, 1] += sideways
    root[:, 2] += up
    new_pos, new_quat = forward_kinematics(RobotConfig().model, root, motion.body_quat_w[:, pelvis], joint_pos)
    pos, quat = motion.body_pos_w.copy(), motion.body_quat_w.copy()
    for i, name in enumerate(motion.body_names):
        if name in g1.BODY_NAMES:
            pos[:, i], quat[:, i] = (new[:, g1.BODY_NAMES.index(name)] for new in (new_pos, new_quat))
    columns = [g1.JOINT_NAMES.index(name) for name in motion.joint_names]
    return replace(motion, body_pos_w=pos, body_quat_w=quat, joint_pos=joint_pos[:, columns].astype(np.float32))


def with_object(motion: Motion, name: str, offset: np.ndarray) -> Motion:
    """The motion with a body moved. [3] or [T, 3]"""
    pos = motion.body_pos_w.copy()
    pos[:, motion.body_names.index(name)] += offset.astype(np.float32)
    return replace(motion, body_pos_w=pos)


def played(motion: Motion, parts: dict[str, Any]) -> Playback:
    return make_playback(motion, **parts)


def soles(playback: Playback) -> np.ndarray:
    """Points under both feet, m. [T, 8, 3]"""
    points = []
    for foot in g1.FEET:
        pos, mat = playback.body_poses(foot)
        points += [pos + mat @ np.subtract(point, (0.0, 0.0, g1.FOOT_POINT_RADIUS)) for point in g1.FOOT_POINTS]
    return np.stack(points, axis=1)


def furthest(playback: Playback) -> float:
    """Of the effectors from their contact points while contact is labelled, m."""
    apart = np.linalg.norm(playback.effector_pos_w - playback.contact_pos_w, axis=-1)
    return float(apart[playback.reference.contact.numpy()].max())


class TestBroken:
    def test_a_robot_in_the_air_comes_down_and_its_feet_stand_still(self, lift_box):
        motion, parts = lift_box
        broken = with_robot(motion, up=0.04)
        assert soles(played(broken, parts))[..., 2].min() > 0.03
        points = soles(played(repair_motion(broken, **parts).motion, parts))
        assert np.abs(points[..., 2]).max() < 0.003
        assert np.ptp(points[..., :2], axis=0).max() < 0.005

    def test_feet_that_slide_stand_still(self, lift_box):
        motion, parts = lift_box
        swaying = 0.06 * np.sin(np.arange(motion.num_frames) / 4)
        broken = with_robot(motion, 0.0, {f"{side}_hip_pitch_joint": swaying for side in ("left", "right")})
        assert np.ptp(soles(played(broken, parts))[..., 0], axis=0).max() > 0.05
        points = soles(played(repair_motion(broken, **parts).motion, parts))
        assert np.ptp(points[..., :2], axis=0).max() < 0.005
        assert np.abs(points[..., 2]).max() < 0.003

    def test_palms_beside_the_box_touch_it_and_press(self, lift_box):
        motion, parts = lift_box
        shifted = np.array([0.0, 0.03, 0.0])
        broken = replace(with_object(motion, "box", shifted), contact_points=None)
        before, after = (played(m, parts) for m in (broken, repair_motion(broken, press=0.01, **parts).motion))
        assert furthest(before) > 0.025
        assert furthest(after) < 0.012
        label = after.reference.contact.numpy()
        for e, effector in enumerate(parts["effectors"]):
            depth = -after.object_distance[:, after.on_bodies([effector.body])].min(axis=1)[label[:, e]]
            assert depth.max() < 0.013
            assert np.median(depth) > 0.007

    def test_a_floating_box_stands_on_its_support_before_and_after_it_is_carried(self, lift_box):
        motion, parts = lift_box
        phase = minimum_jerk(np.linspace(0.0, 1.0, motion.num_frames))
        broken = with_object(motion, "box", np.outer(0.03 + 0.02 * phase, [0.0, 0.0, 1.0]))
        repaired = repair_motion(broken, **parts).motion
        box = motion.body_names.index("box")
        moved = repaired.body_pos_w[:, box] - motion.body_pos_w[:, box]
        free = ~motion.object_contact.any(axis=1)
        clearance = played(repaired, parts).object_clearance.min(axis=1)
        assert np.abs(clearance[free]).max() < 0.003
        assert np.abs(moved[[0, -1]]).max() < 0.003
        assert np.abs(np.diff(moved, axis=0)).max() < 0.004  # no jump where it is taken and put down

    def test_a_limb_that_nothing_asks_for_stays_where_it_was(self, lift_box):
        motion, parts = lift_box
        repaired = repair_motion(with_robot(motion, up=0.04), **parts).motion
        waist = motion.joint_names.index("waist_yaw_joint")
        assert np.abs(repaired.joint_pos[:, waist] - motion.joint_pos[:, waist]).max() < 0.05


@pytest.mark.parametrize(
    ("speed", "held", "rests"),  # in each fifth of a second
    [
        ([0, 0, 0, 1, 1, 0, 0], [0, 1, 1, 1, 1, 0, 0], [1, 1, 1, 0, 0, 1, 1]),  # taken and put down
        ([1, 1, 0, 0, 0, 1, 1], [1, 1, 1, 1, 1, 1, 1], [0, 0, 0, 0, 0, 0, 0]),  # held still
        ([1, 0, 0, 0, 0, 1, 1], [1, 1, 1, 1, 0, 0, 0], [0, 0, 0, 0, 0, 0, 0]),  # held still, and let go
    ],
)
def test_when_an_object_rests(speed, held, rests):
    fps, span = 50.0, 10
    path = np.cumsum(np.repeat(speed, span)) / fps
    pos, quat = np.outer(path, [1.0, 0.0, 0.0]), np.tile([1.0, 0.0, 0.0, 0.0], (len(path), 1))
    found = np.zeros(len(path), int)
    for first, last in at_rest(pos, quat, fps, np.repeat(held, span).astype(bool)):
        found[first : last + 1] = 1
    assert found[span // 2 :: span].tolist() == rests


def test_a_good_reference_hardly_changes(lift_box):
    motion, parts = lift_box
    once = repair_motion(motion, **parts).motion
    assert np.abs(once.body_pos_w - motion.body_pos_w).max() < 0.015  # hands press less
    twice = repair_motion(once, **parts).motion
    assert np.abs(twice.body_pos_w - once.body_pos_w).max() < 0.005


def test_a_body_that_is_rigid_with_the_robot_moves_with_it(lift_box):
    motion, parts = cut(lift_box[0], slice(0, 10)), lift_box[1]
    torso = motion.body_names.index("torso_link")
    pos, quat = motion.body_pos_w[:, torso], motion.body_quat_w[:, torso]

    def logo(pos: np.ndarray, quat: np.ndarray) -> np.ndarray:
        return pos + Rotation.from_quat(quat, scalar_first=True).apply([0.1, 0.0, 0.3])

    extra = {"body_pos_w": logo(pos, quat), "body_quat_w": quat, "body_lin_vel_w": pos, "body_ang_vel_w": pos}
    arrays = {key: np.concatenate([getattr(motion, key), value[:, None]], axis=1) for key, value in extra.items()}
    lifted = with_robot(replace(motion, body_names=(*motion.body_names, "logo_link"), **arrays), up=0.0)
    lifted.body_pos_w[:, :-3, 2] += 0.04  # neither box nor stand
    lifted.body_pos_w[:, -1, 2] += 0.04
    repaired = repair_motion(lifted, **parts).motion
    expected = logo(repaired.body_pos_w[:, torso], repaired.body_quat_w[:, torso])
    np.testing.assert_allclose(repaired.body_pos_w[:, -1], expected, atol=1e-4)
    assert np.abs(repaired.body_pos_w[:, -1] - lifted.body_pos_w[:, -1]).max() > 0.03


def test_names_rate_labels_and_velocities(lift_box):
    motion, parts = lift_box
    order = [*reversed(range(len(motion.body_names)))]
    keys = ("body_pos_w", "body_quat_w", "body_lin_vel_w", "body_ang_vel_w")
    shuffled = replace(
        motion,
        body_names=tuple(motion.body_names[i] for i in order),
        joint_target=motion.joint_pos + 0.1,
        **{key: getattr(motion, key)[:, order] for key in keys},
    )
    repaired = repair_motion(cut(shuffled, slice(0, 20)), **parts).motion
    assert (repaired.body_names, repaired.joint_names, repaired.fps) == (shuffled.body_names, motion.joint_names, 25.0)
    np.testing.assert_array_equal(repaired.object_contact, motion.object_contact[:20])
    np.testing.assert_allclose(repaired.body_lin_vel_w, derivative(repaired.body_pos_w, 25.0), atol=1e-4)
    np.testing.assert_allclose(repaired.joint_target - repaired.joint_pos, 0.1, atol=1e-5)
    held = np.isin(motion.joint_names, parts["robot"].held_joints)
    default = parts["robot"].default_joint_pos[[g1.JOINT_NAMES.index(name) for name in motion.joint_names]]
    np.testing.assert_allclose(repaired.joint_pos[:, held], np.broadcast_to(default, (20, 29))[:, held], atol=1e-6)


class TestInverseKinematics:
    def test_joints_that_the_robot_holds_stay(self):
        reach = PointTarget("left_wrist_yaw_link", [0.35, 0.25, 0.9], 50.0, point=(0.1, 0.0, 0.0))
        robot = RobotConfig(held=["left_wrist_.*", "left_elbow_joint"], default_pose={"left_wrist_yaw_joint": -0.4})
        result = solve([reach, PostureTarget(standing()[7:], 0.1)], 3, 50.0, robot=robot)
        held = np.isin(g1.JOINT_NAMES, robot.held_joints)
        np.testing.assert_allclose(result.joint_pos[:, held], np.tile(robot.default_joint_pos[held], (3, 1)), atol=1e-5)
        assert not len(result.failures)

    def test_an_obstacle_yields_to_whom_it_is_told_to(self):
        reach = PointTarget("left_wrist_yaw_link", [0.5, 0.2, 0.9], 10.0, point=(0.15, 0.0, 0.0))
        wall = Obstacle("wall", [{"box": (0.1, 2.0, 2.0)}], [0.45, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0])
        stay = [PostureTarget(standing()[7:], 0.5), PointTarget("pelvis", standing()[:3], 100.0)]
        for yields, depth in (({}, 0.0), ({"left_wrist_yaw_link": 0.02}, 0.02)):
            result = solve([reach, *stay], 1, 50.0, obstacles=[replace(wall, yields=yields)])
            assert float(result.penetration["wall"][0]) == pytest.approx(depth, abs=0.004)
        with pytest.raises(ValueError, match="yields: the robot has no body 'hand'"):
            solve([reach, *stay], 1, 50.0, obstacles=[replace(wall, yields={"hand": 0.1})])


def report(**values: tuple[float | None, str]) -> Report:
    return Report(
        "made", 10, 50.0, tuple(Finding(c, verdict, v, "m", 1.0, 3.0, c) for c, (v, verdict) in values.items())
    )


@pytest.mark.parametrize(
    ("before", "after", "worse"),
    [
        ((0.5, "good"), (0.9, "good"), False),
        ((0.9, "good"), (1.1, "usable"), True),
        ((0.98, "good"), (1.02, "usable"), False),
        ((2.0, "usable"), (2.1, "usable"), False),
        ((2.0, "usable"), (2.5, "usable"), True),
        ((2.0, "usable"), (1.5, "usable"), False),
        ((2.9, "usable"), (3.1, "bad"), True),
        ((None, "good"), (1.5, "usable"), True),
        ((2.0, "usable"), (None, "good"), False),
        ((None, "bad"), (None, "bad"), False),  # not read before, nor after
    ],
)
def test_what_counts_as_worse(before, after, worse):
    compared = Comparison(report(foot_slide=before), report(foot_slide=after))
    assert bool(compared.worse) == worse
    assert compared.table().row_count == 1


class TestCommand:
    def test_writes_beside_the_motion_and_shows_both(self, lift_box, tmp_path, capsys):
        motion, _ = lift_box
        source = save_motion(cut(with_robot(motion, up=0.04), slice(0, 30)), tmp_path / "lift_box")
        assert repair.main([str(source)]) == 0
        shown = capsys.readouterr().out
        assert "standing_height" in shown
        assert "usable -> good" in shown
        assert soles_of(tmp_path / "lift_box_repaired") < 0.003
        assert soles_of(source) > 0.03

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["task=lift_bix"], "lift_bix"),
            (["press=1"], "press: expected 0 to 0.05 m, got 1"),
            (["out={there}"], "exists; name a folder that does not"),
            (["tsak=none"], "did you mean task?"),
        ],
    )
    def test_mistakes_are_one_line(self, lift_box, tmp_path, capsys, arguments, message):
        source = save_motion(cut(lift_box[0], slice(0, 3)), tmp_path / "lift_box")
        (tmp_path / "there").mkdir()
        assert repair.main([str(source), *(a.format(there=tmp_path / "there") for a in arguments)]) == 2
        said = capsys.readouterr().err
        assert message in said
        assert said.count("\n") == 1
        assert not (tmp_path / "lift_box_repaired").exists()

    def test_a_folder_that_is_no_motion(self, tmp_path, capsys):
        assert repair.main([str(tmp_path), "task=none"]) == 2
        assert "a motion is a folder with motion.npz and meta.json" in capsys.readouterr().err


def soles_of(folder: Path) -> float:
    """Height of the lowest sole of a motion, m."""
    return float(soles(played(load_motion(folder), scene_parts(task_config("lift_box"))))[..., 2].min())


def test_what_cannot_be_repaired(lift_box):
    motion, parts = lift_box
    with pytest.raises(MotionError, match="has no object_contact labels; annotate it first"):
        repair_motion(replace(motion, object_contact=None, contact_points=None), **parts)
    other = RobotConfig(model=replace(RobotConfig().model, name="a robot"))
    with pytest.raises(ConfigError, match="not for a robot"):
        repair_motion(motion, robot=other)


@pytest.mark.slow
def test_the_suitcase_of_the_public_motions(public_motions: Path):
    motion, parts = load_motion(public_motions / "move_suitcase"), scene_parts(task_config("move_suitcase"))
    before, after = (played(m, parts) for m in (motion, repair_motion(motion, **parts).motion))
    assert before.ground_gap > 0.04
    assert after.ground_gap < 0.002
    assert furthest(before) > 0.2
    assert furthest(after) < 0.03
    assert np.abs(after.object_clearance[:120].min(axis=1)).max() < 0.002
