"""A motion in its scene: generalised positions, and what its geoms are away from, frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np
from scipy.signal import savgol_filter

from hdmi.assets import Effector, ObjectConfig, RobotConfig, Scene, SceneryConfig, SimConfig, build_scene
from hdmi.motion.check import MotionError
from hdmi.motion.format import Motion
from hdmi.motion.kinematics import smoothing_window
from hdmi.motion.reference import Reference, make_reference

FAR = 0.5  # m; distances between geoms are not looked for beyond it
TOUCH = 0.02  # m; surfaces this near each other can push


def reference_qpos(scene: Scene, reference: Reference, frames: int | slice = slice(None)) -> np.ndarray:
    """MuJoCo's generalised positions of a frame [nq], or of several frames [T, nq], of a reference."""
    joint_pos = reference.joint_pos[frames].numpy()
    qpos = np.tile(scene.default_qpos, (*joint_pos.shape[:-1], 1))
    qpos[..., :3], qpos[..., 3:7] = reference.body_pos[frames, 0], reference.body_quat[frames, 0]
    qpos[..., scene.joint_qpos] = joint_pos
    if (q := scene.object_free_qpos) is not None:
        qpos[..., q : q + 3], qpos[..., q + 3 : q + 7] = reference.object_pos[frames], reference.object_quat[frames]
    if (q := scene.object_hinge_qpos) is not None:
        qpos[..., q] = reference.object_joint_pos[frames, 0]
    return qpos


@dataclass(frozen=True)
class Playback:
    """A motion set into its scene, without physics.

    Geoms are told apart by what they belong to: the robot's collision shapes, the object, and the ground (the floor
    and all scenery).

    Examples:
        >>> playback = make_playback(load_motion(find_motion("walk")))
        >>> playback.qpos.shape
        (550, 36)
        >>> pos, mat = playback.body_poses("pelvis")
        >>> pos.shape, mat.shape
        ((550, 3), (550, 3, 3))
    """

    reference: Reference
    scene: Scene
    qpos: np.ndarray  # [T, nq]
    fps: float

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.qpos)

    def frames(self) -> Iterator[mujoco.MjData]:
        """Data with the kinematics of every frame, one after the other in the same place."""
        model = self.scene.model
        data = mujoco.MjData(model)
        for qpos in self.qpos:
            data.qpos[:] = qpos
            mujoco.mj_kinematics(model, data)
            yield data

    @cached_property
    def _poses(self) -> tuple[np.ndarray, np.ndarray]:
        poses = [(data.xpos.copy(), data.xmat.copy()) for data in self.frames()]
        pos, mat = (np.stack(values) for values in zip(*poses, strict=True))
        return pos, mat.reshape(*pos.shape, 3)

    def body_poses(self, body: str | int | None) -> tuple[np.ndarray, np.ndarray]:
        """World positions and rotation matrices of a body, by name or id in the scene. [T, 3], [T, 3, 3]"""
        index = self.scene.model.body(body).id
        return self._poses[0][:, index], self._poses[1][:, index]

    @cached_property
    def robot_geoms(self) -> np.ndarray:
        """Ids of the robot's collision geoms. [R]"""
        model = self.scene.model
        of_robot = np.isin(model.geom_bodyid, self.scene.body_ids)
        return np.flatnonzero(of_robot & (model.geom_contype > 0))

    @cached_property
    def ground_geoms(self) -> np.ndarray:
        """Ids of the floor and of the scenery's geoms; the floor is the first. [G]"""
        model = self.scene.model
        others = [*self.scene.body_ids, *model.geom_bodyid[self.scene.object_geoms]]
        return np.flatnonzero(~np.isin(model.geom_bodyid, others))

    @cached_property
    def effector_pos_w(self) -> np.ndarray:
        """The effectors' points, m. [T, E, 3]"""
        points = []
        for effector in self.scene.effectors:
            pos, mat = self.body_poses(effector.body)
            points.append(pos + mat @ np.asarray(effector.point, float))
        return np.stack(points, axis=1)

    @cached_property
    def contact_pos_w(self) -> np.ndarray:
        """The contact points on the object that the effectors' points are to meet, m. [T, E, 3]"""
        pos, mat = self.body_poses(self.scene.object_link)
        return pos[:, None] + np.einsum("tij,tej->tei", mat, self.reference.contact_point.numpy())

    def on_bodies(self, bodies: Sequence[str]) -> np.ndarray:
        """Which of the robot's collision geoms are on the given bodies. bool [R]"""
        ids = [self.scene.model.body(name).id for name in bodies]
        return np.isin(self.scene.model.geom_bodyid[self.robot_geoms], ids)

    @cached_property
    def ground_distance(self) -> np.ndarray:
        """Distances of the robot's geoms from the ground, see `distances`. [T, R]"""
        return self.distances(self.robot_geoms, self.ground_geoms)

    @cached_property
    def object_distance(self) -> np.ndarray:
        """Distances of the robot's geoms from the object, see `distances`. [T, R]"""
        return self.distances(self.robot_geoms, self.scene.object_geoms)

    @cached_property
    def object_clearance(self) -> np.ndarray:
        """Distances of the object's geoms from the ground, see `distances`. [T, O]"""
        return self.distances(self.scene.object_geoms, self.ground_geoms)

    @cached_property
    def clearance(self) -> np.ndarray:
        """Distances of the robot's geoms from what it may stand on, m. [T, R]

        That is the ground, and an object that stands itself; but not on its arms there: those hold it.
        """
        scene = self.scene
        if not scene.object_geoms.size:
            return self.ground_distance
        names = [self.geom_name(g) for g in self.robot_geoms]
        on_arms = np.array([any(word in name for word in ("shoulder", "elbow", "wrist", "hand")) for name in names])
        stands = (self.object_clearance.min(axis=1) < TOUCH) | (scene.object_free_dof is None)
        return np.minimum(self.ground_distance, np.where(stands[:, None] & ~on_arms, self.object_distance, np.inf))

    @property
    def ground_gap(self) -> float:
        """Height of the robot's lowest point over what it may stand on in the median frame, m; 0 on or in it."""
        return max(float(np.median(self.clearance.min(axis=1))), 0.0)

    def geom_name(self, geom: int) -> str:
        """Name of a geom, or of its body if it has none."""
        model = self.scene.model
        return model.geom(geom).name or model.body(model.geom_bodyid[geom]).name

    def distances(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Signed distances between geoms (meshes as their convex hulls), negative inside, at most `FAR`, m.

        Args:
            first, second: geom ids. [F], [S]

        Returns:
            The distance of each first geom from the nearest of the second. [T, F]
        """
        model = self.scene.model
        out = np.full((self.num_frames, len(first)), FAR)
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        radius = np.where(model.geom_type == plane, np.inf, model.geom_rbound)
        for t, data in enumerate(self.frames()):
            centres = data.geom_xpos
            apart = np.linalg.norm(centres[first][:, None] - centres[second][None], axis=-1)
            near = apart - radius[first][:, None] - radius[second] < FAR
            for i, j in np.argwhere(near):
                out[t, i] = min(out[t, i], mujoco.mj_geomDistance(model, data, first[i], second[j], FAR, None))
        return out

    def derivatives(self) -> tuple[np.ndarray, np.ndarray]:
        """Generalised velocities and accelerations, low-pass filtered (Savitzky-Golay). [T, nv], [T, nv]"""
        model, fps, last = self.scene.model, self.fps, self.num_frames - 1
        rough = np.empty((self.num_frames, model.nv))
        for t in range(self.num_frames):
            before, after = max(t - 1, 0), min(t + 1, last)
            mujoco.mj_differentiatePos(model, rough[t], (after - before) / fps, self.qpos[before], self.qpos[after])
        window = smoothing_window(self.num_frames, fps)
        if window < 5:
            return rough, np.gradient(rough, 1 / fps, axis=0)
        smooth: Callable[..., np.ndarray] = savgol_filter
        return (
            smooth(rough, window, 2, axis=0),
            smooth(rough, window, 2, deriv=1, delta=1 / fps, axis=0),
        )


def make_playback(
    motion: Motion,
    *,
    robot: RobotConfig | None = None,
    object: ObjectConfig | None = None,
    scenery: Sequence[SceneryConfig] = (),
    effectors: Sequence[Effector] = (),
) -> Playback:
    """Sets a motion into the scene of a task; scenery that the motion does not place keeps the task's pose.

    A motion without contact labels is taken as one that intends none.

    Raises:
        MotionError: if motion and task do not fit together; see `make_reference`.
        ValueError: if the scene itself cannot be built; see `build_scene`.
    """
    if motion.object_contact is None and effectors:
        motion = replace(motion, object_contact=np.zeros((motion.num_frames, len(effectors)), bool))
    robot = robot or RobotConfig()
    reference = make_reference(
        motion, control_dt=1 / motion.fps, object=object, scenery=scenery, effectors=effectors, robot=robot
    )
    for item in scenery:
        if item.name not in reference.placements and item.pos is None:
            raise MotionError(
                f"motion {motion.name!r}: body_names lacks {item.name!r}, scenery without a pos in the task"
            )
    scene = build_scene(robot, SimConfig(), object, scenery, effectors, reference.placements)
    return Playback(reference, scene, reference_qpos(scene, reference), motion.fps)
