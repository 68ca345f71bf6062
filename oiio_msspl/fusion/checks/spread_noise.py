# SPDX-License-Identifier: Apache-2.0
"""Checks whether a pixel filter has spread the noise of a pair over neighbouring pixels.

Some renderers add each sample to all pixels that the filter reaches. The noise of neighbouring pixels is then alike,
and denoisers that learnt from independent pixels take it for detail.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import RGB
from oiio_msspl.aovs.mapped_render import ReadableRender
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.fusion.tiles.features import in_hrls_pixels, read_features, read_lrhs
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.colour import luminance
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.model.encoding import encode_radiance, find_exposure

#: Side of the blocks in which neighbouring pixels are compared; and of a sample of the frame, in LRHS pixels.
BLOCK, SAMPLE = 8, 32
#: Samples along each side of the frame.
SAMPLES = 3
#: The fewest blocks with noise for a judgement.
FEWEST = 4
#: A block has noise if this fraction of its pixels differ between both renders by more than rounding does, log-encoded.
#: Without noise they differ along edges, where samples of a pixel fall on either side.
DENSE, ROUNDING = 0.5, 1e-3
#: Bytes of decoded rows that neighbouring samples share.
CACHE_BYTES = 256 << 20
#: Noise is spread if neighbouring pixels of the HRLS, and of the difference between both renders, correlate by more.
#: A box filter or importance sampling has 0 in both; Mitsuba's default, a Gaussian, has 0.3 and at least 0.04.
SPREAD_HRLS, SPREAD_DIFFERENCE = 0.15, 0.02
#: Of one render, this share of the blocks may correlate by less. Texture makes up to half of the blocks of a render of
#: 64 spp correlate by more.
LEAST_CORRELATED = 0.25


def is_noise_spread(lr: ReadableRender, hr: ReadableRender, alignment: Alignment) -> bool | None:
    """Return whether the noise of neighbouring pixels is alike in both renders; None if there is hardly any noise.

    Fine texture in the HRLS also makes neighbours alike, but cancels in the difference of the LRHS and the averaged
    HRLS. So neighbours must correlate in both. Of one render, which is given as both, nearly all blocks must correlate,
    also those without texture. Small samples all over the frame are read.
    """
    scale, correlations = alignment.scale, []
    for low, high, exposure in samples_of(lr, hr, alignment):
        mean, low, high = (
            encode_radiance(luminance(image)[..., None], exposure)[..., 0]
            for image in (box_downsample(high, scale), low, high)
        )
        difference = low - mean
        dense = blocks_of(np.abs(difference) > ROUNDING).mean(axis=1) > DENSE
        blocks = blocks_of(high), blocks_of(difference)[dense]
        correlations.append([correlations_in(noise_in(part)) for part in blocks])
    hrls, difference = (np.concatenate(parts) for parts in zip(*correlations, strict=True))
    if lr is hr:
        return None if len(hrls) < FEWEST else bool(np.quantile(hrls, LEAST_CORRELATED) > SPREAD_HRLS)
    if min(len(hrls), len(difference)) < FEWEST:
        return None
    return bool(np.median(hrls) > SPREAD_HRLS and np.median(difference) > SPREAD_DIFFERENCE)


def samples_of(lr: ReadableRender, hr: ReadableRender, alignment: Alignment) -> Iterator[tuple[Array, Array, float]]:
    """Yield the colours of LRHS (h, w, 3) and HRLS (s*h, s*w, 3) in :func:`sample_windows`, and their exposure."""
    with hr.cache_strips(CACHE_BYTES), lr.cache_strips(CACHE_BYTES):
        for window in sample_windows(alignment.grid):
            low = read_lrhs(lr, alignment, window, [RGB])[RGB]
            area = in_hrls_pixels(window, alignment.scale)
            high = read_features(hr, area, alignment.hr_data_window, [RGB])[RGB]
            yield low, high, find_exposure(low)


def sample_windows(grid: Window) -> list[Window]:
    """Return different squares of at most ``SAMPLE`` pixels, evenly spread over the grid."""
    width, height = min(SAMPLE, grid.width), min(SAMPLE, grid.height)
    columns, rows = (
        sorted({first + round(i * rest / (SAMPLES - 1)) for i in range(SAMPLES)})
        for first, rest in ((grid.x0, grid.width - width), (grid.y0, grid.height - height))
    )
    return [Window(x, y, x + width, y + height) for y in rows for x in columns]


def blocks_of(image: NDArray[Any]) -> NDArray[Any]:
    """Return the whole blocks of an image (h, w), (n, BLOCK^2)."""
    rows, columns = (side // BLOCK for side in image.shape)
    blocks = image[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK)
    return blocks.swapaxes(1, 2).reshape(-1, BLOCK**2)


def noise_in(blocks: Array) -> NDArray[np.float64]:
    """Return blocks (n, BLOCK, BLOCK) without their smooth course; black and blown-out ones have no noise."""
    residual = (blocks.astype(np.float64) @ _without_course()).reshape(-1, BLOCK, BLOCK)
    return np.asarray(residual[residual.var(axis=(1, 2)) > 1e-8])


def correlations_in(residual: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the correlation (n) of neighbouring pixels in each block (n, BLOCK, BLOCK) of :func:`noise_in`."""
    across = (residual[:, :, 1:] * residual[:, :, :-1]).mean(axis=(1, 2))
    down = (residual[:, 1:] * residual[:, :-1]).mean(axis=(1, 2))
    result: NDArray[np.float64] = (across + down) / 2 / np.square(residual).mean(axis=(1, 2))
    return result - _neighbours_of_white_noise()


@functools.cache
def _without_course() -> NDArray[np.float64]:
    """Return the matrix that removes the best-fitting quadratic polynomial from a flattened block."""
    y, x = (np.mgrid[:BLOCK, :BLOCK] - (BLOCK - 1) / 2).reshape(2, -1)
    basis, _ = np.linalg.qr(np.stack([np.ones_like(x), x, y, x * y, x * x, y * y], axis=1))
    return np.eye(BLOCK**2) - basis @ basis.T


@functools.cache
def _neighbours_of_white_noise() -> float:
    """Return the correlation that independent neighbours get when the polynomial is removed."""
    covariance = _without_course().reshape((BLOCK,) * 4)
    i = np.arange(BLOCK - 1)
    across = np.mean([covariance[y, i, y, i + 1] for y in range(BLOCK)])  # down, they are alike
    return float(across / np.diag(_without_course()).mean())
