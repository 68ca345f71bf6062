# SPDX-License-Identifier: Apache-2.0
"""Checks whether one of two renders is in another colour space or encoding, or has its channels in another order.

P3 and Rec.709 differ little, so single blocks say nothing of them under noise. But P3 shifts each chromaticity by a
known amount in a known direction. One factor says how much of that shift there is between the renders: 0 for a right
pair, 1 or -1 for P3 in one of them. It is found by instrumental variables: the direction comes from the neighbours of a
block, whose noise is another, so that noise does not bias the factor.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.image.arrays import Mask
from oiio_msspl.image.colour import ACES2065, ACESCG, P3, REC709, conversion

#: Another reading of the colours counts if it leaves at most this fraction of the difference of chromaticity, and is
#: better by this many standard errors.
BETTER, CERTAIN = 0.85, 4.0
#: Colours are not compared if fewer blocks are lit.
MIN_BLOCKS = 64
#: White balances that differ by less differ by rounding alone.
LEAST = 0.02
#: A factor counts as P3 in this range, if it is this many standard errors from 0.
FACTORS, CERTAIN_FACTOR = (0.7, 1.4), 6.0
#: The factors of the halves of the frame must lie in this range: a single object in other light has no such colours.
FACTORS_OF_HALVES = (0.4, 1.8)
#: Blocks along each side of the groups whose noise is independent.
GROUP = 3
#: Differences of chromaticity count up to this for P3, so that coloured fireflies do not dominate.
LARGEST = 0.1
#: Grey pictures have no primaries: P3 shifts their chromaticities by less than the root of this.
LEAST_SHIFT = 1e-9

_SPACES = {"linear Rec.709": REC709, "ACEScg": ACESCG, "ACES2065-1": ACES2065, "linear P3": P3}

Colours = NDArray[np.float64]
_TO_P3 = conversion(REC709, P3)


def _readings(low: Colours, high: Colours) -> Iterator[tuple[str, Colours, Colours]]:
    """Yield ways in which colours (3, n) may differ: words, the LRHS read as the HRLS, and the HRLS as the LRHS."""
    yield "red and blue are swapped in one of the two renders", low[::-1], high[::-1]
    for (a, first), (b, second) in itertools.permutations(_SPACES.items(), 2):
        matrix = conversion(first, second)
        yield f"the LRHS looks like {a} and the HRLS like {b}", matrix @ low, np.linalg.inv(matrix) @ high
    yield "the LRHS looks encoded for a display (sRGB) and the HRLS linear", _from_srgb(low), _srgb(high)
    yield "the HRLS looks encoded for a display (sRGB) and the LRHS linear", _srgb(low), _from_srgb(high)
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
    finite = np.isfinite(low + high).all(axis=1)  # sums of radiance near the limit of float32 are not
    low, high = low[finite], high[finite]
    lit = _lit(low, high) if low.size else np.zeros(0, np.bool_)
    if np.count_nonzero(lit) < MIN_BLOCKS:
        return None
    low, high = low.T[:, lit], high.T[:, lit]  # each channel is contiguous
    if min(low.sum(axis=1).min(), high.sum(axis=1).min()) <= 0:
        return None
    chromaticities = _chromaticities(low, 0), _chromaticities(high, 0)
    as_it_is = _differences(*chromaticities)
    best, least = None, BETTER * as_it_is.mean()
    for words, forwards, backwards in _readings(low, high):
        worse = max(
            _differences(_chromaticities(forwards, 0), chromaticities[1]),
            _differences(chromaticities[0], _chromaticities(backwards, 0)),
            key=np.mean,
        )
        gain = as_it_is - worse
        certain = gain.sum() > CERTAIN * np.sqrt(np.square(gain).sum())
        if certain and worse.mean() < least:
            best, least = words, worse.mean()
    return best


def _srgb(linear: Colours) -> Colours:
    x = np.clip(linear, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1 / 2.4) - 0.055)


def _from_srgb(encoded: Colours) -> Colours:
    x = np.maximum(encoded, 0)
    return np.where(x <= 0.04045, x / 12.92, np.power((x + 0.055) / 1.055, 2.4))


def _differences(a: Colours, b: Colours) -> NDArray[np.float64]:
    """Return the distances (n,) of chromaticities (3, n)."""
    # The limit keeps single blocks full of coloured noise from dominating.
    return np.minimum(np.abs(a - b).sum(axis=0), 0.5)


def different_primaries(low: Colours, high: Colours) -> str | None:
    """Return in words how the primaries of two renders differ; None if they agree, or are too few to judge.

    ``low``, ``high``: RGB of the same blocks of LRHS and HRLS, (rows, columns, 3).
    """
    low, high = (np.where(np.isfinite(colours), colours, 0) for colours in (low, high))
    lit = _lit(low, high)
    both = np.where(lit[..., None], _chromaticities(low) + _chromaticities(high), 0)
    around = _around(both)
    lit &= around.sum(axis=2) > 0
    if np.count_nonzero(lit) < MIN_BLOCKS:
        return None
    difference = np.clip(_chromaticities(low) - _chromaticities(high), -LARGEST, LARGEST)
    direction, own = _shift(_chromaticities(around)), _shift(_chromaticities(both))
    products, norms = (np.where(lit, (values * direction).sum(axis=2), 0) for values in (difference, own))
    factor, error = _ratio(products, norms)
    if not (FACTORS[0] < abs(factor) < FACTORS[1] and abs(factor) > CERTAIN_FACTOR * error):
        return None
    rows, columns = (side // 2 for side in lit.shape)
    for half in (np.s_[:rows], np.s_[rows:], np.s_[:, :columns], np.s_[:, columns:]):
        part, _ = _ratio(products[half], norms[half])
        if not FACTORS_OF_HALVES[0] < part * np.sign(factor) < FACTORS_OF_HALVES[1]:
            return None
    first, second = ("LRHS", "HRLS") if factor > 0 else ("HRLS", "LRHS")
    return f"the {first} looks like linear P3 and the {second} like linear Rec.709"


def _ratio(products: Colours, norms: Colours) -> tuple[float, float]:
    """Return the factor and its standard error, from what the blocks (rows, columns) contribute."""
    total = norms.sum()
    if total <= LEAST_SHIFT * norms.size:
        return 0.0, np.inf
    factor = float(products.sum() / total)
    rest = products - factor * norms
    rest = np.pad(rest, [(0, -side % GROUP) for side in rest.shape])
    groups = rest.reshape(rest.shape[0] // GROUP, GROUP, -1, GROUP).sum(axis=(1, 3))
    return factor, float(np.sqrt(np.square(groups).sum()) / total)


def _lit(low: Colours, high: Colours) -> Mask:
    """Return which blocks (..., 3) are lit in both renders, (...)."""
    first, second = low.sum(axis=-1), high.sum(axis=-1)
    return (first + second > 0.05 * np.median(first + second)) & (first > 0) & (second > 0)


def _chromaticities(rgb: Colours, axis: int = -1) -> Colours:
    """Divide colours by the sum of their channels, which lie along an axis."""
    return rgb / np.maximum(rgb.sum(axis=axis, keepdims=True), 1e-30)


def _shift(chromaticities: Colours) -> Colours:
    """Return by how much P3 shifts chromaticities of Rec.709."""
    return _chromaticities(chromaticities @ _TO_P3.T) - chromaticities


def _around(blocks: Colours) -> Colours:
    """Return the sum of the eight neighbours of each block (rows, columns, 3)."""
    padded = np.pad(blocks, [(1, 1), (1, 1), (0, 0)])
    rows, columns = blocks.shape[:2]
    total = -blocks
    for i, j in itertools.product(range(3), repeat=2):
        total += padded[i : i + rows, j : j + columns]
    return total
