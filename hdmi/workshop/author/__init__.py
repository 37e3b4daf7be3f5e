"""Reference motions without a recording: plans of keyframes, solved with inverse kinematics."""

from hdmi.workshop.author.plan import Plan, PlanError, find_plan, load_plan, parse_plan
from hdmi.workshop.author.solve import Authored, author_motion

__all__ = ["Authored", "Plan", "PlanError", "author_motion", "find_plan", "load_plan", "parse_plan"]
