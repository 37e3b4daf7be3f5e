"""The base environment: raw physics state of a robot, an object and their contacts, for N worlds at once."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded, UnboundedDiscrete
from torchrl.envs import EnvBase

from hdmi.assets import Scene
from hdmi.envs.backend import BatchBackend, PhysicsBackend, assign
from hdmi.envs.rendering import WorldRenderer
from hdmi.functional import body_velocity, quat_apply_inverse

# Model fields of which `set_const` must know.
_SET_CONST_FIELDS = frozenset(mujoco.MjModel._setconst_inputs)


class HumanoidObjectEnv(EnvBase):
    """N worlds of one scene as a batch-locked TorchRL environment of raw state.

    There is no reward and no task here: transforms add them. `terminated` is set only for a world whose physics
    diverged; it is counted in `num_diverged` and shows the default state. A backend that takes masks leaves it as it
    is until it is reset (and counts it in every step until then); others put it back into the default state at once.

    Action:
        `action`: joint position targets, rad. [N, J], held for the control step; or [N, S, J], one after
        another for decimation / S physics steps each. Optionally `push` [N, 6]: linear (m/s) and angular (rad/s)
        world velocity to add to the root first; `wrench/root` and `wrench/object` [N, 6]: force (N) and moment
        (N m) about the body's origin, world frame, during the step.

    Writes (float32, world frame, quaternions wxyz; J joints, B bodies, F feet, K object joints, E effectors):
        `robot/{joint_pos, joint_vel, joint_torque, joint_target}` [N, J];
        `robot/{root_pos, root_lin_vel, root_ang_vel}` [N, 3]; `robot/root_quat` [N, 4];
        `robot/{body_pos, body_lin_vel, body_ang_vel}` [N, B, 3]; `robot/body_quat` [N, B, 4];
        `robot/foot_force` [N, F, 3], N, on the feet;
        with an object: `object/{pos, lin_vel, ang_vel, link_pos}` [N, 3], `object/{quat, link_quat}` [N, 4] (the
        link carries the contact points; for a rigid object it is the object), `object/{joint_pos, joint_vel}`
        [N, K], `object/{scale, mass, friction}` [N, 1]; `contact/force` [N, E, 3], N, of the object on the effectors;
        `diverged` bool [N, 1]; `pixels` uint8 [N, H, W, 3] if asked for.

    Reads on reset, all optional, under `init`: `root_pos`, `root_quat`, `root_lin_vel`, `root_ang_vel` (world),
        `joint_pos`, `joint_vel`, `object_pos`, `object_quat`, `object_lin_vel`, `object_ang_vel`,
        `object_joint_pos`, `object_joint_vel`, `object_scale` [N, 1], `scenery_pos` [N, S, 3] of the S pieces of
        scenery, and `model/<MjModel field>` [N, ...].
        What is not given is the model's default.

    Args:
        scene: compiled by `hdmi.assets.build_scene`.
        num_envs: N.
        backend: makes a physics backend from a model and N; MuJoCo's CPU `Batch` by default.
        pixels: (height, width) to add rendered `pixels`.

    Examples:
        >>> from hdmi.assets import RobotConfig, SimConfig, build_scene
        >>> env = HumanoidObjectEnv(build_scene(RobotConfig(), SimConfig()), num_envs=2)
        >>> td = env.reset()
        >>> td["action"] = td["robot", "joint_pos"]  # servos hold the pose
        >>> env.step(td)["next", "robot", "body_pos"].shape
        torch.Size([2, 30, 3])
    """

    batch_locked = True

    def __init__(
        self,
        scene: Scene,
        num_envs: int,
        backend: Callable[[mujoco.MjModel, int], PhysicsBackend] = BatchBackend,
        pixels: tuple[int, int] | None = None,
    ):
        self.backend = backend(scene.model, num_envs)
        super().__init__(device=self.backend.device, batch_size=[num_envs])
        self.scene = scene
        self._pixels = pixels
        self._renderer: WorldRenderer | None = None
        self._joint_qpos = _slice(scene.joint_qpos)
        self._joint_dof = _slice(scene.joint_dof)
        self._body = _slice(scene.body_ids)
        self._standing: dict[str, Tensor | None] = {}  # rows that all worlds have
        self._make_constants()
        self._make_specs()
        self._fallback = self._default_state() if self.backend.masked else None

    @property
    def num_envs(self) -> int:
        """Number of worlds."""
        return self.batch_size[0]

    @property
    def num_diverged(self) -> int:
        """Worlds that have diverged so far. Reading it waits for the device."""
        return int(self._diverged)

    @num_diverged.setter
    def num_diverged(self, count: int) -> None:
        self._diverged.fill_(count)

    def _make_constants(self) -> None:
        """Tensors on the backend's device: what is made in a step from the host's memory would stop it."""
        scene, model = self.scene, self.scene.model

        def constant(values: object) -> Tensor:
            return torch.as_tensor(np.array(values), device=self.device)

        self._diverged = torch.zeros((), dtype=torch.int64, device=self.device)
        self._everyone = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        self._scenery = constant(scene.scenery_bodies)
        self._object_scale = torch.ones(self.num_envs, 1, device=self.device)
        self._default_qpos = constant(scene.default_qpos).to(self.backend.data("qpos").dtype)
        self._body_root = constant(model.body_rootid).long()
        # the servo's derivative gain is the joint's damping
        self._servo_damping = constant(model.dof_damping[scene.joint_dof]).float()
        self._foot_sensors = constant(scene.foot_sensors)
        self._effector_sensors = constant(scene.effector_sensors)
        self._object_geoms = _slice(scene.object_geoms) if len(scene.object_geoms) else slice(0)
        # what grows with the object: fields of its geoms, and where its link is hinged
        self._scaled = {"geom_size": self._object_geoms, "geom_pos": self._object_geoms}
        if scene.object_link is not None and scene.num_object_joints:
            self._scaled["body_pos"] = slice(scene.object_link, scene.object_link + 1)
        self._unscaled = {field: constant(getattr(model, field)[index]) for field, index in self._scaled.items()}
        bodies = sorted({i for i in (scene.object_body, scene.object_link) if i is not None})
        self._object_bodies = constant(np.array(bodies, dtype=np.int64))

    # -- specs ------------------------------------------------------------------------------------------------

    def _make_specs(self) -> None:
        n, scene = self.num_envs, self.scene
        joints, bodies, effectors = len(scene.joint_dof), len(scene.body_ids), len(scene.effectors)

        def unbounded(*shape: int) -> Unbounded:
            return Unbounded(shape=(n, *shape), device=self.device, dtype=torch.float32)

        robot = {key: unbounded(joints) for key in ("joint_pos", "joint_vel", "joint_torque", "joint_target")}
        robot |= {key: unbounded(bodies, 3) for key in ("body_pos", "body_lin_vel", "body_ang_vel")}
        robot |= {key: unbounded(3) for key in ("root_pos", "root_lin_vel", "root_ang_vel")}
        robot |= {
            "body_quat": unbounded(bodies, 4),
            "root_quat": unbounded(4),
            "foot_force": unbounded(len(scene.foot_sensors), 3),
        }
        spec: dict[str, object] = {"robot": Composite(robot, shape=(n,))}
        if scene.object_body is not None:
            k = scene.num_object_joints
            spec["object"] = Composite(
                {key: unbounded(3) for key in ("pos", "lin_vel", "ang_vel", "link_pos")}
                | {key: unbounded(4) for key in ("quat", "link_quat")}
                | {key: unbounded(k) for key in ("joint_pos", "joint_vel")}
                | {key: unbounded(1) for key in ("scale", "mass", "friction")},
                shape=(n,),
            )
            spec["contact"] = Composite({"force": unbounded(effectors, 3)}, shape=(n,))
        spec["diverged"] = Binary(n=1, shape=(n, 1), dtype=torch.bool, device=self.device)
        if self._pixels is not None:
            spec["pixels"] = UnboundedDiscrete(shape=(n, *self._pixels, 3), dtype=torch.uint8, device=self.device)
        self.observation_spec = Composite(spec, shape=(n,))
        self.action_spec = unbounded(joints)
        self.reward_spec = unbounded(1)
        self.done_spec = Composite(
            {
                key: Binary(n=1, shape=(n, 1), dtype=torch.bool, device=self.device)
                for key in ("done", "terminated", "truncated")
            },
            shape=(n,),
        )

    # -- stepping ---------------------------------------------------------------------------------------------

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action")
        targets = action.unsqueeze(-2) if action.ndim == 2 else action  # [N, S, J]
        decimation, count = self.scene.sim.decimation, targets.shape[-2]
        if decimation % count:
            raise ValueError(f"action: {count} targets per control step do not divide the decimation {decimation}")
        push = tensordict.get("push", None)
        if push is not None:
            self._push(push)
        wrenches = tensordict.get("wrench", None)
        if wrenches is not None:
            self._pull(wrenches)
        self.backend.step(targets.repeat_interleave(decimation // count, dim=1))
        if wrenches is not None:
            self.backend.data("xfrc_applied").zero_()  # it would act in later steps, too
        failed = self.backend.failed()
        out = self._survivors(failed)
        terminated = failed.unsqueeze(-1)
        out.set("diverged", terminated)
        out.set("reward", torch.zeros(self.num_envs, 1, device=self.device))
        out.set("terminated", terminated.clone())
        out.set("truncated", torch.zeros_like(terminated))
        out.set("done", terminated.clone())
        return out

    def _survivors(self, failed: Tensor) -> TensorDict:
        """The state of all worlds, of those that failed the default one. bool [N]"""
        if self._fallback is not None:
            # whether any has failed is not known on the host, and a reset of none costs as much as one of all
            self._diverged += failed.sum()
            return self._fallback.where(failed, self._state(slice(None)))
        if failed.any():
            self._diverged += failed.sum()
            self.place(failed.nonzero().squeeze(-1), None)
        return self._state(slice(None))

    def _push(self, velocity: Tensor) -> None:
        """Adds linear and angular world velocities to the root. [N, 6]"""
        qvel, quat = self.backend.data("qvel"), self.backend.data("qpos")[:, 3:7]
        velocity = velocity.to(qvel.dtype)
        qvel[:, :3] += velocity[:, :3]
        qvel[:, 3:6] += quat_apply_inverse(quat, velocity[:, 3:])
        self.backend.refresh((velocity != 0).any(-1))

    def _pull(self, wrenches: TensorDictBase) -> None:
        """Applies forces and moments about the origins of the root and the object during the step. [N, 6] each"""
        applied = self.backend.data("xfrc_applied")
        bodies = {"root": int(self.scene.body_ids[0]), "object": self.scene.object_body}
        for name, wrench in wrenches.items():
            body = bodies[name]
            force, moment = wrench.to(applied.dtype).split(3, dim=-1)
            # MuJoCo's act on the centre of mass
            lever = self.backend.data("xpos")[:, body] - self.backend.data("xipos")[:, body]
            applied[:, body] = torch.cat([force, moment + torch.linalg.cross(lever, force)], dim=-1)

    def _reset(self, tensordict: TensorDictBase | None, **kwargs) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        init = None if tensordict is None else tensordict.get("init", None)
        self.place(self._everyone if mask is None else mask.reshape(-1), init)
        return self.show(slice(None))

    def show(self, worlds: Tensor | slice) -> TensorDict:
        """What `reset` writes, of some worlds, as they are.

        Args:
            worlds: their numbers, int64 [n], or `slice(None)` for all.

        Returns:
            Batch [n].
        """
        out = self._state(worlds)
        for key in ("diverged", "done", "terminated", "truncated"):
            out.set(key, torch.zeros(*out.batch_size, 1, dtype=torch.bool, device=self.device))
        return out

    def _set_seed(self, seed: int | None) -> None:
        # physics is deterministic; what is random is drawn by transforms from torch's generator
        if seed is not None:
            torch.manual_seed(seed)

    def get_state(self) -> TensorDict:
        """Everything that determines the future of all worlds: state and randomized model fields."""
        return TensorDict({"backend": TensorDict(self.backend.get_state()), "object_scale": self._object_scale.clone()})

    def set_state(self, state: TensorDictBase) -> None:
        """Restores what `get_state` returned."""
        self._standing.clear()
        self._object_scale.copy_(state["object_scale"])
        self.backend.set_state(dict(state["backend"].items()))

    # -- reset ------------------------------------------------------------------------------------------------

    def place(self, worlds: Tensor, init: TensorDictBase | None) -> None:
        """Puts worlds into the model's default state, overwritten by what `init` gives; `show` tells what that is.

        Args:
            worlds: numbers, int64 [n], with an `init` of batch [n]; or a mask, bool [N], with an `init` of batch [N].
        """
        backend, scene = self.backend, self.scene
        init = TensorDict({}, batch_size=worlds.shape) if init is None else init
        self._write_model(worlds, init)
        backend.reset(worlds)
        qpos = self._default_qpos.expand(len(worlds), -1).clone()
        qvel = qpos.new_zeros(len(worlds), scene.model.nv)

        def write(target: Tensor, where: slice | int | None, key: str) -> None:
            value = init.get(key, None)
            if value is not None and where is not None:
                target[:, where] = value.to(target.dtype)

        write(qpos, slice(0, 3), "root_pos")
        write(qpos, slice(3, 7), "root_quat")
        write(qvel, slice(0, 3), "root_lin_vel")
        write(qvel, slice(3, 6), "root_ang_vel")
        write(qpos, self._joint_qpos, "joint_pos")
        write(qvel, self._joint_dof, "joint_vel")
        # MuJoCo's free joints turn in the body frame
        qvel[:, 3:6] = quat_apply_inverse(qpos[:, 3:7], qvel[:, 3:6])
        if (q := scene.object_free_qpos) is not None and (v := scene.object_free_dof) is not None:
            write(qpos, slice(q, q + 3), "object_pos")
            write(qpos, slice(q + 3, q + 7), "object_quat")
            write(qvel, slice(v, v + 3), "object_lin_vel")
            write(qvel, slice(v + 3, v + 6), "object_ang_vel")
            qvel[:, v + 3 : v + 6] = quat_apply_inverse(qpos[:, q + 3 : q + 7], qvel[:, v + 3 : v + 6])
        if (q := scene.object_hinge_qpos) is not None and (v := scene.object_hinge_dof) is not None:
            write(qpos, slice(q, q + 1), "object_joint_pos")
            write(qvel, slice(v, v + 1), "object_joint_vel")

        assign(backend.data("qpos"), worlds, qpos)
        assign(backend.data("qvel"), worlds, qvel)
        assign(backend.data("ctrl"), worlds, qpos[:, self._joint_qpos])
        backend.refresh(worlds)

    def _write_model(self, worlds: Tensor, init: TensorDictBase) -> None:
        commit = False
        fields = init.get("model", None)
        for field, value in () if fields is None else fields.items():
            if self._changes(field, worlds, value):
                assign(self.backend.model(field), worlds, value)
                commit |= field in _SET_CONST_FIELDS
        scale = init.get("object_scale", None)
        if scale is not None and self._changes("object_scale", worlds, scale):
            assign(self._object_scale, worlds, scale)
            for field, index in self._scaled.items():
                assign(self.backend.model(field)[:, index], worlds, scale.unsqueeze(-1) * self._unscaled[field])
            commit = True
        scenery = init.get("scenery_pos", None)
        if scenery is not None:  # static: no constant depends on where they are
            rows = self.backend.model("body_pos")[:, self._scenery]
            assign(rows, worlds, scenery)
            self.backend.model("body_pos")[:, self._scenery] = rows
        if commit:
            self.backend.commit_model(worlds)

    def _changes(self, name: str, worlds: Tensor, rows: Tensor) -> bool:
        """Whether not all worlds have been given these very rows before, as by what is drawn once per world."""
        if self._standing.get(name) is rows:
            return False
        self._standing[name] = rows if worlds is self._everyone else None
        return True

    # -- reading ----------------------------------------------------------------------------------------------

    def _state(self, rows: Tensor | slice) -> TensorDict:
        """Copies the live arrays into fresh float32 tensors: collectors keep references to what they are given."""
        scene = self.scene

        def read(field: str) -> Tensor:
            return self.backend.data(field)[rows].to(torch.float32, copy=True)

        xpos, xquat = read("xpos"), read("xquat")  # [N, nbody, *]
        com = read("subtree_com").index_select(1, self._body_root)  # a quarter of the time that indexing takes
        lin_vel, ang_vel = body_velocity(read("cvel"), xpos, com)
        qpos, qvel, sensors = read("qpos"), read("qvel"), read("sensordata")
        joint_vel = qvel[:, self._joint_dof]
        robot = {
            "joint_pos": qpos[:, self._joint_qpos],
            "joint_vel": joint_vel,
            "joint_torque": read("actuator_force") - self._servo_damping * joint_vel,
            "joint_target": read("ctrl"),
            "body_pos": xpos[:, self._body],
            "body_quat": xquat[:, self._body],
            "body_lin_vel": lin_vel[:, self._body],
            "body_ang_vel": ang_vel[:, self._body],
            # the sensors report what the robot exerts; what it feels is the opposite
            "foot_force": -sensors[:, self._foot_sensors],
        }
        robot |= {f"root_{key}": robot[f"body_{key}"][:, 0] for key in ("pos", "quat", "lin_vel", "ang_vel")}
        n = len(qpos)
        bs = torch.Size([n])
        state = {"robot": TensorDict(robot, batch_size=bs, device=self.device)}
        if scene.object_body is not None:
            body, link = scene.object_body, scene.object_link
            hinge_q, hinge_v = scene.object_hinge_qpos, scene.object_hinge_dof
            mass = self.backend.model("body_mass")[:, self._object_bodies].sum(-1, keepdim=True)
            friction = self.backend.model("geom_friction")[:, int(scene.object_geoms[-1]), :1]
            object_ = {
                "pos": xpos[:, body],
                "quat": xquat[:, body],
                "lin_vel": lin_vel[:, body],
                "ang_vel": ang_vel[:, body],
                "link_pos": xpos[:, link],
                "link_quat": xquat[:, link],
                "joint_pos": qpos.new_zeros(n, 0) if hinge_q is None else qpos[:, hinge_q : hinge_q + 1],
                "joint_vel": qpos.new_zeros(n, 0) if hinge_v is None else qvel[:, hinge_v : hinge_v + 1],
                "scale": self._object_scale[rows].clone(),
                "mass": mass[rows].to(torch.float32),
                "friction": friction[rows].to(torch.float32, copy=True),
            }
            force = -sensors[:, self._effector_sensors]
            state["object"] = TensorDict(object_, batch_size=bs, device=self.device)
            state["contact"] = TensorDict({"force": force}, batch_size=bs, device=self.device)
        out = TensorDict(state, batch_size=bs, device=self.device)
        if self._pixels is not None:
            worlds = torch.arange(self.num_envs, device=self.device)[rows].tolist()
            frames = np.stack([self.render(i, *self._pixels) for i in worlds])
            out.set("pixels", torch.from_numpy(frames).to(self.device))
        return out

    def penetration(self) -> Tensor:
        """Depth of the object's deepest contact in each world, m, as its state was last refreshed by a reset. [N]"""
        sensors, address = self.backend.data("sensordata"), self.scene.penetration_sensor
        return sensors.new_zeros(self.num_envs) if address is None else -sensors[:, address].clamp(max=0)

    def _default_state(self) -> TensorDict:
        """What any world shows in the default state. Batch [N], one row's memory."""
        self.place(self._everyone, None)
        return self._state(torch.zeros(1, dtype=torch.int64, device=self.device)).expand(self.batch_size)

    def render(self, index: int = 0, height: int = 480, width: int = 640) -> np.ndarray:
        """A picture of one world from a camera that follows the robot. uint8 [height, width, 3]

        Raises:
            RenderingError: if no rendering back end works; says what to install.
        """
        if self._renderer is None:
            self._renderer = WorldRenderer(self.scene.model, self.scene.robot, height, width)
        model, data = self.backend.world(index)
        return self._renderer(model, data, height, width)

    def close(self, *, raise_if_closed: bool = True) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        super().close(raise_if_closed=raise_if_closed)


def _slice(index: np.ndarray) -> slice:
    """Consecutive indices as a slice, which reads without gathering."""
    if not (np.diff(index) == 1).all():
        raise ValueError(f"expected consecutive addresses, got {index.tolist()}")
    return slice(int(index[0]), int(index[-1]) + 1)
