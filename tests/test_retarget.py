"""Retargeting: people whose motion is known, and the robot's own motions as if they were people's."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import people
import pytest
from scipy.spatial.transform import Rotation
from sources import write_amass, write_gvhmr

from hdmi.assets import Effector, HingeConfig, ObjectConfig, g1
from hdmi.commands import retarget as retarget_command
from hdmi.motion import Motion, MotionError, load_motion, make_reference, save_motion
from hdmi.workshop.human import HumanMotion, ObjectTrajectory
from hdmi.workshop.retarget import RetargetOptions, RetargetReport, retarget
from hdmi.workshop.retarget.body import find_scaling, read_body, robot_measures
from hdmi.workshop.retarget.feet import find_stances
from hdmi.workshop.retarget.object import handled_point, lowest_point, object_poses, obstacles, on_object, scale_object

pytest.importorskip("mink")

BOX = ObjectConfig("box", [{"box": [0.15, 0.2, people.BOX_HALF_HEIGHT]}])
WRIST = Effector("left_wrist_yaw_link", (0.15, 0.0, 0.0), (-0.15, 0.0, 0.0))


def joint(motion: Motion, name: str) -> np.ndarray:
    return motion.joint_pos[:, motion.joint_names.index(name)]


def body(motion: Motion, name: str) -> np.ndarray:
    return motion.body_pos_w[:, motion.body_names.index(name)]


def assert_sound(report: RetargetReport) -> None:
    """What the issue of any retargeting should be."""
    assert report.solver_failures == []
    assert len(report.unsettled) <= 0.03 * report.frames
    assert report.slide is not None
    assert report.slide["p99"] < 0.01
    assert all(depth["p99"] < 0.01 for depth in report.penetration.values())
    assert report.joint_speed <= 1.001


class TestSquat:
    @pytest.fixture(scope="class")
    def result(self) -> tuple[Motion, RetargetReport]:
        return retarget(people.squat())

    def test_is_sound(self, result: tuple[Motion, RetargetReport]):
        motion, report = result
        assert_sound(report)
        assert report.stance_frames == {"left": motion.num_frames, "right": motion.num_frames}

    def test_goes_down_as_far_as_the_person_in_the_scaled_scene(self, result: tuple[Motion, RetargetReport]):
        motion, report = result
        drop = np.ptp(body(motion, "pelvis")[:, 2])
        assert drop == pytest.approx(0.3 * report.scale, abs=0.02)

    def test_bends_the_knees_as_the_person(self, result: tuple[Motion, RetargetReport]):
        motion, _ = result
        human = people.squat()
        _, knee = people.leg_angles((human.pos("left_ankle") - human.pos("left_hip"))[:, [0, 2]].astype(float))
        shank_lean = people.LEAN
        for side in ("left", "right"):
            error = joint(motion, f"{side}_knee_joint") - (knee + shank_lean)
            assert np.degrees(np.abs(error)).max() < 8

    def test_stands_on_the_ground(self, result: tuple[Motion, RetargetReport]):
        motion, _ = result
        heights = body(motion, "left_ankle_roll_link")[:, 2]
        np.testing.assert_allclose(heights, 0.035, atol=2e-3)


class TestWalk:
    @pytest.fixture(scope="class")
    def result(self) -> tuple[Motion, RetargetReport]:
        return retarget(people.walk())

    def test_is_sound(self, result: tuple[Motion, RetargetReport]):
        assert_sound(result[1])

    def test_steps_are_the_persons_scaled(self, result: tuple[Motion, RetargetReport]):
        motion, report = result
        human = people.walk()
        for side in ("left", "right"):
            path = body(motion, f"{side}_ankle_roll_link")[:, 0]
            expected = report.scale * human.pos(f"{side}_ankle")[:, 0]
            np.testing.assert_allclose(np.ptp(path), np.ptp(expected), atol=0.01)
            assert np.abs(path - expected).max() < 0.05

    def test_feet_swing_above_the_ground(self, result: tuple[Motion, RetargetReport]):
        motion, report = result
        height = body(motion, "left_ankle_roll_link")[:, 2]
        assert height.max() == pytest.approx(0.035 + report.scale * people.SWING_HEIGHT, abs=0.02)

    def test_finds_when_feet_stand(self):
        human = people.walk()
        stances = find_stances(read_body(human, 25.0), people.FPS)
        time = np.arange(human.num_frames) / people.FPS - 0.5
        for foot, side in enumerate(("left", "right")):
            share = (time / people.STEP_TIME - foot) % 2 * people.STEP_TIME / (0.8 * people.STEP_TIME)
            inside = (time > foot * people.STEP_TIME) & (time < 6 * people.STEP_TIME)
            swings = inside & (share > 0.2) & (share < 0.8)
            stands = ~inside | (share > 1.0)
            assert not stances.flat[side][swings].any()
            assert stances.flat[side][stands].mean() > 0.95


class TestReach:
    """The palm comes to lie on a box in front."""

    human = people.reach()

    @pytest.fixture(scope="class")
    def result(self) -> tuple[Motion, RetargetReport]:
        labels = np.zeros((self.human.num_frames, 1), bool)
        labels[60:90] = True
        touching = replace(self.human, contact=labels, contact_names=("left_wrist",))
        shallow = ObjectConfig("box", [{"box": [0.08, 0.2, people.BOX_HALF_HEIGHT]}])  # the forearm does not reach it
        return retarget(touching, shallow, effectors=[WRIST])

    def test_is_sound(self, result: tuple[Motion, RetargetReport]):
        assert_sound(result[1])
        assert set(result[1].penetration) == {"box", "floor", "robot"}

    def test_hand_touches_the_object_of_true_size_where_the_person_did(self, result: tuple[Motion, RetargetReport]):
        motion, _ = result
        hand = motion.body_names.index("left_wrist_yaw_link")
        turn = Rotation.from_quat(motion.body_quat_w[60:90, hand], scalar_first=True)
        palm = body(motion, "left_wrist_yaw_link")[60:90] + turn.apply([0.08, 0.0, 0.0])
        local = palm - body(motion, "box")[60:90]
        # the palm's point is 3.5 cm behind the hand's surface
        np.testing.assert_allclose(local[:, 2], people.BOX_HALF_HEIGHT + 0.035, atol=0.015)
        np.testing.assert_allclose(local[:, :2], 0.0, atol=0.02)

    def test_labels_are_the_effectors(self, result: tuple[Motion, RetargetReport]):
        labels = result[0].object_contact
        assert labels is not None
        assert np.flatnonzero(labels[:, 0]).tolist() == list(range(60, 90))

    def test_other_arm_hangs_as_the_persons(self, result: tuple[Motion, RetargetReport]):
        motion, _ = result
        arm = body(motion, "right_elbow_link") - body(motion, "right_shoulder_roll_link")
        person = self.human.pos("right_elbow") - self.human.pos("right_shoulder")
        cosine = (arm * person).sum(-1) / np.linalg.norm(arm, axis=-1) / np.linalg.norm(person, axis=-1)
        assert np.degrees(np.arccos(cosine.min())) < 20

    def test_makes_a_reference_that_is_read_back(self, result: tuple[Motion, RetargetReport], tmp_path: Path):
        folder = save_motion(result[0], tmp_path / "reach")
        reference = make_reference(load_motion(folder), control_dt=0.02, object=BOX, effectors=[WRIST])
        assert reference.has_object
        np.testing.assert_allclose(reference.object_pos.numpy(), body(result[0], "box"), atol=1e-6)

    def test_report_is_written(self, result: tuple[Motion, RetargetReport], tmp_path: Path):
        report = json.loads(result[1].save(tmp_path / "retarget.json").read_text())
        assert report["frames"] == self.human.num_frames
        assert report["height"] == people.HEIGHT
        assert report["residuals"]["left toes planted"]["p99"] < 1e-3


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_a_foot_on_its_toes_keeps_its_heading(yaw: float):
    """The shank of a kneeling person is tilted back until the foot stands on its tips, and further."""
    human = people.squat()
    phase = people.ease(np.linspace(-0.5, 1.2, human.num_frames))
    tilt, pitch = 1.4 * phase, np.radians(150) * phase
    pos = human.joint_pos.copy()
    knee = pos[:, human.index("left_knee")] = np.array([0.1, 0.09, 0.5])
    ankle = knee + 0.4 * np.column_stack([-np.sin(tilt), 0 * tilt, -np.cos(tilt)])
    pos[:, human.index("left_ankle")] = ankle
    pos[:, human.index("left_foot")] = ankle + 0.14 * np.column_stack([np.cos(pitch), 0 * pitch, -np.sin(pitch)])
    turned = Rotation.from_euler("z", yaw).apply(pos.reshape(-1, 3)).reshape(pos.shape)
    body = read_body(replace(human, joint_pos=turned, joint_quat=None), cutoff=25.0)
    np.testing.assert_allclose(body.foot_yaw["left"], yaw, atol=1e-3)
    np.testing.assert_allclose(body.foot_pitch["left"], pitch - pitch[0], atol=1e-3)


class TestObject:
    def test_keeps_its_size_and_stands_where_it_stood(self):
        pos = np.tile([1.0, 2.0, 0.1], (3, 1))
        pos[1] += [0.5, 0.0, 1.0]
        source = ObjectTrajectory("box", pos, np.tile([1.0, 0, 0, 0], (3, 1)))
        scaled = scale_object(source, 0.5, BOX)
        np.testing.assert_allclose(scaled.pos[0], [0.5, 1.0, 0.1], atol=1e-5)  # 0.1 is half its height
        np.testing.assert_allclose(scaled.pos[1], [0.75, 1.0, 0.6], atol=1e-5)
        np.testing.assert_allclose(scale_object(source, 0.5, None).pos, scaled.pos, atol=1e-5)

    def test_grows_away_from_the_hands_that_push_it(self):
        source = ObjectTrajectory("box", np.tile([2.0, 0.0, 0.1], (50, 1)), np.tile([1.0, 0, 0, 0], (50, 1)))
        approach = np.minimum(np.linspace(0.5, 2.0, 50), 1.83)  # 2 cm from the face at 1.85
        left, right = (np.column_stack([approach, np.full(50, y), np.full(50, 0.1)]) for y in (0.1, -0.1))
        anchor = handled_point([left, right], BOX, source)
        np.testing.assert_allclose(anchor, [-0.15, 0.0, 0.0], atol=1e-3)
        scaled = scale_object(source, 0.5, BOX, anchor)
        np.testing.assert_allclose(scaled.pos[0], [1.85 / 2 + 0.15, 0.0, 0.1], atol=1e-3)
        # one hand counts if the other stays away; none, if both do
        away = left + np.array([0.0, 2.0, 0.0])
        np.testing.assert_allclose(handled_point([left, away], BOX, source), [-0.15, 0.1, 0.0], atol=1e-3)
        np.testing.assert_allclose(handled_point([away, away], BOX, source), 0.0)

    @pytest.mark.parametrize(
        ("geom", "heights"),
        [
            ({"box": [0.15, 0.2, 0.1]}, [0.9, 0.8]),
            ({"sphere": 0.3}, [0.7, 0.7]),
            ({"capsule": [0.1, 0.3]}, [0.6, 0.9]),
            ({"cylinder": [0.1, 0.3]}, [0.7, 0.9]),
            ({"box": [0.1, 0.1, 0.1], "pos": [0.0, 0.0, -0.2]}, [0.7, 0.9]),
            ({"box": [0.1, 0.1, 0.3], "quat": [0.5**0.5, 0.0, 0.5**0.5, 0.0]}, [0.9, 0.9]),
        ],
    )
    def test_lowest_point_follows_its_orientation(self, geom: dict, heights: list[float]):
        quat = Rotation.from_euler("x", [[0], [90]], degrees=True).as_quat(scalar_first=True)
        thing = ObjectTrajectory("thing", np.tile([0.0, 0.0, 1.0], (2, 1)), quat)
        np.testing.assert_allclose(lowest_point(ObjectConfig("thing", [geom]), thing), heights, atol=1e-5)

    def test_a_palm_keeps_its_place_outside_of_the_surface(self):
        still = np.tile([1.0, 0.0, 0.0, 0.0], (4, 1))
        source = ObjectTrajectory("box", np.tile([1.0, 0.0, 0.5], (4, 1)), still)
        turned = Rotation.from_euler("z", np.full((4, 1), 90.0), degrees=True).as_quat(scalar_first=True)
        scaled = ObjectTrajectory("box", np.tile([0.5, 0.0, 0.4], (4, 1)), turned)
        # 10 cm from the near side, inside of it, 10 cm above, and half a metre away
        palms = np.array([[0.75, 0.1, 0.5], [0.86, 0.0, 0.5], [1.0, 0.0, 0.7], [0.35, 0.0, 0.5]])
        upright = Rotation.from_euler("y", np.full((4, 1), -90.0), degrees=True)
        moved, share = on_object(palms, upright, BOX, source, scaled, None, 50.0)
        np.testing.assert_allclose(moved[0], [0.4, -0.25, 0.4], atol=1e-4)
        np.testing.assert_allclose(moved[1], [0.5, -0.185, 0.4], atol=1e-4)  # the hand's radius, and half the box
        np.testing.assert_allclose(moved[2], [0.5, 0.0, 0.6], atol=1e-4)
        np.testing.assert_allclose(share, [0.896, 1.0, 0.896, 0.0], atol=1e-3)

    def test_a_labelled_palm_touches(self):
        source = ObjectTrajectory("box", np.tile([1.0, 0, 0], (9, 1)), np.tile([1.0, 0, 0, 0], (9, 1)))
        palms, labels = np.tile([0.4, 0.0, 0.0], (9, 1)), np.ones(9, bool)
        for pitch, reach in ((0.0, 0.105), (-90.0, 0.035)):  # fingertips first, and flat
            hand = Rotation.from_euler("y", np.full((9, 1), pitch), degrees=True)
            moved, share = on_object(palms, hand, BOX, source, source, labels, 50.0)
            np.testing.assert_allclose(moved[4], [0.85 - reach, 0.0, 0.0], atol=1e-4)
        np.testing.assert_allclose(share, 1.0)

    def test_link_turns_with_its_hinge(self):
        hinge = HingeConfig("door_joint", "panel", [{"box": [0.02, 0.5, 1.0], "pos": [0, -0.5, 0]}], pos=(0, 0.5, 0))
        door = ObjectConfig("door", [], hinge=hinge, fixed_base=True)
        angles = np.array([0.0, np.pi / 2], np.float32)
        source = ObjectTrajectory("door", np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1)), angles)
        pos, rotation = object_poses(door, source)["panel"]
        end = pos + rotation.apply([0.0, -1.0, 0.0])
        np.testing.assert_allclose(end, [[0, -0.5, 0], [1.0, 0.5, 0]], atol=1e-6)
        assert [obstacle.name for obstacle in obstacles(door, source)] == ["panel"]
        assert scale_object(source, 0.7, door).pos[:, 2].tolist() == [0.0, 0.0]


class TestScaling:
    def test_makes_the_legs_as_long_as_the_robots(self):
        human = people.squat()
        found = read_body(human, 25.0)
        scaling = find_scaling(human, found, find_stances(found, people.FPS).flat, None)
        assert scaling.scale == pytest.approx(robot_measures().leg / (people.THIGH + people.SHANK), rel=1e-3)
        assert scaling(found.pos["left_ankle"])[:, 2] == pytest.approx(0.035, abs=1e-3)

    def test_can_be_given(self):
        _, report = retarget(people.squat(seconds=0.3), options=RetargetOptions(scale=0.5))
        assert report.scale == 0.5

    def test_positions_alone_tell_the_orientations(self):
        human = people.reach()
        known, told = read_body(human, 25.0), read_body(replace(human, joint_quat=None), 25.0)
        for a, b, tolerance in ((known.pelvis, told.pelvis, 1), (known.torso, told.torso, 5)):
            assert np.degrees((a.inv() * b).magnitude()).max() < tolerance
        forward = [found.hands["right"].as_matrix()[:, :, 0] for found in (known, told)]
        assert (forward[0] * forward[1]).sum(-1).min() > 0.999


class TestRefusals:
    def test_missing_joints_are_named(self):
        human = people.squat(seconds=0.3)
        names = tuple("shoulder?" if name == "left_shoulder" else name for name in human.joint_names)
        with pytest.raises(
            MotionError, match=r"needs the joints \['left_shoulder'\]; .* other names it has shoulder\?"
        ):
            retarget(replace(human, joint_names=names))

    def test_an_object_without_poses(self):
        with pytest.raises(MotionError, match="has no object poses, so 'box' cannot be placed"):
            retarget(people.squat(seconds=0.3), BOX)

    def test_joints_that_coincide(self):
        human = people.squat(seconds=0.3)
        pos = human.joint_pos.copy()
        pos[:, human.index("left_hip")] = pos[:, human.index("right_hip")]
        with pytest.raises(MotionError, match="joints coincide at frame 0"):
            retarget(replace(human, joint_pos=pos, joint_quat=None))


def as_person(motion: Motion) -> HumanMotion:
    """The robot's joints under the names of a person's, positions only."""
    reference = make_reference(motion, control_dt=1 / motion.fps)
    pos, quat = reference.body_pos.numpy(), reference.body_quat.numpy()

    def at(name: str) -> np.ndarray:
        return pos[:, g1.BODY_NAMES.index(name)]

    points = {"pelvis": at("pelvis")}
    for side in ("left", "right"):
        for part, link in (
            ("hip", "hip_roll_link"), ("knee", "knee_link"), ("ankle", "ankle_roll_link"),
            ("shoulder", "shoulder_roll_link"), ("elbow", "elbow_link"), ("wrist", "wrist_pitch_link"),
        ):  # fmt: skip
            points[f"{side}_{part}"] = at(f"{side}_{link}")
        turn = Rotation.from_quat(quat[:, g1.BODY_NAMES.index(f"{side}_ankle_roll_link")], scalar_first=True)
        points[f"{side}_foot"] = points[f"{side}_ankle"] + turn.apply([0.12, 0.0, -0.02])
    return HumanMotion(motion.name, motion.fps, 1.3, tuple(points), np.stack(list(points.values()), axis=1))


@pytest.mark.parametrize(("name", "frames"), [("walk", slice(200)), ("move_suitcase", slice(60, 240))])
def test_the_robots_own_walk_and_kneel_come_back(public_motions: Path, name: str, frames: slice):
    motion = load_motion(public_motions / name)
    motion = replace(
        motion,
        **{key: value[frames] for key, value in vars(motion).items() if isinstance(value, np.ndarray)},
    )
    found, report = retarget(as_person(motion), options=RetargetOptions(cutoff=25.0))
    assert report.solver_failures == []
    assert report.scale == pytest.approx(1.0, abs=0.01)
    known = [name for name in motion.joint_names if name in g1.JOINT_NAMES and "wrist" not in name]
    error = np.degrees([np.abs(joint(found, name) - joint(motion, name)) for name in known])
    assert error.mean() < 6
    assert error.max() < 40


class TestGround:
    def test_who_floats_or_sinks_is_shifted_and_told(self):
        human = people.squat(seconds=0.3)
        plain, _ = retarget(human)
        for height, told in ((0.3, "shifted by -0.30 m"), (-0.5, "shifted by +0.50 m")):
            motion, report = retarget(human.shifted(np.array([0.0, 0.0, height])))
            np.testing.assert_allclose(motion.joint_pos, plain.joint_pos, atol=2e-3)
            np.testing.assert_allclose(motion.body_pos_w, plain.body_pos_w, atol=2e-3)
            assert told in report.notes[0]

    def test_the_object_is_shifted_along(self):
        human = people.reach()
        thing = replace(human.object, pos=human.object.pos[:20], quat=human.object.quat[:20])
        human = replace(human, joint_pos=human.joint_pos[:20], joint_quat=human.joint_quat[:20], object=thing)
        plain, raised = (retarget(human.shifted(np.array([0.0, 0.0, up]))) for up in (0.0, 0.4))
        np.testing.assert_allclose(body(raised[0], "box"), body(plain[0], "box"), atol=1e-5)

    def test_who_is_to_keep_their_height_does(self):
        raised = people.squat(seconds=0.3).shifted(np.array([0.0, 0.0, 0.5]))
        motion, report = retarget(raised, options=RetargetOptions(ground="keep"))
        assert body(motion, "left_ankle_roll_link")[:, 2].min() > 0.3
        assert report.notes == ["the lowest sole is 0.50 m above the ground, and kept there"]

    def test_who_is_out_of_reach_of_the_ground_is_asked_about(self):
        high = people.squat(seconds=0.3).shifted(np.array([0.0, 0.0, 40.0]))
        with pytest.raises(MotionError, match=r"'person'.*40\.00 m above the ground: .*ground=shift"):
            retarget(high)
        with pytest.raises(MotionError, match="ground: shift or keep expected, got 'lift'"):
            retarget(high, options=RetargetOptions(ground="lift"))


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return retarget_command


class TestScript:
    def test_from_a_file_to_a_motion_and_a_report(self, script, tmp_path, capsys):
        source, out = write_gvhmr(tmp_path / "hmr4d_results.pt"), tmp_path / "wave"
        assert script.main([f"source={source}", "source_fps=30", "height=1.8", f"out={out}"]) == 0
        assert str(out) in capsys.readouterr().out
        assert load_motion(out).fps == 50.0
        assert json.loads((out / "retarget.json").read_text())["name"] == "wave"

    def test_notes_are_shown_and_kept(self, script, tmp_path, capsys):
        source, out = write_amass(tmp_path / "walk.npz", "smplh"), tmp_path / "walk"
        assert script.main([f"source={source}", "source_fps=60", "up=z", f"out={out}"]) == 0
        told = "read at the 60 fps that source_fps says; mocap_framerate says 120"
        assert told in capsys.readouterr().out
        assert told in json.loads((out / "retarget.json").read_text())["notes"]

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["out=x"], "give source=PATH and out=FOLDER"),
            (["source=none.bvh", "out=x"], "none.bvh: no such file"),
            (["source=hmr4d_results.pt", "out=x"], "how fast the video is: give source_fps"),
            (["source=x.csv", "out=x"], "say which format"),
            (["source=none.bvh", "out=x", "format=fbx"], "there is no format 'fbx'"),
            (["source=none.bvh", "out=x", "body_model=x"], "bvh takes no body_model; it takes source_fps, up, unit"),
            (["source=none.bvh", "out=x", "cutoff=0"], "cutoff: expected more than 0, got 0"),
        ],
    )
    def test_wrong_arguments_say_what_is_wrong(self, script, arguments, message, capsys):
        assert script.main(arguments) == 2
        assert message in capsys.readouterr().err
