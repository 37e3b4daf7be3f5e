"""Meshes of objects, as files."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

FORMATS = ("obj", "stl", "ply", "off", "glb", "gltf")
_VOLUME = 1e-12  # m^3, of the hull: MuJoCo takes no less
_POINTER = b"version https://git-lfs"


def load_mesh(path: str, scale: Any = 1.0) -> trimesh.Trimesh:
    """Reads one mesh and scales it; not to be changed, as others get the same.

    Args:
        scale: one figure or three, positive.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no mesh in one of `FORMATS`, or encloses no volume; names the file.
    """
    if not isinstance(path, str | Path):
        raise ValueError(f"a path expected, got {path!r}")
    file = Path(path).expanduser()
    if not file.is_file():
        raise FileNotFoundError(f"no file {file}" + ("" if file.is_absolute() else f" in {Path.cwd()}"))
    try:
        factors = tuple(float(value) for value in np.broadcast_to(np.asarray(scale, float), 3))
    except (TypeError, ValueError):
        factors = (np.nan,) * 3
    if not all(np.isfinite(value) and value > 0 for value in factors):
        raise ValueError(f"scale: one positive figure or three expected, got {scale!r}")
    state = file.stat()
    return _load(file, factors, (state.st_mtime_ns, state.st_size))


@lru_cache(maxsize=16)
def _load(file: Path, scale: tuple[float, ...], version: tuple[int, int]) -> trimesh.Trimesh:
    """`version` tells a file that was changed since from the one that was read."""
    del version
    kind = file.suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        what = f"{file.suffix} files hold" if kind else "a file without a suffix holds"
        raise ValueError(f"{file}: {what} no mesh that is read here; {', '.join(FORMATS)} are")
    with file.open("rb") as stream:
        if stream.read(len(_POINTER)) == _POINTER:
            raise ValueError(f"{file}: a Git LFS pointer and not the mesh, which `git lfs pull` fetches")
    try:
        with np.errstate(all="ignore"):
            mesh = trimesh.load(str(file), force="mesh", process=False)
    except Exception as error:  # a damaged file raises what it likes
        first = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(f"{file}: cannot be read as a mesh: {first}") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise ValueError(f"{file}: holds no faces")
    used = mesh.vertices[np.unique(mesh.faces)]
    if not np.isfinite(used).all() or np.abs(used * scale).max() > 1e6:
        raise ValueError(f"{file}: has vertices that are not finite, or kilometres away")
    mesh.process()
    mesh.apply_scale(scale)
    if _hull_volume(mesh) < _VOLUME:
        raise ValueError(f"{file}: encloses no volume")
    return mesh


def _hull_volume(mesh: trimesh.Trimesh) -> float:
    try:
        with np.errstate(all="ignore"):
            return float(mesh.convex_hull.volume)
    except Exception:  # Qhull's, of points in a plane
        return 0.0
