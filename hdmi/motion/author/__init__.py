"""Reference motions without a recording: plans of keyframes, solved with inverse kinematics."""

from hdmi.motion.author.author import Authored, author_motion
from hdmi.motion.author.plan import Plan, PlanError, find_plan, load_plan, parse_plan

__all__ = ["Authored", "Plan", "PlanError", "author_motion", "find_plan", "load_plan", "parse_plan"]
