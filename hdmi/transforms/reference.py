"""The reference motion as transforms: its clock, its frames, and starting episodes from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from hdmi.assets import g1, match_names
from hdmi.functional import local_pose, quat_from_euler, quat_multiply
from hdmi.motion import Reference
from hdmi.motion.starts import FRAME_KEY, NOISE_SHARE_KEY, StartTables
from hdmi.transforms.common import (
    SpecTransform,
    StateTransform,
    add_state_specs,
    set_terminated,
    soft_limits,
    spec_like,
)


def _uniform(shape: Sequence[int], half_range: Tensor | float, device: torch.device | None) -> Tensor:
    return (2 * torch.rand(shape, device=device) - 1) * half_range


class MotionReference(StateTransform):
    """Advances the motion clock and writes the reference of the present and of future frames.

    The reference of a step is the one that its state is compared with: after a reset to frame f it is frame f, and
    each step moves on by one. Past the end the last frame stays.

    Reads on reset `init/frame` int64 [N, 1] if something wrote it (else frame 0).
    Writes under `ref` (N worlds, K tracked bodies, J tracked joints, E effectors, F future steps):
        `step` int64 [N, 1]; `phase` [N, 1] in [0, 1]; `joint_pos`, `joint_vel` [N, 29];
        `root_pos` [N, 3], `root_quat` [N, 4]; `body_pos`, `body_lin_vel`, `body_ang_vel` [N, K, 3],
        `body_quat` [N, K, 4]; `body_pos_local`, `body_quat_local` (see `functional.local_pose`);
        `future/joint_pos` [N, F, J], `future/body_pos_local` [N, F, K, 3] (future bodies in the present reference
        root's yaw frame); with an object `object_pos`, `object_quat`, `object_joint_pos`; with effectors
        `contact` bool [N, E], `contact_point` [N, E, 3] in the frame of the object's link.

    Args:
        reference: what to track.
        tracked_bodies, tracked_joints: name patterns.
        future_steps: control steps ahead.
    """

    def __init__(
        self,
        reference: Reference,
        tracked_bodies: Sequence[str],
        tracked_joints: Sequence[str],
        future_steps: Sequence[int] = (1, 2, 8, 16, 32),
    ):
        joints = match_names(tracked_joints, g1.JOINT_NAMES, "tracked_joints")
        bodies = match_names(tracked_bodies, g1.BODY_NAMES, "tracked_bodies")
        table = _reference_table(reference, bodies, joints, future_steps)
        super().__init__(in_keys=[], out_keys=[("ref", "step"), *table])
        self.num_frames = reference.num_frames
        self._shapes = {key: value.shape[1:] for key, value in table.items()}
        self._dtypes = {key: value.dtype for key, value in table.items()}
        # one gather per step instead of one per key
        flat = torch.cat([value.reshape(reference.num_frames, -1).float() for value in table.values()], dim=-1)
        self.register_buffer("table", flat, persistent=False)

    def _lookup(self, step: Tensor) -> dict[NestedKey, Tensor]:
        rows = self.table[step.reshape(-1)].reshape(*step.shape[:-1], -1)
        sizes = [shape.numel() for shape in self._shapes.values()]
        out: dict[NestedKey, Tensor] = {("ref", "step"): step}
        for (key, shape), value in zip(self._shapes.items(), rows.split(sizes, dim=-1), strict=True):
            out[key] = value.unflatten(-1, shape).to(self._dtypes[key])
        return out

    def initial_state(self, batch_size: torch.Size, device: torch.device | None) -> dict[NestedKey, Tensor]:
        return self._lookup(torch.zeros(*batch_size, 1, dtype=torch.int64, device=device))

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        # only the clock is read back by this transform, and the joint positions by residual actions
        state = self.initial_state(input_spec.shape, input_spec.device)
        return add_state_specs(
            input_spec, {key: spec_like(state[key]) for key in (("ref", "step"), ("ref", "joint_pos"))}
        )

    def _write(self, tensordict: TensorDictBase, step: Tensor) -> TensorDictBase:
        for key, value in self._lookup(step).items():
            tensordict.set(key, value)
        return tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        step = tensordict.get(FRAME_KEY, None)
        if step is None:
            step = torch.zeros(*tensordict_reset.batch_size, 1, dtype=torch.int64, device=tensordict_reset.device)
        return self._write(tensordict_reset, step)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        step = (tensordict.get(("ref", "step")) + 1).clamp(max=self.num_frames - 1)
        return self._write(next_tensordict, step)


def _reference_table(
    reference: Reference, bodies: Sequence[int], joints: Sequence[int], future_steps: Sequence[int]
) -> dict[NestedKey, Tensor]:
    r, index = reference, list(bodies)
    root_pos, root_quat = r.body_pos[:, 0], r.body_quat[:, 0]
    pos_local, quat_local = local_pose(r.body_pos[:, index], r.body_quat[:, index], root_pos, root_quat)
    last, frames = r.num_frames - 1, torch.arange(r.num_frames, device=root_pos.device)[:, None]
    table: dict[NestedKey, Tensor] = {
        ("ref", "phase"): frames / last,
        ("ref", "joint_pos"): r.joint_pos,
        ("ref", "joint_vel"): r.joint_vel,
        ("ref", "root_pos"): root_pos,
        ("ref", "root_quat"): root_quat,
        ("ref", "body_pos"): r.body_pos[:, index],
        ("ref", "body_quat"): r.body_quat[:, index],
        ("ref", "body_lin_vel"): r.body_lin_vel[:, index],
        ("ref", "body_ang_vel"): r.body_ang_vel[:, index],
        ("ref", "body_pos_local"): pos_local,
        ("ref", "body_quat_local"): quat_local,
    }
    if r.has_object:
        table[("ref", "object_pos")] = r.object_pos
        table[("ref", "object_quat")] = r.object_quat
        if r.object_joint_pos.shape[-1]:
            table[("ref", "object_joint_pos")] = r.object_joint_pos
    if r.contact.shape[-1]:
        table[("ref", "contact")] = r.contact
        table[("ref", "contact_point")] = r.contact_point
    if future_steps:
        ahead = (frames + torch.as_tensor(list(future_steps), device=frames.device)).clamp(max=last)  # [T, F]
        table[("ref", "future", "joint_pos")] = r.joint_pos[ahead][..., list(joints)]
        future_pos = r.body_pos[ahead][:, :, index].flatten(1, 2)  # [T, F K, 3]
        future_local, _ = local_pose(future_pos, future_pos.new_zeros(*future_pos.shape[:-1], 4), root_pos, root_quat)
        table[("ref", "future", "body_pos_local")] = future_local.unflatten(1, (len(future_steps), len(index)))
    return table


class ReferenceStateInitialization(SpecTransform):
    """Starts episodes from frames of the reference with small random perturbations (section III-B, (1)).

    Starts are consistent: in a world whose object is s times as large its lowest point stays where it was, hands and
    feet that touch it still do (to first order in s - 1), the support that an object stands on moves with it, and
    joints are within their soft limits.

    Reads on reset, all optional: `init/object_scale` [N, 1], which transforms farther out draw; `init/frame` int64
    [N, 1], where to start instead of at a drawn frame; `init/noise_share` [N, 1], factor of all perturbations.
    Writes, before the base environment resets: `init/frame` and the state under `init` that `HumanoidObjectEnv` reads.
    It has no effect between resets.

    Args:
        reference: where to start from.
        start: `uniform` over all frames but the last `margin`, or `first`.
        margin: frames at the end that no episode starts from.
        first_share: share of episodes that start at the first frame all the same, as evaluations do.
        noise: half ranges of uniform perturbations: root_pos [3] m, root_rpy [3] rad, root_lin_vel, root_ang_vel,
            joint_pos (rad), joint_vel; object_pos [3], object_rpy [3], object_joint (rad). Absent means none.
        held_noise: factor of the object's perturbations at frames where contact is intended: an object between two
            hands cannot be somewhere else.
        soft_limit: share of the joint ranges, about their middles, that starts stay in.
        starts: of the reference in its scene; without them the object's size changes nothing, and no support moves.
    """

    _NOISES = (
        "root_pos", "root_rpy", "root_lin_vel", "root_ang_vel", "joint_pos", "joint_vel",
        "object_pos", "object_rpy", "object_joint",
    )  # fmt: skip

    def __init__(
        self,
        reference: Reference,
        start: Literal["uniform", "first"] = "uniform",
        margin: int = 1,
        noise: Mapping[str, float | Sequence[float]] | None = None,
        held_noise: float = 1.0,
        first_share: float = 0.0,
        soft_limit: float = 0.95,
        limits: Sequence[Sequence[float]] = g1.JOINT_RANGES,
        starts: StartTables | None = None,
    ):
        super().__init__()
        if start not in ("uniform", "first"):
            raise ValueError(f"reset.start: expected 'uniform' or 'first', got {start!r}")
        unknown = set(noise or {}) - set(self._NOISES)
        if unknown:
            raise ValueError(f"reset.noise: unknown {sorted(unknown)}; there is {list(self._NOISES)}")
        self.start, self.first_share = start, first_share
        self.num_starts = max(reference.num_frames - margin, 1)
        self.reference = reference
        held = reference.contact.any(-1, keepdim=True)  # [T, 1]
        self.register_buffer("object_noise", torch.where(held, held_noise, 1.0), persistent=False)
        for name in self._NOISES:
            value = torch.as_tensor((noise or {}).get(name, 0.0), dtype=torch.float32)
            self.register_buffer(f"noise_{name}", value, persistent=False)
        low, high = soft_limits(limits, soft_limit)
        self.register_buffer("low", low, persistent=False)
        self.register_buffer("high", high, persistent=False)
        self.has_starts = starts is not None
        self.moves_scenery = starts is not None and bool(starts.carries.any())
        for name, table in ({} if starts is None else vars(starts)).items():
            self.register_buffer(f"starts_{name}", table, persistent=False)

    def sample_frames(self, batch_size: torch.Size, device: torch.device | None) -> Tensor:
        """Start frames. int64 [*batch_size]"""
        if self.start == "first":
            return torch.zeros(batch_size, dtype=torch.int64, device=device)
        return torch.randint(self.num_starts, tuple(batch_size), device=device)

    def _start_frames(self, batch_size: torch.Size, device: torch.device | None) -> Tensor:
        frames = self.sample_frames(batch_size, device)
        return frames * (torch.rand(tuple(batch_size), device=device) >= self.first_share)

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        if tensordict is None:
            tensordict = TensorDict({}, batch_size=self.parent.batch_size, device=self.parent.device)
        frames = tensordict.get(FRAME_KEY, None)
        if frames is None:
            frames = self._start_frames(tensordict.batch_size, tensordict.device).unsqueeze(-1)
            tensordict.set(FRAME_KEY, frames)
        scale, noise_share = tensordict.get(("init", "object_scale"), None), tensordict.get(NOISE_SHARE_KEY, None)
        for key, value in self.initial_state(frames.squeeze(-1), scale, noise_share).items():
            tensordict.set(("init", key), value)
        return tensordict

    def initial_state(
        self, frames: Tensor, scale: Tensor | None = None, noise_share: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Perturbed state of the given frames. int64 [N] -> tensors [N, ...]

        Args:
            scale: of the object, [N, 1]. noise_share: factor of the perturbations, [N, 1].
        """
        ref, device = self.reference, frames.device

        def noise(name: str, like: Tensor) -> Tensor:
            drawn = _uniform(like.shape, getattr(self, f"noise_{name}"), device)
            return drawn if noise_share is None else noise_share * drawn

        def grown(name: str) -> Tensor | float:
            """What the object's size adds."""
            if scale is None or not self.has_starts:
                return 0.0
            return (scale - 1) * getattr(self, f"starts_{name}")[frames]

        root_pos, root_quat = ref.body_pos[frames, 0], ref.body_quat[frames, 0]
        root_lin_vel, root_ang_vel = ref.body_lin_vel[frames, 0], ref.body_ang_vel[frames, 0]
        joint_pos, joint_vel = ref.joint_pos[frames], ref.joint_vel[frames]
        state = {
            "root_pos": root_pos + grown("root_pos") + noise("root_pos", root_pos),
            "root_quat": quat_multiply(root_quat, quat_from_euler(noise("root_rpy", root_pos))),
            "root_lin_vel": root_lin_vel + noise("root_lin_vel", root_pos),
            "root_ang_vel": root_ang_vel + noise("root_ang_vel", root_pos),
            "joint_pos": torch.clamp(
                joint_pos + grown("joint_pos") + noise("joint_pos", joint_pos), self.low, self.high
            ),
            "joint_vel": joint_vel + noise("joint_vel", joint_vel),
        }
        if ref.has_object:
            pos, quat, share = ref.object_pos[frames], ref.object_quat[frames], self.object_noise[frames]
            moved = share * noise("object_pos", pos)
            place = pos + moved
            place[..., 2:] += grown("object_height")
            state |= {
                "object_pos": place,
                "object_quat": quat_multiply(quat, quat_from_euler(share * noise("object_rpy", pos))),
                "object_lin_vel": ref.object_lin_vel[frames],
                "object_ang_vel": ref.object_ang_vel[frames],
            }
            if ref.object_joint_pos.shape[-1]:
                joint = ref.object_joint_pos[frames]
                state["object_joint_pos"] = joint + share * noise("object_joint", joint)
                state["object_joint_vel"] = ref.object_joint_vel[frames]
            if self.moves_scenery:
                carried = self.starts_carries[frames].unsqueeze(-1)  # [N, S, 1]
                state["scenery_pos"] = self.starts_scenery_pos + carried * moved.unsqueeze(-2)
        return state


class AdaptiveStateInitialization(ReferenceStateInitialization):
    """Reference state initialization that starts more often shortly before frames where episodes fail.

    The motion is cut into bins; each keeps an exponential average of the terminations in it, and a start's bin is
    drawn with probability `uniform_share / bins + (1 - uniform_share) * failures`, failures normalised.

    Args:
        start: `uniform` as long as nothing has failed, or `first`, always.
        bins: number of bins. uniform_share: of starts that ignore failures. decay: of the average, per reset in
            which any episode has ended. lead: frames before the failure's bin that the start is moved ahead.
    """

    def __init__(
        self,
        reference: Reference,
        start: Literal["uniform", "first"] = "uniform",
        margin: int = 1,
        noise: Mapping[str, float | Sequence[float]] | None = None,
        held_noise: float = 1.0,
        first_share: float = 0.0,
        soft_limit: float = 0.95,
        limits: Sequence[Sequence[float]] = g1.JOINT_RANGES,
        starts: StartTables | None = None,
        bins: int = 20,
        uniform_share: float = 0.5,
        decay: float = 0.999,
        lead: int = 25,
    ):
        super().__init__(reference, start, margin, noise, held_noise, first_share, soft_limit, limits, starts)
        self.uniform_share, self.decay, self.lead = uniform_share, decay, lead
        self.register_buffer("failures", torch.zeros(bins))

    def sample_frames(self, batch_size: torch.Size, device: torch.device | None) -> Tensor:
        if self.start == "first":
            return super().sample_frames(batch_size, device)
        bins, total = len(self.failures), self.failures.sum()
        uniform = torch.full_like(self.failures, 1 / bins)
        failing = self.uniform_share * uniform + (1 - self.uniform_share) * self.failures / total
        weights = torch.where(total > 0, failing, uniform)
        drawn = torch.multinomial(weights, batch_size.numel(), replacement=True).reshape(batch_size)
        within = torch.rand(tuple(batch_size), device=device)
        return ((drawn + within) / bins * self.num_starts).long().clamp(max=self.num_starts - 1)

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        # a start that is drawn again has been counted
        if tensordict is not None and NOISE_SHARE_KEY not in tensordict.keys(True):
            self._count(tensordict.get("terminated", None), tensordict.get(("ref", "step"), None))
        return super()._reset_env_preprocess(tensordict)

    def _count(self, terminated: Tensor | None, step: Tensor | None) -> None:
        """Counts the episodes that ended in failure. bool [N, 1], int64 [N, 1]"""
        if terminated is None or step is None:  # of the first reset
            return
        frames = (step.squeeze(-1) - self.lead).clamp(min=0)
        bins = (frames * len(self.failures) // self.num_starts).clamp(max=len(self.failures) - 1)
        self.failures.mul_(self.decay).index_add_(0, bins, terminated.squeeze(-1).float())


class MotionEnd(SpecTransform):
    """Truncates episodes that reach the last frame of the reference; value estimates bootstrap through it.

    Reads next `step_key`; writes `truncated` and `done`, and bool [N, 1] `completed`.
    """

    def __init__(self, reference: Reference, step_key: NestedKey = ("ref", "step")):
        super().__init__(in_keys=[step_key], out_keys=["completed"])
        self.last = reference.num_frames - 1

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        ended = next_tensordict.get(self.in_keys[0]) >= self.last
        next_tensordict.set("completed", ended & ~next_tensordict.get("terminated"))
        set_terminated(next_tensordict, ended, "truncated")
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        done = tensordict_reset.get("done")
        tensordict_reset.set("completed", torch.zeros_like(done))
        tensordict_reset.set("truncated", torch.zeros_like(done))
        return tensordict_reset

    def transform_done_spec(self, done_spec: Composite) -> Composite:
        if "truncated" not in set(done_spec.keys()):
            done_spec["truncated"] = done_spec["done"].clone()
        return done_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        flag = torch.zeros(*observation_spec.shape, 1, dtype=torch.bool, device=observation_spec.device)
        observation_spec["completed"] = spec_like(flag)
        return observation_spec

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise NotImplementedError("MotionEnd ends episodes and works in an environment only")
