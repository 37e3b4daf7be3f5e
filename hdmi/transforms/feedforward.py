"""Where servos are sent to follow the reference by themselves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
from tensordict import NestedKey
from torch import Tensor

from hdmi.functional import feedforward_target
from hdmi.transforms.common import FunctionTransform

if TYPE_CHECKING:
    from hdmi.motion import Reference


class FeedForwardTarget(FunctionTransform):
    """Targets that make servos follow the reference, for a residual action to start from.

    Soft servos sent to the reference's joint positions give way to whatever they carry. These targets are ahead by
    what the reference's torques and velocities ask for, see `functional.feedforward_target`; where the motion brings
    targets of its own, it is those. What is sent acts late, by the action's delay and half of a control step; `lead`
    sends what the reference asks for by then.

    Reads `step_key` int64 [N, 1], the frame of the reference; writes `out_key` [N, J], rad.

    Args:
        reference: what to follow.
        joint_torque: that it asks for, N m, or what computes it of `grip`. [T, J]
        servo_stiffness, servo_damping: of the servos, N m/rad and N m s/rad. [J]
        effort_limits: of the motors, N m. [J]
        effort: share of the limits that the torques are clipped to: the rest is the policy's.
        grip: share of an object's friction that hands count on when they press it.
        lead: how far ahead on the motion the targets are, s; not those that the motion brings, which were sent in time.
        control_dt: s.

    Examples:
        >>> servos = {"servo_stiffness": [100.0] * 29, "servo_damping": [2.0] * 29, "effort_limits": [50.0] * 29}
        >>> torque = torch.full_like(reference.joint_pos, 10.0)
        >>> ahead = FeedForwardTarget(reference, torque, **servos)
        >>> out = ahead(TensorDict({"ref": {"step": torch.tensor([[0]])}}, [1]))["ref", "joint_target"]
        >>> expected = reference.joint_pos[0] + 10 / 100 + 2 / 100 * reference.joint_vel[0]
        >>> bool(torch.allclose(out[0], expected))
        True
    """

    def __init__(
        self,
        reference: Reference,
        joint_torque: Tensor | Callable[[float], Tensor],
        servo_stiffness: Sequence[float],
        servo_damping: Sequence[float],
        effort_limits: Sequence[float],
        effort: float = 0.8,
        grip: float = 0.5,
        lead: float = 0.0,
        control_dt: float = 0.02,
        step_key: NestedKey = ("ref", "step"),
        out_key: NestedKey = ("ref", "joint_target"),
    ):
        super().__init__([step_key], [out_key])
        if not 0 <= effort <= 1:
            raise ValueError(f"effort: expected a share from 0 to 1, got {effort}")
        if not 0 < grip <= 1:
            raise ValueError(f"grip: expected a share above 0, at most 1, got {grip}")
        if lead < 0:
            raise ValueError(f"lead: expected seconds, not below 0, got {lead}")
        targets = reference.joint_target
        if targets is None:
            torque = joint_torque(grip) if callable(joint_torque) else joint_torque
            kp, kd, limit = (
                torch.as_tensor(values, dtype=torch.float32, device=reference.joint_pos.device)
                for values in (servo_stiffness, servo_damping, effort_limits)
            )
            torque = torque.to(reference.joint_pos)
            targets = feedforward_target(reference.joint_pos, reference.joint_vel, torque, kp, kd, effort * limit)
            targets = _ahead(targets, lead / control_dt)
        self.register_buffer("targets", targets, persistent=False)

    def function(self, *inputs: Tensor) -> Tensor:
        return self.targets[inputs[0].squeeze(-1)]


def _ahead(values: Tensor, frames: float) -> Tensor:
    """Values [T, J] so many frames later, in between linearly; those of the last frame at the end."""
    whole = int(frames)
    index = torch.arange(len(values), device=values.device) + whole
    early, late = (values[(index + i).clamp(max=len(values) - 1)] for i in (0, 1))
    return torch.lerp(early, late, frames - whole)
