# SPDX-License-Identifier: Apache-2.0
"""Checks whether renders of one size have little noise, for which there are other models."""

from __future__ import annotations

import numpy as np

from oiio_msspl.aovs.features import RGB
from oiio_msspl.exr.render import ReadableRender
from oiio_msspl.fusion.checks.spread_noise import CACHE_BYTES, sample_windows
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.fusion.tiles.features import read_features
from oiio_msspl.image.colour import luminance
from oiio_msspl.model.encoding import encode_radiance, find_exposure

#: Mean difference of a pixel to its diagonal neighbours, log-encoded. Path-traced rooms have it at some 16 spp.
LITTLE = 0.125


def has_little_noise(lr: ReadableRender, hr: ReadableRender, alignment: Alignment) -> bool:
    """Return whether the mean of two renders of one size has little noise; one render is given as both.

    Small samples all over the frame are read. Texture counts as noise, so the median of the samples decides.
    """
    differences, window = [], alignment.hr_data_window
    with hr.cache_strips(CACHE_BYTES), lr.cache_strips(CACHE_BYTES):
        for area in sample_windows(alignment.grid):
            mean = read_features(hr, area, window, [RGB])[RGB]
            if lr is not hr:
                mean = (mean + read_features(lr, area, window, [RGB])[RGB]) / np.float32(2)
            image = encode_radiance(luminance(mean)[..., None], find_exposure(mean))[..., 0]
            around = image[:-2, :-2] + image[:-2, 2:] + image[2:, :-2] + image[2:, 2:]
            differences.append(np.abs(image[1:-1, 1:-1] - around / 4).mean())
    return bool(np.median(differences) < LITTLE)
