"""A robot in MuJoCo, apart from the trainer: its own model, step, integrator and servos, and ways to disturb it.

The scene is the policy's `scene.xml`, stepped at 2 ms with the implicit integrator instead of the training's. Servos
are what motor drivers are: torque = stiffness (target - q), clipped to the effort limits, and damping, integrated
implicitly as the joint's. The object's joint has dry friction and damping from the middle of the training's ranges. The
clock is the simulation's, so that runs are as fast as the machine.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from hdmi.deploy.description import Description, PolicyError
from hdmi.deploy.format import scene_of
from hdmi.deploy.line import Line
from hdmi.deploy.robot import Reading
from hdmi.deploy.rotations import quat_from_euler, quat_from_rotation_vector, quat_multiply
from hdmi.deploy.scene import object_joints

MAX_VELOCITY = 1e3  # m/s or rad/s; beyond it the simulation counts as diverged


@dataclass
class Plant:
    """All disturbances are off; ranges are half ranges of uniform draws, once per episode or each reading."""

    seed: int = 0  # of the first episode; the others follow
    timestep: float = 0.002  # s
    integrator: str = "implicitfast"  # or euler
    start_noise: float = 1.0  # factor of the start's perturbations in training; 0: exactly the first frame
    gantry: float = 0.0  # s for which the root is held where the motion starts
    joint_pos_noise: float = 0.0  # rad, each reading
    joint_vel_noise: float = 0.0  # rad/s, each reading
    gyro_noise: float = 0.0  # rad/s, each reading
    gyro_bias: float = 0.0  # rad/s, each episode
    tilt_bias: float = 0.0  # rad that the IMU is mounted askew, about a random axis, each episode
    mocap_noise: float = 0.0  # m of positions and rad of the object's orientation, each frame of motion capture
    mocap_rate: float = 0.0  # Hz; 0: a frame each reading
    mocap_latency: float = 0.0  # s
    mocap_dropout: float = 0.0  # share of frames that are lost
    friction_loss: float = 0.0  # N m of dry friction in each joint
    effort_scale: float = 1.0  # factor of the motors' limits
    mass_scale: float = 1.0  # factor of the robot's masses and inertias
    floor_friction: float = 1.0  # factor of the robot's sliding friction
    viewer: bool = False  # a window


@dataclass
class Options(Plant):
    """The plant's, and how the runner is coupled to it."""

    servo_dt: float = 0.004  # s between commands
    action_delay: float = 0.0  # s from a command to the servos
    realtime: bool = False  # whether the clock keeps to the wall's


class MujocoRobot:
    """See the module; an object with sensors comes with the scene.

    Args:
        description: of the policy, whose servo gains and joints count.
        scene: path of the MJCF file.
        options: see `Options`.

    Attributes:
        model, data: MuJoCo's, the truth behind the sensors.
        object_body: id of the object, None without.

    Raises:
        PolicyError: if the scene lacks joints or the root of the policy.
    """

    def __init__(self, description: Description, scene: str | Path, options: Options | None = None):
        self.description, self.options = description, options or Options()
        if not Path(scene).is_file():
            raise PolicyError(f"{scene}: there is no such file; it belongs to the policy")
        try:
            self.model = model = mujoco.MjModel.from_xml_path(str(scene))
        except ValueError as error:
            raise PolicyError(f"{scene}: MuJoCo cannot read it: {str(error).splitlines()[0]}") from error
        self.data = mujoco.MjData(model)
        self.joint_names = description.joint_names
        self.servo_dt = self.options.servo_dt
        joints = self._ids(mujoco.mjtObj.mjOBJ_JOINT, self.joint_names, scene)
        self._qpos, self._dof = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self._servos = self._ids(mujoco.mjtObj.mjOBJ_ACTUATOR, self.joint_names, scene)
        self.root = int(self._ids(mujoco.mjtObj.mjOBJ_BODY, (description.root,), scene)[0])
        root_joint = model.body_jntadr[self.root]
        if root_joint < 0 or model.jnt_type[root_joint] != mujoco.mjtJoint.mjJNT_FREE:
            raise PolicyError(f"{scene}: body {description.root!r} has no free joint")
        self._root_qpos, self._root_dof = int(model.jnt_qposadr[root_joint]), int(model.jnt_dofadr[root_joint])
        self.object_body, self._object_free, self._object_hinge = object_joints(self.model)
        self._set_options()
        self._viewer: Any = None
        self._episode = -1
        self.reset()

    def _ids(self, kind: Any, names: tuple[str, ...], scene: str | Path) -> np.ndarray:
        ids = [mujoco.mj_name2id(self.model, kind, name) for name in names]
        if missing := [name for name, i in zip(names, ids, strict=True) if i < 0]:
            raise PolicyError(f"{scene}: has no {kind.name.removeprefix('mjOBJ_').lower()} {', '.join(missing)}")
        return np.array(ids)

    def _set_options(self) -> None:
        model, options, description = self.model, self.options, self.description
        model.opt.timestep = options.timestep
        integrators = {
            "euler": mujoco.mjtIntegrator.mjINT_EULER,
            "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
        }
        if options.integrator not in integrators:
            raise PolicyError(f"integrator: expected one of {', '.join(integrators)}, got {options.integrator!r}")
        model.opt.integrator = integrators[options.integrator]
        limits = description.effort_limits * options.effort_scale
        model.actuator_forcelimited[self._servos] = True
        model.actuator_forcerange[self._servos] = np.stack([-limits, limits], axis=1)
        model.dof_frictionloss[self._dof] += options.friction_loss
        if self._object_hinge is not None and description.object_joint:
            dof = model.jnt_dofadr[self._object_hinge]
            model.dof_frictionloss[dof] = description.object_joint["friction"].mean()
            model.dof_damping[dof] = description.object_joint["damping"].mean()
        robot = np.flatnonzero(model.body_rootid == model.body_rootid[self.root])
        model.body_mass[robot] *= options.mass_scale
        model.body_inertia[robot] *= options.mass_scale
        model.geom_friction[np.isin(model.geom_bodyid, robot), 0] *= options.floor_friction
        mujoco.mj_setConst(model, self.data)

    # -- episodes ---------------------------------------------------------------------------------------------

    def reset(self, episode: int | None = None) -> None:
        """Puts robot and object where the motion starts, perturbed, in damping, at time 0.

        Args:
            episode: whose draws; the next one if absent.
        """
        self._episode = self._episode + 1 if episode is None else episode
        self._rng = rng = np.random.default_rng([self.options.seed, self._episode])
        model, data, start, o = self.model, self.data, self.description.start, self.options
        mujoco.mj_resetData(model, data)

        def noise(name: str, shape: int) -> np.ndarray:
            half = np.asarray(self.description.start_noise.get(name, 0.0)) * o.start_noise
            return rng.uniform(-1.0, 1.0, shape) * half

        count, q, v = len(self._qpos), self._root_qpos, self._root_dof
        zero = np.zeros(3)
        middle, half = self.description.joint_ranges.mean(1), 0.475 * np.ptp(self.description.joint_ranges, axis=1)
        joint_pos = np.clip(start["joint_pos"] + noise("joint_pos", count), middle - half, middle + half)
        data.qvel[self._dof] = start.get("joint_vel", np.zeros(count)) + noise("joint_vel", count)
        quat = quat_multiply(start["root_quat_w"], quat_from_euler(noise("root_rpy", 3)))
        quat /= np.linalg.norm(quat)
        self.place(data, start["root_pos_w"] + noise("root_pos", 3), quat, joint_pos)
        data.qvel[v : v + 3] = start.get("root_lin_vel_w", zero) + noise("root_lin_vel", 3)
        ang_vel = start.get("root_ang_vel_w", zero) + noise("root_ang_vel", 3)
        inverse = np.zeros(4)
        mujoco.mju_negQuat(inverse, quat)
        mujoco.mju_rotVecQuat(data.qvel[v + 3 : v + 6], ang_vel, inverse)  # MuJoCo's is in the body
        if self._object_free is not None and "object_pos_w" in start:
            at = model.jnt_qposadr[self._object_free]
            data.qpos[at : at + 3] = start["object_pos_w"] + noise("object_pos", 3)
            turned = quat_multiply(start["object_quat_w"], quat_from_euler(noise("object_rpy", 3)))
            data.qpos[at + 3 : at + 7] = turned / np.linalg.norm(turned)
        if self._object_hinge is not None and "object_joint_pos" in start:
            at = model.jnt_qposadr[self._object_hinge]
            data.qpos[at] = start["object_joint_pos"][0] + noise("object_joint", 1)[0]
        self.held_until = o.gantry
        self._held = data.qpos[q : q + 7].copy() if o.gantry > 0 else None
        if self._held is not None:
            data.qvel[:] = 0.0
        self._gyro_bias = rng.uniform(-1.0, 1.0, 3) * o.gyro_bias
        axis = rng.normal(size=3)
        self._askew = quat_from_rotation_vector(axis / np.linalg.norm(axis) * rng.uniform(-1.0, 1.0) * o.tilt_bias)
        self._commands: deque[tuple[float, np.ndarray, np.ndarray, np.ndarray]] = deque()
        self._mocap: dict[str, np.ndarray] = {}
        self._mocap_next = 0.0
        self._captured = Line[dict[str, np.ndarray]](o.mocap_latency, o.mocap_dropout, rng)
        self._shown = 0.0
        self._wall = time.perf_counter()
        self.damp()
        mujoco.mj_forward(model, data)
        # the robot has stood there for a while: a frame has arrived
        self._mocap_stamp, self._mocap = -o.mocap_latency, self._frame()

    @property
    def diverged(self) -> bool:
        """Whether the state is not finite or absurdly fast."""
        # a NaN fails the comparison
        return not (np.abs(self.data.qvel).max() < MAX_VELOCITY and np.isfinite(self.data.qpos.sum()))

    def joint_pos(self) -> np.ndarray:
        """The joints' true positions, rad. [J]"""
        return self.data.qpos[self._qpos]

    def place(
        self, data: mujoco.MjData, root_pos_w: np.ndarray, root_quat_w: np.ndarray, joint_pos: np.ndarray
    ) -> None:
        """Writes a pose of the robot into data of its model. m [3], wxyz [4], rad [J]"""
        q = self._root_qpos
        data.qpos[q : q + 3], data.qpos[q + 3 : q + 7], data.qpos[self._qpos] = root_pos_w, root_quat_w, joint_pos

    def object_joint_pos(self) -> np.ndarray:
        """Angle of the object's hinge, rad. [1], or [0] without one"""
        if self._object_hinge is None:
            return np.zeros(0)
        return self.data.qpos[self.model.jnt_qposadr[self._object_hinge]].reshape(1).copy()

    def poses(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """True poses of `root`, `object` and the `part` that its hinge moves, as far as there are any: m and wxyz."""
        bodies = {"root": self.root, "object": self.object_body}
        bodies["part"] = None if self._object_hinge is None else int(self.model.jnt_bodyid[self._object_hinge])
        data = self.data
        return {name: (data.xpos[i].copy(), data.xquat[i].copy()) for name, i in bodies.items() if i is not None}

    # -- the protocol -----------------------------------------------------------------------------------------

    def time(self) -> float:
        return float(self.data.time)

    def wait(self, until: float) -> None:
        timestep = self.model.opt.timestep
        # half a step early, so that rounding cannot add one
        while self.data.time < until - 0.5 * timestep:
            while self._commands and self._commands[0][0] <= self.data.time + 0.5 * timestep:
                self.servo(*self._commands.popleft()[1:])
            if self._held is not None:
                self._hold()
            mujoco.mj_step(self.model, self.data)
        mujoco.mj_kinematics(self.model, self.data)  # a step leaves the poses of the state before it
        if self.options.viewer:
            self._show()
        if self.options.realtime:
            ahead = self.data.time - (time.perf_counter() - self._wall)
            if ahead > 0:
                time.sleep(ahead)

    def _hold(self) -> None:
        q, v = self._root_qpos, self._root_dof
        if self.data.time >= self.held_until:
            self._held = None
            return
        self.data.qpos[q : q + 7] = self._held
        self.data.qvel[v : v + 6] = 0.0

    def onboard(self) -> dict[str, np.ndarray]:
        """What encoders and IMU measure now, by name."""
        data, o, rng = self.data, self.options, self._rng
        q, v = self._root_qpos, self._root_dof

        def noisy(values: np.ndarray, half: float) -> np.ndarray:
            return values + rng.uniform(-half, half, values.shape) if half else values.copy()

        return {
            "joint_pos": noisy(data.qpos[self._qpos], o.joint_pos_noise),
            "joint_vel": noisy(data.qvel[self._dof], o.joint_vel_noise),
            "root_quat_w": quat_multiply(data.qpos[q + 3 : q + 7], self._askew),
            "root_ang_vel_b": noisy(data.qvel[v + 3 : v + 6] + self._gyro_bias, o.gyro_noise),
        }

    def read(self) -> Reading:
        now, sensors = self.time(), self.onboard()
        stamps = dict.fromkeys(sensors, now)
        self._capture(now)
        sensors |= self._mocap
        stamps |= dict.fromkeys(self._mocap, self._mocap_stamp)
        return Reading(now, sensors, stamps)

    def _capture(self, now: float) -> None:
        """A frame of motion capture, and what has arrived of the ones before."""
        o = self.options
        if now >= self._mocap_next - 1e-9:
            self._mocap_next = now + 1.0 / o.mocap_rate if o.mocap_rate else now
            self._captured.put(now, self._frame)
        if arrived := self._captured.due(now):
            self._mocap_stamp, self._mocap = arrived[-1]

    def _frame(self) -> dict[str, np.ndarray]:
        """What motion capture sees now."""
        data, rng, half = self.data, self._rng, self.options.mocap_noise
        frame = {"root_pos_w": data.qpos[self._root_qpos : self._root_qpos + 3] + rng.uniform(-half, half, 3)}
        if self.object_body is not None:
            turn = quat_from_rotation_vector(rng.uniform(-half, half, 3))
            frame["object_pos_w"] = data.xpos[self.object_body] + rng.uniform(-half, half, 3)
            frame["object_quat_w"] = quat_multiply(data.xquat[self.object_body], turn)
            if self._object_hinge is not None:
                frame["object_joint_pos"] = self.object_joint_pos() + rng.uniform(-half, half, 1)
        return frame

    def command(self, target: np.ndarray, stiffness: np.ndarray, damping: np.ndarray) -> None:
        if self.options.action_delay <= 0:
            self.servo(target, stiffness, damping)
            return
        at = float(self.data.time) + self.options.action_delay
        self._commands.append((at, np.array(target), np.array(stiffness), np.array(damping)))

    def servo(
        self,
        target: np.ndarray,
        stiffness: np.ndarray,
        damping: np.ndarray,
        velocity: np.ndarray | float = 0.0,
        torque: np.ndarray | float = 0.0,
    ) -> None:
        """What the servos do from now on: stiffness (target - q) + damping (velocity - qd) + torque, within limits.

        Damping by the joint's own velocity is the joint's, and not limited.

        Args:
            target: rad [J].
            stiffness, damping: N m/rad and N m s/rad [J].
            velocity: rad/s [J].
            torque: N m [J].
        """
        model, servos = self.model, self._servos
        model.actuator_gainprm[servos, 0] = stiffness
        model.actuator_biasprm[servos, 0] = damping * velocity + torque
        model.actuator_biasprm[servos, 1] = -np.asarray(stiffness)
        model.dof_damping[self._dof] = damping
        self.data.ctrl[servos] = target

    def damp(self) -> None:
        self._commands.clear()
        zero = np.zeros(len(self._servos))
        self.servo(zero, zero, self.description.damping)

    def remarks(self) -> tuple[str, ...]:
        return ()

    def close(self) -> None:
        self.damp()
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None

    def _show(self) -> None:
        if self._viewer is not None and 0.0 <= self.data.time - self._shown < 0.01:
            return
        self._shown = float(self.data.time)
        if self._viewer is None:
            import mujoco.viewer

            self._viewer = mujoco.viewer.launch_passive(self.model, self.data)
        self._viewer.sync()


def connect(description: Description, folder: Path, options: Options) -> MujocoRobot:
    """The robot of a policy's `scene.xml`, or of the MJCF file that is given instead of the folder.

    Raises:
        PolicyError: if the file is not there or is another robot's.
    """
    return MujocoRobot(description, scene_of(folder), options)
