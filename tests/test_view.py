"""Looking at references: what is shown, where and when."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest

from hdmi.config import ConfigError
from hdmi.motion import find_motion, load_motion, save_motion
from hdmi.workshop.view.curves import curves
from hdmi.workshop.view.scene import load_view


@pytest.fixture(scope="module")
def lift_box() -> Path:
    return find_motion("lift_box")


class TestLoadView:
    def test_the_task_of_the_motion(self, lift_box: Path) -> None:
        playback, taken = load_view(lift_box)
        assert taken == "object and effectors of task lift_box"
        assert playback.reference.has_object
        assert len(playback.scene.effectors) == 2

    def test_a_motion_under_another_name_is_known_by_its_object(self, lift_box: Path, tmp_path: Path) -> None:
        shutil.copytree(lift_box, tmp_path / "renamed")
        playback, taken = load_view(tmp_path / "renamed")
        assert "task" in taken
        assert playback.reference.has_object
        assert playback.num_frames == load_view(lift_box)[0].num_frames

    def test_an_unknown_object_is_a_cube(self, lift_box: Path, tmp_path: Path) -> None:
        motion = load_motion(lift_box)
        names = tuple({"box": "crate"}.get(name, name) for name in motion.body_names)
        save_motion(replace(motion, body_names=names), tmp_path / "m")
        playback, taken = load_view(tmp_path / "m")
        assert "cubes" in taken
        i = names.index("crate")
        np.testing.assert_allclose(playback.reference.object_pos, motion.body_pos_w[:, i], atol=1e-6)

    def test_unknown_task(self, lift_box: Path) -> None:
        with pytest.raises(ConfigError, match="no 'juggle'"):
            load_view(lift_box, "juggle")


class TestCurves:
    def test_gaps_are_of_intended_contacts(self, lift_box: Path) -> None:
        playback, _ = load_view(lift_box)
        gap = curves(playback)["contact gap, left_wrist_yaw [cm]"]
        intended = playback.reference.contact[:, 0].numpy()
        np.testing.assert_array_equal(np.isfinite(gap), intended)
        assert intended.any()
        assert gap[intended].max() < 8

    def test_a_standing_robot_is_on_the_ground_and_presses_the_box(self, lift_box: Path) -> None:
        found = curves(load_view(lift_box)[0])
        assert np.abs(found["ground clearance [cm]"]).max() < 0.5
        assert 0.5 < found["inside the object [cm]"].max() < 5
        assert 0 < found["joint speed [%]"].max() < 100

    def test_a_ghost_that_is_elsewhere(self, lift_box: Path, tmp_path: Path) -> None:
        """Moved by 3 cm, and 20 frames shorter."""
        motion = load_motion(lift_box)
        cut = {key: value[:-20] for key, value in vars(motion).items() if isinstance(value, np.ndarray)}
        cut["body_pos_w"] = cut["body_pos_w"] + np.array([0.0, 0.03, 0.0], np.float32)
        save_motion(replace(motion, **cut), tmp_path / "lift_box")
        found = curves(load_view(lift_box)[0], load_view(tmp_path / "lift_box")[0])
        for name, expected in (("body error [cm]", 3), ("object error [cm]", 3), ("joint error [deg]", 0)):
            np.testing.assert_allclose(found[name][:-20], expected, atol=1e-3, err_msg=name)
            assert np.isnan(found[name][-20:]).all()


class TestViewer:
    @pytest.fixture
    def viewer(self, lift_box: Path) -> Iterator:
        pytest.importorskip("viser")
        from hdmi.workshop.view.browser import ReferenceViewer

        playback, _ = load_view(lift_box)
        viewer = ReferenceViewer(playback, ghost=playback, port=0)
        yield viewer
        viewer.stop()

    def test_scrubbing_moves_bodies_and_lights_contacts(self, viewer) -> None:
        reference = viewer.playback.reference
        hand_pos, _ = viewer.playback.body_poses("left_wrist_yaw_link")
        frame = int(np.flatnonzero(reference.contact[:, 0].numpy())[5])
        before = np.array(viewer.points[0].color)
        viewer.slider.value = frame
        hand = g1_body(viewer, "left_wrist_yaw_link")
        np.testing.assert_allclose(hand.position, hand_pos[frame])
        np.testing.assert_allclose(g1_body(viewer, "box").position, reference.object_pos[frame], atol=1e-5)
        lit = np.array(viewer.points[0].color)
        assert (lit != before).any()
        assert lit.tolist() == [255, 209, 26]
        assert f"{frame * 0.02:.2f} s" in viewer.status.content

    def test_every_visible_body_is_there_once_for_the_reference_and_once_for_the_ghost(self, viewer) -> None:
        assert viewer.bodies.keys() == viewer.ghost_bodies.keys()
        names = {viewer.playback.scene.model.body(body).name for body in viewer.bodies}
        assert {"pelvis", "torso_link", "left_wrist_yaw_link", "box"} <= names

    def test_plots_mark_the_present_frame(self, viewer) -> None:
        viewer.show(40)
        viewer.update_plots()
        plot, values = viewer._plots[0]
        time, curve, now = plot.data
        np.testing.assert_array_equal(curve, values)
        assert np.flatnonzero(np.isfinite(now)).tolist() == [40, 41]
        assert time[40] == pytest.approx(0.8)

    def test_serves_a_page(self, viewer) -> None:
        from urllib.request import urlopen

        with urlopen(viewer.address, timeout=10) as answer:
            assert answer.status == 200


def g1_body(viewer, name: str):
    return viewer.bodies[viewer.playback.scene.model.body(name).id]


class TestCommand:
    def test_writes_a_video(self, lift_box: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        from hdmi.commands.view import main

        out = tmp_path / "a.mp4"
        size = ["width=160", "height=112", "stride=20"]
        status = main([str(lift_box), f"out={out}", f"ghost={lift_box}", *size])
        said = capsys.readouterr()
        if "no OpenGL" in said.err:
            pytest.skip("no OpenGL here")
        assert status == 0, said.err
        frames = load_view(lift_box)[0].num_frames
        assert f"lift_box: {frames} frames at 50 fps, object and effectors of task lift_box" in said.out
        assert said.out.splitlines()[-1] == str(out)
        pictures = list(imageio.get_reader(out).iter_data())
        assert len(pictures) == -(-frames // 20)
        assert pictures[0].shape == (112, 160, 3)
        assert pictures[0].std() > 10

    def test_errors(self, tmp_path: Path, lift_box: Path, capsys: pytest.CaptureFixture[str]) -> None:
        from hdmi.commands.view import main

        assert main([str(tmp_path)]) == 2
        assert "no such file" in capsys.readouterr().err
        assert main([str(lift_box), "start=100000"]) == 2
        assert "start: expected a frame" in capsys.readouterr().err
        (tmp_path / "meta.json").write_text(json.dumps({"body_names": []}))
        assert main([str(tmp_path)]) == 2
        assert main([]) == 2
