# SPDX-License-Identifier: Apache-2.0
"""Fuses pairs whose pixel filter has spread each sample over several pixels.

The noise of neighbouring pixels is then alike, and networks that learnt from independent pixels take it for detail. But
pixels two apart share little. So a tile is split into four pictures, each with every second pixel of every second row.
The network fuses each of them, and the results are put together again. The four differ a little, which shows as a fine
grid; a filter over 3 x 3 pixels removes it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from oiio_msspl.arrays import Array
from oiio_msspl.fusion.tile_features import TilePair
from oiio_msspl.parallel import for_row_blocks

#: Pixels of one picture are this far apart.
STRIDE = 2
#: Log-encoded pixels that differ by this much count 0.6 times as much in the filter that removes the grid.
SIMILAR = 0.07

#: Rows and columns of a tile.
Place = tuple[slice, slice]


def split(pair: TilePair) -> Iterator[tuple[Place, TilePair]]:
    """Split a tile into pictures of every second HRLS pixel, and an LRHS of half the size for each.

    The LRHS is interpolated at the mean position of the HRLS pixels that it belongs to.

    Args:
        pair: a tile of an even number of LRHS rows and columns.

    Yields:
        The place of the picture's pixels in the tile, and the picture. Its windows are those of the whole tile.
    """
    inside = tuple(slice(side.start // STRIDE, -(-side.stop // STRIDE)) for side in pair.inside)
    for y, x in itertools.product(range(STRIDE), repeat=2):
        place = (slice(y, None, STRIDE), slice(x, None, STRIDE))
        # Where the s HRLS pixels of a new LRHS pixel are, between two LRHS pixels: 0 is the first, 1 is the second.
        down, right = (np.float32(0.5 + (offset - 0.5) / pair.scale) for offset in (y, x))
        yield (
            place,
            replace(
                pair,
                lrhs={name: _between(_between(values, down, 0), right, 1) for name, values in pair.lrhs.items()},
                hrls={name: values[place] for name, values in pair.hrls.items()},
                inside=(inside[0], inside[1]),
            ),
        )


def _between(values: Array, position: np.float32, axis: int) -> Array:
    """A value for each two pixels along an axis."""
    lines = values.swapaxes(0, axis)
    mixed: Array = lines[::STRIDE] * (1 - position) + lines[1::STRIDE] * position
    return mixed.swapaxes(0, axis)


def join(pictures: Iterable[tuple[Place, Array]], size: tuple[int, int]) -> Array:
    """Put pictures (h, w, c) together again: the inverse of :func:`split`.

    Args:
        pictures: each with its place in the tile; or a single one that is the whole tile.
        size: height and width of the tile.
    """
    result: Array | None = None
    for place, picture in pictures:
        if picture.shape[:2] == size:
            return picture
        if result is None:
            result = np.empty((*size, picture.shape[2]), np.float32)
        result[place] = picture
    assert result is not None
    return result


def without_grid(encoded: Array) -> Array:
    """Remove the differences between the four pictures from their log-encoded result (h, w, 3).

    A binomial filter over 3 x 3 pixels gives each of the four pictures the same weight, so it removes all of a grid. It
    is a bilateral filter (Tomasi and Manduchi 1998), so edges stay: a pixel counts less the more it differs.
    """
    padded = np.pad(encoded, ((1, 1), (1, 1), (0, 0)), mode="symmetric")
    result = np.empty_like(encoded, order="C")
    width = encoded.shape[1]

    def work(rows: slice) -> None:
        centre = encoded[rows]
        height = len(centre)
        total, weights = np.zeros_like(centre, order="C"), np.zeros((height, width, 1), np.float32)
        for y, x in itertools.product(range(3), repeat=2):
            neighbour = padded[rows.start + y : rows.start + y + height, x : x + width]
            squared = np.square(neighbour - centre).mean(axis=-1, keepdims=True)
            weight = np.exp(squared * np.float32(-0.5 / SIMILAR**2))
            weight *= (1, 2, 1)[y] * (1, 2, 1)[x]
            total += weight * neighbour
            weights += weight
        np.divide(total, weights, out=result[rows])

    for_row_blocks(work, len(encoded), encoded[0].size)
    return result
