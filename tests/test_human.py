"""The neutral human motion and the skeleton that poses it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hdmi.motion import MotionError
from hdmi.workshop.human import SMPL_JOINTS, HumanMotion, ObjectTrajectory
from hdmi.workshop.skeleton import (
    UPRIGHT,
    anthropometric_skeleton,
    body_model_skeleton,
    height_from_legs,
    pose_skeleton,
    stand_on_ground,
)

T = 7
IDENTITY = np.tile([1.0, 0.0, 0.0, 0.0], (T, 1))


def person(**changes: Any) -> HumanMotion:
    """Two joints that move along x at 0.3 m/s, with a box."""
    x = 0.01 * np.arange(T)
    pos = np.stack([np.stack([x, 0 * x, 0 * x + z], axis=-1) for z in (1.0, 0.5)], axis=1)
    values: dict[str, Any] = {
        "name": "stroll",
        "fps": 30.0,
        "height": 1.7,
        "joint_names": ("pelvis", "left_knee"),
        "joint_pos": pos,
        "joint_quat": np.tile(IDENTITY[:, None], (1, 2, 1)),
        "object": ObjectTrajectory("box", np.stack([x, x, x], axis=-1), IDENTITY, joint_pos=x),
        "contact": np.arange(T)[:, None] >= 4,
        "contact_names": ("left_knee",),
    }
    return HumanMotion(**(values | changes))


def t_pose(height: float = 1.8, **rotations: tuple[float, float, float]) -> HumanMotion:
    """Upright, facing x, with some joints turned; two frames."""
    skeleton = anthropometric_skeleton(height)
    rotation = np.zeros((2, len(SMPL_JOINTS), 3))
    rotation[:, 0] = UPRIGHT.as_rotvec()
    for joint, rotvec in rotations.items():
        rotation[:, SMPL_JOINTS.index(joint)] = rotvec
    root = -skeleton.offset[:1].repeat(2, axis=0) + [0, 0, 0.58 * height]
    return pose_skeleton("t", skeleton, rotation, root, 30.0, y_up=False)


class TestHumanMotion:
    def test_arrays_are_float32_and_labels_bool(self) -> None:
        motion = person(contact=(np.arange(T)[:, None] >= 4).astype(int))
        assert motion.joint_pos.dtype == motion.joint_quat.dtype == motion.object.quat.dtype == np.float32
        assert motion.contact.dtype == bool
        assert motion.num_frames == T
        np.testing.assert_allclose(motion.pos("left_knee")[3], [0.03, 0, 0.5])

    @pytest.mark.parametrize(
        ("changes", "fragments"),
        [
            ({"fps": 0.0}, ["fps"]),
            ({"fps": np.nan}, ["fps"]),
            ({"height": 170.0}, ["height", "170"]),
            ({"joint_names": ("pelvis", "pelvis")}, ["joint_names", "distinct"]),
            ({"joint_names": ("pelvis",)}, ["joint_pos", "(7, 2, 3)"]),
            ({"joint_pos": np.zeros((1, 2, 3))}, ["joint_pos", "2 frames"]),
            ({"joint_quat": np.zeros((T, 2, 4))}, ["joint_quat", "frame 0", "'pelvis'"]),
            ({"contact": np.full((T, 1), 0.5)}, ["contact", "0.5", "frame 0"]),
            ({"contact": None}, ["contact"]),
            ({"contact_names": ()}, ["contact", "(7, 1)"]),
            ({"object": ObjectTrajectory("box", np.zeros((T, 2)), IDENTITY)}, ["object.pos", "(7, 2)"]),
            ({"object": ObjectTrajectory("box", np.zeros((T, 3)), 2 * IDENTITY)}, ["object.quat", "'box'"]),
        ],
    )
    def test_refuses(self, changes: dict[str, Any], fragments: list[str]) -> None:
        with pytest.raises(MotionError) as caught:
            person(**changes)
        for fragment in ("stroll", *fragments):
            assert fragment in str(caught.value)

    def test_names_the_frame_that_is_not_finite(self) -> None:
        pos = np.zeros((T, 2, 3))
        pos[5, 1, 2] = np.inf
        with pytest.raises(MotionError, match=r"joint_pos: not finite at frame 5, index \(1, 2\)"):
            person(joint_pos=pos)

    def test_missing_joint(self) -> None:
        with pytest.raises(MotionError, match="lacks the joint 'head'; it has pelvis, left_knee"):
            person().pos("head")

    def test_resample_doubles_the_frames_in_between(self) -> None:
        motion = person().resample(60.0)
        assert (motion.fps, motion.num_frames) == (60.0, 13)
        np.testing.assert_allclose(motion.pos("pelvis")[:, 0], 0.005 * np.arange(13), atol=1e-6)
        np.testing.assert_allclose(motion.object.joint_pos, 0.005 * np.arange(13), atol=1e-6)
        np.testing.assert_array_equal(motion.contact[::2], person().contact)
        assert motion.contact.dtype == bool

    def test_shift_takes_the_object_along(self) -> None:
        motion = person().shifted(np.array([1.0, 2.0, 3.0]))
        np.testing.assert_allclose(motion.pos("pelvis")[0], [1, 2, 4])
        np.testing.assert_allclose(motion.object.pos[0], [1, 2, 3])


class TestSkeleton:
    def test_upright_faces_x_with_its_left_at_y(self) -> None:
        motion = t_pose(1.8)
        np.testing.assert_allclose(motion.pos("pelvis")[0], [0, 0, 0.58 * 1.8], atol=1e-6)
        assert motion.pos("left_foot")[0, 0] > motion.pos("left_ankle")[0, 0]
        assert motion.pos("left_wrist")[0, 1] > motion.pos("left_elbow")[0, 1] > motion.pos("left_shoulder")[0, 1] > 0

    def test_published_proportions(self) -> None:
        motion = t_pose(1.8)
        for joint, share in (("hip", 0.53), ("knee", 0.285), ("ankle", 0.039), ("shoulder", 0.818)):
            np.testing.assert_allclose(motion.pos(f"right_{joint}")[0, 2], share * 1.8, atol=1e-5)
        arm = [np.linalg.norm(motion.pos(a)[0] - motion.pos(b)[0]) for a, b in (("left_shoulder", "left_elbow"),
               ("left_elbow", "left_wrist"))]  # fmt: skip
        # de Leva (1996): 281.7 and 268.9 mm at 1741 mm
        np.testing.assert_allclose(arm, [0.2817 * 1.8 / 1.741, 0.2689 * 1.8 / 1.741], rtol=5e-3)

    def test_is_symmetric(self) -> None:
        motion = t_pose()
        for joint in ("hip", "knee", "foot", "collar", "wrist"):
            left, right = motion.pos(f"left_{joint}")[0], motion.pos(f"right_{joint}")[0]
            np.testing.assert_allclose(left * [1, -1, 1], right, atol=1e-6)

    def test_elbow_flexes_forward(self) -> None:
        """SMPL's left arm points along x: turning about minus y brings it to z, which is forward."""
        motion = t_pose(left_elbow=(0, -np.pi / 2, 0))
        forearm = motion.pos("left_wrist")[0] - motion.pos("left_elbow")[0]
        np.testing.assert_allclose(forearm / np.linalg.norm(forearm), [1, 0, 0], atol=1e-5)

    def test_knee_flexes_backward(self) -> None:
        motion = t_pose(right_knee=(np.pi / 2, 0, 0))
        shank = motion.pos("right_ankle")[0] - motion.pos("right_knee")[0]
        assert shank[0] < -0.4

    def test_children_move_with_their_parents(self) -> None:
        """The whole body turned about the vertical is the same as turning the root."""
        turned = t_pose(spine1=(0, 0.7, 0))
        for joint in ("left_hip", "right_ankle", "pelvis"):
            np.testing.assert_allclose(turned.pos(joint), t_pose().pos(joint), atol=1e-6)
        wrist, still = turned.pos("left_wrist")[0], t_pose().pos("left_wrist")[0]
        axis = t_pose().pos("spine1")[0]
        c, s = np.cos(0.7), np.sin(0.7)
        expected = axis + np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ (still - axis)
        np.testing.assert_allclose(wrist, expected, atol=1e-5)

    def test_height_from_legs_finds_the_height_again(self) -> None:
        motion = t_pose(1.62, left_knee=(1.0, 0, 0))
        # the ankle is a little behind the knee: not all of the shank is vertical
        assert height_from_legs(motion.joint_names, motion.joint_pos) == pytest.approx(1.62, rel=0.01)
        with pytest.raises(MotionError, match="height"):
            height_from_legs(("pelvis",), motion.joint_pos[:, :1])

    def test_stands_on_the_ground(self) -> None:
        raised = t_pose().shifted(np.array([0, 0, 0.4]))
        np.testing.assert_allclose(stand_on_ground(raised).joint_pos, t_pose().joint_pos, atol=1e-5)


class TestBodyModel:
    def write(self, path, **changes: np.ndarray):
        """A body model of 44 vertices: joint j is the mean of vertices 2j and 2j+1; beta 0 is size."""
        from hdmi.workshop.human import SMPL_PARENTS

        skeleton = anthropometric_skeleton(1.7)
        rest = np.zeros((22, 3))
        for j, parent in enumerate(SMPL_PARENTS):
            rest[j] = skeleton.offset[j] + (rest[parent] if parent >= 0 else 0)
        template = rest.repeat(2, axis=0) + np.tile([[0.02, 0, 0], [-0.02, 0, 0]], (22, 1))
        directions = np.zeros((44, 3, 4))
        directions[..., 0] = 0.1 * template
        regressor = np.kron(np.eye(22), [[0.5, 0.5]])
        # SMPL stores the root's parent as 2**32 - 1
        tree = np.array([[2**32 - 1, *SMPL_PARENTS[1:]], range(22)], dtype=np.uint32)
        arrays = {"v_template": template, "shapedirs": directions, "J_regressor": regressor, "kintree_table": tree}
        np.savez(path, **(arrays | changes), joint2num=np.array({"a": 1}, dtype=object))
        return path

    def test_joints_come_from_the_regressor(self, tmp_path) -> None:
        path = self.write(tmp_path / "model.npz")
        mean, large = body_model_skeleton(path), body_model_skeleton(path, [2.0, 5.0])
        np.testing.assert_allclose(mean.offset, anthropometric_skeleton(1.7).offset, atol=1e-6)
        np.testing.assert_allclose(large.offset, 1.2 * mean.offset, atol=1e-6)
        assert large.height == pytest.approx(1.2 * mean.height)

    @pytest.mark.parametrize(
        ("changes", "fragment"),
        [
            ({"J_regressor": np.zeros((22, 43))}, "do not agree"),
            ({"kintree_table": np.zeros((2, 22), np.int64)}, "kintree_table"),
            ({"v_template": np.array(["a"] * 44)}, "must be numbers"),
            ({"v_template": np.full((44, 3), np.nan)}, "not finite"),
            ({"J_regressor": np.array([{}], dtype=object)}, "plain arrays"),
        ],
    )
    def test_refuses(self, tmp_path, changes: dict[str, np.ndarray], fragment: str) -> None:
        path = self.write(tmp_path / "model.npz", **changes)
        with pytest.raises(MotionError, match=fragment) as caught:
            body_model_skeleton(path)
        assert "model.npz" in str(caught.value)
