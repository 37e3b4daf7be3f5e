"""From a person's motion to the robot's (extra `retarget`)."""

from hdmi.workshop.retarget.measures import RetargetReport
from hdmi.workshop.retarget.pipeline import RetargetOptions, retarget

__all__ = ["RetargetOptions", "RetargetReport", "retarget"]
