# SPDX-License-Identifier: Apache-2.0
"""Compare two methods: the mean difference and the ratio of means over scenes, with 95 % intervals.

The interval is a bootstrap over scenes: as many scenes as there are, drawn again and again with repetition. It says
what other scenes of the same kind might have given. With five scenes it is rather too narrow than too wide.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

#: How often the scenes are drawn, and the percentiles of the means that bound the interval.
DRAWS, PERCENTILES = 20_000, (2.5, 97.5)


def with_interval(values: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return the mean of one value for each scene, and the ends of its interval."""
    return float(values.mean()), *_ends(values[_draws(len(values))].mean(axis=1))


def ratio_with_interval(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return the ratio of the means of two methods' values, one for each scene, and the ends of its interval."""
    drawn = _draws(len(ours))
    return float(ours.mean() / theirs.mean()), *_ends(ours[drawn].mean(axis=1) / theirs[drawn].mean(axis=1))


@functools.cache
def _draws(count: int) -> NDArray[np.int64]:
    """Return the indices of the drawn scenes, (DRAWS, count), equal in every run."""
    return np.random.default_rng(0).integers(count, size=(DRAWS, count))


def _ends(means: NDArray[np.float64]) -> tuple[float, float]:
    low, high = np.percentile(means, PERCENTILES)
    return float(low), float(high)


def cell(value: tuple[float, float, float], form: str) -> str:
    """Return a value and its interval as text."""
    middle, low, high = (format(number, form) for number in value)
    return f"{middle} ({low} to {high})"
