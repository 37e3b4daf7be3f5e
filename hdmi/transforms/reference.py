"""The reference motion as transforms: its clock, its frames, and starting episodes from it."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from hdmi.functional import local_pose, quat_from_euler, quat_multiply
from hdmi.names import FRAME_KEY, NOISE_SHARE_KEY, REWIND_KEY, match_names
from hdmi.transforms.common import (
    SpecTransform,
    StateTransform,
    add_state_specs,
    below,
    copied,
    key_of,
    raise_done,
    soft_limits,
    spec_like,
)

if TYPE_CHECKING:
    from hdmi.motion import Reference
    from hdmi.motion.starts import StartTables


def _uniform(shape: Sequence[int], half_range: Tensor | float, device: torch.device | None) -> Tensor:
    return (2 * torch.rand(shape, device=device) - 1) * half_range


class MotionReference(StateTransform):
    """Advances the motion clock and writes the reference of the present and of future frames.

    The reference of a step is the one that its state is compared with: after a reset to frame f it is frame f, and
    each step moves on by one. Past the end the last frame stays.

    Reads on reset `init/frame` int64 [N, 1] if something wrote it (else frame 0).
    Writes under `out_key` (N worlds, K tracked bodies, J tracked joints of all, E effectors, F future steps):
        `step` int64 [N, 1]; `phase` [N, 1] in [0, 1]; `joint_pos`, `joint_vel` [N, all];
        `root_pos` [N, 3], `root_quat` [N, 4]; `body_pos`, `body_lin_vel`, `body_ang_vel` [N, K, 3],
        `body_quat` [N, K, 4]; `body_pos_local`, `body_quat_local` (see `functional.local_pose`);
        `future/joint_pos` [N, F, J], `future/body_pos_local` [N, F, K, 3] (future bodies in the present reference
        root's yaw frame); with an object `object_pos`, `object_quat`, `object_joint_pos`; with effectors
        `contact` bool [N, E], `contact_point` [N, E, 3] in the frame of the object's link.

    Args:
        reference: what to track.
        tracked_bodies, tracked_joints: name patterns.
        body_names, joint_names: those of the robot.
        future_steps: control steps ahead.
        out_key: under which the reference goes; `step` there is its state.

    Attributes:
        tracked_bodies, tracked_joints: names that match, in the robot's order.
        future_steps: as given.

    Examples:
        >>> clock = MotionReference(reference, ["torso_link"], [".*_knee_joint"], g1.BODY_NAMES, g1.JOINT_NAMES)
        >>> td = TransformedEnv(base, clock).rollout(3)
        >>> td["next", "ref", "step"][0].flatten(), td["next", "ref", "future", "joint_pos"].shape
        (tensor([1, 2, 3]), torch.Size([2, 3, 5, 2]))
    """

    def __init__(
        self,
        reference: Reference,
        tracked_bodies: Sequence[str],
        tracked_joints: Sequence[str],
        body_names: Sequence[str],
        joint_names: Sequence[str],
        future_steps: Sequence[int] = (1, 2, 8, 16, 32),
        out_key: NestedKey = "ref",
        frame_key: NestedKey = FRAME_KEY,
    ):
        joints = match_names(tracked_joints, joint_names, "tracked_joints")
        bodies = match_names(tracked_bodies, body_names, "tracked_bodies")
        self.tracked_bodies, self.tracked_joints = [body_names[i] for i in bodies], [joint_names[i] for i in joints]
        self.future_steps = [int(step) for step in future_steps]
        tables = _reference_table(reference, bodies, joints, future_steps)
        table = {below(out_key, key): value for key, value in tables.items()}
        self.step_key, self._base_key = below(out_key, "step"), below(out_key, "joint_pos")
        super().__init__(in_keys=[], out_keys=[self.step_key, *table])
        self.frame_key = key_of(frame_key)
        self.num_frames = reference.num_frames
        self._shapes = {key: value.shape[1:] for key, value in table.items()}
        self._dtypes = {key: value.dtype for key, value in table.items()}
        # one gather per step instead of one per key
        flat = torch.cat([value.reshape(reference.num_frames, -1).float() for value in table.values()], dim=-1)
        self.register_buffer("table", flat, persistent=False)

    def restricted(self, keys: Collection[NestedKey]) -> MotionReference:
        """The same clock, which writes only these of its keys."""
        out = copy.copy(self)
        out._shapes = {key: shape for key, shape in self._shapes.items() if key in keys}
        out.out_keys = [self.step_key, *out._shapes]
        parts = dict(zip(self._shapes, self.table.split([s.numel() for s in self._shapes.values()], -1), strict=True))
        out._buffers = {"table": torch.cat([parts[key] for key in out._shapes], dim=-1)}
        return out

    def _lookup(self, step: Tensor) -> dict[NestedKey, Tensor]:
        # a fifth of the time that indexing takes on a CPU
        rows = self.table.index_select(0, step.reshape(-1)).reshape(*step.shape[:-1], -1)
        sizes = [shape.numel() for shape in self._shapes.values()]
        out: dict[NestedKey, Tensor] = {self.step_key: step}
        for (key, shape), value in zip(self._shapes.items(), rows.split(sizes, dim=-1), strict=True):
            out[key] = value.unflatten(-1, shape).to(self._dtypes[key])
        return out

    def initial_state(self, batch_size: torch.Size, device: torch.device | None) -> dict[NestedKey, Tensor]:
        return self._lookup(torch.zeros(*batch_size, 1, dtype=torch.int64, device=device))

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        input_spec = copied(input_spec)
        # only the clock is read back by this transform, and the joint positions by residual actions
        state = self.initial_state(input_spec.shape, input_spec.device)
        return add_state_specs(input_spec, {key: spec_like(state[key]) for key in (self.step_key, self._base_key)})

    def _write(self, tensordict: TensorDictBase, step: Tensor) -> TensorDictBase:
        for key, value in self._lookup(step).items():
            tensordict.set(key, value)
        return tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        step = tensordict.get(self.frame_key, None)
        if step is None:
            step = torch.zeros(*tensordict_reset.batch_size, 1, dtype=torch.int64, device=tensordict_reset.device)
        return self._write(tensordict_reset, step)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        step = (tensordict.get(self.step_key) + 1).clamp(max=self.num_frames - 1)
        return self._write(next_tensordict, step)


def _reference_table(
    reference: Reference, bodies: Sequence[int], joints: Sequence[int], future_steps: Sequence[int]
) -> dict[NestedKey, Tensor]:
    r, index = reference, list(bodies)
    root_pos, root_quat = r.body_pos[:, 0], r.body_quat[:, 0]
    pos_local, quat_local = local_pose(r.body_pos[:, index], r.body_quat[:, index], root_pos, root_quat)
    last, frames = r.num_frames - 1, torch.arange(r.num_frames, device=root_pos.device)[:, None]
    table: dict[NestedKey, Tensor] = {
        "phase": frames / last,
        "joint_pos": r.joint_pos,
        "joint_vel": r.joint_vel,
        "root_pos": root_pos,
        "root_quat": root_quat,
        "body_pos": r.body_pos[:, index],
        "body_quat": r.body_quat[:, index],
        "body_lin_vel": r.body_lin_vel[:, index],
        "body_ang_vel": r.body_ang_vel[:, index],
        "body_pos_local": pos_local,
        "body_quat_local": quat_local,
    }
    if r.has_object:
        table["object_pos"] = r.object_pos
        table["object_quat"] = r.object_quat
        if r.object_joint_pos.shape[-1]:
            table["object_joint_pos"] = r.object_joint_pos
    if r.contact.shape[-1]:
        table["contact"] = r.contact
        table["contact_point"] = r.contact_point
    if future_steps:
        ahead = (frames + torch.as_tensor(list(future_steps), device=frames.device)).clamp(max=last)  # [T, F]
        table[("future", "joint_pos")] = r.joint_pos[ahead][..., list(joints)]
        future_pos = r.body_pos[ahead][:, :, index].flatten(1, 2)  # [T, F K, 3]
        future_local, _ = local_pose(future_pos, future_pos.new_zeros(*future_pos.shape[:-1], 4), root_pos, root_quat)
        table[("future", "body_pos_local")] = future_local.unflatten(1, (len(future_steps), len(index)))
    return table


class ReferenceStateInitialization(SpecTransform):
    """Starts episodes from frames of the reference with small random perturbations (section III-B, (1)).

    Starts are consistent: in a world whose object is s times as large its lowest point stays where it was, hands and
    feet that touch it still do (to first order in s - 1), the support that an object stands on moves with it, and
    joints are within their soft limits.

    Reads on reset, all optional: `init/object_scale` [N, 1], which transforms farther out draw; `init/frame` int64
    [N, 1], where to start instead of at a drawn frame; `init/rewind_frame` int64 [N, 1], likewise, where it is not
    negative, but not within the margin; `init/noise_share` [N, 1], factor of all perturbations.
    Writes, before the base environment resets: `init/frame` and the state under `init_key` that `HumanoidObjectEnv`
    reads. It has no effect between resets.

    Args:
        reference: where to start from.
        start: `uniform` over all frames but the last `margin`, `first`, or a frame.
        margin: frames at the end that no episode starts from.
        first_share: share of episodes that start at the first frame all the same, as evaluations do.
        noise: half ranges of uniform perturbations: root_pos [3] m, root_rpy [3] rad, root_lin_vel, root_ang_vel,
            joint_pos (rad), joint_vel; object_pos [3], object_rpy [3], object_joint (rad). Absent means none.
        held_noise: factor of the object's perturbations at frames where contact is intended: an object between two
            hands cannot be somewhere else.
        joint_ranges: of the robot, rad. [J, 2]
        soft_limit: share of the joint ranges, about their middles, that starts stay in.
        starts: of the reference in its scene; without them the object's size changes nothing, and no support moves.

    Examples:
        >>> start = ReferenceStateInitialization(reference, g1.JOINT_RANGES, start=100)
        >>> td = TransformedEnv(base, start).reset()
        >>> bool(torch.allclose(td["robot", "root_pos"], reference.body_pos[100, 0]))
        True
    """

    _NOISES = (
        "root_pos", "root_rpy", "root_lin_vel", "root_ang_vel", "joint_pos", "joint_vel",
        "object_pos", "object_rpy", "object_joint",
    )  # fmt: skip

    def __init__(
        self,
        reference: Reference,
        joint_ranges: Sequence[Sequence[float]],
        start: Literal["uniform", "first"] | int = "uniform",
        margin: int = 1,
        noise: Mapping[str, float | Sequence[float]] | None = None,
        held_noise: float = 1.0,
        first_share: float = 0.0,
        soft_limit: float = 0.95,
        starts: StartTables | None = None,
        init_key: NestedKey = "init",
        scale_key: NestedKey = ("init", "object_scale"),
        frame_key: NestedKey = FRAME_KEY,
        noise_share_key: NestedKey = NOISE_SHARE_KEY,
        rewind_key: NestedKey = REWIND_KEY,
    ):
        super().__init__()
        start = 0 if start == "first" else start
        if isinstance(start, str) and start != "uniform":
            raise ValueError(f"reset.start: expected 'uniform', 'first' or a frame, got {start!r}")
        if not isinstance(start, str) and not 0 <= start < reference.num_frames - 1:
            raise ValueError(f"start: expected a frame from 0 to {reference.num_frames - 2}, got {start}")
        unknown = set(noise or {}) - set(self._NOISES)
        if unknown:
            raise ValueError(f"reset.noise: unknown {sorted(unknown)}; there is {list(self._NOISES)}")
        self.start, self.first_share = start, first_share
        self.init_key, self.scale_key = key_of(init_key), key_of(scale_key)
        self.frame_key, self.noise_share_key = key_of(frame_key), key_of(noise_share_key)
        self.rewind_key = key_of(rewind_key)
        self.num_starts = max(reference.num_frames - margin, 1)
        self.reference = reference
        held = reference.contact.any(-1, keepdim=True)  # [T, 1]
        self.register_buffer("object_noise", torch.where(held, held_noise, 1.0), persistent=False)
        for name in self._NOISES:
            value = torch.as_tensor((noise or {}).get(name, 0.0), dtype=torch.float32)
            self.register_buffer(f"noise_{name}", value, persistent=False)
        low, high = soft_limits(joint_ranges, soft_limit)
        self.register_buffer("low", low, persistent=False)
        self.register_buffer("high", high, persistent=False)
        self.has_starts = starts is not None
        self.moves_scenery = starts is not None and bool(starts.carries.any())
        for name, table in ({} if starts is None else vars(starts)).items():
            self.register_buffer(f"starts_{name}", table, persistent=False)

    def sample_frames(self, batch_size: torch.Size, device: torch.device | None) -> Tensor:
        """Start frames. int64 [*batch_size]"""
        if not isinstance(self.start, str):
            return torch.full(tuple(batch_size), self.start, dtype=torch.int64, device=device)
        return torch.randint(self.num_starts, tuple(batch_size), device=device)

    def _start_frames(self, batch_size: torch.Size, device: torch.device | None) -> Tensor:
        frames = self.sample_frames(batch_size, device)
        return frames * (torch.rand(tuple(batch_size), device=device) >= self.first_share)

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        if tensordict is None:
            tensordict = TensorDict({}, batch_size=self.parent.batch_size, device=self.parent.device)
        frames = tensordict.get(self.frame_key, None)
        if frames is None:
            frames = self._start_frames(tensordict.batch_size, tensordict.device).unsqueeze(-1)
            rewound = tensordict.get(self.rewind_key, None)
            if rewound is not None:
                frames = torch.where(rewound < 0, frames, rewound.clamp(max=self.num_starts - 1))
            tensordict.set(self.frame_key, frames)
        scale, noise_share = tensordict.get(self.scale_key, None), tensordict.get(self.noise_share_key, None)
        for key, value in self.initial_state(frames.squeeze(-1), scale, noise_share).items():
            tensordict.set(below(self.init_key, key), value)
        return tensordict

    def initial_state(
        self, frames: Tensor, scale: Tensor | None = None, noise_share: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Perturbed state of the given frames. int64 [N] -> tensors [N, ...]

        Args:
            scale: of the object, [N, 1].
            noise_share: factor of the perturbations, [N, 1].
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


class Rewind(SpecTransform):
    """Starts an episode some steps before the frame at which the last one of its environment failed, now and then.

    Reads on reset, where they are, `terminated_key` bool [N, 1] and `step_key` int64 [N, 1] of the episode that ended;
    writes `out_key` int64 [N, 1], which `ReferenceStateInitialization` reads: -1 where it is to draw. It has no effect
    between resets.

    Args:
        share: of failed episodes that are rewound.
        steps: least and most to go back.

    Examples:
        >>> back = Rewind(share=1.0, steps=(25, 25))
        >>> ended = TensorDict({"terminated": [[True], [False]], "ref": {"step": [[100], [549]]}}, [2])
        >>> back._reset_env_preprocess(ended)["init", "rewind_frame"].flatten()
        tensor([75, -1])
    """

    training_only = True

    def __init__(
        self,
        share: float = 0.8,
        steps: Sequence[int] = (25, 125),
        terminated_key: NestedKey = "terminated",
        step_key: NestedKey = ("ref", "step"),
        out_key: NestedKey = REWIND_KEY,
    ):
        super().__init__()
        self.low, self.high = (int(s) for s in steps)
        if not 0 <= self.low <= self.high:
            raise ValueError(f"rewind: steps: expected 0 <= least <= most, got {list(steps)}")
        if not 0 <= share <= 1:
            raise ValueError(f"rewind: share: expected 0 to 1, got {share}")
        self.share = share
        self.terminated_key, self.step_key = key_of(terminated_key), key_of(step_key)
        self.out_key = key_of(out_key)

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase | None:
        if tensordict is None:
            return None
        failed, step = tensordict.get(self.terminated_key, None), tensordict.get(self.step_key, None)
        if failed is None or step is None:  # of the first reset
            return tensordict
        chosen = failed & (torch.rand(failed.shape, device=failed.device) < self.share)
        back = torch.randint(self.low, self.high + 1, step.shape, device=step.device)
        return tensordict.set(self.out_key, torch.where(chosen, (step - back).clamp(min=0), -1))


class ResetNoiseCurriculum(SpecTransform):
    """Starts episodes with a share of the perturbations that grows while training goes on.

    The share is `start` for a while and then rises linearly with the steps taken, to 1; their count is a buffer that
    goes with the transform's state. Reads on reset, where it is, and writes `noise_share_key` [N, 1], which
    `ReferenceStateInitialization` reads: what was asked for, times the share. It has no effect between resets.

    Args:
        total_steps: of the training, for each environment.
        start: share at first.
        hold: part of `total_steps` before it rises.
        grow: part of `total_steps` in which it rises.

    Examples:
        >>> curriculum = ResetNoiseCurriculum(total_steps=100, start=0.2)
        >>> asked = TensorDict({"init": {"noise_share": torch.tensor([[1.0], [0.5]])}}, [2])
        >>> curriculum._reset_env_preprocess(asked)["init", "noise_share"].flatten()
        tensor([0.2000, 0.1000])
    """

    training_only = True

    def __init__(
        self,
        total_steps: int,
        start: float = 0.3,
        hold: float = 0.4,
        grow: float = 0.3,
        noise_share_key: NestedKey = NOISE_SHARE_KEY,
    ):
        super().__init__()
        if not 0 <= start <= 1:
            raise ValueError(f"reset: curriculum: start: expected a share from 0 to 1, got {start}")
        if not (hold >= 0 < grow and hold + grow <= 1):
            raise ValueError(
                "reset: curriculum: hold, grow: expected parts of the training, the second above 0, of at most 1 "
                f"together, got {hold}, {grow}"
            )
        self.start, self.hold_steps, self.grow_steps = start, hold * total_steps, max(grow * total_steps, 1.0)
        self.noise_share_key = key_of(noise_share_key)
        self.register_buffer("steps", torch.zeros(()))

    @property
    def share(self) -> Tensor:
        """Of the perturbations, from `start` to 1."""
        return self.start + (1 - self.start) * ((self.steps - self.hold_steps) / self.grow_steps).clamp(0, 1)

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        if tensordict is None:
            tensordict = TensorDict({}, batch_size=self.parent.batch_size, device=self.parent.device)
        asked = tensordict.get(self.noise_share_key, None)
        if asked is None:
            asked = torch.ones(*tensordict.batch_size, 1, device=tensordict.device)
        return tensordict.set(self.noise_share_key, asked * self.share)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.steps.add_(1)
        return next_tensordict


class AdaptiveStateInitialization(ReferenceStateInitialization):
    """Reference state initialization that starts more often shortly before frames where episodes fail.

    The motion is cut into bins; each keeps an exponential average of the terminations in it, and a start's bin is
    drawn with probability `uniform_share / bins + (1 - uniform_share) * failures`, failures normalised.

    Args:
        start: `uniform` as long as nothing has failed; `first` or a frame, always.
        bins: number of bins.
        uniform_share: of starts that ignore failures.
        decay: of the average, per reset in which any episode has ended.
        lead: frames before the failure's bin that the start is moved ahead.

    Examples:
        >>> start = AdaptiveStateInitialization(reference, g1.JOINT_RANGES, bins=11, uniform_share=0.0)
        >>> start.failures[2] = 1.0  # as if all episodes had failed there: in frames 100 to 149 of 550
        >>> frames = start.sample_frames(torch.Size([1000]), None)
        >>> int(frames.min()) >= 99, int(frames.max()) <= 149
        (True, True)
    """

    def __init__(
        self,
        reference: Reference,
        joint_ranges: Sequence[Sequence[float]],
        start: Literal["uniform", "first"] | int = "uniform",
        margin: int = 1,
        noise: Mapping[str, float | Sequence[float]] | None = None,
        held_noise: float = 1.0,
        first_share: float = 0.0,
        soft_limit: float = 0.95,
        starts: StartTables | None = None,
        bins: int = 20,
        uniform_share: float = 0.5,
        decay: float = 0.999,
        lead: int = 25,
        terminated_key: NestedKey = "terminated",
        step_key: NestedKey = ("ref", "step"),
        init_key: NestedKey = "init",
        scale_key: NestedKey = ("init", "object_scale"),
        frame_key: NestedKey = FRAME_KEY,
        noise_share_key: NestedKey = NOISE_SHARE_KEY,
        rewind_key: NestedKey = REWIND_KEY,
    ):
        super().__init__(
            reference, joint_ranges, start, margin, noise, held_noise, first_share, soft_limit, starts,
            init_key, scale_key, frame_key, noise_share_key, rewind_key,
        )  # fmt: skip
        self.terminated_key, self.step_key = key_of(terminated_key), key_of(step_key)
        self.uniform_share, self.decay, self.lead = uniform_share, decay, lead
        self.register_buffer("failures", torch.zeros(bins))

    def sample_frames(self, batch_size: torch.Size, device: torch.device | None) -> Tensor:
        if not isinstance(self.start, str):
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
        if tensordict is not None and self.noise_share_key not in tensordict.keys(True):
            self._count(tensordict.get(self.terminated_key, None), tensordict.get(self.step_key, None))
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

    Reads next `step_key` int64 [N, 1]; writes `truncated` and `done`, and bool [N, 1] `completed`, of those that no
    termination ends in the same step.

    Examples:
        >>> start = ReferenceStateInitialization(reference, g1.JOINT_RANGES, start=547)  # of frames 0 to 549
        >>> clock = MotionReference(reference, ["torso_link"], [".*_knee_joint"], g1.BODY_NAMES, g1.JOINT_NAMES)
        >>> td = TransformedEnv(base, Compose(start, clock, MotionEnd(reference))).rollout(10)
        >>> td["next", "completed"][0].flatten()
        tensor([False,  True])
    """

    def __init__(
        self,
        reference: Reference,
        step_key: NestedKey = ("ref", "step"),
        completed_key: NestedKey = "completed",
        truncated_key: NestedKey = "truncated",
        terminated_key: NestedKey = "terminated",
        done_key: NestedKey = "done",
    ):
        super().__init__(in_keys=[key_of(step_key)], out_keys=[key_of(completed_key)])
        self.last = reference.num_frames - 1
        self.truncated_key, self.terminated_key = key_of(truncated_key), key_of(terminated_key)
        self.done_key = key_of(done_key)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        ended = next_tensordict.get(self.in_keys[0]) >= self.last
        next_tensordict.set(self.out_keys[0], ended & ~next_tensordict.get(self.terminated_key))
        raise_done(next_tensordict, ended, self.truncated_key, self.done_key)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        done = tensordict_reset.get(self.done_key)
        tensordict_reset.set(self.out_keys[0], torch.zeros_like(done))
        tensordict_reset.set(self.truncated_key, torch.zeros_like(done))
        return tensordict_reset

    def transform_done_spec(self, done_spec: Composite) -> Composite:
        if self.truncated_key not in done_spec.keys(True, True):
            done_spec = copied(done_spec)
            done_spec[self.truncated_key] = done_spec[self.done_key].clone()
        return done_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec = copied(observation_spec)
        flag = torch.zeros(*observation_spec.shape, 1, dtype=torch.bool, device=observation_spec.device)
        observation_spec[self.out_keys[0]] = spec_like(flag)
        return observation_spec

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise NotImplementedError("MotionEnd ends episodes and works in an environment only")
