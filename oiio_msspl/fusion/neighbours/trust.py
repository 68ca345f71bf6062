# SPDX-License-Identifier: Apache-2.0
"""Tells whether the light of a frame's neighbour has changed.

Both renders of a frame, `L` and `H`, are compared with those of a neighbour at the LRHS's resolution. They have
independent noise, so the mean of the product of the two differences is the squared change of the light without the
noise of the renders. (Zheng et al. 2021 estimate errors from two independent buffers in the same way.)
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.neighbours.bands import REACH, grid_window
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.filters import grown, max_3x3, means_around, sum_3x3

#: The change is averaged over squares of two sizes, in HRLS pixels to each side. The small one finds the edge of a
#: shadow, the large one a faint change of all the light.
RADII = (14, REACH)
#: The error of a fused frame is as large as the noise of the mean of this many HRLS pixels.
PIXELS_AVERAGED = 80.0
#: How many standard deviations of its own noise are subtracted from an estimated change.
DOUBT = 0.5
#: Differences relative to the local brightness are limited to this, because a firefly says nothing of the light.
LARGEST_DIFFERENCE = 3.0
#: The local brightness is at least this share of the frame's.
DARKEST = 0.02
#: Relative squared difference below which two frames are equal.
EQUAL = 1e-4
#: A lamp shines in one frame alone where the mean of 3 x 3 LRHS pixels is this many times as bright as the brightest of
#: them in the other frame.
LAMP = 3.0

#: Says how much a neighbour counts by its light, as :meth:`Light.judge` does.
Judge = Callable[[Array, Array], Array]


class Light:
    """The light of a frame, as both of its renders show it.

    Args:
        alignment: of the frame.
        lrhs, hrls: luminance of both renders (h, w) over the grid.
        picture: luminance (h, w) over the grid that differences are relative to.
    """

    def __init__(self, alignment: Alignment, lrhs: Array, hrls: Array, picture: Array) -> None:
        self.alignment = alignment
        #: Luminance that is added to the local brightness.
        self.darkest = DARKEST * float(picture.mean(dtype=np.float64)) + 1e-30
        self._brightness = means_around(picture, [1])[0] + np.float32(self.darkest)
        self._renders = lrhs, hrls
        self._least, self._most = _bounds(lrhs, hrls)
        low, high = (render / self._brightness for render in self._renders)
        noise = np.square(np.clip((low - high) / 2, -LARGEST_DIFFERENCE, LARGEST_DIFFERENCE))
        reaches = [max(1, round(radius / alignment.scale)) for radius in RADII]
        #: For each radius in LRHS pixels: the variance of the mean of both renders.
        self._noise = dict(zip(reaches, means_around(noise, reaches), strict=True))

    def judge(self, area: Window) -> Judge:
        """Return the function that judges the neighbours on one side, from the nearest to the farthest.

        It takes the luminance of a neighbour's LRHS and HRLS (h, w) over the grid pixels of ``area``; for a fused
        neighbour, its luminance is both. It returns how much the neighbour counts (h, w), from 0 to 1, and never more
        than a nearer one: a light that has changed there has changed in the farther one.
        """
        trust: Array | np.float32 = np.float32(1)
        rows, _ = grid_window(self.alignment, area).slices(self.alignment.grid)

        def judge(lrhs: Array, hrls: Array) -> Array:
            nonlocal trust
            trust = np.minimum(trust, self._trust(lrhs, hrls, rows))
            return trust

        return judge

    def _trust(self, lrhs: Array, hrls: Array, rows: slice) -> Array:
        """Return how much one neighbour counts, over some rows of the grid."""
        brightness = self._brightness[rows]
        product = np.ones_like(brightness)
        for own, render in zip(self._renders, (lrhs, hrls), strict=True):
            product *= np.clip((own[rows] - render) / brightness, -LARGEST_DIFFERENCE, LARGEST_DIFFERENCE)
        trust = np.ones_like(product)
        for (reach, variance), mean in zip(self._noise.items(), means_around(product, list(self._noise)), strict=True):
            noise = variance[rows]
            own_error = noise * np.float32(self.alignment.scale**2 / PIXELS_AVERAGED) + np.float32(EQUAL)
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
    """Return the mean of 3 x 3 pixels (h, w) in the darker render, and their brightest pixel in either render."""
    # A firefly is in one render alone. A lamp, however small, is bright in both. Means over many pixels do not notice
    # it, and a thousandth of its light is seen on a dark wall.
    least = np.minimum(*(sum_3x3(render) for render in (lrhs, hrls))) * np.float32(1 / 9)
    return least, max_3x3(np.maximum(lrhs, hrls))


def likeness(own: Array, other: Array, darkest: float, half: float, *, steep: bool = False) -> Array:
    """Return how much pixels of two luminances count for each other: 1 if equal, 0.5 at a difference of ``half``."""
    with np.errstate(over="ignore"):
        squares = np.square(relative_difference(own, other, darkest) / np.float32(half))
        return np.asarray(1 / (1 + (np.square(squares) if steep else squares)), np.float32)


def relative_difference(own: Array, other: Array, darkest: float) -> Array:
    """Return the difference of two luminances of at least ``darkest``, divided by the root of their product."""
    own, other = (np.maximum(values, np.float32(darkest)) for values in (own, other))
    with np.errstate(over="ignore", under="ignore", divide="ignore"):  # the product could overflow, as the ratio may
        ratio = np.sqrt(own / other)
        return np.asarray(ratio - 1 / ratio, np.float32)
