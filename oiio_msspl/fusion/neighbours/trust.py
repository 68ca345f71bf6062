# SPDX-License-Identifier: Apache-2.0
"""Tells whether the light of a frame's neighbour has changed.

Both renders of a frame, `L` and `H`, are compared with those of a neighbour at the LRHS's resolution, in each colour.
They have independent noise, so the mean of the product of the two differences is the squared change of the light
without the noise of the renders. (Zheng et al. 2021 estimate errors from two independent buffers in the same way.) The
noise of this mean is known from `L - H`. Where the mean is larger than chance allows, the light has changed.

The larger the area, the smaller a change that is certain: 20 percent in a few pixels, 1 percent in a whole frame. So
the differences are averaged to cells of half the resolution, again and again, and each resolution is judged. What is
certain of a small square counts more than what the large ones around it say.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.neighbours.bands import grid_window
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.image.arrays import Array, Mask
from oiio_msspl.image.colour import luminance
from oiio_msspl.image.filters import halved, max_around, means_around, sum_3x3, upsample_linear

#: Side of the smallest cells that are judged, in HRLS pixels, unless LRHS pixels are larger; and side of those from
#: which the light of the whole frame is judged, and not of bands of rows.
CELL, WHOLE = 4, 8
#: Products are averaged over the cells up to these numbers of rows and columns away: the large square finds a faint
#: change, the small one the edge of a change.
REACHES = (3, 1)
#: The noise is averaged over the pixels up to this number of rows and columns away.
NOISE_REACH = 3
#: The error of a fused frame is as large as the noise of the mean of this many HRLS pixels.
PIXELS_AVERAGED = 80.0
#: A change is certain from this many standard deviations of the mean of products on. From the second number on, a small
#: square contradicts what the large ones around it say.
CERTAIN, CONTRADICTED = 2.0, 4.0
#: A neighbour counts half where the light's squared change is this many times the squared error that the frame's result
#: has anyway. A smaller change adds less error than the neighbour takes away; a larger one is seen.
TOLERATED = 2.5
#: Before differences are averaged to larger cells, they are limited to this many standard deviations of one of them: a
#: highlight that moves says nothing of the surface around it.
MOST_SAID = np.float32(3.0)
#: Differences relative to the local brightness are limited to this, because a firefly says nothing of the light.
LARGEST_DIFFERENCE = 3.0
#: The local brightness is at least this share of the frame's.
DARKEST = 0.02
#: Relative squared difference below which two frames are equal.
EQUAL = 1e-4
#: Variance of the noise of an HRLS pixel, relative to the light, up to which a neighbour that has moved does not count,
#: and from which on it counts fully: 400 and 250 spp. In clean frames it could only blur.
CLEAN, NOISY = 1 / 400, 1 / 250
#: A lamp shines in one frame alone where the mean of 3 x 3 LRHS pixels is this many times as bright as the brightest of
#: them in the other frame.
LAMP = 3.0

#: Says how much a neighbour counts by its light, as :meth:`Light.judge` does.
Judge = Callable[..., Array]


class _Own(NamedTuple):
    """A frame's own cells of one size."""

    brightness: Array
    """(h, w, 3): local brightness."""
    noise: Array
    """(h, w): variance of the mean of both renders, relative to the brightness."""
    compared: Array
    other: Array
    """What neighbours are compared with, see :meth:`Light._compared`."""

    def halved(self) -> _Own:
        """Return cells of twice the size."""
        own = _Own(*map(halved, self))
        return own._replace(noise=own.noise * np.float32(1 / 4))


class Light(ABC):
    """The light of a frame over the alignment's grid.

    Args:
        alignment: of the frame.
        lrhs, hrls: both renders (h, w, c) over the grid.
        picture: colours (h, w, 3) over the grid that differences are relative to.
    """

    def __init__(self, alignment: Alignment, lrhs: Array, hrls: Array, picture: Array) -> None:
        self.alignment = alignment
        #: Luminance that is added to the local brightness.
        self.darkest = DARKEST * float(luminance(picture).mean(dtype=np.float64)) + 1e-30
        brightness = sum_3x3(picture) * np.float32(1 / 9) + np.float32(self.darkest)
        bright = brightness if lrhs.shape[-1] == brightness.shape[-1] else luminance(brightness)[..., None]
        self._cell = max(CELL, alignment.scale)
        noise = _noise(*(self._cells(image) for image in (lrhs, hrls, bright)))
        brightness = self._cells(brightness)
        self._own = _Own(brightness, noise, *self._compared(lrhs, hrls, picture, brightness))
        self._coarse = self._own if self._cell == WHOLE else self._own.halved()
        self.noise = float(np.median(noise)) * (self._cell // alignment.scale) ** 2
        """Variance of the mean of both renders in an LRHS pixel, relative to the light: the median of all."""
        hrls_noise = 2 * self.noise * alignment.scale**2
        self.moved_weight = np.float32(np.clip((hrls_noise - CLEAN) / (NOISY - CLEAN), 0, 1))
        """How much a neighbour that has moved counts, from 0 to 1."""
        self.shape = self._coarse.noise.shape
        """Rows and columns of cells of ``WHOLE`` HRLS pixels."""
        lights = (image[..., 0] if image.shape[-1] == 1 else luminance(image) for image in (lrhs, hrls))
        self._least, self._most = _bounds(*lights)

    def _cells(self, image: Array) -> Array:
        return cells(image, self.alignment.scale, CELL)

    @abstractmethod
    def _compared(self, lrhs: Array, hrls: Array, picture: Array, brightness: Array) -> tuple[Array, Array]:
        """Return the cells of a frame that those of neighbours are compared with, for :class:`_Own`."""

    @abstractmethod
    def _compare(self, neighbour: Sequence[Array], own: _Own, share: float) -> _Cells:
        """Compare a neighbour's cells (h, w, 3) with the frame's. The ``share`` is for :class:`_Cells`."""

    def judge(self, area: Window, coarse: Sequence[Array]) -> Judge:
        """Return the function that judges the neighbours on one side, from the nearest to the farthest.

        It takes the colours of a neighbour (h, w, 3) over the grid pixels of ``area``: of its LRHS and its HRLS, or of
        its fused picture. It returns how much the neighbour counts (h, w), from 0 to 1, and never more than a nearer
        one: a light that has changed there has changed in the farther one.

        Args:
            area: rows of the frame, see :func:`oiio_msspl.fusion.neighbours.bands.for_bands`.
            coarse: :meth:`coarse_trust` of each neighbour.
        """
        least: Array | np.float32 = np.float32(1)
        rows, _ = grid_window(self.alignment, area).slices(self.alignment.grid)
        maps = iter(coarse)

        def judge(*neighbour: Array) -> Array:
            nonlocal least
            least = np.minimum(least, self._trust(neighbour, next(maps), rows))
            return least

        return judge

    def _trust(self, neighbour: Sequence[Array], coarse: Array, rows: slice) -> Array:
        """Return how much one neighbour counts (h, w), over some rows of the grid."""
        height, width = neighbour[0].shape[:2]
        factor = self._cell // self.alignment.scale
        own = _Own(*(plane[rows.start // factor : -(-rows.stop // factor)] for plane in self._own))
        compared = self._compare([self._cells(image) for image in neighbour], own, self._cell**2 / PIXELS_AVERAGED)
        first = rows.start * self.alignment.scale // WHOLE
        trust = compared.trust(WHOLE // self._cell - 1, coarse[first:])
        if factor > 1:
            trust = upsample_linear(trust, factor)[:height, :width]
        lights = [luminance(image) for image in neighbour]
        least, most = _bounds(lights[0], lights[-1])
        lamps = self._least[rows] > np.float32(LAMP) * (most + np.float32(self.darkest))
        lamps |= least > np.float32(LAMP) * (self._most[rows] + np.float32(self.darkest))
        if lamps.any():
            # Weights are interpolated between LRHS pixels, so those beside a lamp are 0, too.
            trust[max_around(lamps)] = 0
        return trust

    def coarse_trust(self, neighbour: Sequence[Array], valid: Mask) -> Array:
        """Return how much a neighbour counts, 0 to 1, judged by cells of twice ``WHOLE`` pixels and by larger ones.

        Args:
            neighbour: its colours (h, w, 3) at the places of the cells of the whole frame.
            valid: where it shows the same surface (h, w).

        Returns:
            (h, w) over cells of ``WHOLE`` pixels.
        """
        compared = self._compare(neighbour, self._coarse, WHOLE**2 / PIXELS_AVERAGED)
        shown = replace(compared, low=compared.low * valid[..., None], high=compared.high * valid[..., None])
        return upsample_linear(shown.halved().trust(), 2)


class RenderLight(Light):
    """The light of a frame whose renders are averaged: ``lrhs`` has colours (h, w, 3), and is the ``picture``, too."""

    def _compared(self, lrhs: Array, hrls: Array, picture: Array, brightness: Array) -> tuple[Array, Array]:
        return self._cells(lrhs), self._cells(hrls)

    def _compare(self, neighbour: Sequence[Array], own: _Own, share: float) -> _Cells:
        low, high = (_limited((mine - other) / own.brightness) for mine, other in zip(own[2:], neighbour, strict=True))
        others: Array = _noise(neighbour[0], neighbour[1], own.brightness)
        return _Cells(low, high, 2 * (own.noise + others), own.noise, share)


class ResultLight(Light):
    """The light of a frame whose fused picture `F` is averaged. The renders have one channel, their luminance.

    A fused neighbour `W` is compared with it, because both lack the same detail. The frame's renders are the referees:
    (W - L) (W - H) - (F - L) (F - H) is by how much the squared error of `W` exceeds that of `F`.
    """

    def _compared(self, lrhs: Array, hrls: Array, picture: Array, brightness: Array) -> tuple[Array, Array]:
        doubt = self._cells(2 * luminance(picture) - lrhs[..., 0] - hrls[..., 0]) / luminance(brightness)
        return self._cells(picture), _limited(doubt)[..., None]  # F, and 2 F - L - H relative to the brightness

    def _compare(self, neighbour: Sequence[Array], own: _Own, share: float) -> _Cells:
        low = _limited((neighbour[0] - own.compared) / own.brightness)
        deviation = np.float32(2 * np.sqrt(2 * min(share, 1))) * own.noise
        return _Cells(low, low + own.other, deviation, own.noise, share)


@dataclass(frozen=True)
class _Cells:
    """What cells say of a neighbour."""

    low: Array
    high: Array
    """Two differences to the neighbour (h, w, 3) whose noise is independent."""
    deviation: Array
    """Standard deviation (h, w) of their product."""
    noise: Array
    """Variance (h, w) of the mean of the frame's two renders."""
    share: float
    """Cells over which a fused frame averages this noise: 1 / their number."""

    def halved(self) -> _Cells:
        """Return cells of twice the size."""
        most, quarter = MOST_SAID * np.sqrt(self.deviation)[..., None], np.float32(1 / 4)
        low, high = (halved(np.clip(difference, -most, most)) for difference in (self.low, self.high))
        deviation, noise = (halved(plane) * quarter for plane in (self.deviation, self.noise))
        return _Cells(low, high, deviation, noise, self.share * 4)

    def trust(self, steps: int = 99, coarse: Array | None = None) -> Array:
        """Return how much the neighbour counts (h, w), judged by these cells and by larger ones.

        Args:
            steps: how often cells are halved.
            coarse: what even larger cells say, (h, w) or more rows.
        """
        if steps and min(self.noise.shape) > 1:
            coarse = upsample_linear(self.halved().trust(steps - 1, coarse), 2)
        height, width = self.noise.shape
        trust = np.ones_like(self.noise) if coarse is None else coarse[:height, :width]
        own_error = self.noise * np.float32(min(self.share, 1)) + np.float32(EQUAL)
        products = (self.low * self.high).mean(axis=-1)
        for reach in REACHES:
            mean = means_around(products, reach)
            one = self.deviation / np.float32(2 * reach + 1)
            least, most = (
                1 / (1 + np.square(np.square(np.maximum(change, 0) / (np.float32(TOLERATED) * own_error))))
                for change in (mean + np.float32(CONTRADICTED) * one, mean - np.float32(CERTAIN) * one)
            )
            trust = np.clip(trust, least, most)
        return trust


def cells(image: Array, scale: int, side: int) -> Array:
    """Average an image over the grid (h, w, ...) to cells of ``side`` HRLS pixels; itself if its pixels are larger."""
    for _ in range(round(np.log2(side / scale))):
        image = halved(image)
    return image


def _noise(lrhs: Array, hrls: Array, brightness: Array) -> Array:
    """Return the variance (h, w) of the mean of both renders (h, w, c), relative to the brightness."""
    squares = np.square(_limited((lrhs - hrls) / (2 * brightness))).mean(axis=-1)
    return means_around(squares, NOISE_REACH)


def _limited(differences: Array) -> Array:
    return np.clip(differences, -LARGEST_DIFFERENCE, LARGEST_DIFFERENCE)


def _bounds(lrhs: Array, hrls: Array) -> tuple[Array, Array]:
    """Return the mean of 3 x 3 pixels (h, w) in the darker render, and their brightest pixel in either render."""
    # A firefly is in one render alone. A lamp, however small, is bright in both. Means over many pixels do not notice
    # it, and a thousandth of its light is seen on a dark wall.
    least = np.minimum(*(sum_3x3(render) for render in (lrhs, hrls))) * np.float32(1 / 9)
    return least, max_around(np.maximum(lrhs, hrls))


def likeness(own: Array, other: Array, darkest: float, half: float, *, steep: bool = False) -> Array:
    """Return how much pixels of two luminances count for each other: 1 if equal, 0.5 at a difference of ``half``.

    The difference is divided by the root of their product. Both count as at least ``darkest``.
    """
    own, other = (np.maximum(values, np.float32(darkest)) for values in (own, other))
    with np.errstate(over="ignore", under="ignore", divide="ignore"):  # the product could overflow, as the ratio may
        ratio = np.sqrt(own / other)
        squares = np.square((ratio - 1 / ratio) / np.float32(half))
        return np.asarray(1 / (1 + (np.square(squares) if steep else squares)), np.float32)
