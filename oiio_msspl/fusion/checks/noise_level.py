# SPDX-License-Identifier: Apache-2.0
"""Checks whether renders have little noise, for which there are other models, and how clean AOVs are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import ALBEDO, NORMAL
from oiio_msspl.aovs.mapped_render import ReadableRender
from oiio_msspl.fusion.checks.spread_noise import (
    CACHE_BYTES,
    blocks_of,
    correlations_in,
    noise_in,
    sample_windows,
    samples_of,
)
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.fusion.tiles.features import in_hrls_pixels, read_features
from oiio_msspl.image.colour import luminance
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.model.contract import ONE_SIZE
from oiio_msspl.model.encoding import encode_radiance, find_exposure
from oiio_msspl.model.render_mean import lrhs_share

#: Standard deviation of the noise in blocks, log-encoded, and the share of the blocks with less: the others may have
#: texture. Path-traced rooms have this noise at some 8 to 32 spp.
LITTLE, SMOOTH = 0.085, 0.25
#: The limit for a model that denoises albedo and normal before. Rooms have this noise at some 4 to 16 spp.
LITTLE_WITH_CLEAN_AOVS = 0.12
#: The limit for pairs of two sizes, by scale: the larger LRHS pixels are, the more detail models for more noise lose.
LITTLE_OF_PAIR = {2: 0.065, 4: 0.075, 8: 0.085}
#: The limit for pairs of two sizes and a model that denoises albedo and normal before: for the noise of their mean.
LITTLE_OF_MEAN = 0.075
#: The limit for noise that a filter has spread is this number times the scale.
LITTLE_SPREAD = 0.009
#: Blocks of an AOV show edges or texture from this variance on. There, neighbouring pixels of clean AOVs correlate by
#: more than the second number, in the mean: at 1, 2, 4, 8 and 16 spp by some 0.27, 0.37, 0.44, 0.47 and 0.50.
EDGES, CLEAN_AOVS = 1e-4, 0.46
#: The same for pairs of two sizes, whose difference tells smooth rooms of few spp from clean ones.
CLEAN_AOVS_OF_PAIR = 0.42


def has_little_noise(
    lr: ReadableRender, hr: ReadableRender, alignment: Alignment, *, spread: bool = False, denoises_aovs: bool = False
) -> bool:
    """Return whether an HRLS has little noise, or the mean of two renders of one size; one render is given as both.

    Small samples all over the frame are read.

    Args:
        lr, hr, alignment: of the pair.
        spread: a filter has spread the noise over neighbouring pixels.
        denoises_aovs: the model for little noise denoises albedo and normal before. Then it gains in more noise of the
            HRLS, too, if the LRHS has much less.
    """
    scale = alignment.scale
    if spread or scale == ONE_SIZE:
        of_one_size = LITTLE_WITH_CLEAN_AOVS if denoises_aovs else LITTLE
        limit, found = (LITTLE_SPREAD * scale if spread else of_one_size), _noise_in_blocks(lr, hr, alignment)
    else:
        limit = LITTLE_OF_MEAN if denoises_aovs else LITTLE_OF_PAIR[scale]
        found = _noise_by_difference(lr, hr, alignment, of_mean=denoises_aovs)
    return len(found) > 0 and bool(np.quantile(found, SMOOTH) < limit)


def _noise_in_blocks(lr: ReadableRender, hr: ReadableRender, alignment: Alignment) -> NDArray[np.float64]:
    """Return the deviation (n) of the pixels of blocks from a smooth course. Fine texture counts, too."""
    deviations = []
    for low, high, _ in samples_of(lr, hr, alignment):
        mean = (high + low) / np.float32(2) if alignment.scale == ONE_SIZE and lr is not hr else high
        image = encode_radiance(luminance(mean)[..., None], find_exposure(mean))[..., 0]
        deviations.append(noise_in(blocks_of(image)).std(axis=(1, 2)))
    return np.concatenate(deviations)


def _noise_by_difference(
    lr: ReadableRender, hr: ReadableRender, alignment: Alignment, *, of_mean: bool
) -> NDArray[np.float64]:
    """Return the deviation (n) of an HRLS pixel's noise in blocks, by the difference of both renders."""
    lows, highs = [], []
    for low, high, exposure in samples_of(lr, hr, alignment):
        lows.append(encode_radiance(low, exposure))
        highs.append(encode_radiance(box_downsample(high, alignment.scale), exposure))
    share = lrhs_share(np.stack(lows), np.stack(highs))
    # For d = LRHS - mean of the HRLS, E d^2 share s^2 is the variance of an HRLS pixel. That of the mean of both
    # renders is 2 (1 - share), relative to equal shares.
    gain = alignment.scale * np.sqrt(share * (min(1.0, 2 * (1 - share)) if of_mean else 1.0))
    # All colours count alike: blue noise is hardly seen in luminance.
    squares = [np.square(low - high, dtype=np.float64).mean(axis=-1) for low, high in zip(lows, highs, strict=True)]
    deviations = gain * np.sqrt(np.concatenate([blocks_of(plane) for plane in squares]).mean(axis=1))
    return deviations[deviations > 0]  # where both are black there is no noise


def has_clean_aovs(hr: ReadableRender, alignment: Alignment, least: float = CLEAN_AOVS) -> bool:
    """Return whether albedo and normal of an HRLS have hardly any noise, or no edge that could show it.

    At an edge, the few samples of a pixel fall on either side by chance, so neighbouring pixels differ more than those
    of a clean edge. Small samples all over the frame are read.
    """
    variances, products = [np.zeros(0)], [np.zeros(0)]
    with hr.cache_strips(CACHE_BYTES):
        for window in sample_windows(alignment.grid):
            area = in_hrls_pixels(window, alignment.scale)
            for image in read_features(hr, area, alignment.hr_data_window, [ALBEDO, NORMAL]).values():
                for plane in np.moveaxis(image, -1, 0):
                    residual = noise_in(blocks_of(plane))
                    variance = residual.var(axis=(1, 2))
                    shows = variance > EDGES
                    variances.append(variance[shows])
                    products.append(variance[shows] * correlations_in(residual[shows]))
    return bool(np.concatenate(products).sum() >= least * np.concatenate(variances).sum())
