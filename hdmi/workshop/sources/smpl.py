"""Sources that store the parameters of an SMPL body: GVHMR's results and AMASS."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Unpack

import numpy as np

from hdmi.motion.check import MotionError, checked, checked_fps
from hdmi.motion.files import read_npz, read_torch, reading, tensor_array
from hdmi.workshop.human import SMPL_JOINTS, HumanMotion
from hdmi.workshop.skeleton import anthropometric_skeleton, body_model_skeleton, pose_skeleton
from hdmi.workshop.sources.world import World, fps_of, placed, unit_of, without_blank_ends

_BODY = 3 * len(SMPL_JOINTS)
# What generations of AMASS and of tools that imitate it call the same thing
_TRANS = ("trans", "transl")
_ROOT = ("root_orient", "global_orient")
_POSE = ("pose_body", "body_pose")
_RATES = ("mocap_framerate", "mocap_frame_rate", "fps", "framerate", "frame_rate")
_LARGEST_ANGLE = 4 * np.pi  # rad, of a joint in the median frame


def read_gvhmr(
    path: str | Path,
    fps: float,
    height: float | None = None,
    body_model: str | Path | None = None,
    **world: Unpack[World],
) -> HumanMotion:
    """A person in a video, recovered by GVHMR: `smpl_params_global` of its `hmr4d_results.pt` (SMPL-X, y up).

    Args:
        fps: of the video; the file does not say.
        height: of the person, m; estimated from the first shape parameter if not given.
        body_model: npz of SMPL-X, whose joints are taken instead of the anthropometric skeleton's.
        world: see `World`; the unit is that of `transl`.

    Raises:
        MotionError: if the file is not such a result.
    """
    path = Path(path)
    result = read_torch(path)
    params = result.get("smpl_params_global") if isinstance(result, dict) else None
    if not isinstance(params, dict):
        raise MotionError(f"{path}: lacks 'smpl_params_global'; not a result of GVHMR")
    arrays = {}
    for key in ("global_orient", "body_pose", "transl", "betas"):
        if key not in params:
            raise MotionError(f"{path}: smpl_params_global lacks {key!r}; it has {sorted(map(str, params))}")
        arrays[key] = tensor_array(path, key, params[key])
    num_frames = len(np.atleast_1d(arrays["body_pose"]))
    pose = np.concatenate(
        [
            checked(path, "global_orient", arrays["global_orient"], (num_frames, 3)),
            checked(path, "body_pose", arrays["body_pose"], (num_frames, _BODY - 3)),
        ],
        axis=1,
    )
    transl = checked(path, "transl", arrays["transl"], (num_frames, 3))
    name = path.parent.name if path.stem == "hmr4d_results" else path.stem
    with reading(path):
        fps = checked_fps("fps", fps)
        return _posed(path, name, pose, transl, arrays["betas"], fps, height, body_model, "y", world)


def read_amass(
    path: str | Path,
    height: float | None = None,
    body_model: str | Path | None = None,
    fps: float | None = None,
    **world: Unpack[World],
) -> HumanMotion:
    """A sequence of AMASS: SMPL-H (`poses`, `mocap_framerate`) or SMPL-X (`root_orient`, `mocap_frame_rate`), z up.

    Files of others in this manner may say transl, global_orient, body_pose, fps, framerate or frame_rate instead.

    Args:
        height: of the person, m; estimated from the first shape parameter if not given.
        body_model: npz of the sequence's body model, whose joints are taken instead of the anthropometric skeleton's.
        fps: instead of what the file says.
        world: see `World`; the unit is that of `trans`.

    Raises:
        MotionError: if the file is not such a sequence.
    """
    path = Path(path)
    arrays = read_npz(path, ("poses", "betas", *_TRANS, *_ROOT, *_POSE, *_RATES))
    trans_key, root_key, pose_key = (_first(arrays, keys) for keys in (_TRANS, _ROOT, _POSE))
    if trans_key is None or not ("poses" in arrays or (root_key and pose_key)):
        raise MotionError(
            f"{path}: not a sequence of AMASS: needs trans, and poses or root_orient and pose_body; of these it has "
            f"{sorted(arrays)}"
        )
    num_frames = len(np.atleast_1d(arrays[trans_key]))
    if "poses" in arrays:
        poses = arrays["poses"]
        if poses.ndim == 3 and poses.shape[2] == 3:
            poses = poses.reshape(len(poses), -1)
        if poses.ndim != 2 or poses.shape[1] < _BODY:
            raise MotionError(f"{path}: poses: shape {poses.shape}, expected (T, {_BODY} or more)")
        pose = checked(path, "poses", poses[:, :_BODY], (num_frames, _BODY), f" from {trans_key}")
    else:
        assert root_key is not None
        assert pose_key is not None
        root = checked(path, root_key, arrays[root_key], (num_frames, 3), f" from {trans_key}")
        body = checked(path, pose_key, arrays[pose_key], (num_frames, _BODY - 3), f" from {trans_key}")
        pose = np.concatenate([root, body], axis=1)
    trans = checked(path, trans_key, arrays[trans_key], (num_frames, 3))
    rate_key = _first(arrays, _RATES)
    with reading(path):
        told = None if rate_key is None else _rate(rate_key, arrays[rate_key], needed=fps is None)
        rate, notes = fps_of(fps, told, rate_key or " or ".join(_RATES))
        betas = arrays.get("betas", np.zeros(1))
        motion = _posed(path, path.stem, pose, trans, betas, rate, height, body_model, "z", world)
        return replace(motion, notes=(*notes, *motion.notes))


def _first(arrays: Mapping[str, np.ndarray], keys: tuple[str, ...]) -> str | None:
    return next((key for key in keys if key in arrays), None)


def _rate(key: str, value: np.ndarray, *, needed: bool) -> float | None:
    """A number, or text that is one; None if it is neither and not needed."""
    if value.size == 1 and value.dtype.kind in "fiuSU":
        try:
            return float(value.reshape(()).astype(str if value.dtype.kind in "SU" else float).item())
        except ValueError:
            pass
    if not needed:
        return None
    got = repr(value.item()) if value.size == 1 else f"shape {value.shape}"
    raise MotionError(f"{key}: one number expected, got {got[:40]}; give source_fps")


def _posed(
    path: Path,
    name: str,
    pose: np.ndarray,  # [T, 66]
    transl: np.ndarray,
    betas: np.ndarray,
    fps: float,
    height: float | None,
    body_model: str | Path | None,
    usual_up: str,
    world: World,
) -> HumanMotion:
    unit = unit_of(world, 1.0)
    kept, notes = without_blank_ends(np.concatenate([pose, transl], axis=1))
    pose, transl = pose[kept], transl[kept] * unit
    if betas.ndim not in (1, 2) or not betas.size:
        raise MotionError(f"betas: shape {betas.shape}, expected (S,) or (T, S)")
    shape = checked(path, "betas", betas, betas.shape).astype(float)
    shape = shape if shape.ndim == 1 else shape.mean(0)
    rotation = pose.astype(float).reshape(len(pose), len(SMPL_JOINTS), 3)
    angles = np.median(np.linalg.norm(rotation, axis=-1), axis=0) if len(rotation) else np.zeros(1)
    if (largest := float(angles.max())) > _LARGEST_ANGLE:
        joint = SMPL_JOINTS[int(angles.argmax())]
        raise MotionError(f"rotation of {joint!r}: {largest:.3g} in the median frame: are these degrees, not radians?")
    if body_model is None:
        skeleton = anthropometric_skeleton(height_from_betas(shape) if height is None else height)
    elif height is None:
        skeleton = body_model_skeleton(body_model, shape)
    else:
        raise MotionError("give height or body_model, not both: a body model knows its height")
    motion = replace(pose_skeleton(name, skeleton, rotation, transl, fps, y_up=False), notes=notes)
    # the anthropometric body is another than the one that the translation was found with: its soles are elsewhere
    return placed(motion, usual_up, unit, world, own_body=body_model is not None)


def height_from_betas(betas: np.ndarray) -> float:
    """Height in m that goes with SMPL-X's shape: 1.66 + 0.1 beta_0, the estimate that GMR uses. [S]"""
    return 1.66 + 0.1 * float(betas[0])
