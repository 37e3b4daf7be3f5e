"""Small files in other people's formats, written with plain numpy, torch and text: the formats, not our readers."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from hdmi.assets import default_joint_pos, g1_robot
from hdmi.motion import forward_kinematics
from hdmi.workshop.human import SMPL_JOINTS
from hdmi.workshop.skeleton import UPRIGHT, anthropometric_skeleton
from hdmi.workshop.sources.robot import table_order

T = 9


def write_gvhmr(path: Path, **changes: Any) -> Path:
    """A person who walks along z at 2 cm a frame, y up, and bends the left elbow."""
    frames = torch.arange(T)
    body_pose = torch.zeros(T, 63)
    body_pose[:, 3 * (SMPL_JOINTS.index("left_elbow") - 1) + 1] = -0.1 * frames
    transl = torch.zeros(T, 3)
    transl[:, 1], transl[:, 2] = 1.3, 0.02 * frames
    params = {
        "body_pose": body_pose,
        "betas": torch.full((T, 10), 0.5),
        "global_orient": torch.zeros(T, 3),
        "transl": transl,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    result = {
        "smpl_params_global": params | changes,
        "smpl_params_incam": params,
        "K_fullimg": torch.eye(3).expand(T, 3, 3),
    }
    torch.save(result, path)
    return path


def write_amass(path: Path, layout: str, **changes: np.ndarray) -> Path:
    """A person who faces x, z up, at 120 fps, and raises the left arm."""
    width = {"smplh": 156, "smplx": 165}[layout]
    poses = np.zeros((T, width))
    poses[:, :3] = UPRIGHT.as_rotvec()
    poses[:, 3 * SMPL_JOINTS.index("left_shoulder") + 2] = np.linspace(0, 1.5, T)
    arrays: dict[str, Any] = {"trans": np.tile([0.1, 0.2, 0.9], (T, 1)), "betas": np.full(16, 0.5)}
    if layout == "smplh":
        arrays |= {
            "poses": poses,
            "mocap_framerate": np.array(120.0),
            "gender": np.array("male"),
            "dmpls": np.zeros((T, 8)),
        }
    else:
        arrays |= {
            "root_orient": poses[:, :3],
            "pose_body": poses[:, 3:66],
            "mocap_frame_rate": np.array(120.0),
            "surface_model_type": np.array("smplx"),
            "gender": np.array("neutral"),
            # AMASS pickles some fields that are not needed
            "marker_meta": np.array({"a": 1}, dtype=object),
        }
    np.savez(path, **(arrays | changes))
    return path


def write_omomo(path: Path, **changes: np.ndarray) -> Path:
    """A person of 1.8 m with a box that moves along x, turned by 90 degrees about z."""
    rest = anthropometric_skeleton(1.8).offset
    hands = [[0.08, 0, 0], [-0.08, 0, 0]]
    arrays: dict[str, Any] = {
        "seq_name": np.array("sub3_largebox_003"),
        "betas": np.zeros((1, 16)),
        "gender": np.array("male"),
        "trans2joint": np.array([0.0, 0.3, 0.0]),
        "rest_offsets": np.concatenate([rest, hands]),
        "trans": np.tile([0.1, 0.2, 0.9], (T, 1)),
        "root_orient": np.tile(UPRIGHT.as_rotvec(), (T, 1)),
        "pose_body": np.zeros((T, 63)),
        "obj_scale": np.ones(T),
        "obj_trans": np.stack([0.05 * np.arange(T), np.ones(T), np.zeros(T)], axis=-1)[..., None],
        "obj_rot": np.tile([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], (T, 1, 1)),
        "obj_com_pos": np.zeros((T, 3)),
    }
    np.savez(path, **(arrays | changes))
    return path


def write_intermimic(path: Path) -> Path:
    """Body j is at x = j cm, the object at 0.1 m per frame; a left thumb touches from frame 5, the head must not."""
    data = torch.zeros(T, 591)
    pos = torch.zeros(T, 52, 3)
    pos[:, :, 0] = 0.01 * torch.arange(52)
    # legs of a person: hip, knee, ankle below each other
    for first in (1, 5):
        pos[:, first : first + 3, 2] = torch.tensor([0.9, 0.48, 0.06])
    data[:, 162:318] = pos.reshape(T, -1)
    data[:, 318], data[:, 319], data[:, 320] = 0.1 * torch.arange(T), 5.0, 6.0
    data[:, 323], data[:, 324] = 0.5**0.5, 0.5**0.5
    data[:, 6] = 1.0
    data[:, 331 + 30] = (torch.arange(T) >= 5).float()  # left thumb 1
    data[:, 331 + 13] = -1.0  # head
    data[:, 386::4] = 1.0
    torch.save(data, path)
    return path


def robot_arrays(num_frames: int = T) -> dict[str, np.ndarray]:
    """A robot that walks, turns and swings all its joints; table order, float32."""
    t = np.arange(num_frames) / 50
    joint_pos = default_joint_pos() + 0.3 * np.sin(t[:, None] * 5 + np.arange(29))
    root = np.stack([0.5 * t, 0.1 * t, 0.76 + 0 * t], axis=-1)
    quat = Rotation.from_euler("z", 0.5 * t[:, None]).as_quat(scalar_first=True)
    pos, body_quat = forward_kinematics(g1_robot(), root, quat, joint_pos)
    rng = np.random.default_rng(0)
    return {
        "joint_pos": joint_pos.astype(np.float32),
        "joint_vel": rng.normal(size=joint_pos.shape).astype(np.float32),
        "body_pos_w": pos.astype(np.float32),
        "body_quat_w": body_quat.astype(np.float32),
        "body_lin_vel_w": rng.normal(size=pos.shape).astype(np.float32),
        "body_ang_vel_w": rng.normal(size=pos.shape).astype(np.float32),
    }


def write_mjlab_file(path: Path, arrays: dict[str, np.ndarray], order: str) -> Path:
    joints, bodies = table_order(order)  # type: ignore[arg-type]
    moved = {key: value[:, joints if key.startswith("joint") else bodies] for key, value in arrays.items()}
    np.savez(path, fps=[50], **moved)
    return path


def _joint(name: str, offset: tuple[float, ...], *children: str, root: bool = False) -> str:
    channels = "CHANNELS 6 Xposition Yposition Zposition" if root else "CHANNELS 3"
    inside = "\n".join(children) or "End Site\n{\nOFFSET 0 0 0\n}"
    numbers = " ".join(f"{x:g}" for x in offset)
    head = "ROOT" if root else "JOINT"
    return f"{head} {name}\n{{\nOFFSET {numbers}\n{channels} Zrotation Yrotation Xrotation\n{inside}\n}}"


def write_bvh(path: Path, *, t_pose: bool = False) -> Path:
    """Three frames at 30 fps in cm, y up: a pelvis with legs as LAFAN1 has them, or a person who rests in a T-pose."""
    sides = (("Left", 1), ("Right", -1))
    if t_pose:
        limbs = []
        for side, x in sides:
            shin = _joint(f"{side}Leg", (0, -42, 0), _joint(f"{side}Foot", (0, -42, 0)))
            limbs.append(_joint(f"{side}UpLeg", (x * 10, -5, 0), shin))
        for side, x in sides:
            forearm = _joint(f"{side}ForeArm", (x * 28, 0, 0), _joint(f"{side}Hand", (x * 26, 0, 0)))
            limbs.append(_joint(f"{side}Arm", (x * 18, 50, 0), forearm))
        hips = _joint("mixamorig:Hips", (0, 90, 0), *limbs, root=True)
        rows = np.zeros((3, 6 + 12 * 3))
        rows[:, :3] = [0, 90, 0]
        rows[:, 6 + 3 * 6] = [0, 20, 40]  # left arm, about z
        rows[:, 6 + 3 * 7 + 1] = [0, -30, -60]  # left forearm, about y
    else:
        legs = [
            _joint(f"{side}UpLeg", (0, 0, z), _joint(f"{side}Leg", (43.5, 0, 0), _joint(f"{side}Foot", (42.4, 0, 0))))
            for side, z in (("Left", 10), ("Right", -10))
        ]
        hips = _joint("Hips", (-224.7, 91.9, -431.6), *legs, root=True)
        rows = np.zeros((3, 6 + 6 * 3))
        rows[:, :3] = [[100, 90, 200], [101, 90, 200], [102, 90, 200]]
        rows[:, 3] = 90
        rows[:, 6], rows[:, 15] = 180, 180
        rows[2, 9] = 90
    lines = "\n".join(" ".join(f"{value:.1f}" for value in row) for row in rows)
    path.write_text(f"HIERARCHY\n{hips}\nMOTION\nFrames: 3\nFrame Time: 0.033333\n{lines}\n")
    return path


def write_gmr(path: Path) -> Path:
    """A robot that walks and turns, as GMR pickles it."""
    arrays = robot_arrays()
    content = {
        "fps": 30.0,
        "root_pos": arrays["body_pos_w"][:, 0],
        "root_rot": np.roll(arrays["body_quat_w"][:, 0], -1, axis=-1),
        "dof_pos": arrays["joint_pos"],
        "local_body_pos": None,
        "link_body_list": None,
    }
    path.write_bytes(pickle.dumps(content))
    return path
