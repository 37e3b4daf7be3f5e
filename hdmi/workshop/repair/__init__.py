"""Mends a reference's geometry: feet on the ground, effectors on the object, the object on its support (`retarget`)."""

from hdmi.workshop.repair.comparison import Comparison
from hdmi.workshop.repair.pipeline import Repair, repair_motion

__all__ = ["Comparison", "Repair", "repair_motion"]
