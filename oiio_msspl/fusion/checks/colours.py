# SPDX-License-Identifier: Apache-2.0
"""Checks whether one of two renders is in another colour space or encoding, or has its channels in another order."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.image.colour import ACES2065, ACESCG, P3, REC709, conversion, srgb

#: Another reading of the colours counts if it leaves at most this fraction of the difference of chromaticity, and is
#: better by this many standard errors.
BETTER, CERTAIN = 0.85, 4.0
#: Colours are not compared if fewer blocks are lit.
MIN_BLOCKS = 64
#: White balances that differ by less differ by rounding alone.
LEAST = 0.02

_SPACES = {"linear Rec.709": REC709, "ACEScg": ACESCG, "ACES2065-1": ACES2065, "linear P3": P3}

#: RGB of blocks.
Colours = NDArray[Any]


def _readings(low: Colours, high: Colours) -> Iterator[tuple[str, Colours, Colours]]:
    """Yield ways in which colours (3, n) may differ: words, the LRHS read as the HRLS, and the HRLS as the LRHS."""
    yield "red and blue are swapped in one of the two renders", low[::-1], high[::-1]
    for (a, first), (b, second) in itertools.permutations(_SPACES.items(), 2):
        matrix = conversion(first, second)
        yield f"the LRHS looks like {a} and the HRLS like {b}", matrix @ low, np.linalg.inv(matrix) @ high
    yield "the LRHS looks encoded for a display (sRGB) and the HRLS linear", _from_srgb(low), srgb(high)
    yield "the HRLS looks encoded for a display (sRGB) and the LRHS linear", srgb(low), _from_srgb(high)
    gains = (high.sum(axis=1) / low.sum(axis=1))[:, None]
    gains /= np.exp(np.log(gains).mean())
    if np.abs(np.log(gains)).max() < LEAST:
        return
    words = ", ".join(f"{gain:.2f}" for gain in gains.ravel())
    yield f"the white balance of the two renders differs (by {words} in red, green and blue)", low * gains, high / gains


def different_colours(low: Colours, high: Colours) -> str | None:
    """Return in words how the colours of two renders differ; None if they agree, or are too few to judge.

    Every reading is tried on the LRHS, and its inverse on the HRLS, and the worse of the two counts: a matrix that
    makes colours paler also makes their noise paler, but then its inverse does the opposite.

    ``low``, ``high``: RGB of the same blocks of both renders, (n, 3).
    """
    low, high = np.ascontiguousarray(low.T), np.ascontiguousarray(high.T)
    lights = low.sum(axis=0), high.sum(axis=0)
    lit = (np.minimum(*lights) > 0) & (sum(lights) > 0.05 * np.median(sum(lights)))
    if np.count_nonzero(lit) < MIN_BLOCKS:
        return None
    low, high = low[:, lit], high[:, lit]
    if min(low.sum(axis=1).min(), high.sum(axis=1).min()) <= 0:
        return None
    chromaticities = _chromaticities(low), _chromaticities(high)
    as_it_is = _differences(*chromaticities)
    best, least = None, BETTER * as_it_is.mean()
    for words, forwards, backwards in _readings(low, high):
        worse = max(
            _differences(_chromaticities(forwards), chromaticities[1]),
            _differences(chromaticities[0], _chromaticities(backwards)),
            key=np.mean,
        )
        gain = as_it_is - worse
        certain = gain.sum() > CERTAIN * np.sqrt(np.square(gain).sum())
        if certain and worse.mean() < least:
            best, least = words, worse.mean()
    return best


def _from_srgb(encoded: Colours) -> Colours:
    x = np.maximum(encoded, 0)
    return np.where(x <= 0.04045, x / 12.92, np.power((x + 0.055) / 1.055, 2.4))


def _differences(a: Colours, b: Colours) -> NDArray[np.float64]:
    """Return the distances (n,) of chromaticities (3, n)."""
    # The limit keeps single blocks full of coloured noise from dominating.
    return np.minimum(np.abs(a - b).sum(axis=0), 0.5)


def _chromaticities(rgb: Colours) -> Colours:
    """Divide colours (3, n) by the sum of their channels."""
    return rgb / np.maximum(rgb.sum(axis=0), 1e-30)
