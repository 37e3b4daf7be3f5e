"""People whose motion is known: the anthropometric skeleton, posed by formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from hdmi.workshop.human import SMPL_JOINTS, HumanMotion, ObjectTrajectory
from hdmi.workshop.skeleton import UPRIGHT, anthropometric_skeleton

HEIGHT, FPS = 1.75, 50.0
THIGH = 0.245 * HEIGHT
SHANK = float(np.hypot(0.246, 0.015)) * HEIGHT
LEAN = np.arctan2(0.015, 0.246)  # of the shank at rest, backwards, rad
HIP_WIDTH, ANKLE_HEIGHT, PELVIS_ABOVE_HIP = 0.05 * HEIGHT, 0.039 * HEIGHT, 0.05 * HEIGHT
ARM_DOWN = np.array([0.0, 0.0, -1.35])  # of the left shoulder, rotation vector


def ease(phase: np.ndarray) -> np.ndarray:
    u = np.clip(phase, 0.0, 1.0)
    return u**3 * (10 - 15 * u + 6 * u**2)


def leg_angles(hip_to_ankle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flexion of hip and knee, rad, that bring the ankle there, in the sagittal plane. [T, 2] forward, up"""
    forward, up = hip_to_ankle.T
    reach = np.hypot(forward, up)
    inner = np.arccos(np.clip((THIGH**2 + reach**2 - SHANK**2) / (2 * THIGH * reach), -1, 1))
    hip = np.arctan2(forward, -up) + inner
    shank = np.arctan2(forward - THIGH * np.sin(hip), -(up + THIGH * np.cos(hip)))
    return hip, hip - LEAN - shank


def person(
    hips: np.ndarray, ankles: dict[str, np.ndarray], arms: dict[str, np.ndarray], wrist: np.ndarray | float = 0.0
) -> HumanMotion:
    """Somebody upright who faces x, with feet flat.

    Args:
        hips: between the hip joints. [T, 3]
        ankles: by side. [T, 3]; sideways they are below the hips
        arms: rotation vectors of the shoulders, by side. [T, 3]
        wrist: how far the left hand is turned towards its back, rad. [T]
    """
    skeleton = anthropometric_skeleton(HEIGHT)
    rotation = np.zeros((len(hips), len(SMPL_JOINTS), 3))
    rotation[:, 0] = UPRIGHT.as_rotvec()
    for side in ("left", "right"):
        hip, knee = leg_angles((ankles[side] - hips)[:, [0, 2]])
        for joint, angle in (("hip", -hip), ("knee", knee), ("ankle", hip - knee)):
            rotation[:, SMPL_JOINTS.index(f"{side}_{joint}"), 0] = angle
        rotation[:, SMPL_JOINTS.index(f"{side}_shoulder")] = arms[side]
    rotation[:, SMPL_JOINTS.index("left_wrist"), 2] = wrist
    pos, quat = skeleton.forward(rotation, hips + np.array([0.0, 0.0, PELVIS_ABOVE_HIP]))
    return HumanMotion("person", FPS, HEIGHT, SMPL_JOINTS, pos, quat)


def arms_down(num_frames: int) -> dict[str, np.ndarray]:
    return {side: np.tile(sign * ARM_DOWN, (num_frames, 1)) for side, sign in (("left", 1), ("right", -1))}


def feet_below(num_frames: int) -> dict[str, np.ndarray]:
    return {
        side: np.tile([0.0, sign * HIP_WIDTH, ANKLE_HEIGHT], (num_frames, 1))
        for side, sign in (("left", 1), ("right", -1))
    }


def squat(depth: float = 0.3, seconds: float = 2.0) -> HumanMotion:
    """Down by `depth` and up again on the spot."""
    phase = np.arange(round(seconds * FPS)) / (seconds * FPS)
    down = depth * (ease(2 * phase) - ease(2 * phase - 1))
    hips = np.column_stack([-0.3 * down, 0 * down, 0.52 * HEIGHT - down])
    return person(hips, feet_below(len(phase)), arms_down(len(phase)))


STEP_TIME, STEP_LENGTH, SWING_HEIGHT = 0.5, 0.5, 0.08


def walk(steps: int = 6) -> HumanMotion:
    """Steps of `STEP_LENGTH` along x, left foot first, standing still for half a second before and after."""
    time = np.arange(round((steps * STEP_TIME + 1.0) * FPS)) / FPS - 0.5
    hips = np.column_stack([0 * time, 0 * time, np.full(len(time), 0.505 * HEIGHT)])
    ankles = feet_below(len(time))
    for step in range(steps):
        side = ("left", "right")[step % 2]
        length = STEP_LENGTH * (0.5 if step in (0, steps - 1) else 1.0)
        share = (time - step * STEP_TIME) / (0.8 * STEP_TIME)
        ankles[side][:, 0] += length * ease(share)
        swing = np.clip(share, 0, 1)
        ankles[side][:, 2] += SWING_HEIGHT * 16 * swing**2 * (1 - swing) ** 2
    hips[:, 0] = (ankles["left"][:, 0] + ankles["right"][:, 0]) / 2
    return person(hips, ankles, arms_down(len(time)))


BOX_HALF_HEIGHT = 0.1


def reach(gap: float = 0.02) -> HumanMotion:
    """The left hand comes down from above onto a box in front, lies there for a second and goes up again.

    Args:
        gap: between the palm's middle and the top of the box, whose centre is `BOX_HALF_HEIGHT` lower, m.
    """
    time = np.arange(round(3.0 * FPS)) / FPS
    share = ease(time) - ease(time - 2.0)
    lowered = 0.6 - 1.1 * share  # of the arm, which points forward
    arms = arms_down(len(time))
    forward, zero = Rotation.from_rotvec([0.0, -1.45, 0.0]), np.zeros(len(time))
    arms["left"] = (forward * Rotation.from_rotvec(np.column_stack([zero, zero, lowered]))).as_rotvec()
    level = -lowered * share  # of the hand, against the arm
    hips = np.tile([0.0, 0.0, 0.525 * HEIGHT], (len(time), 1))
    alone = person(hips, feet_below(len(time)), arms, wrist=level)
    assert alone.joint_quat is not None
    middle, joint = len(time) // 2, alone.index("left_wrist")
    hand = Rotation.from_quat(alone.joint_quat[middle, joint], scalar_first=True)
    palm = alone.joint_pos[middle, joint] + hand.apply([0.054 * HEIGHT, 0.0, 0.0])
    pos = np.tile(palm - np.array([0.0, 0.0, gap + BOX_HALF_HEIGHT]), (len(time), 1))
    thing = ObjectTrajectory("box", pos, np.tile([1.0, 0.0, 0.0, 0.0], (len(time), 1)))
    return replace(alone, object=thing)
