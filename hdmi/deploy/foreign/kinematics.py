"""Where a robot's bodies are, by MuJoCo on the scene's file; and what the scene says of joints and object."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from hdmi.deploy.description import PolicyError
from hdmi.deploy.rotations import quat_apply, quat_from_rotation_vector, quat_multiply


class Kinematics:
    """The robot of a scene, in the order of the given joints.

    Args:
        scene: MJCF file.
        joint_names: [J]; joints of the scene that are not among them stay at their zero.

    Attributes:
        root: name of the body with the robot's free joint.
        body_names: of the robot's B bodies, the root first.
        joint_ranges: rad. [J, 2]
        effort_limits: of the servos, infinite where the scene has none, N m. [J]

    Raises:
        PolicyError: if there is no such file, or the scene lacks joints or a free root above them.
    """

    def __init__(self, scene: str | Path, joint_names: Sequence[str]):
        if not Path(scene).is_file():
            raise PolicyError(
                f"{scene}: there is no such file; `hdmi foreign task=NAME out=FOLDER` writes a task's scene"
            )
        try:
            self.model = model = mujoco.MjModel.from_xml_path(str(scene))
        except ValueError as error:
            raise PolicyError(f"{scene}: MuJoCo cannot read it: {str(error).splitlines()[0]}") from error
        self._data = mujoco.MjData(model)
        ids = np.array([mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in joint_names])
        if missing := [name for name, i in zip(joint_names, ids, strict=True) if i < 0]:
            there = [model.joint(i).name for i in range(model.njnt) if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_HINGE]
            raise PolicyError(f"{scene}: has no joint {', '.join(missing)}; it has {', '.join(there)}")
        top = int(model.body_rootid[model.jnt_bodyid[ids[0]]])
        first = int(model.body_jntadr[top])
        if first < 0 or model.jnt_type[first] != mujoco.mjtJoint.mjJNT_FREE:
            raise PolicyError(f"{scene}: body {model.body(top).name!r}, above {joint_names[0]}, has no free joint")
        self._root = int(model.jnt_qposadr[first])
        self._qpos = model.jnt_qposadr[ids]
        self._bodies = np.flatnonzero(model.body_rootid == top)
        self.body_names = tuple(model.body(i).name for i in self._bodies)
        self.root = self.body_names[0]
        self.joint_ranges = np.where(model.jnt_limited[ids, None], model.jnt_range[ids], [-np.inf, np.inf])
        self.effort_limits = np.array([self._effort(name, i) for name, i in zip(joint_names, ids, strict=True)])

    def _effort(self, name: str, joint: int) -> float:
        model, servo = self.model, mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_ACTUATOR, name)
        if servo >= 0 and model.actuator_forcelimited[servo]:
            return float(model.actuator_forcerange[servo, 1])
        return float(model.jnt_actfrcrange[joint, 1]) if model.jnt_actfrclimited[joint] else np.inf

    def __call__(
        self, root_pos_w: np.ndarray, root_quat_w: np.ndarray, joint_pos: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Poses of all bodies in the world. m [..., 3], wxyz [..., 4], rad [..., J] -> [..., B, 3], [..., B, 4]"""
        shape, data, q = joint_pos.shape[:-1], self._data, self._root
        rows = np.concatenate([root_pos_w, root_quat_w, joint_pos], axis=-1).reshape(-1, 7 + len(self._qpos))
        pos, quat = np.empty((len(rows), len(self._bodies), 3)), np.empty((len(rows), len(self._bodies), 4))
        for i, row in enumerate(rows):
            data.qpos[q : q + 7], data.qpos[self._qpos] = row[:7], row[7:]
            mujoco.mj_kinematics(self.model, data)
            pos[i], quat[i] = data.xpos[self._bodies], data.xquat[self._bodies]
        return pos.reshape(*shape, -1, 3), quat.reshape(*shape, -1, 4)

    def link(
        self, name: str, pos_w: np.ndarray, quat_w: np.ndarray, joint_pos: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Pose of an object's link: what hangs from the object's body on a hinge, or the object itself.

        Args:
            name: of the object's body; if the scene has none of that name, the object has no link.
            pos_w, quat_w: of the object. m [..., 3], [..., 4]
            joint_pos: of the hinge, rad, if it is measured. [..., 1]
        """
        model = self.model
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) if name else -1
        hinges = [
            j
            for j in range(model.njnt)
            if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE and model.body_parentid[model.jnt_bodyid[j]] == body
        ]
        if body < 0 or not hinges or joint_pos is None:
            return pos_w, quat_w
        link, anchor = model.jnt_bodyid[hinges[0]], model.jnt_pos[hinges[0]]
        angle = joint_pos - model.qpos0[model.jnt_qposadr[hinges[0]]]
        turn = quat_from_rotation_vector(model.jnt_axis[hinges[0]] * angle)
        fixed = np.broadcast_to(model.body_quat[link], quat_w.shape)
        moved = anchor - quat_apply(turn, np.broadcast_to(anchor, pos_w.shape))
        place = model.body_pos[link] + quat_apply(fixed, moved)
        return pos_w + quat_apply(quat_w, place), quat_multiply(quat_multiply(quat_w, fixed), turn)
