# SPDX-License-Identifier: Apache-2.0
"""Checks whether renders have little noise, for which there are other models, and how clean AOVs are."""

from __future__ import annotations

import numpy as np

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.exr.render import ReadableRender
from oiio_msspl.fusion.checks.spread_noise import CACHE_BYTES, blocks_of, correlations_in, noise_in, sample_windows
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.fusion.tiles.features import in_hrls_pixels, read_features
from oiio_msspl.image.colour import luminance
from oiio_msspl.model.contract import ONE_SIZE
from oiio_msspl.model.encoding import encode_radiance, find_exposure

#: Standard deviation of the noise in blocks, log-encoded, and the share of the blocks with less: the others may have
#: texture. Path-traced rooms have this noise at some 16 to 32 spp.
LITTLE, SMOOTH = 0.07, 0.25
#: The same for noise that a filter has spread, for each HRLS pixel along a side of one of the LRHS: the wider these
#: are, the less they tell of detail.
LITTLE_SPREAD = 0.009
#: Blocks of an AOV show edges or texture from this variance on. There, neighbouring pixels of clean AOVs correlate by
#: more than the second number, in the mean: at 1, 2, 4, 8 and 16 spp by some 0.27, 0.37, 0.44, 0.47 and 0.50.
EDGES, CLEAN = 1e-4, 0.46


def has_little_noise(lr: ReadableRender, hr: ReadableRender, alignment: Alignment, *, spread: bool = False) -> bool:
    """Return whether an HRLS has little noise, or the mean of two renders of one size; one render is given as both.

    Small samples all over the frame are read. ``spread``: a filter has spread the noise over neighbouring pixels.
    """
    deviations, window, scale = [], alignment.hr_data_window, alignment.scale
    with hr.cache_strips(CACHE_BYTES), lr.cache_strips(CACHE_BYTES):
        for grid in sample_windows(alignment.grid):
            area = in_hrls_pixels(grid, scale)
            mean = read_features(hr, area, window, [RGB])[RGB]
            if scale == ONE_SIZE and lr is not hr:
                mean = (mean + read_features(lr, area, window, [RGB])[RGB]) / np.float32(2)
            image = encode_radiance(luminance(mean)[..., None], find_exposure(mean))[..., 0]
            deviations.append(noise_in(blocks_of(image)).std(axis=(1, 2)))
    found = np.concatenate(deviations)
    return len(found) > 0 and bool(np.quantile(found, SMOOTH) < (LITTLE_SPREAD * scale if spread else LITTLE))


def has_clean_aovs(hr: ReadableRender, alignment: Alignment) -> bool:
    """Return whether albedo and normal of an HRLS have hardly any noise, or no edge that could show it.

    At an edge, the few samples of a pixel fall on either side by chance, so neighbouring pixels differ more than those
    of a clean edge. Their noise does not depend on the light. Small samples all over the frame are read.
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
    return bool(np.concatenate(products).sum() >= CLEAN * np.concatenate(variances).sum())
