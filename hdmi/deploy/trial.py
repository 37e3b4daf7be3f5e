"""Whether a simulated robot does what its motion does, by the trainer's measures as far as poses tell."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

from hdmi.deploy.description import Description, PolicyError
from hdmi.deploy.format import REFERENCE, REFERENCE_FILE
from hdmi.deploy.robots.mujoco import MujocoRobot
from hdmi.deploy.rotations import quat_angle, quat_apply_inverse, quat_conjugate, quat_multiply, tilt_of, yaw_of

FALL_TILT = 1.0  # rad of the root's tilt beyond the motion's
UNITS = {
    "success_rate": "%", "survival": "%", "joint_pos_error": "rad", "body_pos_error": "m", "body_ori_error": "rad",
    "root_pos_error": "m", "root_ori_error": "rad", "object_pos_error": "m", "object_ori_error": "rad",
    "object_joint_error": "rad", "ms_mean": "ms", "ms_p99": "ms",
}  # fmt: skip
FALL_HEIGHT = 0.5  # m of the root off the motion's height


def read_reference(path: str | Path, description: Description) -> dict[str, np.ndarray]:
    """The motion of a policy: see `hdmi.deploy.format.REFERENCE`. [T, ...]

    Args:
        path: of the file or of the policy's folder.

    Raises:
        PolicyError: if there is no such file, or it is of another motion.
    """
    path = Path(path)
    path = path / REFERENCE_FILE if path.is_dir() else path
    if not path.is_file():
        raise PolicyError(f"{path}: there is no such file; it is written with the policy")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name].astype(float) for name in REFERENCE if name in file.files}
    except Exception as error:  # zipfile's, too
        raise PolicyError(f"{path}: cannot be read: {error}") from error
    for name in ("joint_pos", "root_pos_w", "root_quat_w"):
        if name not in arrays or len(arrays[name]) != description.num_frames:
            raise PolicyError(f"{path}: {name}: expected {description.num_frames} frames, as the policy's motion has")
    return arrays


@dataclass
class Result:
    """What became of an episode.

    Args:
        failure: None, or what ended it: the name of a termination, `fall`, `diverged`, or the runner's words.
        frames: of the motion that were reached.
        errors: means over the frames survived, m and rad.
        ms: the runner's own time of each tick, ms.
    """

    failure: str | None
    frames: int
    errors: dict[str, float]
    ms: np.ndarray
    counts: dict[str, int] = field(default_factory=dict)

    @property
    def success(self) -> bool:
        """Whether the motion's last frame was reached."""
        return self.failure is None


class Judge:
    """Compares the simulation's true state with the motion after each tick.

    An episode fails by

    - `diverged`: the simulation is not finite or absurdly fast;
    - the trainer's terminations that compare poses, under its thresholds and persistence: root, object, object's
      joint, and tracked bodies in the root's yaw frame, those of the motion by forward kinematics in the same scene;
    - `fall`: the root is tilted by 1 rad more than the motion's, or 0.5 m off its height.

    Not checked are what needs contacts or forces, such as `lost_contact`: `description.unchecked` names it.

    Args:
        robot: whose truth is looked at.
        reference: of `read_reference`.
    """

    def __init__(self, robot: MujocoRobot, reference: dict[str, np.ndarray]):
        self.robot, self.reference, self.description = robot, reference, robot.description
        names = self.description.joint_names
        self._joints = np.array([names.index(name) for name in self.description.tracked_joints])
        body = mujoco.mjtObj.mjOBJ_BODY
        self._bodies = np.array([mujoco.mj_name2id(robot.model, body, n) for n in self.description.tracked_bodies], int)
        if len(self._bodies) and self._bodies.min() < 0:
            raise PolicyError("tracked_bodies: the scene lacks some of them")
        self._places = self._kinematics()
        self.start()

    def _kinematics(self) -> tuple[np.ndarray, np.ndarray]:
        """Tracked bodies of the motion, local: positions [T, K, 3] and orientations [T, K, 4]."""
        robot, ref = self.robot, self.reference
        data = mujoco.MjData(robot.model)
        pos, quat = [], []
        for frame in range(self.description.num_frames):
            robot.place(data, ref["root_pos_w"][frame], ref["root_quat_w"][frame], ref["joint_pos"][frame])
            mujoco.mj_kinematics(robot.model, data)
            pos.append(data.xpos[self._bodies].copy())
            quat.append(data.xquat[self._bodies].copy())
        return _local(np.array(pos), np.array(quat), ref["root_pos_w"], ref["root_quat_w"])

    def start(self) -> None:
        """Begins an episode."""
        self._sums: dict[str, float] = {}
        self._persisted = dict.fromkeys(self.description.terminations, 0)
        self.frames = 0

    def errors(self, frame: int) -> dict[str, np.ndarray]:
        """Errors of the present state against a frame: m and rad, `[K]` for bodies and joints, else `[1]`."""
        robot, ref = self.robot, self.reference
        data = robot.data
        root_pos, root_quat = data.xpos[robot.root], data.xquat[robot.root]
        pos, quat = _local(data.xpos[self._bodies], data.xquat[self._bodies], root_pos, root_quat)
        found = {
            "joint_pos": np.abs(robot.joint_pos() - ref["joint_pos"][frame])[self._joints],
            "body_pos": np.linalg.norm(pos - self._places[0][frame], axis=-1),
            "body_ori": quat_angle(quat, self._places[1][frame]),
            "root_pos": np.linalg.norm(root_pos - ref["root_pos_w"][frame]).reshape(1),
            "root_ori": quat_angle(root_quat, ref["root_quat_w"][frame]).reshape(1),
        }
        if "object_pos_w" in ref and robot.object_body is not None:
            body = robot.object_body
            found["object_pos"] = np.linalg.norm(data.xpos[body] - ref["object_pos_w"][frame]).reshape(1)
            found["object_ori"] = quat_angle(data.xquat[body], ref["object_quat_w"][frame]).reshape(1)
            if "object_joint_pos" in ref:
                found["object_joint"] = np.abs(robot.object_joint_pos() - ref["object_joint_pos"][frame])
        return found

    def __call__(self, frame: int) -> str | None:
        """Judges the state at a frame of the motion; returns what has failed, or None."""
        if self.robot.diverged:
            return "diverged"
        errors, ref, data = self.errors(frame), self.reference, self.robot.data
        self.frames += 1
        for name, value in errors.items():
            self._sums[name] = self._sums.get(name, 0.0) + float(value.mean())
        for name, term in self.description.terminations.items():
            holds = any((errors[key] > most).any() for key, most in term.errors.items() if key in errors)
            self._persisted[name] = (self._persisted[name] + 1) * holds
            if self._persisted[name] >= term.min_steps:
                return name
        tilt = tilt_of(data.xquat[self.robot.root]) - tilt_of(ref["root_quat_w"][frame])
        if tilt > FALL_TILT or abs(data.xpos[self.robot.root][2] - ref["root_pos_w"][frame, 2]) > FALL_HEIGHT:
            return "fall"
        return None

    def means(self) -> dict[str, float]:
        """Errors averaged over the frames so far."""
        return {name: value / max(self.frames, 1) for name, value in self._sums.items()}


def _local(
    pos: np.ndarray, quat: np.ndarray, root_pos: np.ndarray, root_quat: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Poses in the root's yaw frame at its ground projection. [..., K, 3], [..., K, 4], [..., 3], [..., 4]"""
    yaw = yaw_of(root_quat)[..., None, :]
    ground = root_pos * np.array([1.0, 1.0, 0.0])
    return quat_apply_inverse(yaw, pos - ground[..., None, :]), quat_multiply(quat_conjugate(yaw), quat)


def summarize(results: list[Result], num_frames: int) -> dict[str, float]:
    """Figures over episodes: `success_rate` and `survival` as shares, errors, `ms_mean`, `ms_p99`."""
    ms = np.concatenate([result.ms for result in results])
    figures = {"success_rate": float(np.mean([result.success for result in results]))}
    figures["survival"] = float(np.mean([result.frames / num_frames for result in results]))
    for name in results[0].errors:
        figures[f"{name}_error"] = float(np.mean([result.errors[name] for result in results if name in result.errors]))
    return figures | {"ms_mean": float(ms.mean()), "ms_p99": float(np.percentile(ms, 99))}
