"""Evaluation of policies by the paper's protocol, and videos of them."""

from hdmi.evaluation.protocol import EvalResult, evaluate_checkpoint, evaluate_policy
from hdmi.evaluation.video import render_checkpoint

__all__ = ["EvalResult", "evaluate_checkpoint", "evaluate_policy", "render_checkpoint"]
