"""What a runner watches and limits: age and sanity of sensors, range, speed and torque of joints, tilt, lateness."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from hdmi.deploy.description import Description
from hdmi.deploy.format import SENSORS
from hdmi.deploy.robot import Reading
from hdmi.deploy.rotations import tilt_of

ALWAYS = ("joint_pos", "joint_vel", "root_quat_w")  # what limits need, whatever the policy does


@dataclass(frozen=True)
class Limits:
    """Where a runner limits, and where it gives up and damps."""

    target_margin: float | None = None  # rad that targets keep off the ends of the joint ranges, if they are to
    range_margin: float = 0.1  # rad beyond the range at which a measured joint means damping
    velocity: float = 1.0  # share of the motors' velocity limits at which a measured speed means damping
    effort: float = 1.0  # share of the effort limits that a target may ask for; 0 leaves the limit to the motors
    tilt: float = 0.7  # rad that the root may be tilted more than the motion ever is; beyond it: damping
    encoder_age: float = 0.05  # s after which measurements of encoders and IMU are stale
    mocap_age: float = 0.1  # s after which those of motion capture are
    late: float = 0.01  # s after its time that a tick counts as late
    stale_ticks: int = 5  # ticks in a row with stale sensors that mean damping
    bad_ticks: int = 3  # ticks in a row with a sensor that is not finite that mean damping
    late_ticks: int = 5  # late ticks in a row that mean damping


@dataclass
class Counts:
    """How many ticks so far had what."""

    stale: int = 0
    bad: int = 0
    late: int = 0
    clamped: int = 0  # a target was beyond a joint's range
    limited: int = 0  # a target asked for more than the effort limit


class Guard:
    """Judges readings and limits targets.

    Args:
        description: of the policy.
        sensors: that the policy needs; encoders and the root's orientation are needed anyway.
        limits: see `Limits`.

    Attributes:
        counts: see `Counts`.
        ages: of the needed sensors at the last reading, s.
    """

    def __init__(self, description: Description, sensors: Iterable[str], limits: Limits):
        self.description, self.limits = description, limits
        self.needed = tuple(dict.fromkeys((*ALWAYS, *sensors)))
        # soft servos are sent beyond a range to get torque within it, which `effort` limits
        margin = -np.inf if limits.target_margin is None else limits.target_margin
        self.low, self.high = description.joint_ranges[:, 0] + margin, description.joint_ranges[:, 1] - margin
        self.counts = Counts()
        self.ages: dict[str, float] = {}
        self._last: dict[str, np.ndarray] = {}
        self._in_a_row = {"stale": 0, "bad": 0, "late": 0}
        self._faults: tuple[str, ...] = ()
        self._stale: list[str] = []
        self._bad: list[str] = []

    def max_age(self, sensor: str) -> float:
        """s after which a sensor is stale."""
        of_mocap = SENSORS[sensor]["source"].startswith("motion capture")
        return self.limits.mocap_age if of_mocap else self.limits.encoder_age

    def accept(self, reading: Reading, late: float) -> dict[str, np.ndarray]:
        """What to go by in this tick: the reading's sensors, for those that are not finite their last good values.

        Args:
            late: s by which the tick comes after its time.

        Returns:
            float32 by name; what has never been measured is absent.
        """
        self._bad = [name for name in reading.sensors if not _sane(name, reading.sensors[name])]
        for name, value in reading.sensors.items():
            if name not in self._bad:
                self._last[name] = np.asarray(value, dtype=np.float32)
        self.ages = {name: reading.time - reading.stamps[name] for name in self.needed if name in reading.stamps}
        # an age that is no number is none to rely on
        self._stale = [name for name, age in self.ages.items() if not age <= self.max_age(name)]
        self._faults = reading.faults
        self._count("stale", bool(self._stale))
        self._count("bad", bool(self._bad))
        self._count("late", late > self.limits.late)
        return {name: self._last[name] for name in reading.sensors if name in self._last}

    def _count(self, what: str, now: bool) -> None:
        setattr(self.counts, what, getattr(self.counts, what) + now)
        self._in_a_row[what] = (self._in_a_row[what] + 1) * now

    def not_ready(self, sensors: dict[str, np.ndarray]) -> str | None:
        """Why servos must not be switched on now, or None."""
        if missing := [name for name in self.needed if name not in sensors]:
            return f"no measurement yet of {', '.join(missing)}"
        if self._stale:
            return self._stale_text()
        if self._bad:
            return f"not finite: {', '.join(self._bad)}"
        return self.trouble(sensors)

    def trouble(self, sensors: dict[str, np.ndarray]) -> str | None:
        """Why to damp now, or None."""
        limits, description = self.limits, self.description
        if self._faults:
            return f"the robot says: {'; '.join(dict.fromkeys(self._faults))}"
        if missing := [name for name in self.needed if name not in sensors]:
            return f"no measurement of {', '.join(missing)}"
        if self._in_a_row["bad"] > limits.bad_ticks:
            return f"not finite for {self._in_a_row['bad']} ticks: {', '.join(self._bad)}"
        if self._in_a_row["stale"] > limits.stale_ticks:
            return f"{self._stale_text()}, for {self._in_a_row['stale']} ticks"
        if self._in_a_row["late"] > limits.late_ticks:
            return f"late by more than {limits.late * 1e3:g} ms for {self._in_a_row['late']} ticks"
        beyond = np.maximum(
            description.joint_ranges[:, 0] - sensors["joint_pos"], sensors["joint_pos"] - description.joint_ranges[:, 1]
        )
        if (beyond > limits.range_margin).any():
            i = int(beyond.argmax())
            return f"{description.joint_names[i]} is {beyond[i]:.2f} rad beyond its range"
        share = np.abs(sensors["joint_vel"]) / description.velocity_limits
        if (share > limits.velocity).any():
            i = int(share.argmax())
            return f"{description.joint_names[i]} turns at {sensors['joint_vel'][i]:.1f} rad/s"
        tilt = float(tilt_of(sensors["root_quat_w"]))
        if tilt > description.max_tilt + limits.tilt:
            return f"{description.root} is tilted by {tilt:.2f} rad"
        return None

    def _stale_text(self) -> str:
        return "stale: " + ", ".join(f"{name} ({self.ages[name]:.3f} s old)" for name in self._stale)

    def limit(
        self, target: np.ndarray, stiffness: np.ndarray, damping: np.ndarray, sensors: dict[str, np.ndarray]
    ) -> np.ndarray:
        """A target within the joint ranges, if these are limits, for no more torque than the motors have. rad [J]

        The torque is that of the servo at the measured state, `kp (target - q) - kd qd`.
        """
        inside = np.clip(np.asarray(target, dtype=float), self.low, self.high)
        self.counts.clamped += bool((inside != target).any())
        if self.limits.effort <= 0:
            return inside
        pos, vel = sensors["joint_pos"].astype(float), sensors["joint_vel"].astype(float)
        torque = stiffness * (inside - pos) - damping * vel
        most = self.limits.effort * self.description.effort_limits
        over = (np.abs(torque) > most) & (stiffness > 0)
        if not over.any():
            return inside
        self.counts.limited += 1
        limited = inside.copy()
        allowed = np.clip(torque, -most, most)
        limited[over] = pos[over] + (allowed[over] + damping[over] * vel[over]) / stiffness[over]
        return limited


def _sane(name: str, value: np.ndarray) -> bool:
    """Whether a measurement can be one: finite, and of length one where it is a quaternion."""
    if not np.isfinite(value).all():
        return False
    return "quat" not in name or abs(float(np.linalg.norm(value)) - 1.0) < 0.1
