# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise (OIDN) on every second pixel, for renders whose pixel filter has spread each sample.

The noise of neighbouring pixels is then alike, and OIDN takes it for detail. But pixels two apart share little. So a
picture is split into four, each with every second pixel of every second row, and the four results are put together
again. They differ a little, which shows as a fine grid; a filter over 3 x 3 pixels removes it. No tool that we know of
calls OIDN like this.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

import numpy as np

from oiio_msspl.image.arrays import Array
from oiio_msspl.image.parallel import for_row_blocks

#: Pixels of one picture are this far apart.
STRIDE = 2
#: Log-encoded pixels that differ by this much count 0.6 times as much in the filter that removes the grid.
SIMILAR = 0.07


def places() -> Iterator[tuple[slice, slice]]:
    """The rows and columns of each of the four pictures."""
    for y, x in itertools.product(range(STRIDE), repeat=2):
        yield slice(y, None, STRIDE), slice(x, None, STRIDE)


def on_every_second_pixel(denoise: Callable[..., Array], images: dict[str, Array]) -> Array:
    """Call ``denoise`` with every second pixel of the images (h, w, c), four times; put the results (h, w, 3) together.

    The grid is still in it, see :func:`without_grid`.
    """
    height, width = next(iter(images.values())).shape[:2]
    result = np.empty((height, width, 3), np.float32)
    for place in places():
        result[place] = denoise(**{name: np.ascontiguousarray(image[place]) for name, image in images.items()})
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
