"""How far the centre of mass has to move for the ground to push the robot where its feet are."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import nnls

from hdmi.assets import ObjectConfig, g1
from hdmi.motion.playback import TOUCH, Playback
from hdmi.workshop.author.balance import Load, centre_of_pressure, pendulum_com
from hdmi.workshop.repair.feet import FootPath

_EASE = 0.1  # s; standard deviation over which what is missing is smoothed
_SUM = 100.0  # m; weight of the shares' sum against distances


def balance_shift(
    playback: Playback, feet: dict[str, FootPath], object: ObjectConfig | None, qpos: np.ndarray
) -> np.ndarray:
    """Shift of the centre of mass by which the centre of pressure stays over the soles that stand, m. [T, 2]

    Where the robot kneels, or holds on to what does not hang in its hands, nothing is known of the other forces, and
    nothing asked for.

    Args:
        qpos: of the robot alone. [T, 36]
    """
    label = playback.reference.contact.numpy().sum(axis=1) > 0
    carried = np.zeros(len(qpos), bool)
    load = Load(np.zeros((len(qpos), 3)), np.zeros(len(qpos)), np.zeros((len(qpos), 3)), np.zeros((len(qpos), 3)))
    if object is not None and playback.scene.object_free_dof is not None:
        carried = label & (playback.object_clearance.min(axis=1) > TOUCH)
        pos, mat = playback.body_poses(object.name)
        load = Load(pos + mat @ playback.scene.model.body(object.name).ipos, object.mass * carried, load.force, pos)
    off_feet = ~playback.on_bodies(g1.FEET)
    alone = (playback.clearance[:, off_feet].min(axis=1) > TOUCH) & (carried | ~label)
    points = np.stack([path.soles for path in feet.values()], axis=1)  # [T, 2, 4, 3]
    stands = np.stack([path.standing for path in feet.values()], axis=1)  # [T, 2, 4]
    frames = np.flatnonzero(stands.any(axis=(1, 2)))
    if not frames.size:
        return np.zeros((len(qpos), 2))
    heights = [points[t][stands[t]][:, 2].mean() for t in frames]
    pressure = centre_of_pressure(qpos, load, np.interp(np.arange(len(qpos)), frames, heights), playback.fps)
    missing = np.zeros((len(qpos), 2))
    for t in frames[alone[frames]]:
        missing[t] = _nearest(points[t][stands[t]][:, :2], pressure[t]) - pressure[t]
    return pendulum_com(gaussian_filter1d(missing, _EASE * playback.fps, axis=0), playback.fps)


def _nearest(corners: np.ndarray, point: np.ndarray) -> np.ndarray:
    """The point of a convex hull that is nearest to a point. [N, 2], [2] -> [2]"""
    shares, _ = nnls(np.vstack([(corners - point).T, np.full(len(corners), _SUM)]), np.array([0.0, 0.0, _SUM]))
    return np.asarray(shares @ corners / shares.sum())
