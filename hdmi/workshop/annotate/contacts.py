"""When and where effectors touch the object: from the distance of their surfaces to it, and from its motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.ndimage import binary_closing
from scipy.spatial.transform import Rotation

from hdmi.assets import ObjectConfig
from hdmi.assets.surface import Surface, object_surfaces
from hdmi.motion.check import MotionError
from hdmi.motion.kinematics import derivative
from hdmi.motion.playback import Playback

_AXIS_POINTS = 9  # along a capsule
_FACE_POINTS = 5  # along an edge of a box


@dataclass(frozen=True)
class ContactCriteria:
    """What counts as contact.

    Args:
        touch, release: contact begins when the surfaces come nearer than `touch` and ends when they are further apart
            than `release`, m.
        moving: from this speed on the object moves, where the effector is, m/s.
        still, slip: an effector that slides over the object faster than `still`, m/s, and faster than `slip` times the
            object moves there, passes by.
        along: an object moves along with an effector that is slower in its frame than this share of its speed.
        reach: up to this distance an object that moves along is held, m.
        pause: interruptions up to this long are bridged, and contacts shorter than it are dropped, s.
        lead: an object is touched at most this long before it first and after it last moves, s.

    Examples:
        >>> from hdmi.assembly import scene_parts
        >>> from hdmi.config import task_config
        >>> from hdmi.motion import find_motion, load_motion, make_playback
        >>> parts = scene_parts(task_config("lift_box"))
        >>> playback = make_playback(load_motion(find_motion("lift_box")), **parts)
        >>> intervals(find_contacts(playback, parts["object"], ContactCriteria(touch=0.02))[:, 0])  # of the left hand
        [(71, 226)]
    """

    touch: float = 0.03
    release: float = 0.04
    moving: float = 0.05
    still: float = 0.1
    slip: float = 2.0
    along: float = 0.5
    reach: float = 0.1
    pause: float = 0.3
    lead: float = 1.0


def find_contacts(playback: Playback, config: ObjectConfig, criteria: ContactCriteria | None = None) -> np.ndarray:
    """Finds when effectors touch the object. bool [T, E]

    Contact is nearness of the surfaces, with hysteresis, that is no passing by; in a wider range while the object moves
    along. It counts where the object is moved, and for a while around that: hands that rest on an object that nobody
    moves do not interact with it. An object that is fixed in the world cannot be moved: there all contact counts.

    Raises:
        MotionError: for an effector without a collision shape.
    """
    surfaces = object_surfaces(config)
    gap = np.stack([_gap(playback, effector.body, surfaces) for effector in playback.scene.effectors], axis=1)
    label, _ = label_contacts(playback, gap, criteria)
    return label


def label_contacts(
    playback: Playback, gap: np.ndarray, criteria: ContactCriteria | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Labels as `find_contacts` does, from given distances between the surfaces, m. [T, E]

    Returns:
        Labels, bool [T, E], and the speed of the object's material point that is where the effector is, m/s. [T, E]
    """
    criteria = criteria or ContactCriteria()
    local = effector_points(playback)
    link_pos, link_mat = playback.body_poses(playback.scene.object_link)
    fps = playback.fps
    relative = np.linalg.norm(derivative(local, fps), axis=-1)  # [T, E]
    turning = np.einsum("tij,tej->tei", derivative(link_mat, fps), local)
    speed = np.linalg.norm(derivative(link_pos, fps)[:, None] + turning, axis=-1)
    fixed = playback.scene.object_free_dof is None and playback.scene.object_hinge_dof is None
    columns = [_label(gap[:, i], speed[:, i], relative[:, i], fixed, fps, criteria) for i in range(gap.shape[1])]
    return np.stack(columns, axis=1), speed


def contact_points(playback: Playback, config: ObjectConfig, label: np.ndarray) -> np.ndarray:
    """One point for each interval of contact, on the object's surface, in its link's frame. [T, E] -> [T, E, 3]

    It is the point of the surface nearest to the effector's, in the median over the interval. Between intervals the
    point is that of the nearest one; an effector without any keeps its target.
    """
    surfaces = object_surfaces(config)
    surface = surfaces.get(config.link) or surfaces[config.name]
    local = effector_points(playback)
    out = np.empty((*label.shape, 3))
    frames = np.arange(len(label))
    for e, effector in enumerate(playback.scene.effectors):
        out[:, e] = effector.target
        distance = np.full(len(label), np.inf)
        for first, last in intervals(label[:, e]):
            nearest = surface.nearest(local[first : last + 1, e])
            point = surface.nearest(np.median(nearest, axis=0, keepdims=True))[0]
            away = np.maximum(first - frames, frames - last)
            out[away < distance, e] = point
            distance = np.minimum(distance, away)
    return out


def effector_points(playback: Playback) -> np.ndarray:
    """The effectors' points in the frame of the object's link. [T, E, 3]"""
    link_pos, link_mat = playback.body_poses(playback.scene.object_link)
    return np.einsum("tji,tej->tei", link_mat, playback.effector_pos_w - link_pos[:, None])


def _gap(playback: Playback, body: str, surfaces: Mapping[str, Surface]) -> np.ndarray:
    """Distance between the collision shapes of a robot body and the object's surfaces. [T]"""
    points, radius = _shape_points(playback, body)
    body_pos, body_mat = playback.body_poses(body)
    points_w = body_pos[:, None] + np.einsum("tij,pj->tpi", body_mat, points)
    gaps = []
    for name, surface in surfaces.items():
        pos, mat = playback.body_poses(name)
        distance = surface.distance(np.einsum("tji,tpj->tpi", mat, points_w - pos[:, None]))  # [T, P]
        gaps.append((distance - radius).min(axis=1))
    return np.min(gaps, axis=0)


def _shape_points(playback: Playback, body: str) -> tuple[np.ndarray, np.ndarray]:
    """Points in a robot body's collision shapes, in its frame, and how far the surface is from each. [P, 3], [P]"""
    model = playback.scene.model
    points, radii = [], []
    geoms = playback.robot_geoms[playback.on_bodies([body])]
    if not geoms.size:
        raise MotionError(f"contacts: the robot's {body!r} has no collision shape that could touch the object")
    for geom in geoms:
        size, kind = model.geom_size[geom], model.geom_type[geom]
        if kind == mujoco.mjtGeom.mjGEOM_BOX:
            grid = np.linspace(-1, 1, _FACE_POINTS)
            local = np.stack(np.meshgrid(grid, grid, grid), axis=-1).reshape(-1, 3) * size
            radius = 0.0
        else:  # a sphere is a capsule without length
            half = size[1] if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
            local = np.linspace(-half, half, _AXIS_POINTS)[:, None] * [0, 0, 1]
            radius = size[0]
        rotation = Rotation.from_quat(model.geom_quat[geom], scalar_first=True)
        points.append(model.geom_pos[geom] + rotation.apply(local))
        radii.append(np.full(len(local), radius))
    return np.concatenate(points), np.concatenate(radii)


def _label(
    gap: np.ndarray, speed: np.ndarray, relative: np.ndarray, fixed: bool, fps: float, criteria: ContactCriteria
) -> np.ndarray:
    """Contact of one effector. [T] each -> bool [T]"""
    moving = speed > criteria.moving
    carried = moving & (relative < criteria.along * speed) & (gap < criteria.reach)
    near = _hysteresis((gap < criteria.touch) | carried, (gap < criteria.release) | carried)
    label = near & (relative < np.maximum(criteria.still, criteria.slip * speed))
    lead = round(criteria.lead * fps)
    out = np.zeros_like(label)
    for first, last in intervals(without_chatter(label, round(criteria.pause * fps))):
        moved = first + np.flatnonzero(moving[first : last + 1])
        if fixed:
            out[first : last + 1] = True
        elif moved.size:
            out[max(first, moved[0] - lead) : min(last, moved[-1] + lead) + 1] = True
    return out


def without_chatter(label: np.ndarray, pause: int) -> np.ndarray:
    """Labels with interruptions of up to `pause` frames bridged, then without contacts of up to so many. bool [T]"""
    bridged = binary_closing(np.pad(label, pause), np.ones(pause + 1, bool))[pause : len(label) + pause]
    out = np.zeros_like(bridged)
    for first, last in intervals(bridged):
        out[first : last + 1] = last - first >= pause
    return out


def _hysteresis(begin: np.ndarray, stay: np.ndarray) -> np.ndarray:
    """From the first frame of `begin` to the end of each run of `stay`. bool [T]"""
    out = np.zeros_like(begin)
    for first, last in intervals(stay | begin):
        if begin[first : last + 1].any():
            out[first + int(begin[first : last + 1].argmax()) : last + 1] = True
    return out


def intervals(label: np.ndarray) -> list[tuple[int, int]]:
    """First and last frame of each run of true frames. bool [T]"""
    frames = np.flatnonzero(label)
    if not frames.size:
        return []
    runs = np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1)
    return [(int(run[0]), int(run[-1])) for run in runs]
