# SPDX-License-Identifier: Apache-2.0
"""Is one of two renders in another colour space, or are its channels in another order?"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.colour import ACES2065, ACESCG, REC709, conversion

#: Another reading of the colours counts if it leaves at most this share of the difference of chromaticity.
BETTER = 0.85

#: By how many standard errors it must be better.
CERTAIN = 4.0
#: With fewer blocks nothing is said of colours.
MIN_BLOCKS = 64

_SPACES = {"linear Rec.709": REC709, "ACEScg": ACESCG, "ACES2065-1": ACES2065}

#: What the colours of the HRLS are to those of the LRHS -> the matrix from LRHS to HRLS.
READINGS = {"red and blue are swapped in one of the two renders": np.eye(3)[::-1]} | {
    f"the LRHS looks like {low} and the HRLS like {high}": conversion(_SPACES[low], _SPACES[high])
    for low, high in itertools.permutations(_SPACES, 2)
}


def different_colours(low: NDArray[np.float64], high: NDArray[np.float64]) -> str | None:
    """How the colours of two renders differ, as a key of `READINGS`; None if they do not.

    Every reading is tried both ways, on the LRHS and reversed on the HRLS: a matrix that makes colours paler also makes
    their noise paler, but then its inverse does the opposite.

    Args:
        low, high: RGB of the same blocks of both renders, (n, 3).
    """
    finite = np.isfinite(low + high).all(axis=-1)  # sums of radiance near the limit of float32 are not
    low, high = low[finite], high[finite]
    if len(low) < MIN_BLOCKS:
        return None
    brightness = low.sum(axis=-1) + high.sum(axis=-1)
    lit = (brightness > 0.05 * np.median(brightness)) & (low.sum(axis=-1) > 0) & (high.sum(axis=-1) > 0)
    low, high = low[lit], high[lit]
    if len(low) < MIN_BLOCKS:
        return None
    as_it_is = _differences(low, high)
    best, least = None, BETTER * as_it_is.mean()
    for reading, matrix in READINGS.items():
        both_ways = _differences(low @ matrix.T, high), _differences(low, high @ np.linalg.inv(matrix).T)
        worse = max(both_ways, key=np.mean)
        gain = as_it_is - worse
        certain = gain.sum() > CERTAIN * np.sqrt(np.square(gain).sum())
        if certain and worse.mean() < least:
            best, least = reading, worse.mean()
    return best


def _differences(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances (n,) of the chromaticities of colours (n, 3), whatever their brightness."""
    chromaticities = [v / np.maximum(v.sum(axis=-1, keepdims=True), 1e-30) for v in (a, b)]
    # The limit keeps single blocks full of coloured noise from dominating.
    return np.minimum(np.abs(chromaticities[0] - chromaticities[1]).sum(axis=-1), 0.5)
