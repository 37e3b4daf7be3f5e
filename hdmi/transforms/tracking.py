"""What rewards, terminations and metrics compare: tracked bodies, tracking errors, contact points, feet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from hdmi.functional import local_pose, quat_angle, quat_apply
from hdmi.names import match_names
from hdmi.transforms.common import FunctionTransform, StateTransform, below, key_of

if TYPE_CHECKING:
    from hdmi.assets import Effector


class TrackedBodies(FunctionTransform):
    """Selects the robot's tracked bodies and adds their poses in the root's yaw frame at its ground projection.

    Reads `robot/body_{pos, quat, lin_vel, ang_vel}` [N, B, *] and `robot/root_{pos, quat}`; writes the same for K
    bodies under `out_key`, and there `body_{pos, quat}_local` [N, K, *].

    Args:
        tracked_bodies: name patterns.
        body_names: of the B bodies.
        out_key: under which the six entries go.

    Examples:
        >>> places = torch.tensor([[[1.0, 1.0, 0.8], [1.0, 1.0, 1.2]]])
        >>> pose = {"body_pos": places, "root_pos": places[:, 0]}
        >>> turns = {"body_quat": torch.eye(4)[:1].expand(1, 2, 4), "root_quat": torch.eye(4)[:1]}
        >>> velocities = {"body_lin_vel": torch.zeros(1, 2, 3), "body_ang_vel": torch.zeros(1, 2, 3)}
        >>> td = TensorDict({"robot": pose | turns | velocities}, [1])
        >>> TrackedBodies(["torso"], body_names=["pelvis", "torso"])(td)["tracked", "body_pos_local"]
        tensor([[[0.0000, 0.0000, 1.2000]]])
    """

    def __init__(
        self,
        tracked_bodies: Sequence[str],
        body_names: Sequence[str],
        body_pos_key: NestedKey = ("robot", "body_pos"),
        body_quat_key: NestedKey = ("robot", "body_quat"),
        body_lin_vel_key: NestedKey = ("robot", "body_lin_vel"),
        body_ang_vel_key: NestedKey = ("robot", "body_ang_vel"),
        root_pos_key: NestedKey = ("robot", "root_pos"),
        root_quat_key: NestedKey = ("robot", "root_quat"),
        out_key: NestedKey = "tracked",
    ):
        outs = ("body_pos", "body_quat", "body_lin_vel", "body_ang_vel", "body_pos_local", "body_quat_local")
        super().__init__(
            [body_pos_key, body_quat_key, body_lin_vel_key, body_ang_vel_key, root_pos_key, root_quat_key],
            [below(out_key, name) for name in outs],
        )
        index = torch.as_tensor(match_names(tracked_bodies, body_names, "tracked_bodies"))
        self.register_buffer("index", index, persistent=False)

    def function(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        bodies, (root_pos, root_quat) = inputs[:4], inputs[4:]
        selected = [value.index_select(-2, self.index) for value in bodies]
        return (*selected, *local_pose(selected[0], selected[1], root_pos, root_quat))


class Distance(FunctionTransform):
    """Euclidean distance between vectors. [..., 3], [..., 3] -> [...], or [..., 1] if that drops the last dimension.

    Examples:
        >>> td = TensorDict({"a": torch.tensor([[3.0, 4.0, 0.0]]), "b": torch.zeros(1, 3)}, [1])
        >>> Distance("a", "b", ("error", "pos"))(td)["error", "pos"]
        tensor([[5.]])
    """

    def __init__(self, a_key: NestedKey, b_key: NestedKey, out_key: NestedKey):
        super().__init__([a_key, b_key], [out_key])

    def function(self, *inputs: Tensor) -> Tensor:
        return _feature((inputs[0] - inputs[1]).norm(dim=-1), inputs[0])


class Angle(FunctionTransform):
    """Angle between orientations, rad. [..., 4], [..., 4] -> [...], or [..., 1] if that drops the last dimension.

    Examples:
        >>> td = TensorDict({"a": torch.eye(4)[:1], "b": torch.eye(4)[1:2]}, [1])  # half a turn about x
        >>> Angle("a", "b", ("error", "rot"))(td)["error", "rot"]
        tensor([[3.1416]])
    """

    def __init__(self, a_key: NestedKey, b_key: NestedKey, out_key: NestedKey):
        super().__init__([a_key, b_key], [out_key])

    def function(self, *inputs: Tensor) -> Tensor:
        return _feature(quat_angle(inputs[0], inputs[1]), inputs[0])


class AbsoluteDifference(FunctionTransform):
    """Absolute difference of scalars, of the selected columns if `index` is given. [..., J] -> [..., J']

    Examples:
        >>> td = TensorDict({"a": torch.tensor([[1.0, 2.0, 3.0]]), "b": torch.tensor([[0.0, 2.5, 3.0]])}, [1])
        >>> AbsoluteDifference("a", "b", "error", index=[0, 1])(td)["error"]
        tensor([[1.0000, 0.5000]])
    """

    def __init__(self, a_key: NestedKey, b_key: NestedKey, out_key: NestedKey, index: Sequence[int] | None = None):
        super().__init__([a_key, b_key], [out_key])
        self.register_buffer("index", None if index is None else torch.as_tensor(list(index)), persistent=False)

    def function(self, *inputs: Tensor) -> Tensor:
        difference = (inputs[0] - inputs[1]).abs()
        return difference if self.index is None else difference.index_select(-1, self.index)


class BodyHeightError(FunctionTransform):
    """How far the height of one of the tracked bodies is from the reference's, m. [N, K, 3], [N, K, 3] -> [N, 1]

    Args:
        body: name of the body.
        tracked_bodies: name patterns of the K bodies, among `body_names`.

    Raises:
        ValueError: if `body` is none of the tracked ones.

    Examples:
        >>> error = BodyHeightError("torso", ["pelvis", "torso"], body_names=["pelvis", "torso", "head"])
        >>> bodies = torch.tensor([[[0.0, 0.0, 0.8], [0.0, 0.0, 1.0]]])
        >>> td = TensorDict({("tracked", "body_pos"): bodies, ("ref", "body_pos"): bodies + 0.25}, [1])
        >>> error(td)["error", "torso_height"]
        tensor([[0.2500]])
    """

    def __init__(
        self,
        body: str,
        tracked_bodies: Sequence[str],
        body_names: Sequence[str],
        a_key: NestedKey = ("tracked", "body_pos"),
        b_key: NestedKey = ("ref", "body_pos"),
        out_key: NestedKey = ("error", "torso_height"),
    ):
        super().__init__([a_key, b_key], [out_key])
        tracked = [body_names[i] for i in match_names(tracked_bodies, body_names, "tracked_bodies")]
        self.body = match_names([body], tracked, "body")[0]

    def function(self, *inputs: Tensor) -> Tensor:
        return (inputs[0] - inputs[1])[..., self.body, 2:].abs()


class JointErrors(AbsoluteDifference):
    """Absolute error of the tracked joints. [..., J], [..., J] -> [..., J']

    Args:
        tracked_joints: name patterns.
        joint_names: of the J joints.

    Examples:
        >>> errors = JointErrors("q", "q_ref", "error", tracked_joints=[".*_knee"], joint_names=["hip", "left_knee"])
        >>> errors(TensorDict({"q": torch.tensor([[1.0, 0.5]]), "q_ref": torch.zeros(1, 2)}, [1]))["error"]
        tensor([[0.5000]])
    """

    def __init__(
        self,
        a_key: NestedKey,
        b_key: NestedKey,
        out_key: NestedKey,
        tracked_joints: Sequence[str],
        joint_names: Sequence[str],
    ):
        super().__init__(a_key, b_key, out_key, match_names(tracked_joints, joint_names, "tracked_joints"))


def _feature(value: Tensor, source: Tensor) -> Tensor:
    # [N, K] for K bodies, [N, 1] for a single pose
    return value if source.ndim > 2 else value.unsqueeze(-1)


class ContactPoints(FunctionTransform):
    """End effectors and their contact points on the object, in the world.

    Reads `robot/body_{pos, quat}` [N, B, *], `object/link_{pos, quat}` [N, *], `object/scale` [N, 1] and
    `ref/contact_point` [N, E, 3] (link frame, m, scaled with the object);
    writes `contact/eef_pos` and `contact/target_pos` [N, E, 3], m.

    Args:
        effectors: their bodies, and the point of each in the frame of its body.
        body_names: of the B bodies.

    Examples:
        >>> from hdmi.assets import Effector
        >>> points = ContactPoints([Effector("hand", point=(0.1, 0.0, 0.0))], body_names=["pelvis", "hand"])
        >>> robot = {"body_pos": torch.ones(1, 2, 3), "body_quat": torch.eye(4)[:1].expand(1, 2, 4)}
        >>> link = {"link_pos": torch.zeros(1, 3), "link_quat": torch.eye(4)[:1], "scale": torch.full((1, 1), 2.0)}
        >>> td = TensorDict({"robot": robot, "object": link, "ref": {"contact_point": torch.ones(1, 1, 3)}}, [1])
        >>> points(td)["contact", "eef_pos"], td["contact", "target_pos"]  # the object is twice as large
        (tensor([[[1.1000, 1.0000, 1.0000]]]), tensor([[[2., 2., 2.]]]))
    """

    def __init__(
        self,
        effectors: Sequence[Effector],
        body_names: Sequence[str],
        body_pos_key: NestedKey = ("robot", "body_pos"),
        body_quat_key: NestedKey = ("robot", "body_quat"),
        link_pos_key: NestedKey = ("object", "link_pos"),
        link_quat_key: NestedKey = ("object", "link_quat"),
        scale_key: NestedKey = ("object", "scale"),
        contact_point_key: NestedKey = ("ref", "contact_point"),
        eef_pos_key: NestedKey = ("contact", "eef_pos"),
        target_pos_key: NestedKey = ("contact", "target_pos"),
    ):
        super().__init__(
            [body_pos_key, body_quat_key, link_pos_key, link_quat_key, scale_key, contact_point_key],
            [eef_pos_key, target_pos_key],
        )
        index = [match_names([e.body], body_names, "effectors")[0] for e in effectors]
        self.register_buffer("index", torch.as_tensor(index), persistent=False)
        points = torch.tensor([list(e.point) for e in effectors], dtype=torch.float32)
        self.register_buffer("points", points, persistent=False)

    def function(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        body_pos, body_quat, link_pos, link_quat, scale, points = inputs
        eef_pos, eef_quat = (value.index_select(-2, self.index) for value in (body_pos, body_quat))
        eef = eef_pos + quat_apply(eef_quat, self.points)
        scaled = points * scale.unsqueeze(-1)
        target = link_pos.unsqueeze(-2) + quat_apply(link_quat.unsqueeze(-2), scaled)
        return eef, target


class FeetState(StateTransform):
    """Contact history of the feet, for the regularization rewards.

    Reads next `robot/foot_force` [N, 2, 3]; writes under `out_key`: `force`, `previous_force` [N, 2, 3], N;
    `air_time` [N, 2], s, zero in contact; `swing_time` [N, 2], s, of the swing that ends in this step;
    `touchdown` bool [N, 2].

    Args:
        control_dt: s.
        force_threshold: N, above which a foot is in contact.
        out_key: under which the five entries go, which are its state, too.

    Examples:
        >>> env = TransformedEnv(base, FeetState(control_dt=0.02, force_threshold=1e9))  # as if always in the air
        >>> env.rollout(3)["next", "feet", "air_time"][0, :, 0]  # s, of the left foot
        tensor([0.0200, 0.0400, 0.0600])
    """

    def __init__(
        self,
        control_dt: float,
        force_threshold: float = 5.0,
        force_key: NestedKey = ("robot", "foot_force"),
        out_key: NestedKey = "feet",
    ):
        names = ("force", "previous_force", "air_time", "swing_time", "touchdown")
        super().__init__(in_keys=[key_of(force_key)], out_keys=[below(out_key, name) for name in names])
        self.control_dt, self.force_threshold = control_dt, force_threshold

    def initial_state(self, batch_size: torch.Size, device: torch.device | None) -> dict[NestedKey, Tensor]:
        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(*batch_size, *shape, dtype=dtype, device=device)

        values = (zeros(2, 3), zeros(2, 3), zeros(2), zeros(2), zeros(2, dtype=torch.bool))
        return dict(zip(self.out_keys, values, strict=True))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        tensordict_reset = super()._reset(tensordict, tensordict_reset)
        # the first step must not count the load of standing as an impact
        force = tensordict_reset.get(self.in_keys[0])
        tensordict_reset.set(self.out_keys[0], force)
        tensordict_reset.set(self.out_keys[1], force.clone())
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        force, before = next_tensordict.get(self.in_keys[0]), tensordict.get(self.out_keys[0])
        air_time = tensordict.get(self.out_keys[2]) + self.control_dt
        contact = force.norm(dim=-1) > self.force_threshold
        touchdown = contact & (tensordict.get(self.out_keys[2]) > 0)
        values = (force, before, air_time * ~contact, air_time * touchdown, touchdown)
        for key, value in zip(self.out_keys, values, strict=True):
            next_tensordict.set(key, value)
        return next_tensordict


class Metrics(FunctionTransform):
    """Averages tensors over their features for logs and evaluation, without influence on training.

    Writes `metrics/<name>` [N, 1] = mean of the entry at `keys[name]` [N, K]; names without a key are left out.

    Args:
        out_key: under which they go.

    Examples:
        >>> metrics = Metrics({"joint_error": ("error", "joints"), "object_error": None})
        >>> metrics(TensorDict({("error", "joints"): torch.tensor([[0.1, 0.3]])}, [1]))["metrics", "joint_error"]
        tensor([[0.2000]])
    """

    def __init__(self, keys: Mapping[str, NestedKey | Sequence[str] | None], out_key: NestedKey = "metrics"):
        given = {name: key_of(key) for name, key in keys.items() if key is not None}
        super().__init__(list(given.values()), [below(out_key, name) for name in given])

    def function(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        return tuple(value.float().mean(-1, keepdim=True) for value in inputs)


class ContactMade(FunctionTransform):
    """Share of the intended contacts that are made: the effector touches the object with some force.

    Reads `contact/force` [N, E, 3] and `ref/contact` bool [N, E]; writes `contact/made` and `contact/intended`
    [N, E], 0 or 1.

    Args:
        min_force: N, as in the lost-contact termination.

    Examples:
        >>> force = torch.tensor([[[5.0, 0.0, 0.0], [0.0, 0.0, 0.0]]])
        >>> td = TensorDict({("contact", "force"): force, ("ref", "contact"): torch.tensor([[True, True]])}, [1])
        >>> ContactMade(min_force=1.0)(td)["contact", "made"]
        tensor([[1., 0.]])
    """

    def __init__(
        self,
        min_force: float = 1.0,
        force_key: NestedKey = ("contact", "force"),
        active_key: NestedKey = ("ref", "contact"),
        made_key: NestedKey = ("contact", "made"),
        intended_key: NestedKey = ("contact", "intended"),
    ):
        super().__init__([force_key, active_key], [made_key, intended_key])
        self.min_force = min_force

    def function(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        force, active = inputs
        made = active & (force.norm(dim=-1) >= self.min_force)
        return made.float(), active.float()
