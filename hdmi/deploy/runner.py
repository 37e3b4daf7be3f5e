"""Drives a robot by a policy: a loop at the policy's rate, states between damping and the motion, and a log."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Protocol

import numpy as np

from hdmi.deploy.controls import QUIT, Controls, Interrupts
from hdmi.deploy.description import Description
from hdmi.deploy.log import Log
from hdmi.deploy.robot import Reading, Robot, RobotError
from hdmi.deploy.rotations import quat_angle
from hdmi.deploy.safety import Guard, Limits


class State(StrEnum):
    """What the robot does. Whatever goes wrong in another state than damping leads there."""

    DAMPING = "damping"  # no stiffness: it sinks or hangs
    TO_START = "to_start"  # slowly to the first frame's joint positions, and holds them
    RUN = "run"  # the policy
    HOLD = "hold"  # the motion's last frame, by the policy; from elsewhere the last targets


# What may be asked for, and in which states.
ALLOWED = {
    State.TO_START: (State.DAMPING, State.HOLD),
    State.RUN: (State.TO_START,),
    State.HOLD: (State.RUN, State.TO_START),
}


@dataclass(frozen=True)
class Options:
    """How the states follow each other."""

    to_start: float = 3.0  # s from the present joint positions to those of the first frame
    settle: float = 0.5  # s at the first frame before the policy may run
    hold: float = 1.0  # s that the policy goes on at the last frame; with auto, then damping
    auto: bool = False  # states follow by themselves: to the start, the motion, hold, damping
    patience: float = 5.0  # s that auto waits for sensors and for the robot to be at the start
    start_joints: float = 0.3  # rad that a joint may be off the first frame when the policy begins
    start_root: float = 0.5  # m that the root may be off, if the policy depends on where it is
    start_heading: float = 0.5  # rad, likewise
    start_object: float = 0.3  # m that the object may be off, likewise


class RunnablePolicy(Protocol):
    """What the runner needs of a policy: see `hdmi.deploy.policy.Policy`.

    Attributes:
        description: of robot and motion.
        sensors: that it depends on.
        frame: of the last call.
        finished: whether that was the last frame.
        digest: says in the log which policy it was.
    """

    description: Description
    sensors: tuple[str, ...]
    digest: str

    @property
    def frame(self) -> int: ...

    @property
    def finished(self) -> bool: ...

    def reset(self, start_frame: int = 0) -> None: ...

    def __call__(self, sensors: dict[str, np.ndarray]) -> np.ndarray: ...


# Called after each tick of the policy with its frame; what it returns ends the run as a failure of that name.
Watch = Callable[[int], str | None]


class Runner:
    """One run on a robot, from damping to damping.

    Args:
        policy: see `RunnablePolicy`.
        robot: see `hdmi.deploy.robot.Robot`; is not closed here.
        options, limits: see there.
        controls: where requests come from besides the robot's remote control.
        watch: judges each tick of the policy.
        say: is told events, as lines of text.

    Attributes:
        state: see `State`.
        log: of all ticks so far.
        guard: with counts of what was limited, late or stale.
        failure: why the run ended before its end, or None.

    Raises:
        PolicyError: if the robot lacks joints of the policy.
    """

    def __init__(
        self,
        policy: RunnablePolicy,
        robot: Robot,
        options: Options | None = None,
        limits: Limits | None = None,
        controls: Sequence[Controls] = (),
        watch: Watch | None = None,
        say: Callable[[str], object] = lambda text: None,
    ):
        self.policy, self.robot = policy, robot
        self.options, self.limits = options or Options(), limits or Limits()
        self.controls, self._watch, self._say = controls, watch, say
        self.description = description = policy.description
        # the policy's joints among the robot's
        self._index = description.indices_of(robot.joint_names, "robot")
        self.guard = Guard(description, policy.sensors, self.limits)
        self.state = State.DAMPING
        self.failure: str | None = None
        self.log = Log(
            {
                "joint_names": list(description.joint_names),
                "states": [str(state) for state in State],
                "policy": policy.digest,
                "task": description.task,
                "control_dt": description.control_dt,
                "options": asdict(self.options),
                "limits": asdict(self.limits),
            }
        )
        self._ended = self._finished = False
        self._requests: tuple[str, ...] = ()
        self._faults: tuple[str, ...] = ()
        self._late = 0.0  # s by which the present tick comes after its time
        self._reached_end = False
        self._entered = self._began = 0.0
        self._from = np.zeros(len(description.joint_names))
        self._target: np.ndarray | None = None  # what the servos are to follow until the next tick
        self._now, self._sensors = 0.0, dict[str, np.ndarray]()
        self._first, self._fresh = State.DAMPING, False

    # -- the loop ---------------------------------------------------------------------------------------------

    def run(self, first: State = State.DAMPING, log: str | Path | None = None) -> Log:
        """Runs until the end is asked for, or everything has been done that `options.auto` does by itself.

        However it ends, by an interrupt or any error, the robot is damped first, and then the log is written.

        Args:
            first: RUN begins with the policy at once, for a simulated robot that already is at the start.
            log: file to write.

        Raises:
            RobotError: if the robot is lost, or `options.auto` has waited in vain.
            OSError: if the log cannot be written.
        """
        with Interrupts() as interrupts:
            try:
                try:
                    self._loop(first, interrupts)
                except KeyboardInterrupt:
                    self.failure = "interrupted"
                except BaseException as error:
                    self.failure = f"{type(error).__name__}: {error}"
                    raise
                finally:
                    self._finish(interrupts, log)
            finally:
                # once more, if the one interrupt that is raised came just before
                self._finish(interrupts, log)
        return self.log

    def _loop(self, first: State, interrupts: Interrupts) -> None:
        self._first = first
        due = self._began = self.robot.time()
        while True:
            self._tick()
            if interrupts.asked:
                self._fail("interrupted")
            if self._ended:
                return
            due = self._wait(due)

    def _finish(self, interrupts: Interrupts, log: str | Path | None) -> None:
        """Damps, and then writes the log; a second time does nothing."""
        if self._finished:
            return
        before, self.state = self.state, State.DAMPING
        if before is not State.DAMPING:
            self.log.events.append((self._now, f"{before} -> damping: {self.failure}"))
        errors = interrupts.shield([self.robot.damp, *([] if log is None else [lambda: self.log.write(log)])])
        self._finished = True
        if errors:
            raise errors[0]

    @property
    def completed(self) -> bool:
        """Whether the motion came to its end without failure."""
        return self._reached_end and self.failure is None

    def _wait(self, due: float) -> float:
        """Until the next tick, repeating the command as often as the servos want it; when that tick is due."""
        period, every = self.description.control_dt, self.robot.servo_dt
        after = due + period
        repeats = 0 if self._target is None else max(round(period / every) - 1, 0)
        for k in range(1, repeats + 1):
            at = due + k * every
            if self.robot.time() > at + every:  # too late for this one
                continue
            self.robot.wait(at)
            self._command(self._joints(self._read().sensors))
        self.robot.wait(after)
        self._late = max(self.robot.time() - after, 0.0)
        # a tick that was missed is not made up for: the motion waits
        return after if self._late < period else after + self._late

    def _tick(self) -> None:
        clock = time.perf_counter()
        reading = self._read()
        sensors = self.guard.accept(replace(reading, faults=self._faults), self._late)
        for name in ("joint_pos", "joint_vel"):
            if name in sensors:
                sensors[name] = sensors[name][self._index]
        self._now, self._sensors = reading.time, sensors
        if self.state is not State.DAMPING and (trouble := self.guard.trouble(sensors)):
            self._fail(trouble)
        for request in (*self._requests, *(name for source in self.controls for name in source.requests())):
            self._obey(request)
        self._requests, self._faults = (), ()
        self._go_on()
        target = self._act(sensors)
        row: dict[str, object] = {
            "time": reading.time, "late": self._late, "state": list(State).index(self.state),
            "frame": -1, "reset": False,
        }  # fmt: skip
        if target is not None and self._policy_acts:
            row |= {"frame": self.policy.frame, "reset": self._fresh, "target": target}
            self._fresh = False
        self._target = target
        if target is None:
            self.robot.damp()
            row |= {"command": np.full(len(self._index), np.nan)}
        else:
            command = self._command(sensors)
            row |= {"command": command, "stiffness": self.description.stiffness, "damping": self.description.damping}
        row |= {f"sensors/{name}": value for name, value in sensors.items()}
        row |= {f"stamps/{name}": float(reading.stamps.get(name, np.nan)) for name in sensors}
        self.log.add(row | {"ms": (time.perf_counter() - clock) * 1e3})
        if self.state is State.RUN and self._watch is not None and (verdict := self._watch(self.policy.frame)):
            self._fail(verdict)
        if self.state is State.RUN and self.policy.finished:
            self._reached_end = True
            self._enter(State.HOLD)

    def _read(self) -> Reading:
        """A reading, of which requests and faults are kept until the next tick."""
        reading = self.robot.read()
        self._requests, self._faults = self._requests + reading.requests, self._faults + reading.faults
        return reading

    def _joints(self, sensors: object) -> dict[str, np.ndarray]:
        """Positions and velocities of the policy's joints between ticks; the last ones where they are not finite."""
        found = {}
        for name in ("joint_pos", "joint_vel"):
            value = np.asarray(sensors[name])[self._index] if name in sensors else np.array(np.nan)  # type: ignore
            found[name] = value if np.isfinite(value).all() else self._sensors[name]
        return found

    def _command(self, sensors: dict[str, np.ndarray]) -> np.ndarray:
        """Sends the present target, limited; returns what was sent. rad [J]"""
        assert self._target is not None
        description, count = self.description, len(self.robot.joint_names)
        limited = self.guard.limit(self._target, description.stiffness, description.damping, sensors)
        if count == len(self._index) and (self._index == np.arange(count)).all():
            self.robot.command(limited, description.stiffness, description.damping)
            return limited
        # joints that the policy does not know are damped
        full, stiffness = np.zeros(count), np.zeros(count)
        damping = np.full(count, float(description.damping.min()))
        full[self._index], stiffness[self._index] = limited, description.stiffness
        damping[self._index] = description.damping
        self.robot.command(full, stiffness, damping)
        return limited

    # -- states -----------------------------------------------------------------------------------------------

    def _note(self, text: str) -> None:
        self.log.note(self.robot.time(), text)
        self._say(text)

    def _fail(self, reason: str) -> None:
        """Damping, for a reason; the run ends where nobody could ask for more."""
        if self.failure is None:
            self.failure = reason
        self._enter(State.DAMPING, reason)
        self._ended = self._ended or self.options.auto or self._first is State.RUN or reason == "interrupted"

    def _enter(self, state: State, reason: str = "") -> None:
        if state is State.DAMPING:  # first of all: words may be slow
            self._target = None
            self.robot.damp()
        before, self.state, self._entered = self.state, state, self._now
        if state is not before:
            self._note(f"{before} -> {state}" + (f": {reason}" if reason else ""))
        if state is State.TO_START:
            self._from = self._sensors["joint_pos"].astype(float)
        elif state is State.RUN:
            self.policy.reset()
            self._fresh = True
        if state in (State.TO_START, State.RUN):
            self.failure, self._reached_end = None, False

    def _obey(self, request: str) -> None:
        """Does what the operator asks, or says why not."""
        if request == QUIT:
            self._enter(State.DAMPING, "quit")
            self._ended = True
            return
        if request not in list(State):
            self._note(f"{request}: there is no such state")
            return
        state = State(request)
        if reason := self._refuse(state):
            self._note(f"{state} refused: {reason}")
        else:
            self._enter(state, "asked for")

    def _refuse(self, state: State) -> str | None:
        """Why a state cannot be entered now, or None."""
        if state is State.DAMPING:
            return None
        if self.state not in ALLOWED[state]:
            return f"from {' or '.join(ALLOWED[state])} only, not from {self.state}"
        if state is State.HOLD:
            return None
        if (reason := self.guard.not_ready(self._sensors)) or state is State.TO_START:
            return reason
        if (left := self._entered + self.options.to_start + self.options.settle - self._now) > 1e-9:
            return f"not at the start yet, {left:.1f} s left"
        return self._off_start()

    def _off_start(self) -> str | None:
        """How robot and object are off the motion's first frame, or None."""
        sensors, start, options, needed = self._sensors, self.description.start, self.options, self.policy.sensors
        off = np.abs(sensors["joint_pos"] - start["joint_pos"])
        if off.max() > options.start_joints:
            i = int(off.argmax())
            return f"{self.description.joint_names[i]} is {off[i]:.2f} rad off the first frame"
        for name, most in (("root_pos_w", options.start_root), ("object_pos_w", options.start_object)):
            if name in needed and (far := float(np.linalg.norm(sensors[name] - start[name]))) > most:
                return f"{name} is {far:.2f} m off the first frame, at {np.array2string(sensors[name], precision=2)}"
        angle = float(quat_angle(sensors["root_quat_w"].astype(float), start["root_quat_w"]))
        if "root_pos_w" in needed and angle > options.start_heading:
            return f"root_quat_w is {angle:.2f} rad off the first frame"
        return None

    def _go_on(self) -> None:
        """States that follow by themselves."""
        if not self.log.rows and self._first is State.RUN:
            if reason := self.guard.not_ready(self._sensors) or self._off_start():
                self._fail(reason)
            else:
                self._enter(State.RUN)
            return
        if self.state is State.HOLD and self._reached_end and self._now - self._entered >= self.options.hold - 1e-9:
            if self.options.auto or self._first is State.RUN:
                self._enter(State.DAMPING, "the motion is over")
                self._ended = True
            return
        wanted = {State.DAMPING: State.TO_START, State.TO_START: State.RUN}.get(self.state)
        if not self.options.auto or self._ended or wanted is None:
            return
        if (reason := self._refuse(wanted)) is None:
            self._enter(wanted)
            return
        since = self._entered if self.state is State.TO_START else self._began
        allowed = self.options.patience + (
            self.options.to_start + self.options.settle if self.state is State.TO_START else 0.0
        )
        if self._now - since > allowed:
            self._enter(State.DAMPING, reason)
            raise RobotError(f"{wanted} refused for {self.options.patience:g} s: {reason}")

    def _act(self, sensors: dict[str, np.ndarray]) -> np.ndarray | None:
        """The state's target, rad [J], or None for damping."""
        if self.state is State.TO_START:
            share = min((self._now - self._entered) / self.options.to_start, 1.0) if self.options.to_start > 0 else 1.0
            smooth = share * share * (3.0 - 2.0 * share)
            return self._from + smooth * (self.description.start["joint_pos"] - self._from)
        if self._policy_acts:
            try:
                return self.policy({name: sensors[name] for name in self.policy.sensors})
            except (ArithmeticError, ValueError) as error:
                self._fail(f"the policy fails: {error}")
                return None
        return self._target if self.state is State.HOLD else None

    @property
    def _policy_acts(self) -> bool:
        return self.state is State.RUN or (self.state is State.HOLD and self._reached_end)
