"""A simulated G1 behind the real one's messages: physics, motor drivers, IMU, motion capture, and a bad network.

What goes over the wire is bytes in and bytes out of `Simulator`, whose clock is the simulation's; `serve` connects it
to DDS and ZMQ and keeps it to the wall's clock.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from hdmi.deploy import g1, mocap
from hdmi.deploy.controls import Interrupts
from hdmi.deploy.description import Description
from hdmi.deploy.line import Line
from hdmi.deploy.robot import RobotError
from hdmi.deploy.robots.mujoco import MujocoRobot, Plant
from hdmi.deploy.robots.mujoco import Options as PlantOptions
from hdmi.deploy.rotations import quat_from_rotation_vector, quat_multiply

DONE = "done"  # the answer when what was asked for has happened
PRESS = 0.1  # s for which a button is down
MODE_MACHINE = 5  # of a G1 with 29 joints
WARM = 40  # degrees C of a motor that has nothing to complain of
_BEHIND = 0.05  # s behind the wall's clock that are not made up for


@dataclass
class Options(Plant):
    """The plant's, and what is between it and a runner."""

    gantry: float = 3.6  # s for which the root is held from the first command with stiffness on, and before; 0: never
    mocap_rate: float = 100.0  # Hz; 0: a frame each step
    command_timeout: float = 0.05  # s without a command after which the motor drivers damp by themselves
    loss: float = 0.0  # share of commands, and of states, that are lost
    delay: float = 0.0  # s that commands, and states, take


class Simulator:
    """See the module.

    Args:
        description: of a policy, whose joints and effort limits count.
        scene: its MJCF file.
        options: see `Options`.
        say: is told events, as lines of text.

    Attributes:
        plant: the robot, whose root is held until the gantry lets go.
        steps: so far, of all episodes.
        counts: commands that the motor drivers got, those with a wrong CRC, and how often there was none in time.

    Raises:
        PolicyError: if the scene is none of the policy's, or the G1 lacks joints of it.
    """

    def __init__(
        self,
        description: Description,
        scene: str | Path,
        options: Options,
        say: Callable[[str], object] = lambda text: None,
    ):
        self.options, self._say = options, say
        shared = {f.name: getattr(options, f.name) for f in fields(Plant)}
        self._motors = description.indices_of(g1.JOINTS, "simulate_robot: the G1")
        self.plant = MujocoRobot(description, scene, PlantOptions(**shared))
        self.steps, self.counts = 0, {"commands": 0, "dropped": 0, "timeouts": 0}
        self._names = mocap.Options()
        self._rng = np.random.default_rng([options.seed, 1])
        self._ready()

    def _ready(self) -> None:
        o = self.options
        self._commands = Line[bytes](o.delay, o.loss, self._rng)
        self._states = Line[bytes](o.delay, o.loss, self._rng)
        self._frames = Line[list[list[bytes]]](o.mocap_latency, o.mocap_dropout, self._rng)
        self._next_frame = 0.0
        self._commanded: float | None = None  # when; None: damped by itself
        self._pressed, self._pressed_until = frozenset[str](), 0.0
        self._let_go = False
        if o.gantry > 0:
            self.plant.held_until = float("inf")

    # -- what an operator does --------------------------------------------------------------------------------

    def reset(self, episode: int | None = None) -> None:
        """Puts robot and object where the motion starts, held and damped, at time 0; the next episode if absent."""
        self.plant.reset(episode)
        self._ready()

    def release(self) -> None:
        """Lets go of the root."""
        self.plant.held_until, self._let_go = self.plant.time(), True

    def press(self, button: str) -> None:
        """Presses a button of the remote control.

        Raises:
            ValueError: if there is no such button.
        """
        if button not in g1.BUTTONS:
            raise ValueError(f"no button {button!r}; there is {', '.join(g1.BUTTONS)}")
        self._pressed, self._pressed_until = frozenset((button,)), self.plant.time() + PRESS

    def obey(self, text: str) -> str:
        """Does what a message asks: `reset [EPISODE]`, `release`, `press BUTTON`; returns an answer."""
        verb, _, rest = text.partition(" ")
        try:
            if verb == "reset":
                self.reset(int(rest) if rest else None)
            elif verb == "release" and not rest:
                self.release()
            elif verb == "press":
                self.press(rest)
            else:
                raise ValueError(f"expected reset [EPISODE], release or press BUTTON, got {text!r}")
        except ValueError as error:
            return f"refused: {error}"
        self._note(text)
        return DONE

    # -- the wire ---------------------------------------------------------------------------------------------

    def hear(self, payload: bytes) -> None:
        """Takes a LowCmd_ in, which reaches the motor drivers after the network's delay, or never."""
        self._commands.put(self.plant.time(), lambda: payload)

    def step(self) -> tuple[list[bytes], list[list[bytes]]]:
        """One step of the physics; LowState_ messages and poses that have arrived at the other end by then."""
        plant, options, now = self.plant, self.options, self.plant.time()
        for _, payload in self._commands.due(now):
            self._follow(payload, now)
        if self._commanded is not None and now - self._commanded > options.command_timeout:
            self._commanded = None
            self.counts["timeouts"] += 1
            plant.damp()
            self._note(f"no command for {options.command_timeout:g} s: damping")
        plant.wait(now + plant.model.opt.timestep)
        now = plant.time()
        if now >= plant.held_until and not self._let_go:
            self._let_go = True
            if options.gantry > 0:
                self._note("the gantry lets go")
        self.steps += 1
        self._states.put(now, lambda: self._state(now))
        if now >= self._next_frame - 1e-9:
            self._next_frame = now + 1.0 / options.mocap_rate if options.mocap_rate else now
            self._frames.put(now, self._frame)
        frames = [message for _, frame in self._frames.due(now) for message in frame]
        return [payload for _, payload in self._states.due(now)], frames

    def _follow(self, payload: bytes, now: float) -> None:
        """What the motor drivers do with a command."""
        message = g1.unpack(payload, g1.LOW_CMD)
        if message is None:
            self.counts["dropped"] += 1
            return
        self.counts["commands"] += 1
        motors = message["motor_cmd"][self._motors]
        on = motors["mode"] == 1
        q, dq, tau, kp, kd = (motors[name].astype(float) for name in ("q", "dq", "tau", "kp", "kd"))
        if self._commanded is None:
            self._note("commanded")
        self._commanded = now
        self.plant.servo(q, kp * on, kd * on, dq, tau * on)
        if (kp * on).any() and np.isinf(self.plant.held_until):
            self.plant.held_until = now + self.options.gantry
            self._note(f"stiffness; the gantry holds for another {self.options.gantry:g} s")

    def _state(self, now: float) -> bytes:
        measured = self.plant.onboard()
        message = np.zeros((), g1.LOW_STATE)
        message["mode_machine"], message["tick"] = MODE_MACHINE, round(now * 1e3)
        message["imu_state"]["quaternion"] = measured["root_quat_w"]
        message["imu_state"]["gyroscope"] = measured["root_ang_vel_b"]
        motors = message["motor_state"]
        motors["mode"][self._motors], motors["temperature"][self._motors] = 1, WARM
        motors["q"][self._motors], motors["dq"][self._motors] = measured["joint_pos"], measured["joint_vel"]
        message["wireless_remote"] = g1.remote_of(self._pressed if now < self._pressed_until else frozenset())
        return g1.pack(message)

    def _frame(self) -> list[list[bytes]]:
        """A frame of motion capture: a message for each rigid body."""
        half, rng, names = self.options.mocap_noise, self._rng, self._names
        called = {"root": names.root_name, "object": names.object_name, "part": names.part_name}
        messages, stamp = [], time.time()
        for body, (pos, quat) in self.plant.poses().items():
            turn = quat_from_rotation_vector(rng.uniform(-half, half, 3))
            pose = mocap.Pose(pos + rng.uniform(-half, half, 3), quat_multiply(quat, turn))
            messages.append(mocap.encode(called[body], pose, stamp=stamp))
        return messages

    def _note(self, text: str) -> None:
        self._say(f"{self.plant.time():8.3f} s: {text}")


@dataclass
class Network:
    """Where a simulated robot is to be found."""

    interface: str = "lo"  # network interface
    domain: int = 0  # id of the DDS domain
    poses: str = "tcp://127.0.0.1:5556"  # where poses are published
    control: str = "tcp://127.0.0.1:5557"  # where reset, release and press are asked for
    service: str = ""  # name of a motion service of the robot's own that has to be released
    realtime: float = 1.0  # simulated s per s of the wall's clock
    seconds: float = 0.0  # simulated s after which it ends; 0: never


def serve(simulator: Simulator, network: Network) -> float:
    """Runs a simulated robot until an interrupt or the given time.

    Returns:
        s by which it was behind the wall's clock and did not catch up.

    Raises:
        ImportError: without the extra `robot`.
        RobotError: if DDS or ZMQ cannot use what the options say, or `realtime` makes no sense.
    """
    from hdmi.deploy import dds
    from hdmi.deploy.motion_switcher import SimulatedSwitcher

    if network.realtime <= 0:
        raise RobotError(f"realtime: expected more than 0, got {network.realtime:g}")
    bus = dds.Bus(network.interface, network.domain)
    port, switcher = dds.Port(bus, g1.STATE_TOPIC, g1.COMMAND_TOPIC), SimulatedSwitcher(bus, network.service)
    with (
        mocap.socket_of("PUB", network.poses, "poses") as poses,
        mocap.socket_of("REP", network.control, "control") as control,
        Interrupts() as interrupts,
    ):
        return _steps(simulator, network, interrupts, port, switcher, poses, control)


def _steps(
    simulator: Simulator, network: Network, interrupts: Interrupts, port: Any, switcher: Any, poses: Any, control: Any
) -> float:
    timestep, lost = simulator.plant.model.opt.timestep, 0.0
    due = time.perf_counter()
    while not interrupts.asked and not (network.seconds and simulator.steps * timestep >= network.seconds):
        for payload in port.receive(0.0):
            simulator.hear(payload)
        switcher.answer()
        if control.poll(0):
            control.send_string(simulator.obey(control.recv_string()))
        states, frames = simulator.step()
        for state in states:
            port.send(state)
        for parts in frames:
            poses.send_multipart(parts)
        due += timestep / network.realtime
        ahead = due - time.perf_counter()
        if ahead > 0:
            time.sleep(ahead)
        elif ahead < -_BEHIND:
            lost, due = lost - ahead, due - ahead
    return lost


def ask(control: str, text: str, timeout: float = 5.0) -> str:
    """Asks a simulated robot that runs for something; returns its answer.

    Args:
        control: its address.
        text: see `Simulator.obey`.
        timeout: s.

    Raises:
        ImportError: without the extra `robot`.
        RobotError: if it does not answer.
    """
    with mocap.socket_of("REQ", control, "control") as socket:
        socket.send_string(text)
        if not socket.poll(timeout * 1e3):
            raise RobotError(f"control: {control}: no answer for {timeout:g} s; is simulate_robot running?")
        return socket.recv_string()
