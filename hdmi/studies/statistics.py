"""Statistics of a few runs: interquartile means with stratified bootstrap intervals, probability of improvement.

A sample is an array of one value for each seed; several samples, one for each task, are the strata: resampling draws
seeds within each task, never tasks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import bootstrap, mannwhitneyu, trim_mean

CONFIDENCE = 0.95
_RESAMPLES = 2000

Sample = NDArray[np.float64]


@dataclass(frozen=True)
class Estimate:
    """A figure with its interval; `low` and `high` are NaN where there are too few runs for one.

    Examples:
        >>> f"{Estimate(0.9, 0.85, 0.95, 6):.0%}"
        '90% [85%, 95%]'
        >>> f"{Estimate(0.9, float('nan'), float('nan'), 1):.2f}"
        '0.90'
    """

    value: float
    low: float
    high: float
    n: int  # runs

    def __format__(self, spec: str) -> str:
        if not np.isfinite(self.value):
            return "-"
        if not np.isfinite(self.low):
            return format(self.value, spec)
        return f"{self.value:{spec}} [{self.low:{spec}}, {self.high:{spec}}]"


def interquartile_mean(values: ArrayLike, axis: int = -1) -> Any:
    """The mean without the lowest and highest quarter of the values, of which whole values are left out.

    Examples:
        >>> float(interquartile_mean([0.0, 1.0, 2.0, 9.0]))
        1.5
    """
    return trim_mean(np.asarray(values, dtype=float), 0.25, axis=axis)


def iqm(samples: Sequence[Sample], seed: int = 0) -> Estimate:
    """The interquartile mean over tasks and seeds together, with its stratified bootstrap interval."""

    def statistic(*strata: Sample, axis: int = -1) -> Any:
        return interquartile_mean(np.concatenate(strata, axis=axis), axis)

    return _estimate(samples, statistic, seed)


def improvement(better: Sequence[Sample], than: Sequence[Sample], seed: int = 0) -> Estimate:
    """How likely a run of one variant has a greater value than one of another on the same task; ties count half.

    The mean over tasks of the Mann-Whitney statistic over the product of their sizes.
    """
    count = len(better)

    def statistic(*strata: Sample, axis: int = -1) -> Any:
        shares = [
            mannwhitneyu(a, b, axis=axis).statistic / (a.shape[axis] * b.shape[axis])
            for a, b in zip(strata[:count], strata[count:], strict=True)
        ]
        return np.mean(shares, axis=0)

    return _estimate([*better, *than], statistic, seed)


def paired_difference(samples: Sequence[Sample], minus: Sequence[Sample], seed: int = 0) -> Estimate:
    """The mean over tasks and seeds of the difference between two variants with the same task and seed."""
    differences = [a - b for a, b in zip(samples, minus, strict=True)]

    def statistic(*strata: Sample, axis: int = -1) -> Any:
        return np.concatenate(strata, axis=axis).mean(axis=axis)

    return _estimate(differences, statistic, seed)


def _estimate(samples: Sequence[Sample], statistic: Callable[..., Any], seed: int) -> Estimate:
    samples = [np.asarray(sample, dtype=float) for sample in samples]
    n = sum(len(sample) for sample in samples)
    if not samples or not all(len(sample) for sample in samples):
        return Estimate(np.nan, np.nan, np.nan, n)
    value = float(statistic(*samples))
    if min(len(sample) for sample in samples) < 2:  # nothing to resample
        return Estimate(value, np.nan, np.nan, n)
    if all(np.ptp(sample) == 0 for sample in samples):
        return Estimate(value, value, value, n)
    found = bootstrap(
        samples, statistic, n_resamples=_RESAMPLES, confidence_level=CONFIDENCE, method="percentile",
        rng=np.random.default_rng(seed), vectorized=True,
    )  # fmt: skip
    return Estimate(value, float(found.confidence_interval.low), float(found.confidence_interval.high), n)
