"""The object of a policy's scene: its joints, and its hinge's angle from orientations."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from hdmi.deploy.rotations import quat_conjugate, quat_multiply, turn_about


@dataclass(frozen=True)
class Hinge:
    """An object's hinge: the moving part's orientation in the object at angle 0 [4], and the axis in the part [3]."""

    quat: np.ndarray
    axis: np.ndarray

    def angle(self, object_quat_w: np.ndarray, part_quat_w: np.ndarray) -> float:
        """rad, in (-pi, pi], from the orientations of object and part. [4], [4]"""
        relative = quat_multiply(quat_conjugate(object_quat_w), part_quat_w)
        return turn_about(self.axis, quat_multiply(quat_conjugate(self.quat), relative))


def object_joints(model: mujoco.MjModel) -> tuple[int | None, int | None, int | None]:
    """The object's body, its free joint and the hinge of its moving part in a policy's scene, each None without.

    The object is what the exporter's sensor of penetrations is about; its part hangs from it on the hinge.
    """
    sensor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, "object_penetration")
    if sensor < 0:
        return None, None, None
    body = int(model.sensor_objid[sensor])
    free = hinge = None
    for joint in range(model.njnt):
        at = int(model.jnt_bodyid[joint])
        if at == body and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            free = joint
        elif model.body_parentid[at] == body and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
            hinge = joint
    return body, free, hinge


def hinge_of(model: mujoco.MjModel) -> Hinge | None:
    """The object's hinge in a policy's scene, or None."""
    _, _, joint = object_joints(model)
    if joint is None:
        return None
    part, reference = model.jnt_bodyid[joint], float(model.qpos0[model.jnt_qposadr[joint]])
    axis = np.array(model.jnt_axis[joint])
    back = np.array([math.cos(reference / 2), *(-math.sin(reference / 2) * axis)])
    return Hinge(quat_multiply(np.array(model.body_quat[part]), back), axis)
