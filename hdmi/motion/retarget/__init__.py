"""From a person's motion to the robot's (extra `retarget`)."""

from hdmi.motion.retarget.report import RetargetReport
from hdmi.motion.retarget.retarget import RetargetOptions, retarget

__all__ = ["RetargetOptions", "RetargetReport", "retarget"]
