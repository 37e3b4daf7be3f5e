"""The motion format, its errors, and the reference that training reads."""

import json
import math

import numpy as np
import pytest
import torch

from hdmi.assets import Effector, HingeConfig, ObjectConfig, RobotConfig, SceneryConfig, g1, g1_robot
from hdmi.motion import MotionError, find_motion, forward_kinematics, load_motion, make_reference, save_motion
from hdmi.motion.complete import resample
from hdmi.motion.kinematics import angular_velocity, derivative

FPS, T = 50.0, 21  # of the synthetic motion in conftest.py
BOX = ObjectConfig("box", [{"box": (0.2, 0.2, 0.2)}])
HANDS = (
    Effector("left_wrist_yaw_link", target=(0.0, 0.2, 0.1)),
    Effector("right_wrist_yaw_link", target=(0.0, -0.2, 0.1)),
)
PUBLIC = (
    "carry_bread_box",
    "move_foam",
    "move_suitcase",
    "move_suitcase_perfect",
    "open_door_feet",
    "open_foldchair_sit",
    "push_box",
    "push_door_hand",
    "topple_wood_board",
    "walk",
)


def changed(array, index, value):
    out = np.array(array, dtype=np.float32)
    out[index] = value
    return out


class TestFormat:
    def test_load(self, write_motion, motion_arrays):
        motion = load_motion(write_motion())
        assert (motion.name, motion.fps, motion.num_frames) == ("stroll", FPS, T)
        assert motion.body_names == ("pelvis", "torso_link", "left_wrist_yaw_link", "box")
        np.testing.assert_array_equal(motion.body_pos_w, motion_arrays["body_pos_w"])
        np.testing.assert_array_equal(motion.joint_pos, motion_arrays["joint_pos"])
        assert motion.object_contact.dtype == bool
        assert motion.object_contact.sum() == 11
        assert motion.contact_points is None

    def test_absent_velocities_are_derived(self, write_motion):
        motion = load_motion(write_motion())
        box = motion.body_names.index("box")
        # the box slides along y at 0.2 m/s and turns about z at 0.8 rad/s
        np.testing.assert_allclose(motion.body_lin_vel_w[:, box], [[0, 0.2, 0]] * T, atol=1e-4)
        np.testing.assert_allclose(motion.body_ang_vel_w[:, box], [[0, 0, 0.8]] * T, atol=1e-4)
        np.testing.assert_allclose(motion.joint_vel[:, 1], 0.2, atol=1e-4)

    def test_given_velocities_are_kept(self, write_motion):
        velocity = np.full((T, 4, 3), 7.0, np.float32)
        motion = load_motion(write_motion(body_lin_vel_w=velocity))
        np.testing.assert_array_equal(motion.body_lin_vel_w, velocity)

    def test_round_trip_is_lossless(self, write_motion, tmp_path):
        rng = np.random.default_rng(0)
        quat = rng.normal(size=(T, 4, 4))
        quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
        more = {"contact_points": rng.normal(size=(T, 1, 3)), "joint_target": rng.normal(size=(T, 2))}
        first = load_motion(write_motion(body_quat_w=quat.astype(np.float32), **more))
        np.testing.assert_allclose(first.joint_target, more["joint_target"], rtol=1e-6)
        folder = save_motion(first, tmp_path / "again" / "stroll")
        second = load_motion(folder)
        for key, value in vars(first).items():
            if isinstance(value, np.ndarray):
                assert getattr(second, key).dtype == value.dtype, key
                np.testing.assert_array_equal(getattr(second, key), value, err_msg=key)
            else:
                assert getattr(second, key) == value, key

    def test_round_trip_without_labels(self, write_motion, tmp_path):
        again = load_motion(save_motion(load_motion(write_motion(drop=["object_contact"])), tmp_path / "again"))
        assert again.object_contact is again.contact_points is again.joint_target is None

    @pytest.mark.parametrize("labels", [np.ones(T), np.ones((T, 1), np.int64), np.ones((T, 1), bool)])
    def test_labels_of_one_column(self, write_motion, labels):
        contact = load_motion(write_motion(object_contact=labels)).object_contact
        assert contact.shape == (T, 1)
        assert contact.all()

    def test_nearly_unit_quaternions_are_normalised(self, write_motion, motion_arrays):
        motion = load_motion(write_motion(body_quat_w=1.004 * motion_arrays["body_quat_w"]))
        np.testing.assert_allclose(motion.body_quat_w, motion_arrays["body_quat_w"], atol=1e-6)


class TestErrors:
    """Every message names the file, the field and, where there is one, the frame."""

    def refused(self, folder, *fragments):
        with pytest.raises(MotionError) as caught:
            load_motion(folder)
        for fragment in (str(folder), *fragments):
            assert fragment in str(caught.value)

    @pytest.mark.parametrize("file", ["meta.json", "motion.npz"])
    def test_missing_file(self, write_motion, file):
        folder = write_motion()
        (folder / file).unlink()
        self.refused(folder, file, "no such file")

    @pytest.mark.parametrize("key", ["body_names", "joint_names", "fps"])
    def test_missing_meta(self, write_motion, key):
        self.refused(write_motion(drop=[key]), "meta.json", key)

    def test_meta_that_is_not_json(self, write_motion):
        folder = write_motion()
        (folder / "meta.json").write_text('{"body_names": [')
        self.refused(folder, "meta.json")

    @pytest.mark.parametrize("fps", [0, -50.0, math.nan, math.inf, "fast", None])
    def test_bad_fps(self, write_motion, fps):
        self.refused(write_motion(meta={"fps": fps}), "meta.json", "fps")

    def test_duplicate_names(self, write_motion):
        names = ["pelvis", "torso_link", "torso_link", "box"]
        self.refused(write_motion(meta={"body_names": names}), "meta.json", "body_names")
        again = write_motion("again", meta={"joint_names": ["left_knee_joint"] * 2})
        self.refused(again, "meta.json", "joint_names")

    def test_names_that_are_not_strings(self, write_motion):
        self.refused(write_motion(meta={"joint_names": ["left_knee_joint", 3]}), "meta.json", "joint_names")

    @pytest.mark.parametrize("keep", [0.0, 0.3, 0.9])
    def test_truncated_npz(self, write_motion, keep):
        path = write_motion() / "motion.npz"
        data = path.read_bytes()
        path.write_bytes(data[: int(keep * len(data))])
        self.refused(path.parent, "motion.npz")

    def test_damaged_npz(self, write_motion):
        path = write_motion(body_pos_w=np.random.default_rng(0).normal(size=(T, 4, 3))) / "motion.npz"
        data = bytearray(path.read_bytes())
        start = data.index(b"body_pos_w.npy") + 40
        for offset in range(0, 160, 4):  # one bit at a time: headers, lengths, codes
            damaged = data.copy()
            damaged[start + offset] ^= 0x10
            path.write_bytes(damaged)
            self.refused(path.parent, "motion.npz")

    def test_pickled_objects_are_refused(self, write_motion):
        self.refused(write_motion(joint_pos=np.array([{"a": 1}] * T, dtype=object)), "motion.npz")

    def test_text_is_refused(self, write_motion):
        self.refused(write_motion(joint_pos=np.full((T, 2), "1.0")), "motion.npz", "joint_pos")

    @pytest.mark.parametrize("key", ["body_pos_w", "body_quat_w", "joint_pos"])
    def test_missing_array(self, write_motion, key):
        self.refused(write_motion(drop=[key]), "motion.npz", f"lacks '{key}'")

    @pytest.mark.parametrize(
        ("key", "shape"),
        [
            ("body_pos_w", (T, 3, 3)),
            ("body_pos_w", (T - 1, 4, 3)),
            ("body_quat_w", (T, 4, 3)),
            ("joint_pos", (T, 3)),
            ("joint_pos", (T,)),
            ("body_lin_vel_w", (T, 4, 2)),
            ("body_ang_vel_w", (T + 1, 4, 3)),
            ("joint_vel", (T, 1)),
            ("object_contact", (T - 1, 1)),
            ("object_contact", (T, 1, 1)),
            ("object_contact", ()),
            ("contact_points", (T, 2, 2)),
            ("contact_points", (T, 3)),
            ("joint_target", (T, 3)),
            ("joint_target", (T - 1, 2)),
            ("joint_target", (T,)),
        ],
    )
    def test_wrong_shape(self, write_motion, key, shape):
        self.refused(write_motion(**{key: np.zeros(shape)}), "motion.npz", f"{key}: ", str(shape))

    def test_too_few_frames(self, write_motion, motion_arrays):
        first = {key: value[:1] for key, value in motion_arrays.items()}
        self.refused(write_motion(**first), "motion.npz", "joint_pos", "at least 2 frames")

    @pytest.mark.parametrize("value", [math.nan, math.inf])
    @pytest.mark.parametrize("key", ["body_pos_w", "body_quat_w", "joint_pos"])
    def test_not_finite(self, write_motion, motion_arrays, key, value):
        broken = changed(motion_arrays[key], (7, 1), value)
        self.refused(write_motion(**{key: broken}), "motion.npz", key, "frame 7")

    def test_quaternion_that_is_not_unit(self, write_motion, motion_arrays):
        broken = changed(motion_arrays["body_quat_w"], (5, 3), (0.5, 0.0, 0.0, 0.0))
        self.refused(write_motion(body_quat_w=broken), "motion.npz", "body_quat_w", "0.500", "frame 5", "'box'")

    def test_label_between_zero_and_one(self, write_motion, motion_arrays):
        broken = changed(motion_arrays["object_contact"], (12, 0), 0.5)
        self.refused(write_motion(object_contact=broken), "motion.npz", "object_contact", "0.5", "frame 12")


@pytest.mark.parametrize("fps", [30.0, 120.0])
def test_velocities_are_per_second(fps):
    angle = 0.8 * np.arange(5) / fps
    quat = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], axis=-1)
    np.testing.assert_allclose(angular_velocity(quat, fps), [[0, 0, 0.8]] * 5, atol=1e-6)
    np.testing.assert_allclose(derivative(angle, fps), 0.8, atol=1e-6)


class TestResample:
    def test_to_half_the_rate_takes_every_other_frame(self, write_motion):
        motion = load_motion(write_motion())
        half = resample(motion, 25.0)
        assert (half.fps, half.num_frames) == (25.0, 11)
        for key in ("body_pos_w", "body_quat_w", "body_lin_vel_w", "joint_pos", "joint_vel"):
            np.testing.assert_allclose(getattr(half, key), getattr(motion, key)[::2], atol=1e-5, err_msg=key)
        np.testing.assert_array_equal(half.object_contact, motion.object_contact[::2])

    def test_to_twice_the_rate_interpolates(self, write_motion):
        motion = load_motion(write_motion())
        double = resample(motion, 100.0)
        assert (double.fps, double.num_frames) == (100.0, 41)
        np.testing.assert_allclose(double.body_pos_w[::2], motion.body_pos_w, atol=1e-6)
        middle = (motion.joint_pos[:-1] + motion.joint_pos[1:]) / 2
        np.testing.assert_allclose(double.joint_pos[1::2], middle, atol=1e-6)
        # the box turns at 0.8 rad/s throughout
        half_angle = 0.4 * np.arange(41) / 100
        expected = np.stack([np.cos(half_angle), 0 * half_angle, 0 * half_angle, np.sin(half_angle)], axis=-1)
        np.testing.assert_allclose(double.body_quat_w[:, 3], expected, atol=1e-6)
        assert double.object_contact.dtype == bool
        np.testing.assert_array_equal(double.object_contact[::2], motion.object_contact)

    def test_to_a_rate_that_does_not_divide(self, write_motion):
        odd = resample(load_motion(write_motion()), 30.0)
        assert odd.num_frames == 13  # 0.4 s
        np.testing.assert_allclose(odd.body_pos_w[:, 3, 1], 0.2 * np.arange(13) / 30, atol=1e-6)

    def test_joint_targets_are_interpolated(self, write_motion, motion_arrays):
        target = motion_arrays["joint_pos"] + 0.1
        double = resample(load_motion(write_motion(joint_target=target)), 100.0)
        np.testing.assert_allclose(double.joint_target, double.joint_pos + 0.1, atol=1e-6)
        assert resample(load_motion(write_motion("plain")), 100.0).joint_target is None

    def test_same_rate_changes_nothing(self, write_motion):
        motion = load_motion(write_motion())
        assert resample(motion, FPS) is motion


class TestReference:
    def test_shapes_and_dtypes(self, write_motion):
        reference = make_reference(write_motion(), control_dt=0.02, object=BOX, effectors=HANDS)
        shapes = {
            "joint_pos": (T, 29),
            "joint_vel": (T, 29),
            "body_pos": (T, 30, 3),
            "body_quat": (T, 30, 4),
            "body_lin_vel": (T, 30, 3),
            "body_ang_vel": (T, 30, 3),
            "object_pos": (T, 3),
            "object_quat": (T, 4),
            "object_lin_vel": (T, 3),
            "object_ang_vel": (T, 3),
            "object_joint_pos": (T, 0),
            "contact": (T, 2),
            "contact_point": (T, 2, 3),
        }
        for key, shape in shapes.items():
            value = getattr(reference, key)
            assert tuple(value.shape) == shape, key
            assert value.dtype == (torch.bool if key == "contact" else torch.float32), key
        assert (reference.num_frames, reference.has_object) == (T, True)

    def test_joints_that_the_motion_lacks_hold_the_default_pose(self, write_motion, motion_arrays):
        reference = make_reference(write_motion(), control_dt=0.02)
        column = dict(zip(g1.JOINT_NAMES, reference.joint_pos.T, strict=True))
        np.testing.assert_array_equal(column["left_knee_joint"], motion_arrays["joint_pos"][:, 0])
        np.testing.assert_array_equal(column["waist_yaw_joint"], motion_arrays["joint_pos"][:, 1])
        np.testing.assert_allclose(column["right_knee_joint"], 0.669, atol=1e-6)
        np.testing.assert_allclose(column["left_wrist_roll_joint"], 0.0)
        assert not reference.joint_vel[:, g1.JOINT_NAMES.index("right_knee_joint")].any()

    def test_joint_targets_are_completed_like_joints(self, write_motion, motion_arrays):
        target = motion_arrays["joint_pos"] + np.float32(0.1)
        folder = write_motion(joint_target=target)
        reference = make_reference(folder, control_dt=0.02)
        assert (reference.joint_target.shape, reference.joint_target.dtype) == ((T, 29), torch.float32)
        column = dict(zip(g1.JOINT_NAMES, reference.joint_target.T, strict=True))
        np.testing.assert_array_equal(column["left_knee_joint"], target[:, 0])
        np.testing.assert_array_equal(column["waist_yaw_joint"], target[:, 1])
        np.testing.assert_allclose(column["right_knee_joint"], 0.669, atol=1e-6)  # absent: the default pose
        robot = RobotConfig(default_pose={"waist_yaw_joint": -0.3}, held=["waist_yaw_joint"])
        held = make_reference(folder, control_dt=0.02, robot=robot).joint_target
        np.testing.assert_allclose(held[:, g1.JOINT_NAMES.index("waist_yaw_joint")], -0.3)
        np.testing.assert_array_equal(held[:, g1.JOINT_NAMES.index("left_knee_joint")], target[:, 0])
        assert make_reference(write_motion("plain"), control_dt=0.02).joint_target is None

    def test_joint_targets_go_with_their_joints(self, write_motion, motion_arrays):
        target = motion_arrays["joint_pos"] + np.float32(0.1)
        kept = load_motion(write_motion(joint_target=target)).with_joints(["waist_yaw_joint", "right_knee_joint"])
        assert kept.joint_names == ("waist_yaw_joint",)
        np.testing.assert_array_equal(kept.joint_target, target[:, 1:])

    def test_bodies_that_the_motion_lacks_come_from_forward_kinematics(self, write_motion, motion_arrays):
        reference = make_reference(write_motion(), control_dt=0.02)
        pos, _ = forward_kinematics(
            g1_robot(),
            motion_arrays["body_pos_w"][:, 0],
            motion_arrays["body_quat_w"][:, 0],
            reference.joint_pos.numpy(),
        )
        np.testing.assert_allclose(reference.body_pos, pos, atol=1e-5)
        foot = g1.BODY_NAMES.index("right_ankle_roll_link")
        np.testing.assert_allclose(reference.body_lin_vel[:, foot], [[0.5, 0, 0]] * T, atol=1e-3)
        # hung from the pelvis, which does not turn
        np.testing.assert_allclose(reference.body_ang_vel[:, foot], np.zeros((T, 3)), atol=1e-3)

    def test_linear_velocities_are_of_origins_whatever_the_file_has(self, write_motion):
        fast = np.full((T, 4, 3), 7.0, np.float32)  # as of centres of mass, which turning bodies swing about
        for control_dt in (0.02, 0.01):
            folder = write_motion(f"stroll_{control_dt}", body_lin_vel_w=fast)
            reference = make_reference(folder, control_dt=control_dt, object=BOX)
            count = reference.num_frames
            np.testing.assert_allclose(reference.body_lin_vel[:, 0], [[0.5, 0, 0]] * count, atol=1e-4)
            np.testing.assert_allclose(reference.object_lin_vel, [[0, 0.2, 0]] * count, atol=1e-4)

    def test_bodies_that_the_motion_has_are_kept(self, write_motion, motion_arrays):
        moved = changed(motion_arrays["body_pos_w"], (slice(None), 2, 2), 1.5)
        reference = make_reference(write_motion(body_pos_w=moved), control_dt=0.02)
        assert (reference.body_pos[:, g1.BODY_NAMES.index("left_wrist_yaw_link"), 2] == 1.5).all()

    def test_control_rate(self, write_motion):
        reference = make_reference(write_motion(), control_dt=0.01, object=BOX)
        assert reference.num_frames == 41
        np.testing.assert_allclose(reference.object_lin_vel, [[0, 0.2, 0]] * 41, atol=1e-4)

    def test_without_object(self, write_motion):
        reference = make_reference(write_motion(), control_dt=0.02)
        assert not reference.has_object
        assert reference.object_pos.shape == (T, 0)
        assert reference.contact.shape == (T, 0)
        assert reference.contact_point.shape == (T, 0, 3)

    def test_one_label_column_serves_all_effectors(self, write_motion):
        reference = make_reference(write_motion(), control_dt=0.02, object=BOX, effectors=HANDS)
        assert reference.contact.sum(0).tolist() == [11, 11]
        np.testing.assert_allclose(reference.contact_point[3], [[0.0, 0.2, 0.1], [0.0, -0.2, 0.1]])

    def test_a_label_column_per_effector(self, write_motion):
        labels = np.zeros((T, 2))
        labels[:5, 1] = 1
        reference = make_reference(write_motion(object_contact=labels), control_dt=0.02, object=BOX, effectors=HANDS)
        assert reference.contact.sum(0).tolist() == [0, 5]

    def test_the_motions_contact_points_take_precedence(self, write_motion):
        points = np.full((T, 2, 3), 0.25, np.float32)
        folder = write_motion(contact_points=points)
        reference = make_reference(folder, control_dt=0.02, object=BOX, effectors=HANDS)
        np.testing.assert_array_equal(reference.contact_point, points)

    def test_hinge(self, write_motion, motion_arrays):
        angle = np.linspace(0, 0.8, T, dtype=np.float32)
        joint_pos = np.concatenate([motion_arrays["joint_pos"], angle[:, None]], axis=1)
        names = ["left_knee_joint", "waist_yaw_joint", "lid_joint"]
        folder = write_motion(meta={"joint_names": names}, joint_pos=joint_pos)
        box = ObjectConfig("box", BOX.geoms, hinge=HingeConfig("lid_joint", "lid", BOX.geoms))
        reference = make_reference(folder, control_dt=0.02, object=box)
        np.testing.assert_array_equal(reference.object_joint_pos[:, 0], angle)
        np.testing.assert_allclose(reference.object_joint_vel[:, 0], 2.0, atol=1e-4)
        with pytest.raises(MotionError, match=r"joint_names: \['lid_joint'\]"):
            make_reference(folder, control_dt=0.02, object=BOX)

    def test_free_root_joint_is_no_unknown_joint(self, write_motion, motion_arrays):
        # exporters list the free joint with a column of zeros; the pelvis has its pose
        joint_pos = np.concatenate([np.zeros((T, 1), np.float32), motion_arrays["joint_pos"]], axis=1)
        names = ["root", "left_knee_joint", "waist_yaw_joint"]
        reference = make_reference(write_motion(meta={"joint_names": names}, joint_pos=joint_pos), control_dt=0.02)
        knee = g1.JOINT_NAMES.index("left_knee_joint")
        np.testing.assert_array_equal(reference.joint_pos[:, knee], motion_arrays["joint_pos"][:, 0])

    def test_placements_are_of_the_first_frame(self, write_motion):
        scenery = [SceneryConfig("table", BOX.geoms, pos=(0, 0, 0))]
        placements = make_reference(write_motion(), control_dt=0.02, object=BOX, scenery=scenery).placements
        assert set(placements) == {"box"}
        np.testing.assert_allclose(placements["box"][0], [1.0, 0.0, 0.3], atol=1e-6)
        np.testing.assert_allclose(placements["box"][1], [1.0, 0.0, 0.0, 0.0], atol=1e-6)

    def test_to_device(self, write_motion):
        reference = make_reference(write_motion(), control_dt=0.02, object=BOX)
        moved = reference.to("meta")
        assert moved.body_pos.is_meta
        assert (moved.name, moved.placements) == (reference.name, reference.placements)

    def test_unknown_joint(self, write_motion):
        folder = write_motion(meta={"joint_names": ["left_knee_joint", "tail_joint"]})
        with pytest.raises(MotionError, match=r"'stroll': joint_names: \['tail_joint'\]"):
            make_reference(folder, control_dt=0.02)

    def test_no_joint_of_the_robot(self, write_motion, motion_arrays):
        folder = write_motion(meta={"joint_names": ["lid"]}, joint_pos=motion_arrays["joint_pos"][:, :1])
        box = ObjectConfig("box", BOX.geoms, hinge=HingeConfig("lid", "lid_link", BOX.geoms))
        with pytest.raises(MotionError, match="'stroll': joint_names has no joint of the robot"):
            make_reference(folder, control_dt=0.02, object=box)

    def test_missing_root(self, write_motion):
        folder = write_motion(meta={"body_names": ["hips", "torso_link", "left_wrist_yaw_link", "box"]})
        with pytest.raises(MotionError, match="'stroll': body_names lacks the root 'pelvis'"):
            make_reference(folder, control_dt=0.02)

    def test_missing_object(self, write_motion):
        with pytest.raises(MotionError, match="'stroll': body_names lacks the task's object 'sofa'"):
            make_reference(write_motion(), control_dt=0.02, object=ObjectConfig("sofa", BOX.geoms))

    def test_missing_hinge(self, write_motion):
        box = ObjectConfig("box", BOX.geoms, hinge=HingeConfig("lid_joint", "lid", BOX.geoms))
        with pytest.raises(MotionError, match="'stroll': joint_names lacks the object's hinge 'lid_joint'"):
            make_reference(write_motion(), control_dt=0.02, object=box)

    def test_missing_labels(self, write_motion):
        folder = write_motion(drop=["object_contact"])
        with pytest.raises(MotionError, match="'stroll': has no object_contact labels"):
            make_reference(folder, control_dt=0.02, object=BOX, effectors=HANDS)

    def test_label_columns_that_do_not_fit(self, write_motion):
        folder = write_motion(object_contact=np.zeros((T, 3)))
        with pytest.raises(MotionError, match="object_contact has 3 columns; the task has 2 effectors"):
            make_reference(folder, control_dt=0.02, object=BOX, effectors=HANDS)

    def test_contact_points_that_do_not_fit(self, write_motion):
        folder = write_motion(contact_points=np.zeros((T, 3, 3)))
        with pytest.raises(MotionError, match="contact_points has 3 effectors"):
            make_reference(folder, control_dt=0.02, object=BOX, effectors=HANDS)


class TestFind:
    def test_under_a_root(self, write_motion):
        folder = write_motion("stroll")
        assert find_motion("stroll", str(folder.parent)) == folder

    def test_error_says_where_was_looked_and_what_is_there(self, write_motion):
        root = write_motion("stroll").parent
        with pytest.raises(MotionError) as caught:
            find_motion("sprint", str(root))
        assert all(fragment in str(caught.value) for fragment in ("'sprint'", str(root), "stroll", "motion_root"))

    def test_a_root_that_is_not_there(self, tmp_path):
        with pytest.raises(MotionError, match="no motions"):
            find_motion("stroll", str(tmp_path / "nowhere"))


def test_meta_is_plain_json(write_motion, tmp_path):
    folder = save_motion(load_motion(write_motion()), tmp_path / "copy")
    meta = json.loads((folder / "meta.json").read_text())
    assert meta["fps"] == FPS
    assert meta["joint_names"] == ["left_knee_joint", "waist_yaw_joint"]


class TestPublicMotions:
    @pytest.mark.parametrize("name", PUBLIC)
    def test_robot_table_reproduces_every_body(self, public_motions, name):
        motion = load_motion(find_motion(name, str(public_motions)))
        hinge = {
            "open_door_feet": "door_joint",
            "push_door_hand": "door_joint",
            "open_foldchair_sit": "foldchair_joint",
        }
        item = None
        if name in hinge:
            body = hinge[name].removesuffix("_joint")
            item = ObjectConfig(body, BOX.geoms, hinge=HingeConfig(hinge[name], "link", BOX.geoms))
        joint_pos = make_reference(motion, control_dt=1 / motion.fps, object=item).joint_pos.numpy()
        root = motion.body_names.index("pelvis")
        # 0.2 s apart: enough to see every pose, a fifth of the time
        frames = slice(None, None, 10)
        pos, _ = forward_kinematics(
            g1_robot(), motion.body_pos_w[frames, root], motion.body_quat_w[frames, root], joint_pos[frames]
        )
        shared = [body for body in g1.BODY_NAMES if body in motion.body_names]
        assert len(shared) >= 28
        for body in shared:
            expected = motion.body_pos_w[frames, motion.body_names.index(body)]
            error = np.linalg.norm(pos[:, g1.BODY_NAMES.index(body)] - expected, axis=-1)
            assert error.max() < 1e-3, body
