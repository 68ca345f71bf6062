# SPDX-License-Identifier: Apache-2.0
"""The features of a tile: read from both renders, repaired, and continued beyond the data window."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import NORMAL
from oiio_msspl.arrays import Array, interpolate, repair
from oiio_msspl.exr.render import ReadableRender, Window
from oiio_msspl.fusion.alignment import Alignment
from oiio_msspl.fusion.tiling import Tile

#: Features that may be negative.
SIGNED_FEATURES = {NORMAL}


@dataclass
class RepairCounts:
    """How many values of a render were changed, by feature."""

    repaired: dict[str, int] = field(default_factory=dict)
    """NaN or infinite."""
    negative: dict[str, int] = field(default_factory=dict)
    """Negative and set to 0: colours out of gamut, in files that are otherwise sound."""

    def add(self, feature: str, values: Array, changed: NDArray[np.bool_]) -> None:
        """Count values; ``changed`` is the mask of :func:`oiio_msspl.arrays.repair`."""
        broken = int(np.count_nonzero(~np.isfinite(values)))
        for counts, count in ((self.repaired, broken), (self.negative, int(np.count_nonzero(changed)) - broken)):
            if count:
                counts[feature] = counts.get(feature, 0) + count


@dataclass
class TilePair:
    """The features of both renders over one tile."""

    lrhs: dict[str, Array]
    """Features (h, w, c) over the tile's area."""
    hrls: dict[str, Array]
    """Features (s*h, s*w, c) over the tile's area."""
    scale: int
    lrhs_area: Window
    """The tile's area in LRHS pixels."""
    hrls_area: Window
    """The tile's area in HRLS pixels."""
    hrls_target: Window
    """The part of the HRLS's data window that the tile contributes."""
    core: tuple[slice, slice]
    """Rows and columns of ``lrhs`` that the tile contributes and that are inside the alignment's grid."""
    inside: tuple[slice, slice]
    """Rows and columns of ``lrhs`` that are inside the alignment's grid. The others only fill up the tile's size."""


def read_tile(
    tile: Tile,
    lrhs: dict[str, Array],
    grid: Window,
    hr: ReadableRender,
    alignment: Alignment,
    features: Iterable[str],
    counts: RepairCounts,
) -> TilePair:
    """Read both renders over a tile.

    Args:
        lrhs: features of the LRHS over ``grid``, see :func:`read_lrhs`.
        features: names of the HRLS's features to read.
        counts: repaired values of the HRLS; those of the tile's core are added.
    """
    scale = alignment.scale
    area, core = _in_hrls_pixels(tile.area, scale), _in_hrls_pixels(tile.core, scale)
    window = tile.area.slices(grid)
    return TilePair(
        lrhs={name: values[window] for name, values in lrhs.items()},
        hrls=read_features(hr, area, alignment.hr_data_window, features, counts=counts, counted=core),
        scale=scale,
        lrhs_area=tile.area,
        hrls_area=area,
        hrls_target=core.intersect(alignment.hr_data_window),
        core=tile.core.intersect(alignment.grid).slices(tile.area),
        inside=tile.area.intersect(alignment.grid).slices(tile.area),
    )


def read_lrhs(
    lr: ReadableRender, alignment: Alignment, grid: Window, features: Iterable[str], counts: RepairCounts
) -> dict[str, Array]:
    """Read features of the LRHS over ``grid``, those that it has. Where an odd size was rounded, they are resampled.

    Args:
        counts: repaired values are added here.
    """
    data = alignment.lr_data_window
    if alignment.stretch == (1.0, 1.0):
        return read_features(lr, grid, data, features, counts=counts, counted=grid)
    layers = read_features(lr, data, data, features, counts=counts, counted=data)
    stretch_x, stretch_y = alignment.stretch
    for axis, first, last, stretch, origin in (
        (0, grid.y0, grid.y1, stretch_y, data.y0),
        (1, grid.x0, grid.x1, stretch_x, data.x0),
    ):
        positions = (np.arange(first, last, dtype=np.float64) + 0.5) * stretch - 0.5 - origin
        layers = {name: interpolate(values, positions, axis) for name, values in layers.items()}
    return layers


def read_features(
    render: ReadableRender,
    window: Window,
    data_window: Window,
    features: Iterable[str] | None = None,
    *,
    counts: RepairCounts | None = None,
    counted: Window | None = None,
) -> dict[str, Array]:
    """Read and repair features over a window. Outside the data window the nearest pixel is repeated.

    Args:
        window, data_window: both relative to the top left of the display window.
        features: names of features; all if None. Those that the render lacks are left out.
        counts: repaired values; those inside ``counted`` are added, because overlaps are read twice.
    """
    rows = np.clip(np.arange(window.y0, window.y1), data_window.y0, data_window.y1 - 1)
    columns = np.clip(np.arange(window.x0, window.x1), data_window.x0, data_window.x1 - 1)
    stored = Window(int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1)
    layers = render.read(stored.shift(render.display_window.x0, render.display_window.y0), features)
    result = {}
    for name, values in layers.items():
        repaired, bad = repair(values, signed=name in SIGNED_FEATURES)
        if bad is not None and counts is not None and counted is not None:
            inside = counted.intersect(stored).slices(stored)
            counts.add(name, values[inside], bad[inside])
        repeated = (rows[:, None] - stored.y0, columns[None, :] - stored.x0)
        result[name] = repaired if stored == window else repaired[repeated]
    return result


def _in_hrls_pixels(window: Window, scale: int) -> Window:
    return Window(window.x0 * scale, window.y0 * scale, window.x1 * scale, window.y1 * scale)
