# SPDX-License-Identifier: Apache-2.0
"""Gathers, tile by tile, what the checks of a pair compare: the HRLS at the LRHS's resolution."""

from __future__ import annotations

import itertools
from collections import defaultdict
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.checks.framing import AREA, central_slices
from oiio_msspl.fusion.checks.same_noise import MIDDLE, noise_variance
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.fusion.tiles.features import TileFeatures, in_hrls_pixels
from oiio_msspl.image.arrays import Array, planes_of
from oiio_msspl.image.colour import luminance
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.image.parallel import for_row_blocks
from oiio_msspl.model.contract import ONE_SIZE

#: Brighter pixels are clipped to this, because sums of squares over a frame would overflow float32.
BRIGHTEST = np.float32(1e15)
#: Side of the blocks, in LRHS pixels, over which noise and colours are summed.
BLOCK = 4
#: A pixel has noise if its RMS is this fraction of its brightness.
NOISY = 0.05
#: Name of the noise in :attr:`HrlsAverages.aovs`.
NOISE = "noise"


class HrlsAverages:
    """The HRLS at the LRHS's resolution, and its difference to the LRHS; filled tile by tile.

    Attributes:
        rgb: luminance (h, w) over the grid of the alignment.
        aovs: those that the HRLS has, over the central area of the grid, where edges are compared. Luminance of the
            albedo; length of the difference of the normals to the next pixels; and as ``NOISE``, the root mean square
            of that difference if the normals were constant, by their noise.
        quarters: luminance of quarters of LRHS pixels over the middle of the grid, see
            :mod:`oiio_msspl.fusion.checks.same_noise`; of whole pixels if both renders have one size.
        failed: LRHS pixels (h, w) in buckets that failed, of the LRHS and of the HRLS.
        blocks: sums over blocks of `BLOCK` pixels, (rows, columns, 8): the LRHS's RGB, the HRLS's RGB, and the numbers
            of LRHS pixels over which the HRLS is noisy, and of those among them that equal an HRLS pixel, less those
            whose neighbour does: colours repeat where coverage is all that varies.
        is_lost: the HRLS's beauty is NaN in all tiles, so its averages are those of the LRHS.
    """

    def __init__(self, alignment: Alignment) -> None:
        self.alignment = alignment
        grid = alignment.grid
        self.rgb = np.zeros((grid.height, grid.width), np.float32)
        self._centre, self._middle = (
            Window(columns.start, rows.start, columns.stop, rows.stop).shift(grid.x0, grid.y0)
            for rows, columns in (central_slices(self.rgb.shape, side) for side in (AREA, MIDDLE))
        )
        size = self._centre.height, self._centre.width
        self.aovs = defaultdict[str, Array](lambda: np.zeros(size, np.float32))
        self._cosines = np.zeros(2)  # sums of products of the normals, and of their lengths
        self._parts = 1 if alignment.scale == ONE_SIZE else 2
        self.quarters = np.zeros((self._parts * self._middle.height, self._parts * self._middle.width), np.float32)
        self.failed = tuple(np.zeros(self.rgb.shape, np.bool_) for _ in range(2))
        self.blocks = np.zeros((-(-self.rgb.shape[0] // BLOCK), -(-self.rgb.shape[1] // BLOCK), 8))
        self.is_lost = True

    def add(self, pair: TileFeatures) -> None:
        """Add the core of a tile."""
        self.is_lost &= pair.hrls_is_lost
        core, grid = pair.core, self.alignment.grid
        inside = core.slices(pair.lrhs_area)
        self._add_beauty(pair.lrhs[RGB][inside], _hrls_pixels(pair, RGB, core), core.shift(-grid.x0, -grid.y0))
        for failed, new in zip(self.failed, pair.failed or (), strict=False):
            failed[core.slices(grid)] = new[inside]
        middle = core.intersect(self._middle)
        if middle.width and middle.height:
            pixels = np.minimum(_hrls_pixels(pair, RGB, middle), BRIGHTEST)
            target = in_hrls_pixels(middle, self._parts).slices(in_hrls_pixels(self._middle, self._parts))
            self.quarters[target] = luminance(box_downsample(pixels, pair.scale // self._parts))
        centre = core.intersect(self._centre)
        if centre.width and centre.height:
            self._add_aovs(pair, centre)

    def _add_aovs(self, pair: TileFeatures, window: Window) -> None:
        """Fill ``aovs`` over a part of the central area."""
        target = window.slices(self._centre)
        if ALBEDO in pair.hrls:
            self.aovs[ALBEDO][target] = luminance(box_downsample(_hrls_pixels(pair, ALBEDO, window), pair.scale))
        if NORMAL in pair.hrls:
            pixels = _hrls_pixels(pair, NORMAL, window)
            # Means over scale x scale pixels, in two differences of two of them each.
            variance = reduce(np.add, planes_of(noise_variance(pixels, pair.scale)))
            self.aovs[NOISE][target] = np.sqrt(variance) * np.float32(2 / pair.scale)
            mean = box_downsample(pixels, pair.scale)
            self.aovs[NORMAL][target] = _edge_lengths(mean)
            if NORMAL in pair.lrhs and pair.lrhs is not pair.hrls:
                low = pair.lrhs[NORMAL][window.slices(pair.lrhs_area)]
                lengths = np.linalg.norm(low, axis=-1) * np.linalg.norm(mean, axis=-1)
                self._cosines += np.sum(low * mean), np.sum(lengths)

    @property
    def normals_agree(self) -> float | None:
        """The mean cosine between the normals of both renders over the central area; None if one of them has none."""
        product, lengths = self._cosines
        return float(product / lengths) if lengths > 0 else None

    def _add_beauty(self, low: Array, high: Array, place: Window) -> None:
        """Fill ``rgb`` and sum ``blocks``, given the colours (h, w, 3) and (s*h, s*w, 3) of a ``place`` in the grid."""
        scale = self.alignment.scale
        phases = list(itertools.product(range(scale), repeat=2))
        averages = self.rgb[place.y0 : place.y1, place.x0 : place.x1]
        values = np.empty((8, *low.shape[:2]), np.float32)

        def work(rows: slice) -> None:
            colour = np.minimum(low[rows], BRIGHTEST)
            samples = np.minimum(high[rows.start * scale : rows.stop * scale], BRIGHTEST)
            mean = box_downsample(samples, scale)
            averages[rows] = luminance(mean)
            pixels, grey = luminance(samples), luminance(colour)
            expected = noise_variance(pixels, scale) / np.float32(scale**2)
            # Black pixels are equal in any two renders where light is rare.
            noisy = (grey > 0) & (expected > np.square(np.float32(NOISY) * grey))
            equal, by_chance = (
                reduce(np.minimum, (np.abs(pixels[i::scale, j::scale] - value) for i, j in phases)) < 1e-3 * value
                for value in (grey, np.roll(grey, 1, axis=1))
            )
            values[:3, rows], values[3:6, rows] = planes_of(colour), planes_of(mean)
            values[6, rows], values[7, rows] = noisy, noisy * (equal * np.float32(1) - by_chance)

        for_row_blocks(work, len(low), high[0].size * scale)
        sums: NDArray[Any] = values
        for axis, (start, stop) in ((1, (place.y0, place.y1)), (2, (place.x0, place.x1))):
            first = np.maximum(np.arange(start // BLOCK * BLOCK, stop, BLOCK) - start, 0)
            sums = np.add.reduceat(sums, first, axis).astype(np.float64)
        top, left = place.y0 // BLOCK, place.x0 // BLOCK
        self.blocks[top : top + sums.shape[1], left : left + sums.shape[2]] += sums.transpose(1, 2, 0)


def _edge_lengths(normal: Array) -> Array:
    """Return the length (h, w) of the difference of normals (h, w, 3) to the next pixels, to the right and down."""
    squares = np.zeros(normal.shape[:2], np.float32)
    for plane in planes_of(normal):
        squares[:-1] += np.square(np.diff(plane, axis=0))
        squares[:, :-1] += np.square(np.diff(plane, axis=1))
    return np.sqrt(squares)


def _hrls_pixels(pair: TileFeatures, feature: str, window: Window) -> Array:
    """Return a feature of the HRLS over a window of LRHS pixels inside the tile."""
    return pair.hrls[feature][in_hrls_pixels(window, pair.scale).slices(pair.hrls_area)]


def bounded_luminance(rgb: Array) -> Array:
    """Return the luminance of repaired colours, at most `BRIGHTEST`: (..., 3) to (...)."""
    return np.minimum(luminance(rgb), BRIGHTEST)
