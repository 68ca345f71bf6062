# SPDX-License-Identifier: Apache-2.0
"""Cuts a frame into bands of rows, which bounds memory, and brings planes to the LRHS's resolution and back."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.fusion.tiles.features import in_hrls_pixels, mirrored
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.filters import box_downsample, upsample_linear
from oiio_msspl.image.parallel import two_at_a_time
from oiio_msspl.model.contract import SCALES

T = TypeVar("T")

#: Two bands are worked on at a time. Together they have at most this many pixels, unless a band would have fewer rows
#: than ``BAND_ROWS``: the rows around a band are computed twice.
BAND_PIXELS, BAND_ROWS = 1 << 22, 128
#: The rows of a band, and those around it, are a multiple of every scale.
ROW_MULTIPLE = max(SCALES)
#: Rows and columns around a pixel that decide on it.
REACH = 48


def for_bands(alignment: Alignment, work: Callable[[Window, Window], T], weight: float = 1.0) -> list[T]:
    """Call ``work(core, area)`` for each band, two at a time, and return the results from top to bottom.

    ``core`` has the rows of the data window that are to be computed, ``area`` also the rows around that decide on them.

    Args:
        weight: how many times the usual memory a pixel takes. Bands have fewer rows then.
    """
    window, scale = alignment.hr_data_window, alignment.scale
    rows = _band_rows(window, weight)
    bands = []
    for top in range(alignment.grid.y0 * scale, alignment.grid.y1 * scale, rows):
        core = Window(window.x0, max(top, window.y0), window.x1, min(top + rows, window.y1))
        area = Window(core.x0, max(top - REACH, window.y0), core.x1, min(top + rows + REACH, window.y1))
        bands.append((core, area))
    return two_at_a_time(lambda band: work(*band), bands)


def _band_rows(window: Window, weight: float) -> int:
    pairs = -(-window.width * window.height // BAND_PIXELS)
    rows = int((-(-window.height // max(2 * pairs, 1)) + 2 * REACH) / weight) - 2 * REACH
    return -(-max(rows, BAND_ROWS) // ROW_MULTIPLE) * ROW_MULTIPLE


def rows_in_bands(window: Window, weight: float = 1.0) -> int:
    """Return how many rows of a data window :func:`for_bands` works on at the same time, at most."""
    halos = 4 * REACH
    return min(window.height + halos, 2 * (_band_rows(window, weight) + halos))


def grid_window(alignment: Alignment, area: Window) -> Window:
    """Return the LRHS pixels that cover an area, over the width of the grid."""
    grid, scale = alignment.grid, alignment.scale
    return Window(grid.x0, area.y0 // scale, grid.x1, -(-area.y1 // scale))


def to_grid(alignment: Alignment, plane: Array, area: Window) -> Array:
    """Average a plane (h, w) over ``area`` to the LRHS's resolution, over :func:`grid_window`."""
    whole = in_hrls_pixels(grid_window(alignment, area), alignment.scale)
    if whole != area:
        plane = mirrored(plane, area, whole)
    return box_downsample(plane, alignment.scale)


def whole_grid(alignment: Alignment, pixels: Callable[[Window], Array]) -> Array:
    """Average a frame to the LRHS's resolution, over the grid. ``pixels`` returns those of an area, (h, w, ...)."""
    return np.concatenate(for_bands(alignment, lambda core, _: to_grid(alignment, pixels(core), core)))


def from_grid(alignment: Alignment, plane: Array, area: Window) -> Array:
    """Interpolate a plane over :func:`grid_window` of ``area`` at full resolution, (h, w) over ``area``."""
    whole = in_hrls_pixels(grid_window(alignment, area), alignment.scale)
    return upsample_linear(plane, alignment.scale)[area.slices(whole)]
