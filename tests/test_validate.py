"""Validation: motions made by hand with one known fault each, found in the right frames."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import mujoco
import numpy as np
import pytest

from hdmi.assembly import scene_parts
from hdmi.assets import Effector, ObjectConfig, default_joint_pos, g1, g1_robot
from hdmi.commands import validate
from hdmi.config import task_config
from hdmi.motion import Motion, find_motion, forward_kinematics, load_motion, make_playback, robot_model, save_motion
from hdmi.motion.format import motion_from_poses
from hdmi.motion.kinematics import derivative
from hdmi.workshop.validate import LIMITS, Limit, Series, judge, validate_motion

FPS, T = 50.0, 60
PELVIS = g1.BODY_NAMES.index("pelvis")


def moved(
    *, z: np.ndarray | float = 0.0, x: np.ndarray | float = 0.0, joints: dict[str, np.ndarray | float] | None = None
) -> Motion:
    """The default pose, soles flat on the floor, moved by offsets of the root [T], with some joints at other angles."""
    standing = default_joint_pos()
    for side in ("left", "right"):
        hip, knee, ankle = (
            g1.JOINT_NAMES.index(f"{side}_{name}_joint") for name in ("hip_pitch", "knee", "ankle_pitch")
        )
        standing[ankle] = -standing[hip] - standing[knee]
    joint_pos = np.tile(standing, (T, 1))
    for name, angle in (joints or {}).items():
        joint_pos[:, g1.JOINT_NAMES.index(name)] = angle
    root_pos, root_quat = np.zeros((T, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (T, 1))
    feet, _ = forward_kinematics(g1_robot(), root_pos[:1], root_quat[:1], standing[None])
    root_pos[:, 2] = g1.FOOT_POINT_RADIUS - g1.FOOT_POINTS[0][2] - feet[0, g1.BODY_NAMES.index(g1.FEET[0]), 2] + z
    root_pos[:, 0] = x
    return from_qpos(root_pos, root_quat, joint_pos)


def from_qpos(root_pos: np.ndarray, root_quat: np.ndarray, joint_pos: np.ndarray) -> Motion:
    pos, quat = forward_kinematics(g1_robot(), root_pos, root_quat, joint_pos)
    return motion_from_poses("made", FPS, g1.BODY_NAMES, g1.JOINT_NAMES, pos, quat, joint_pos)


def with_box(motion: Motion, box_pos: np.ndarray) -> Motion:
    """The motion beside an upright box with a path of its own. [T, 3]"""
    extra = {
        "body_pos_w": box_pos,
        "body_quat_w": np.tile([1.0, 0.0, 0.0, 0.0], (T, 1)),
        "body_lin_vel_w": derivative(box_pos, FPS),
        "body_ang_vel_w": 0 * box_pos,
    }
    arrays = {key: np.concatenate([getattr(motion, key), value[:, None]], axis=1) for key, value in extra.items()}
    return replace(motion, body_names=(*motion.body_names, "box"), **arrays)


def within(first: int, last: int, value: float) -> np.ndarray:
    """`value` in a span of frames, else zero. [T]"""
    out = np.zeros(T)
    out[first : last + 1] = value
    return out


def spans(finding) -> list[tuple[int, int]]:
    return [(fault.first, fault.last) for fault in finding.faults]


@pytest.fixture(scope="module")
def lift_box() -> tuple[Motion, dict]:
    """The shipped reference and its scene."""
    return load_motion(find_motion("lift_box")), scene_parts(task_config("lift_box"))


class TestRobot:
    def test_standing_is_good(self):
        report = validate_motion(moved())
        assert (report.verdict, report.reasons) == ("good", ())
        assert report["centre_of_pressure"].value == pytest.approx(0, abs=1e-3)
        assert report["contact_gap"].value is None  # nothing to touch

    def test_floating_foot(self):
        finding = validate_motion(moved(z=within(20, 39, 0.06)))["floating"]
        assert finding.verdict == "usable"
        assert finding.value == pytest.approx(0.06, abs=1e-4)
        assert spans(finding) == [(20, 39)]

    def test_standing_above_the_ground(self):
        report = validate_motion(moved(z=0.045))
        assert report["standing_height"].value == pytest.approx(0.045, abs=1e-4)
        assert report["standing_height"].verdict == "usable"
        assert spans(report["standing_height"]) == [(0, T - 1)]
        # the height is one fault; that nothing carries the robot is not another
        assert report["ground_force"].verdict == report["torque"].verdict == "good"

    def test_flight_is_not_floating(self):
        time = np.arange(T) / FPS - 0.6
        height = np.maximum(0.0, 0.5 * 9.81 * (0.3**2 - time**2))  # leaves at 0.3 s, lands at 0.9 s
        assert height.max() > LIMITS["floating"].bad
        for first, last in spans(validate_motion(moved(z=height))["floating"]):
            assert last < 24 or first > 36  # around take-off and landing the filtered acceleration is not free fall
        levitating = validate_motion(moved(z=within(10, 59, 0.2)))["floating"]
        assert levitating.verdict == "bad"

    def test_the_shortest_motions(self):
        motion = moved()
        arrays = ("body_pos_w", "body_quat_w", "body_lin_vel_w", "body_ang_vel_w", "joint_pos", "joint_vel")
        for count in (2, 3, 4):
            short = replace(motion, **{key: getattr(motion, key)[:count] for key in arrays})
            assert validate_motion(short).verdict == "good"

    def test_ground_penetration(self):
        finding = validate_motion(moved(z=within(20, 39, -0.03)))["ground_penetration"]
        assert (finding.verdict, spans(finding)) == ("usable", [(20, 39)])
        assert finding.value == pytest.approx(0.03, abs=1e-4)
        assert "foot" in finding.faults[0].part

    def test_slide(self):
        x = np.clip(np.arange(T) - 20, 0, 20) / FPS * 0.3  # 0.3 m/s from frame 20 to 40
        finding = validate_motion(moved(x=x))["foot_slide"]
        assert finding.verdict == "usable"
        assert finding.value == pytest.approx(0.3, abs=1e-3)
        ((first, last),) = spans(finding)
        assert (first, last) in ((20, 39), (20, 40), (21, 39))  # half the speed at either end

    def test_a_foot_may_slide_while_it_lands(self):
        def slides(last: int) -> list[tuple[int, int]]:
            x = np.clip(np.arange(T) - 20, 0, last - 20) / FPS * 0.4
            return spans(validate_motion(moved(x=x, z=within(18, 29, 0.03)))["foot_slide"])

        assert slides(30) == []
        assert slides(36) == [(32, 36)]  # lands at 30, and has two frames

    def test_a_foot_that_pushes_moves_with_what_it_pushes(self):
        x = np.clip(np.arange(T) - 20, 0, 20) / FPS * 0.3
        motion = moved(x=x, z=0.06)  # off the floor, toes on a box that stands on it
        ankle = motion.body_pos_w[:, motion.body_names.index(g1.FEET[0])]
        toes = max(point[0] for point in g1.FOOT_POINTS) + g1.FOOT_POINT_RADIUS
        motion = with_box(motion, ankle * [1, 1, 0] + [toes + 0.1, 0, 0.1])
        scene = {
            "object": ObjectConfig("box", [{"box": (0.1, 0.1, 0.1)}]),
            "effectors": [Effector(g1.FEET[0], (toes, 0, 0), (-0.1, 0, 0))],
        }

        def slides(label: bool) -> list[tuple[int, int]]:
            labelled = replace(motion, object_contact=np.full((T, 1), label))
            return [(f.first, f.last) for f in validate_motion(labelled, **scene)["foot_slide"].faults]

        assert slides(True) == []
        assert slides(False) != []  # it could stand on the box's edge

    def test_jump(self):
        report = validate_motion(moved(x=within(30, 59, 0.2)))
        assert report.verdict == "bad"
        assert report["acceleration"].value == pytest.approx(0.2 * FPS**2, rel=1e-3)
        assert spans(report["acceleration"]) == [(29, 30)]

    def test_torque(self):
        time = np.arange(T) / FPS
        swing = np.where(np.abs(time - 0.6) < 1 / 3, 0.45 * np.sin(2 * np.pi * 3 * (time - 0.6)), 0)
        finding = validate_motion(moved(joints={"waist_pitch_joint": swing}))["torque"]
        assert finding.verdict != "good"
        assert finding.faults[0].part == "waist_pitch_joint"
        (first, *_), (*_, last) = zip(*spans(finding), strict=True)
        assert 8 <= first <= 20
        assert 40 <= last <= 52

    def test_joint_limit_and_speed(self):
        report = validate_motion(moved(joints={"left_knee_joint": 0.669 - within(20, 29, 0.9)}))
        assert report["joint_limit"].value == pytest.approx(0.9 - 0.669 - 0.087267, abs=1e-4)
        assert (report["joint_limit"].verdict, spans(report["joint_limit"])) == ("bad", [(20, 29)])
        assert report["joint_velocity"].value == pytest.approx(0.9 * FPS / 2 / 20, rel=1e-3)
        assert report["joint_velocity"].faults[0].part == "left_knee_joint"
        high = g1.JOINT_RANGES[g1.JOINT_NAMES.index("left_elbow_joint")][1]
        bent = validate_motion(moved(joints={"left_elbow_joint": high + 0.03}))["joint_limit"]
        assert bent.value == pytest.approx(0.03, abs=1e-4)
        assert bent.verdict == "usable"

    def test_missing_joints(self):
        kept = [name for name in g1.JOINT_NAMES if "elbow" not in name and "shoulder" not in name]
        report = validate_motion(moved().with_joints(kept))
        assert (report["missing_joints"].value, report["missing_joints"].verdict) == (8, "usable")
        assert "left_elbow_joint" in report.notes[0]

    def test_bodies_beside_the_joints(self):
        motion = moved()
        knee = g1.BODY_NAMES.index("left_knee_link")
        motion.body_pos_w[10, knee, 1] += 0.05
        finding = validate_motion(motion)["fk_position"]
        assert finding.value == pytest.approx(0.05, abs=1e-4)
        assert [(f.first, f.last, f.part) for f in finding.faults] == [(10, 10, "left_knee_link")]

    def test_velocities_beside_the_positions(self):
        motion = moved()
        motion.joint_vel[15:18, 3] = 9.0
        motion.body_lin_vel_w[30:33, PELVIS] = 2.0
        report = validate_motion(motion)
        assert (report["joint_velocity_error"].value, spans(report["joint_velocity_error"])) == (9.0, [(15, 17)])
        assert report["body_velocity_error"].verdict == "bad"
        assert spans(report["body_velocity_error"]) == [(30, 32)]

    def test_velocities_of_centres_of_mass_are_velocities(self):
        motion = moved(joints={"left_hip_pitch_joint": 0.8 * np.sin(np.arange(T) / 8)})
        model, com = robot_model(g1_robot()), np.empty((T, len(g1.BODY_NAMES), 3))
        data = mujoco.MjData(model)
        for t in range(T):
            data.qpos[:] = [*motion.body_pos_w[t, PELVIS], *motion.body_quat_w[t, PELVIS], *motion.joint_pos[t]]
            mujoco.mj_kinematics(model, data)
            com[t] = data.xipos[1:]
        velocity = derivative(com, FPS)
        assert np.abs(velocity - motion.body_lin_vel_w).max() > LIMITS["body_velocity_error"].good
        assert validate_motion(replace(motion, body_lin_vel_w=velocity))["body_velocity_error"].value < 0.01

    def test_centre_of_pressure(self):
        """A robot that leans with its whole body over its toes: the plumb line of its mass misses them."""
        lean = 0.25
        motion = moved()
        ankle = motion.body_pos_w[0, g1.BODY_NAMES.index(g1.FEET[0])] * [1, 0, 1]
        rotation = np.array([[np.cos(lean), 0, np.sin(lean)], [0, 1, 0], [-np.sin(lean), 0, np.cos(lean)]])
        root_pos = ankle + (motion.body_pos_w[:, PELVIS] - ankle) @ rotation.T
        root_quat = np.tile([np.cos(lean / 2), 0, np.sin(lean / 2), 0], (T, 1))
        joint_pos = np.array(motion.joint_pos)
        for side in ("left", "right"):
            joint_pos[:, g1.JOINT_NAMES.index(f"{side}_ankle_pitch_joint")] -= lean
        motion = from_qpos(root_pos, root_quat, joint_pos)
        model = robot_model(g1_robot())
        data = mujoco.MjData(model)
        data.qpos[:] = [*root_pos[0], *root_quat[0], *joint_pos[0]]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        foot = motion.body_pos_w[0, g1.BODY_NAMES.index(g1.FEET[0])]
        expected = data.subtree_com[1, 0] - (foot[0] + g1.FOOT_POINTS[0][0])
        assert expected > 0.05
        finding = validate_motion(motion)["centre_of_pressure"]
        assert finding.verdict == "usable"
        assert finding.value == pytest.approx(expected, abs=0.02)
        assert spans(finding) == [(0, T - 1)]
        # it is where the force acts, however large that is
        bob = 0.009 * (1 - np.cos(2 * np.pi * 1.5 * np.arange(T) / FPS))
        bobbing = from_qpos(root_pos + bob[:, None] * [0, 0, 1], root_quat, joint_pos)
        assert validate_motion(bobbing)["centre_of_pressure"].value == pytest.approx(finding.value, rel=0.05)


class TestObject:
    def test_lift_box_is_good(self, lift_box):
        motion, scene = lift_box
        report = validate_motion(motion, **scene)
        assert (report.verdict, report.reasons, report.notes) == ("good", (), ())
        assert {finding.check for finding in report.findings} == set(LIMITS)
        assert all(finding.value is not None for finding in report.findings)

    def test_body_in_the_object(self):
        box_pos = np.tile([1.0, 0.0, 0.1], (T, 1))
        box_pos[20:40, 0] = 0.2  # shins are at 0.0 to 0.1
        motion = with_box(moved(), box_pos)
        report = validate_motion(motion, object=ObjectConfig("box", [{"box": (0.15, 0.3, 0.1)}]))
        assert report["object_penetration"].verdict != "good"
        assert spans(report["object_penetration"]) == [(20, 39)]
        assert "shin" in report["object_penetration"].faults[0].part
        assert spans(report["acceleration"]) == [(19, 20), (39, 40)]  # of the box

    def test_box_that_glides_by_itself(self):
        path = np.column_stack([1.0 + 0.3 * np.arange(T) / FPS, np.zeros(T), np.full(T, 0.1)])
        box = ObjectConfig("box", [{"box": (0.15, 0.3, 0.1)}], friction=0.5)
        finding = validate_motion(with_box(moved(), path), object=box)["object_force"]
        assert finding.value == pytest.approx(0.45, abs=0.05)  # friction, mostly
        still = np.repeat(path[:1], T, axis=0)
        assert validate_motion(with_box(moved(), still), object=box)["object_force"].value < 0.01

    def test_feet_are_as_high_as_what_they_stand_on(self):
        box_pos = np.tile([0.0, 0.0, 0.1], (T, 1))
        box = ObjectConfig("box", [{"box": (0.3, 0.3, 0.1)}])
        for lift, gap in ((0.2, 0.0), (0.23, 0.03)):
            playback = make_playback(with_box(moved(z=lift), box_pos), object=box)
            assert playback.ground_gap == pytest.approx(gap, abs=1e-3)
        # what is carried is no ground
        playback = make_playback(with_box(moved(z=0.2), box_pos + np.array([0, 0, 0.05])), object=box)
        assert playback.ground_gap == pytest.approx(0.2, abs=1e-3)

    def test_label_before_the_hands_arrive(self, lift_box):
        motion, scene = lift_box
        assert motion.object_contact is not None
        label = motion.object_contact.copy()
        first = int(label[:, 0].argmax())
        label[:first, 0] = True
        finding = validate_motion(replace(motion, object_contact=label), **scene)["contact_gap"]
        assert finding.verdict != "good"
        assert len(finding.faults) == 1
        assert finding.faults[0].first == 0
        assert first - 15 < finding.faults[0].last < first
        assert finding.faults[0].part == "left_wrist_yaw_link"

    def test_label_missing_while_the_box_is_lifted(self, lift_box):
        motion, scene = lift_box
        assert motion.object_contact is not None
        label = motion.object_contact.copy()
        label[80:131] = False  # the box rises from 1.6 to 2.6 s
        finding = validate_motion(replace(motion, object_contact=label), **scene)["unlabelled_contact"]
        assert finding.verdict == "usable"
        (first, last), *_ = spans(finding)
        assert 80 <= first <= 95
        assert 115 <= last <= 130

    def test_box_that_rises_by_itself(self, lift_box):
        motion, scene = lift_box
        still = {key: np.repeat(getattr(motion, key)[:1], motion.num_frames, axis=0) for key in ("joint_pos",)}
        box = motion.body_names.index("box")
        bodies = {key: np.array(getattr(motion, key)) for key in ("body_pos_w", "body_quat_w", "body_lin_vel_w")}
        for value in bodies.values():
            value[:, :box] = value[:1, :box]
        bodies["body_lin_vel_w"][:, :box] = 0
        alone = replace(
            motion, object_contact=np.zeros((300, 2), bool), joint_vel=0 * motion.joint_vel, **still, **bodies
        )
        finding = validate_motion(alone, **scene)["object_force"]
        assert finding.value == pytest.approx(1.0, abs=0.1)  # its weight
        assert len(finding.faults) == 1
        first, last = spans(finding)[0]
        assert 80 < first < 100  # more than 2 cm above the stand
        assert 200 < last < 220

    def test_contact_point_elsewhere(self, lift_box):
        motion, scene = lift_box
        left, right = scene["effectors"]
        x, y, z = left.target
        moved_target = replace(left, target=(x, y, z + 0.25))
        motion = replace(motion, contact_points=None)
        finding = validate_motion(motion, **{**scene, "effectors": [moved_target, right]})["contact_point"]
        assert finding.verdict == "usable"
        assert finding.value == pytest.approx(0.25, abs=0.01)
        assert finding.faults[0].part == "left_wrist_yaw_link"

    @pytest.mark.parametrize(
        ("tolerance", "value"), [({"tolerance": 0.2}, 0.05), ({"reduce": "max"}, 0.01), ({"tolerance": 0.3}, 0.0)]
    )
    def test_contact_point_within_the_tolerance_of_the_task(self, lift_box, tolerance, value):
        motion, scene = lift_box
        left, right = scene["effectors"]
        x, y, z = left.target
        effectors = [replace(left, target=(x, y, z + 0.25)), right]
        motion = replace(motion, contact_points=None)
        report = validate_motion(motion, **{**scene, "effectors": effectors}, **tolerance)
        assert report["contact_point"].value == pytest.approx(value, abs=0.01)

    def test_a_fault_of_the_scene_is_no_verdict_on_the_motion(self, lift_box):
        motion, scene = lift_box
        box = replace(scene["object"], geoms=[{"box": (0.1, 0.1)}])
        with pytest.raises(ValueError, match=r"geoms\[0\].box: 3 positive numbers"):
            validate_motion(motion, **{**scene, "object": box})

    def test_wrong_task_is_named(self, lift_box):
        motion, _ = lift_box
        scene = {"object": ObjectConfig("vase", [{"sphere": 0.1}]), "effectors": [Effector("left_wrist_yaw_link")]}
        report = validate_motion(motion, **scene)
        assert report.verdict == "bad"
        assert "vase" in report.reasons[0]

    def test_undescribed_bodies_are_noted(self, lift_box):
        motion, _ = lift_box
        assert any("box, stand" in note for note in validate_motion(motion).notes)


def test_documented_limits_are_the_limits():
    text = (Path(__file__).parents[1] / "docs" / "motions.md").read_text(encoding="utf-8")
    for check, limit in LIMITS.items():
        bad = f"{limit.bad:g}" if np.isfinite(limit.bad) else "-"
        assert f"| `{check}` | {limit.good:g} | {bad} | {limit.unit} | {limit.share:g} | {limit.about} |" in text


class TestJudge:
    LIMIT = Limit(1.0, 2.0, "m", "made up", share=0.1)

    def judge(self, values: list[float]):
        return judge("check", Series(np.array(values)[:, None], ["part"]), self.LIMIT)

    def test_share_of_frames_may_exceed(self):
        assert self.judge([0.0] * 19 + [9.0]).verdict == "good"
        assert self.judge([0.0] * 17 + [1.5] * 3).verdict == "usable"
        assert self.judge([0.0] * 17 + [9.0] * 3).verdict == "bad"

    def test_bounds_themselves_are_allowed(self):
        assert self.judge([1.0] * 9).verdict == "good"
        assert self.judge([2.0] * 9).verdict == "usable"

    def test_reasons_say_what_bound_and_where_it_is_worst(self):
        values = np.array([[0.0, 1.2], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [1.7, 0.0], [1.5, 1.6]])
        finding = judge("check", Series(values, ["knee", "toe"]), self.LIMIT)
        assert finding.reason() == "check 1.7 m, above 1: knee, frames 0, 4-5"
        assert (
            judge("check", Series(values[:4], ["knee", "toe"]), self.LIMIT).reason().endswith("above 1: toe, frame 0")
        )
        worse = judge("check", Series(2 * values, ["knee", "toe"]), self.LIMIT)
        assert worse.reason() == "check 3.4 m, above 2: knee, frames 0, 4-5"

    def test_frames_to_which_it_does_not_apply(self):
        nan = float("nan")
        assert self.judge([nan] * 17 + [9.0] * 3).verdict == "bad"
        assert self.judge([nan] * 20).value is None

    def test_short_gaps_join_faults(self):
        finding = self.judge([0, 3, 0, 0, 5, 0, 0, 0, 4, 0])
        assert [(f.first, f.last, f.worst, f.value) for f in finding.faults] == [(1, 4, 4, 5.0), (8, 8, 8, 4.0)]


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return validate


class TestScript:
    def test_good_motion(self, script, capsys):
        assert script.main([str(find_motion("lift_box")), "--json"]) == 0
        report = json.loads(capsys.readouterr().out)
        assert (report["verdict"], report["motion"], report["num_frames"]) == ("good", "lift_box", 300)
        assert {finding["check"] for finding in report["findings"]} == set(LIMITS)

    def test_tolerance_of_the_task_counts(self, script, tmp_path):
        """Hands that roll a ball are far from its points, and the task lets them be."""
        motion = replace(load_motion(find_motion("roll_ball")), contact_points=None)
        save_motion(motion, tmp_path / "roll_ball")
        strict = validate_motion(motion, **scene_parts(task_config("roll_ball")))["contact_point"]
        assert strict.verdict == "bad"
        report = script.report_on(tmp_path / "roll_ball", None)
        assert report["contact_point"].verdict == "good"
        assert report["contact_point"].value == pytest.approx(strict.value - 0.4, abs=0.1)
        assert report.verdict != "bad"

    def test_bad_motion(self, script, tmp_path, capsys):
        save_motion(moved(x=within(30, 59, 0.4)), tmp_path / "jumpy")
        assert script.main([str(tmp_path / "jumpy")]) == 1
        out = capsys.readouterr().out
        assert "bad" in out
        assert "acceleration" in out
        assert "29-30" in out

    def test_unreadable_motion(self, script, tmp_path, capsys):
        assert script.main(["--json", str(tmp_path)]) == 1
        report = json.loads(capsys.readouterr().out)
        assert report["verdict"] == "bad"
        assert "meta.json" in report["reasons"][0]

    @pytest.mark.parametrize("arguments", [[], ["a", "b"], ["nowhere"], ["a", "tusk=none"], ["a", "task=nothing"]])
    def test_wrong_arguments(self, script, arguments, capsys):
        assert script.main(arguments) == 2
        said = capsys.readouterr()
        assert len(said.err.splitlines()) == 1
        assert not said.out

    def test_public_motions(self, script, public_motions):
        imperfect = script.report_on(public_motions / "move_suitcase", None)
        assert imperfect["standing_height"].value == pytest.approx(0.045, abs=0.01)
        assert sum(last - first + 1 for first, last in spans(imperfect["standing_height"])) > 400
        perfect = script.report_on(public_motions / "move_suitcase_perfect", "move_suitcase")
        assert perfect["standing_height"].verdict == perfect["floating"].verdict == "good"
        assert perfect["object_force"].value < 0.01
        for report in (imperfect, perfect, script.report_on(public_motions / "walk", None)):
            assert report.verdict != "bad"
            assert report["fk_position"].value < 1e-3
