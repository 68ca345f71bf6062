# SPDX-License-Identifier: Apache-2.0
"""Has the light of a frame's neighbour changed?

Both renders of a frame, `L` and `H`, are compared with those of a neighbour at the LRHS's resolution. They have
independent noise, so the mean of the product of the two differences is the squared change of the light without the
noise of the renders. (Zheng et al. 2021 estimate errors from two independent buffers in the same way.)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from oiio_msspl.arrays import Array, box_downsample, upsample_linear
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.alignment import Alignment
from oiio_msspl.fusion.neighbourhood import mean_around
from oiio_msspl.fusion.tile_features import mirrored
from oiio_msspl.model.contract import SCALES
from oiio_msspl.parallel import two_at_a_time

T = TypeVar("T")

#: The change is averaged over squares of two sizes, in HRLS pixels to each side. The small one finds the edge of a
#: shadow, the large one a faint change of all the light.
RADII = (14, 28)
#: The error that a fused frame has itself: the variance of the noise of this many HRLS pixels, averaged.
PIXELS_AVERAGED = 80.0
#: How many standard deviations of its own noise are subtracted from an estimated change.
DOUBT = 0.5
#: Differences relative to the local brightness are limited to this, because a firefly says nothing of the light.
LARGEST_DIFFERENCE = 3.0
#: The local brightness is at least this share of the frame's.
DARKEST = 0.02
#: Relative squared difference below which two frames are equal.
EQUAL = 1e-4
#: A frame is averaged in bands of rows, two at a time. Two together have at most so many pixels, which bounds memory,
#: unless they have fewer rows than that each: the rows around a band are computed twice.
BAND_PIXELS, BAND_ROWS = 1 << 22, 128
#: The rows of a band are a multiple of every scale.
ROW_MULTIPLE = max(SCALES)


def for_bands(alignment: Alignment, work: Callable[[Window, Window], T], weight: float = 1.0) -> list[T]:
    """The results of ``work(core, area)`` for each band, from top to bottom; two are computed at the same time.

    ``core`` has the rows of the data window that are to be computed, ``area`` also those around that decide on them.

    Args:
        weight: how many times as much memory as usual a pixel takes. Bands have fewer rows then.
    """
    window, scale = alignment.hr_data_window, alignment.scale
    halo, rows = -(-max(RADII) // scale) * scale + 2 * scale, _band_rows(window, weight)
    bands = []
    for top in range(alignment.grid.y0 * scale, alignment.grid.y1 * scale, rows):
        core = Window(window.x0, max(top, window.y0), window.x1, min(top + rows, window.y1))
        area = Window(core.x0, max(top - halo, window.y0), core.x1, min(top + rows + halo, window.y1))
        bands.append((core, area))
    return two_at_a_time(lambda band: work(*band), bands)


def _band_rows(window: Window, weight: float) -> int:
    pairs = -(-window.width * window.height // BAND_PIXELS)
    rows = -(-window.height // max(2 * pairs, 1))
    if weight > 1:
        rows = int((rows + 2 * max(RADII)) / weight) - 2 * max(RADII)
    return -(-max(rows, BAND_ROWS) // ROW_MULTIPLE) * ROW_MULTIPLE


def rows_in_bands(window: Window, weight: float = 1.0) -> int:
    """The most rows of the areas of :func:`for_bands` that are worked on at the same time, in this data window."""
    halos = 4 * max(RADII)
    return min(window.height + halos, 2 * (_band_rows(window, weight) + halos))


def grid_rows(alignment: Alignment, area: Window) -> slice:
    """The rows of the grid that an area of the data window covers."""
    grid, scale = alignment.grid, alignment.scale
    return slice(area.y0 // scale - grid.y0, -(-area.y1 // scale) - grid.y0)


def to_grid(alignment: Alignment, plane: Array, area: Window) -> Array:
    """A plane (h, w) over ``area`` at the LRHS's resolution, over the width of the grid."""
    whole = _whole_pixels(alignment, area)
    if whole != area:
        plane = mirrored(plane, area, whole)
    return box_downsample(plane, alignment.scale)


def from_grid(alignment: Alignment, plane: Array, area: Window) -> Array:
    """A plane over :func:`grid_rows` of ``area`` at full resolution, (h, w) over ``area``."""
    whole = _whole_pixels(alignment, area)
    return upsample_linear(plane, alignment.scale, slice(0, len(plane)))[area.slices(whole)]


def _whole_pixels(alignment: Alignment, area: Window) -> Window:
    """An area, widened to whole LRHS pixels over the width of the grid."""
    grid, scale = alignment.grid, alignment.scale
    return Window(grid.x0 * scale, area.y0 // scale * scale, grid.x1 * scale, -(-area.y1 // scale) * scale)


class Light:
    """The light of a frame, as both of its renders show it.

    Args:
        alignment: of the frame.
        lrhs, hrls: luminance of both renders (h, w) over the grid.
        picture: luminance (h, w) over the grid by which differences are relative.
    """

    def __init__(self, alignment: Alignment, lrhs: Array, hrls: Array, picture: Array) -> None:
        self._alignment = alignment
        self.darkest = DARKEST * float(picture.mean(dtype=np.float64)) + 1e-30
        """Luminance that is added to the local brightness."""
        self._brightness = mean_around(picture, 1) + np.float32(self.darkest)
        self._renders = lrhs, hrls
        low, high = (render / self._brightness for render in self._renders)
        noise = np.square(np.clip((low - high) / 2, -LARGEST_DIFFERENCE, LARGEST_DIFFERENCE))
        scale = alignment.scale
        #: For each radius in LRHS pixels: the variance of the mean of both renders.
        self._noise = {reach: mean_around(noise, reach) for reach in (max(1, round(r / scale)) for r in RADII)}

    def trust(self, lrhs: Array, hrls: Array, area: Window) -> Array:
        """How much a neighbour counts, from 0 to 1, (h, w) over :func:`grid_rows` of ``area``.

        Args:
            lrhs, hrls: luminance of the neighbour's renders, (h, w) over the same rows. For a fused neighbour, its
                luminance is both.
        """
        rows = grid_rows(self._alignment, area)
        brightness = self._brightness[rows]
        differences = [
            np.clip((render[rows] - other) / brightness, -LARGEST_DIFFERENCE, LARGEST_DIFFERENCE)
            for render, other in zip(self._renders, (lrhs, hrls), strict=True)
        ]
        product = differences[0] * differences[1]
        trust = np.ones_like(product)
        for reach, variance in self._noise.items():
            noise = variance[rows]
            own_error = noise * np.float32(self._alignment.scale**2 / PIXELS_AVERAGED) + np.float32(EQUAL)
            uncertainty = np.float32(DOUBT * 2 / (2 * reach + 1)) * noise
            change = np.maximum(mean_around(product, reach) - uncertainty - own_error, 0)
            np.minimum(trust, own_error / (own_error + change), out=trust)
        return trust


def relative_difference(own: Array, other: Array, darkest: float) -> Array:
    """The difference of two luminances, divided by the root of their product. At least ``darkest`` counts for each."""
    own, other = (np.maximum(each, np.float32(darkest)) for each in (own, other))
    with np.errstate(over="ignore", under="ignore", divide="ignore"):  # the product could overflow, as the ratio may
        ratio = np.sqrt(own / other)
        return np.asarray(ratio - 1 / ratio, np.float32)
