# SPDX-License-Identifier: Apache-2.0
"""Checks whether renders of one size have little noise, for which there are other models."""

from __future__ import annotations

import numpy as np

from oiio_msspl.aovs.features import RGB
from oiio_msspl.exr.render import ReadableRender
from oiio_msspl.fusion.checks.spread_noise import CACHE_BYTES, blocks_of, noise_in, sample_windows
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.fusion.tiles.features import read_features
from oiio_msspl.image.colour import luminance
from oiio_msspl.model.encoding import encode_radiance, find_exposure

#: Standard deviation of the noise in blocks, log-encoded, and the share of the blocks with less: the others may have
#: texture. Path-traced rooms have this noise at some 16 to 32 spp.
LITTLE, SMOOTH = 0.07, 0.25


def has_little_noise(lr: ReadableRender, hr: ReadableRender, alignment: Alignment) -> bool:
    """Return whether the mean of two renders of one size has little noise; one render is given as both.

    Small samples all over the frame are read.
    """
    deviations, window = [], alignment.hr_data_window
    with hr.cache_strips(CACHE_BYTES), lr.cache_strips(CACHE_BYTES):
        for area in sample_windows(alignment.grid):
            mean = read_features(hr, area, window, [RGB])[RGB]
            if lr is not hr:
                mean = (mean + read_features(lr, area, window, [RGB])[RGB]) / np.float32(2)
            image = encode_radiance(luminance(mean)[..., None], find_exposure(mean))[..., 0]
            deviations.append(noise_in(blocks_of(image)).std(axis=(1, 2)))
    found = np.concatenate(deviations)
    return len(found) > 0 and bool(np.quantile(found, SMOOTH) < LITTLE)
