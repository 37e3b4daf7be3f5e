"""Recording a policy's rollout as a reference motion: its kernels, what is in it, and that it trains."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from mocks import CONF, command, load_config
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from test_training import config

from hdmi.assembly import Task, make_task, make_transforms, scene_parts
from hdmi.assets import RobotConfig, g1
from hdmi.assets.surface import object_surfaces
from hdmi.commands import record
from hdmi.config import ConfigError
from hdmi.evaluation.protocol import evaluation_config
from hdmi.evaluation.video import Moment
from hdmi.learning.trainer import Trainer
from hdmi.motion import Motion, find_motion, forward_kinematics, load_motion, make_playback, save_motion
from hdmi.motion.complete import complete_robot
from hdmi.motion.kinematics import derivative
from hdmi.workshop import recording
from hdmi.workshop.annotate import intervals, without_chatter
from hdmi.workshop.recording import (
    PAUSE,
    Rollout,
    contact_labels,
    continuous,
    min_contact_force,
    nominal_config,
    record_motion,
    roll_out,
    rollout_motion,
    touched_points,
)

ZOO = CONF.parent / "zoo"
FRAMES = slice(58, 98)  # of lift_box: the hands come, and from the tenth frame on they press


# -- kernels --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("label", "pause", "expected"),
    [
        ("1110111", 1, "1111111"),
        ("1100111", 1, "1100111"),  # an interruption of two
        ("0010000", 1, "0000000"),
        ("0110000", 1, "0110000"),
        ("1000001", 1, "0000000"),
        ("10101010", 1, "11111110"),  # together they are a contact
        ("0111001110", 2, "0111111110"),
        ("0110001110", 2, "0000001110"),
        ("0010110000", 2, "0011110000"),
        ("110011", 2, "111111"),
        ("001000", 0, "001000"),
    ],
)
def test_chatter(label: str, pause: int, expected: str):
    found = without_chatter(np.array([c == "1" for c in label]), pause)
    assert "".join("01"[int(value)] for value in found) == expected


def test_labels_are_forces_without_chatter():
    force = np.array([[0.0, 9.0], [1.0, 0.0], [0.9, 0.0], [5.0, 0.0], [5.0, 0.5]])
    assert contact_labels(force, 1.0, 1).T.tolist() == [[False, True, True, True, True], [False] * 5]


def points_along_x(
    x: list[float], pressure: list[float], label: list[int], aim: float = -1.0, spread: float = 1e-3
) -> list[float]:
    """`touched_points` of one effector, with points on the x axis."""
    point = np.array(x)[:, None, None] * [1.0, 0.0, 0.0]
    aims = np.array([[aim, 0.0, 0.0]])
    column = touched_points(point, np.array(pressure, float)[:, None], np.array(label, bool)[:, None], aims, spread)
    assert not column[..., 1:].any()
    return column[:, 0, 0].tolist()


class TestContactPoints:
    def test_between_contacts_those_of_the_nearest_one(self):
        found = points_along_x([0, 2, 2, 0, 0, 0, 4], [0, 1, 1, 0, 0, 0, 1], [0, 1, 1, 0, 0, 0, 1])
        assert found == pytest.approx([2, 2, 2, 2, 2, 4, 4])  # frame 4 is as near to both: the earlier one

    def test_a_bridged_frame_has_a_neighbour_s(self):
        assert points_along_x([1, 0, 3], [1, 0, 1], [1, 1, 1]) == pytest.approx([1, 1, 3])

    def test_they_are_averaged_by_force(self):
        found = points_along_x([1, 3], [3, 1], [1, 1], spread=1e3)
        assert found == pytest.approx([1.5, 1.5], abs=1e-3)

    def test_another_contact_does_not_count(self):
        found = points_along_x([1, 1, 0, 9, 9], [1, 1, 0, 50, 50], [1, 1, 0, 1, 1], spread=1e3)
        assert found == pytest.approx([1, 1, 1, 9, 9])

    def test_without_any_contact_it_is_where_it_was_meant(self):
        assert points_along_x([5, 5], [0.5, 0.5], [0, 0], aim=7.0) == [7, 7]


def test_signs_of_quaternions_are_continuous():
    angle = np.linspace(0, 4, 5)
    turning = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], axis=-1)[:, None]
    flipped = turning * np.array([-1, -1, 1, 1, -1])[:, None, None]
    np.testing.assert_allclose(continuous(flipped), -turning)  # as the first frame has it


@pytest.mark.parametrize(
    ("nodes", "force"),
    [
        ({"termination": {"lost_contact": {"min_force": 2.0}}}, 2.0),
        ({"termination": {"lost_contact": None}}, 1.0),
        ({"termination": {"lost_contact": {"distance": 0.4}}}, 1.0),
        ({"termination": None}, 1.0),
    ],
)
def test_what_the_task_takes_for_lost_is_no_contact(nodes: dict, force: float):
    assert min_contact_force(OmegaConf.create(nodes)) == force


# -- a rollout ------------------------------------------------------------------------------------------------


def still(td: TensorDictBase) -> TensorDictBase:
    """Servos that follow the reference."""
    return td.set("action", torch.zeros(1, 23))


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> tuple[Motion, DictConfig]:
    """A part of lift_box with all bodies of the robot, and the config of a training on it."""
    motion = complete_robot(load_motion(find_motion("lift_box")))
    motion = replace(motion, **{key: value[FRAMES] for key, value in vars(motion).items() if np.ndim(value) > 1})
    folder = tmp_path_factory.mktemp("motions")
    save_motion(motion, folder / "lift_box")
    return load_motion(folder / "lift_box"), load_config(f"motion_root={folder}")


@pytest.fixture(scope="module")
def played(source: tuple[Motion, DictConfig]) -> tuple[Task, Rollout]:
    cfg = nominal_config(source[1])
    task = make_task(cfg)
    return task, roll_out(still, cfg, task)


@pytest.fixture(scope="module")
def recorded(source: tuple[Motion, DictConfig], played: tuple[Task, Rollout], tmp_path_factory) -> Path:
    """Folder of the recording."""
    motion = rollout_motion(played[1], played[0], source[0], "perfect", targets=True)
    return save_motion(motion, tmp_path_factory.mktemp("recorded") / "perfect")


# -- the nominal world ----------------------------------------------------------------------------------------


def test_nothing_is_drawn_in_the_nominal_world(source, played):
    trained = source[1].copy()
    cfg = evaluation_config(nominal_config(source[1]))
    transforms = make_transforms(cfg, played[0])
    assert not [name for name, transform in transforms if getattr(transform, "training_only", False)]
    assert not [name for name, _ in transforms if name.startswith(("randomization", "noise"))]
    assert cfg.reset.state.noise == {}
    assert source[1] == trained


def test_the_object_s_joint_resists_as_in_the_middle_of_the_training_s_worlds():
    cfg = nominal_config(load_config("task=open_foldchair_sit"))
    assert set(cfg.randomization) == {"object_joint"}
    assert (cfg.randomization.object_joint.friction, cfg.randomization.object_joint.damping) == ([7.5] * 2, [3.0] * 2)


# -- what is recorded ------------------------------------------------------------------------------------------


def test_it_has_the_frames_and_names_of_the_motion_that_was_tracked(source, recorded):
    motion, tracked = load_motion(recorded), source[0]
    for key in ("fps", "num_frames", "body_names", "joint_names"):
        assert getattr(motion, key) == getattr(tracked, key), key
    assert motion.body_quat_w.shape == (40, 32, 4)  # with box and stand
    np.testing.assert_allclose(motion.body_pos_w[0], tracked.body_pos_w[0], atol=1e-5)  # the start
    np.testing.assert_allclose(motion.joint_pos[0], tracked.joint_pos[0], atol=1e-5)
    assert 1e-3 < np.abs(motion.body_pos_w - tracked.body_pos_w).max() < 0.05  # servos give way, a little


def test_bodies_are_where_the_joints_put_them(recorded):
    motion = load_motion(recorded)
    pelvis = motion.body_names.index("pelvis")
    joint_pos = motion.joint_pos[:, [motion.joint_names.index(name) for name in g1.JOINT_NAMES]]
    robot = RobotConfig().model
    pos, quat = forward_kinematics(robot, motion.body_pos_w[:, pelvis], motion.body_quat_w[:, pelvis], joint_pos)
    columns = [motion.body_names.index(name) for name in g1.BODY_NAMES]
    np.testing.assert_allclose(motion.body_pos_w[:, columns], pos, atol=1e-5)
    along = np.abs((motion.body_quat_w[:, columns] * quat).sum(-1))
    np.testing.assert_allclose(along, 1.0, atol=1e-5)
    quat = motion.body_quat_w
    assert (quat[1:] * quat[:-1]).sum(-1).min() > 0.9
    np.testing.assert_allclose(motion.body_lin_vel_w, derivative(motion.body_pos_w, 50.0), atol=1e-3)


def test_contacts_are_where_and_when_forces_were_felt(source, played, recorded):
    rollout, motion = played[1], load_motion(recorded)
    assert motion.object_contact is not None
    assert motion.contact_points is not None
    for e in range(2):
        ((first, last),) = intervals(motion.object_contact[:, e])
        assert 5 < first < 20
        assert last == 39
        felt = rollout.force[first : last + 1, e] >= 1
        assert felt[0]
        assert all(end - start < PAUSE * 50 for start, end in intervals(~felt))  # no more than chatter
        assert (rollout.force[:first, e] < 1).all()
        # as far from the middle of the box as its faces are
        assert np.abs(motion.contact_points[:, e, 1]) == pytest.approx(np.full(40, 0.14), abs=3e-3)
    surface = object_surfaces(scene_parts(source[1])["object"])["box"]
    for e in range(2):
        pressed = rollout.touch[rollout.pressure[:, e] > 0, e]
        assert np.abs(surface.distance(pressed)).max() < 2e-3
    # what the two are pressed with is what they feel, but for forces that hold each other
    assert (rollout.pressure >= rollout.force - 1e-6).all()
    assert rollout.force.max() > 5


def test_contact_points_can_be_those_of_the_effectors(source, played):
    task, rollout = played
    motion = rollout_motion(rollout, task, source[0], points="effector")
    parts = scene_parts(source[1])
    playback = make_playback(motion, **parts)
    apart = np.linalg.norm(playback.effector_pos_w - playback.contact_pos_w, axis=-1)[motion.object_contact]
    felt = make_playback(rollout_motion(rollout, task, source[0]), **parts)
    further = np.linalg.norm(felt.effector_pos_w - felt.contact_pos_w, axis=-1)[motion.object_contact]
    assert apart.max() < 5e-3 < 0.01 < further.mean()


def test_targets_are_where_servos_are_sent_from_each_frame_on(source, played, recorded):
    motion = load_motion(recorded)
    transforms = dict(make_transforms(nominal_config(source[1]), played[0]))
    sent = transforms["reference.target"].targets.numpy()  # by frame; the policy adds nothing
    assert motion.joint_target is not None
    order = [motion.joint_names.index(name) for name in g1.JOINT_NAMES]
    np.testing.assert_allclose(motion.joint_target[:-1, order], sent[:-1], atol=1e-5)
    np.testing.assert_array_equal(motion.joint_target[-1], motion.joint_target[-2])


def test_joints_that_the_motion_lacks_are_recorded_and_bodies_that_the_scene_lacks_are_not(source, played):
    task, rollout = played
    poor = source[0].with_joints([name for name in source[0].joint_names if "wrist" not in name])
    poor = replace(poor, body_names=(*poor.body_names[:-1], "podium"))
    motion = rollout_motion(rollout, task, poor)
    assert motion.joint_names[:23] == poor.joint_names
    assert sorted(motion.joint_names) == sorted(g1.JOINT_NAMES)
    assert motion.body_names == poor.body_names[:-1]
    assert motion.joint_target is None


def test_the_task_trains_on_it(recorded, tmp_path):
    options = ["task.motion=perfect", f"motion_root={recorded.parent}", "total_frames=64"]
    trainer = Trainer(config(*options), tmp_path)
    trainer.run()
    assert trainer.iteration == 2
    assert trainer.task.reference.joint_target is not None
    assert trainer.task.reference.contact.any()


# -- the command ----------------------------------------------------------------------------------------------


@pytest.fixture
def policy(source: tuple[Motion, DictConfig], monkeypatch: pytest.MonkeyPatch) -> None:
    """Any checkpoint is of a policy that stays still."""
    monkeypatch.setattr(record, "load_checked_policy", lambda path: (still, source[1].copy(), {"file": path}))


def test_of_a_policy_that_fails_nothing_is_written(policy, played, tmp_path, capsys, monkeypatch):
    model = played[0].scene.model
    data, left = mujoco.MjData(model), []

    def moments(*arguments: object, **options: object) -> Iterator[Moment]:
        try:
            yield Moment(model, data, 0)
            yield Moment(model, data, 1, "object_pose")
            raise AssertionError("it goes on after the failure")
        finally:
            left.append(True)

    monkeypatch.setattr(recording, "play_moments", moments)
    assert record.main(["checkpoint=run", f"out={tmp_path / 'perfect'}"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("ConfigError: run: the policy fails by object_pose at frame 1 of 39: a reference needs")
    assert said.count("\n") == 1
    assert left == [True]  # the environment is closed
    assert not list(tmp_path.iterdir())


def test_writes_a_motion_and_says_what_it_is_worth(policy, played, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(recording, "roll_out", lambda *_: played[1])
    monkeypatch.chdir(tmp_path)
    assert record.main(["checkpoint=run", "out=recordings/perfect", "targets=true"]) == 0
    shown = capsys.readouterr().out
    assert "perfect: 40 frames at 50 Hz" in shown
    assert "contact_gap" in shown
    assert f"hdmi train task=lift_box task.motion=perfect motion_root={tmp_path / 'recordings'}" in shown
    assert shown.endswith("recordings/perfect\n")
    assert load_motion(tmp_path / "recordings" / "perfect").joint_target is not None
    assert record.main(["checkpoint=run", "out=recordings/perfect"]) == 2
    assert "recordings/perfect exists; name a folder that does not" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give checkpoint=RUN and out=FOLDER"),
        (["checkpoint=zoo/walk"], "give checkpoint=RUN and out=FOLDER"),
        (["checkpoint=nowhere", "out=there"], "nowhere"),
        (["target=true"], "did you mean targets?"),
    ],
)
def test_mistakes_are_one_line(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert command("record").main(arguments) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_contact_points_of_no_kind():
    with pytest.raises(ConfigError, match="points: expected one of touch, effector, got 'hand'"):
        record_motion(still, load_config(), points="hand")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lift_box", "move_suitcase", "open_foldchair_sit", "walk"])
def test_the_zoo(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert record.main([f"checkpoint={ZOO / name}", f"out={tmp_path / name}", "targets=true"]) == 0
    shown = capsys.readouterr().out
    assert " good" in shown
    motion, tracked = load_motion(tmp_path / name), load_motion(find_motion(name))
    assert (motion.num_frames, motion.body_names, motion.joint_names) == (
        tracked.num_frames, tracked.body_names, tracked.joint_names,
    )  # fmt: skip
    if motion.object_contact is not None:
        assert (motion.object_contact.mean(axis=0) > 0.1).all()
