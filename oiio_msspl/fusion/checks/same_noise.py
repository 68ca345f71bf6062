# SPDX-License-Identifier: Apache-2.0
"""Checks whether the LRHS was made from the HRLS by scaling it down, so that both have the same noise.

A scaled-down picture is a weighted sum of HRLS pixels, whatever the filter. So the weights are fitted, and what they
leave is compared with the noise that such a sum has: an independent render differs by at least as much.
"""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.image.arrays import Array
from oiio_msspl.image.filters import blurred, box_downsample
from oiio_msspl.model.contract import ONE_SIZE

#: Side, in LRHS pixels, of the middle of the frame that is compared, and of the blocks in which noise is averaged.
MIDDLE, BLOCK = 256, 4
#: The LRHS has the noise of the HRLS if in three of four blocks it differs by less than this fraction of the variance
#: of independent renders. At 1 - 8 spp right pairs reach 1.0, those full of texture at 64 - 256 spp 0.75, and pairs
#: scaled down by eight filters 0.00 - 0.55.
SAME_NOISE = 0.4
#: The LRHS was made from the HRLS if it differs by less than this fraction of its brightness, RMS. Independent renders
#: of thousands of spp differ by more.
COPIED = 0.002
#: A block has noise if its RMS is this fraction of the block's brightness.
NOISY = 0.02
#: Noise is not compared if there are fewer noisy blocks, or if they are less than this fraction of the lit ones.
MIN_NOISY_BLOCKS, MIN_NOISY = 24, 0.25
#: The numbers of quarters of LRHS pixels that share a weight, see :func:`_sums`.
_COUNTS = np.array([4, 8, 4, 8, 8, 4])


def compare_noise(low: Array, quarters: Array) -> tuple[bool | None, bool]:
    """Compare the noise of both renders.

    Args:
        low: luminance of the LRHS (h, w).
        quarters: luminance of the HRLS over the quarters of LRHS pixels, (2h, 2w).

    Returns:
        Whether the noise is the same, None if there is too little of it; and whether the LRHS is independent. Texture
        without noise looks like shared noise, so it is independent unless nothing is left of the difference.
    """
    if min(low.shape) < 4 * BLOCK:
        return None, True
    rows, columns = inner = tuple(slice(BLOCK, (side - BLOCK) // BLOCK * BLOCK) for side in low.shape)
    sums, picture = _sums(quarters.astype(np.float64))[..., rows, columns], low[inner].astype(np.float64)
    brightness = blurred((low + box_downsample(quarters, 2)) / np.float32(2), 2)[inner].astype(np.float64)
    # Relative differences, so that no bright corner dominates.
    weight = np.divide(1, brightness, out=np.zeros_like(brightness), where=brightness > 0)
    # The normal equations: the threads of a large least squares problem keep a core busy for 0.2 s after it.
    planes = (sums * weight).reshape(len(sums), -1)
    products = (planes * (picture * weight).ravel()).sum(axis=1)
    weights = np.linalg.lstsq(planes @ planes.T, products, rcond=None)[0]
    residual, noise, light = (
        box_downsample(values, BLOCK).astype(np.float64)
        for values in (
            np.square(picture - sum(map(operator.mul, weights, sums))),
            noise_variance(quarters.astype(np.float64), 2)[inner],
            brightness,
        )
    )
    noisy = (light > 0) & (noise > np.square(NOISY * light))
    if np.count_nonzero(noisy) < max(MIN_NOISY_BLOCKS, MIN_NOISY * np.count_nonzero(light)):
        return None, True
    expected = noise[noisy] * float(_COUNTS @ np.square(weights))
    same, copied = (
        bool(np.quantile(residual[noisy] / np.maximum(part, 1e-300), 0.75) < most)
        for part, most in ((expected, SAME_NOISE), (np.square(light[noisy]), COPIED**2))
    )
    return same, not copied


def noise_variance(pixels: NDArray[Any], scale: int) -> NDArray[Any]:
    """Estimate the variance of noise (h, w, ...) of the HRLS's pixels (s*h, s*w, ...) from 2 x 2 pixels each."""
    # Gradients and straight edges cancel out of a diagonal difference. Its variance is four times that of the noise.
    if scale == ONE_SIZE:  # each pixel, with those to the right and below
        pixels = np.pad(pixels, [(0, 1), (0, 1), *[(0, 0)] * (pixels.ndim - 2)], mode="edge")
        a, b, c, d = (pixels[i : len(pixels) - 1 + i, j : pixels.shape[1] - 1 + j] for i in (0, 1) for j in (0, 1))
    else:
        a, b, c, d = (pixels[i::2, j::2] for i in (0, 1) for j in (0, 1))
    variance: NDArray[Any] = np.square(a - b - c + d) / np.float32(4)
    return box_downsample(variance, scale // 2) if scale > 2 else variance


def _sums(quarters: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return sums of the quarters in the 3 x 3 LRHS pixels around each, (6, h, w): those that filters weight alike."""
    height, width = quarters.shape
    padded = np.pad(quarters, 2, mode="edge")
    # Of six rows around the middle of a pixel, each with the one that is as far from it.
    rows = [padded[2 - i : 2 - i + height : 2] + padded[3 + i : 3 + i + height : 2] for i in range(3)]
    near, next_, far = (
        [row[:, 2 - i : 2 - i + width : 2] + row[:, 3 + i : 3 + i + width : 2] for i in range(3)] for row in rows
    )
    return np.stack([near[0], near[1] + next_[0], next_[1], near[2] + far[0], next_[2] + far[1], far[2]])
