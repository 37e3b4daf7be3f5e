"""The runner: its states, what it watches and limits, its log, the simulated robot, and that it needs no trainer."""

from __future__ import annotations

import json
import os
import pty
import signal
import struct
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from mocks import command

from hdmi import functional as F
from hdmi.deploy import rotations
from hdmi.deploy.controls import Gamepad, Interrupts, Keyboard
from hdmi.deploy.description import Description, PolicyError, Termination
from hdmi.deploy.log import Log, LogError, read_log, replay
from hdmi.deploy.robot import Reading, RobotError
from hdmi.deploy.runner import Options, Runner, State
from hdmi.deploy.safety import Guard, Limits

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from hdmi.deploy.policy import OutputError, Policy, SensorError  # noqa: E402
from hdmi.deploy.robots.mujoco import MujocoRobot  # noqa: E402
from hdmi.deploy.robots.mujoco import Options as MujocoOptions  # noqa: E402
from hdmi.deploy.trial import Judge, read_reference  # noqa: E402

ROOT = Path(__file__).parents[1]
DT = 0.02
SHAPES = {"joint_pos": (2,), "joint_vel": (2,), "root_quat_w": (4,), "root_pos_w": (3,)}


def description(**changes: Any) -> Description:
    """Two joints, ten frames; the second joint has the smaller range."""
    found = Description(
        robot="toy", task="toy", motion="toy", num_frames=10, control_dt=DT, joint_names=("hip", "knee"),
        stiffness=np.array([100.0, 50.0]), damping=np.array([2.0, 1.0]), default_joint_pos=np.zeros(2),
        effort_limits=np.array([20.0, 10.0]), velocity_limits=np.array([10.0, 5.0]),
        joint_ranges=np.array([[-2.0, 2.0], [-0.5, 1.0]]), root="pelvis", sensors=SHAPES,
        start={
            "joint_pos": np.array([0.1, 0.2]), "root_pos_w": np.array([0.0, 0.0, 0.8]),
            "root_quat_w": np.array([1.0, 0.0, 0.0, 0.0]),
        },
    )  # fmt: skip
    return replace(found, **changes)


class ToyPolicy:
    """Its target is the start, moved by a hundredth of a radian per frame, and by what it feels of its position."""

    digest = "toy"
    sensors = ("joint_pos", "root_pos_w")

    def __init__(self, about: Description | None = None):
        self.description = about or description()
        self.given: list[dict[str, np.ndarray]] = []
        self.reset()

    def reset(self, start_frame: int = 0) -> None:
        self.frame = start_frame - 1

    @property
    def finished(self) -> bool:
        return self.frame >= self.description.num_frames - 1

    def __call__(self, sensors: dict[str, np.ndarray]) -> np.ndarray:
        self.frame = min(self.frame + 1, self.description.num_frames - 1)
        self.given.append(sensors)
        moved = self.description.start["joint_pos"] + 0.01 * self.frame + 0.1 * sensors["root_pos_w"][0]
        return moved.astype(np.float32)


class ToyRobot:
    """Joints that are where they were told to be; `change` may rewrite what it measures."""

    joint_names: tuple[str, ...] = ("hip", "knee")
    servo_dt = DT

    def __init__(self, change: Callable[[int, dict, dict], None] = lambda tick, sensors, stamps: None):
        self.clock, self.change = 0.0, change
        self.calls: list[str] = []
        self.commands: list[np.ndarray] = []
        self.requests: dict[int, tuple[str, ...]] = {}
        self.faults: dict[int, tuple[str, ...]] = {}
        self.waits: dict[int, float] = {}  # s that a wait takes longer
        self.reads = 0
        self.pos = np.zeros(len(self.joint_names))

    def time(self) -> float:
        return self.clock

    def wait(self, until: float) -> None:
        self.clock = max(self.clock, until) + self.waits.get(self.reads, 0.0)

    def read(self) -> Reading:
        sensors = {
            "joint_pos": self.pos.copy(), "joint_vel": np.zeros(len(self.pos)),
            "root_quat_w": np.array([1.0, 0.0, 0.0, 0.0]), "root_pos_w": np.array([0.0, 0.0, 0.8]),
        }  # fmt: skip
        stamps = dict.fromkeys(sensors, self.clock)
        self.change(self.reads, sensors, stamps)
        tick, self.reads = self.reads, self.reads + 1
        return Reading(self.clock, sensors, stamps, self.requests.get(tick, ()), self.faults.get(tick, ()))

    def command(self, target: np.ndarray, stiffness: np.ndarray, damping: np.ndarray) -> None:
        self.calls.append("command")
        self.commands.append(target)
        self.pos = np.where(stiffness > 0, target, self.pos)

    def damp(self) -> None:
        self.calls.append("damp")

    def close(self) -> None:
        self.damp()


AUTO = Options(to_start=0.2, settle=0.04, hold=0.06, auto=True)
ASKED = replace(AUTO, auto=False)


def states(log: Log) -> list[str]:
    """The states that a log went through, each once."""
    found = [log.header["states"][row["state"]] for row in log.rows]
    return [state for i, state in enumerate(found) if i == 0 or state != found[i - 1]]


# -- states ---------------------------------------------------------------------------------------------------


def test_states_follow_by_themselves():
    robot = ToyRobot()
    runner = Runner(ToyPolicy(), robot, AUTO)
    log = runner.run()
    assert states(log) == ["to_start", "run", "hold", "damping"]
    assert runner.completed
    assert runner.state is State.DAMPING
    assert robot.calls[-1] == "damp"
    frames = [row["frame"] for row in log.rows if row["frame"] >= 0]
    assert frames[:11] == [*range(10), 9]  # and the last frame on and on, while it holds
    assert [row["time"] for row in log.rows] == pytest.approx(np.arange(len(log.rows)) * DT)


def test_moves_to_the_start_slowly():
    robot = ToyRobot()
    Runner(ToyPolicy(), robot, AUTO).run()
    way = np.array(robot.commands[:11])
    assert way[0] == pytest.approx([0.0, 0.0])
    assert way[5] == pytest.approx([0.05, 0.1])  # half of the way after half of the time
    assert way[10] == pytest.approx([0.1, 0.2])
    assert np.abs(np.diff(way[:, 1])).max() < 0.2 * 1.5 * DT / 0.2 + 1e-9  # 1.5 times the mean speed at most


def test_requests_of_the_operator():
    robot = ToyRobot()
    robot.requests = {
        1: ("run",), 2: ("to_start",), 4: ("run",), 16: ("run",), 20: ("hold",), 23: ("to_start",), 26: ("jump",),
        28: ("damping",), 30: ("quit",),
    }  # fmt: skip
    runner = Runner(ToyPolicy(), robot, ASKED)
    log = runner.run()
    assert states(log) == ["damping", "to_start", "run", "hold", "to_start", "damping"]
    said = [text for _, text in log.events]
    assert "run refused: from to_start only, not from damping" in said
    assert "run refused: not at the start yet, 0.2 s left" in said
    assert "jump: there is no such state" in said
    assert len(log.rows) == 31
    held = [row["command"] for row in log.rows if log.header["states"][row["state"]] == "hold"]
    assert held == [pytest.approx([0.13, 0.23])] * 3  # the target of frame 3


def test_runs_again_from_the_first_frame():
    robot, policy = ToyRobot(), ToyPolicy()
    robot.requests = {0: ("to_start",), 14: ("run",), 17: ("hold",), 18: ("to_start",), 32: ("run",), 34: ("quit",)}
    log = Runner(policy, robot, ASKED).run()
    assert [row["frame"] for row in log.rows if row["frame"] >= 0] == [0, 1, 2, 0, 1]
    assert [i for i, row in enumerate(log.rows) if row["reset"]] == [14, 32]


@pytest.mark.parametrize(
    ("sensor", "value", "text"),
    [
        ("joint_pos", [0.1, 0.9], "knee is 0.70 rad off the first frame"),
        ("root_pos_w", [3.0, 0.0, 0.8], "root_pos_w is 3.00 m off the first frame, at [3.  0.  0.8]"),
        ("root_quat_w", [0.8, 0.0, 0.0, 0.6], "root_quat_w is 1.29 rad off the first frame"),
    ],
)
def test_does_not_run_away_from_the_start(sensor: str, value: list[float], text: str):
    def change(tick: int, sensors: dict, stamps: dict) -> None:
        sensors[sensor] = np.array(value)

    robot = ToyRobot(change)
    with pytest.raises(RobotError, match="run refused for 5 s"):
        Runner(ToyPolicy(), robot, AUTO).run()
    runner = Runner(ToyPolicy(), ToyRobot(change), AUTO)
    runner.run(State.RUN)
    assert runner.failure == text
    assert robot.calls[-1] == "damp"


def test_waits_for_sensors_and_says_which_are_missing():
    def change(tick: int, sensors: dict, stamps: dict) -> None:
        if tick < 20:
            del sensors["root_pos_w"], stamps["root_pos_w"]

    runner = Runner(ToyPolicy(), ToyRobot(change), AUTO)
    assert states(runner.run()) == ["damping", "to_start", "run", "hold", "damping"]
    robot = ToyRobot(change)
    with pytest.raises(RobotError, match=r"to_start refused for 0.1 s: no measurement yet of root_pos_w"):
        Runner(ToyPolicy(), robot, replace(AUTO, patience=0.1)).run()
    assert set(robot.calls) == {"damp"}


def test_order_of_joints_is_the_robots():
    robot = ToyRobot()
    robot.joint_names, robot.pos = ("knee", "finger", "hip"), np.array([0.2, 7.0, 0.1])
    policy = ToyPolicy()
    Runner(policy, robot, replace(AUTO, hold=0.0)).run(State.RUN)
    assert policy.given[0]["joint_pos"] == pytest.approx([0.1, 0.2])
    assert robot.commands[3] == pytest.approx([0.23, 0.0, 0.13])
    other = ToyRobot()
    other.joint_names = ("knee",)
    with pytest.raises(PolicyError, match="robot: has no joints hip, which the policy drives"):
        Runner(policy, other)


def test_servos_are_told_more_often_than_the_policy_is_asked():
    robot, policy = ToyRobot(), ToyPolicy()
    robot.servo_dt = DT / 4
    robot.pos = np.array([0.1, 0.2])
    Runner(policy, robot, AUTO).run(State.RUN)
    assert len(robot.commands) > 4 * 10
    assert len(policy.given) < 15
    assert all((robot.commands[4 * i] == robot.commands[4 * i + k]).all() for i in range(9) for k in range(4))


def test_requests_between_ticks_are_not_lost():
    robot = ToyRobot()
    robot.servo_dt, robot.pos = DT / 4, np.array([0.1, 0.2])
    robot.requests = {6: ("hold",), 15: ("quit",)}  # the second reading of the second tick, the third of the fourth
    log = Runner(ToyPolicy(), robot, ASKED).run(State.RUN)
    assert states(log) == ["run", "hold", "damping"]
    assert [row["frame"] for row in log.rows] == [0, 1, -1, -1, -1]
    robot = ToyRobot()
    robot.servo_dt, robot.pos, robot.faults = DT / 4, np.array([0.1, 0.2]), {6: ("knee is hot",)}
    runner = Runner(ToyPolicy(), robot, AUTO)
    runner.run(State.RUN)
    assert runner.failure == "the robot says: knee is hot"


# -- what ends in damping -------------------------------------------------------------------------------------


def after(tick: int, **values: Any) -> Callable[[int, dict, dict], None]:
    """Sensors that show something else from a reading on."""

    def change(now: int, sensors: dict, stamps: dict) -> None:
        if now >= tick:
            sensors.update({name: np.array(value, dtype=float) for name, value in values.items()})

    return change


def stale(sensor: str) -> Callable[[int, dict, dict], None]:
    """A sensor that measures nothing more from the sixth reading on."""

    def change(now: int, sensors: dict, stamps: dict) -> None:
        stamps[sensor] = min(stamps[sensor], 5 * DT)

    return change


NAN = float("nan")


@pytest.mark.parametrize(
    ("change", "failure"),
    [
        (after(5, joint_pos=[0.1, 1.2]), "knee is 0.20 rad beyond its range"),
        (after(5, joint_vel=[-11.0, 0.0]), "hip turns at -11.0 rad/s"),
        (after(5, root_quat_w=[0.8, 0.6, 0.0, 0.0]), "pelvis is tilted by 1.29 rad"),
        (after(5, root_pos_w=[NAN, 0.0, 0.8]), "not finite for 4 ticks: root_pos_w"),
        (after(5, root_quat_w=[0.0, 0.0, 0.0, 0.0]), "not finite for 4 ticks: root_quat_w"),
        (stale("root_pos_w"), "stale: root_pos_w (0.220 s old), for 6 ticks"),
        (stale("joint_vel"), "stale: joint_vel (0.160 s old), for 6 ticks"),
    ],
)
def test_trouble_ends_in_damping(change: Callable[[int, dict, dict], None], failure: str, tmp_path: Path):
    robot = ToyRobot(change)
    robot.pos = np.array([0.1, 0.2])
    runner = Runner(ToyPolicy(description(num_frames=100)), robot, AUTO)
    log = runner.run(State.RUN, tmp_path / "log.npz")
    assert runner.failure == failure
    assert states(log) == ["run", "damping"]
    assert robot.calls[-1] == "damp"
    assert not runner.completed
    header, _ = read_log(tmp_path / "log.npz")
    assert header["events"][-1][1] == f"run -> damping: {failure}"


@pytest.mark.parametrize("start", [State.TO_START, State.HOLD])
def test_trouble_counts_in_every_state_with_stiffness(start: State):
    robot = ToyRobot(after(8, root_quat_w=[0.8, 0.6, 0.0, 0.0]))
    robot.requests = {1: ("to_start",)} | ({3: ("hold",)} if start is State.HOLD else {}) | {12: ("quit",)}
    runner = Runner(ToyPolicy(), robot, ASKED)
    log = runner.run()
    assert log.header["states"][log.rows[7]["state"]] in ("to_start", "hold")
    assert log.header["states"][log.rows[8]["state"]] == "damping"
    assert robot.calls[-6:] == ["damp"] * 6


def test_a_motion_may_lean():
    leans = after(5, root_quat_w=[0.8, 0.6, 0.0, 0.0])  # 1.29 rad
    robot = ToyRobot(leans)
    robot.pos = np.array([0.1, 0.2])
    runner = Runner(ToyPolicy(description(max_tilt=0.6)), robot, AUTO)
    runner.run(State.RUN)
    assert runner.completed


def test_a_robot_that_reports_a_fault_is_damped():
    robot = ToyRobot()
    robot.pos, robot.faults = np.array([0.1, 0.2]), {5: ("knee is hot",)}
    runner = Runner(ToyPolicy(), robot, AUTO)
    runner.run(State.RUN)
    assert runner.failure == "the robot says: knee is hot"


def test_late_ticks_are_counted_and_end_in_damping():
    robot = ToyRobot()
    robot.pos = np.array([0.1, 0.2])
    robot.waits = dict.fromkeys(range(3, 100), 0.012)
    runner = Runner(ToyPolicy(description(num_frames=100)), robot, AUTO)
    runner.run(State.RUN)
    assert runner.failure == "late by more than 10 ms for 6 ticks"
    assert runner.guard.counts.late == 6

    robot = ToyRobot()
    robot.pos, robot.waits = np.array([0.1, 0.2]), {3: 0.012, 5: 0.1}
    runner = Runner(ToyPolicy(), robot, AUTO)
    log = runner.run(State.RUN)
    assert runner.completed
    assert runner.guard.counts.late == 2
    times = [row["time"] for row in log.rows]
    assert times[:7] == pytest.approx([0.0, 0.02, 0.04, 0.072, 0.08, 0.2, 0.22])  # what was missed is not made up for


def test_a_value_that_is_not_finite_is_bridged_for_a_while():
    def change(tick: int, sensors: dict, stamps: dict) -> None:
        sensors["root_pos_w"][0] = NAN if tick in (4, 5, 8) else 0.001 * tick

    robot, policy = ToyRobot(change), ToyPolicy()
    robot.pos = np.array([0.1, 0.2])
    runner = Runner(policy, robot, AUTO)
    runner.run(State.RUN)
    assert runner.completed
    assert runner.guard.counts.bad == 3
    shown = [given["root_pos_w"][0] for given in policy.given[3:9]]
    assert shown == pytest.approx([0.003, 0.003, 0.003, 0.006, 0.007, 0.007])


@pytest.mark.parametrize("error", [OutputError("not finite"), SensorError("no eyes")])
def test_a_policy_that_fails_is_followed_by_damping(error: Exception):
    class Failing(ToyPolicy):
        def __call__(self, sensors: dict[str, np.ndarray]) -> np.ndarray:
            if self.frame == 3:
                raise error
            return super().__call__(sensors)

    robot = ToyRobot()
    robot.pos = np.array([0.1, 0.2])
    runner = Runner(Failing(), robot, AUTO)
    runner.run(State.RUN)
    assert runner.failure == f"the policy fails: {error}"
    assert robot.calls[-1] == "damp"


def test_any_exception_ends_in_damping_and_leaves_a_log(tmp_path: Path):
    def change(tick: int, sensors: dict, stamps: dict) -> None:
        if tick == 6:
            raise ZeroDivisionError("a bug")

    robot = ToyRobot(change)
    runner = Runner(ToyPolicy(), robot, AUTO)
    with pytest.raises(ZeroDivisionError):
        runner.run(log=tmp_path / "log.npz")
    assert robot.calls[-1] == "damp"
    assert runner.failure == "ZeroDivisionError: a bug"
    assert len(read_log(tmp_path / "log.npz")[1]["time"]) == 6


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupt_ends_in_damping(number: signal.Signals, tmp_path: Path):
    robot = ToyRobot(lambda tick, sensors, stamps: signal.raise_signal(number) if tick == 6 else None)
    before = signal.getsignal(number)
    runner = Runner(ToyPolicy(), robot, AUTO)
    runner.run(log=tmp_path / "log.npz")
    assert runner.failure == "interrupted"
    assert robot.calls[-1] == "damp"
    assert len(read_log(tmp_path / "log.npz")[1]["time"]) == 7  # the tick was finished
    assert signal.getsignal(number) is before


def test_more_interrupts_end_in_damping_and_leave_a_log(tmp_path: Path):
    class Slow(ToyRobot):
        def damp(self) -> None:
            signal.raise_signal(signal.SIGINT)  # again, just as it damps
            super().damp()

    def change(tick: int, sensors: dict, stamps: dict) -> None:
        if tick == 6:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)  # breaks the tick off

    robot = Slow(change)
    robot.pos = np.array([0.1, 0.2])
    runner = Runner(ToyPolicy(), robot, AUTO)
    runner.run(State.RUN, tmp_path / "log.npz")
    assert runner.failure == "interrupted"
    assert robot.calls[-1] == "damp"
    assert len(read_log(tmp_path / "log.npz")[1]["time"]) == 6


def test_a_robot_that_cannot_be_damped_does_not_cost_the_log(tmp_path: Path):
    class Lost(ToyRobot):
        def read(self) -> Reading:
            if self.reads == 4:
                raise RobotError("cable")
            return super().read()

        def damp(self) -> None:
            raise RobotError("no answer")

    robot = Lost()
    robot.pos = np.array([0.1, 0.2])
    with pytest.raises(RobotError):
        Runner(ToyPolicy(), robot, AUTO).run(State.RUN, tmp_path / "log.npz")
    assert len(read_log(tmp_path / "log.npz")[1]["time"]) == 4


# -- limits ---------------------------------------------------------------------------------------------------


def limited(target: list[float], pos: list[float], vel: list[float], **limits: float) -> np.ndarray:
    about = description()
    guard = Guard(about, (), Limits(**limits))
    return guard.limit(
        np.array(target), about.stiffness, about.damping, {"joint_pos": np.array(pos), "joint_vel": np.array(vel)}
    )


def test_targets_stay_in_the_joint_ranges_if_they_are_to():
    assert limited([3.0, -0.7], [2.0, -0.5], [0.0, 0.0], target_margin=0.0) == pytest.approx([2.0, -0.5])
    assert limited([3.0, -0.7], [1.9, -0.5], [0.0, 0.0], target_margin=0.1) == pytest.approx([1.9, -0.4])


def test_targets_ask_for_no_more_than_the_motors_have():
    # 100 * 0.5 - 2 * 1 = 48 N m wanted of 20: q + (20 + 2) / 100; the knee's 50 * -0.1 + 1 * 4 = -1 N m is allowed
    assert limited([0.5, -0.1], [0.0, 0.0], [1.0, -4.0]) == pytest.approx([0.22, -0.1])
    # beyond the range of 2 rad at its end: as far as the motor can push
    assert limited([3.0, -0.1], [2.0, 0.0], [0.0, 0.0]) == pytest.approx([2.2, -0.1])
    assert limited([0.5, -0.1], [0.0, 0.0], [1.0, -4.0], effort=0.5) == pytest.approx([0.12, -0.1])
    assert limited([0.5, -0.1], [0.0, 0.0], [1.0, -4.0], effort=0.0) == pytest.approx([0.5, -0.1])


# -- log ------------------------------------------------------------------------------------------------------


def test_log_replays_to_the_same_targets(tmp_path: Path):
    wobble = lambda tick, sensors, stamps: sensors["root_pos_w"].__setitem__(0, 0.01 * np.sin(tick))  # noqa: E731
    robot = ToyRobot(wobble)
    Runner(ToyPolicy(), robot, AUTO).run(log=tmp_path / "log.npz")
    header, arrays = read_log(tmp_path / "log.npz")
    assert header["joint_names"] == ["hip", "knee"]
    assert replay(arrays, ToyPolicy()).max() == 0.0
    arrays["sensors/root_pos_w"][arrays["frame"] == 4, 0] += 0.5
    differences = replay(arrays, ToyPolicy())
    assert differences.argmax() == 4
    assert differences.max() == pytest.approx(0.05)
    assert np.isnan(arrays["target"][arrays["frame"] < 0]).all()
    assert np.isnan(arrays["command"][-1]).all()  # damping
    with pytest.raises(LogError, match="lacks sensors/root_pos_w"):
        replay({name: value for name, value in arrays.items() if "root_pos" not in name}, ToyPolicy())


def test_a_log_that_cannot_be_written_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "log.npz"
    Log({"states": []}, [{"time": 1.0}]).write(path)

    def full(*_: Any, **__: Any) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OSError, match="no space left"):
        Log({"states": []}, [{"time": 2.0}]).write(path)
    assert [item.name for item in tmp_path.iterdir()] == ["log.npz"]
    assert read_log(path)[1]["time"] == [1.0]


def test_wrong_logs_are_named(tmp_path: Path):
    path = tmp_path / "log.npz"
    with pytest.raises(LogError, match=r"log.npz: there is no such file"):
        read_log(path)
    path.write_bytes(b"PK\x03\x04 and nothing more")
    with pytest.raises(LogError, match=r"log.npz: is no log of the runner"):
        read_log(path)
    np.savez(path, header=np.array(json.dumps({"format": "other"})))
    with pytest.raises(LogError, match="format 'other'; this version reads"):
        read_log(path)
    with pytest.raises(LogError, match="the policy never ran"):
        replay({"frame": np.array([-1])}, ToyPolicy())


# -- controls -------------------------------------------------------------------------------------------------


def test_keys_of_a_terminal(monkeypatch: pytest.MonkeyPatch):
    far, near = pty.openpty()
    with os.fdopen(near, "r+b", buffering=0) as terminal:
        monkeypatch.setattr(sys, "stdin", os.fdopen(os.dup(terminal.fileno())))
        keyboard = Keyboard()
        assert keyboard.active
        assert keyboard.requests() == []
        os.write(far, b"sx r\x1b")
        assert keyboard.requests() == ["to_start", "damping", "run", "damping"]
        keyboard.close()
        keyboard.close()
        assert not keyboard.active
        sys.stdin.close()
    os.close(far)


def test_no_terminal_has_no_keys(monkeypatch: pytest.MonkeyPatch):
    with open(os.devnull) as nothing:
        monkeypatch.setattr(sys, "stdin", nothing)
        keyboard = Keyboard()
        assert not keyboard.active
        assert keyboard.requests() == []
        keyboard.close()


def test_a_gamepad_that_goes_away_means_damping(tmp_path: Path):
    path = tmp_path / "js0"
    os.mkfifo(path)
    gamepad = Gamepad(str(path))
    device = os.open(path, os.O_WRONLY)
    events = [(0, 1, 0x81, 0), (5, 1, 1, 0), (6, 0, 1, 0), (7, 1, 2, 3), (8, 1, 1, 3)]  # opening, down, up, axis, down
    os.write(device, b"".join(struct.pack("IhBB", *event) for event in events))
    assert gamepad.requests() == ["to_start", "run"]
    os.close(device)
    assert gamepad.requests() == ["damping"]
    assert gamepad.requests() == []


def test_shielded_actions_are_all_done():
    done: list[str] = []

    def fails() -> None:
        done.append("first")
        raise ValueError("no")

    with Interrupts() as interrupts:
        errors = interrupts.shield([fails, lambda: signal.raise_signal(signal.SIGINT), lambda: done.append("last")])
    assert done == ["first", "last"]
    assert [type(error) for error in errors] == [ValueError]


# -- an exported policy ---------------------------------------------------------------------------------------


@pytest.fixture
def changed(exported: Path, tmp_path: Path) -> Callable[..., Path]:
    """The exported policy with other metadata; None takes an entry away."""

    def write(**entries: str | None) -> Path:
        model = onnx.load(exported / "policy.onnx")
        metadata = {prop.key: prop.value for prop in model.metadata_props} | entries
        onnx.helper.set_model_props(model, {key: value for key, value in metadata.items() if value is not None})
        path = tmp_path / "policy.onnx"
        path.write_bytes(model.SerializeToString())
        return path

    return write


@pytest.fixture
def plant(exported: Path) -> Callable[..., MujocoRobot]:
    """The exported policy's robot, with options."""
    about = Policy(exported).description

    def make(**options: Any) -> MujocoRobot:
        return MujocoRobot(about, exported / "scene.xml", MujocoOptions(**options))

    return make


def first_sensors(robot: MujocoRobot, policy: Policy) -> dict[str, np.ndarray]:
    sensors = robot.read().sensors
    return {name: sensors[name] for name in policy.sensors}


def test_policy_keeps_its_state_and_starts_anew(exported: Path, plant: Callable[..., MujocoRobot]):
    policy = Policy(exported)
    sensors = first_sensors(plant(start_noise=0.0), policy)
    first = policy(sensors)
    assert first.shape == (29,)
    assert policy.frame == 0
    second = policy(sensors)
    assert not np.array_equal(first, second)  # the motion went on
    policy.reset()
    assert np.array_equal(policy(sensors), first)
    policy.reset(290)
    assert policy.frame == 289
    for _ in range(12):
        policy(sensors)
    assert policy.finished
    assert policy.frame == 299
    with pytest.raises(ValueError, match="start_frame: expected 0 to 299, got 300"):
        policy.reset(300)


def test_sensors_are_checked(exported: Path, plant: Callable[..., MujocoRobot]):
    policy = Policy(exported)
    sensors = first_sensors(plant(), policy)
    with pytest.raises(SensorError, match="sensors object_pos_w are missing; the policy needs joint_pos"):
        policy({name: value for name, value in sensors.items() if name != "object_pos_w"})
    with pytest.raises(SensorError, match="unknown sensors lidar; there is joint_pos"):
        policy(sensors | {"lidar": np.zeros(3)})
    with pytest.raises(SensorError, match=r"joint_pos: expected shape \[29\], got \[28\]"):
        policy(sensors | {"joint_pos": np.zeros(28)})
    with pytest.raises(SensorError, match="root_pos_w: is not finite"):
        policy(sensors | {"root_pos_w": np.array([NAN, 0.0, 0.0])})
    policy.state = {name: np.full_like(v, NAN) if v.dtype == np.float32 else v for name, v in policy.state.items()}
    with pytest.raises(OutputError, match="joint_pos_target is not finite at frame 0"):
        policy(sensors)


@pytest.mark.parametrize(
    ("entries", "text"),
    [
        ({"format": None}, "has no metadata entry 'format'"),
        ({"format": "hdmi-policy/99"}, "format 'hdmi-policy/99'; this version reads 'hdmi-policy/1'"),
        ({"joint_stiffness": None}, "metadata lacks 'joint_stiffness'"),
        ({"joint_stiffness": "1.0,2.0"}, r"'joint_stiffness': expected shape \[29\], got \[2\]"),
        ({"joint_damping": "a,b"}, "metadata 'joint_damping' cannot be read"),
        ({"joint_names": "hip,knee"}, r"expected shape \[2, 2\], got \[29, 2\]"),
        ({"joint_ranges": "[["}, "metadata 'joint_ranges' cannot be read"),
        ({"sensors": '{"lidar": {"shape": [3]}}'}, "metadata 'sensors': unknown lidar"),
        ({"sensors": '{"joint_vel": {"shape": [29]}}'}, "input 'joint_pos' is none of its sensors joint_vel"),
        ({"start": "{}"}, "metadata 'start' lacks joint_pos, root_pos_w, root_quat_w"),
        ({"state": "{}"}, "metadata 'state' lacks 'fresh'"),
        ({"control_dt": "0"}, "metadata 'control_dt': expected seconds between 0 and 1"),
        ({"num_frames": "many"}, "metadata 'num_frames' cannot be read"),
    ],
)
def test_wrong_files_are_one_line(entries: dict[str, str | None], text: str, changed: Callable[..., Path]):
    with pytest.raises(PolicyError, match=text) as caught:
        Policy(changed(**entries))
    assert "\n" not in str(caught.value)
    assert "policy.onnx" in str(caught.value)


def test_files_that_are_no_policies(tmp_path: Path):
    with pytest.raises(PolicyError, match=r"policy.onnx: there is no such file"):
        Policy(tmp_path)
    (tmp_path / "policy.onnx").write_bytes(b"not a graph")
    with pytest.raises(PolicyError, match="is no ONNX graph that ONNX Runtime reads"):
        Policy(tmp_path)
    (tmp_path / "scene.xml").write_text("<mujoco><worldbody/></mujoco>")
    with pytest.raises(PolicyError, match="has no joint hip"):
        MujocoRobot(description(), tmp_path / "scene.xml")


def test_metadata_says_what_an_evaluation_needs(exported: Path):
    about = Policy(exported).description
    assert about.terminations["object_pose"] == Termination({"object_pos": 0.12, "object_ori": 1.2}, 25)
    assert set(about.terminations) == {"root_pose", "body_local_pose", "object_pose"}
    assert about.unchecked == ("lost_contact",)
    assert about.max_tilt == pytest.approx(0.0, abs=0.01)
    assert len(about.tracked_joints) == 23
    assert about.start_noise["joint_pos"] == pytest.approx(0.03)  # the preset's
    reference = read_reference(exported, about)
    assert {name: value.shape for name, value in reference.items()} == {
        "joint_pos": (300, 29), "root_pos_w": (300, 3), "root_quat_w": (300, 4),
        "object_pos_w": (300, 3), "object_quat_w": (300, 4),
    }  # fmt: skip
    assert reference["joint_pos"][0] == pytest.approx(about.start["joint_pos"], abs=1e-6)


# -- the simulated robot --------------------------------------------------------------------------------------


def test_starts_are_the_first_frame_perturbed(plant: Callable[..., MujocoRobot]):
    robot = plant(start_noise=0.0)
    start = robot.description.start
    sensors = robot.read().sensors
    for name in ("joint_pos", "root_pos_w", "object_pos_w"):
        assert sensors[name] == pytest.approx(start[name], abs=1e-6)
    robot = plant(start_noise=2.0, seed=3)
    first = robot.read().sensors["joint_pos"]
    off = np.abs(first - start["joint_pos"])
    assert 0.03 < off.max() <= 0.06 + 1e-6
    robot.reset()
    assert not np.array_equal(robot.read().sensors["joint_pos"], first)
    robot.reset(0)
    assert np.array_equal(robot.read().sensors["joint_pos"], first)


def test_servos_are_stiffness_and_damping_within_the_effort_limits(plant: Callable[..., MujocoRobot]):
    robot = plant(start_noise=0.0)
    about = robot.description
    target = about.start["joint_pos"] + 0.01
    target[20] += 1.0  # 100 N m/rad and 5 N m
    robot.command(target, about.stiffness, about.damping)
    import mujoco

    mujoco.mj_forward(robot.model, robot.data)
    expected = np.clip(0.01 * about.stiffness, -about.effort_limits, about.effort_limits)
    expected[20] = 5.0
    assert robot.data.qfrc_actuator[6:35] == pytest.approx(expected, abs=1e-4)
    assert robot.model.dof_damping[6:35] == pytest.approx(about.damping)
    robot.damp()
    mujoco.mj_forward(robot.model, robot.data)
    assert robot.data.qfrc_actuator == pytest.approx(np.zeros(robot.model.nv))
    assert robot.model.dof_damping[6:35] == pytest.approx(about.damping)


def test_clock_is_the_simulations(plant: Callable[..., MujocoRobot]):
    robot = plant()
    robot.wait(0.02)
    assert robot.time() == pytest.approx(0.02)
    assert robot.data.time / robot.model.opt.timestep == pytest.approx(10)
    robot.wait(0.01)
    assert robot.time() == pytest.approx(0.02)


def test_motion_capture_is_late_and_loses_frames(plant: Callable[..., MujocoRobot]):
    robot = plant(mocap_latency=0.03, mocap_rate=100.0)
    ages = []
    for tick in range(20):
        robot.wait(tick * DT)
        reading = robot.read()
        ages.append(reading.time - reading.stamps["root_pos_w"])
        assert reading.stamps["joint_pos"] == reading.time
    assert min(ages) == pytest.approx(0.03)
    assert max(ages) < 0.03 + DT + 1e-9
    robot = plant(mocap_dropout=1.0)
    robot.wait(0.1)
    reading = robot.read()
    assert reading.stamps["object_pos_w"] == 0.0
    assert reading.sensors["object_pos_w"] == pytest.approx(robot.read().sensors["object_pos_w"])


def test_actions_are_late(plant: Callable[..., MujocoRobot]):
    robot = plant(action_delay=0.01)
    about = robot.description
    robot.command(about.start["joint_pos"], about.stiffness, about.damping)
    robot.wait(0.01)
    assert robot.model.actuator_gainprm[:, 0] == pytest.approx(np.zeros(29))
    robot.wait(0.012)
    assert robot.model.actuator_gainprm[:, 0] == pytest.approx(about.stiffness)
    robot.command(about.start["joint_pos"], about.stiffness, about.damping)
    robot.damp()
    robot.wait(0.05)
    assert robot.model.actuator_gainprm[:, 0] == pytest.approx(np.zeros(29))


@pytest.mark.parametrize(
    ("option", "sensor", "most"),
    [
        ("joint_pos_noise", "joint_pos", 0.05),
        ("joint_vel_noise", "joint_vel", 0.05),
        ("gyro_noise", "root_ang_vel_b", 0.05),
        ("gyro_bias", "root_ang_vel_b", 0.05),
        ("tilt_bias", "root_quat_w", 0.05),
        ("mocap_noise", "root_pos_w", 0.05),
        ("mocap_noise", "object_pos_w", 0.05),
    ],
)
def test_noise_is_within_its_range(option: str, sensor: str, most: float, plant: Callable[..., MujocoRobot]):
    true = plant(start_noise=0.0).read().sensors[sensor]
    noisy = plant(start_noise=0.0, **{option: most})
    off = np.abs([noisy.read().sensors[sensor] - true for _ in range(20)])
    assert 0.0 < off.max() <= most + 1e-9
    assert (np.ptp(off, axis=0).max() == 0.0) == option.endswith("bias")


def test_friction_and_strength_of_the_plant(plant: Callable[..., MujocoRobot]):
    nominal, other = plant(), plant(friction_loss=0.7, mass_scale=1.1, effort_scale=0.5, floor_friction=0.5)
    assert other.model.dof_frictionloss[6:35] == pytest.approx(nominal.model.dof_frictionloss[6:35] + 0.7)
    assert other.model.body_mass[1:31] == pytest.approx(1.1 * nominal.model.body_mass[1:31])
    assert other.model.body_mass[31:] == pytest.approx(nominal.model.body_mass[31:])  # stand and box
    assert other.model.actuator_forcerange == pytest.approx(0.5 * nominal.model.actuator_forcerange)


def test_a_gantry_holds_the_root_for_a_while(plant: Callable[..., MujocoRobot]):
    robot = plant(gantry=0.2)
    height = robot.data.qpos[2]
    robot.wait(0.2)
    assert robot.data.qpos[2] == pytest.approx(height, abs=1e-3)
    robot.wait(0.6)
    assert robot.data.qpos[2] < height - 0.05  # without stiffness it sinks


def test_judge_finds_no_error_in_the_motion_itself(exported: Path, plant: Callable[..., MujocoRobot]):
    import mujoco

    robot = plant(start_noise=0.0)
    reference = read_reference(exported, robot.description)
    judge = Judge(robot, reference)
    for frame in (0, 100, 200):
        robot.place(
            robot.data, reference["root_pos_w"][frame], reference["root_quat_w"][frame], reference["joint_pos"][frame]
        )
        mujoco.mj_kinematics(robot.model, robot.data)
        errors = judge.errors(frame)
        for name in ("joint_pos", "body_pos", "body_ori", "root_pos", "root_ori"):
            assert errors[name].max() < 1e-5, name
    robot.data.qpos[:2] += [0.3, 0.4]
    mujoco.mj_kinematics(robot.model, robot.data)
    errors = judge.errors(200)
    assert errors["root_pos"][0] == pytest.approx(0.5, abs=1e-5)
    assert errors["body_pos"].max() < 1e-5  # local


def test_judge_has_the_trainers_patience(exported: Path, plant: Callable[..., MujocoRobot]):
    import mujoco

    robot = plant(start_noise=0.0)
    judge = Judge(robot, read_reference(exported, robot.description))
    robot.data.qpos[0] += 0.6  # m; 0.5 for three steps is a failure
    mujoco.mj_kinematics(robot.model, robot.data)
    assert [judge(0), judge(0), judge(0)] == [None, None, "root_pose"]
    judge.start()
    robot.data.qpos[0] -= 0.6
    robot.data.qpos[2] -= 0.6
    mujoco.mj_kinematics(robot.model, robot.data)
    assert judge(0) == "fall"
    robot.data.qvel[0] = NAN
    assert judge(0) == "diverged"


# -- rotations ------------------------------------------------------------------------------------------------


def test_rotations_are_those_of_the_trainer():
    generator = torch.Generator().manual_seed(0)
    a, b = torch.nn.functional.normalize(torch.randn(2, 50, 4, generator=generator, dtype=torch.float64), dim=-1)
    v = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    pairs = [
        (rotations.quat_multiply(a.numpy(), b.numpy()), F.quat_multiply(a, b)),
        (rotations.quat_apply(a.numpy(), v.numpy()), F.quat_apply(a, v)),
        (rotations.quat_apply_inverse(a.numpy(), v.numpy()), F.quat_apply_inverse(a, v)),
        (rotations.quat_angle(a.numpy(), b.numpy()), F.quat_angle(a, b)),
        (rotations.quat_from_euler(v.numpy()), F.quat_from_euler(v)),
        (rotations.yaw_of(a.numpy()), F.yaw_quat(a)),
    ]
    for ours, theirs in pairs:
        assert ours == pytest.approx(theirs.numpy(), abs=1e-6)
    turned = rotations.quat_from_rotation_vector(np.array([[0.0, 0.0, np.pi / 2], [0.0, 0.0, 0.0]]))
    assert turned == pytest.approx(np.array([[0.5**0.5, 0.0, 0.0, 0.5**0.5], [1.0, 0.0, 0.0, 0.0]]))
    assert rotations.tilt_of(np.array([0.8, 0.0, 0.6, 0.0])) == pytest.approx(2 * np.arctan2(0.6, 0.8))


# -- the command ----------------------------------------------------------------------------------------------


def test_episodes_log_replay_and_plot(exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    main = command("deploy").main
    log, plot = tmp_path / "log.npz", tmp_path / "page.png"
    assert main([f"policy={exported}", "robot=mujoco", "episodes=1", f"log={log}"]) == 0
    shown = capsys.readouterr().out
    assert "1 episodes of 299 steps" in shown
    assert "not checked: lost_contact" in shown
    assert main([f"policy={exported}", f"replay={log}", f"plot={plot}"]) == 0
    assert "targets differ by at most 0.00e+00 rad" in capsys.readouterr().out
    assert plot.read_bytes().startswith(b"\x89PNG")
    header, arrays = read_log(log)
    arrays["sensors/joint_pos"][5:] += 0.2
    np.savez(log, header=np.array(json.dumps(header)), **arrays)
    assert main([f"policy={exported}", f"replay={log}"]) == 1


def test_all_states_in_simulation(exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    log = tmp_path / "log.npz"
    options = ["robot=mujoco", "gantry=100", "auto=true", "to_start=0.2", "settle=0.1", "hold=0.1"]
    assert command("deploy").main([f"policy={exported}", *options, f"log={log}", "effort=0", "keys=false"]) == 0
    header, arrays = read_log(log)
    numbers = [header["states"].index(name) for name in ("to_start", "run", "hold")]
    assert list(dict.fromkeys(arrays["state"].tolist())) == [*numbers, header["states"].index("damping")]
    assert "to_start -> run" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["robot=mujoco"], "ConfigError: give policy=FOLDER"),
        (["policy={}"], "ConfigError: give robot=NAME, one of mujoco, unitree"),
        (["policy={}", "robot=asimo"], "ConfigError: robot: expected one of mujoco"),
        (["policy={}", "robot=mujoco", "epsodes=3"], "ConfigError: unknown option 'epsodes' (did you mean episodes?)"),
        (["policy={}", "robot=mujoco", "mocap_latency=far"], "ConfigError: mocap_latency: a number expected"),
        (["policy={}", "robot=mujoco", "integrator=leapfrog"], "PolicyError: integrator: expected one of euler"),
        (["policy=/nowhere", "robot=mujoco"], "PolicyError: /nowhere: there is no such file"),
        (["policy={}", "replay=/nowhere.npz"], "LogError: /nowhere.npz: there is no such file"),
        (["policy={}", "robot=mujoco", "gamepad=/nowhere"], "FileNotFoundError"),
    ],
)
def test_mistakes_are_one_line(arguments: list[str], text: str, exported: Path, capsys: pytest.CaptureFixture[str]):
    assert command("deploy").main([argument.format(exported) for argument in arguments]) == 2
    said = capsys.readouterr().err
    assert said.startswith(text)
    assert said.count("\n") == 1


def test_help_names_every_option(capsys: pytest.CaptureFixture[str]):
    assert command("deploy").main(["--help"]) == 0
    shown = capsys.readouterr().out
    for option in ("to_start=3.0", "tilt=0.7", "mocap_latency=0.0", "episodes"):
        assert option in shown


WITHOUT_TRAINER = """
import sys
for name in ("torch", "torchrl", "tensordict", "hydra", "omegaconf", "onnx", "scipy", "trimesh", "wandb", "matplotlib"):
    sys.modules[name] = None  # importing it fails
from hdmi.commands.deploy import main
status = main([f"policy={sys.argv[1]}", "robot=mujoco", "episodes=1", "log=" + sys.argv[2]])
assert not [name for name in sys.modules if name.startswith(("hdmi.learning", "hdmi.transforms", "hdmi.config"))]
sys.exit(status)
"""


def test_needs_no_trainer(exported: Path, tmp_path: Path):
    """In a process in which neither torch nor hydra can be imported."""
    call = [sys.executable, "-c", WITHOUT_TRAINER, str(exported), str(tmp_path / "log.npz")]
    done = subprocess.run(call, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert len(read_log(tmp_path / "log.npz")[1]["time"]) >= 1
