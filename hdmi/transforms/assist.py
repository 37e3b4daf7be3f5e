"""Help with following the reference that fades while training goes on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from hdmi.functional import quat_conjugate, quat_multiply, quat_to_rotation_vector, spring_wrench
from hdmi.transforms.common import SpecTransform, add_read_state, below, key_of

if TYPE_CHECKING:
    from hdmi.motion import Reference

_POSE = ("pos", "quat", "lin_vel", "ang_vel")


class SpringAssist(SpecTransform):
    """Pulls the robot's root, or the object, to where the reference has it in the next step, less and less.

    The spring is critically damped, see `functional.spring_wrench`. What is left of it falls linearly from 1 to 0 with
    the steps taken; their count is a buffer that goes with the transform's state.

    Reads of the present step `step_key` int64 [N, 1], the frame of the reference, and `state_keys`: the body's
    position [N, 3], orientation [N, 4], linear and angular velocity [N, 3], and with an object its mass [N, 1], kg.
    Writes `out_key` [N, 6] into the stepped tensordict: force and moment about the body's origin, N and N m, world
    frame, which `HumanoidObjectEnv` applies during the step.

    Args:
        reference: what to follow.
        robot_mass: kg.
        total_steps: of the training, for each environment.
        body: `root` or `object`.
        object_free: whether the object can be pulled: not where it stands fixed in the world.
        fade: share of `total_steps` after which nothing is left.
        frequency: of the spring, Hz.
        radius: of gyration, m: moments are for a body of inertia m radius^2.
        max_acceleration: that the force is limited to, m/s^2; the moment likewise at one radius.

    Examples:
        >>> spring = SpringAssist(reference, robot_mass=2.0, total_steps=100, frequency=0.5, max_acceleration=100.0)
        >>> here = TensorDict({"ref": {"step": torch.tensor([[0]])}, "action": torch.zeros(1, 29)}, [1])
        >>> here["robot"] = {"root_pos": reference.body_pos[1:2, 0] - 0.1, "root_quat": reference.body_quat[1:2, 0]}
        >>> here["robot", "root_lin_vel"] = reference.body_lin_vel[1:2, 0]
        >>> here["robot", "root_ang_vel"] = reference.body_ang_vel[1:2, 0]
        >>> spring.inv(here)["wrench", "root"][:, :3]  # 2 kg times pi^2 times 0.1 m
        tensor([[1.9739, 1.9739, 1.9739]])
    """

    training_only = True

    def __init__(
        self,
        reference: Reference,
        robot_mass: float,
        total_steps: int,
        body: Literal["root", "object"] = "root",
        object_free: bool = True,
        fade: float = 0.5,
        frequency: float = 1.0,
        radius: float = 0.3,
        max_acceleration: float = 5.0,
        step_key: NestedKey = ("ref", "step"),
        state_keys: Sequence[NestedKey] | None = None,
        out_key: NestedKey | None = None,
    ):
        super().__init__()
        if body not in ("root", "object"):
            raise ValueError(f"assist: body: expected 'root' or 'object', got {body!r}")
        if not 0 < fade <= 1:
            raise ValueError(f"assist: fade: expected a share of the training, above 0 and up to 1, got {fade}")
        if body == "root":
            parts = [getattr(reference, f"body_{name}")[:, 0] for name in _POSE]
            keys: list[NestedKey] = [("robot", f"root_{name}") for name in _POSE]
        elif reference.has_object and object_free:
            parts = [getattr(reference, f"object_{name}") for name in _POSE]
            keys = [("object", name) for name in (*_POSE, "mass")]
        else:
            raise ValueError(f"assist: body: motion {reference.name!r} has no object that can be pulled")
        self.step_key = key_of(step_key)
        self.state_keys = [self.step_key, *(key_of(key) for key in (keys if state_keys is None else state_keys))]
        self.out_key = below("wrench", body) if out_key is None else key_of(out_key)
        self.robot_mass, self.radius, self.rate = robot_mass, radius, 2 * math.pi * frequency
        self.max_acceleration, self.fade_steps = max_acceleration, max(fade * total_steps, 1.0)
        self.last = reference.num_frames - 1
        self.register_buffer("table", torch.cat(parts, dim=-1), persistent=False)  # [T, 13]
        self.register_buffer("steps", torch.zeros(()))

    @property
    def strength(self) -> Tensor:
        """What is left of the spring, from 1 to 0."""
        return (1 - self.steps / self.fade_steps).clamp(min=0)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        step = tensordict.get(self.step_key, None)
        if step is None:
            return tensordict
        pos, quat, lin_vel, ang_vel, *mass = (tensordict.get(key) for key in self.state_keys[1:])
        goal = self.table[(step.squeeze(-1) + 1).clamp(max=self.last)].split([3, 4, 3, 3], dim=-1)
        rotation = quat_to_rotation_vector(quat_multiply(goal[1], quat_conjugate(quat)))
        kg = mass[0] if mass else self.robot_mass
        wrench = spring_wrench(
            goal[0] - pos, rotation, goal[2] - lin_vel, goal[3] - ang_vel, kg, self.radius, self.rate
        )
        force, moment = wrench.split(3, dim=-1)
        tensordict.set(
            self.out_key,
            self.strength * torch.cat([self._limited(force, kg), self._limited(moment, kg * self.radius)], dim=-1),
        )
        return tensordict

    def _limited(self, value: Tensor, unit: Tensor | float) -> Tensor:
        longest = unit * self.max_acceleration
        return value * (longest / value.norm(dim=-1, keepdim=True).clamp(min=1e-9)).clamp(max=1)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.steps.add_(1)
        return next_tensordict

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        return add_read_state(super().transform_input_spec(input_spec), self, self.state_keys)
