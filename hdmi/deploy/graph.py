"""From a transform stack to the graph of its deployment: sensors in, joint position targets out.

Observations and actions are transforms already, with their state in the tensordict. What a policy needs of them on a
robot is found backwards from its observation, run on one world, and traced; nothing is written a second time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor, nn
from torchrl.envs import Transform

from hdmi.functional import quat_apply, quat_from_axis_angle, quat_multiply
from hdmi.learning.networks import network_of
from hdmi.transforms import MotionReference
from hdmi.transforms.common import StateTransform

FRESH = "fresh"  # state that is 1 in the first tick of an episode
UNMEASURED = "unmeasured"  # of entries that no sensor gives


def name_of(key: NestedKey) -> str:
    """`("a", "b")` as it is called in a graph: `a.b`."""
    return key if isinstance(key, str) else ".".join(key)


def forward_part(stack: list[tuple[str, Transform]], *goals: NestedKey) -> list[tuple[str, Transform]]:
    """The transforms that some entries depend on, in their order, without those that only training needs."""
    needed, part = {unravel_key(goal) for goal in goals}, []
    for name, transform in reversed(stack):
        if getattr(transform, "training_only", False):
            continue
        if needed.intersection(unravel_key(key) for key in transform.out_keys or ()):
            part.append((name, transform))
            needed |= {unravel_key(key) for key in transform.in_keys or ()}
    return part[::-1]


def inverse_part(stack: list[tuple[str, Transform]], action_key: NestedKey) -> list[tuple[str, Transform]]:
    """The transforms that an action passes on its way to the robot, in the order in which it does."""
    return [
        (name, transform)
        for name, transform in reversed(stack)
        if action_key in (transform.in_keys_inv or ()) and not getattr(transform, "training_only", False)
    ]


class _Noted:
    """A tensordict that notes which of its entries are read."""

    def __init__(self, tensordict: TensorDictBase):
        self.tensordict, self.read = tensordict, set[NestedKey]()

    def get(self, key: NestedKey, *default: Any) -> Any:
        self.read.add(unravel_key(key))
        return self.tensordict.get(key, *default)


def _choose(flag: Tensor, yes: Tensor, no: Tensor) -> Tensor:
    """As torch.where, of flags, too, for which runtimes have no such operator."""
    flag = flag.reshape(-1, *[1] * (no.ndim - 1))
    return (flag & yes) | (~flag & no) if no.dtype == torch.bool else torch.where(flag, yes, no)


class Measured(nn.Module):
    """Entries of the environment's raw state from what sensors give.

    Sensors (world frame, wxyz, SI): `joint_pos`, `joint_vel` [J]; `root_quat_w` [4] and `root_ang_vel_b` [3], of the
    IMU; `root_pos_w` [3], `object_pos_w` [3], `object_quat_w` [4], of motion capture; `object_joint_pos` [1], of an
    articulated object. The object is taken to have its nominal size.

    Args:
        entries: shapes of the raw state's entries, without batch.
        hinge: pose of the object's link in the object and the axis that it turns about, if it has one.
    """

    def __init__(self, entries: Mapping[NestedKey, torch.Size], hinge: tuple[Tensor, ...] | None):
        super().__init__()
        self.entries = dict(entries)
        self.hinge_pos: Tensor
        self.hinge_quat: Tensor
        self.hinge_axis: Tensor
        for name, value in zip(("pos", "quat", "axis"), hinge or (), strict=False):
            self.register_buffer(f"hinge_{name}", value, persistent=False)
        self.has_hinge = hinge is not None
        joints = entries[("robot", "joint_pos")]
        self.sensors: dict[str, torch.Size] = {
            "joint_pos": joints, "joint_vel": joints, "root_quat_w": torch.Size([4]), "root_ang_vel_b": torch.Size([3]),
            "root_pos_w": torch.Size([3]),
        }  # fmt: skip
        if ("object", "pos") in entries:
            self.sensors |= {"object_pos_w": torch.Size([3]), "object_quat_w": torch.Size([4])}
            if self.has_hinge:
                self.sensors["object_joint_pos"] = torch.Size([1])

    def forward(self, sensors: Mapping[str, Tensor], others: Mapping[NestedKey, Tensor]) -> TensorDict:
        """The raw state of one world, batch [1]; `others` are entries that no sensor gives."""
        quat = sensors["root_quat_w"]
        found: dict[NestedKey, Tensor] = {
            ("robot", "joint_pos"): sensors["joint_pos"],
            ("robot", "joint_vel"): sensors["joint_vel"],
            ("robot", "root_pos"): sensors["root_pos_w"],
            ("robot", "root_quat"): quat,
            ("robot", "root_ang_vel"): quat_apply(quat, sensors["root_ang_vel_b"]),
        }
        if "object_pos_w" in sensors:
            pos, quat = sensors["object_pos_w"], sensors["object_quat_w"]
            link_pos, link_quat = pos, quat
            if self.has_hinge:
                found["object", "joint_pos"] = sensors["object_joint_pos"]
                turn = quat_from_axis_angle(self.hinge_axis, sensors["object_joint_pos"][0])
                link_pos = pos + quat_apply(quat, self.hinge_pos)
                link_quat = quat_multiply(quat_multiply(quat, self.hinge_quat), turn)
            found |= {
                ("object", "pos"): pos,
                ("object", "quat"): quat,
                ("object", "link_pos"): link_pos,
                ("object", "link_quat"): link_quat,
                ("object", "scale"): torch.ones(1),
            }
        out = TensorDict({}, batch_size=[1])
        for key, value in {**others, **found}.items():
            out.set(key, value.unsqueeze(0))
        return out

    def unmeasured(self) -> list[NestedKey]:
        """Entries that no sensor gives."""
        given = {name: torch.zeros(shape) for name, shape in self.sensors.items()}
        known = self(given, {}).keys(True, True)
        return [key for key in self.entries if key not in known]


class PolicyGraph(nn.Module):
    """One tick of a policy: `(sensors, state) -> (joint position targets, next state)`.

    Args:
        stack: the transforms of an environment with the names of their nodes, from the base environment outwards.
        actor: of the policy.
        measured: what gives the raw state.
        action_key: of the environment.
    """

    def __init__(
        self,
        stack: list[tuple[str, Transform]],
        actor: nn.Module,
        measured: Measured,
        action_key: NestedKey = "action",
    ):
        super().__init__()
        self.measured, self.network, self.action_key = measured, network_of(actor), action_key
        self.others = measured.unmeasured()
        inverse = inverse_part(stack, action_key)
        forward = forward_part(stack, "policy", *(key for _, t in inverse for key in getattr(t, "state_keys", ())))
        used = {unravel_key(key) for _, t in forward for key in t.in_keys or ()}
        used |= {unravel_key(key) for _, t in inverse for key in getattr(t, "state_keys", ())}
        self.stages = [(n, t.restricted(used) if isinstance(t, MotionReference) else t) for n, t in forward]
        self.inverse = inverse
        sensors = {name: torch.zeros(shape) for name, shape in measured.sensors.items()}
        others = {key: torch.zeros(measured.entries[key]) for key in self.others}
        first = self._tick(measured(sensors, others), None)
        noted = _Noted(first)
        self._tick(measured(sensors, others), noted)
        self.state: dict[NestedKey, Tensor] = {
            key: torch.zeros_like(first.get(key)[0]) for key in sorted(noted.read, key=name_of)
        }

    def _tick(self, now: TensorDict, before: Any, fresh: Tensor | None = None) -> TensorDict:
        """Everything that one tick computes, from the raw state and from what the last tick left.

        Args:
            before: None in the first tick.
            fresh: bool [1, 1], whether this is the first tick, if that is only known when the graph runs.
        """
        for _, transform in self.stages:
            if not isinstance(transform, StateTransform) and not hasattr(transform, "fresh_state"):
                now = transform._call(now) if hasattr(transform, "_call") else transform(now)
                continue
            versions = []
            if before is None or fresh is not None:
                start = TensorDict({}, batch_size=[1])
                if isinstance(transform, MotionReference) and before is not None:
                    start.set(transform.frame_key, before.get(transform.step_key))
                versions.append(transform._reset(start, now.copy()))
            if before is not None:
                versions.append(transform._step(before, now.copy()))
            if len(versions) == 2:
                assert fresh is not None
                begun, went = versions
                for key in went.keys(True, True):
                    value = went.get(key)
                    if value is not now.get(key, None):
                        now.set(key, _choose(fresh, begun.get(key), value))
            else:
                now = versions[0]
        out = self.network(now.get("policy"))
        now.set(self.action_key, out[0] if isinstance(out, tuple) else out)
        for _, transform in self.inverse:
            now = transform._inv_call(now)
        return now

    def forward(self, *values: Tensor) -> tuple[Tensor, ...]:
        """Values in the order of `inputs`, results in the order of `outputs`; none has a batch dimension."""
        given = dict(zip(self.inputs, values, strict=True))
        sensors = {name: given[name] for name in self.measured.sensors}
        others = {key: given[f"{UNMEASURED}.{name_of(key)}"] for key in self.others}
        before = TensorDict({}, batch_size=[1])
        for key in self.state:
            before.set(key, given[f"state.{name_of(key)}"].unsqueeze(0))
        fresh = given[f"state.{FRESH}"].reshape(1, 1) > 0.5
        now = self._tick(self.measured(sensors, others), before, fresh)
        left = [now.get(key)[0] for key in self.state]
        return now.get(self.action_key)[0], torch.zeros(1), *left

    @property
    def inputs(self) -> dict[str, Tensor]:
        """Names of what `forward` takes, with the values of an episode's start, which for sensors say nothing."""
        found = {name: torch.zeros(shape) for name, shape in self.measured.sensors.items()}
        found[f"state.{FRESH}"] = torch.ones(1)
        found |= {f"state.{name_of(key)}": value for key, value in self.state.items()}
        return found | {f"{UNMEASURED}.{name_of(k)}": torch.zeros(self.measured.entries[k]) for k in self.others}

    @property
    def outputs(self) -> list[str]:
        """Names of what `forward` returns: `joint_pos_target` [J], rad, and the next tick's state."""
        return ["joint_pos_target", f"next.{FRESH}", *(f"next.{name_of(key)}" for key in self.state)]

    def terms_that_read(self, key: NestedKey) -> Iterator[str]:
        """Nodes of the observation that depend on an entry of the raw state."""
        terms = [(n, t) for n, t in self.stages if n.startswith("observation.")]
        for name, term in terms:
            reached = {unravel_key(k) for _, t in forward_part(self.stages, term.out_keys[0]) for k in t.in_keys or ()}
            if unravel_key(key) in reached:
                yield name
