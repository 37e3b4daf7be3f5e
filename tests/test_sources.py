"""Readers of other people's motions, on files that the tests write in each format's layout."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from sources import (
    T,
    robot_arrays,
    write_amass,
    write_bvh,
    write_gvhmr,
    write_intermimic,
    write_mjlab_file,
    write_omomo,
)

from hdmi.assets import g1, g1_robot
from hdmi.motion import MotionError, load_motion, save_motion
from hdmi.workshop.human import SMPL_JOINTS
from hdmi.workshop.skeleton import UPRIGHT, anthropometric_skeleton
from hdmi.workshop.sources import (
    convert,
    guess_format,
    read_amass,
    read_bvh,
    read_gvhmr,
    read_holosoma,
    read_intermimic,
    read_mjlab,
    read_omomo,
    read_person,
    read_robot_csv,
    write_holosoma,
    write_mjlab,
    write_robot_csv,
)
from hdmi.workshop.sources.interaction import _INTERMIMIC_JOINTS
from hdmi.workshop.sources.robot import table_order


class TestGvhmr:
    def test_is_turned_upright_and_put_on_the_ground(self, tmp_path: Path) -> None:
        motion = read_gvhmr(write_gvhmr(tmp_path / "walk_1" / "hmr4d_results.pt"), fps=25.0)
        assert (motion.name, motion.fps, motion.num_frames, motion.joint_names) == ("walk_1", 25.0, T, SMPL_JOINTS)
        assert motion.height == pytest.approx(1.66 + 0.1 * 0.5)
        head, foot = motion.pos("head"), motion.pos("left_foot")
        assert (head[:, 2] > 1.4).all()
        np.testing.assert_allclose(foot[:, 2], 0.012 * motion.height, atol=1e-4)
        # y-up z is minus y here: the file's person faces z and walks along it
        np.testing.assert_allclose(np.diff(motion.pos("pelvis")[:, 1]), -0.02, atol=1e-5)
        assert (foot[:, 1] < motion.pos("left_ankle")[:, 1]).all()

    def test_orientations_are_of_smpls_frames(self, tmp_path: Path) -> None:
        motion = read_gvhmr(write_gvhmr(tmp_path / "a.pt"), fps=30.0)
        axes = Rotation.from_quat(motion.joint_quat[0, 0], scalar_first=True).as_matrix()
        np.testing.assert_allclose(axes, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-6)
        elbow = Rotation.from_quat(motion.joint_quat[3, SMPL_JOINTS.index("left_elbow")], scalar_first=True)
        forearm = motion.pos("left_wrist")[3] - motion.pos("left_elbow")[3]
        np.testing.assert_allclose(elbow.apply([1, 0, 0]), forearm / np.linalg.norm(forearm), atol=1e-5)

    def test_height_is_the_users(self, tmp_path: Path) -> None:
        path = write_gvhmr(tmp_path / "a.pt")
        tall, short = read_gvhmr(path, 30.0, height=1.9), read_gvhmr(path, 30.0, height=1.5)
        reach = [np.ptp(m.joint_pos[0, :, 0]) for m in (tall, short)]
        assert reach[0] / reach[1] == pytest.approx(1.9 / 1.5, rel=1e-4)

    def test_one_shape_for_all_frames(self, tmp_path: Path) -> None:
        assert read_gvhmr(write_gvhmr(tmp_path / "a.pt", betas=torch.full((1, 10), 1.0)), 30.0).height == 1.76

    @pytest.mark.parametrize(
        ("changes", "fragments"),
        [
            ({"body_pose": torch.zeros(T, 69)}, ["body_pose", "(9, 69)"]),
            ({"transl": torch.full((T, 3), torch.nan)}, ["transl", "frame 0"]),
            ({"transl": torch.zeros(T - 1, 3)}, ["transl", "(8, 3)"]),
            ({"betas": torch.full((T, 10), 90.0)}, ["height", "10.66"]),
            ({"betas": "none"}, ["betas", "str"]),
            ({"global_orient": torch.zeros(T, 3, dtype=torch.complex64)}, ["global_orient", "complex64"]),
            ({"global_orient": torch.zeros(1).expand(10**9, 10**9)}, ["global_orient", "GiB"]),
            ({"global_orient": torch.eye(3).to_sparse()}, ["global_orient", "sparse"]),
            ({"transl": torch.full((T, 3), 1e39, dtype=torch.float64)}, ["transl", "not finite"]),
        ],
    )
    def test_refuses(self, tmp_path: Path, changes: dict, fragments: list[str]) -> None:
        path = write_gvhmr(tmp_path / "bad.pt", **changes)
        with pytest.raises(MotionError) as caught:
            read_gvhmr(path, 30.0)
        for fragment in (str(path), *fragments):
            assert fragment in str(caught.value)

    def test_refuses_other_results(self, tmp_path: Path) -> None:
        torch.save({"smpl_params_incam": {}}, tmp_path / "a.pt")
        with pytest.raises(MotionError, match="smpl_params_global"):
            read_gvhmr(tmp_path / "a.pt", 30.0)
        with pytest.raises(MotionError, match="fps"):
            read_gvhmr(write_gvhmr(tmp_path / "b.pt"), 0.0)


class TestAmass:
    @pytest.mark.parametrize("layout", ["smplh", "smplx"])
    def test_both_layouts(self, tmp_path: Path, layout: str) -> None:
        motion = read_amass(write_amass(tmp_path / "jump_stageii.npz", layout))
        assert (motion.name, motion.fps, motion.num_frames) == ("jump_stageii", 120.0, T)
        # stands on z = 0, facing x, raises the left arm
        np.testing.assert_allclose(motion.pos("pelvis")[:, 2], 0.58 * motion.height, atol=1e-4)
        assert (motion.pos("left_foot")[:, 0] > motion.pos("left_ankle")[:, 0] + 0.05).all()
        assert motion.pos("left_wrist")[-1, 2] > motion.pos("left_wrist")[0, 2] + 0.3

    def test_the_body_model_is_used_where_there_is_one(self, tmp_path: Path) -> None:
        from test_human import TestBodyModel

        model = TestBodyModel().write(tmp_path / "model.npz")
        path = write_amass(tmp_path / "a.npz", "smplh")
        motion = read_amass(path, body_model=model)
        shape = 1 + 0.1 * 0.5
        skeleton = anthropometric_skeleton(1.7)
        np.testing.assert_allclose(motion.pos("pelvis")[0], shape * skeleton.offset[0] + [0.1, 0.2, 0.9], atol=1e-5)
        with pytest.raises(MotionError, match="height or body_model"):
            read_amass(path, height=1.7, body_model=model)

    @pytest.mark.parametrize(
        ("changes", "fragments"),
        [
            ({"poses": np.zeros((T, 60))}, ["poses", "(9, 60)"]),
            ({"poses": np.zeros((T - 2, 156))}, ["poses", "(7, 66)"]),
            ({"mocap_framerate": np.array([60.0, 60.0])}, ["mocap_framerate"]),
            ({"mocap_framerate": np.array(0.0)}, ["fps"]),
            ({"betas": np.zeros((2, 2, 2))}, ["betas"]),
            ({"trans": np.array([["a"] * 3] * T)}, ["trans", "dtype"]),
            ({"poses": np.array([{}], dtype=object)}, ["plain arrays"]),
        ],
    )
    def test_refuses(self, tmp_path: Path, changes: dict, fragments: list[str]) -> None:
        path = write_amass(tmp_path / "bad.npz", "smplh", **changes)
        with pytest.raises(MotionError) as caught:
            read_amass(path)
        for fragment in (str(path), *fragments):
            assert fragment in str(caught.value)

    def test_refuses_other_archives(self, tmp_path: Path) -> None:
        np.savez(tmp_path / "a.npz", trans=np.zeros((T, 3)))
        with pytest.raises(MotionError, match="not a sequence of AMASS"):
            read_amass(tmp_path / "a.npz")


class TestOmomo:
    def test_person_and_object(self, tmp_path: Path) -> None:
        motion = read_omomo(write_omomo(tmp_path / "a.npz"))
        assert (motion.name, motion.fps) == ("sub3_largebox_003", 30.0)
        assert motion.joint_names == (*SMPL_JOINTS, "left_hand", "right_hand")
        # the translation is the pelvis itself
        np.testing.assert_allclose(motion.pos("pelvis")[0], [0.1, 0.2, 0.9], atol=1e-6)
        assert motion.height == pytest.approx(1.8, rel=0.01)
        assert motion.object.name == "largebox"
        np.testing.assert_allclose(motion.object.pos[:, 0], 0.05 * np.arange(T), atol=1e-6)
        np.testing.assert_allclose(motion.object.quat[0], np.sqrt([0.5, 0, 0, 0.5]), atol=1e-6)

    @pytest.mark.parametrize(
        ("changes", "fragments"),
        [
            ({"obj_rot": np.zeros((T, 3, 3))}, ["obj_rot", "not a rotation at frame 0"]),
            ({"obj_rot": np.tile(np.diag([1.0, 1.0, -1.0]), (T, 1, 1))}, ["obj_rot"]),
            ({"rest_offsets": np.zeros((23, 3))}, ["rest_offsets", "23"]),
            ({"rest_offsets": np.zeros((24, 3))}, ["height"]),
            ({"obj_trans": np.zeros((T, 3, 2, 1))}, ["obj_trans"]),
        ],
    )
    def test_refuses(self, tmp_path: Path, changes: dict, fragments: list[str]) -> None:
        path = write_omomo(tmp_path / "bad.npz", **changes)
        with pytest.raises(MotionError) as caught:
            read_omomo(path)
        for fragment in (str(path), *fragments):
            assert fragment in str(caught.value)


class TestInterMimic:
    def test_columns(self, tmp_path: Path) -> None:
        motion = read_intermimic(write_intermimic(tmp_path / "sub3_largebox_003.pt"))
        assert (motion.fps, motion.num_frames, len(motion.joint_names)) == (30.0, T, 52)
        for j, name in enumerate(_INTERMIMIC_JOINTS):
            np.testing.assert_allclose(motion.pos(name)[2, 0], 0.01 * j, atol=1e-6, err_msg=name)
        assert motion.object.name == "largebox"
        np.testing.assert_allclose(motion.object.pos[4], [0.4, 5.0, 6.0], atol=1e-6)
        np.testing.assert_allclose(motion.object.quat[0], np.sqrt([0.5, 0, 0, 0.5]), atol=1e-6)

    def test_bodies_that_rest_upright_are_in_smpls_frames(self, tmp_path: Path) -> None:
        motion = read_intermimic(write_intermimic(tmp_path / "a.pt"), height=1.7)
        expected = np.abs(UPRIGHT.as_quat(scalar_first=True))
        np.testing.assert_allclose(np.abs(motion.joint_quat[0, 0]), expected, atol=1e-6)

    def test_a_finger_touches_for_its_hand_and_minus_one_is_no_contact(self, tmp_path: Path) -> None:
        motion = read_intermimic(write_intermimic(tmp_path / "a.pt"), height=1.7)
        touching = {name for name, column in zip(motion.contact_names, motion.contact.T, strict=True) if column.any()}
        assert touching == {"left_wrist"}
        assert motion.contact[:, motion.contact_names.index("left_wrist")].tolist() == [False] * 5 + [True] * (T - 5)

    def test_refuses(self, tmp_path: Path) -> None:
        torch.save(torch.zeros(T, 590), tmp_path / "narrow.pt")
        with pytest.raises(MotionError, match=r"\(9, 590\), expected a tensor of shape \(T, 591\)"):
            read_intermimic(tmp_path / "narrow.pt")
        torch.save(torch.zeros(T, 591), tmp_path / "zero.pt")
        with pytest.raises(MotionError, match=r"columns 383-591: norm 0\.000 at frame 0, body 'pelvis'"):
            read_intermimic(tmp_path / "zero.pt")


class TestBvh:
    def test_lafan1(self, tmp_path: Path) -> None:
        """LAFAN1's bones lie along x, its root rotates by z, y, x; 90 degrees about z stand it up."""
        motion = read_bvh(write_bvh(tmp_path / "walk1_subject1.bvh"))
        assert (motion.name, motion.fps, motion.num_frames) == ("walk1_subject1", 30.0, 3)
        assert motion.joint_quat is None
        assert motion.height == pytest.approx((0.435 + 0.424) / 0.491, rel=1e-3)
        # root at x 1, y 0.9 (up), z 2, moving along x by 1 cm a frame
        np.testing.assert_allclose(
            motion.pos("pelvis"), [[1.0, -2.0, 0.9], [1.01, -2.0, 0.9], [1.02, -2.0, 0.9]], atol=1e-6
        )
        # hanging legs: the hip is turned by 180 degrees about z, the knee then bends by 90 about z
        np.testing.assert_allclose(motion.pos("left_hip")[0], [1.0, -2.1, 0.9], atol=1e-6)
        np.testing.assert_allclose(motion.pos("left_knee")[0], [1.0, -2.1, 0.465], atol=1e-6)
        np.testing.assert_allclose(motion.pos("left_ankle")[0], [1.0, -2.1, 0.041], atol=1e-6)
        np.testing.assert_allclose(motion.pos("left_ankle")[2], [1.444, -2.1, 0.465], atol=1e-6)

    def test_a_rest_pose_like_smpls_keeps_orientations(self, tmp_path: Path) -> None:
        motion = read_bvh(write_bvh(tmp_path / "a.bvh", t_pose=True), height=1.8)
        assert motion.height == 1.8
        assert motion.joint_names[:1] == ("pelvis",)
        elbow = Rotation.from_quat(motion.joint_quat[2, motion.index("left_elbow")], scalar_first=True)
        forearm = motion.pos("left_wrist")[2] - motion.pos("left_elbow")[2]
        np.testing.assert_allclose(elbow.apply([1, 0, 0]), forearm / np.linalg.norm(forearm), atol=1e-5)

    def test_up_axis(self, tmp_path: Path) -> None:
        path = write_bvh(tmp_path / "a.bvh")
        np.testing.assert_allclose(read_bvh(path, up="z").pos("pelvis")[0], [1.0, 0.9, 2.0], atol=1e-6)

    @pytest.mark.parametrize(
        ("old", "new", "fragment"),
        [
            ("MOTION", "MOTOIN", "no MOTION"),
            ("ROOT Hips", "ROOT Bone", "no root Hips"),
            ("Frames: 3", "Frames: 4", "needs 2 frames"),
            ("Frame Time: 0.033333", "Frame Time: 0", "Frame Time"),
            ("OFFSET 43.5 0 0", "OFFSET 43.5 nan 0", "OFFSET"),
            ("OFFSET 43.5 0 0", "OFFSET 43500 0 0", "unit"),
            ("JOINT LeftLeg", "JOINT", "hangs from no joint"),
            ("JOINT LeftLeg", "LeftLeg", "unexpected 'LeftLeg'"),
            ("}", "", "unbalanced"),
            ("Zrotation", "Wrotation", "CHANNELS"),
            ("CHANNELS 3", "CHANNELS 999999999999", "CHANNELS"),
            ("100.0 90.0", "1e300 90.0", "frame 0, channel 0"),
            ("100.0 90.0", "hundred 90.0", "hundred"),
        ],
    )
    def test_refuses(self, tmp_path: Path, old: str, new: str, fragment: str) -> None:
        path = write_bvh(tmp_path / "a.bvh")
        path.write_text(path.read_text().replace(old, new, 1))
        with pytest.raises(MotionError, match=fragment) as caught:
            read_bvh(path)
        assert str(path) in str(caught.value)


class TestPerson:
    """The format of a file is found in the file; what it does not say has to be given, what it says cannot be."""

    def test_formats_are_found(self, tmp_path: Path) -> None:
        renamed = read_person(write_gvhmr(tmp_path / "results.pt"), source_fps=25.0)
        assert (renamed.fps, renamed.object) == (25.0, None)
        assert read_person(write_intermimic(tmp_path / "sub1_box_0.pt")).contact is not None
        assert read_person(write_omomo(tmp_path / "a.npz")).object is not None
        assert read_person(write_amass(tmp_path / "b.npz", "smplh")).fps == 120.0
        assert read_person(write_bvh(tmp_path / "a.bvh")).height == pytest.approx(1.75, abs=0.01)

    def test_options_reach_the_reader(self, tmp_path: Path) -> None:
        path = write_bvh(tmp_path / "a.bvh")
        metres = read_person(path, unit=0.012, up="z", height=1.5)
        assert metres.height == 1.5
        np.testing.assert_allclose(metres.pos("pelvis")[0], [1.2, 1.08, 2.4], atol=1e-5)

    def test_what_does_not_fit_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(MotionError, match="give source_fps"):
            read_person(write_gvhmr(tmp_path / "results.pt"))
        with pytest.raises(
            MotionError, match="amass takes no names; it takes source_fps, up, unit, ground, height, body"
        ):
            read_person(write_amass(tmp_path / "b.npz", "smplh"), names="names.yaml")
        with pytest.raises(MotionError, match="omomo takes no height; it takes source_fps, up, unit, ground"):
            read_person(write_omomo(tmp_path / "a.npz"), height=1.7)


class TestMjlab:
    def test_isaac_labs_order_is_breadth_first(self) -> None:
        joints, bodies = table_order("isaac")
        names = [g1.JOINT_NAMES[j] for j in joints]
        assert names[:6] == [
            f"{name}_joint"
            for name in (
                "left_hip_pitch",
                "right_hip_pitch",
                "waist_yaw",
                "left_hip_roll",
                "right_hip_roll",
                "waist_roll",
            )
        ]
        assert names[-2:] == ["left_wrist_yaw_joint", "right_wrist_yaw_joint"]
        assert [g1.BODY_NAMES[b] for b in bodies[:3]] == ["pelvis", "left_hip_pitch_link", "right_hip_pitch_link"]
        assert sorted(joints) == list(range(29))
        assert sorted(bodies) == list(range(30))

    @pytest.mark.parametrize("order", ["mujoco", "isaac"])
    def test_the_order_is_found(self, tmp_path: Path, order: str) -> None:
        arrays = robot_arrays()
        motion = read_mjlab(write_mjlab_file(tmp_path / "a.npz", arrays, order))
        assert (motion.fps, motion.joint_names, motion.body_names) == (50.0, g1.JOINT_NAMES, g1.BODY_NAMES)
        for key, value in arrays.items():
            np.testing.assert_array_equal(getattr(motion, key), value, err_msg=key)

    def test_another_robot_is_refused(self, tmp_path: Path) -> None:
        arrays = robot_arrays()
        arrays["body_pos_w"][:, 20] += 3.0
        path = write_mjlab_file(tmp_path / "a.npz", arrays, "mujoco")
        with pytest.raises(MotionError, match="not this robot's"):
            read_mjlab(path)
        arrays = {key: value[:, :20] for key, value in robot_arrays().items()}
        np.savez(tmp_path / "b.npz", fps=[50], **arrays)
        with pytest.raises(MotionError, match=r"joint_pos: shape \(9, 20\), expected \(9, 29\)"):
            read_mjlab(tmp_path / "b.npz")


class TestHolosoma:
    def write(self, path: Path, *, free: bool = True, world: bool = True, thing: bool = True) -> tuple[Path, dict]:
        arrays = robot_arrays()
        count = len(arrays["joint_pos"])
        file: dict[str, np.ndarray] = {"fps": np.array([50])}
        root = np.concatenate([arrays["body_pos_w"][:, 0], arrays["body_quat_w"][:, 0]], axis=1)
        file["joint_pos"] = np.concatenate([root, arrays["joint_pos"]], 1) if free else arrays["joint_pos"]
        file["joint_vel"] = (
            np.concatenate([np.zeros((count, 6)), arrays["joint_vel"]], 1) if free else arrays["joint_vel"]
        )
        names = list(g1.BODY_NAMES)
        for key in ("body_pos_w", "body_quat_w", "body_lin_vel_w", "body_ang_vel_w"):
            values = arrays[key].astype(np.float64)
            if world:
                values = np.concatenate([np.zeros_like(values[:, :1]), values], 1)
                values[:, 0, 0] = key == "body_quat_w"
            if thing:
                values = np.concatenate([values, np.ones_like(values[:, :1]) / (2 if "quat" in key else 1)], 1)
            file[key] = values
        names = (["world"] if world else []) + names + (["largebox"] if thing else [])
        if thing:
            file["object_pos_w"], file["object_lin_vel_w"] = np.full((count, 3), 7.0), np.full((count, 3), 8.0)
            file["object_quat_w"], file["object_ang_vel_w"] = np.full((count, 4), 0.5), np.full((count, 3), 9.0)
        np.savez(path, **file, joint_names=np.array(g1.JOINT_NAMES), body_names=np.array(names))
        return path, arrays

    @pytest.mark.parametrize("free", [True, False])
    @pytest.mark.parametrize("world", [True, False])
    def test_with_and_without_root_and_world(self, tmp_path: Path, free: bool, world: bool) -> None:
        path, arrays = self.write(tmp_path / "a.npz", free=free, world=world)
        motion = read_holosoma(path)
        assert motion.body_names == (*g1.BODY_NAMES, "largebox")
        for key, value in arrays.items():
            np.testing.assert_array_equal(getattr(motion, key)[:, : value.shape[1]], value, err_msg=key)
        assert (motion.body_pos_w[:, -1] == 7).all()
        assert (motion.body_ang_vel_w[:, -1] == 9).all()

    def test_object_without_a_body(self, tmp_path: Path) -> None:
        path, _ = self.write(tmp_path / "a.npz")
        with np.load(path) as file:
            arrays = dict(file)
        for key in ("body_pos_w", "body_quat_w", "body_lin_vel_w", "body_ang_vel_w"):
            arrays[key] = arrays[key][:, :-1]
        arrays["body_names"] = arrays["body_names"][:-1]
        np.savez(path, **arrays)
        assert read_holosoma(path).body_names[-1] == "object"
        assert read_holosoma(path, "crate").body_names[-1] == "crate"

    def test_without_object(self, tmp_path: Path) -> None:
        path, _ = self.write(tmp_path / "a.npz", thing=False)
        assert read_holosoma(path).body_names == g1.BODY_NAMES

    def test_written_root_is_mujocos_free_joint(self, tmp_path: Path) -> None:
        """Integrating the written velocity from one frame leads to the next."""
        import mujoco

        from hdmi.motion.kinematics import robot_model

        arrays = robot_arrays()
        fps = 50.0
        motion = read_mjlab(write_mjlab_file(tmp_path / "a.npz", arrays, "mujoco"))
        yaw = np.zeros_like(arrays["body_ang_vel_w"])
        yaw[:, 0, 2] = 0.5
        moving = np.zeros_like(yaw)
        moving[:, 0] = [0.5, 0.1, 0.0]
        tilted = Rotation.from_quat(motion.body_quat_w[:, 0], scalar_first=True) * Rotation.from_euler("x", 0.8)
        quat = motion.body_quat_w.copy()
        quat[:, 0] = tilted.as_quat(scalar_first=True)
        from dataclasses import replace

        path, _ = write_holosoma(
            replace(motion, body_quat_w=quat, body_ang_vel_w=yaw, body_lin_vel_w=moving), tmp_path / "b.npz"
        )
        with np.load(path) as file:
            qpos, qvel = file["joint_pos"].astype(float), file["joint_vel"].astype(float)
        step = qpos[0].copy()
        mujoco.mj_integratePos(robot_model(g1_robot()), step, qvel[0], 1 / fps)
        np.testing.assert_allclose(step[:7], qpos[1, :7], atol=1e-5)

    def test_refuses(self, tmp_path: Path) -> None:
        path, _ = self.write(tmp_path / "a.npz")
        with np.load(path) as file:
            arrays = dict(file)
        np.savez(path, **{k: v for k, v in arrays.items() if k != "object_quat_w"})
        with pytest.raises(MotionError, match="lacks object_quat_w"):
            read_holosoma(path)
        np.savez(path, **(arrays | {"joint_names": np.arange(29)}))
        with pytest.raises(MotionError, match="joint_names: strings expected"):
            read_holosoma(path)


class TestRobotCsv:
    def test_root_is_xyzw(self, tmp_path: Path) -> None:
        arrays = robot_arrays()
        rows = np.concatenate(
            [arrays["body_pos_w"][:, 0], np.roll(arrays["body_quat_w"][:, 0], -1, 1), arrays["joint_pos"]], axis=1
        )
        np.savetxt(tmp_path / "dance1.csv", rows, delimiter=",", fmt="%.6f")
        motion = read_robot_csv(tmp_path / "dance1.csv")
        assert (motion.name, motion.fps, motion.num_frames) == ("dance1", 30.0, T)
        np.testing.assert_allclose(motion.joint_pos, arrays["joint_pos"], atol=1e-6)
        np.testing.assert_allclose(motion.body_pos_w, arrays["body_pos_w"], atol=1e-5)
        np.testing.assert_allclose(motion.body_quat_w, arrays["body_quat_w"], atol=1e-5)
        # 0.5 m/s at 50 fps is 0.3 m/s at 30
        np.testing.assert_allclose(motion.body_lin_vel_w[:, 0, 0], 0.3, atol=1e-4)

    @pytest.mark.parametrize(
        ("text", "fragment"),
        [
            ("", "needs at least 2 frames"),
            ("1,2,3\n1,2,3\n", "(2, 3)"),
            ("a,b\n", "not a table"),
            ("0," * 35 + "0\n" + "0," * 35 + "0\n", "norm 0.000 at frame 0, body 'root'"),
        ],
    )
    def test_refuses(self, tmp_path: Path, text: str, fragment: str) -> None:
        path = tmp_path / "a.csv"
        path.write_text(text)
        with pytest.raises(MotionError) as caught:
            read_robot_csv(path)
        assert str(path) in str(caught.value)
        assert fragment in str(caught.value)


class TestConvert:
    """On the public motions: out and back changes nothing that a format can hold."""

    MOTIONS = ("carry_bread_box", "move_suitcase_perfect", "open_door_feet", "push_box", "walk")

    @pytest.mark.parametrize("name", MOTIONS)
    @pytest.mark.parametrize("to", ["hdmi", "mjlab", "beyondmimic", "holosoma", "csv"])
    def test_out_and_back(self, public_motions: Path, tmp_path: Path, name: str, to: str) -> None:
        first = load_motion(public_motions / name)
        out = tmp_path / (name + {"hdmi": "", "csv": ".csv"}.get(to, ".npz"))
        _, path, lost = convert(public_motions / name, out, to)
        assert guess_format(path) == ("mjlab" if to == "beyondmimic" else to)
        from hdmi.workshop.sources.formats import Options

        second, _, _ = convert(path, tmp_path / "back", "hdmi", options=Options(fps=50.0))
        assert (second.fps, second.num_frames) == (first.fps, first.num_frames)
        fixed = to in ("mjlab", "beyondmimic", "csv")
        joints = [n for n in first.joint_names if to == "hdmi" or n in g1.JOINT_NAMES]
        bodies = [n for n in first.body_names if not fixed or n in g1.BODY_NAMES]
        bodies = ["pelvis"] if to == "csv" else bodies
        for keys, ours, theirs, names in (
            (("joint_pos",), first.joint_names, second.joint_names, joints),
            (("body_pos_w", "body_quat_w"), first.body_names, second.body_names, bodies),
            (("joint_vel",), first.joint_names, second.joint_names, joints if to != "csv" else []),
            (("body_lin_vel_w", "body_ang_vel_w"), first.body_names, second.body_names, bodies if to != "csv" else []),
        ):
            for key in keys:
                a = getattr(first, key)[:, [ours.index(n) for n in names]]
                b = getattr(second, key)[:, [theirs.index(n) for n in names]]
                np.testing.assert_array_equal(a, b, err_msg=key)
        assert load_motion(tmp_path / "back").num_frames == first.num_frames
        if to == "hdmi":
            assert not lost
            np.testing.assert_array_equal(first.object_contact, second.object_contact)
        else:
            # what is lost is said
            gone = [
                n for n in (*first.joint_names, *first.body_names) if n not in (*second.joint_names, *second.body_names)
            ]
            for what in gone + (["object_contact"] if first.object_contact is not None else []):
                assert what in " ".join(lost), what

    def test_object_of_holosoma_is_named_where_it_is_not_clear(self, public_motions: Path, tmp_path: Path) -> None:
        motion = load_motion(public_motions / "carry_bread_box")
        path, lost = write_holosoma(motion, tmp_path / "a.npz")
        assert any("which of bread_box, support0, support1 is the object" in what for what in lost)
        with np.load(path) as file:
            assert "object_pos_w" not in file.files
        path, _ = write_holosoma(motion, tmp_path / "b.npz", "bread_box")
        with np.load(path) as file:
            i = motion.body_names.index("bread_box")
            np.testing.assert_array_equal(file["object_pos_w"], motion.body_pos_w[:, i])
        with pytest.raises(MotionError, match="no object 'crate'"):
            write_holosoma(motion, tmp_path / "c.npz", "crate")

    def test_resamples(self, write_motion: Callable[..., Path], tmp_path: Path) -> None:
        motion, path, _ = convert(write_motion(), tmp_path / "a.npz", "mjlab", fps=25.0)
        assert (motion.fps, read_mjlab(path).num_frames) == (25.0, 11)

    def test_errors(self, write_motion: Callable[..., Path], tmp_path: Path) -> None:
        source = write_motion()
        with pytest.raises(MotionError, match="no format 'fbx'"):
            convert(source, tmp_path / "a", "fbx")
        with pytest.raises(MotionError, match=r"ends in \.npz"):
            convert(source, tmp_path / "a", "mjlab")
        with pytest.raises(MotionError, match="no such file"):
            convert(tmp_path / "nothing", tmp_path / "a", "hdmi")
        (tmp_path / "a.txt").write_text("")
        with pytest.raises(MotionError, match=r"neither a motion folder nor an \.npz or \.csv"):
            convert(tmp_path / "a.txt", tmp_path / "a", "hdmi")
        with pytest.raises(MotionError, match="no such file"):
            convert(tmp_path, tmp_path / "a", "hdmi")

    def test_the_command_says_what_it_did(
        self, write_motion: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        from hdmi.commands.convert import main

        source, out = write_motion(), tmp_path / "out.npz"
        assert main([f"source={source}", f"out={out}", "to=mjlab"]) == 0
        said = capsys.readouterr().out
        assert "stroll: 21 frames at 50 fps" in said
        assert "mjlab cannot hold bodies box" in said
        assert said.splitlines()[-1] == str(out)
        assert main([f"source={tmp_path / 'none'}", f"out={out}", "to=mjlab"]) == 2
        assert "no such file" in capsys.readouterr().err
        assert main([f"source={source}"]) == 2

    def test_failed_writes_leave_nothing(self, write_motion: Callable[..., Path], tmp_path: Path, monkeypatch) -> None:
        motion = load_motion(write_motion())
        monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
        for write in (save_motion, write_mjlab, write_robot_csv):
            with pytest.raises(OSError, match="disk full"):
                write(motion, tmp_path / "new" / "a")
            assert not [p for p in (tmp_path / "new").rglob("*") if p.is_file()]
