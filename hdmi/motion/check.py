"""Checks that the motion types and every reader share; messages name file, field and frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


class MotionError(ValueError):
    """A motion file that cannot be used; the message names file, field and frame.

    Examples:
        >>> load_motion("motions/nowhere")
        Traceback (most recent call last):
        hdmi.motion.check.MotionError: motions/nowhere/meta.json: ...
    """


def checked(where: object, key: str, array: np.ndarray, shape: tuple[int, ...], because: str = "") -> np.ndarray:
    """The array as float32.

    Args:
        where: what the message starts with, such as the path of a file.
        key: the array's name there.
        shape: that it must have.
        because: of what it must have it, for the message.

    Raises:
        MotionError: for another shape, values that are not numbers, or not finite as float32.
    """
    array = np.asarray(array)
    if array.dtype.kind not in "fiub":
        raise MotionError(f"{where}: {key}: numbers expected, got dtype {array.dtype}")
    if array.shape != shape:
        raise MotionError(f"{where}: {key}: shape {array.shape}, expected {shape}{because}")
    with np.errstate(over="ignore"):
        array = array.astype(np.float32)
    if (bad := np.argwhere(~np.isfinite(array))).size:
        raise MotionError(f"{where}: {key}: not finite at frame {bad[0][0]}, index {tuple(int(i) for i in bad[0][1:])}")
    return array


def checked_quat(where: object, key: str, quat: np.ndarray, names: Sequence[str], kind: str) -> np.ndarray:
    """Unit quaternions as float32; those that are nearly unit are normalised. [T, N, 4]

    Args:
        names: of the N things that are oriented, and `kind` what they are, for the message.

    Raises:
        MotionError: where the norm is off by more than 1 percent.
    """
    norms = np.linalg.norm(quat.astype(np.float64), axis=-1)
    if (bad := np.argwhere(np.abs(norms - 1) > 1e-2)).size:
        t, i = bad[0]
        raise MotionError(f"{where}: {key}: norm {norms[t, i]:.3f} at frame {t}, {kind} {names[i]!r}")
    norms[np.abs(norms - 1) < 1e-6] = 1.0  # unit as far as float32 can tell: leave the bits alone
    return (quat / norms[..., None]).astype(np.float32)


def checked_labels(where: object, key: str, labels: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Labels, bool or 0/1, as bool.

    Raises:
        MotionError: as `checked`, and for any other value.
    """
    labels = checked(where, key, labels, shape)
    if (bad := np.argwhere((labels != 0) & (labels != 1))).size:
        raise MotionError(f"{where}: {key}: {labels[tuple(bad[0])]} at frame {bad[0][0]} is neither 0 nor 1")
    return labels.astype(bool)


def checked_fps(where: object, fps: float) -> float:
    """A rate in frames per second.

    Raises:
        MotionError: unless it is from 1 to 1000.
    """
    if not 1 <= fps <= 1000:
        raise MotionError(f"{where}: fps must be from 1 to 1000 frames per second, got {fps}")
    return float(fps)


def checked_names(where: object, key: str, names: Sequence[object]) -> tuple[str, ...]:
    """Distinct strings.

    Raises:
        MotionError: if they are not.
    """
    strings = tuple(name for name in names if isinstance(name, str))
    if len(strings) != len(names) or len(set(strings)) != len(strings):
        raise MotionError(f"{where}: {key} must be distinct strings")
    return strings
