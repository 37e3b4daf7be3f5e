"""A network of others in the place of an exported policy: from sensors to joint position targets, tick by tick."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from hdmi.deploy.description import Description, PolicyError
from hdmi.deploy.foreign.kinematics import Kinematics
from hdmi.deploy.foreign.motion import Motion, motion_of, read_motion
from hdmi.deploy.foreign.schema import NETWORK, NetworkSpec, per_joint, read_spec
from hdmi.deploy.foreign.stack import Graph, Stack
from hdmi.deploy.foreign.terms import Moment, sensors_of
from hdmi.deploy.policy import OutputError, checked_sensors
from hdmi.deploy.rotations import quat_apply_inverse, tilt_of

MAX_FRAMES = 100_000  # of a motion that a network gives itself
_OUTPUTS = ("joint_pos", "joint_vel", "body_pos_w", "body_quat_w")


class ForeignPolicy:
    """Runs what a YAML describes; the interface is that of `hdmi.deploy.policy.Policy`.

    Args:
        path: of the YAML.
        spec: instead of what the file says.

    Attributes:
        description: of robot and motion, as the runner wants it.
        sensors: names of the sensors that the terms depend on.
        scene: path of the scene's file.
        motion, kinematics, stack: what the terms are computed from.
        digest: SHA-256 of YAML and network.
        frame: of the motion that the last call was about; -1 before the first.

    Raises:
        PolicyError: if a file is missing or wrong, or files do not fit each other; names file and key.
    """

    def __init__(self, path: str | Path, spec: NetworkSpec | None = None):
        self.path = Path(path)
        self.spec = spec = read_spec(path) if spec is None else spec
        folder, where = self.path.parent, str(path)
        graph = Graph(folder / spec.network)
        self.scene = folder / spec.scene
        self.kinematics = Kinematics(self.scene, spec.joints)
        if spec.motion == NETWORK:
            self.motion = network_motion(graph, spec, self.kinematics)
        else:
            self.motion = read_motion(folder / spec.motion, spec, self.kinematics)
        self.stack = Stack(spec, self.motion, graph, self.kinematics.body_names, where)
        terms = [term.spec for terms in self.stack.observer.terms.values() for term in terms]
        self.sensors = tuple(sorted(set().union(*(sensors_of(term, self.kinematics.root) for term in terms))))
        self.description = describe(spec, self.kinematics, self.motion, where)
        for name in self.sensors:
            if name not in self.description.sensors:
                users = [term.term for term in terms if name in sensors_of(term, self.kinematics.root)]
                raise PolicyError(f"{where}: {', '.join(users)}: depends on {name}, of an object; give `object`")
        self.digest = hashlib.sha256(self.path.read_bytes() + graph.content).hexdigest()
        self.stack.check_widths(self.in_motion(np.zeros(1, dtype=int)))
        self.reset()

    @property
    def reference(self) -> dict[str, np.ndarray]:
        """The motion as `hdmi.deploy.trial.read_reference` gives it."""
        return self.motion.reference()

    def reset(self, start_frame: int = 0) -> None:
        """The next call is the first of an episode, at a frame of the motion.

        Raises:
            ValueError: for a frame that the motion does not have.
        """
        if not 0 <= start_frame < self.motion.num_frames:
            raise ValueError(f"start_frame: expected 0 to {self.motion.num_frames - 1}, got {start_frame}")
        self.frame = start_frame - 1
        self._fresh = True
        self._root_pos = self.motion.body_pos_w[start_frame, 0]

    @property
    def finished(self) -> bool:
        """Whether the last call was about the motion's last frame."""
        return self.frame >= self.motion.num_frames - 1

    def __call__(self, sensors: Mapping[str, np.ndarray]) -> np.ndarray:
        """Joint position targets of this control step, rad. float32 [J]

        Args:
            sensors: those of `self.sensors`, by name; further known ones are ignored.

        Raises:
            SensorError: if one is missing, unknown, of a wrong shape or not finite.
            OutputError: if the result is not finite; the state stays as it was.
        """
        given = checked_sensors(sensors, self.sensors, self.description.sensors, float)
        frame = min(self.frame + 1, self.motion.num_frames - 1)
        before = self.stack.memory
        target = self.stack(self._moment(given, frame), np.array(self._fresh)).astype(np.float32)
        if not np.isfinite(target).all():
            self.stack.memory = before
            raise OutputError(f"the target is not finite at frame {frame}")
        self.frame, self._fresh = frame, False
        self._root_pos = given.get("root_pos_w", self._root_pos)
        return target

    def _moment(self, given: Mapping[str, np.ndarray], frame: int) -> Moment:
        """What the terms see; of what no term needs, the motion."""
        motion, root = self.motion, self.motion.body_pos_w[frame, 0]
        joint_pos = given.get("joint_pos", motion.joint_pos[frame])
        root_pos = given.get("root_pos_w", root)
        poses = self.kinematics(root_pos, given.get("root_quat_w", motion.body_quat_w[frame, 0]), joint_pos)
        velocity = (root_pos - self._root_pos) / self.spec.control_dt
        now = Moment(
            step=np.array(frame),
            joint_pos=joint_pos,
            joint_vel=given.get("joint_vel", motion.joint_vel[frame]),
            body_pos_w=poses[0],
            body_quat_w=poses[1],
            root_lin_vel_w=motion.body_lin_vel_w[frame, 0] if self._fresh else velocity,
            root_ang_vel_b=given.get("root_ang_vel_b", np.zeros(3)),
            action=self.stack.last_action(np.array(self._fresh)),
        )
        return self._with_object(now, {name: value for name, value in given.items() if name.startswith("object_")})

    def _with_object(self, now: Moment, measured: Mapping[str, np.ndarray]) -> Moment:
        """The moment with the object, as far as it is measured, and its link."""
        now = replace(now, **measured)
        if not {"object_pos_w", "object_quat_w"} <= set(measured):
            return now
        joint_pos = measured.get("object_joint_pos")
        pos, quat = self.kinematics.link(self.spec.object, now.object_pos_w, now.object_quat_w, joint_pos)
        return replace(now, link_pos_w=pos, link_quat_w=quat)

    def in_motion(self, frames: np.ndarray) -> Moment:
        """What the terms see of a robot that is exactly in the motion. int [N]"""
        motion, base = self.motion, self.stack.base(frames)
        driven, scale = self.stack.driven, self.stack.scale
        offset = (motion.joint_pos[frames] - base)[..., driven]
        now = Moment(
            step=frames,
            joint_pos=motion.joint_pos[frames],
            joint_vel=motion.joint_vel[frames],
            body_pos_w=motion.body_pos_w[frames],
            body_quat_w=motion.body_quat_w[frames],
            root_lin_vel_w=motion.body_lin_vel_w[frames, 0],
            root_ang_vel_b=quat_apply_inverse(motion.body_quat_w[frames, 0], motion.body_ang_vel_w[frames, 0]),
            # what asks for the motion's joint positions
            action=np.divide(offset, scale, out=np.zeros_like(offset), where=scale != 0),
        )
        reference = {name: value[frames] for name, value in motion.reference().items()}
        return self._with_object(now, {name: value for name, value in reference.items() if name.startswith("object_")})


def describe(spec: NetworkSpec, kinematics: Kinematics, motion: Motion, where: str) -> Description:
    """What the runner has to know, from the YAML, the scene and the motion.

    Raises:
        PolicyError: for values per joint that cannot be used.
    """
    joints, count = spec.joints, len(spec.joints)
    for name, names, there in (
        ("tracked_joints", spec.tracked_joints, joints),
        ("tracked_bodies", spec.tracked_bodies, kinematics.body_names),
    ):
        if unknown := [item for item in names if item not in there]:
            raise PolicyError(f"{where}.{name}: there is no {', '.join(unknown)}; there is {', '.join(there)}")

    def numbers(name: str, default: np.ndarray | None = None) -> np.ndarray:
        values = getattr(spec, name)
        return default if values is None else per_joint(values, joints, f"{where}.{name}")  # type: ignore[return-value]

    sensors = {"joint_pos": (count,), "joint_vel": (count,), "root_quat_w": (4,), "root_ang_vel_b": (3,)}
    sensors |= {"root_pos_w": (3,)}
    if motion.object_pos_w.shape[-1]:
        sensors |= {"object_pos_w": (3,), "object_quat_w": (4,)}
        if motion.object_joint_pos.shape[-1]:
            sensors["object_joint_pos"] = (1,)
    start = {name: value[0] for name, value in motion.reference().items()} | {
        "joint_vel": motion.joint_vel[0],
        "root_lin_vel_w": motion.body_lin_vel_w[0, 0],
        "root_ang_vel_w": motion.body_ang_vel_w[0, 0],
    }
    return Description(
        robot=spec.robot,
        task=spec.task,
        motion=motion.name,
        num_frames=motion.num_frames,
        control_dt=spec.control_dt,
        joint_names=joints,
        stiffness=numbers("stiffness"),
        damping=numbers("damping"),
        default_joint_pos=numbers("default_pose"),
        effort_limits=numbers("effort_limits", kinematics.effort_limits),
        velocity_limits=numbers("velocity_limits", np.full(count, np.inf)),
        joint_ranges=kinematics.joint_ranges,
        root=kinematics.root,
        sensors=sensors,
        start=start,
        max_tilt=float(tilt_of(motion.body_quat_w[:, 0]).max()),
        start_noise={name: np.asarray(value) for name, value in spec.start_noise.items()},
        object_joint={name: np.asarray(value) for name, value in spec.object_joint_ranges.items()},
        tracked_joints=spec.tracked_joints or joints,
        tracked_bodies=spec.tracked_bodies,
        terminations=spec.terminations,
        unchecked=spec.unchecked,
    )


def network_motion(graph: Graph, spec: NetworkSpec, kinematics: Kinematics) -> Motion:
    """The motion that a network gives at each `time_step`, up to the frame from which on it stays.

    Raises:
        PolicyError: if the network has no such outputs, or the motion does not end.
    """
    where = str(graph.path)
    lacking = [n for n in (*_OUTPUTS, "time_step") if n not in (*graph.outputs, *graph.inputs)]
    if lacking:
        raise PolicyError(f"{where}: motion: {NETWORK}, and it has no {', '.join(lacking)}; it gives no motion")
    empty = {name: np.zeros((1, graph.width(name) or 1)) for name in graph.inputs}

    def at(frame: int) -> np.ndarray:
        return np.concatenate(graph(empty | {"time_step": np.array([[float(frame)]])}, _OUTPUTS), axis=-1)[0]

    last, rows = at(MAX_FRAMES), [at(0)]
    while not np.array_equal(rows[-1], last):
        if len(rows) >= MAX_FRAMES:
            raise PolicyError(f"{where}: its motion has no end within {MAX_FRAMES} frames")
        rows.append(at(len(rows)))
    joints, bodies = len(spec.joints), len(spec.motion_bodies)
    if rows[0].size != 2 * joints + 7 * bodies:
        raise PolicyError(
            f"{where}: its motion has {rows[0].size} numbers a frame, and {joints} joints and {bodies} motion_bodies "
            f"make {2 * joints + 7 * bodies}"
        )
    pos, vel, body_pos, body_quat = np.split(np.array(rows, dtype=float), np.cumsum([joints, joints, 3 * bodies]), 1)
    arrays = {
        "joint_pos": pos, "joint_vel": vel, "body_pos_w": body_pos.reshape(-1, bodies, 3),
        "body_quat_w": body_quat.reshape(-1, bodies, 4),
    }  # fmt: skip
    return motion_of(graph.path.stem, arrays, spec.joints, spec.motion_bodies, spec, kinematics, where)
