"""Unitree's G1 by its low-level DDS topics: servo commands at 500 Hz, encoders, IMU, remote control; poses over ZMQ.

A thread of its own repeats the last command, and damps by itself when the runner has fallen silent; at the end damping
is sent for a while. Whatever else the robot's services do, they must not command the motors at the same time: the
motion service is released at connecting, and the robot refused while anyone else commands. docs/robot.md is the guide.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import mujoco
import numpy as np

from hdmi.deploy import g1, mocap
from hdmi.deploy.description import Description, PolicyError
from hdmi.deploy.format import scene_of
from hdmi.deploy.robot import Reading, RobotError
from hdmi.deploy.scene import Hinge, hinge_of

_LEG_MOTORS = 12  # of which Unitree's own examples report the error codes
_LISTEN = 0.1  # s that a thread waits for messages before it looks whether it is to end


@dataclass
class Options(mocap.Options):
    """The robot's network, and what it is watched for."""

    interface: str | None = None  # network interface of the robot, such as eth0; lo: simulate_robot on this machine
    domain: int = 0  # id of the DDS domain
    servo_dt: float = 0.002  # s between commands on the wire
    watchdog: float = 0.1  # s without a command of the runner after which the robot is damped
    farewell: float = 0.5  # s for which damping is sent at the end
    connect_timeout: float = 5.0  # s to wait for the robot's states and for its motion switcher
    release: bool = True  # whether the robot's own motion service is asked to let go of the motors
    max_temperature: float = 90.0  # degrees C of a motor, surface or winding, that mean damping


class Port(Protocol):
    """Messages out and in: see `hdmi.deploy.dds.Port`."""

    def send(self, payload: bytes) -> None: ...

    def receive(self, timeout: float) -> list[bytes]: ...


class UnitreeRobot:
    """A G1 behind a port; see `hdmi.deploy.robot.Robot`.

    `hear`, `hear_pose` and `speak` are what goes over the wire; `listen` and `drive` have threads do it.

    Args:
        description: of the policy, whose damping counts.
        options: see `Options`.
        hinge: of the policy's object, None without.
        clock: s, never goes backwards.

    Attributes:
        dropped: states whose CRC or length was wrong.
        motion: poses of motion capture, None without.

    Raises:
        PolicyError: if the policy drives joints that the G1 lacks.
        RobotError: if an option makes no sense.
    """

    joint_names = g1.JOINTS

    def __init__(
        self,
        description: Description,
        options: Options,
        hinge: Hinge | None = None,
        clock: Callable[[], float] = time.monotonic,
    ):
        index = description.indices_of(g1.JOINTS, "unitree: the G1")
        for key in ("servo_dt", "watchdog"):
            if getattr(options, key) <= 0:
                raise RobotError(f"{key}: expected more than 0 s, got {getattr(options, key):g}")
        self.options, self._clock = options, clock
        self.servo_dt = options.servo_dt
        self.motion = None if options.mocap == "none" else mocap.Motion(options, hinge)
        self._damping = np.full(len(g1.JOINTS), float(description.damping.min()))
        self._damping[index] = description.damping
        self._state: tuple[float, np.ndarray] | None = None
        self._command: tuple[float, np.ndarray, np.ndarray, np.ndarray] | None = None  # None: damping
        self._requests: deque[str] = deque()
        self._silences: deque[str] = deque()
        self._pressed: frozenset[str] | None = None  # at the first state there is nothing newly pressed
        self._failure: Exception | None = None
        self._threads: list[threading.Thread] = []
        self._end = threading.Event()
        self._driven = False
        self._leave_at: float | None = None
        self.dropped = 0

    # -- the wire ---------------------------------------------------------------------------------------------

    def hear(self, payload: bytes) -> None:
        """Takes a LowState_ in."""
        state = g1.unpack(payload, g1.LOW_STATE)
        if state is None:
            self.dropped += 1
            return
        self._state = self._clock(), state
        now = g1.pressed(state["wireless_remote"])
        if self._pressed is not None:
            self._requests.extend(g1.requests_of(self._pressed, now))
        self._pressed = now

    def speak(self) -> bytes:
        """The LowCmd_ to send now: the last command, or damping where the runner has fallen silent."""
        command, count = self._command, len(g1.JOINTS)
        if command is not None and self._clock() - command[0] > self.options.watchdog:
            self._command = command = None
            self._silences.append(f"no command for more than {self.options.watchdog:g} s")
        message = np.zeros((), g1.LOW_CMD)
        if self._state is not None:
            message["mode_machine"] = self._state[1]["mode_machine"]
        motors = message["motor_cmd"]
        motors["mode"][:count] = 1
        if command is None:
            motors["kd"][:count] = self._damping
        else:
            _, motors["q"][:count], motors["kp"][:count], motors["kd"][:count] = command
        return g1.pack(message)

    def hear_pose(self, parts: list[bytes]) -> None:
        """Takes a message of motion capture in."""
        assert self.motion is not None
        imu = None if self._state is None else self._state[1]["imu_state"]["quaternion"].astype(float)
        self.motion.hear(parts, self._clock(), imu)

    def listen(self, port: Port, poses: Any = None) -> None:
        """Starts threads that hear states and poses, and waits for the first state.

        Args:
            poses: a ZMQ socket with messages of motion capture; closed at the end.

        Raises:
            RobotError: if no state comes within `connect_timeout`.
        """

        def hear() -> None:
            while not self._end.is_set():
                for payload in port.receive(_LISTEN):
                    self.hear(payload)

        def hear_poses() -> None:
            while not self._end.is_set():
                if poses.poll(_LISTEN * 1e3):
                    self.hear_pose(poses.recv_multipart())
            poses.close()

        self._run("states", hear)
        if poses is not None:
            self._run("poses", hear_poses)
        until = self._clock() + self.options.connect_timeout
        while self._state is None:
            if self._failure is not None or self._clock() > until:
                raise RobotError(str(self._failure or self._unheard()))
            time.sleep(0.01)

    def drive(self, port: Port) -> None:
        """Starts the thread that sends commands, until `farewell` s after `close`."""

        def speak() -> None:
            due = self._clock()
            while self._leave_at is None or self._clock() < self._leave_at:
                port.send(self.speak())
                due = max(due + self.servo_dt, self._clock() - self.servo_dt)  # what was missed is not made up for
                time.sleep(max(due - self._clock(), 0.0))
            self._end.set()

        self._driven = True
        self._run("commands", speak)

    def _unheard(self) -> str:
        options = self.options
        wrong = f", but {self.dropped} messages with a wrong CRC" if self.dropped else ""
        return (
            f"interface {options.interface}, domain {options.domain}: nothing on {g1.STATE_TOPIC} "
            f"for {options.connect_timeout:g} s{wrong}; is the robot on, this machine in 192.168.123.x?"
        )

    def _run(self, name: str, body: Callable[[], None]) -> None:
        def guarded() -> None:
            try:
                body()
            except Exception as error:
                self._failure = error
                self._end.set()

        self._threads.append(threading.Thread(target=guarded, name=name))
        self._threads[-1].start()

    # -- the protocol -----------------------------------------------------------------------------------------

    def time(self) -> float:
        return self._clock()

    def wait(self, until: float) -> None:
        left = until - self._clock()
        if left > 0:
            time.sleep(left)

    def read(self) -> Reading:
        self._check()
        assert self._state is not None
        stamp, state = self._state
        imu, motors = state["imu_state"], state["motor_state"][: len(g1.JOINTS)]
        sensors = {
            "joint_pos": motors["q"].astype(float),
            "joint_vel": motors["dq"].astype(float),
            "root_ang_vel_b": imu["gyroscope"].astype(float),
        }
        orientation = imu["quaternion"].astype(float)
        stamps = dict.fromkeys((*sensors, "root_quat_w"), stamp)
        if self.motion is None:
            sensors["root_quat_w"] = orientation
        else:
            if (heading := self.motion.heading) is not None:
                sensors["root_quat_w"] = mocap.turned(heading, orientation)
            seen, seen_at = self.motion.sensors()
            sensors, stamps = sensors | seen, stamps | seen_at
        faults = (*_taken(self._silences), *self._faults(motors))
        return Reading(self._clock(), sensors, stamps, _taken(self._requests), faults)

    def _faults(self, motors: np.ndarray) -> tuple[str, ...]:
        hottest = motors["temperature"].max(axis=1)
        hot = [f"{g1.JOINTS[i]} is at {hottest[i]} C" for i in np.flatnonzero(hottest > self.options.max_temperature)]
        codes = motors["motorstate"][:_LEG_MOTORS]
        return (*hot, *(f"{g1.JOINTS[i]} has error code {codes[i]:#x}" for i in np.flatnonzero(codes)))

    def command(self, target: np.ndarray, stiffness: np.ndarray, damping: np.ndarray) -> None:
        self._check()
        values = np.array([target, stiffness, damping], dtype=float)
        if not np.isfinite(values).all():
            raise RobotError("command: expected finite targets and gains")
        self._command = self._clock(), *values

    def _check(self) -> None:
        if self._failure is not None:
            raise RobotError(f"the robot is lost: {self._failure}") from self._failure

    def damp(self) -> None:
        self._command = None

    def remarks(self) -> tuple[str, ...]:
        found = [f"{self.dropped} states with a wrong CRC dropped"] if self.dropped else []
        if self.motion is not None and self.motion.dropped:
            found.append(f"{self.motion.dropped} messages of motion capture dropped, the last: {self.motion.reason}")
        return tuple(found)

    def close(self) -> None:
        self.damp()
        if self._leave_at is None:
            self._leave_at = self._clock() + self.options.farewell
        if not self._driven:
            self._end.set()
        for thread in self._threads:
            thread.join()


def _taken(queue: deque[str]) -> tuple[str, ...]:
    """Empties a queue that another thread fills."""
    return tuple(queue.popleft() for _ in range(len(queue)))


def connect(description: Description, folder: Path, options: Options) -> UnitreeRobot:
    """The G1 on a network interface, in damping.

    Raises:
        ImportError: without the extra `robot`.
        PolicyError: if the policy drives joints that the G1 lacks, or its scene cannot be read.
        RobotError: if an option makes no sense, the robot does not answer, or someone else commands it.
    """
    from hdmi.deploy import dds
    from hdmi.deploy.motion_switcher import MotionSwitcher

    if options.interface is None:
        raise RobotError("give interface=NAME, the network interface of the robot, such as eth0; lo for simulate_robot")
    robot = UnitreeRobot(description, options, _hinge(scene_of(folder)))
    bus = dds.Bus(options.interface, options.domain)
    port = dds.Port(bus, g1.COMMAND_TOPIC, g1.STATE_TOPIC)
    poses = None if robot.motion is None else mocap.socket_of("SUB", options.mocap, "mocap")
    try:
        robot.listen(port, poses)
        if options.release:
            MotionSwitcher(bus).release(options.connect_timeout)
        if dds.others_command(bus, 0.5):
            raise RobotError(
                f"interface {options.interface}: someone else commands the motors on {g1.COMMAND_TOPIC}; end it, or "
                "press L2 and R2 (debug mode)"
            )
        robot.drive(port)
    except BaseException:
        robot.close()
        raise
    return robot


def _hinge(scene: Path) -> Hinge | None:
    try:
        return hinge_of(mujoco.MjModel.from_xml_path(str(scene)))
    except ValueError as error:
        raise PolicyError(f"{scene}: MuJoCo cannot read it: {str(error).splitlines()[0]}") from error
