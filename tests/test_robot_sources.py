"""Motions of robots from other projects: what their numbers mean, which joints they have, and pickles that are data."""

from __future__ import annotations

import importlib
import io
import json
import os
import pickle
import re
import sys
import types
import warnings
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sources import write_mjlab_file

from hdmi.assets import HingeConfig, ObjectConfig, default_joint_pos, g1, g1_robot
from hdmi.motion import Motion, MotionError, forward_kinematics, load_motion, make_reference, save_motion
from hdmi.motion.complete import is_finger_joint
from hdmi.motion.format import motion_from_poses
from hdmi.workshop.sources import (
    Conventions,
    convert,
    guess_format,
    read_holosoma,
    read_mjlab,
    read_robot_csv,
    read_robot_pickle,
    write_holosoma,
    write_robot_csv,
)
from hdmi.workshop.sources.formats import Options
from hdmi.workshop.sources.layouts import LAYOUTS
from hdmi.workshop.sources.plain_pickle import read_plain_pickle

T = 12
FINGERS = [
    f"{side}_hand_{finger}_joint"
    for side in ("left", "right")
    for finger in ("thumb_0", "thumb_1", "thumb_2", "middle_0", "middle_1", "index_0", "index_1")
]
pytestmark = pytest.mark.filterwarnings("ignore:.*does not say its rate:UserWarning")


def angles(names: tuple[str, ...] = g1.JOINT_NAMES) -> np.ndarray:
    """Every joint at an angle of its own, near that of the default pose. [T, J] float32"""
    own = dict(zip(g1.JOINT_NAMES, default_joint_pos() + 0.004 * np.arange(29), strict=True))
    pose = np.array([own.get(name, 0.7) for name in names])
    return (pose + 0.02 * np.sin(np.arange(T))[:, None]).astype(np.float32)


def pose(heading: float = 0.0, tilt: Rotation | None = None, height: float = 0.76) -> tuple[np.ndarray, np.ndarray]:
    """A root that walks ahead by 5 cm a frame, heading in degrees: position [T, 3] and orientation, wxyz [T, 4]."""
    turn = Rotation.from_euler("z", heading + 2 * np.arange(T)[:, None], degrees=True)
    way = np.stack([0.05 * np.arange(T), np.zeros(T), np.full(T, height)], axis=-1)
    pos = Rotation.from_euler("z", heading, degrees=True).apply(way)
    return pos, (turn * (tilt or Rotation.identity())).as_quat(scalar_first=True)


def table(pos: np.ndarray, wxyz: np.ndarray, joints: np.ndarray, order: str = "xyzw") -> np.ndarray:
    return np.concatenate([pos, np.roll(wxyz, -1, axis=-1) if order == "xyzw" else wxyz, joints], axis=1)


def write_csv(path: Path, rows: np.ndarray, **options: Any) -> Path:
    np.savetxt(path, rows, **{"delimiter": ",", "fmt": "%.9g", "comments": "", **options})
    return path


def walking(heading: float = 0.0) -> Motion:
    pos, quat = pose(heading)
    body_pos, body_quat = forward_kinematics(g1_robot(), pos, quat, angles())
    return motion_from_poses("walk", 50.0, g1.BODY_NAMES, g1.JOINT_NAMES, body_pos, body_quat, angles())


def upright(motion: Motion) -> bool:
    root = Rotation.from_quat(motion.body_quat_w[:, motion.body_names.index("pelvis")], scalar_first=True)
    return bool((root.as_matrix()[:, 2, 2] > 0.9).all())


def turned_world(axis: str) -> Rotation:
    """From a world that is z up to one in which `axis` points up."""
    target = np.zeros(3)
    target["xyz".index(axis[-1])] = -1.0 if axis[0] == "-" else 1.0
    found, _ = Rotation.align_vectors([target], [[0.0, 0.0, 1.0]])
    return found


class TestOrderOfQuaternions:
    @pytest.mark.parametrize("heading", [0, 60, 120, -90, 140])
    def test_w_first_is_refused_and_taken_when_given(self, tmp_path: Path, heading: float) -> None:
        pos, quat = pose(heading)
        path = write_csv(tmp_path / "a.csv", table(pos, quat, angles(), "wxyz"))
        with pytest.raises(MotionError, match=r"a\.csv: columns 4-7: .* upright with quat=wxyz") as caught:
            read_robot_csv(path)
        assert "\n" not in str(caught.value)
        motion = read_robot_csv(path, given=Conventions(quat="wxyz"))
        assert upright(motion)
        np.testing.assert_allclose(motion.body_quat_w[:, 0], quat, atol=1e-6)
        believed = read_robot_csv(path, given=Conventions(quat="xyzw", ground="keep"))
        np.testing.assert_allclose(believed.body_quat_w[:, 0], np.roll(quat, 1, axis=-1), atol=1e-6)

    @pytest.mark.parametrize("heading", range(0, 360, 45))
    def test_w_last_is_taken_whatever_the_heading(self, tmp_path: Path, heading: float) -> None:
        pos, quat = pose(heading)
        motion = read_robot_csv(write_csv(tmp_path / "a.csv", table(pos, quat, angles())))
        np.testing.assert_allclose(motion.body_quat_w[:, 0], quat, atol=1e-6)

    def test_a_robot_that_seems_to_walk_backwards_is_noted(self, tmp_path: Path) -> None:
        """Facing backwards, both readings are upright."""
        pos, quat = pose(178)
        path = write_csv(tmp_path / "a.csv", table(pos, quat, angles(), "wxyz"))
        with pytest.warns(UserWarning, match=r"walks backwards; .* quat=wxyz"):
            read_robot_csv(path)

    @pytest.mark.parametrize("axis", ["x", "y"])
    @pytest.mark.parametrize("heading", [0, 90, 180])
    def test_a_robot_that_lies_on_the_ground_lies(self, tmp_path: Path, axis: str, heading: float) -> None:
        pos, quat = pose(heading, Rotation.from_euler(axis, -90, degrees=True), height={"x": 0.34, "y": 0.1}[axis])
        motion = read_robot_csv(write_csv(tmp_path / "a.csv", table(pos, quat, angles())))
        np.testing.assert_allclose(motion.body_quat_w[:, 0], quat, atol=1e-6)

    @pytest.mark.parametrize("axis", ["x", "y"])
    def test_a_robot_in_a_motion_folder_may_lie_on_something(self, tmp_path: Path, axis: str) -> None:
        pos, quat = pose(0, Rotation.from_euler(axis, -90, degrees=True), height=0.8)
        body_pos, body_quat = forward_kinematics(g1_robot(), pos, quat, angles())
        motion = motion_from_poses("bed", 50.0, g1.BODY_NAMES, g1.JOINT_NAMES, body_pos, body_quat, angles())
        taken, _, _ = convert(save_motion(motion, tmp_path / "bed"), tmp_path / "same", "hdmi")
        np.testing.assert_array_equal(taken.body_quat_w, motion.body_quat_w)

    @pytest.mark.parametrize("writer", ["mjlab", "holosoma", "hdmi", "pickle"])
    def test_in_every_format(self, tmp_path: Path, writer: str, capsys: pytest.CaptureFixture[str]) -> None:
        from hdmi.commands.convert import main

        motion = walking(heading=50)
        other = "wxyz" if writer == "pickle" else "xyzw"
        wrong = replace(motion, body_quat_w=np.roll(motion.body_quat_w, -1, axis=-1))
        path = tmp_path / {"hdmi": "walk", "pickle": "walk.pkl"}.get(writer, "walk.npz")
        if writer == "hdmi":
            save_motion(wrong, path)
        elif writer == "pickle":
            path.write_bytes(pickle.dumps(gmr(motion) | {"root_rot": motion.body_quat_w[:, 0]}))
        elif writer == "holosoma":
            write_holosoma(motion, path)
            with np.load(path) as file:
                arrays = dict(file)
            np.savez(path, **(arrays | {"body_quat_w": np.roll(arrays["body_quat_w"], -1, axis=-1)}))
        else:
            keys = ("joint_pos", "joint_vel", "body_pos_w", "body_quat_w", "body_lin_vel_w", "body_ang_vel_w")
            write_mjlab_file(path, {key: getattr(wrong, key) for key in keys}, "isaac")
        command = [f"source={path}", f"out={tmp_path / 'out'}", "to=hdmi"]
        assert main(command) == 2
        error = capsys.readouterr().err.strip()
        assert f"quat={other}" in error
        assert len(error.splitlines()) == 1
        assert main([*command, f"quat={other}"]) == 0
        taken = load_motion(tmp_path / "out")
        np.testing.assert_allclose(taken.body_quat_w, motion.body_quat_w, atol=1e-5)
        np.testing.assert_allclose(taken.body_ang_vel_w, motion.body_ang_vel_w, atol=1e-4)

    def test_unnormalised_and_zero(self, tmp_path: Path) -> None:
        pos, quat = pose()
        rows = table(pos, quat, angles())
        rows[:, 3:7] *= 1.005
        np.testing.assert_allclose(
            read_robot_csv(write_csv(tmp_path / "a.csv", rows)).body_quat_w[:, 0], quat, atol=1e-6
        )
        rows[4, 3:7] = 0
        with pytest.raises(MotionError, match=r"b\.csv: columns 4-7: norm 0\.000 at frame 4, body 'root'"):
            read_robot_csv(write_csv(tmp_path / "b.csv", rows))


class TestAxisThatPointsUp:
    @pytest.mark.parametrize("axis", ["y", "-z", "x", "-y", "-x"])
    def test_is_named_and_taken(self, tmp_path: Path, axis: str) -> None:
        pos, quat = pose(30)
        turn = turned_world(axis)
        moved = (turn * Rotation.from_quat(quat, scalar_first=True)).as_quat(scalar_first=True)
        path = write_csv(tmp_path / "a.csv", table(turn.apply(pos), moved, angles()))
        with pytest.raises(MotionError, match=f"upright with up={axis}: "):
            read_robot_csv(path)
        motion = read_robot_csv(path, given=Conventions(up=axis))
        assert upright(motion)
        np.testing.assert_allclose(motion.body_pos_w[:, 0, 2], 0.76, atol=1e-5)
        straight = read_robot_csv(write_csv(tmp_path / "b.csv", table(pos, quat, angles())))
        # but for the heading, which is anyone's choice
        np.testing.assert_allclose(
            np.linalg.norm(motion.body_lin_vel_w, axis=-1), np.linalg.norm(straight.body_lin_vel_w, axis=-1), atol=1e-4
        )
        believed = read_robot_csv(path, given=Conventions(up="z", ground="keep"))
        np.testing.assert_allclose(believed.body_pos_w[:, 0], turn.apply(pos), atol=1e-5)

    def test_together_with_w_first(self, tmp_path: Path) -> None:
        pos, quat = pose()
        turn = turned_world("y")
        moved = (turn * Rotation.from_quat(quat, scalar_first=True)).as_quat(scalar_first=True)
        path = write_csv(tmp_path / "a.csv", table(turn.apply(pos), moved, angles(), "wxyz"))
        with pytest.raises(MotionError, match="upright with quat=wxyz up=y"):
            read_robot_csv(path)
        assert upright(read_robot_csv(path, given=Conventions(quat="wxyz", up="y")))


class TestUnits:
    def rows(self) -> np.ndarray:
        return table(*pose(), angles())

    def test_degrees(self, tmp_path: Path) -> None:
        rows = self.rows()
        rows[:, 7:] = np.rad2deg(rows[:, 7:])
        path = write_csv(tmp_path / "a.csv", rows)
        with pytest.raises(MotionError, match=r"_joint is at .* rad at frame \d+, .* give angles=degrees"):
            read_robot_csv(path)
        motion = read_robot_csv(path, given=Conventions(angles="degrees"))
        np.testing.assert_allclose(motion.joint_pos, angles(), atol=1e-5)
        believed = read_robot_csv(path, given=Conventions(angles="radians", ground="keep"))
        np.testing.assert_allclose(believed.joint_pos, np.rad2deg(angles()), atol=1e-4)

    def test_joints_beyond_reach_in_any_unit(self, tmp_path: Path) -> None:
        rows = self.rows()
        rows[3, 7 + 4] = 700.0
        with pytest.raises(
            MotionError, match=r"left_ankle_pitch_joint is at 700\.00 rad at frame 3, .* another robot's"
        ):
            read_robot_csv(write_csv(tmp_path / "a.csv", rows))

    @pytest.mark.parametrize(("factor", "unit"), [(100, 0.01), (1000, 0.001)])
    def test_lengths(self, tmp_path: Path, factor: float, unit: float) -> None:
        rows = self.rows()
        rows[:, :3] *= factor
        path = write_csv(tmp_path / "a.csv", rows)
        with pytest.raises(MotionError, match=f"give unit={unit}"):
            read_robot_csv(path)
        motion = read_robot_csv(path, given=Conventions(unit=unit))
        np.testing.assert_allclose(motion.body_pos_w[:, 0], pose()[0], atol=1e-5)

    def test_npz_in_degrees_or_centimetres(self, tmp_path: Path) -> None:
        motion = walking()
        keys = ("joint_pos", "joint_vel", "body_pos_w", "body_quat_w", "body_lin_vel_w", "body_ang_vel_w")
        arrays = {key: getattr(motion, key) for key in keys}
        degrees = arrays | {key: np.rad2deg(arrays[key]) for key in ("joint_pos", "joint_vel")}
        with pytest.raises(MotionError, match="give angles=degrees"):
            read_mjlab(write_mjlab_file(tmp_path / "a.npz", degrees, "mujoco"))
        taken = read_mjlab(tmp_path / "a.npz", given=Conventions(angles="degrees"))
        np.testing.assert_allclose(taken.joint_vel, motion.joint_vel, atol=1e-4)
        far = arrays | {key: 100 * arrays[key] for key in ("body_pos_w", "body_lin_vel_w")}
        with pytest.raises(MotionError, match=r"give unit=0\.01"):
            read_mjlab(write_mjlab_file(tmp_path / "b.npz", far, "isaac"))
        taken = read_mjlab(tmp_path / "b.npz", given=Conventions(unit=0.01))
        np.testing.assert_allclose(taken.body_pos_w, motion.body_pos_w, atol=1e-5)

    def test_joint_targets_are_angles_and_what_cannot_hold_them_says_so(self, tmp_path: Path) -> None:
        motion = replace(walking(), joint_target=angles() + np.float32(0.1))
        degrees = {key: np.rad2deg(getattr(motion, key)) for key in ("joint_pos", "joint_vel", "joint_target")}
        save_motion(replace(motion, **degrees), tmp_path / "degrees")
        taken, _, lost = convert(
            tmp_path / "degrees", tmp_path / "hdmi", "hdmi", options=Options(given=Conventions(angles="degrees"))
        )
        np.testing.assert_allclose(taken.joint_target, motion.joint_target, atol=1e-5)
        np.testing.assert_allclose(load_motion(tmp_path / "hdmi").joint_target, motion.joint_target, atol=1e-5)
        assert not lost
        _, _, lost = convert(tmp_path / "hdmi", tmp_path / "a.npz", "mjlab")
        assert "joint_target" in lost

    @pytest.mark.parametrize(
        ("option", "value"),
        [("quat", "zyx"), ("angles", "turns"), ("up", "w"), ("ground", "yes"), ("unit", 0.0), ("unit", float("nan"))],
    )
    def test_options_that_are_none(self, option: str, value: Any) -> None:
        with pytest.raises(MotionError, match=f"{option}="):
            Conventions(**{option: value})


class TestGround:
    def path(self, tmp_path: Path, by: float) -> Path:
        return write_csv(tmp_path / "a.csv", table(*pose(height=0.76 + by), angles()))

    def soles(self, motion: Motion) -> float:
        feet = [motion.body_names.index(name) for name in g1.FEET]
        turn = Rotation.from_quat(motion.body_quat_w[:, feet].reshape(-1, 4), scalar_first=True)
        points = [motion.body_pos_w[:, feet].reshape(-1, 3) + turn.apply(point) for point in g1.FOOT_POINTS]
        return float(np.min(np.stack(points)[..., 2])) - g1.FOOT_POINT_RADIUS

    @pytest.mark.parametrize("by", [1.0, 0.3, -0.9])
    def test_shift_puts_the_soles_on_it(self, tmp_path: Path, by: float) -> None:
        motion = read_robot_csv(self.path(tmp_path, by), given=Conventions(ground="shift"))
        assert abs(self.soles(motion)) < 0.002
        np.testing.assert_allclose(motion.body_pos_w[:, 0, :2], pose()[0][:, :2], atol=1e-6)

    def test_above_is_said_and_below_is_refused(self, tmp_path: Path) -> None:
        with pytest.warns(UserWarning, match=r"above the ground by (0\.9[5-9]|1\.0\d) m .* ground=shift"):
            motion = read_robot_csv(self.path(tmp_path, 1.0))
        np.testing.assert_allclose(motion.body_pos_w[:, 0, 2], 1.76, atol=1e-6)
        with pytest.raises(MotionError, match=r"below the ground by (0\.7|0\.8)\d m .* ground=shift .* ground=keep"):
            read_robot_csv(self.path(tmp_path, -0.79))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            kept = read_robot_csv(self.path(tmp_path, -0.79), 50.0, given=Conventions(ground="keep"))
        np.testing.assert_allclose(kept.body_pos_w[:, 0, 2], -0.03, atol=1e-6)

    def test_a_motion_folder_is_taken_as_it_is(self, tmp_path: Path) -> None:
        """Its scene may have something to stand on."""
        raised = walking().body_pos_w + np.float32([0, 0, 0.9])
        folder = save_motion(replace(walking(), body_pos_w=raised), tmp_path / "walk")
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            motion, _, _ = convert(folder, tmp_path / "same", "hdmi")
        np.testing.assert_array_equal(motion.body_pos_w, raised)
        down, _, _ = convert(folder, tmp_path / "down", "hdmi", options=Options(given=Conventions(ground="shift")))
        assert abs(self.soles(down)) < 0.002


class TestTables:
    """Dialects of CSV."""

    def rows(self) -> np.ndarray:
        return table(*pose(), angles())

    def expect(self, path: Path, names: tuple[str, ...] = g1.JOINT_NAMES, fps: float = 50.0) -> Motion:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            motion = read_robot_csv(path, fps)
        assert motion.joint_names == names
        np.testing.assert_allclose(motion.joint_pos, angles(names), atol=1e-5)
        np.testing.assert_allclose(motion.body_pos_w[:, 0], pose()[0], atol=1e-5)
        np.testing.assert_allclose(motion.body_quat_w[:, 0], pose()[1], atol=1e-5)
        return motion

    @pytest.mark.parametrize(
        "root", [list("xyzabcd"), ["root_pos_x", "root_pos_y", "root_pos_z", "q0", "q1", "q2", "q3"]]
    )
    def test_a_header_decides_about_the_order_of_joints(self, tmp_path: Path, root: list[str]) -> None:
        order = np.random.default_rng(0).permutation(29)
        names = [g1.JOINT_NAMES[i] for i in order]
        rows = np.concatenate([self.rows()[:, :7], self.rows()[:, 7:][:, order]], axis=1)
        self.expect(write_csv(tmp_path / "a.csv", rows, header=",".join(root + names)), tuple(names))
        short = [name.removesuffix("_joint") + "_dof" for name in names]
        self.expect(write_csv(tmp_path / "b.csv", rows, header=",".join(root + short)), tuple(names))

    def test_a_header_decides_about_the_root(self, tmp_path: Path) -> None:
        root = ["root_qw", "root_qx", "root_qy", "root_qz", "root_z", "root_y", "root_x"]
        rows = self.rows()
        moved = np.concatenate([rows[:, [6, 3, 4, 5]], rows[:, [2, 1, 0]], rows[:, 7:]], axis=1)
        self.expect(write_csv(tmp_path / "a.csv", moved, header=",".join([*root, *g1.JOINT_NAMES])))

    def test_euler_angles_in_degrees_and_centimetres(self, tmp_path: Path) -> None:
        """As the BONES-SEED data set has them."""
        pos, quat = pose()
        euler = Rotation.from_quat(quat, scalar_first=True).as_euler("xyz", degrees=True)
        names = ["Frame", *(f"root_translate{a}" for a in "XYZ"), *(f"root_rotate{a}" for a in "XYZ")]
        names += [f"{name}_dof" for name in g1.JOINT_NAMES]
        rows = np.concatenate([np.arange(T)[:, None], 100 * pos, euler, np.rad2deg(angles())], axis=1)
        path = write_csv(tmp_path / "a.csv", rows, header=",".join(names))
        with pytest.raises(MotionError, match="angles=degrees"):
            read_robot_csv(path)
        motion = read_robot_csv(path, 50.0, given=Conventions(angles="degrees", unit=0.01))
        np.testing.assert_allclose(motion.body_quat_w[:, 0], quat, atol=1e-5)
        np.testing.assert_allclose(motion.body_pos_w[:, 0], pos, atol=1e-5)
        np.testing.assert_allclose(motion.joint_pos, angles(), atol=1e-5)

    def test_any_other_header_is_skipped_with_a_note(self, tmp_path: Path) -> None:
        path = write_csv(tmp_path / "a.csv", self.rows(), header=",".join(f"c{i}" for i in range(36)))
        with pytest.warns(UserWarning, match=r"the header \(c0, .*skipped"):
            motion = read_robot_csv(path)
        np.testing.assert_allclose(motion.joint_pos, angles(), atol=1e-5)

    @pytest.mark.parametrize("name", ["frame", "Frame_ID", "", "index"])
    def test_a_column_of_frames_is_dropped(self, tmp_path: Path, name: str) -> None:
        rows = np.concatenate([np.arange(T)[:, None], self.rows()], axis=1)
        header = ",".join([name, *"xyz", "qx", "qy", "qz", "qw", *g1.JOINT_NAMES])
        self.expect(write_csv(tmp_path / "a.csv", rows, header=header))
        with pytest.raises(MotionError, match=r"shape \(12, 37\), expected 30 or 34 or 36 or 50 columns"):
            read_robot_csv(write_csv(tmp_path / "b.csv", rows))

    def test_a_column_of_seconds_tells_the_rate(self, tmp_path: Path) -> None:
        rows = np.concatenate([0.02 * np.arange(T)[:, None], self.rows()], axis=1)
        path = write_csv(
            tmp_path / "a.csv", rows, header=",".join(["time", *"xyz", "a", "b", "c", "d", *g1.JOINT_NAMES])
        )
        assert read_robot_csv(path).fps == 50.0
        assert read_robot_csv(path, 25.0).fps == 25.0

    def test_no_rate_is_noted(self, tmp_path: Path) -> None:
        with pytest.warns(UserWarning, match="taken as 30 fps; else give source_fps"):
            assert read_robot_csv(write_csv(tmp_path / "a.csv", self.rows())).fps == 30.0

    @pytest.mark.parametrize("separator", [",", ";", "\t", " ", ", ", " ; "])
    def test_separators(self, tmp_path: Path, separator: str) -> None:
        self.expect(write_csv(tmp_path / "a.csv", self.rows(), delimiter=separator))
        header = separator.join([*"xyzabcd", *g1.JOINT_NAMES])
        path = write_csv(tmp_path / "b.csv", self.rows(), delimiter=separator, header=header)
        self.expect(path)
        trailing = separator.strip(" ") or separator
        path.write_text("".join(line + trailing + "\r\n" for line in path.read_text().splitlines()), encoding="utf-8")
        self.expect(path)

    def test_decimal_commas(self, tmp_path: Path) -> None:
        path = write_csv(tmp_path / "a.csv", self.rows(), delimiter=";")
        path.write_text(path.read_text().replace(".", ","))
        self.expect(path)

    def test_comments_byte_order_mark_and_quotes(self, tmp_path: Path) -> None:
        path = write_csv(tmp_path / "a.csv", self.rows())
        lines = path.read_text().splitlines()
        header = ",".join(f'"{name}"' for name in [*"xyzabcd", *g1.JOINT_NAMES])
        path.write_text("\ufeff# made by hand\n" + header + "\n\n" + "\n# half\n".join(lines) + "\n", encoding="utf-8")
        self.expect(path)

    def test_a_header_that_is_a_comment(self, tmp_path: Path) -> None:
        names = tuple(reversed(g1.JOINT_NAMES))
        rows = table(*pose(), angles(names))
        self.expect(write_csv(tmp_path / "a.csv", rows, header=",".join([*"xyzabcd", *names]), comments="# "), names)

    @pytest.mark.parametrize(
        ("change", "fragment"),
        [
            (lambda names: [*names[:-1], "right_wrist_yow_joint"], "right_wrist_yow_joint"),
            (lambda names: [*names[:-1], names[-2]], "right_wrist_pitch_joint twice"),
            (lambda names: names[:-1], "names 35 columns, the rows have 36"),
            (lambda names: ["tail_joint", *names[1:7], *names[7:]], "tail_joint"),
        ],
    )
    def test_headers_that_do_not_fit(self, tmp_path: Path, change: Callable, fragment: str) -> None:
        names = change(["x", "y", "z", "qx", "qy", "qz", "qw", *g1.JOINT_NAMES])
        if "tail_joint" in names:
            names[1:7] = ["y", "z", "qx", "qy", "qz", "q"]
            names[7] = "tail2_joint"
        path = write_csv(tmp_path / "a.csv", self.rows(), header=",".join(names))
        with pytest.raises(MotionError, match=fragment) as caught:
            read_robot_csv(path)
        assert str(path) in str(caught.value)

    @pytest.mark.parametrize(
        ("old", "new", "fragment"),
        [
            ("0.05,", "abc,", "line 2, column 1: 'abc'"),
            ("0.05,", "", "line 2: 35 columns, the line before has 36"),
            ("0.05,", "nan,", "not finite at frame 1"),
            ("0.05,", "1e400,", "not finite at frame 1"),
        ],
    )
    def test_rows_that_do_not_fit(self, tmp_path: Path, old: str, new: str, fragment: str) -> None:
        path = write_csv(tmp_path / "a.csv", self.rows())
        first, second, *others = path.read_text().splitlines()
        assert second.startswith(old)
        path.write_text("\n".join([first, second.replace(old, new, 1), *others]))
        with pytest.raises(MotionError, match=fragment):
            read_robot_csv(path)

    def test_one_row(self, tmp_path: Path) -> None:
        with pytest.raises(MotionError, match="needs at least 2 frames, has 1"):
            read_robot_csv(write_csv(tmp_path / "a.csv", self.rows()[:1]))

    def test_written_tables_are_read_to_the_bit(self, tmp_path: Path) -> None:
        motion = walking(20)
        write_robot_csv(motion, tmp_path / "a.csv")
        again = read_robot_csv(tmp_path / "a.csv", 50.0)
        np.testing.assert_array_equal(again.joint_pos, motion.joint_pos)
        np.testing.assert_array_equal(again.body_pos_w[:, 0], motion.body_pos_w[:, 0])
        np.testing.assert_array_equal(again.body_quat_w[:, 0], motion.body_quat_w[:, 0])
        write_robot_csv(again, tmp_path / "b.csv")
        assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


class TestJoints:
    @pytest.mark.parametrize("layout", [name for name in LAYOUTS if name != "g1_29dof_with_hand"])
    def test_layouts(self, tmp_path: Path, layout: str) -> None:
        names = LAYOUTS[layout]
        path = write_csv(tmp_path / "a.csv", table(*pose(), angles(names)))
        motion = read_robot_csv(path, joints=layout)
        assert motion.joint_names == names
        np.testing.assert_allclose(motion.joint_pos, angles(names), atol=1e-6)
        lacking = [i for i, name in enumerate(g1.JOINT_NAMES) if name not in names]
        full = angles()
        full[:, lacking] = default_joint_pos()[lacking]
        expected, _ = forward_kinematics(g1_robot(), *pose(), full)
        np.testing.assert_allclose(motion.body_pos_w, expected, atol=1e-5)

    def test_unitrees_23(self, tmp_path: Path) -> None:
        rows = np.delete(table(*pose(), angles()), [20, 21, 27, 28, 34, 35], axis=1)
        with pytest.warns(
            UserWarning, match="23 joints, taken as those of g1_23dof; else give joints=g1_29dof_anneal_23dof"
        ):
            motion = read_robot_csv(write_csv(tmp_path / "a.csv", rows))
        absent = {"waist_roll", "waist_pitch"} | {f"{s}_wrist_{a}" for s in ("left", "right") for a in ("pitch", "yaw")}
        assert set(g1.JOINT_NAMES) - set(motion.joint_names) == {f"{name}_joint" for name in absent}
        reference = make_reference(load_motion(save_motion(motion, tmp_path / "a")), control_dt=1 / 30)
        np.testing.assert_allclose(reference.joint_pos[:, 15], angles()[:, 15], atol=1e-6)

    def test_another_order_is_refused_where_joints_tell(self, tmp_path: Path) -> None:
        pose_of = dict(zip(g1.JOINT_NAMES, default_joint_pos(), strict=True))
        pose_of |= {"left_knee_joint": 1.2, "right_knee_joint": 1.3, "left_shoulder_roll_joint": 0.9}
        names = LAYOUTS["g1_29dof_isaac"]
        joints = np.tile([pose_of[name] for name in names], (T, 1))
        path = write_csv(tmp_path / "a.csv", table(*pose(), joints))
        with pytest.raises(MotionError, match="give joints=g1_29dof_isaac"):
            read_robot_csv(path)
        with pytest.raises(MotionError, match=r"joints=h1: there is g1_29dof, "):
            read_robot_csv(path, joints="h1")
        with pytest.raises(MotionError, match="29 joints; g1_23dof has 23"):
            read_robot_csv(path, joints="g1_23dof")

    @pytest.mark.parametrize("count", [1, 12, 28, 30, 42])
    def test_other_counts(self, tmp_path: Path, count: int) -> None:
        with pytest.raises(MotionError, match=rf"shape \(12, {7 + count}\), expected"):
            read_robot_csv(write_csv(tmp_path / "a.csv", np.zeros((T, 7 + count))))


class TestHands:
    def motion(self, *more: str) -> Motion:
        motion = walking()
        names = (*motion.joint_names, *FINGERS, *more)
        pad = np.zeros((T, len(FINGERS) + len(more)), np.float32)
        joint_pos, joint_vel = (np.concatenate([a, pad], axis=1) for a in (motion.joint_pos, motion.joint_vel))
        return replace(motion, joint_names=names, joint_pos=joint_pos, joint_vel=joint_vel)

    @pytest.mark.parametrize(
        "name", [*FINGERS, "L_thumb_proximal_yaw_joint", "right_index_1_joint", "left_zero_joint", "LeftHandThumb1"]
    )
    def test_names_of_fingers(self, name: str) -> None:
        assert is_finger_joint(name)

    @pytest.mark.parametrize(
        "name",
        [*g1.JOINT_NAMES, "left_knee", "left_wrist_rol_joint", "door_joint", "left_door_hinge", "handle_joint", "lid"],
    )
    def test_names_of_others(self, name: str) -> None:
        assert not is_finger_joint(name)

    def test_training_and_validation_take_the_folder(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        folder = save_motion(self.motion(), tmp_path / "walk")
        with pytest.warns(UserWarning, match="'walk': joints of hands are dropped: left_hand_thumb_0_joint, "):
            reference = make_reference(folder, control_dt=0.02)
        np.testing.assert_allclose(reference.joint_pos, angles(), atol=1e-6)

        from hdmi.commands.validate import main

        with pytest.warns(UserWarning, match="joints of hands"):
            main([str(folder), "task=none"])
        assert "joint_names" not in "".join(capsys.readouterr())

    def test_the_objects_hinge_stays(self, tmp_path: Path) -> None:
        motion = self.motion("left_hand_drill_joint")
        box = np.tile(np.float32([1, 0, 0]), (T, 1, 1)), np.tile(np.float32([1, 0, 0, 0]), (T, 1, 1))
        motion = motion_from_poses(
            "walk",
            50.0,
            (*motion.body_names, "drill"),
            motion.joint_names,
            np.concatenate([motion.body_pos_w, box[0]], axis=1),
            np.concatenate([motion.body_quat_w, box[1]], axis=1),
            motion.joint_pos + 0.25 * (np.arange(len(motion.joint_names)) == 43),
        )
        geoms = [{"box": [0.1, 0.1, 0.1]}]
        drill = ObjectConfig("drill", geoms, hinge=HingeConfig("left_hand_drill_joint", "bit", geoms))
        with pytest.warns(UserWarning, match="joints of hands"):
            reference = make_reference(motion, control_dt=0.02, object=drill)
        np.testing.assert_allclose(reference.object_joint_pos, 0.25, atol=1e-6)

    def test_a_misspelt_joint_is_no_finger(self, tmp_path: Path) -> None:
        motion = self.motion()
        names = tuple(name.replace("left_wrist_roll", "left_wrist_rol") for name in motion.joint_names)
        motion = replace(motion, joint_names=names)
        with (
            pytest.warns(UserWarning, match="joints of hands"),
            pytest.raises(MotionError, match=r"joint_names: \['left_wrist_rol_joint'\]"),
        ):
            make_reference(motion, control_dt=0.02)

    @pytest.mark.parametrize("source", ["hdmi", "csv", "named csv", "holosoma", "pickle"])
    def test_convert_drops_them_with_a_note(
        self, tmp_path: Path, source: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        from hdmi.commands.convert import main

        names = LAYOUTS["g1_29dof_with_hand"]
        rows = table(*pose(), angles(names))
        path = tmp_path / "a.csv"
        if source == "hdmi":
            path = save_motion(self.motion("door_joint"), tmp_path / "walk")
        elif source == "holosoma":
            path = tmp_path / "a.npz"
            motion = self.motion()
            write_holosoma(walking(), path)
            with np.load(path) as file:
                arrays = dict(file) | {"joint_names": np.array(motion.joint_names)}
            np.savez(path, **(arrays | {key: getattr(motion, key) for key in ("joint_pos", "joint_vel")}))
        elif source == "pickle":
            path = tmp_path / "a.pkl"
            path.write_bytes(pickle.dumps(gmr(walking()) | {"dof_pos": angles(names)}))
        else:
            header = ",".join([*"xyzabcd", *names]) if source == "named csv" else ""
            write_csv(path, rows, header=header)
            if not header:
                path.write_text(path.read_text().lstrip("\n"))
        assert main([f"source={path}", f"out={tmp_path / 'out'}", "to=hdmi"]) == 0
        said = capsys.readouterr().out
        assert "left_hand_thumb_0_joint" in said or source == "csv"
        motion = load_motion(tmp_path / "out")
        assert motion.joint_names == (*g1.JOINT_NAMES, *(["door_joint"] if source == "hdmi" else []))
        np.testing.assert_allclose(motion.joint_pos[:, :29], angles(), atol=1e-5)
        make_reference(motion.with_joints(g1.JOINT_NAMES), control_dt=0.02)


class TestFewFrames:
    def folder(self, tmp_path: Path, count: int) -> Path:
        folder = tmp_path / "two"
        folder.mkdir()
        keys = ("body_pos_w", "body_quat_w", "joint_pos")
        np.savez(folder / "motion.npz", **{key: getattr(walking(), key)[:count] for key in keys})
        meta = {"body_names": g1.BODY_NAMES, "joint_names": g1.JOINT_NAMES, "fps": 50}
        (folder / "meta.json").write_text(json.dumps(meta))
        return folder

    @pytest.mark.parametrize("to", ["hdmi", "mjlab", "beyondmimic", "holosoma", "csv"])
    @pytest.mark.parametrize("count", [1, 2])
    def test_too_few_are_an_error(
        self, tmp_path: Path, to: str, count: int, capsys: pytest.CaptureFixture[str]
    ) -> None:
        from hdmi.commands.convert import main

        out = tmp_path / ("out" + {"hdmi": "", "csv": ".csv"}.get(to, ".npz"))
        assert main([f"source={self.folder(tmp_path, count)}", f"to={to}", f"out={out}", "fps=30"]) == 2
        error = capsys.readouterr().err
        assert len(error.splitlines()) == 1
        assert "at least 2" in error
        assert not out.exists()

    def test_two_that_stay_two(self, tmp_path: Path) -> None:
        from hdmi.commands.convert import main

        assert main([f"source={self.folder(tmp_path, 2)}", "to=hdmi", f"out={tmp_path / 'out'}", "fps=50"]) == 0
        assert load_motion(tmp_path / "out").num_frames == 2

    @pytest.mark.parametrize("fps", ["0", "-50", "nan", "inf", "1e9", "0.5"])
    @pytest.mark.parametrize("option", ["fps", "source_fps"])
    def test_rates_that_are_none(
        self, tmp_path: Path, fps: str, option: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        from hdmi.commands.convert import main

        path = write_csv(tmp_path / "a.csv", table(*pose(), angles()))
        assert main([f"source={path}", "to=hdmi", f"out={tmp_path / 'out'}", f"{option}={fps}"]) == 2
        error = capsys.readouterr().err
        assert len(error.splitlines()) == 1
        assert re.search(r"fps must be from 1 to 1000|fps: a number expected", error)
        assert not (tmp_path / "out").exists()

    def test_for_training(self, tmp_path: Path) -> None:
        with pytest.raises(MotionError, match=r"'two': its 2 frames at 50 fps are 1 frame at 10 fps"):
            make_reference(self.folder(tmp_path, 2), control_dt=0.1)


def gmr(motion: Motion) -> dict[str, Any]:
    """What GMR's scripts pickle."""
    return {
        "fps": motion.fps,
        "root_pos": motion.body_pos_w[:, 0],
        "root_rot": np.roll(motion.body_quat_w[:, 0], -1, axis=-1),
        "dof_pos": motion.joint_pos,
        "local_body_pos": None,
        "link_body_list": None,
    }


def asap(layout: str = "g1_29dof_anneal_23dof", links: int = 3) -> dict[str, Any]:
    """A clip of PHC's layout, as ASAP and PBHC write it."""
    names = LAYOUTS[layout]
    pos, quat = pose()
    axis = {joint.name: joint.axis for joint in g1.JOINTS}
    poses = np.zeros((T, 1 + len(names) + links, 3), np.float32)
    poses[:, 0] = Rotation.from_quat(quat, scalar_first=True).as_rotvec()
    poses[:, 1 : 1 + len(names)] = angles(names)[..., None] * np.array([axis[name] for name in names])
    return {
        "root_trans_offset": pos,
        "pose_aa": poses,
        "dof": angles(names),
        "root_rot": np.roll(quat, -1, axis=-1),
        "smpl_joints": np.zeros((T, 24, 3), np.float32),
        "fps": 30,
    }


class JoblibPickler(pickle._Pickler):
    """Writes arrays as joblib does: a description, and the bytes behind it in the file."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, protocol=4)
        self.file = file

    def save(self, obj: Any, save_persistent_id: bool = True) -> None:
        if type(obj) is not np.ndarray:
            return super().save(obj, save_persistent_id)
        self.framer.commit_frame(force=True)
        wrapper = sys.modules["joblib.numpy_pickle"].NumpyArrayWrapper()
        order = "F" if obj.flags.f_contiguous and not obj.flags.c_contiguous else "C"
        wrapper.__dict__.update(
            subclass=np.ndarray, shape=obj.shape, order=order, dtype=obj.dtype, allow_mmap=True,
            numpy_array_alignment_bytes=16,
        )  # fmt: skip
        super().save(wrapper, save_persistent_id)
        self.framer.commit_frame(force=True)
        padding = 16 - (self.file.tell() + 1) % 16
        self.file.write(bytes([padding]) + b"\xff" * padding + obj.tobytes(order))


@pytest.fixture
def joblib_bytes(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any], bytes]:
    """What joblib.dump writes, without joblib."""
    wrapper = type("NumpyArrayWrapper", (), {"__module__": "joblib.numpy_pickle"})
    module = types.ModuleType("joblib.numpy_pickle")
    module.NumpyArrayWrapper = wrapper  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "joblib", types.ModuleType("joblib"))
    monkeypatch.setitem(sys.modules, "joblib.numpy_pickle", module)

    def dump(value: Any) -> bytes:
        file = io.BytesIO()
        JoblibPickler(file).dump(value)
        return file.getvalue()

    return dump


class TestPickles:
    @pytest.mark.parametrize("protocol", range(6))
    def test_gmr(self, tmp_path: Path, protocol: int) -> None:
        path = tmp_path / "dance.pkl"
        path.write_bytes(pickle.dumps(gmr(walking(30)), protocol))
        motion = read_robot_pickle(path)
        assert (motion.name, motion.fps, motion.joint_names) == ("dance", 50.0, g1.JOINT_NAMES)
        np.testing.assert_array_equal(motion.joint_pos, angles())
        np.testing.assert_allclose(motion.body_pos_w, walking(30).body_pos_w, atol=1e-5)
        np.testing.assert_allclose(motion.body_lin_vel_w, walking(30).body_lin_vel_w, atol=1e-3)

    @pytest.mark.parametrize("layout", ["g1_23dof", "g1_29dof_anneal_23dof", "g1_29dof_isaac"])
    def test_gmrs_bodies_tell_the_joints(self, tmp_path: Path, layout: str) -> None:
        names = LAYOUTS[layout]
        full = np.tile(default_joint_pos(), (T, 1))
        full[:, [g1.JOINT_NAMES.index(name) for name in names]] = angles(names)
        local, _ = forward_kinematics(g1_robot(), np.zeros((T, 3)), np.tile([1.0, 0, 0, 0], (T, 1)), full)
        content = gmr(walking()) | {"dof_pos": angles(names)}
        content |= {"local_body_pos": local.astype(np.float32), "link_body_list": list(g1.BODY_NAMES)}
        (tmp_path / "a.pkl").write_bytes(pickle.dumps(content))
        assert read_robot_pickle(tmp_path / "a.pkl").joint_names == names

    @pytest.mark.parametrize("layout", ["g1_23dof", "g1_29dof_anneal_23dof", "g1_29dof"])
    @pytest.mark.parametrize("lacks", [(), ("dof",), ("root_rot",), ("dof", "root_rot"), ("pose_aa",)])
    def test_asap(
        self, tmp_path: Path, layout: str, lacks: tuple[str, ...], joblib_bytes: Callable[[Any], bytes]
    ) -> None:
        clip = {key: value for key, value in asap(layout).items() if key not in lacks}
        path = tmp_path / "a.pkl"
        path.write_bytes(joblib_bytes({"punch": clip}))
        joints = layout if lacks == ("pose_aa",) and layout == "g1_23dof" else None
        motion = read_robot_pickle(path, joints=joints)
        assert (motion.name, motion.fps, motion.joint_names) == ("punch", 30.0, LAYOUTS[layout])
        np.testing.assert_allclose(motion.joint_pos, angles(LAYOUTS[layout]), atol=1e-6)
        np.testing.assert_allclose(motion.body_quat_w[:, 0], pose()[1], atol=1e-6)

    def test_clips(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        from hdmi.commands.convert import main

        path = tmp_path / "set.pkl"
        path.write_bytes(pickle.dumps({"punch": asap(), "kick": asap() | {"fps": 60}, "note": "two"}))
        command = [f"source={path}", "to=hdmi", f"out={tmp_path / 'out'}"]
        assert main(command) == 2
        error = capsys.readouterr().err.strip()
        assert error.endswith("set.pkl: holds several clips: give clip=NAME; there is punch, kick")
        assert main([*command, "clip=kick"]) == 0
        assert load_motion(tmp_path / "out").fps == 60
        assert main([*command, "clip=jump"]) == 2
        assert "no clip 'jump'; there is punch, kick" in capsys.readouterr().err
        path.write_bytes(pickle.dumps(gmr(walking())))
        assert main([*command, "clip=jump"]) == 2
        assert main([*command]) == 0

    @pytest.mark.parametrize("suffix", [".pickle", ".p", ".joblib", ".PKL"])
    def test_is_found_by_its_suffix_and_only_read(self, tmp_path: Path, suffix: str) -> None:
        path = tmp_path / f"a{suffix}"
        path.write_bytes(pickle.dumps(gmr(walking())))
        assert guess_format(path) == "pickle"
        with pytest.raises(MotionError, match="'pickle' is only read; written are hdmi, "):
            convert(path, tmp_path / "b.pkl", "pickle")
        folder, options = save_motion(walking(), tmp_path / "walk"), Options(clip="a")
        with pytest.raises(MotionError, match="hdmi takes no clip"):
            convert(folder, tmp_path / "c", "hdmi", options=options)

    def test_a_rate_that_is_missing(self, tmp_path: Path) -> None:
        content = gmr(walking())
        del content["fps"]
        (tmp_path / "a.pkl").write_bytes(pickle.dumps(content))
        with pytest.raises(MotionError, match="give source_fps"):
            read_robot_pickle(tmp_path / "a.pkl")
        assert read_robot_pickle(tmp_path / "a.pkl", 25.0).fps == 25.0
        (tmp_path / "b.pkl").write_bytes(pickle.dumps(gmr(walking())))
        with pytest.warns(UserWarning, match="50 fps: source_fps=25 is not used"):
            assert read_robot_pickle(tmp_path / "b.pkl", 25.0).fps == 50.0

    def test_joints_by_name(self, tmp_path: Path) -> None:
        names = tuple(reversed(g1.JOINT_NAMES))
        content = gmr(walking()) | {"dof_pos": angles(names), "dof_names": list(names)}
        (tmp_path / "a.pkl").write_bytes(pickle.dumps(content))
        assert read_robot_pickle(tmp_path / "a.pkl").joint_names == names
        content["dof_names"] = ["tail_joint", *names[1:]]
        (tmp_path / "b.pkl").write_bytes(pickle.dumps(content))
        with pytest.raises(MotionError, match="dof_names: tail_joint are not joints of this robot"):
            read_robot_pickle(tmp_path / "b.pkl")

    @pytest.mark.parametrize(
        ("changes", "fragment"),
        [
            ({"root_pos": np.zeros((T, 2))}, r"root_pos: shape \(12, 2\), expected \(12, 3\)"),
            ({"root_pos": np.zeros((1, 3))}, "root_pos: needs at least 2 frames"),
            ({"root_pos": "far"}, "root_pos: an array of numbers expected, got a str"),
            ({"root_rot": np.zeros((T, 4))}, "root_rot: norm 0.000 at frame 0"),
            ({"root_rot": np.ones((T - 1, 4))}, r"root_rot: shape \(11, 4\)"),
            ({"root_rot": None}, "needs .* root_rot"),
            ({"dof_pos": np.zeros((T, 20))}, "dof_pos: 20 joints; this robot has 23, 27, 29, 43"),
            ({"dof_pos": np.full((T, 29), np.nan)}, "dof_pos: not finite at frame 0"),
            ({"dof_pos": [[1.0], [1.0, 2.0]]}, "dof_pos: .* several lengths"),
            ({"fps": 0}, "fps must be from 1 to 1000"),
            ({"fps": "fast"}, "fps: an array of numbers"),
            ({"dof_pos": np.rad2deg(angles())}, "give angles=degrees"),
            ({"root_pos": 100 * pose()[0]}, "give unit=0.01"),
        ],
    )
    def test_fields_that_do_not_fit(self, tmp_path: Path, changes: dict[str, Any], fragment: str) -> None:
        path = tmp_path / "a.pkl"
        path.write_bytes(pickle.dumps(gmr(walking()) | changes))
        with pytest.raises(MotionError, match=fragment) as caught:
            read_robot_pickle(path)
        assert str(path) in str(caught.value)

    @pytest.mark.parametrize("content", [[], {}, 3, "text", {"a": 1}, {"a": {"b": 1}}, [1, 2], None])
    def test_other_pickles(self, tmp_path: Path, content: Any) -> None:
        (tmp_path / "a.pkl").write_bytes(pickle.dumps(content))
        with pytest.raises(MotionError, match=r"a\.pkl: "):
            read_robot_pickle(tmp_path / "a.pkl")


class Calls:
    """Pickles to a call."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self.function, self.arguments


class Plain:
    """Any class of a project."""


def assembled(*parts: bytes) -> bytes:
    return b"\x80\x04" + b"".join(parts) + b"."


def text(value: str) -> bytes:
    return b"\x8c" + bytes([len(value)]) + value.encode()


class TestPicklesAreData:
    @pytest.mark.parametrize("protocol", range(6))
    def test_plain_data_is_what_it_was(self, tmp_path: Path, protocol: int) -> None:
        shared = np.arange(6.0).reshape(2, 3)
        content = {
            "numbers": [1, -(10**30), 2.5, True, None, 300, 70000],
            "words": ("a", "ä" * 300, b"bytes", b"\xff" * 300),
            "sets": {1, 2},
            "empty": [[], (), {}, np.zeros((0, 3))],
            "fortran": np.asfortranarray(np.arange(6).reshape(2, 3)),
            "big endian": np.arange(3, dtype=">f4"),
            "half": np.arange(3, dtype=np.float16),
            "bool": np.array([True, False]),
            "strings": np.array(["one", "three"]),
            "scalar": np.float32(1.5),
            "twice": [shared, shared],
            1: (1, (2, (3, 4, 5), 6, 7, 8)),
        }
        (tmp_path / "a.pkl").write_bytes(pickle.dumps(content, protocol))
        read = read_plain_pickle(tmp_path / "a.pkl")
        assert read.keys() == content.keys()
        for key, value in content.items():
            for ours, theirs in zip(read[key], value, strict=True) if isinstance(value, list) else [(read[key], value)]:
                if isinstance(theirs, np.ndarray):
                    assert ours.dtype == theirs.dtype
                    np.testing.assert_array_equal(ours, theirs)
                else:
                    assert ours == theirs

    @pytest.mark.parametrize("compressor", ["zlib", "gzip", "bz2", "lzma"])
    def test_compressed_joblib(self, tmp_path: Path, compressor: str, joblib_bytes: Callable[[Any], bytes]) -> None:
        content = {"a": np.asfortranarray(np.arange(6.0).reshape(2, 3)), "b": [np.arange(3), "x"]}
        (tmp_path / "a.pkl").write_bytes(importlib.import_module(compressor).compress(joblib_bytes(content)))
        read = read_plain_pickle(tmp_path / "a.pkl")
        np.testing.assert_array_equal(read["a"], content["a"])
        np.testing.assert_array_equal(read["b"][0], [0, 1, 2])
        assert read["b"][1] == "x"

    @pytest.mark.parametrize("protocol", [0, 2, 4])
    @pytest.mark.parametrize(
        ("function", "arguments", "name"),
        [
            (os.system, ("touch ran",), "posix.system|nt.system"),
            (eval, ("open('ran', 'w')",), ".*builtin.*eval"),
            (exec, ("open('ran', 'w')",), ".*builtin.*exec"),
            (getattr, ("", "join"), ".*builtin.*getattr"),
            (open, ("ran", "w"), ".*open"),
            (np.load, ("ran.npy",), "numpy.*load"),
            (np.fromfile, ("ran",), "numpy.*fromfile"),
            (np.save, ("ran", 1), "numpy.*save"),
            (np.memmap, ("ran",), "numpy.*memmap"),
            (np.zeros, (10**12,), "numpy.*zeros"),
            (bytearray, (10**12,), "bytes of a int"),
            (range, (10**12,), ".*builtin.*range"),
            (Plain, (), ".*Plain"),
        ],
    )
    def test_calls_are_refused_by_name(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, function: Any, arguments: tuple, name: str, protocol: int
    ) -> None:
        monkeypatch.chdir(tmp_path)
        content = gmr(walking()) | {"extra": [Calls(function, *arguments)]}
        (tmp_path / "a.pkl").write_bytes(pickle.dumps(content, protocol))
        with pytest.raises(MotionError, match=rf"a\.pkl: wants ({name})") as caught:
            read_robot_pickle("a.pkl")
        assert "\n" not in str(caught.value)
        assert [path.name for path in tmp_path.iterdir()] == ["a.pkl"]

    @pytest.mark.parametrize("module", ["numpy.core.multiarray", "numpy._core.multiarray"])
    def test_both_generations_of_numpy(self, tmp_path: Path, module: str) -> None:
        written = pickle.dumps(np.arange(3.0), 2)
        known = next(name for name in (b"numpy.core.multiarray", b"numpy._core.multiarray") if name in written)
        (tmp_path / "a.pkl").write_bytes(written.replace(known, module.encode()))
        np.testing.assert_array_equal(read_plain_pickle(tmp_path / "a.pkl"), [0, 1, 2])

    @pytest.mark.parametrize(
        "data",
        [
            # a name that is known, found in another place or called as what it is not
            assembled(text("numpy"), text("ndarray"), b"\x93", b"K\x09\x85R"),
            assembled(text("numpy"), text("ndarray"), b"\x93", b"K\x09\x85\x81"),
            assembled(text("numpy"), text("ndarray.tofile"), b"\x93"),
            assembled(text("os"), text("dtype"), b"\x93"),
            assembled(text("numpy.dtype"), text("f8"), b"\x93"),
            assembled(text("numpy"), text("dtype"), b"\x93", text("O8"), b"\x85R", b"}b"),
            # state of a name, of a number; a call of a string
            assembled(text("numpy"), text("dtype"), b"\x93", b"}", text("__init__"), text("x"), b"sb"),
            assembled(b"K\x01}b"),
            assembled(text("os.system"), text("true"), b"\x85R"),
            # persistent ids, the extension registry, old instances, buffers from elsewhere
            assembled(text("id"), b"Q"),
            b"Pid\n.",
            assembled(b"\x82\x01"),
            b"(S'true'\nios\nsystem\n.",
            assembled(b"(cos\nsystem\n", text("true"), b"o"),
            b"\x80\x05\x97.",
            # a stack that is not there
            b".",
            b"R.",
            b"0.",
            b"t.",
            b"h\x09.",
            b"\x80\x04]K\x01K\x02s.",
            assembled(b"(((("),
            # keys that take long to hash
            assembled(b")", b"\x94h\x00h\x00\x86" * 40, b"}", b"(", b")" + b"2\x86" * 40, b"K\x01", b"u"),
        ],
    )
    def test_hand_made_programs(self, tmp_path: Path, data: bytes) -> None:
        (tmp_path / "a.pkl").write_bytes(data)
        with pytest.raises(MotionError, match=r"a\.pkl: ") as caught:
            read_robot_pickle(tmp_path / "a.pkl")
        assert "\n" not in str(caught.value)

    def test_arrays_that_claim_more_than_there_is(self, tmp_path: Path, joblib_bytes: Callable[[Any], bytes]) -> None:
        array = np.arange(255.0, dtype=np.float64)
        for data in (pickle.dumps(array, 2), pickle.dumps(array, 5), joblib_bytes(array)):
            at = data.index(b"K\xff")
            for shape in (b"J\xff\xff\xff\x7f", b"\x8a\x06\x00\x00\x00\x00\x00\x10", b"K\xfe", b"J\xff\xff\xff\xff"):
                (tmp_path / "a.pkl").write_bytes(data[:at] + shape + data[at + 2 :])
                # by joblib: an array that is shorter leaves bytes that are no opcodes
                with pytest.raises(MotionError, match=r"claims \d+ bytes, the file holds|wants an array|truncated"):
                    read_plain_pickle(tmp_path / "a.pkl")

    def test_bombs(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("hdmi.motion.files.MAX_BYTES", 1_000_000)
        (tmp_path / "a.pkl").write_bytes(zlib.compress(pickle.dumps(np.zeros(10**6))))
        with pytest.raises(MotionError, match="unpacks to more than"):
            read_plain_pickle(tmp_path / "a.pkl")
        # a long text is copied again and again
        copy = b"h\x00c_codecs\nencode\nh\x01\x85R0".replace(b"h\x00", b"")
        long = b"X" + (10**5).to_bytes(4, "little") + b"a" * 10**5 + b"q\x01"
        (tmp_path / "b.pkl").write_bytes(b"\x80\x02" + long + copy * 20 + b".")
        with pytest.raises(MotionError, match="unpacks to more than"):
            read_plain_pickle(tmp_path / "b.pkl")

    def test_what_is_no_pickle(self, tmp_path: Path) -> None:
        np.savez(tmp_path / "a.npz", a=np.zeros(3))
        (tmp_path / "a.npz").rename(tmp_path / "a.pkl")
        with pytest.raises(MotionError, match="a zip archive"):
            read_plain_pickle(tmp_path / "a.pkl")
        with pytest.raises(MotionError, match="no such file"):
            read_plain_pickle(tmp_path / "none.pkl")
        (tmp_path / "b.pkl").write_bytes(b"\x04\x22\x4d\x18" + b"\0" * 9)
        with pytest.raises(MotionError, match="lz4"):
            read_plain_pickle(tmp_path / "b.pkl")

    def test_structured_arrays_are_refused(self, tmp_path: Path) -> None:
        (tmp_path / "a.pkl").write_bytes(pickle.dumps(np.zeros(3, dtype=[("a", "f4"), ("b", "i4")])))
        with pytest.raises(MotionError, match=r"wants .* dtype"):
            read_plain_pickle(tmp_path / "a.pkl")


def test_holosoma_that_lies_is_refused_and_believed(tmp_path: Path) -> None:
    """A world that is y up, in a format with all bodies and an object."""
    motion = walking()
    turn = turned_world("y")
    quat = (turn * Rotation.from_quat(motion.body_quat_w.reshape(-1, 4), scalar_first=True)).as_quat(scalar_first=True)
    moved = replace(
        motion,
        body_pos_w=turn.apply(motion.body_pos_w.reshape(-1, 3)).reshape(T, -1, 3).astype(np.float32),
        body_quat_w=quat.reshape(T, -1, 4).astype(np.float32),
    )
    path, _ = write_holosoma(moved, tmp_path / "a.npz")
    with pytest.raises(MotionError, match=r"body_quat_w: the robot lies .* up=y"):
        read_holosoma(path)
    taken = read_holosoma(path, given=Conventions(up="y"))
    np.testing.assert_allclose(taken.body_pos_w[..., 2], motion.body_pos_w[..., 2], atol=1e-5)
    assert upright(taken)
    assert not upright(read_holosoma(path, given=Conventions(up="z", ground="keep")))
