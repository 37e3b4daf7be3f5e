"""The G1 behind its messages: their bytes, the watchdog, motion capture, and a simulated robot at the other end.

What is about logic runs over a loopback in the simulation's time; what is about DDS and processes runs on `lo`.
"""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

pytest.importorskip("onnxruntime")

from hdmi.assets import g1 as figures
from hdmi.deploy import g1, mocap, rotations
from hdmi.deploy.description import Description, PolicyError
from hdmi.deploy.line import Line
from hdmi.deploy.log import Log, read_log
from hdmi.deploy.policy import Policy
from hdmi.deploy.robot import RobotError
from hdmi.deploy.robots.unitree import Options, UnitreeRobot, connect
from hdmi.deploy.runner import Options as RunnerOptions
from hdmi.deploy.runner import Runner, State
from hdmi.deploy.scene import hinge_of
from hdmi.deploy.simulator import Options as SimulatorOptions
from hdmi.deploy.simulator import Simulator
from hdmi.deploy.trial import Judge, read_reference

ROOT = Path(__file__).parents[1]
NO_POSES = Options(mocap="none")
DDS = pytest.mark.xdist_group("dds")
DOMAIN = 71  # the tests' own


# -- messages -------------------------------------------------------------------------------------------------


def bitwise_crc(words: bytes) -> int:
    """As the SDK's documentation writes it: word by word, bit by bit."""
    crc = 0xFFFFFFFF
    for word in np.frombuffer(words, "<u4").tolist():
        for bit in range(31, -1, -1):
            high = crc >> 31
            crc = (crc << 1) & 0xFFFFFFFF
            if high ^ (word >> bit & 1):
                crc ^= 0x04C11DB7
    return crc


def filled(dtype: np.dtype) -> np.ndarray:
    """A message with a number of its own in every field."""
    message = np.zeros((), dtype)
    rng = np.random.default_rng(0)

    def fill(part: np.ndarray) -> None:
        for name in part.dtype.names or ():
            if part.dtype[name].base.names:
                fill(part[name])
            else:
                part[name] = rng.integers(0, 200, part[name].shape)

    fill(message)
    return message


def test_crc_is_the_sdks():
    rng = np.random.default_rng(0)
    for count in (1, 2, 250):
        words = rng.integers(0, 256, 4 * count, dtype=np.uint8).tobytes()
        assert g1.crc32(words) == bitwise_crc(words)


def test_crc_of_a_command_that_the_sdk_has_sent():
    """Fields and CRC of a message on the wire from Unitree's C++ SDK."""
    message = np.zeros((), g1.LOW_CMD)
    message["mode_machine"] = 5
    motors = message["motor_cmd"][:29]
    motors["mode"], motors["dq"], motors["tau"], motors["kd"] = 1, 0.5, -0.25, 1.5
    motors["q"], motors["kp"] = 0.01 * np.arange(29), 40.0 + np.arange(29)
    g1.pack(message)
    assert message["crc"] == 0x426DC291


@pytest.mark.parametrize("dtype", [g1.LOW_CMD, g1.LOW_STATE], ids=["command", "state"])
def test_messages_come_back(dtype: np.dtype):
    message = filled(dtype)
    payload = g1.pack(message)
    assert g1.unpack(payload, dtype) == message
    spoilt = bytearray(payload)
    spoilt[100] ^= 1
    assert g1.unpack(bytes(spoilt), dtype) is None
    message = np.frombuffer(message.tobytes(), dtype)[0].copy()  # whose padding may be anything
    assert g1.unpack(g1.pack(message), dtype) == message
    assert g1.unpack(payload[:-1], dtype) is None
    assert g1.unpack(b"", dtype) is None


def test_bytes_are_what_a_serializer_makes_of_the_types():
    """Cyclone's own, which knows nothing of ours; and the types are those that the SDK's programs announce."""
    dds = pytest.importorskip("hdmi.deploy.dds")
    identifiers = {
        dds.LowCmd: "42b0283aa7e1bb592ec898a0dbed", dds.LowState: "2be9706c9587e8d8afd8bfc6de7b",
        dds.Request: "c47a4429fcbf539486498753c48f", dds.Response: "d1c32cc0221490" "1a464a6c51325d",
    }  # fmt: skip
    for kind, identifier in identifiers.items():
        assert kind.__idl__.get_type_id().value.hex() == identifier
    for kind, dtype in ((dds.LowCmd, g1.LOW_CMD), (dds.LowState, g1.LOW_STATE)):
        message = filled(dtype)
        payload = b"\x00\x01\x00\x00" + g1.pack(message)
        read = kind.__idl__.deserialize(payload)
        assert read.crc == message["crc"]
        assert kind.__idl__.serialize(read) == payload


def test_motors_are_in_the_sdks_order():
    assert set(g1.JOINTS) == set(figures.JOINT_NAMES)
    for name, motor in {
        "left_hip_pitch": 0, "left_knee": 3, "right_hip_pitch": 6, "right_ankle_roll": 11, "waist_yaw": 12,
        "waist_pitch": 14, "left_elbow": 18, "left_wrist_yaw": 21, "right_shoulder_pitch": 22, "right_wrist_yaw": 28,
    }.items():  # fmt: skip
        assert g1.JOINTS[motor] == f"{name}_joint"


def test_buttons_ask_for_states():
    remote = np.zeros(40, np.uint8)
    remote[2], remote[3] = 0b00101000, 0b00000010
    assert g1.pressed(remote) == {"select", "L2", "B"}
    assert (g1.remote_of(frozenset(("select", "L2", "B"))) == remote).all()
    none = frozenset[str]()
    assert [g1.requests_of(none, frozenset((name,))) for name in ("A", "Y", "X", "B", "select", "up")] == [
        ("to_start",), ("run",), ("hold",), ("damping",), ("quit",), (),
    ]  # fmt: skip
    assert g1.requests_of(frozenset("A"), frozenset("A")) == ()  # is held
    assert g1.requests_of(none, frozenset(("L2", "A"))) == ()  # a combination of the robot's own
    assert g1.requests_of(none, frozenset(("L2", "B"))) == ("damping",)


# -- motion capture -------------------------------------------------------------------------------------------

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
ROOT_POSE = mocap.Pose(np.array([1.0, 2.0, 0.8]), LEVEL)


def test_poses_come_back():
    sent = mocap.Pose(np.array([1.0, -2.0, 0.5]), np.array([0.6, 0.0, 0.8, 0.0]))
    message = mocap.decode(mocap.encode("box", sent, stamp=12.5))
    assert (message.name, message.stamp, message.joint) == ("box", 12.5, None)
    assert message.pose is not None
    assert message.pose.pos == pytest.approx(sent.pos)
    assert message.pose.quat == pytest.approx(sent.quat)
    assert mocap.decode(mocap.encode("hinge", joint=0.3)).joint == 0.3


@pytest.mark.parametrize(
    ("parts", "fault"),
    [
        ([b"pelvis"], "expected a name and a JSON object"),
        ([b"", b"{}"], "expected a name"),
        ([b"pelvis", b"[1, 2]"], "pelvis: expected a JSON object"),
        ([b"pelvis", b"{"], "Expecting property name"),
        ([b"\xff", b"{}"], "codec can't decode"),
        ([b"pelvis", b'{"pos": [0, 0, 0]}'], "pelvis: quat: expected 4 numbers"),
        ([b"pelvis", b'{"pos": [0, 0], "quat": [1, 0, 0, 0]}'], "pelvis: pos: expected 3 finite numbers"),
        ([b"pelvis", b'{"pos": [0, NaN, 0], "quat": [1, 0, 0, 0]}'], "pelvis: pos: expected 3 finite numbers"),
        ([b"pelvis", b'{"pos": [0, 0, 0], "quat": [0, 0, 0, 0]}'], "pelvis: quat: expected length 1, got 0.000"),
        ([b"hinge", b'{"joint": "wide"}'], "hinge: joint: expected 1 numbers"),
        ([b"hinge", b'{"joint": [1]}'], "hinge: joint: expected 1 finite numbers"),
    ],
)
def test_bad_messages_are_dropped(parts: list[bytes], fault: str):
    motion = mocap.Motion(mocap.Options(), None)
    motion.hear(mocap.encode("pelvis", ROOT_POSE), 1.0, LEVEL)
    motion.hear(parts, 2.0, LEVEL)
    assert motion.dropped == 1
    assert fault in motion.reason
    found, stamps = motion.sensors()
    assert found["root_pos_w"] == pytest.approx([1.0, 2.0, 0.8])
    assert stamps["root_pos_w"] == 1.0


def test_the_last_message_of_each_body_counts():
    motion = mocap.Motion(mocap.Options(object_name="crate"), None)
    assert motion.sensors() == ({}, {})
    for now, x in enumerate((0.1, 0.2, 0.3)):
        motion.hear(mocap.encode("crate", mocap.Pose(np.array([x, 0.0, 0.0]), LEVEL)), float(now), None)
    motion.hear(mocap.encode("somebody", ROOT_POSE), 5.0, None)
    found, stamps = motion.sensors()
    assert found["object_pos_w"] == pytest.approx([0.3, 0.0, 0.0])
    assert stamps == {"object_pos_w": 2.0, "object_quat_w": 2.0}


def test_offsets_lead_from_markers_to_bodies():
    turn = [0.5**0.5, 0.0, 0.0, 0.5**0.5]  # a quarter about z
    motion = mocap.Motion(mocap.Options(root_offset=[0.1, 0.0, 0.0, *turn]), None)
    motion.hear(mocap.encode("pelvis", mocap.Pose(np.array([1.0, 0.0, 0.0]), np.array(turn))), 0.0, LEVEL)
    assert motion.sensors()[0]["root_pos_w"] == pytest.approx([1.0, 0.1, 0.0])
    assert motion.heading == pytest.approx(np.pi)
    with pytest.raises(RobotError, match=r"object_offset: expected x,y,z,w,x,y,z with a unit quaternion"):
        mocap.Motion(mocap.Options(object_offset=[0.1, 0.0, 0.0]), None)


def test_stamps_of_the_publisher_count_only_if_asked_for():
    message = mocap.encode("pelvis", ROOT_POSE, stamp=99.97)
    arrival, stamped = (mocap.Motion(mocap.Options(mocap_stamps=asked), None, lambda: 100.0) for asked in (False, True))
    for motion in (arrival, stamped):
        motion.hear(message, 7.0, None)
    assert arrival.sensors()[1]["root_pos_w"] == 7.0
    assert stamped.sensors()[1]["root_pos_w"] == pytest.approx(6.97)
    stamped.hear(mocap.encode("pelvis", ROOT_POSE, stamp=101.0), 8.0, None)
    assert "pelvis: stamp is 1.000 s ahead of this machine's clock" in stamped.reason


def test_heading_is_motion_captures_and_the_tilt_the_imus():
    yaw = lambda angle: rotations.quat_from_euler(np.array([0.0, 0.0, angle]))  # noqa: E731
    tilted = rotations.quat_from_euler(np.array([0.2, -0.3, 0.0]))
    imu, true = rotations.quat_multiply(yaw(0.4), tilted), rotations.quat_multiply(yaw(-2.9), tilted)
    offset = mocap.heading_between(true, imu)
    assert offset == pytest.approx(rotations.wrapped(-3.3))
    assert rotations.quat_angle(mocap.turned(offset, imu), true) == pytest.approx(0.0, abs=1e-6)
    # an IMU that is off by more than its heading: the tilt stays the IMU's
    leaning = rotations.quat_multiply(rotations.quat_from_euler(np.array([0.05, 0.0, 0.0])), imu)
    found = mocap.turned(mocap.heading_between(true, leaning), leaning)
    assert rotations.tilt_of(found) == pytest.approx(rotations.tilt_of(leaning))


def test_heading_follows_slowly_and_the_short_way():
    assert abs(mocap.blended(3.1, -3.1, 0.5)) == pytest.approx(np.pi, abs=1e-9)
    assert mocap.blended(0.2, 0.4, 0.25) == pytest.approx(0.25)
    motion = mocap.Motion(mocap.Options(heading_time=1.0), None)
    for tick in range(101):
        measured = 0.1 if tick else 0.0
        quat = rotations.quat_from_euler(np.array([0.0, 0.0, measured]))
        motion.hear(mocap.encode("pelvis", mocap.Pose(np.zeros(3), quat)), 0.01 * tick, LEVEL)
        if tick == 0:
            assert motion.heading == 0.0
    assert motion.heading == pytest.approx(0.1 * (1.0 - np.exp(-1.0)), rel=1e-6)


HINGED = """<mujoco><worldbody><body name="chair"><freejoint/><geom size="0.1"/>
  <body name="seat" euler="20 -30 10" pos="0 0 0.2"><joint axis="0.6 0 0.8" ref="25"/><geom size="0.1"/></body>
</body></worldbody><sensor><framepos name="object_penetration" objtype="body" objname="chair"/></sensor></mujoco>"""


def test_hinge_from_two_rigid_bodies():
    model = mujoco.MjModel.from_xml_string(HINGED)
    data, hinge = mujoco.MjData(model), hinge_of(model)
    assert hinge is not None
    rng = np.random.default_rng(0)
    for angle in (-1.2, 0.0, 0.7):
        data.qpos[3:7] = rng.normal(size=4)
        data.qpos[7] = angle
        mujoco.mj_kinematics(model, data)
        assert hinge.angle(data.body("chair").xquat, data.body("seat").xquat) == pytest.approx(angle)
        motion = mocap.Motion(mocap.Options(), hinge)
        motion.hear(mocap.encode("object", mocap.Pose(np.zeros(3), data.body("chair").xquat)), 1.0, None)
        assert "object_joint_pos" not in motion.sensors()[0]
        motion.hear(mocap.encode("object_part", mocap.Pose(np.zeros(3), data.body("seat").xquat)), 2.0, None)
        found, stamps = motion.sensors()
        assert found["object_joint_pos"] == pytest.approx([angle])
        assert stamps["object_joint_pos"] == 1.0
    motion.hear(mocap.encode("object_joint", joint=0.25), 3.0, None)
    assert motion.sensors()[0]["object_joint_pos"] == pytest.approx([0.25])


# -- the robot ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def about(exported: Path) -> Description:
    return Policy(exported).description


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def state(**changes: Any) -> bytes:
    """A LowState_ of a level robot; `motor` fields by their names."""
    message = np.zeros((), g1.LOW_STATE)
    message["mode_machine"], message["imu_state"]["quaternion"] = 5, LEVEL
    for name, value in changes.items():
        (message if name in (g1.LOW_STATE.names or ()) else message["motor_state"])[name] = value
    return g1.pack(message)


def commanded(payload: bytes) -> np.ndarray:
    """The motors' fields of a LowCmd_. [35]"""
    message = g1.unpack(payload, g1.LOW_CMD)
    assert message is not None
    assert message["mode_pr"] == 0
    return message["motor_cmd"]


def test_damps_until_it_is_commanded(about: Description):
    robot = UnitreeRobot(about, NO_POSES, clock=Clock())
    robot.hear(state())
    motors = commanded(robot.speak())
    assert motors["mode"].tolist() == [1] * 29 + [0] * 6
    assert not motors["kp"].any()
    damping = dict(zip(about.joint_names, about.damping, strict=True))
    assert motors["kd"][:29] == pytest.approx([damping[name] for name in g1.JOINTS], rel=1e-6)


def test_commands_go_to_the_motors_of_their_joints(about: Description):
    names = about.joint_names[::-1]
    other = replace(about, joint_names=names, damping=about.damping[::-1])
    robot = UnitreeRobot(other, NO_POSES, clock=Clock())
    robot.hear(state(q=np.arange(35), dq=-np.arange(35)))
    index = other.indices_of(robot.joint_names, "robot")
    measured = robot.read().sensors
    assert measured["joint_pos"][index[0]] == g1.JOINTS.index(names[0])
    target, stiffness, damping = np.zeros(29), np.full(29, 10.0), np.full(29, 2.0)
    target[index[3]] = 0.5
    robot.command(target, stiffness, damping)
    motors = commanded(robot.speak())
    assert motors["q"][g1.JOINTS.index(names[3])] == 0.5
    assert np.count_nonzero(motors["q"]) == 1
    assert motors["kp"][:29].tolist() == [10.0] * 29
    assert motors["kd"].tolist() == [2.0] * 29 + [0.0] * 6
    assert g1.unpack(robot.speak(), g1.LOW_CMD)["mode_machine"] == 5  # type: ignore[index]
    robot.damp()
    assert not commanded(robot.speak())["kp"].any()


def test_a_silent_runner_is_damped(about: Description):
    clock = Clock()
    robot = UnitreeRobot(about, NO_POSES, clock=clock)
    robot.hear(state())
    robot.command(np.zeros(29), np.ones(29), np.ones(29))
    clock.now = 0.09
    assert commanded(robot.speak())["kp"].any()
    clock.now = 0.11
    assert not commanded(robot.speak())["kp"].any()
    assert robot.read().faults == ("no command for more than 0.1 s",)
    assert robot.read().faults == ()
    robot.command(np.zeros(29), np.ones(29), np.ones(29))
    assert commanded(robot.speak())["kp"].any()


def test_what_the_motors_complain_of_is_a_fault(about: Description):
    robot = UnitreeRobot(about, NO_POSES, clock=Clock())
    hot, codes = np.full((35, 2), 40), np.zeros(35)
    hot[3, 1], codes[6], codes[20] = 95, 0x40, 1
    robot.hear(state(temperature=hot, motorstate=codes))
    # of the arms' codes Unitree's own examples say nothing
    assert robot.read().faults == ("left_knee_joint is at 95 C", "right_hip_pitch_joint has error code 0x40")


def test_a_spoilt_state_is_none(about: Description):
    clock = Clock()
    robot = UnitreeRobot(about, NO_POSES, clock=clock)
    robot.hear(state())
    clock.now = 1.0
    payload = state()
    robot.hear(payload[:-1] + bytes((payload[-1] ^ 1,)))
    reading = robot.read()
    assert robot.remarks() == ("1 states with a wrong CRC dropped",)
    assert reading.time == 1.0
    assert set(reading.stamps.values()) == {0.0}


def test_short_presses_are_not_lost(about: Description):
    robot = UnitreeRobot(about, NO_POSES, clock=Clock())
    for down in ("B", "", "A", "", "Y", "Y", ""):  # what is down at the first state was pressed for someone else
        robot.hear(state(wireless_remote=g1.remote_of(frozenset(down))))
    assert robot.read().requests == ("to_start", "run")
    assert robot.read().requests == ()


def test_heading_has_to_be_known_where_there_is_motion_capture(about: Description):
    robot = UnitreeRobot(about, Options(), clock=Clock())
    robot.hear(state())
    assert "root_quat_w" not in robot.read().sensors
    half = mocap.Pose(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    robot.hear_pose(mocap.encode("pelvis", half))
    assert np.abs(robot.read().sensors["root_quat_w"]) == pytest.approx([0.0, 0.0, 0.0, 1.0])
    assert robot.remarks() == ()
    robot.hear_pose([b"pelvis", b"[]"])
    assert robot.remarks() == ("1 messages of motion capture dropped, the last: pelvis: expected a JSON object",)


def test_nonsense_is_refused_in_one_line(about: Description, tmp_path: Path):
    robot = UnitreeRobot(about, NO_POSES, clock=Clock())
    with pytest.raises(RobotError, match="expected finite targets and gains"):
        robot.command(np.full(29, np.nan), np.ones(29), np.ones(29))
    tail = replace(about, joint_names=(*about.joint_names[:-1], "tail_joint"))
    with pytest.raises(PolicyError, match=r"^unitree: the G1: has no joints tail_joint, which the policy drives$"):
        UnitreeRobot(tail, NO_POSES)
    with pytest.raises(RobotError, match="watchdog: expected more than 0 s"):
        UnitreeRobot(about, replace(NO_POSES, watchdog=0.0))


class Wire:
    """A port at whose other end a robot says the same all the time; keeps what it is sent."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.fault: Exception | None = None

    def send(self, payload: bytes) -> None:
        if self.fault is not None:
            raise self.fault
        self.sent.append(payload)

    def receive(self, timeout: float) -> list[bytes]:
        time.sleep(0.001)
        return [state()]


def waited(condition: Callable[[], object]) -> None:
    """Returns when a condition holds that another thread brings about."""
    for _ in range(2000):
        if condition():
            return
        time.sleep(0.002)
    raise AssertionError("in vain")


def test_damping_is_the_last_that_is_sent(about: Description):
    wire, robot = Wire(), UnitreeRobot(about, replace(NO_POSES, farewell=0.05, watchdog=60.0))
    robot.listen(wire)
    robot.drive(wire)
    robot.command(np.zeros(29), np.ones(29), np.ones(29))
    waited(lambda: wire.sent and commanded(wire.sent[-1])["kp"].any())
    before = len(wire.sent)
    robot.close()
    farewell = [commanded(payload)["kp"].any() for payload in wire.sent[before + 2 :]]  # one may have been under way
    assert farewell
    assert not any(farewell)
    assert not any(thread.is_alive() for thread in robot._threads)
    robot.close()


def test_a_wire_that_breaks_loses_the_robot(about: Description):
    wire, robot = Wire(), UnitreeRobot(about, NO_POSES)
    robot.listen(wire)
    wire.fault = RobotError("rt/lowcmd: DDS does not take a message")
    robot.drive(wire)
    waited(lambda: robot._failure)
    with pytest.raises(RobotError, match="the robot is lost: rt/lowcmd: DDS does not take a message"):
        robot.read()
    robot.close()


def test_a_line_delays_and_loses():
    line = Line[int](0.1, 0.5, np.random.default_rng(0))
    for i in range(100):
        line.put(0.01 * i, lambda i=i: i)
    assert line.due(0.0999) == []
    early, late = line.due(0.5), line.due(2.0)
    assert [i for _, i in early + late] == sorted(i for _, i in early + late)
    assert max(sent for sent, _ in early) == pytest.approx(0.4)
    assert 30 < len(early + late) < 70


# -- runner, robot and simulated robot, in the simulation's time -------------------------------------------------

Network = Callable[[float, str, bytes], bytes | None]  # what becomes of a message: its time, its kind and its bytes


class Loopback(UnitreeRobot):
    """The robot and the simulated one in one process: each wait of the runner advances the simulation."""

    def __init__(self, simulator: Simulator, options: Options, network: Network = lambda now, kind, payload: payload):
        super().__init__(simulator.plant.description, options, clock=simulator.plant.time)
        self.simulator, self.network = simulator, network
        self.wait(0.05)

    def wait(self, until: float) -> None:
        while self.time() < until - 1e-9:
            if (command := self.network(self.time(), "command", self.speak())) is not None:
                self.simulator.hear(command)
            states, frames = self.simulator.step()
            for payload in states:
                if (arrived := self.network(self.time(), "state", payload)) is not None:
                    self.hear(arrived)
            for name, body in frames:
                if (arrived := self.network(self.time(), "pose", body)) is not None:
                    self.hear_pose([name, arrived])


QUICK = RunnerOptions(to_start=0.2, settle=0.1, hold=0.1, auto=True)


@pytest.fixture
def drive(exported: Path) -> Callable[..., tuple[Runner, Loopback, Log]]:
    """A run through all states with a held robot, over a network."""

    def run(network: Network = lambda now, kind, payload: payload, **options: float) -> tuple[Runner, Loopback, Log]:
        policy = Policy(exported)
        policy.description = replace(policy.description, num_frames=40)
        chosen = {"gantry": 100.0, "mocap_rate": 100.0} | options
        simulator = Simulator(policy.description, exported / "scene.xml", SimulatorOptions(**chosen))
        robot = Loopback(simulator, Options(), network)
        runner = Runner(policy, robot, QUICK)
        return runner, robot, runner.run()

    return run


def since(moment: float, *kinds: str) -> Network:
    """A network that carries nothing of some kinds from a time on."""
    return lambda now, kind, payload: None if now > moment and kind in kinds else payload


def states(log: Log) -> list[str]:
    found = [log.header["states"][row["state"]] for row in log.rows]
    return [name for i, name in enumerate(found) if i == 0 or name != found[i - 1]]


def test_all_states_over_the_wire(drive: Callable[..., Any]):
    runner, robot, log = drive()
    assert runner.completed
    assert states(log) == ["to_start", "run", "hold", "damping"]
    run = [row for row in log.rows if row["frame"] >= 0]
    true = robot.simulator.plant.data.qpos[robot.simulator.plant._root_qpos :][3:7]
    assert rotations.quat_angle(run[-1]["sensors/root_quat_w"].astype(float), true) < 1e-3
    servo = robot.simulator.plant.model.actuator_gainprm[:, 0]
    robot.wait(robot.time() + 0.01)
    assert not servo.any()  # damped


def test_a_bad_network_is_survived(drive: Callable[..., Any]):
    runner, robot, _ = drive(loss=0.2, delay=0.006, mocap_dropout=0.2, mocap_latency=0.01)
    assert runner.completed
    assert robot.simulator.counts["commands"] < 0.9 * robot.simulator.steps
    assert robot.simulator.counts["dropped"] == 0


@pytest.mark.parametrize(
    ("network", "failure"),
    [
        (since(0.6, "pose"), r"stale: root_pos_w \(0.\d+ s old\), .*for 6 ticks"),
        (since(0.6, "state"), r"stale: joint_pos \(0.\d+ s old\), .*for 6 ticks"),
        (since(0.6, "state", "command", "pose"), r"stale: joint_pos"),
    ],
    ids=["poses", "states", "all"],
)
def test_what_does_not_arrive_any_more_ends_in_damping(network: Network, failure: str, drive: Callable[..., Any]):
    runner, robot, log = drive(network)
    assert re.match(failure, runner.failure)
    assert states(log) == ["to_start", "run", "damping"]
    assert not commanded(robot.speak())["kp"].any()


def test_a_state_that_is_not_finite_ends_in_damping(drive: Callable[..., Any]):
    def network(now: float, kind: str, payload: bytes) -> bytes:
        if now < 0.6 or kind != "state":
            return payload
        message = g1.unpack(payload, g1.LOW_STATE).copy()  # type: ignore[union-attr]
        message["motor_state"]["q"][4] = np.nan
        return g1.pack(message)

    runner, _, _ = drive(network)
    assert runner.failure == "not finite for 4 ticks: joint_pos"


def test_spoilt_commands_are_none(drive: Callable[..., Any]):
    def network(now: float, kind: str, payload: bytes) -> bytes:
        return payload[:-1] + bytes((payload[-1] ^ 1,)) if kind == "command" else payload

    _, robot, _ = drive(network)
    assert robot.simulator.counts["commands"] == 0
    assert robot.simulator.counts["dropped"] == robot.simulator.steps


@pytest.fixture
def simulator(exported: Path, about: Description) -> Callable[..., Simulator]:
    def make(say: Callable[[str], object] = lambda text: None, **options: Any) -> Simulator:
        return Simulator(about, exported / "scene.xml", SimulatorOptions(**({"start_noise": 0.0} | options)), say)

    return make


def low_command(**fields: Any) -> bytes:
    message = np.zeros((), g1.LOW_CMD)
    for name, value in ({"mode": 1} | fields).items():
        message["motor_cmd"][name][:29] = value
    return g1.pack(message)


def test_motors_do_what_a_command_says_and_damp_without_one(simulator: Callable[..., Simulator], about: Description):
    robot = simulator(command_timeout=0.02)
    plant = robot.plant
    joint = about.joint_names.index("left_elbow_joint")
    q, dq = plant.joint_pos()[joint], plant.onboard()["joint_vel"][joint]
    motor = g1.JOINTS.index("left_elbow_joint")
    values = {name: np.zeros(29) for name in ("q", "dq", "tau", "kp", "kd")}
    for name, value in {"q": q + 0.1, "dq": 0.5, "tau": 2.0, "kp": 20.0, "kd": 1.5}.items():
        values[name][motor] = value
    robot.hear(low_command(**values))
    robot.step()
    servo = plant._servos[joint]
    torque = float(plant.data.actuator_force[servo])  # of the step: damping by the joint's own velocity comes on top
    assert torque == pytest.approx(20.0 * 0.1 + 1.5 * 0.5 + 2.0, abs=0.05 + 20.0 * 0.002 * abs(dq))
    assert plant.model.dof_damping[plant._dof[joint]] == pytest.approx(1.5)
    values["kp"][motor] = 1e4
    robot.hear(low_command(**values))
    robot.step()
    assert plant.data.actuator_force[servo] == pytest.approx(about.effort_limits[joint])
    robot.hear(low_command(**(values | {"mode": 0})))
    robot.step()
    assert plant.data.actuator_force[servo] == 0.0
    for _ in range(12):
        robot.step()
    assert robot.counts["timeouts"] == 1
    assert plant.model.dof_damping[plant._dof] == pytest.approx(about.damping)


def test_the_gantry_holds_until_the_runner_has_had_its_time(simulator: Callable[..., Simulator]):
    told: list[str] = []
    robot = simulator(told.append, gantry=0.1)
    height = robot.plant.data.qpos[2]
    for _ in range(100):
        robot.step()
    assert robot.plant.data.qpos[2] == pytest.approx(height, abs=1e-3)
    for _ in range(60):
        robot.hear(low_command(kp=1e-3))
        robot.step()
    assert robot.plant.data.qpos[2] < height - 1e-3
    assert [text.partition(": ")[2] for text in told] == [
        "commanded", "stiffness; the gantry holds for another 0.1 s", "the gantry lets go",
    ]  # fmt: skip


def test_an_operator_resets_releases_and_presses(simulator: Callable[..., Simulator]):
    robot = simulator()
    first = robot.plant.data.qpos.copy()
    assert robot.obey("release") == "done"
    for _ in range(100):
        robot.step()
    assert np.abs(robot.plant.data.qpos - first).max() > 0.01
    assert robot.obey("reset 0") == "done"
    assert robot.plant.data.qpos == pytest.approx(first)
    assert robot.obey("press A") == "done"
    payloads, _ = robot.step()
    message = g1.unpack(payloads[0], g1.LOW_STATE)
    assert message is not None
    assert g1.pressed(message["wireless_remote"]) == {"A"}
    for text, answer in {
        "jump": "refused: expected reset [EPISODE], release or press BUTTON, got 'jump'",
        "press Z": "refused: no button 'Z'; there is R1, L1, start",
        "reset x": "refused: invalid literal",
    }.items():
        assert robot.obey(text).startswith(answer)


# -- DDS ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bus() -> Any:
    dds = pytest.importorskip("hdmi.deploy.dds")
    return dds.Bus("lo", DOMAIN)


def received(port: Any, send: Callable[[], None]) -> bytes:
    """The first message that arrives while another end sends."""
    for _ in range(100):
        send()
        if found := port.receive(0.05):
            return found[-1]
    raise AssertionError("nothing arrives")


def repeatedly(action: Callable[[], object]) -> tuple[threading.Event, threading.Thread]:
    """Does something in another thread, again and again until the event is set."""
    done = threading.Event()

    def work() -> None:
        while not done.wait(0.005):
            action()

    thread = threading.Thread(target=work)
    thread.start()
    return done, thread


@DDS
def test_messages_cross_dds(bus: Any):
    from hdmi.deploy import dds

    runner = dds.Port(bus, g1.COMMAND_TOPIC, g1.STATE_TOPIC)
    robot = dds.Port(bus, g1.STATE_TOPIC, g1.COMMAND_TOPIC)
    for near, far, dtype in ((runner, robot, g1.LOW_CMD), (robot, runner, g1.LOW_STATE)):
        message = filled(dtype)
        payload = g1.pack(message)
        assert g1.unpack(received(far, lambda near=near, payload=payload: near.send(payload)), dtype) == message
    assert not dds.others_command(bus, 0.05)  # this participant itself does not count
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    other = DomainParticipant(DOMAIN)
    message = object.__new__(dds.LowCmd)
    message.payload = g1.pack(filled(g1.LOW_CMD))
    writer = DataWriter(other, Topic(other, g1.COMMAND_TOPIC, dds.LowCmd))
    done, thread = repeatedly(lambda: writer.write(message))
    try:
        assert dds.others_command(bus, 5.0)
    finally:
        done.set()
        thread.join()


@DDS
def test_the_robots_own_service_is_released(bus: Any):
    from hdmi.deploy.motion_switcher import MotionSwitcher, SimulatedSwitcher

    with pytest.raises(RobotError, match=r"the motion switcher does not answer within 0.2 s; press L2 and R2"):
        MotionSwitcher(bus).release(0.2)
    switcher = SimulatedSwitcher(bus, "ai")
    done, thread = repeatedly(switcher.answer)
    try:
        MotionSwitcher(bus).release(5.0)
    finally:
        done.set()
        thread.join()
    assert switcher.mode == ""


@DDS
def test_a_robot_that_is_not_there_is_one_line(about: Description, exported: Path):
    pytest.importorskip("cyclonedds")
    options = Options(mocap="none", domain=DOMAIN + 1, connect_timeout=0.2)
    for interface, text in {
        None: "give interface=NAME",
        "eth77": "interface: there is no 'eth77'; there is lo",
        "lo": f"interface lo, domain {DOMAIN + 1}: nothing on rt/lowstate for 0.2 s; is the robot on",
    }.items():
        with pytest.raises(RobotError, match=re.escape(text)) as caught:
            connect(about, exported, replace(options, interface=interface))
        assert "\n" not in str(caught.value)


BLOCKED = """
import sys
for name in ("torch", "torchrl", "tensordict", "hydra", "omegaconf", "onnx", "scipy", "wandb", "matplotlib"{more}):
    sys.modules[name] = None  # importing it fails
from hdmi.commands.{command} import main
sys.exit(main(sys.argv[1:]))
"""


def start(command: str, *arguments: str, more: str = "") -> subprocess.Popen[str]:
    """A command in a process of its own that has no trainer."""
    code = BLOCKED.format(command=command, more=more)
    pipe = subprocess.PIPE
    return subprocess.Popen(
        [sys.executable, "-u", "-c", code, *arguments], stdout=pipe, stderr=pipe, stdin=subprocess.DEVNULL, text=True,
        cwd=ROOT,
    )  # fmt: skip


def until(process: subprocess.Popen[str], text: str) -> None:
    """Reads what a process says until a line has a text in it."""
    assert process.stdout is not None
    said = []
    for line in process.stdout:
        said.append(line)
        if text in line:
            return
    raise AssertionError(f"{text!r} never said: {''.join(said)}")


@pytest.mark.parametrize("package", ["cyclonedds", "zmq"])
def test_a_missing_extra_is_named(package: str, exported: Path):
    process = start("deploy", f"policy={exported}", "robot=unitree", "interface=lo", more=f', "{package}"')
    _, said = process.communicate(timeout=60)
    assert process.returncode == 2
    assert said.startswith("ImportError: ")
    assert said.endswith("needs the extra robot: pip install 'hdmi[robot]'\n")
    assert said.count("\n") == 1


@pytest.fixture
def processes() -> Iterator[list[subprocess.Popen[str]]]:
    started: list[subprocess.Popen[str]] = []
    yield started
    for process in started:
        process.kill()
        process.communicate()


@DDS
def test_either_end_may_be_killed(exported: Path, processes: list[subprocess.Popen[str]]):
    pytest.importorskip("cyclonedds")
    pytest.importorskip("zmq")
    domain, poses, control = f"domain={DOMAIN + 2}", "tcp://127.0.0.1:15556", "tcp://127.0.0.1:15557"
    robot = start(
        "simulate_robot", f"scene={exported}", domain, f"poses={poses}", f"control={control}", "gantry=100",
        "service=ai", "command_timeout=0.5",
    )  # fmt: skip
    processes.append(robot)
    until(robot, "at the start of lift_box")
    run = [
        f"policy={exported}", "robot=unitree", "interface=lo", domain, f"mocap={poses}", "auto=true", "to_start=0.2",
        "settle=0.1", "effort=0", "late_ticks=1000", "encoder_age=0.5", "mocap_age=0.5", "watchdog=1",
    ]  # fmt: skip
    runner = start("deploy", *run)
    processes.append(runner)
    until(runner, "to_start -> run")
    runner.send_signal(signal.SIGKILL)
    until(robot, "no command for 0.5 s: damping")
    asked = start("simulate_robot", "send=reset", f"control={control}")
    assert asked.communicate(timeout=60)[0] == "done\n"
    runner = start("deploy", *run)
    processes.append(runner)
    until(runner, "to_start -> run")
    robot.send_signal(signal.SIGKILL)
    _, said = runner.communicate(timeout=60)
    assert runner.returncode == 1
    assert re.fullmatch(r"ended in damping: stale: joint_pos .* for 6 ticks\n", said)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the zoo's lift_box."""
    from hdmi.deploy.export import export_graph

    folder = tmp_path_factory.mktemp("trained")
    export_graph(ROOT / "zoo" / "lift_box", folder)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    "network",
    [
        {},
        {"loss": 0.05, "delay": 0.004, "mocap_dropout": 0.05, "mocap_latency": 0.01},
        {"loss": 0.2, "delay": 0.01, "mocap_dropout": 0.2, "mocap_latency": 0.02},
    ],
    ids=["good", "bad", "worse"],
)
def test_episodes_succeed_over_the_wire(network: dict[str, float], trained: Path):
    """lift_box of the zoo, ten perturbed starts each, in the simulation's time."""
    policy = Policy(trained)
    reference = read_reference(trained, policy.description)
    failures = []
    for episode in range(10):
        options = SimulatorOptions(gantry=0.0, seed=100 + episode, **network)
        simulator = Simulator(policy.description, trained / "scene.xml", options)
        judge = Judge(simulator.plant, reference)
        runner = Runner(policy, Loopback(simulator, Options()), RunnerOptions(hold=0.0), watch=judge)
        runner.run(State.RUN)
        failures.append(runner.failure)
    assert failures == [None] * 10


@DDS
@pytest.mark.slow
def test_a_whole_policy_over_a_bad_network(trained: Path, tmp_path: Path, processes: list[subprocess.Popen[str]]):
    """lift_box of the zoo from the gantry to the motion's end, in real time."""
    pytest.importorskip("cyclonedds")
    pytest.importorskip("zmq")
    domain, poses, control = f"domain={DOMAIN + 3}", "tcp://127.0.0.1:15558", "tcp://127.0.0.1:15559"
    robot = start(
        "simulate_robot", f"scene={trained}", domain, f"poses={poses}", f"control={control}", "loss=0.05",
        "delay=0.004", "mocap_dropout=0.05", "mocap_latency=0.01", "seconds=60",
    )  # fmt: skip
    processes.append(robot)
    until(robot, "at the start of lift_box")
    runner = start(
        "deploy",
        f"policy={trained}",
        "robot=unitree",
        "interface=lo",
        domain,
        f"mocap={poses}",
        "auto=true",
        f"log={tmp_path / 'log.npz'}",
    )
    processes.append(runner)
    said, errors = runner.communicate(timeout=120)
    assert runner.returncode == 0, errors
    assert "hold -> damping: the motion is over" in said
    _, rows = read_log(tmp_path / "log.npz")
    ran = rows["frame"] >= 0
    wanted = read_reference(trained, Policy(trained).description)["object_pos_w"][rows["frame"][ran]]
    assert np.ptp(wanted[:, 2]) > 0.1  # it is lifted
    assert np.linalg.norm(rows["sensors/object_pos_w"][ran] - wanted, axis=1).mean() < 0.08
