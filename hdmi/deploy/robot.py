"""What the runner asks of a robot, real or simulated. numpy only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np


class RobotError(RuntimeError):
    """A robot that cannot be reached or does not do what it is told; the message is one line."""


@dataclass(frozen=True)
class Reading:
    """What the sensors have measured last, each at a time of its own.

    Args:
        time: of the reading, s, on the robot's clock.
        sensors: by the names of `hdmi.deploy.format.SENSORS`: `joint_pos`, `joint_vel` [J], in the order of the
            robot's `joint_names`; `root_quat_w` [4] (wxyz), `root_ang_vel_b` [3]; of motion capture `root_pos_w` [3],
            `object_pos_w` [3], `object_quat_w` [4] and `object_joint_pos` [1]. Float arrays that nobody writes to
            afterwards. A sensor that the robot lacks, or that has measured nothing yet, is absent.
        stamps: when each of these sensors measured, s, on the robot's clock.
        requests: states that the operator has asked for since the last reading, on a remote control of the robot:
            names of `hdmi.deploy.runner.State`, such as `damping`, `to_start`, `run`.
        faults: what is wrong by the robot's own account, a line each, such as a hot motor; any ends in damping.
    """

    time: float
    sensors: Mapping[str, np.ndarray]
    stamps: Mapping[str, float]
    requests: tuple[str, ...] = ()
    faults: tuple[str, ...] = field(default=())


class Robot(Protocol):
    """A robot with position servos.

    The runner calls from one thread, and `read`, `command`, `wait` in turn. A robot is in damping when it is made, and
    its module, `hdmi.deploy.robots.<name>`, has

    - `Options`: a dataclass of what can be set, as `key=value` on the command line, fields of type str, int, float,
      bool or a list of one of these, or one of these or None, all with defaults;
    - `connect(description, folder, options) -> Robot`: from the `hdmi.deploy.description.Description` of the policy
      that is to run, the folder of its files, or its scene's file where that lies elsewhere, and the options.

    Attributes:
        joint_names: [J], the order of joints in readings and commands.
        servo_dt: s between commands; the runner repeats its target that often between ticks of the policy.
    """

    joint_names: tuple[str, ...]
    servo_dt: float

    def time(self) -> float:
        """The robot's clock, s; never goes backwards."""
        ...

    def wait(self, until: float) -> None:
        """Returns when `time()` has reached `until`, at once if it has passed; a simulation advances to it.

        An interrupt (`KeyboardInterrupt`) may end it early.
        """
        ...

    def read(self) -> Reading:
        """The latest measurements, without waiting for new ones; `stamps` show their age.

        Raises:
            RobotError: if the robot is lost.
        """
        ...

    def command(self, target: np.ndarray, stiffness: np.ndarray, damping: np.ndarray) -> None:
        """What the servos do from now on: torque = stiffness (target - q) - damping qd, within the motors' limits.

        Args:
            target: rad [J].
            stiffness: N m/rad [J].
            damping: N m s/rad [J].

        Raises:
            RobotError: if the robot is lost.
        """
        ...

    def damp(self) -> None:
        """Damping without stiffness from now on, until the next command. May be called at any time, repeatedly."""
        ...

    def remarks(self) -> tuple[str, ...]:
        """What the operator should know of the wire when a run is over, a line each, such as lost messages."""
        ...

    def close(self) -> None:
        """Damps and lets go of the robot. May be called repeatedly."""
        ...
