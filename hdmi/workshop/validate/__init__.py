"""Whether a motion is worth training on: geometry, limits, dynamics and contact labels held against a table of limits.

```python
report = validate_motion(load_motion(path), object=..., scenery=..., effectors=...)
report.verdict      # "good", "usable" or "bad"
report.reasons      # what, how much, where, in which frames
```
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

from hdmi.assets import Effector, ObjectConfig, RobotConfig, SceneryConfig, g1_robot
from hdmi.config import ConfigError
from hdmi.motion.dynamics import Dynamics, inverse_dynamics
from hdmi.motion.format import Motion, MotionError
from hdmi.motion.playback import make_playback
from hdmi.workshop.validate import checks
from hdmi.workshop.validate.limits import LIMITS, Limit
from hdmi.workshop.validate.report import Fault, Finding, Report, Series, Verdict, judge

__all__ = [
    "LIMITS",
    "Dynamics",
    "Fault",
    "Finding",
    "Limit",
    "Report",
    "Series",
    "Verdict",
    "inverse_dynamics",
    "unreadable",
    "validate_motion",
]


def validate_motion(
    motion: Motion,
    *,
    robot: RobotConfig | None = None,
    object: ObjectConfig | None = None,
    scenery: Sequence[SceneryConfig] = (),
    effectors: Sequence[Effector] = (),
    limits: Mapping[str, Limit] = LIMITS,
    tolerance: float = 0.0,
    reduce: Literal["mean", "max"] = "mean",
) -> Report:
    """Checks a motion in the scene of its task.

    Without an object or scenery only the robot on the floor is checked. A motion that does not fit the task (names,
    shapes, number of label columns) is bad for that reason alone.

    Args:
        robot: how the G1 is built; its feet are taken as four points each whatever they are, and joints that it holds
            where the motion has them.
        limits: instead of `LIMITS`.
        tolerance: how far from its contact point an effector may be at no cost in the task's interaction reward, m.
        reduce: the task's, too; `max`: of several effectors that are to touch, the nearest one counts.

    Raises:
        ConfigError: for another robot than the G1, whose limits are held against it.
        ValueError: if the scene itself cannot be built, which says nothing about the motion.
    """
    if robot is not None and robot.model != g1_robot():
        raise ConfigError(f"robot.model: motions are validated against the limits of the G1, not of {robot.model.name}")
    # one geom per point of a foot tells a foot that rolls over its toes from one that slides
    robot = replace(robot or RobotConfig(), feet="sphere", held=())
    try:
        playback = make_playback(motion, robot=robot, object=object, scenery=scenery, effectors=effectors)
    except MotionError as error:
        return unreadable(motion.name, error, motion)
    dynamics = inverse_dynamics(playback)
    series = {
        **checks.consistency(motion, playback),
        **checks.limits(playback),
        **checks.smoothness(motion),
        "torque": checks.torque(dynamics),
        **checks.ground(playback, dynamics),
        **checks.objects(playback, dynamics),
        **checks.labels(playback, tolerance, reduce),
    }
    described = [item.name for item in scenery] + ([object.name] if object is not None else [])
    notes = checks.missing_parts(motion, playback, described)
    if effectors and motion.object_contact is None:
        notes.append("no contact labels: none is taken to be intended")
    findings = tuple(judge(check, series.get(check), limit) for check, limit in limits.items())
    return Report(motion.name, motion.num_frames, motion.fps, findings, tuple(notes))


def unreadable(name: str, error: Exception, motion: Motion | None = None) -> Report:
    """The report on a motion that cannot be read, or not for its task."""
    finding = Finding("format", "bad", None, "", 0.0, None, str(error))
    return Report(name, motion.num_frames if motion else 0, motion.fps if motion else 0.0, (finding,))
