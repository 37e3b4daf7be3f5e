"""Files that others wrote, read without trusting them; and our own, written atomically."""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hdmi.motion.check import MotionError

MAX_BYTES = 2 << 30  # of data in one file; an hour of motion has a tenth of it


@contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Puts the path in front of every MotionError raised inside that does not name it."""
    try:
        yield
    except MotionError as error:
        if str(path) in str(error):
            raise
        raise MotionError(f"{path}: {error}") from error


def existing_file(path: str | Path, hint: str = "") -> Path:
    """The path of a file of at most `MAX_BYTES`.

    Raises:
        MotionError: if it is none.
    """
    path = Path(path)
    if not path.is_file():
        raise MotionError(f"{path}: no such file{hint}")
    _check_size(path, path.stat().st_size)
    return path


def _check_size(where: object, size: int) -> None:
    if size > MAX_BYTES:
        raise MotionError(f"{where}: claims {size / 2**30:.1f} GiB of data, more than a motion has")


def read_npz(path: str | Path, keys: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Plain arrays of an npz; nothing is unpickled.

    Args:
        keys: to read where they are there; None reads all.

    Raises:
        MotionError: if the file is missing, damaged, or what is read is not a plain array.
    """
    path = existing_file(path)
    try:
        with zipfile.ZipFile(path) as archive:
            sizes = {info.filename.removesuffix(".npy"): info.file_size for info in archive.infolist()}
        wanted = [key for key in sizes if keys is None or key in keys]
        _check_size(path, sum(sizes[key] for key in wanted))
        with np.load(path, allow_pickle=False) as file:
            return {key: np.asarray(file[key]) for key in wanted}
    except MotionError:
        raise
    except Exception as error:  # a damaged archive raises what it likes
        raise MotionError(f"{path}: truncated or not an npz of plain arrays: {_first_line(error)}") from error


def read_torch(path: str | Path) -> Any:
    """What `torch.save` wrote, if it is tensors in plain containers; nothing else is unpickled.

    Raises:
        MotionError: if the file is missing, damaged, or holds anything else.
    """
    path = existing_file(path)
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                _check_size(path, sum(info.file_size for info in archive.infolist()))
        return torch.load(path, map_location="cpu", weights_only=True)
    except MotionError:
        raise
    except Exception as error:  # a damaged archive raises what it likes
        raise MotionError(
            f"{path}: truncated, or not plain tensors saved by torch.save (nothing else is unpickled): "
            f"{_first_line(error)}"
        ) from error


def tensor_array(path: str | Path, key: str, value: object) -> np.ndarray:
    """A dense tensor of real numbers as an array.

    Raises:
        MotionError: if it is none.
    """
    if not isinstance(value, Tensor) or value.layout != torch.strided or value.is_complex() or value.is_quantized:
        kind = f"a {value.layout} tensor of {value.dtype}" if isinstance(value, Tensor) else f"a {type(value).__name__}"
        raise MotionError(f"{path}: {key}: a dense tensor of real numbers expected, got {kind}")
    # a few bytes can pass as a large tensor: strides of zero
    _check_size(f"{path}: {key}", 8 * value.numel())
    try:
        return value.detach().to("cpu", torch.float64).numpy()
    except Exception as error:
        raise MotionError(f"{path}: {key}: not a tensor with data: {_first_line(error)}") from error


def read_text(path: str | Path) -> str:
    """A text file.

    Raises:
        MotionError: if it is missing or not UTF-8.
    """
    path = existing_file(path)
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise MotionError(f"{path}: not a text file: {_first_line(error)}") from error


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"


def write_npz(path: str | Path, arrays: Mapping[str, np.ndarray]) -> Path:
    """Writes an npz atomically, and the folders above it."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    return _write(Path(path), buffer.getvalue())


def write_text(path: str | Path, text: str) -> Path:
    """Writes a UTF-8 text file atomically, and the folders above it."""
    return _write(Path(path), text.encode())


def _write(path: Path, data: bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        partial.write_bytes(data)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    return path
