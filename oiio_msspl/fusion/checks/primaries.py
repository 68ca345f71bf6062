# SPDX-License-Identifier: Apache-2.0
"""Tells whether one of two renders has the primaries of P3 and the other one those of Rec.709.

The two differ little, so single blocks say nothing under noise. But P3 shifts each chromaticity by a known amount in a
known direction. One factor says how much of that shift there is between the renders: 0 for a right pair, 1 or -1 for P3
in one of them. It is found by instrumental variables: the direction comes from the neighbours of a block, whose noise
is another, so that noise does not bias the factor.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.image.colour import P3, REC709, conversion

#: A factor counts as P3 in this range, if it is this many standard errors from 0.
FACTORS, CERTAIN = (0.7, 1.4), 6.0
#: The factors of the halves of the frame must lie in this range: a single object in other light has no such colours.
FACTORS_OF_HALVES = (0.4, 1.8)
#: Colours are not compared if fewer blocks are lit.
MIN_BLOCKS = 64
#: Blocks along each side of the groups whose noise is independent.
GROUP = 3
#: Differences of chromaticity count up to this, so that coloured fireflies do not dominate.
LARGEST = 0.1

#: Grey pictures have no primaries: P3 shifts their chromaticities by less than the root of this.
LEAST = 1e-9

Colours = NDArray[np.float64]
_TO_P3 = conversion(REC709, P3)


def different_primaries(low: Colours, high: Colours) -> str | None:
    """Return in words how the primaries of two renders differ; None if they agree, or are too few to judge.

    Args:
        low, high: RGB of the same blocks of LRHS and HRLS, (rows, columns, 3).
    """
    low, high = (np.where(np.isfinite(colours), colours, 0) for colours in (low, high))
    brightness = low.sum(axis=2) + high.sum(axis=2)
    lit = (brightness > 0.05 * np.median(brightness)) & (low.sum(axis=2) > 0) & (high.sum(axis=2) > 0)
    both = np.where(lit[..., None], _chromaticities(low) + _chromaticities(high), 0)
    around = _around(both)
    lit &= around.sum(axis=2) > 0
    if np.count_nonzero(lit) < MIN_BLOCKS:
        return None
    difference = np.clip(_chromaticities(low) - _chromaticities(high), -LARGEST, LARGEST)
    direction, own = _shift(_chromaticities(around)), _shift(_chromaticities(both))
    products, norms = (np.where(lit, (values * direction).sum(axis=2), 0) for values in (difference, own))
    factor, error = _ratio(products, norms)
    if not (FACTORS[0] < abs(factor) < FACTORS[1] and abs(factor) > CERTAIN * error):
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
    if total <= LEAST * norms.size:
        return 0.0, np.inf
    factor = float(products.sum() / total)
    rest = products - factor * norms
    rest = np.pad(rest, [(0, -side % GROUP) for side in rest.shape])
    groups = rest.reshape(rest.shape[0] // GROUP, GROUP, -1, GROUP).sum(axis=(1, 3))
    return factor, float(np.sqrt(np.square(groups).sum()) / total)


def _chromaticities(rgb: Colours) -> Colours:
    """Divide colours (..., 3) by the sum of their channels."""
    result: Colours = rgb / np.maximum(rgb.sum(axis=-1, keepdims=True), 1e-30)
    return result


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
