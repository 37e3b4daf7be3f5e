"""Domain randomization: model fields drawn per episode or once per world, joint offsets and pushes.

Model terms write full per-world rows under `init/model/<MjModel field>` of the reset tensordict, on top of what terms
before them wrote; `HumanoidObjectEnv` applies the rows of the worlds that reset.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from hdmi.names import match_names
from hdmi.transforms.action import ActionStateTransform
from hdmi.transforms.common import SpecTransform, StateTransform, below, key_of

if TYPE_CHECKING:
    import mujoco

_MESH = 7  # mjGEOM_MESH


def _between(span: Sequence[float], shape: Sequence[int], device: torch.device | None) -> Tensor:
    """Uniform between the two figures of `span`."""
    low, high = span
    return low + (high - low) * torch.rand(tuple(shape), device=device)


class ModelRandomization(SpecTransform):
    """Base of terms that draw model fields.

    Args:
        per: `episode` draws at every reset; `world` once, at the first reset, so that worlds differ but stay.
        model: whose `fields` are the nominal ones.
        init_key: under which what the environment resets to is written, fields of the model under `model` there.
        worlds_key: numbers of the worlds that reset, int64 [n], where only rows do.
    """

    training_only = True

    def __init__(
        self,
        per: Literal["episode", "world"] = "episode",
        model: mujoco.MjModel | None = None,
        fields: Sequence[str] = (),
        init_key: NestedKey = "init",
        worlds_key: NestedKey = "worlds",
    ):
        super().__init__()
        self.init_key, self.worlds_key = key_of(init_key), key_of(worlds_key)
        if per not in ("episode", "world"):
            raise ValueError(f"{type(self).__name__}: per is 'episode' or 'world', got {per!r}")
        self.per = per
        # of the numbers per world; -1 until the first reset. A buffer, so that a resumed run keeps its worlds.
        self.register_buffer("seed", torch.tensor(-1))
        self._world_rows: dict[NestedKey, Tensor] = {}  # what the seed gives on top of the nominal model
        for field in fields:
            values = torch.tensor(getattr(model, field), dtype=torch.float32)
            self.register_buffer(f"nominal_{field}", values, persistent=False)

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        self._world_rows = {}  # of another seed

    def draw(self, init: TensorDictBase) -> None:
        """Writes into `init` (batch [N]) what this term randomizes."""
        raise NotImplementedError

    def _rows(self, init: TensorDictBase, field: str) -> Tensor:
        """A copy of the per-world rows that terms before wrote, or of the nominal model's. [N, ...]"""
        rows = init.get(("model", field), None)
        if rows is not None:
            return rows.clone()
        nominal = getattr(self, f"nominal_{field}")
        return nominal.expand(*init.batch_size, *nominal.shape).clone()

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        if tensordict is None:
            tensordict = TensorDict({}, batch_size=self.parent.batch_size, device=self.parent.device)
        init = tensordict.get(self.init_key, None)
        if init is None:
            init = TensorDict({}, batch_size=tensordict.batch_size, device=tensordict.device)
        if self.per == "world":
            self._draw_again(init, tensordict.get(self.worlds_key, None))
        else:
            self.draw(init)
        tensordict.set(self.init_key, init)
        return tensordict

    def _draw_again(self, init: TensorDictBase, worlds: Tensor | None) -> None:
        """The same numbers at every reset; terms per episode build on the rows that this one writes."""
        rows = self._world_rows
        if not rows or any(init.get(key, None) is not None for key in rows):
            rows = self._draw_everyone(init, worlds)
        for key, value in rows.items():
            init.set(key, value if worlds is None else value[worlds])

    def _draw_everyone(self, init: TensorDictBase, worlds: Tensor | None) -> dict[NestedKey, Tensor]:
        """What the seed gives for all worlds, on top of what terms before wrote for those that reset."""
        everyone = init.copy()
        if worlds is not None:
            everyone = init.new_zeros(self.parent.batch_size)
            everyone[worlds] = init
        before = everyone.copy()
        if self.seed < 0:
            self.seed.copy_(torch.randint(2**31, ()))
        with torch.random.fork_rng():
            torch.manual_seed(int(self.seed))
            self.draw(everyone)
        rows = {key: value for key, value in everyone.items(True, True) if value is not before.get(key, None)}
        if not any(key in before.keys(True, True) for key in rows):
            self._world_rows = rows
        return rows


def _find_bodies(
    model: mujoco.MjModel,
    patterns: Sequence[str],
    among: Literal["scene", "robot"],
    robot_bodies: Sequence[int],
    where: str,
) -> list[int]:
    """Ids of the bodies that match: of all, or of the robot's alone, whatever an object's are called."""
    if among not in ("scene", "robot"):
        raise ValueError(f"{where}.among: 'scene' or 'robot', got {among!r}")
    ids = list(range(model.nbody)) if among == "scene" else [int(i) for i in robot_bodies]
    return [ids[i] for i in match_names(patterns, [model.body(i).name for i in ids], f"{where}.bodies")]


class MassRandomization(ModelRandomization):
    """Scales mass and inertia of bodies, each on its own, or sets the total mass of an object.

    Args:
        bodies: name patterns.
        among: which bodies they are matched with, all of the `scene` or the `robot`'s.
        robot_bodies: ids of the robot's.
        scale: range of the factor; or
        mass: range of the bodies' total mass, kg, shared in proportion.

    Examples:
        >>> term = MassRandomization(scene.model, bodies=["pelvis"], mass=(5.0, 5.0))
        >>> term.draw(init := TensorDict({}, [1]))
        >>> float(init["model", "body_mass"][0, scene.model.body("pelvis").id])  # kg
        5.0
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        bodies: Sequence[str],
        scale: Sequence[float] | None = None,
        mass: Sequence[float] | None = None,
        per: Literal["episode", "world"] = "episode",
        among: Literal["scene", "robot"] = "scene",
        robot_bodies: Sequence[int] = (),
        init_key: NestedKey = "init",
        worlds_key: NestedKey = "worlds",
    ):
        super().__init__(per, model, ("body_mass", "body_inertia"), init_key, worlds_key)
        if (scale is None) == (mass is None):
            raise ValueError("MassRandomization: give either scale or mass")
        index = _find_bodies(model, bodies, among, robot_bodies, "MassRandomization")
        self.register_buffer("bodies", torch.as_tensor(index), persistent=False)
        self.scale, self.mass = scale, mass
        self.total = float(model.body_mass[index].sum())
        if self.total <= 0:
            raise ValueError(f"MassRandomization: {list(bodies)} are static and have no mass")

    def draw(self, init: TensorDictBase) -> None:
        n = init.batch_size[0]
        if self.mass is not None:
            factor = (_between(self.mass, (n, 1), init.device) / self.total).expand(n, len(self.bodies))
        else:
            assert self.scale is not None
            factor = _between(self.scale, (n, len(self.bodies)), init.device)
        for field, shaped in (("body_mass", factor), ("body_inertia", factor.unsqueeze(-1))):
            rows = self._rows(init, field)
            rows[:, self.bodies] *= shaped
            init.set(("model", field), rows)


class CenterOfMassRandomization(ModelRandomization):
    """Shifts the centre of mass of bodies by up to `shift` m along each axis; for `bodies`, see `MassRandomization`.

    Examples:
        >>> term = CenterOfMassRandomization(scene.model, bodies=["torso_link"], shift=0.05)
        >>> term.draw(init := TensorDict({}, [1]))
        >>> moved = init["model", "body_ipos"][0] - torch.tensor(scene.model.body_ipos).float()
        >>> moved.any(-1).sum(), bool((moved.abs() <= 0.0501).all())  # one body
        (tensor(1), True)
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        bodies: Sequence[str],
        shift: float,
        per: Literal["episode", "world"] = "episode",
        among: Literal["scene", "robot"] = "scene",
        robot_bodies: Sequence[int] = (),
        init_key: NestedKey = "init",
        worlds_key: NestedKey = "worlds",
    ):
        super().__init__(per, model, ("body_ipos",), init_key, worlds_key)
        index = _find_bodies(model, bodies, among, robot_bodies, "CenterOfMassRandomization")
        self.register_buffer("bodies", torch.as_tensor(index), persistent=False)
        self.shift = shift

    def draw(self, init: TensorDictBase) -> None:
        rows = self._rows(init, "body_ipos")
        shape = (init.batch_size[0], len(self.bodies), 3)
        rows[:, self.bodies] += _between((-self.shift, self.shift), shape, init.device)
        init.set(("model", "body_ipos"), rows)


class FrictionRandomization(ModelRandomization):
    """Draws one sliding friction for all geoms of the named bodies; for `bodies`, see `MassRandomization`.

    MuJoCo uses the larger friction of two geoms in contact, or that of an object which says so; floor and scenery have
    next to none of their own.

    Examples:
        >>> term = FrictionRandomization(scene.model, bodies=["left_ankle_roll_link"], friction=(0.4, 0.4))
        >>> term.draw(init := TensorDict({}, [1]))
        >>> init["model", "geom_friction"][0, scene.model.geom("left_foot0_collision").id, 0]
        tensor(0.4000)
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        bodies: Sequence[str],
        friction: Sequence[float],
        per: Literal["episode", "world"] = "episode",
        among: Literal["scene", "robot"] = "scene",
        robot_bodies: Sequence[int] = (),
        init_key: NestedKey = "init",
        worlds_key: NestedKey = "worlds",
    ):
        super().__init__(per, model, ("geom_friction",), init_key, worlds_key)
        wanted = _find_bodies(model, bodies, among, robot_bodies, "FrictionRandomization")
        geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] in wanted]
        self.register_buffer("geoms", torch.as_tensor(geoms), persistent=False)
        self.friction = friction

    def draw(self, init: TensorDictBase) -> None:
        rows = self._rows(init, "geom_friction")
        rows[:, self.geoms, 0] = _between(self.friction, (init.batch_size[0], 1), init.device)
        init.set(("model", "geom_friction"), rows)


class ObjectScale(ModelRandomization):
    """Scales the object about its body's origin: geoms, hinge and contact points. Writes `init/object_scale` [N, 1].

    Args:
        scale: range.
        object_geoms: of the model.
        entry: name of what is drawn, under `init_key`.

    Raises:
        ValueError: for an object with meshes, which MuJoCo cannot scale per world.

    Examples:
        >>> term = ObjectScale(scale=(0.9, 1.1))
        >>> term.draw(init := TensorDict({}, [100]))
        >>> init["object_scale"].shape, bool(((init["object_scale"] - 1).abs() <= 0.101).all())
        (torch.Size([100, 1]), True)
    """

    def __init__(
        self,
        scale: Sequence[float],
        per: Literal["episode", "world"] = "episode",
        model: mujoco.MjModel | None = None,
        object_geoms: Sequence[int] = (),
        init_key: NestedKey = "init",
        entry: str = "object_scale",
        worlds_key: NestedKey = "worlds",
    ):
        super().__init__(per, init_key=init_key, worlds_key=worlds_key)
        self.entry = entry
        if model is not None and any(model.geom(g).type[0] == _MESH for g in object_geoms):
            raise ValueError("a mesh cannot be scaled per world: leave this node out (randomization.object_scale=null)")
        self.range = scale

    def draw(self, init: TensorDictBase) -> None:
        init.set(self.entry, _between(self.range, (init.batch_size[0], 1), init.device))


class ObjectJointRandomization(ModelRandomization):
    """Draws dry friction (N m) and damping (N m s/rad) of the object's joint.

    Examples:
        >>> term = ObjectJointRandomization(scene.model, "waist_yaw_joint", friction=(0.5, 0.5), damping=(2.0, 2.0))
        >>> term.draw(init := TensorDict({}, [1]))
        >>> init["model", "dof_damping"][0, scene.model.joint("waist_yaw_joint").dofadr[0]]  # any hinge will do
        tensor(2.)
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        joint: str,
        friction: Sequence[float],
        damping: Sequence[float],
        per: Literal["episode", "world"] = "episode",
        init_key: NestedKey = "init",
        worlds_key: NestedKey = "worlds",
    ):
        super().__init__(per, model, ("dof_frictionloss", "dof_damping"), init_key, worlds_key)
        names = [model.joint(i).name for i in range(model.njnt)]
        self.dof = int(model.jnt_dofadr[match_names([joint], names, "ObjectJointRandomization.joint")[0]])
        self.ranges = {"dof_frictionloss": friction, "dof_damping": damping}

    def draw(self, init: TensorDictBase) -> None:
        for field, span in self.ranges.items():
            rows = self._rows(init, field)
            rows[:, self.dof] = _between(span, (init.batch_size[0],), init.device)
            init.set(("model", field), rows)


class JointOffset(ActionStateTransform):
    """Calibration error of the joints: a constant offset on every target, drawn per episode.

    State: the offset, [N, J], rad.

    Args:
        offset: half range, rad.
        size: width of the action, J; None asks the environment.
        state_key: `joint_offset/<action_key>` if absent.

    Examples:
        >>> env = TransformedEnv(base, JointOffset(offset=0.02))
        >>> td = env.step(env.reset().set("action", torch.zeros(2, 29)))
        >>> offset = td["joint_offset", "action"]
        >>> bool((td["next", "robot", "joint_target"] == offset).all()), bool((offset.abs() <= 0.02).all())
        (True, True)
    """

    training_only = True

    def __init__(
        self,
        offset: float,
        size: int | None = None,
        action_key: NestedKey = "action",
        state_key: NestedKey | None = None,
    ):
        super().__init__(action_key, size)
        self.offset = offset
        self.state_key = below("joint_offset", self.action_key) if state_key is None else key_of(state_key)

    @property
    def own_keys(self) -> list[NestedKey]:
        return [self.state_key]

    def initial_state(self, batch_size: torch.Size, device: torch.device | None) -> dict[NestedKey, Tensor]:
        return {self.state_key: _between((-self.offset, self.offset), (*batch_size, self.size), device)}

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get(self.action_key, None)
        if action is not None:
            offset = tensordict.get(self.state_key)
            # targets may come one per physics step [N, S, J]
            tensordict.set(self.action_key, action + (offset if action.ndim == offset.ndim else offset.unsqueeze(-2)))
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        next_tensordict.set(self.state_key, tensordict.get(self.state_key))
        return next_tensordict


class RandomPush(StateTransform):
    """Pushes the robot: now and then adds a random velocity to its root.

    Writes `out_key` [N, 6] into the stepped tensordict, which `HumanoidObjectEnv` adds to the root's linear and
    angular world velocity before stepping. State: control steps to the next one, int64 [N, 1].

    Args:
        interval: range of control steps between pushes.
        linear, angular: half ranges of the added velocity, m/s and rad/s.
        state_key: `push_countdown/<out_key>` if absent.

    Examples:
        >>> env = TransformedEnv(base, RandomPush(interval=(2, 2), linear=(0.5, 0.5, 0.0), angular=(0.0, 0.0, 0.5)))
        >>> env.rollout(4)["push_countdown", "push"][0].flatten()  # a step that begins at 1 pushes
        tensor([2, 1, 2, 1])
    """

    training_only = True

    def __init__(
        self,
        interval: Sequence[int],
        linear: Sequence[float],
        angular: Sequence[float],
        out_key: NestedKey = "push",
        state_key: NestedKey | None = None,
    ):
        super().__init__()
        self.out_key = key_of(out_key)
        self.state_key = below("push_countdown", self.out_key) if state_key is None else key_of(state_key)
        self.low, self.high = (int(i) for i in interval)
        if not 1 <= self.low <= self.high:
            raise ValueError(f"push.interval: expected 1 <= low <= high, got {list(interval)}")
        half_range = torch.tensor([*linear, *angular], dtype=torch.float32)
        self.register_buffer("half_range", half_range, persistent=False)

    def _countdown(self, batch_size: torch.Size, device: torch.device | None) -> Tensor:
        return torch.randint(self.low, self.high + 1, (*batch_size, 1), device=device)

    def initial_state(self, batch_size: torch.Size, device: torch.device | None) -> dict[NestedKey, Tensor]:
        return {self.state_key: self._countdown(batch_size, device)}

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        countdown = tensordict.get(self.state_key, None)
        if countdown is not None:
            size = (*countdown.shape[:-1], len(self.half_range))
            velocity = (2 * torch.rand(size, device=countdown.device) - 1) * self.half_range
            tensordict.set(self.out_key, velocity * (countdown <= 1))
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        countdown = tensordict.get(self.state_key)
        fresh = self._countdown(countdown.shape[:-1], countdown.device)
        next_tensordict.set(self.state_key, torch.where(countdown <= 1, fresh, countdown - 1))
        return next_tensordict
