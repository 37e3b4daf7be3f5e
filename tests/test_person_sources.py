"""What files of persons do not say, or say otherwise: axes, units, ground, rates, names; on files written here."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from sources import T, write_amass, write_bvh, write_gvhmr, write_intermimic, write_omomo

from hdmi.motion import MotionError
from hdmi.workshop.human import SMPL_JOINTS, SMPL_PARENTS, HumanMotion
from hdmi.workshop.skeleton import UPRIGHT, anthropometric_skeleton, pose_skeleton
from hdmi.workshop.sources import read_amass, read_bvh, read_gvhmr, read_intermimic, read_omomo, read_person
from hdmi.workshop.sources.joint_names import smpl_names
from hdmi.workshop.sources.world import AXES

# how a world in which SMPL's x, y and z are left, up and forward is written with each axis up
WRITTEN = {axis: turn.inv() * Rotation.from_euler("x", 90, degrees=True) for axis, turn in AXES.items()}
SAME = Rotation.identity()
PARTS = {
    "pelvis": "Hips", "spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2", "neck": "Neck", "head": "Head",
    "hip": "UpLeg", "knee": "Leg", "ankle": "Foot", "foot": "ToeBase",
    "collar": "Shoulder", "shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand",
}  # fmt: skip


def mixamo(joint: str) -> str:
    side, _, part = joint.partition("_")
    return PARTS[part or side] if side not in ("left", "right") else side.capitalize() + PARTS[part]


def write_person(
    path: Path,
    *,
    axes: Rotation = SAME,
    positions: str = "root",
    unit: float = 0.01,
    radians: bool = False,
    name: Callable[[str], str] = mixamo,
    edit: Callable[[str], str] = str,
    lift: float = 0.0,
    frames: int = 4,
) -> Path:
    """Somebody of 1.75 m who rests in a T-pose, but has arms down, one of them twisted, and bent knees.

    Args:
        axes: what turns SMPL's axes to the file's.
        positions: who has position channels: the `root`, or `all`, there at their offsets and in `zero` at zero.
    """
    skeleton = anthropometric_skeleton(1.75)
    local = {"left_shoulder": (0, 0, -1.2), "right_shoulder": (0, 0, 1.2), "left_elbow": (1.2, 0, 0), "neck": (0, 1, 0),
             "left_knee": (0.9, 0, 0), "right_knee": (0.9, 0, 0), "pelvis": (0, 0.4, 0)}  # fmt: skip
    lines, row = ["HIERARCHY"], []

    def emit(j: int) -> None:
        joint, root = SMPL_JOINTS[j], j == 0
        place = [0, 0.58 * 1.75 + lift, 0] if root else skeleton.offset[j]
        offset = axes.apply(place) / unit
        moves = root or positions != "root"
        lines.append(f"{'ROOT' if root else 'JOINT'} {name(joint)}\n{{\nOFFSET " + " ".join(f"{x:.6f}" for x in offset))
        channels = ["Xposition", "Yposition", "Zposition"] * moves + ["Zrotation", "Xrotation", "Yrotation"]
        lines.append(f"CHANNELS {len(channels)} {' '.join(channels)}")
        if moves:
            row.extend(offset if root or positions == "all" else np.zeros(3))
        turn = axes * Rotation.from_rotvec(local.get(joint, (0, 0, 0))) * axes.inv()
        row.extend(turn.as_euler("ZXY", degrees=not radians))
        children = [k for k, parent in enumerate(SMPL_PARENTS) if parent == j]
        for child in children:
            emit(child)
        lines.append("}" if children else "End Site\n{\nOFFSET 0 0 0\n}\n}")

    emit(0)
    values = [" ".join(f"{x:.8f}" for x in row)] * frames
    path.write_text(
        edit("\n".join([*lines, "MOTION", f"Frames: {frames}", "Frame Time: 0.02", *values, ""])), newline=""
    )
    return path


def pose(**rotations: tuple[float, float, float]) -> np.ndarray:
    """Axis times angle of all joints, the given ones turned. [J, 3]"""
    rotation = np.zeros((len(SMPL_JOINTS), 3))
    for joint, rotvec in rotations.items():
        rotation[SMPL_JOINTS.index(joint)] = rotvec
    return rotation


ARMS = {"left_shoulder": (0, 0, -1.2), "right_shoulder": (0, 0, 1.2)}


def write_posed(path: Path, root: Rotation, *, travel: float = 0.0, **rotations: tuple[float, float, float]) -> Path:
    """Somebody in one pose, z up, on the ground, who gets ahead by `travel` along x."""
    turned = pose(**rotations)
    turned[0] = root.as_rotvec()
    place = np.linspace([0, 0, 0], [travel, 0, 0], 40)
    poses = np.tile(turned, (40, 1, 1))
    motion = pose_skeleton("", anthropometric_skeleton(1.66), poses, place, 30.0, y_up=False)
    place[:, 2] -= motion.joint_pos[..., 2].min()
    np.savez(path, poses=poses.reshape(40, -1), trans=place, mocap_framerate=30.0)
    return path


CRAWL = dict.fromkeys(("left_hip", "right_hip"), (-np.pi / 2, 0, 0))
CRAWL |= dict.fromkeys(("left_knee", "right_knee"), (np.pi / 2, 0, 0))
PRONE = Rotation.from_euler("y", 90, degrees=True) * UPRIGHT  # the head towards x, the face down


class TestUp:
    """Which axis points up is told by the option, or is the format's if the person then stands."""

    def amass(self, path: Path, axis: str) -> Path:
        turn, skeleton = WRITTEN[axis], anthropometric_skeleton(1.66)
        poses = np.tile(pose(**ARMS), (T, 1, 1))
        poses[:, 0] = turn.as_rotvec()
        trans = turn.apply([0.0, 0.58 * 1.66, 0.0]) - skeleton.offset[0]
        np.savez(path, poses=poses.reshape(T, -1), trans=np.tile(trans, (T, 1)), mocap_framerate=30.0)
        return path

    def gvhmr(self, path: Path, axis: str) -> Path:
        turn, skeleton = WRITTEN[axis], anthropometric_skeleton(1.66 + 0.05)
        orient = torch.tensor(np.tile(turn.as_rotvec(), (T, 1)))
        trans = torch.tensor(np.tile(turn.apply([0.0, 0.58 * 1.71, 0.0]) - skeleton.offset[0], (T, 1)))
        return write_gvhmr(path, global_orient=orient, transl=trans)

    def omomo(self, path: Path, axis: str) -> Path:
        turn = WRITTEN[axis]
        place = turn.apply([[0.0, 0.58 * 1.8, 0.0]] * T)
        thing = turn.apply([[0.0, 0.3, 0.5]] * T)
        root = np.tile(turn.as_rotvec(), (T, 1))
        return write_omomo(
            path, root_orient=root, trans=place, obj_trans=thing, obj_rot=np.tile(turn.as_matrix(), (T, 1, 1))
        )

    def intermimic(self, path: Path, axis: str) -> Path:
        turn = WRITTEN[axis]
        write_intermimic(path)
        data = torch.load(path, weights_only=True)
        skeleton = anthropometric_skeleton(1.75)
        pos, _ = skeleton.forward(pose()[None], np.array([[0.0, 0.58 * 1.75, 0.0]]))
        from hdmi.workshop.sources.interaction import _INTERMIMIC_JOINTS

        every = np.zeros((52, 3))
        for j, name in enumerate(_INTERMIMIC_JOINTS):
            every[j] = turn.apply(pos[0, SMPL_JOINTS.index(name if name in SMPL_JOINTS else "pelvis")])
        data[:, 162:318] = torch.tensor(every).reshape(1, -1)
        # its bodies' frames are SMPL's, turned
        data[:, 383:] = torch.tensor((turn * UPRIGHT.inv()).as_quat()).repeat(52)
        torch.save(data, path)
        return path

    def bvh(self, path: Path, axis: str) -> Path:
        return write_person(path, axes=WRITTEN[axis])

    @pytest.mark.parametrize("axis", AXES)
    @pytest.mark.parametrize(
        ("form", "filename", "usual"),
        [
            ("amass", "a.npz", "z"), ("gvhmr", "hmr4d_results.pt", "y"), ("omomo", "sub1_box_0.npz", "z"),
            ("intermimic", "sub1_box_0.pt", "z"), ("bvh", "a.bvh", "y"),
        ],
    )  # fmt: skip
    def test_every_axis_of_every_format(self, tmp_path: Path, form: str, filename: str, usual: str, axis: str) -> None:
        path = getattr(self, form)(tmp_path / filename, axis)
        more: dict[str, Any] = {"source_fps": 30.0, "ground": "shift"}
        if axis != usual:
            with pytest.raises(MotionError, match="the trunk leans") as caught:
                read_person(path, form, **more)
            message = str(caught.value)
            assert str(path) in message
            assert f"from up={usual} " in message
            assert f"give up={axis}, or up={usual} if" in message
            assert "\n" not in message
        motion = read_person(path, form, up=axis, **more)
        head, pelvis, foot = (motion.pos(joint)[:, 2] for joint in ("head", "pelvis", "left_foot"))
        np.testing.assert_allclose(head - pelvis, (0.905 - 0.58) * motion.height, atol=0.01)
        np.testing.assert_allclose(foot, 0.012 * motion.height, atol=0.06)
        assert motion.joint_quat is not None
        upwards = Rotation.from_quat(motion.joint_quat[:, 0], scalar_first=True).apply([0, 1, 0])
        np.testing.assert_allclose(upwards, [[0, 0, 1]] * motion.num_frames, atol=1e-5)
        if form == "omomo":
            np.testing.assert_allclose(motion.object.pos[:, 2], 0.3, atol=0.02)
            box = Rotation.from_quat(motion.object.quat, scalar_first=True).apply([0, 1, 0])
            np.testing.assert_allclose(box, [[0, 0, 1]] * T, atol=1e-5)

    def test_a_pitched_camera(self, tmp_path: Path) -> None:
        """The camera's frame has y down, and the person leans in it as the camera is pitched."""
        seen = Rotation.from_euler("x", 25, degrees=True) * Rotation.from_euler("x", 180, degrees=True)
        path = write_posed(tmp_path / "a.npz", seen)
        with pytest.raises(MotionError, match="give up=-y, or up=z"):
            read_amass(path)
        assert read_amass(path, up="-y").pos("head")[0, 2] > 1.3

    def test_who_really_lies_can_be_told_to(self, tmp_path: Path) -> None:
        path = write_posed(tmp_path / "a.npz", PRONE, **ARMS)
        with pytest.raises(MotionError, match="up=z if the person does lie like this"):
            read_amass(path)
        motion = read_amass(path, up="z")
        assert motion.pos("head")[:, 2].max() < 0.3
        assert any("trunk leans" in note and "from up=z" in note for note in motion.notes)

    def test_who_crawls_ahead_is_believed_and_who_crawls_on_the_spot_asked(self, tmp_path: Path) -> None:
        ahead = read_amass(write_posed(tmp_path / "a.npz", PRONE, travel=3.0, **CRAWL))
        assert np.ptp(ahead.pos("pelvis")[:, 0]) == pytest.approx(3.0, abs=1e-3)
        assert any("trunk leans" in note for note in ahead.notes)
        with pytest.raises(MotionError, match="up=z if"):
            read_amass(write_posed(tmp_path / "b.npz", PRONE, **CRAWL))

    def test_a_handstand_is_no_other_axis(self, tmp_path: Path) -> None:
        head_down = Rotation.from_euler("y", 180, degrees=True) * UPRIGHT
        raised = {"left_shoulder": (0.0, 0.0, 1.5), "right_shoulder": (0.0, 0.0, -1.5)}
        motion = read_amass(write_posed(tmp_path / "a.npz", head_down, **raised))
        assert (motion.pos("left_wrist")[:, 2] < 0.1).all()
        assert (motion.pos("left_ankle")[:, 2] > 1.7).all()

    @pytest.mark.parametrize(
        "bent",
        [
            {"left_hip": (-2.2, 0, 0), "right_hip": (-2.2, 0, 0)},  # a deep bow: the trunk is below the horizontal
            {"left_hip": (-1.6, 0, 0), "right_hip": (-1.6, 0, 0), "left_knee": (1.6, 0, 0), "right_knee": (1.6, 0, 0)},
            {"left_knee": (1.6, 0, 0), "right_knee": (1.6, 0, 0)},  # kneels
        ],
    )
    def test_who_bows_sits_or_kneels_stands_as_far_as_axes_go(self, tmp_path: Path, bent: dict) -> None:
        lean = -bent.get("left_hip", (0,))[0] - bent.get("left_knee", (0,))[0]
        root = Rotation.from_euler("y", max(lean, 0.0)) * UPRIGHT
        motion = read_amass(write_posed(tmp_path / "a.npz", root, **bent))
        assert (motion.pos("pelvis")[:, 2] > motion.pos("left_foot")[:, 2]).all()

    def test_other_axes_are_refused(self, tmp_path: Path) -> None:
        with pytest.raises(MotionError, match=r"up: the axis that points up is one of x, .*, -z, got 'w'"):
            read_person(write_amass(tmp_path / "a.npz", "smplh"), up="w")


class TestUnit:
    @pytest.mark.parametrize(
        ("unit", "hint"), [(1.0, "unit=1 .metres"), (0.001, "unit=0.001 .milli"), (0.0254, "unit=0.0254 .inches")]
    )
    def test_a_bvh_in_another_unit_is_asked_about(self, tmp_path: Path, unit: float, hint: str) -> None:
        path = write_person(tmp_path / "a.bvh", unit=unit)
        for height in (None, 1.75):
            with pytest.raises(MotionError, match=f"is unit=0.01 m right[?] {hint}.* makes it 1.7"):
                read_bvh(path, height)
        given = read_bvh(path, unit=unit)
        np.testing.assert_allclose(given.joint_pos, read_bvh(write_person(tmp_path / "b.bvh")).joint_pos, atol=1e-5)

    def test_a_child_is_one_if_the_unit_or_the_height_says_so(self, tmp_path: Path) -> None:
        path = write_person(tmp_path / "a.bvh", unit=0.02)
        with pytest.raises(MotionError, match=r"by its legs the person is 0.87"):
            read_bvh(path)
        assert read_bvh(path, unit=0.01).height == pytest.approx(0.876, abs=0.01)
        assert read_bvh(path, height=0.9).height == 0.9
        with pytest.raises(MotionError, match=r"by its legs the person is 0.87\d m tall, not 1.75: .*unit=0.01 if"):
            read_bvh(write_person(tmp_path / "b.bvh", unit=0.02), height=1.75)
        with pytest.raises(MotionError, match=r"height: metres, from 0.5 to 2.5, expected, got 175"):
            read_bvh(path, height=175.0)

    @pytest.mark.parametrize("form", ["amass", "omomo", "intermimic", "gvhmr"])
    def test_units_of_the_others(self, tmp_path: Path, form: str) -> None:
        """A walk of 1 m/s in centimetres is a flight of 100; given the unit, it is a walk."""
        walk = np.linspace([0.0, 0.0, 90.0], [100.0 * T / 30, 0.0, 90.0], T)
        if form == "amass":
            path = write_amass(tmp_path / "a.npz", "smplx", trans=walk)
        elif form == "gvhmr":
            path = write_gvhmr(tmp_path / "hmr4d_results.pt", transl=torch.tensor(walk[:, [0, 2, 1]]))
        elif form == "omomo":
            path = write_omomo(
                tmp_path / "a.npz",
                trans=walk,
                rest_offsets=100 * np.load(write_omomo(tmp_path / "b.npz"))["rest_offsets"],
            )
        else:
            path = write_intermimic(tmp_path / "a.pt")
            data = torch.load(path, weights_only=True)
            data[:, 162:321] *= 100
            torch.save(data, path)
        with pytest.raises(MotionError, match="is unit=1 m right"):
            read_person(path, form, source_fps=30.0)
        motion = read_person(path, form, source_fps=30.0, unit=0.01)
        assert np.ptp(motion.pos("pelvis"), axis=0).max() < 1.1 * T / 30
        assert 1.6 < motion.height < 1.9

    @pytest.mark.parametrize("unit", [0.0, -1.0, np.inf, np.nan])
    def test_what_is_no_unit_is_refused(self, tmp_path: Path, unit: float) -> None:
        with pytest.raises(MotionError, match="unit: metres, more than 0, expected"):
            read_bvh(write_person(tmp_path / "a.bvh"), unit=unit)

    def test_angles_in_radians_are_asked_about(self, tmp_path: Path) -> None:
        path = write_person(tmp_path / "a.bvh", radians=True)
        with pytest.raises(MotionError, match=r"are angles in radians[?] Give angles=radians, or angles=degrees"):
            read_bvh(path)
        usual = read_bvh(write_person(tmp_path / "b.bvh"))
        np.testing.assert_allclose(read_bvh(path, angles="radians").joint_pos, usual.joint_pos, atol=1e-5)
        assert np.abs(read_bvh(path, angles="degrees").joint_pos - usual.joint_pos).max() > 0.3
        with pytest.raises(MotionError, match="angles: degrees or radians expected, got 'turns'"):
            read_bvh(path, angles="turns")

    def test_smpls_angles_in_degrees_are_refused(self, tmp_path: Path) -> None:
        poses = np.zeros((T, 156))
        poses[:, 3 * SMPL_JOINTS.index("left_shoulder") + 2] = -70
        with pytest.raises(MotionError, match="'left_shoulder': 70 in the median frame: are these degrees"):
            read_amass(write_amass(tmp_path / "a.npz", "smplh", poses=poses))


class TestGround:
    """A reader keeps heights where body and ground are the file's; retargeting shifts (tests/test_retarget.py)."""

    def test_shift_and_keep(self, tmp_path: Path) -> None:
        path = write_person(tmp_path / "a.bvh", lift=0.3)
        usual, shifted = read_bvh(path), read_bvh(path, ground="shift")
        moved = usual.joint_pos[..., 2] - shifted.joint_pos[..., 2]
        np.testing.assert_allclose(moved, moved.mean(), atol=1e-5)
        lowest = min(shifted.pos(f"{side}_foot")[:, 2].min() for side in ("left", "right"))
        assert lowest == pytest.approx(0.012 * shifted.height, abs=1e-4)
        assert any("onto the ground; ground=keep" in note for note in shifted.notes)
        np.testing.assert_allclose(read_bvh(path, ground="keep").joint_pos, usual.joint_pos)

    def test_a_body_that_is_not_the_files_is_shifted_unless_told_to_keep(self, tmp_path: Path) -> None:
        path = write_amass(tmp_path / "a.npz", "smplh", trans=np.tile([0.1, 0.2, 1.5], (T, 1)))
        assert read_amass(path).pos("pelvis")[0, 2] == pytest.approx(0.58 * 1.71, abs=0.01)
        kept = read_amass(path, ground="keep")
        assert kept.pos("pelvis")[0, 2] == pytest.approx(1.5, abs=1e-4)
        with pytest.raises(MotionError, match="ground: shift or keep expected, got 'up'"):
            read_amass(path, ground="up")


class TestRestPose:
    @pytest.mark.parametrize("positions", ["all", "zero"])
    def test_position_channels_of_all_joints_change_nothing(self, tmp_path: Path, positions: str) -> None:
        plain = read_bvh(write_person(tmp_path / "a.bvh"))
        other = read_bvh(write_person(tmp_path / "b.bvh", positions=positions))
        np.testing.assert_allclose(other.joint_pos, plain.joint_pos, atol=1e-5)
        assert plain.joint_quat is not None
        assert other.joint_quat is not None
        np.testing.assert_allclose(other.joint_quat, plain.joint_quat, atol=1e-5)
        assert other.notes == plain.notes == ()

    def test_positions_of_a_frame_take_the_place_of_the_offset(self, tmp_path: Path) -> None:
        path = write_person(tmp_path / "a.bvh", positions="all")
        text = path.read_text()
        offset = f"{0.245 * 175:.8f}"
        assert f"-{offset}" in text
        path.write_text(text.replace(f"-{offset}", f"-{0.25 * 175:.8f}"))
        longer = read_bvh(path)
        thigh = np.linalg.norm(longer.pos("left_hip") - longer.pos("left_knee"), axis=-1)
        np.testing.assert_allclose(thigh, 0.25 * 1.75, atol=1e-4)

    @pytest.mark.parametrize("heading", [0, 90, 180, 270])
    def test_orientations_are_smpls_wherever_the_rest_pose_faces(self, tmp_path: Path, heading: float) -> None:
        motion = read_bvh(write_person(tmp_path / "a.bvh", axes=Rotation.from_euler("y", heading, degrees=True)))
        assert motion.joint_quat is not None
        for joint, child, along in (
            ("left_elbow", "left_wrist", [1, 0, 0]),
            ("right_elbow", "right_wrist", [-1, 0, 0]),
            ("left_hip", "left_knee", [0, -1, 0]),
        ):
            bone = motion.pos(child) - motion.pos(joint)
            turn = Rotation.from_quat(motion.joint_quat[:, motion.index(joint)], scalar_first=True)
            bone /= np.linalg.norm(bone, axis=-1, keepdims=True)
            np.testing.assert_allclose(turn.apply(along), bone, atol=1e-5)
        forward = Rotation.from_quat(motion.joint_quat[:, motion.index("left_foot")], scalar_first=True)
        # bent by 0.9 rad at the knee, toes point down
        assert (forward.apply([0, 0, 1])[:, 2] < -0.7).all()

    def test_why_orientations_are_not_used_is_noted(self, tmp_path: Path) -> None:
        lafan = read_bvh(write_bvh(tmp_path / "a.bvh"))
        assert lafan.joint_quat is None
        assert "orientations are not used" in lafan.notes[0]
        assert "lacks left_elbow" in lafan.notes[0]

        def hang(text: str) -> str:
            hung, arms = re.subn(r"OFFSET -?28\.350000 \S+ \S+", "OFFSET 0 -28.35 0", text)
            assert arms == 2
            return hung

        hanging = read_bvh(write_person(tmp_path / "b.bvh", edit=hang))
        assert hanging.joint_quat is None
        assert "its rest pose is no T-pose (from left_shoulder to left_elbow)" in hanging.notes[0]


USUAL = (
    "Hips LeftUpLeg LeftLeg LeftFoot LeftToeBase Spine Spine1 Spine2 Neck Head "
    "LeftShoulder LeftArm LeftForeArm LeftHand"
)
SOFTWARE = {
    "Mixamo": USUAL,
    "LAFAN1": USUAL.replace("ToeBase", "Toe"),
    "MotionBuilder": " ".join(f"Character1_{name}" for name in USUAL.split()),
    "numbered": " ".join(f"mixamorig1:{name}_{i:03d}" for i, name in enumerate(USUAL.split())),
    "capitals": USUAL.upper(),
    "lower case": USUAL.lower(),
    "suffixed": " ".join(f"{name}_jnt" for name in USUAL.split()),
    "Rokoko": "Hips LeftThigh LeftShin LeftFoot LeftToe Spine1 Spine2 Spine3 Neck Head LeftShoulder LeftArm LeftForeArm"
    " LeftHand",
    "Xsens": "Hips LeftHip LeftKnee LeftAnkle LeftToe Chest Chest2 Chest3 Neck Head LeftCollar LeftShoulder LeftElbow"
    " LeftWrist",
    "OptiTrack": "Hip LThigh LShin LFoot LToe Chest Ab . Neck Head LShoulder LUArm LFArm LHand",
    "Biped": "Bip01_Pelvis Bip01_L_Thigh Bip01_L_Calf Bip01_L_Foot Bip01_L_Toe0 Bip01_Spine Bip01_Spine1 Bip01_Spine2"
    " Bip01_Neck Bip01_Head Bip01_L_Clavicle Bip01_L_UpperArm Bip01_L_Forearm Bip01_L_Hand",
    "Unreal": "pelvis thigh_l calf_l foot_l ball_l spine_01 spine_02 spine_03 neck_01 head clavicle_l upperarm_l"
    " lowerarm_l hand_l",
    "VRoid": "J_Bip_C_Hips J_Bip_L_UpperLeg J_Bip_L_LowerLeg J_Bip_L_Foot J_Bip_L_ToeBase J_Bip_C_Spine J_Bip_C_Chest"
    " J_Bip_C_UpperChest J_Bip_C_Neck J_Bip_C_Head J_Bip_L_Shoulder J_Bip_L_UpperArm J_Bip_L_LowerArm J_Bip_L_Hand",
    "SMPL": "Pelvis L_Hip L_Knee L_Ankle L_Foot Spine1 Spine2 Spine3 Neck Head L_Collar L_Shoulder L_Elbow L_Wrist",
    "Blender": "hips thigh.L shin.L foot.L toe.L spine chest . neck head shoulder.L upper_arm.L forearm.L hand.L",
}  # fmt: skip
LEFT = ("pelvis", "left_hip", "left_knee", "left_ankle", "left_foot", "spine1", "spine2", "spine3", "neck", "head",
        "left_collar", "left_shoulder", "left_elbow", "left_wrist")  # fmt: skip


class TestNames:
    @pytest.mark.parametrize("software", SOFTWARE)
    def test_names_of_common_software(self, software: str) -> None:
        theirs = SOFTWARE[software].split()
        found = dict(zip(LEFT, smpl_names(theirs), strict=True))
        wrong = {joint: name for joint, name in found.items() if joint != name}
        # few have three joints where SMPL's spine has
        assert set(wrong) <= {"spine2", "spine3"}
        assert not set(wrong.values()) & set(SMPL_JOINTS)

    def test_what_is_no_limb_keeps_its_name(self) -> None:
        others = ["LHipJoint", "LeftHandIndex1", "LeftForeArmTwist", "LeftToe_End", "HeadTop_End", "LowerBack", "Neck1"]
        theirs = ["Hips", "Neck", "LeftUpLeg", *others]
        assert smpl_names(theirs) == ("pelvis", "neck", "left_hip", *others)

    @pytest.mark.parametrize("prefix", ["Model_", "mixamorig:", "mixamorig1:", "mixamorig_", "Skeleton_001_", "a|b|"])
    def test_a_file_with_a_prefix_is_the_one_without(self, tmp_path: Path, prefix: str) -> None:
        plain = read_bvh(write_person(tmp_path / "a.bvh"))
        other = read_bvh(write_person(tmp_path / "b.bvh", name=lambda joint: prefix + mixamo(joint)))
        assert other.joint_names == plain.joint_names
        np.testing.assert_array_equal(other.joint_pos, plain.joint_pos)

    def test_a_file_of_names(self, tmp_path: Path) -> None:
        path = write_person(tmp_path / "a.bvh", name=lambda joint: f"bone{SMPL_JOINTS.index(joint)}")
        with pytest.raises(MotionError, match=r"no root Hips among bone0, bone1, .*names=FILE"):
            read_bvh(path)
        names = tmp_path / "names.yaml"
        names.write_text("".join(f"bone{j}: {joint}\n" for j, joint in enumerate(SMPL_JOINTS)))
        plain = read_bvh(write_person(tmp_path / "b.bvh"))
        found = read_person(path, names=names)
        assert found.joint_names == plain.joint_names
        np.testing.assert_array_equal(found.joint_pos, plain.joint_pos)

    def test_a_few_names_go_before_what_is_found(self, tmp_path: Path) -> None:
        names = tmp_path / "names.yaml"
        names.write_text("ShinBone: left_knee\nNeck: head\n")
        path = write_person(
            tmp_path / "a.bvh", name=lambda joint: "ShinBone" if joint == "left_knee" else mixamo(joint)
        )
        found = read_bvh(path, names=names)
        assert {"left_knee", "head", "Head"} <= set(found.joint_names)
        assert "neck" not in found.joint_names

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("Hips: pelvi", "Hips: 'pelvi' is none of SMPL's joints: pelvis, left_hip"),
            ("Hip: pelvis", "Hip: there is no such joint among Hips, LeftUpLeg"),
            ("Hips: pelvis\nSpine: pelvis", "Spine: pelvis is another joint's name already"),
            ("- Hips", "lines such as"),
            ("", "lines such as"),
            ("a: [", "not a YAML file"),
            ("Hips: {x: pelvis}", "Hips: {'x': 'pelvis'} is none of"),
        ],
    )
    def test_a_wrong_file_of_names(self, tmp_path: Path, text: str, message: str) -> None:
        names = tmp_path / "names.yaml"
        names.write_text(text)
        with pytest.raises(MotionError) as caught:
            read_bvh(write_person(tmp_path / "a.bvh"), names=names)
        assert message in str(caught.value)
        assert str(names) in str(caught.value)
        assert "\n" not in str(caught.value)
        with pytest.raises(MotionError, match=r"none.yaml: no such file"):
            read_bvh(tmp_path / "a.bvh", names=tmp_path / "none.yaml")

    def test_without_legs_the_missing_joints_are_named_unless_the_height_is_given(self, tmp_path: Path) -> None:
        path = write_person(tmp_path / "a.bvh", name=lambda joint: mixamo(joint).replace("Leg", "Bone"))
        with pytest.raises(
            MotionError, match="legs, which lack left_hip, left_knee, right_hip, right_knee; give height"
        ):
            read_bvh(path)
        assert read_bvh(path, height=1.7).height == 1.7


class TestDialects:
    @pytest.mark.parametrize(
        "edit",
        [
            lambda text: text.replace("Zposition", "ZPosition"),
            lambda text: text.replace("Zrotation", "ZRotation").replace("Xposition", "XPOSITION"),
            lambda text: text.replace("HIERARCHY", "hierarchy").replace("MOTION", "Motion").replace("ROOT", "Root"),
            lambda text: text.replace("JOINT", "Joint").replace("OFFSET", "Offset").replace("CHANNELS", "Channels"),
            lambda text: text.replace("End Site", "End site"),
            lambda text: text.replace("Frames: ", "Frames:").replace("Frame Time: ", "Frame Time:"),
            lambda text: text.replace("Frames: ", "FRAMES :\t").replace("Frame Time: ", "frame time:\t"),
            lambda text: text.replace("\n", "\r\n"),
            lambda text: "\ufeff" + text,
            lambda text: text.replace(" ", "\t").replace("Frame\tTime", "Frame Time").replace("End\tSite", "End Site"),
            lambda text: text.replace("\n", "\n\n").replace("\n}", "\n    }  ") + "\n\n",
            lambda text: text.replace("\n{", " {"),
            lambda text: text.replace("JOINT Head", "JOINT Motion_Hat"),
            lambda text: text.replace("JOINT Head", "JOINT Hard Hat"),
        ],
    )
    def test_what_exporters_write_reads_alike(self, tmp_path: Path, edit: Callable[[str], str]) -> None:
        plain = read_bvh(write_person(tmp_path / "a.bvh"))
        path = write_person(tmp_path / "b.bvh")
        assert edit(path.read_text()) != path.read_text()
        other = read_bvh(write_person(tmp_path / "b.bvh", edit=edit))
        np.testing.assert_array_equal(other.joint_pos, plain.joint_pos)

    @pytest.mark.parametrize(
        ("old", "new", "message"),
        [
            ("Zrotation", "Wrotation", "CHANNELS of 'Hips': 6 of Xposition.*'Wrotation' is none"),
            ("Xrotation", "Zrotation", "CHANNELS of 'Hips'.*each at most once"),
            ("CHANNELS 3", "CHANNELS 4", "CHANNELS of 'LeftUpLeg': 4 of .*'JOINT' is none"),
            ("Time: 0.02", "Time: 0,02", "'0,02': a decimal point expected"),
            (" 0.00000000", " 0,00000000", "'0,0.*: a decimal point expected at frame 0, channel 2"),
            ("Frames: 4", "Frames: four", "MOTION: Frames or Frame Time: .*'four'"),
            ("Frames: 4", "Rows: 4", "MOTION: 'Frames: N' and 'Frame Time: S' expected"),
            ("Time: 0.02", "Time: 0", "Frame Time must be .*; give source_fps"),
            ("Time: 0.02", "Time: 0.000001", "Frame Time must be .*got 1e-06; give source_fps"),
        ],
    )
    def test_what_is_wrong_is_said(self, tmp_path: Path, old: str, new: str, message: str) -> None:
        path = write_person(tmp_path / "a.bvh", edit=lambda text: text.replace(old, new, 1))
        with pytest.raises(MotionError, match=message) as caught:
            read_bvh(path)
        assert str(path) in str(caught.value)


class TestRate:
    @pytest.mark.parametrize("key", ["fps", "framerate", "frame_rate", "mocap_frame_rate"])
    @pytest.mark.parametrize("rate", [30, 30.0, np.array([30.0]), np.array([[30]]), "30", b"30.0", np.float32(30)])
    def test_generations_of_fields(self, tmp_path: Path, key: str, rate: Any) -> None:
        with np.load(write_amass(tmp_path / "a.npz", "smplh")) as file:
            arrays = {name: file[name] for name in ("poses", "trans", "betas")}
        np.savez(tmp_path / "b.npz", **arrays, **{key: rate})
        assert read_amass(tmp_path / "b.npz").fps == 30.0

    @pytest.mark.parametrize(
        ("rate", "message"),
        [
            ("fast", "mocap_framerate: one number expected, got .fast.; give source_fps"),
            (1e6, "mocap_framerate: fps must be from 1 to 1000.*got 1000000.0; give source_fps"),
            (0.0, "mocap_framerate: fps must be .*; give source_fps"),
            (np.nan, "mocap_framerate: fps must be"),
        ],
    )
    def test_what_is_no_rate(self, tmp_path: Path, rate: Any, message: str) -> None:
        path = write_amass(tmp_path / "a.npz", "smplh", mocap_framerate=rate)
        with pytest.raises(MotionError, match=message):
            read_amass(path)
        assert read_person(path, source_fps=25.0).fps == 25.0

    def test_a_file_without_one_asks_for_it(self, tmp_path: Path) -> None:
        with np.load(write_amass(tmp_path / "a.npz", "smplh")) as file:
            np.savez(tmp_path / "b.npz", **{name: file[name] for name in ("poses", "trans", "betas")})
        with pytest.raises(MotionError, match=r"no mocap_framerate or .* says how many frames a second has"):
            read_person(tmp_path / "b.npz")
        assert read_person(tmp_path / "b.npz", source_fps=60.0).fps == 60.0

    @pytest.mark.parametrize(
        ("write", "filename", "told"),
        [
            (lambda path: write_amass(path, "smplx"), "a.npz", "mocap_frame_rate says 120"),
            (write_omomo, "a.npz", "OMOMO says 30"),
            (write_intermimic, "a_box_0.pt", "InterMimic says 30"),
            (write_person, "a.bvh", "its Frame Time says 50"),
        ],
    )
    def test_a_rate_that_is_given_counts_and_is_noted_where_it_differs(
        self, tmp_path: Path, write: Callable[[Path], Path], filename: str, told: str
    ) -> None:
        path = write(tmp_path / filename)
        motion = read_person(path, source_fps=25.0)
        assert motion.fps == 25.0
        assert f"read at the 25 fps that source_fps says; {told}" in motion.notes
        same = read_person(path, source_fps=read_person(path).fps)
        assert not any("source_fps" in note for note in same.notes)

    def test_a_bvh_without_a_frame_time_takes_what_is_given(self, tmp_path: Path) -> None:
        path = write_person(tmp_path / "a.bvh", edit=lambda text: text.replace("Time: 0.02", "Time: 0"))
        assert read_bvh(path, fps=24.0).fps == 24.0
        with pytest.raises(MotionError, match="source_fps: fps must be from 1 to 1000"):
            read_bvh(path, fps=0.0)


class TestFields:
    def test_messages_have_the_files_names(self, tmp_path: Path) -> None:
        trans = np.zeros((T, 3))
        trans[7, 1] = np.nan
        for key in ("trans", "transl"):
            with np.load(write_amass(tmp_path / "a.npz", "smplh")) as file:
                arrays = {name: file[name] for name in ("poses", "betas", "mocap_framerate")}
            np.savez(tmp_path / "b.npz", **arrays, **{key: trans})
            with pytest.raises(MotionError, match=rf"b.npz: {key}: not finite at frame 7, index \(1,\)"):
                read_amass(tmp_path / "b.npz")

    def test_smplx_names_and_poses_by_joint(self, tmp_path: Path) -> None:
        plain = read_amass(write_amass(tmp_path / "a.npz", "smplh"))
        with np.load(tmp_path / "a.npz") as file:
            rows, rest = file["poses"], {"betas": file["betas"], "fps": 120.0}
            np.savez(
                tmp_path / "b.npz", global_orient=rows[:, :3], body_pose=rows[:, 3:66], transl=file["trans"], **rest
            )
            np.savez(tmp_path / "c.npz", poses=rows.reshape(T, 52, 3), trans=file["trans"], **rest)
        for name in ("b", "c"):
            np.testing.assert_array_equal(read_amass(tmp_path / f"{name}.npz").joint_pos, plain.joint_pos)


class TestBlankFrames:
    """Frames of zeros before and after a motion are padding; in between, and without a motion, they are not."""

    def tensor(self, path: Path, blank: list[int]) -> Path:
        write_intermimic(path)
        data = torch.load(path, weights_only=True)
        data[blank] = 0.0
        torch.save(data, path)
        return path

    @pytest.mark.parametrize(
        ("blank", "kept", "note"),
        [
            ([0], slice(1, T), "dropped 1 blank frame at the start"),
            ([0, 1, T - 1], slice(2, T - 1), "dropped 2 blank frames at the start and 1 blank frame at the end"),
            ([], slice(0, T), None),
        ],
    )
    def test_intermimic(self, tmp_path: Path, blank: list[int], kept: slice, note: str | None) -> None:
        whole = read_intermimic(write_intermimic(tmp_path / "a_box_0.pt"))
        motion = read_intermimic(self.tensor(tmp_path / "b_box_0.pt", blank))
        np.testing.assert_array_equal(motion.joint_pos, whole.joint_pos[kept])
        np.testing.assert_array_equal(motion.object.pos, whole.object.pos[kept])
        np.testing.assert_array_equal(motion.contact, whole.contact[kept])
        assert [told for told in motion.notes if "blank" in told] == ([] if note is None else [note])

    def test_a_gap_is_named_in_frames_of_the_file(self, tmp_path: Path) -> None:
        with pytest.raises(MotionError, match=r"columns 383-591: norm 0\.000 at frame 4, body 'pelvis'"):
            read_intermimic(self.tensor(tmp_path / "a_box_0.pt", [0, 4]))

    def test_the_others(self, tmp_path: Path) -> None:
        def first_blank(array: np.ndarray) -> np.ndarray:
            return np.concatenate([np.zeros_like(array[:1]), array[1:]])

        with np.load(write_amass(tmp_path / "a.npz", "smplh")) as file:
            arrays = {key: first_blank(file[key]) for key in ("poses", "trans")}
        amass = read_amass(write_amass(tmp_path / "a.npz", "smplh", **arrays))
        with np.load(write_omomo(tmp_path / "b.npz")) as file:
            arrays = {key: first_blank(file[key]) for key in ("root_orient", "pose_body", "trans")}
        omomo = read_omomo(write_omomo(tmp_path / "b.npz", **arrays))
        bvh = write_person(tmp_path / "c.bvh")
        *head, first, second, third, fourth = bvh.read_text().splitlines()
        zeros = " ".join("0" for _ in first.split())
        bvh.write_text("\n".join([*head, zeros, second, third, fourth]))
        person: list[HumanMotion] = [amass, omomo, read_bvh(bvh)]
        for motion, frames in zip(person, (T, T, 4), strict=True):
            assert motion.num_frames == frames - 1
            assert "dropped 1 blank frame at the start" in motion.notes
        assert omomo.object.pos[0, 0] == pytest.approx(0.05)
        gvhmr = read_gvhmr(write_gvhmr(tmp_path / "a.pt", transl=torch.zeros(T, 3)), 30.0)
        assert gvhmr.num_frames == T - 1
