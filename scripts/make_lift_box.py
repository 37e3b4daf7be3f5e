"""Makes the reference motion `lift_box`: the robot stands before a stand, lifts a box off it and puts it back.

The fingertips and the box follow minimum-jerk paths; inverse kinematics finds the joints, with the feet planted and the
centre of mass of robot and carried box held over them. While the box is held the fingertips are asked to be a little
inside its sides, so that servos that follow the reference squeeze it. Sizes, mass and contact points are the task's.

    python scripts/make_lift_box.py --out hdmi/motion/references/lift_box
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import mink
import mujoco
import numpy as np
from hydra.utils import instantiate
from omegaconf import OmegaConf
from scipy.spatial.transform import Rotation, Slerp

from hdmi.assets import Effector, ObjectConfig, SceneryConfig, default_joint_pos, g1
from hdmi.motion import Motion, forward_kinematics, robot_model, save_motion
from hdmi.motion.kinematics import angular_velocity, derivative

_ROOT = Path(__file__).resolve().parents[1]

FPS = 50.0
DURATION = 6.0  # s

# begin and end of the way out, begin and end of the way back, s
REACH = (0.2, 1.1, 4.8, 5.7)
PRESS = (1.1, 1.45, 4.5, 4.8)
LIFT = (1.6, 2.6, 3.4, 4.4)

BOX_X = 0.35  # of box and stand, ahead of the ankles, m
LIFT_HEIGHT = 0.15  # m
CLEARANCE = 0.05  # between fingertip and box before the hands close in, m
SQUEEZE = 0.02  # how far inside the box's sides the fingertips are asked to be while they hold it, m
HAND_PITCH = 0.1  # fingers down while at the box, rad

FOOT_Y = 0.119  # m
ANKLE_HEIGHT = -g1.FOOT_POINTS[0][2] + g1.FOOT_POINT_RADIUS  # soles on the floor
PELVIS_HEIGHT = 0.755  # m
COM_X = 0.03  # of robot and carried box, ahead of the ankles, m
TORSO_PITCH = 0.05  # lean, rad
LIMIT_MARGIN = 0.06  # rad


@dataclass(frozen=True)
class Task:
    """What the task's configuration says about the scene."""

    box: ObjectConfig
    stand: SceneryConfig
    effectors: tuple[Effector, ...]  # left, right

    @property
    def box_rest_height(self) -> float:
        """Of the box's centre while it stands on the stand, m."""
        return 2 * self.stand.geoms[0]["box"][2] + self.box.geoms[0]["box"][2]


@dataclass(frozen=True)
class HandPath:
    """Where a hand's contact point and its orientation should be."""

    point: np.ndarray  # [T, 3]
    quat: np.ndarray  # [T, 4]


def load_task(path: Path) -> Task:
    """Reads box, stand and effectors from a task's configuration."""
    config = instantiate(OmegaConf.select(OmegaConf.load(path), "task"), _convert_="all")
    return Task(box=config["object"], stand=config["scenery"][0], effectors=tuple(config["effectors"]))


def minimum_jerk(phase: np.ndarray) -> np.ndarray:
    """From 0 to 1 as `phase` goes from 0 to 1, at rest at both ends."""
    u = np.clip(phase, 0.0, 1.0)
    return u**3 * (10 - 15 * u + 6 * u**2)


def there_and_back(time: np.ndarray, knots: tuple[float, float, float, float]) -> np.ndarray:
    """From 0 to 1 between the first two knots, and back to 0 between the last two. [T]"""
    out, out_end, back, back_end = knots
    there = minimum_jerk((time - out) / (out_end - out))
    return there - minimum_jerk((time - back) / (back_end - back))


class Solver:
    """Inverse kinematics of the standing robot; each solution starts from the one before."""

    def __init__(self) -> None:
        model = robot_model()
        self.configuration = mink.Configuration(model)
        self.limits = [mink.ConfigurationLimit(model, min_distance_from_limits=LIMIT_MARGIN)]
        home = np.concatenate([[0.0, 0.0, PELVIS_HEIGHT, 1.0, 0.0, 0.0, 0.0], default_joint_pos()])
        self.configuration.update(home)
        self.com = mink.ComTask([10.0, 10.0, 0.0])
        self.hands = {name: _frame(name, 10.0, 3.0) for name in ("left_wrist_yaw_link", "right_wrist_yaw_link")}
        self.feet = _feet_tasks()
        self.fixed = [*_upright_tasks(), _posture_task(model, home)]

    def solve(self, com: np.ndarray, hands: dict[str, mink.SE3]) -> np.ndarray:
        """Positions of the robot model with the centre of mass at `com` and the given bodies at their poses. [36]

        Raises:
            RuntimeError: if the iteration does not settle: the poses are out of comfortable reach.
        """
        self.com.set_target(com)
        tasks = [*self.fixed, self.com]
        for name, pose in hands.items():
            self.hands[name].set_target(pose)
            tasks.append(self.hands[name])
        for _ in range(400):
            velocity = mink.solve_ik(
                self.configuration, tasks, 1.0, "daqp", damping=1e-2, limits=self.limits, constraints=self.feet
            )
            self.configuration.integrate_inplace(velocity, 1.0)
            if np.abs(velocity).max() < 1e-4:
                return self.configuration.q.copy()
        raise RuntimeError(f"inverse kinematics does not settle: last step {np.abs(velocity).max():.1e} rad")


def _frame(name: str, position_cost: float | list[float], orientation_cost: float) -> mink.FrameTask:
    return mink.FrameTask(name, "body", position_cost=position_cost, orientation_cost=orientation_cost)


def _pose(pos: np.ndarray | list[float], quat: np.ndarray | list[float]) -> mink.SE3:
    return mink.SE3.from_rotation_and_translation(mink.SO3(np.asarray(quat, float)), np.asarray(pos, float))


def _pitch(angle: float) -> np.ndarray:
    return Rotation.from_euler("y", angle).as_quat(scalar_first=True)


def _feet_tasks() -> list[mink.FrameTask]:
    """Feet flat and parallel on the floor."""
    tasks = []
    for name, y in zip(g1.FEET, (FOOT_Y, -FOOT_Y), strict=True):
        task = _frame(name, 1.0, 1.0)
        task.set_target(_pose([0.0, y, ANKLE_HEIGHT], _pitch(0.0)))
        tasks.append(task)
    return tasks


def _upright_tasks() -> list[mink.FrameTask]:
    """Pelvis at its height, pelvis and torso near upright."""
    pelvis = _frame("pelvis", [0.0, 0.0, 2.0], 0.5)
    pelvis.set_target(_pose([0.0, 0.0, PELVIS_HEIGHT], _pitch(0.0)))
    torso = _frame("torso_link", 0.0, 1.0)
    torso.set_target(_pose([0.0, 0.0, 0.0], _pitch(TORSO_PITCH)))
    return [pelvis, torso]


def _posture_task(model: mujoco.MjModel, home: np.ndarray) -> mink.PostureTask:
    task = mink.PostureTask(model, cost=0.02)
    task.set_target(home)
    return task


def com_path(task: Task, time: np.ndarray) -> np.ndarray:
    """Centre of mass of the robot alone that keeps it, with the box once held, over the same point. [T, 3]"""
    robot_mass = robot_model().body_mass.sum()
    carried = task.box.mass * there_and_back(time, PRESS)
    path = np.zeros((len(time), 3))
    path[:, 0] = COM_X - carried / robot_mass * (BOX_X - COM_X)
    return path


def box_path(task: Task, time: np.ndarray) -> np.ndarray:
    """Centre of the box. [T, 3]"""
    path = np.tile([BOX_X, 0.0, task.box_rest_height], (len(time), 1))
    path[:, 2] += LIFT_HEIGHT * there_and_back(time, LIFT)
    return path


def hand_path(effector: Effector, rest: np.ndarray, box: np.ndarray, time: np.ndarray) -> HandPath:
    """From the rest pose (of the body, [7]) to beside the box, onto its side, with the box, and back."""
    target = np.asarray(effector.target, float)
    outward = np.array([0.0, np.sign(target[1]), 0.0])
    rest_rotation = Rotation.from_quat(rest[3:], scalar_first=True)
    rest_point = rest[:3] + rest_rotation.apply(effector.point)
    reach, press = there_and_back(time, REACH), there_and_back(time, PRESS)
    beside = box + target + outward * (CLEARANCE - (CLEARANCE + SQUEEZE) * press[:, None])
    turn = Slerp([0.0, 1.0], Rotation.concatenate([rest_rotation, Rotation.from_euler("y", HAND_PITCH)]))
    return HandPath(
        point=rest_point + reach[:, None] * (beside - rest_point),
        quat=turn(np.clip(reach, 0.0, 1.0)).as_quat(scalar_first=True),
    )


def body_pose(path: HandPath, frame: int, point: np.ndarray) -> mink.SE3:
    """Pose of the hand's body that puts `point` (in its frame) on the path."""
    rotation = Rotation.from_quat(path.quat[frame], scalar_first=True)
    return _pose(path.point[frame] - rotation.apply(point), path.quat[frame])


def solve_motion(task: Task, time: np.ndarray, box: np.ndarray) -> tuple[np.ndarray, list[HandPath]]:
    """Positions of the robot model in every frame [T, 36] and the hands' paths that they follow."""
    solver = Solver()
    com = com_path(task, time)
    rest = solver.solve(com[0], {})
    pos, quat = forward_kinematics(rest[None, :3], rest[None, 3:7], rest[None, 7:])
    paths = []
    for effector in task.effectors:
        b = g1.BODY_NAMES.index(effector.body)
        paths.append(hand_path(effector, np.concatenate([pos[0, b], quat[0, b]]), box, time))
    qpos = np.empty((len(time), len(rest)))
    for t in range(len(time)):
        hands = {
            effector.body: body_pose(path, t, np.asarray(effector.point, float))
            for effector, path in zip(task.effectors, paths, strict=True)
        }
        qpos[t] = solver.solve(com[t], hands)
    return qpos, paths


def contact_labels(task: Task, box: np.ndarray, paths: list[HandPath]) -> np.ndarray:
    """True while both fingertips are at or inside the box's sides. [T, E]"""
    gaps = []
    for effector, path in zip(task.effectors, paths, strict=True):
        target = np.asarray(effector.target, float)
        gaps.append(np.sign(target[1]) * (path.point - box - target)[:, 1])
    together = (np.max(gaps, axis=0) <= 0.0)[:, None]
    return np.repeat(together, len(task.effectors), axis=1)


def make_motion(task: Task) -> Motion:
    """Solves the motion and completes it with the box, the stand, velocities and contacts."""
    time = np.arange(round(DURATION * FPS)) / FPS
    box = box_path(task, time)
    qpos, paths = solve_motion(task, time, box)
    body_pos, body_quat = forward_kinematics(qpos[:, :3], qpos[:, 3:7], qpos[:, 7:])
    stand = np.tile([BOX_X, 0.0, task.stand.geoms[0]["box"][2]], (len(time), 1))
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(time), 2, 1))
    body_pos = np.concatenate([body_pos, np.stack([box, stand], axis=1)], axis=1)
    body_quat = np.concatenate([body_quat, upright], axis=1)
    points = np.array([effector.target for effector in task.effectors], dtype=float)
    arrays = {
        "body_pos_w": body_pos,
        "body_quat_w": body_quat,
        "body_lin_vel_w": derivative(body_pos, FPS),
        "body_ang_vel_w": angular_velocity(body_quat, FPS),
        "joint_pos": qpos[:, 7:],
        "joint_vel": derivative(qpos[:, 7:], FPS),
        "contact_points": np.tile(points, (len(time), 1, 1)),
    }
    return Motion(
        name="lift_box",
        fps=FPS,
        body_names=(*g1.BODY_NAMES, task.box.name, task.stand.name),
        joint_names=g1.JOINT_NAMES,
        object_contact=contact_labels(task, box, paths),
        **{key: value.astype(np.float32) for key, value in arrays.items()},
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", type=Path, default=_ROOT / "conf/task/lift_box.yaml")
    parser.add_argument("--out", type=Path, default=_ROOT / "hdmi/motion/references/lift_box")
    args = parser.parse_args()
    motion = make_motion(load_task(args.task))
    folder = save_motion(motion, args.out)
    assert motion.object_contact is not None
    held = int(motion.object_contact.all(axis=1).sum())
    fastest = np.abs(motion.joint_vel).max()
    print(f"{folder}: {motion.num_frames} frames, {held} in contact, fastest joint {fastest:.2f} rad/s")


if __name__ == "__main__":
    main()
