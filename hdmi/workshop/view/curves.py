"""A motion to look at: whose object it has, and what goes wrong in it when."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hdmi.motion.playback import Playback
from hdmi.workshop.validate.checks import limits


def curves(playback: Playback, other: Playback | None = None) -> Mapping[str, np.ndarray]:
    """What is plotted over time. Each [T], NaN where it does not apply.

    Height of the robot's lowest point over the ground, the deepest that it is inside the object, the distance of each
    effector from its contact point while contact is intended, and the fastest joint in percent of its limit. Against
    another motion of the same rate: mean errors of bodies and joints, and of the object if both have one.
    """
    reference, scene = playback.reference, playback.scene
    found = {"ground clearance [cm]": 100 * playback.ground_distance.min(axis=1)}
    if scene.object_geoms.size:
        found["inside the object [cm]"] = 100 * (-playback.object_distance).clip(min=0).max(axis=1)
    if scene.effectors:
        apart = np.linalg.norm(playback.effector_pos_w - playback.contact_pos_w, axis=-1)
        gaps = np.where(reference.contact.numpy(), 100 * apart, np.nan)
        names = [effector.body.removesuffix("_link") for effector in scene.effectors]
        found |= {f"contact gap, {name} [cm]": gap for name, gap in zip(names, gaps.T, strict=True)}
    found["joint speed [%]"] = 100 * limits(playback)["joint_velocity"].values.max(axis=1)
    if other is not None:
        found |= _differences(playback, other)
    return found


def _differences(playback: Playback, other: Playback) -> dict[str, np.ndarray]:
    ours, theirs = playback.reference, other.reference
    count = min(ours.num_frames, theirs.num_frames)
    errors = {
        "body error [cm]": 100 * (ours.body_pos[:count] - theirs.body_pos[:count]).norm(dim=-1).mean(-1),
        "joint error [deg]": (ours.joint_pos[:count] - theirs.joint_pos[:count]).abs().mean(-1).rad2deg(),
    }
    if ours.has_object and theirs.has_object:
        errors["object error [cm]"] = 100 * (ours.object_pos[:count] - theirs.object_pos[:count]).norm(dim=-1)
    pad = np.full(ours.num_frames - count, np.nan)
    return {name: np.concatenate([values.numpy(), pad]) for name, values in errors.items()}
