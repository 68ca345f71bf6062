# SPDX-License-Identifier: Apache-2.0
"""Checks whether one of two renders is in another colour space, or has its channels in another order."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.image.colour import ACES2065, ACESCG, REC709, conversion

#: Another reading of the colours counts if it leaves at most this fraction of the difference of chromaticity.
BETTER = 0.85
#: It must be better by this many standard errors.
CERTAIN = 4.0
#: Colours are not compared if there are fewer blocks.
MIN_BLOCKS = 64

_SPACES = {"linear Rec.709": REC709, "ACEScg": ACESCG, "ACES2065-1": ACES2065}

#: A difference of colours -> the matrix from the LRHS to the HRLS.
READINGS = {"red and blue are swapped in one of the two renders": np.eye(3)[::-1]} | {
    f"the LRHS looks like {low} and the HRLS like {high}": conversion(_SPACES[low], _SPACES[high])
    for low, high in itertools.permutations(_SPACES, 2)
}


def different_colours(low: NDArray[np.float64], high: NDArray[np.float64]) -> str | None:
    """Return how the colours of two renders differ, as a key of `READINGS`; None if they agree.

    Every matrix is tried on the LRHS, and its inverse on the HRLS, and the worse of the two counts: a matrix that makes
    colours paler also makes their noise paler, but then its inverse does the opposite.

    Args:
        low, high: RGB of the same blocks of both renders, (n, 3).
    """
    low, high = low.T, high.T  # each channel is contiguous
    finite = np.isfinite(low + high).all(axis=0)  # sums of radiance near the limit of float32 are not
    low, high = low[:, finite], high[:, finite]
    if low.shape[1] < MIN_BLOCKS:
        return None
    brightness = low.sum(axis=0) + high.sum(axis=0)
    lit = (brightness > 0.05 * np.median(brightness)) & (low.sum(axis=0) > 0) & (high.sum(axis=0) > 0)
    low, high = low[:, lit], high[:, lit]
    if low.shape[1] < MIN_BLOCKS:
        return None
    chromaticities = _chromaticities(low), _chromaticities(high)
    as_it_is = _differences(*chromaticities)
    best, least = None, BETTER * as_it_is.mean()
    for reading, matrix in READINGS.items():
        forwards = _differences(_chromaticities(matrix @ low), chromaticities[1])
        backwards = _differences(chromaticities[0], _chromaticities(np.linalg.inv(matrix) @ high))
        worse = max(forwards, backwards, key=np.mean)
        gain = as_it_is - worse
        certain = gain.sum() > CERTAIN * np.sqrt(np.square(gain).sum())
        if certain and worse.mean() < least:
            best, least = reading, worse.mean()
    return best


def _chromaticities(rgb: NDArray[np.float64]) -> NDArray[np.float64]:
    """Divide colours (3, n) by the sum of their channels."""
    return rgb / np.maximum(rgb.sum(axis=0), 1e-30)


def _differences(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances (n,) of chromaticities (3, n)."""
    # The limit keeps single blocks full of coloured noise from dominating.
    return np.minimum(np.abs(a - b).sum(axis=0), 0.5)
