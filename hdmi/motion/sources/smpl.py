"""Sources that store the parameters of an SMPL body: GVHMR's results and AMASS."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hdmi.motion.check import MotionError, checked, checked_fps
from hdmi.motion.files import read_npz, read_torch, reading, tensor_array
from hdmi.motion.human import SMPL_JOINTS, HumanMotion
from hdmi.motion.skeleton import anthropometric_skeleton, body_model_skeleton, pose_skeleton, stand_on_ground

_BODY = 3 * len(SMPL_JOINTS)


def read_gvhmr(
    path: str | Path, fps: float, height: float | None = None, body_model: str | Path | None = None
) -> HumanMotion:
    """A person in a video, recovered by GVHMR: `smpl_params_global` of its `hmr4d_results.pt` (SMPL-X, y up).

    Args:
        fps: of the video; the file does not say.
        height: of the person, m; estimated from the first shape parameter if not given.
        body_model: npz of SMPL-X, whose joints are taken instead of the anthropometric skeleton's.

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
    name = path.parent.name if path.stem == "hmr4d_results" else path.stem
    return _posed(path, name, pose, arrays["transl"], arrays["betas"], fps, height, body_model, y_up=True)


def read_amass(path: str | Path, height: float | None = None, body_model: str | Path | None = None) -> HumanMotion:
    """A sequence of AMASS: SMPL-H (`poses`, `mocap_framerate`) or SMPL-X (`root_orient`, `mocap_frame_rate`), z up.

    Args:
        height: of the person, m; estimated from the first shape parameter if not given.
        body_model: npz of the sequence's body model, whose joints are taken instead of the anthropometric skeleton's.

    Raises:
        MotionError: if the file is not such a sequence.
    """
    path = Path(path)
    keys = ("poses", "root_orient", "pose_body", "trans", "betas", "mocap_framerate", "mocap_frame_rate")
    arrays = read_npz(path, keys)
    rates = [np.asarray(arrays[key]) for key in keys[-2:] if key in arrays]
    if not rates or "trans" not in arrays or not ("poses" in arrays or {"root_orient", "pose_body"} <= arrays.keys()):
        raise MotionError(
            f"{path}: not a sequence of AMASS: needs trans, mocap_framerate or mocap_frame_rate, and poses or "
            f"root_orient and pose_body; of these it has {sorted(arrays)}"
        )
    num_frames = len(np.atleast_1d(arrays["trans"]))
    if "poses" in arrays:
        poses = arrays["poses"]
        if poses.ndim != 2 or poses.shape[1] < _BODY:
            raise MotionError(f"{path}: poses: shape {poses.shape}, expected (T, {_BODY} or more)")
        pose = checked(path, "poses", poses[:, :_BODY], (num_frames, _BODY), " from trans")
    else:
        root = checked(path, "root_orient", arrays["root_orient"], (num_frames, 3), " from trans")
        body = checked(path, "pose_body", arrays["pose_body"], (num_frames, _BODY - 3), " from trans")
        pose = np.concatenate([root, body], axis=1)
    fps = checked(path, "mocap_framerate", rates[0].reshape(rates[0].shape or (1,)), (1,))[0]
    betas = arrays.get("betas", np.zeros(1))
    return _posed(path, path.stem, pose, arrays["trans"], betas, float(fps), height, body_model, y_up=False)


def _posed(
    path: Path,
    name: str,
    pose: np.ndarray,  # [T, 66]
    transl: np.ndarray,
    betas: np.ndarray,
    fps: float,
    height: float | None,
    body_model: str | Path | None,
    *,
    y_up: bool,
) -> HumanMotion:
    num_frames = len(pose)
    transl = checked(path, "transl", transl, (num_frames, 3))
    if betas.ndim not in (1, 2) or not betas.size:
        raise MotionError(f"{path}: betas: shape {betas.shape}, expected (S,) or (T, S)")
    shape = checked(path, "betas", betas, betas.shape).astype(float)
    shape = shape if shape.ndim == 1 else shape.mean(0)
    rotation = pose.astype(float).reshape(num_frames, len(SMPL_JOINTS), 3)
    with reading(path):
        checked_fps("fps", fps)
        if body_model is not None:
            if height is not None:
                raise MotionError("give height or body_model, not both: a body model knows its height")
            skeleton = body_model_skeleton(body_model, shape)
            return pose_skeleton(name, skeleton, rotation, transl, fps, y_up=y_up)
        skeleton = anthropometric_skeleton(height_from_betas(shape) if height is None else height)
        # the body is another than the one that the translation was found with: its soles are elsewhere
        return stand_on_ground(pose_skeleton(name, skeleton, rotation, transl, fps, y_up=y_up))


def height_from_betas(betas: np.ndarray) -> float:
    """Height in m that goes with SMPL-X's shape: 1.66 + 0.1 beta_0, the estimate that GMR uses. [S]"""
    return 1.66 + 0.1 * float(betas[0])
