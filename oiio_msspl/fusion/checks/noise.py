# SPDX-License-Identifier: Apache-2.0
"""Looks at the noise of renders: has a pixel filter spread it, is there little of it, and are AOVs clean?

Some renderers add each sample to all pixels that the filter reaches. The noise of neighbouring pixels is then alike,
and denoisers that learnt from independent pixels take it for detail. Renders with little noise have other models, too.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.aovs.mapped_render import ReadableRender
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.fusion.tiles.features import in_hrls_pixels, read_features, read_lrhs
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.colour import luminance
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.model.contract import ONE_SIZE
from oiio_msspl.model.encoding import encode_radiance, find_exposure
from oiio_msspl.model.render_mean import lrhs_share

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
#: Standard deviation of the noise in blocks, log-encoded, and the share of the blocks with less: the others may have
#: texture. Path-traced rooms have this noise at some 8 to 32 spp.
LITTLE, SMOOTH = 0.085, 0.25
#: The limit for a model that denoises albedo and normal before. Rooms have this noise at some 4 to 16 spp.
LITTLE_WITH_CLEAN_AOVS = 0.12
#: The limit for pairs of two sizes, by scale: the larger LRHS pixels are, the more detail models for more noise lose.
LITTLE_OF_PAIR = {2: 0.065, 4: 0.075, 8: 0.085}
#: The limit for pairs of two sizes and a model that denoises albedo and normal before: for the noise of their mean.
LITTLE_OF_MEAN = 0.075
#: The limits for noise that a filter has spread, by scale: of its deviation, and of the correlation of pixels two
#: apart, which is higher where texture outweighs noise. Renders of one size reach these at some 500 to 1,000 spp.
LITTLE_SPREAD = {1: (0.0055, 0.075), 2: (0.018, 0.03), 4: (0.036, 0.03), 8: (0.072, 0.03)}
#: The limits at which renders of one size begin to gain by models for independent noise: at some 100 to 300 spp.
LESS_SPREAD = 0.009, 0.03
#: Pixels three apart correlate by less than this in noise of filters that are so wide that those two apart do not tell.
WIDE = -0.2
#: Blocks of an AOV show edges or texture from this variance on. There, neighbouring pixels of clean AOVs correlate by
#: more than the second number, in the mean: at 1, 2, 4, 8 and 16 spp by some 0.27, 0.37, 0.44, 0.47 and 0.50.
EDGES, CLEAN_AOVS = 1e-4, 0.46
#: The same for pairs of two sizes, whose difference tells smooth rooms of few spp from clean ones.
CLEAN_AOVS_OF_PAIR = 0.42


def is_noise_spread(lr: ReadableRender, hr: ReadableRender, alignment: Alignment) -> bool | None:
    """Return whether the noise of neighbouring pixels is alike in both renders; None if there is hardly any noise.

    Fine texture in the HRLS also makes neighbours alike, but cancels in the difference of the LRHS and the averaged
    HRLS. So neighbours must correlate in both. Of one render, which is given as both, nearly all blocks must correlate,
    also those without texture. Small samples all over the frame are read.
    """
    scale, correlations = alignment.scale, []
    for low, high, exposure in _samples_of(lr, hr, alignment):
        mean, low, high = (
            encode_radiance(luminance(image)[..., None], exposure)[..., 0]
            for image in (box_downsample(high, scale), low, high)
        )
        difference = low - mean
        dense = _blocks_of(np.abs(difference) > ROUNDING).mean(axis=1) > DENSE
        blocks = _blocks_of(high), _blocks_of(difference)[dense]
        correlations.append([_correlations_in(_noise_in(part)) for part in blocks])
    hrls, difference = (np.concatenate(parts) for parts in zip(*correlations, strict=True))
    if lr is hr:
        return None if len(hrls) < FEWEST else bool(np.quantile(hrls, LEAST_CORRELATED) > SPREAD_HRLS)
    if min(len(hrls), len(difference)) < FEWEST:
        return None
    return bool(np.median(hrls) > SPREAD_HRLS and np.median(difference) > SPREAD_DIFFERENCE)


def has_little_noise(
    lr: ReadableRender, hr: ReadableRender, alignment: Alignment, *, denoises_aovs: bool = False
) -> bool:
    """Return whether an HRLS has little noise, or the mean of two renders of one size; one render is given as both.

    Small samples all over the frame are read.

    Args:
        lr, hr, alignment: of the pair, whose noise no filter has spread.
        denoises_aovs: the model for little noise denoises albedo and normal before. Then it gains in more noise of the
            HRLS, too, if the LRHS has much less.
    """
    if alignment.scale == ONE_SIZE:
        limit = LITTLE_WITH_CLEAN_AOVS if denoises_aovs else LITTLE
        found = _residuals(lr, hr, alignment).std(axis=(1, 2))
    else:
        limit = LITTLE_OF_MEAN if denoises_aovs else LITTLE_OF_PAIR[alignment.scale]
        found = _noise_by_difference(lr, hr, alignment, of_mean=denoises_aovs)
    return _in_smooth_blocks(found) < limit


def has_little_spread_noise(lr: ReadableRender, hr: ReadableRender, alignment: Alignment) -> tuple[bool, bool]:
    """Return whether a filter has spread little noise, and whether models for independent noise are more accurate then.

    Models for spread noise were trained with more of it, and take detail for noise. The second is False for renders of
    two sizes. Small samples all over the frame are read.
    """
    residuals = _residuals(lr, hr, alignment)
    deviation = _in_smooth_blocks(residuals.std(axis=(1, 2)))
    # Pixels two apart do not correlate in noise that a filter has spread, and do in texture.
    two_apart, three_apart = (np.median(_correlations_in(residuals, apart)) for apart in (2, 3))
    texture = two_apart if three_apart > WIDE else 0.0
    little, less = (
        bool(deviation < most or texture > least) for most, least in (LITTLE_SPREAD[alignment.scale], LESS_SPREAD)
    )
    return little, less and alignment.scale == ONE_SIZE


def _residuals(lr: ReadableRender, hr: ReadableRender, alignment: Alignment) -> NDArray[np.float64]:
    """Return the pixels of an HRLS, or of the mean of renders of one size, log-encoded: blocks of :func:`_noise_in`."""
    residuals = []
    for low, high, _ in _samples_of(lr, hr, alignment):
        mean = (high + low) / np.float32(2) if alignment.scale == ONE_SIZE and lr is not hr else high
        image = encode_radiance(luminance(mean)[..., None], find_exposure(mean))[..., 0]
        residuals.append(_noise_in(_blocks_of(image)))
    return np.concatenate(residuals)


def _in_smooth_blocks(deviations: NDArray[np.float64]) -> float:
    """Return the deviation in blocks (n) with little texture; infinite without blocks. Fine texture counts, too."""
    return float(np.quantile(deviations, SMOOTH)) if len(deviations) else np.inf


def _noise_by_difference(
    lr: ReadableRender, hr: ReadableRender, alignment: Alignment, *, of_mean: bool
) -> NDArray[np.float64]:
    """Return the deviation (n) of an HRLS pixel's noise in blocks, by the difference of both renders."""
    lows, highs = [], []
    for low, high, exposure in _samples_of(lr, hr, alignment):
        lows.append(encode_radiance(low, exposure))
        highs.append(encode_radiance(box_downsample(high, alignment.scale), exposure))
    share = lrhs_share(np.stack(lows), np.stack(highs))
    # For d = LRHS - mean of the HRLS, E d^2 share s^2 is the variance of an HRLS pixel. That of the mean of both
    # renders is 2 (1 - share), relative to equal shares.
    gain = alignment.scale * np.sqrt(share * (min(1.0, 2 * (1 - share)) if of_mean else 1.0))
    # All colours count alike: blue noise is hardly seen in luminance.
    squares = [np.square(low - high, dtype=np.float64).mean(axis=-1) for low, high in zip(lows, highs, strict=True)]
    deviations = gain * np.sqrt(np.concatenate([_blocks_of(plane) for plane in squares]).mean(axis=1))
    return deviations[deviations > 0]  # where both are black there is no noise


def has_clean_aovs(hr: ReadableRender, alignment: Alignment, least: float = CLEAN_AOVS) -> bool:
    """Return whether albedo and normal of an HRLS have hardly any noise, or no edge that could show it.

    At an edge, the few samples of a pixel fall on either side by chance, so neighbouring pixels differ more than those
    of a clean edge. Small samples all over the frame are read.
    """
    variances, products = [np.zeros(0)], [np.zeros(0)]
    with hr.cache_strips(CACHE_BYTES):
        for window in _sample_windows(alignment.grid):
            area = in_hrls_pixels(window, alignment.scale)
            for image in read_features(hr, area, alignment.hr_data_window, [ALBEDO, NORMAL]).values():
                for plane in np.moveaxis(image, -1, 0):
                    residual = _noise_in(_blocks_of(plane))
                    variance = residual.var(axis=(1, 2))
                    shows = variance > EDGES
                    variances.append(variance[shows])
                    products.append(variance[shows] * _correlations_in(residual[shows]))
    return bool(np.concatenate(products).sum() >= least * np.concatenate(variances).sum())


def _samples_of(lr: ReadableRender, hr: ReadableRender, alignment: Alignment) -> Iterator[tuple[Array, Array, float]]:
    """Yield the colours of LRHS (h, w, 3) and HRLS (s*h, s*w, 3) in :func:`_sample_windows`, and their exposure."""
    with hr.cache_strips(CACHE_BYTES), lr.cache_strips(CACHE_BYTES):
        for window in _sample_windows(alignment.grid):
            low = read_lrhs(lr, alignment, window, [RGB])[RGB]
            area = in_hrls_pixels(window, alignment.scale)
            high = read_features(hr, area, alignment.hr_data_window, [RGB])[RGB]
            yield low, high, find_exposure(low)


def _sample_windows(grid: Window) -> list[Window]:
    """Return different squares of at most ``SAMPLE`` pixels, evenly spread over the grid."""
    width, height = min(SAMPLE, grid.width), min(SAMPLE, grid.height)
    columns, rows = (
        sorted({first + round(i * rest / (SAMPLES - 1)) for i in range(SAMPLES)})
        for first, rest in ((grid.x0, grid.width - width), (grid.y0, grid.height - height))
    )
    return [Window(x, y, x + width, y + height) for y in rows for x in columns]


def _blocks_of(image: NDArray[Any]) -> NDArray[Any]:
    """Return the whole blocks of an image (h, w), (n, BLOCK^2)."""
    rows, columns = (side // BLOCK for side in image.shape)
    blocks = image[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK)
    return blocks.swapaxes(1, 2).reshape(-1, BLOCK**2)


def _noise_in(blocks: Array) -> NDArray[np.float64]:
    """Return blocks (n, BLOCK, BLOCK) without their smooth course; black and blown-out ones have no noise."""
    residual = (blocks.astype(np.float64) @ _without_course()).reshape(-1, BLOCK, BLOCK)
    return np.asarray(residual[residual.var(axis=(1, 2)) > 1e-8])


def _correlations_in(residual: NDArray[np.float64], apart: int = 1) -> NDArray[np.float64]:
    """Return the correlation (n) of pixels so far ``apart`` in each block (n, BLOCK, BLOCK) of :func:`_noise_in`."""
    across = (residual[:, :, apart:] * residual[:, :, :-apart]).mean(axis=(1, 2))
    down = (residual[:, apart:] * residual[:, :-apart]).mean(axis=(1, 2))
    result: NDArray[np.float64] = (across + down) / 2 / np.square(residual).mean(axis=(1, 2))
    return result - _in_white_noise(apart)


@functools.cache
def _without_course() -> NDArray[np.float64]:
    """Return the matrix that removes the best-fitting quadratic polynomial from a flattened block."""
    y, x = (np.mgrid[:BLOCK, :BLOCK] - (BLOCK - 1) / 2).reshape(2, -1)
    basis, _ = np.linalg.qr(np.stack([np.ones_like(x), x, y, x * y, x * x, y * y], axis=1))
    return np.eye(BLOCK**2) - basis @ basis.T


@functools.cache
def _in_white_noise(apart: int) -> float:
    """Return the correlation that independent pixels get when the polynomial is removed."""
    covariance = _without_course().reshape((BLOCK,) * 4)
    i = np.arange(BLOCK - apart)
    across = np.mean([covariance[y, i, y, i + apart] for y in range(BLOCK)])  # down, they are alike
    return float(across / np.diag(_without_course()).mean())
