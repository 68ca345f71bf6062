# SPDX-License-Identifier: Apache-2.0
"""Measure how wrong the frames of a sequence are, and how much they flicker.

Flicker is what changes from frame to frame of a result beyond what changes in the reference. With the result O and the
reference R, it is the root of the mean square of (O[t+1] - O[t]) - (R[t+1] - R[t]), in sRGB values from 0 to 1.

The reference comes in two halves with independent noise. Each square is the product of the differences to both halves,
so that the noise of the reference cancels out.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.image.arrays import Array

Mask = NDArray[np.bool_]


def flicker(images: Array, truth: tuple[Array, Array]) -> float:
    """Return the flicker of sRGB images (frames, h, w, 3) against two references, or twice one without noise."""
    first, second = (np.diff(images - reference, axis=0) for reference in truth)
    return math.sqrt(_mean(first * second))


def psnr(image: Array, truth: tuple[Array, Array], mask: Mask | None = None) -> float:
    """Return PSNR in dB of sRGB values (..., 3) against two references, where the mask (...) is set if there is one."""
    products = (image - truth[0]) * (image - truth[1])
    square = _mean(products if mask is None else products[mask])
    return math.inf if square == 0 else -10 * math.log10(square)


def _mean(products: NDArray[Any]) -> float:
    """Return the mean of products of two measurements. Noise of one of them may make it negative, which means 0."""
    return max(float(np.mean(products, dtype=np.float64)), 0.0)
