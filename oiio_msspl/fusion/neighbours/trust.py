# SPDX-License-Identifier: Apache-2.0
"""Has the light of a frame's neighbour changed?

Both renders of a frame, `L` and `H`, are compared with those of a neighbour at the LRHS's resolution. They have
independent noise, so the mean of the product of the two differences is the squared change of the light without the
noise of the renders. (Zheng et al. 2021 estimate errors from two independent buffers in the same way.)
"""

from __future__ import annotations

import numpy as np

from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.neighbours.bands import REACH, grid_rows
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.filters import grown, max_3x3, means_around, sum_3x3

#: The change is averaged over squares of two sizes, in HRLS pixels to each side. The small one finds the edge of a
#: shadow, the large one a faint change of all the light.
RADII = (14, REACH)
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
#: A lamp shines in one frame alone where the mean of 3 x 3 LRHS pixels is so many times as bright as the brightest of
#: them in the other frame.
LAMP = 3.0


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
        self._brightness = means_around(picture, [1])[0] + np.float32(self.darkest)
        self._renders = lrhs, hrls
        self._least, self._most = _bounds(lrhs, hrls)
        low, high = (render / self._brightness for render in self._renders)
        noise = np.square(np.clip((low - high) / 2, -LARGEST_DIFFERENCE, LARGEST_DIFFERENCE))
        scale = alignment.scale
        #: For each radius in LRHS pixels: the variance of the mean of both renders.
        reaches = [max(1, round(r / scale)) for r in RADII]
        self._noise = dict(zip(reaches, means_around(noise, reaches), strict=True))

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
        for (reach, variance), mean in zip(self._noise.items(), means_around(product, list(self._noise)), strict=True):
            noise = variance[rows]
            own_error = noise * np.float32(self._alignment.scale**2 / PIXELS_AVERAGED) + np.float32(EQUAL)
            uncertainty = np.float32(DOUBT * 2 / (2 * reach + 1)) * noise
            change = np.maximum(mean - uncertainty - own_error, 0)
            np.minimum(trust, own_error / (own_error + change), out=trust)
        least, most = _bounds(lrhs, hrls)
        lamps = self._least[rows] > np.float32(LAMP) * (most + np.float32(self.darkest))
        lamps |= least > np.float32(LAMP) * (self._most[rows] + np.float32(self.darkest))
        if lamps.any():
            # Weights are interpolated between LRHS pixels, so those beside a lamp are 0, too.
            trust[grown(lamps)] = 0
        return trust


def _bounds(lrhs: Array, hrls: Array) -> tuple[Array, Array]:
    """How bright each 3 x 3 pixels (h, w) are at least, on average, and their brightest pixel at most.

    A firefly is in one render alone. What is bright in both is a lamp, however small it is. Means over many pixels do
    not notice it, and a thousandth of its light is seen on a dark wall.
    """
    least = np.minimum(*(sum_3x3(render) for render in (lrhs, hrls))) * np.float32(1 / 9)
    return least, max_3x3(np.maximum(lrhs, hrls))


def relative_difference(own: Array, other: Array, darkest: float) -> Array:
    """The difference of two luminances, divided by the root of their product. At least ``darkest`` counts for each."""
    own, other = (np.maximum(each, np.float32(darkest)) for each in (own, other))
    with np.errstate(over="ignore", under="ignore", divide="ignore"):  # the product could overflow, as the ratio may
        ratio = np.sqrt(own / other)
        return np.asarray(ratio - 1 / ratio, np.float32)
