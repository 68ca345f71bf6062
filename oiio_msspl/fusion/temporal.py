# SPDX-License-Identifier: Apache-2.0
"""Averages a fused frame with its neighbours, warped along the motion of their surfaces, as far as they can be trusted.

Two questions decide how much a pixel of a neighbour counts:

- Does it show the same surface? A vector leads to the neighbour, and the neighbour's own vector must lead back.
- Has the light changed? The warped neighbour is compared with the LRHS and with the HRLS of this frame, at the LRHS's
  resolution. Both have independent noise, and the neighbour has neither's. So the mean of the product of the two
  differences is the neighbour's squared error without the noise of the renders. (Zheng et al. 2021 estimate errors from
  two independent buffers in the same way.)

A pixel that no neighbour may change keeps its bits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.arrays import Array, box_downsample, mean_around, planes_of, upsample_linear
from oiio_msspl.colour import LUMINANCE_WEIGHTS
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.alignment import Alignment
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.fusion.tile_features import mirrored_pixels
from oiio_msspl.parallel import for_row_blocks

Mask = NDArray[np.bool_]

#: A vector and the way back may differ by this, in HRLS pixels.
ROUND_TRIP = 1.0
#: The error of a neighbour is averaged over squares of two sizes, in HRLS pixels to each side. The small one finds the
#: edge of a shadow, the large one a faint change of all the light.
RADII = (14, 28)
#: The error that a fused frame has itself: the variance of the noise of this many HRLS pixels, averaged.
PIXELS_AVERAGED = 80.0
#: Rows of the frame that are averaged at a time, which bounds memory; a multiple of every scale.
BAND_ROWS = 512
#: Memory for each pixel of these rows.
BYTES_PER_PIXEL = 96
#: How many standard deviations of its own noise are subtracted from an estimated error.
DOUBT = 0.5
#: Differences relative to the local brightness are limited to this, because a firefly says nothing of the light.
LARGEST_DIFFERENCE = 3.0
#: The local brightness is at least this share of the frame's.
DARKEST = 0.02
#: Relative squared error below which two frames are equal.
EQUAL = 1e-4
#: Sharpness of the interpolation: the slope of Keys' cubic at the next pixel. Softer ones blur with every frame.
SHARPNESS = -1.0


@dataclass(frozen=True)
class Step:
    """From a frame to the next one, forwards or backwards in time."""

    frame: FusedFrame
    """The frame that it leads to."""
    vectors: Array | None
    """(h, w, 2) over the data window of the frame that it starts from: where the surface of a pixel is, in HRLS pixels
    from there, as (x, y) with y downwards. None: it stays."""
    valid: Mask | None
    """(h, w): which of them can be believed; None if all can."""
    back: Array | None
    """(h, w, 2) over the data window of ``frame``: the way back."""
    back_valid: Mask | None


@dataclass(frozen=True)
class Accumulated:
    """A frame that is averaged with its neighbours."""

    rgb: Array
    """(h, w, 3)"""
    alpha: Array | None
    """(h, w, 1)"""
    frames: Array
    """(h, w, 1): the number of frames with equal weight whose mean would have as little noise: 1 where the frame stands
    alone."""


def accumulate(frame: FusedFrame, before: Sequence[Step], after: Sequence[Step]) -> Accumulated:
    """Average a frame with its neighbours.

    Args:
        frame: the frame.
        before: steps to the frame before it, to the one before that, and so on.
        after: steps to the frames after it, the nearest first.
    """
    window = frame.alignment.hr_data_window
    rgb = np.empty_like(frame.rgb)
    alpha = None if frame.alpha is None else np.empty_like(frame.alpha)
    frames = np.empty((window.height, window.width, 1), np.float32)
    light = _Light(frame)
    for core, area in _bands(frame.alignment):
        total, weights, squares = _accumulate_band(frame, before, after, light, area)
        total /= weights
        inside, target = core.slices(area), core.slices(window)
        rgb[target] = np.moveaxis(total[:3], 0, -1)[inside]
        if alpha is not None:
            alpha[target] = total[3][inside][..., None]
        frames[target] = (np.square(weights) / squares)[inside][..., None]
    return Accumulated(rgb, alpha, frames)


def shared_noise(frame: FusedFrame, other: FusedFrame) -> float:
    """Correlation, from -1 to 1, of the noise of two frames: of what their LRHS and HRLS differ by.

    A renderer that uses one seed for all frames gives each pixel the same noise in all of them. 0 for frames whose
    pixels lie over different places.
    """
    if frame.alignment.grid != other.alignment.grid:
        return 0.0
    noise = []
    for each in (frame, other):
        low, high = each.lrhs_luminance, each.hrls_luminance
        light = low + high
        # The difference relative to the light is at most 1, so fireflies do not decide.
        noise.append(np.divide(low - high, light, out=np.zeros_like(light), where=light > 0).ravel())
    lengths = np.linalg.norm(noise[0]) * np.linalg.norm(noise[1])
    return float(np.dot(*noise) / lengths) if lengths > 0 else 0.0


def memory_to_accumulate(window: Window) -> int:
    """Bytes that :func:`accumulate` needs beside its arguments and its result, for a frame of this data window."""
    return min(window.height, BAND_ROWS + 4 * max(RADII)) * window.width * BYTES_PER_PIXEL


def _bands(alignment: Alignment) -> Iterator[tuple[Window, Window]]:
    """Rows of the data window, and the area around them that decides on them."""
    window, scale = alignment.hr_data_window, alignment.scale
    halo = -(-max(RADII) // scale) * scale + 2 * scale
    for top in range(alignment.grid.y0 * scale, alignment.grid.y1 * scale, BAND_ROWS):
        core = Window(window.x0, max(top, window.y0), window.x1, min(top + BAND_ROWS, window.y1))
        area = Window(core.x0, max(top - halo, window.y0), core.x1, min(top + BAND_ROWS + halo, window.y1))
        yield core, area


def _accumulate_band(
    frame: FusedFrame, before: Sequence[Step], after: Sequence[Step], light: _Light, area: Window
) -> tuple[Array, Array, Array]:
    """The weighted sum of colour and alpha (3 or 4, h, w), the weights (h, w), and their squares."""
    window = frame.alignment.hr_data_window
    total = _channels(frame, area)
    weights = np.ones(total.shape[1:], np.float32)
    squares = np.ones_like(weights)
    own = light.luminance_of(total)
    for steps in (before, after):
        path = _Path(area, window)
        trusted: Array | None = None
        for step in steps:
            path.follow(step)
            warped = _warp(step.frame, path)
            weight = light.trust(np.where(path.valid, light.luminance_of(warped), own), area)
            # A light that has changed in the nearer frame has changed in the farther one.
            trusted = weight if trusted is None else np.minimum(trusted, weight)
            if len(warped) < len(total):  # the neighbour has no alpha
                warped = np.concatenate([warped, _channels(frame, area)[3:]])
            _add(total, weights, squares, warped, trusted * path.valid)
    return total, weights, squares


class _Path:
    """Where the surfaces of a frame are in another one, followed from frame to frame."""

    def __init__(self, area: Window, window: Window) -> None:
        """``area``: the pixels that are followed, in a frame whose data window is ``window``."""
        self._area, self._area_window = area, window
        #: Positions (h, w) in pixels, and None for "at the pixel itself".
        self.x: Array | None = None
        self.y: Array | None = None
        self.valid: Mask = np.ones((area.height, area.width), bool)
        self._last = window

    def follow(self, step: Step) -> None:
        """Go on to the next frame."""
        start, end = self._last, step.frame.alignment.hr_data_window
        valid = self.valid.copy()
        moves = step.vectors is not None
        # A complex number is gathered in half the time of two real ones.
        vectors, back = (None if v is None else _as_complex(v) for v in (step.vectors, step.back))
        x, y = (np.empty(valid.shape, np.float32) for _ in range(2)) if moves or start != end else (self.x, self.y)

        first = self.x is None and start == self._area_window

        def work(rows: slice) -> None:
            from_x, from_y = self.positions(rows)
            to_x, to_y = from_x, from_y
            good = valid[rows]
            at = None if first else _nearest(from_x, from_y, start)
            if step.valid is not None:
                good &= self._at_pixels(step.valid, rows) if at is None else step.valid.reshape(-1).take(at)
            if vectors is not None:
                vector = self._at_pixels(vectors, rows) if at is None else vectors.reshape(-1).take(at)
                good &= np.isfinite(vector)
                to_x = np.where(good, from_x + vector.real, from_x)
                to_y = np.where(good, from_y + vector.imag, from_y)
            good &= (to_x > end.x0 - 0.5) & (to_x < end.x1 - 0.5) & (to_y > end.y0 - 0.5) & (to_y < end.y1 - 0.5)
            if (vectors is not None and back is not None) or step.back_valid is not None:
                there = _nearest(to_x, to_y, end)
                if vectors is not None and back is not None:
                    home = vector + back.reshape(-1).take(there)
                    good &= np.square(home.real) + np.square(home.imag) < ROUND_TRIP**2  # false for NaN, too
                if step.back_valid is not None:
                    good &= step.back_valid.reshape(-1).take(there)
            if x is not None and y is not None and (moves or start != end):
                x[rows], y[rows] = to_x, to_y

        for_row_blocks(work, len(valid), valid.shape[1])
        self.x, self.y, self.valid, self._last = x, y, valid, end

    def _at_pixels(self, values: NDArray[Any], rows: slice) -> NDArray[Any]:
        """Values over the data window, at these rows of the area."""
        area, window = self._area, self._area_window
        part = Window(area.x0, area.y0 + rows.start, area.x1, area.y0 + min(rows.stop, area.height))
        return np.asarray(values[part.slices(window)])

    def positions(self, rows: slice) -> tuple[Array, Array]:
        """Positions of some rows, (n, w) each."""
        if self.x is not None and self.y is not None:
            return self.x[rows], self.y[rows]
        area = self._area
        x = np.arange(area.x0, area.x1, dtype=np.float32)
        y = np.arange(area.y0 + rows.start, area.y0 + rows.stop, dtype=np.float32)[:, None]
        x, y = np.broadcast_arrays(x, y)
        return x, y

    def place_in(self, window: Window) -> Window:
        """The rows of a window that lie around the positions, as far as cubic interpolation reaches."""
        if self.y is None:
            return self._area
        low, high = int(np.floor(self.y.min())) - 2, int(np.ceil(self.y.max())) + 3
        top = min(max(low, window.y0), window.y1 - 1)
        return Window(window.x0, top, window.x1, max(min(high, window.y1), top + 1))


def _as_complex(vectors: Array) -> NDArray[np.complex64]:
    """(h, w, 2) as (h, w): x + i y."""
    return np.ascontiguousarray(vectors, np.float32).view(np.complex64)[..., 0]


def _nearest(x: Array, y: Array, window: Window) -> NDArray[np.intp]:
    """Flat indices of the nearest pixels of a window."""
    column = np.clip(np.rint(x - window.x0), 0, window.width - 1).astype(np.intp)
    row = np.clip(np.rint(y - window.y0), 0, window.height - 1).astype(np.intp)
    return row * window.width + column


def _warp(frame: FusedFrame, path: _Path) -> Array:
    """Colour and alpha (3 or 4, h, w) of another frame at the positions of a path: Keys' cubic, within the range of the
    four nearest pixels."""
    place = path.place_in(frame.alignment.hr_data_window)
    planes = _channels(frame, place)
    if path.x is None:
        return planes
    padded = np.pad(planes, [(0, 0), (2, 2), (2, 2)], mode="edge").reshape(len(planes), -1)
    stride = place.width + 4
    height, width = path.valid.shape
    result = np.empty((len(planes), height, width), np.float32)

    def work(rows: slice) -> None:
        x, y = path.positions(rows)
        x = np.clip(x - place.x0, -1, place.width - 0.01)
        y = np.clip(y - place.y0, -1, place.height - 0.01)
        left, top = np.floor(x), np.floor(y)
        first = (top.astype(np.intp) + 2) * stride + left.astype(np.intp) + 2
        across, down = _keys(x - left), _keys(y - top)
        for plane, out in zip(padded, result, strict=True):
            total, values = np.zeros(x.shape, np.float32), np.empty(x.shape, np.float32)
            low, high = np.full(x.shape, np.inf, np.float32), np.full(x.shape, -np.inf, np.float32)
            for dy, weight_y in zip(range(-1, 3), down, strict=True):
                row = np.zeros_like(total)
                for dx, weight_x in zip(range(-1, 3), across, strict=True):
                    # "wrap" makes NumPy write straight into `values`; no index needs it.
                    plane.take(first + (dy * stride + dx), out=values, mode="wrap")
                    if {dx, dy} <= {0, 1}:
                        np.minimum(low, values, out=low)
                        np.maximum(high, values, out=high)
                    values *= weight_x
                    row += values
                row *= weight_y
                total += row
            np.clip(total, low, high, out=out[rows])

    for_row_blocks(work, height, width)
    return result


def _keys(t: Array) -> list[Array]:
    """Weights of the four pixels around a position that lies ``t`` beyond the second one (Keys 1981)."""
    a = np.float32(SHARPNESS)
    near = [((a + 2) * d - (a + 3)) * d * d + 1 for d in (t, 1 - t)]
    far = [((a * d - 5 * a) * d + 8 * a) * d - 4 * a for d in (1 + t, 2 - t)]
    return [far[0], near[0], near[1], far[1]]


class _Light:
    """The light of a frame, as both renders show it, to compare warped neighbours with."""

    def __init__(self, frame: FusedFrame) -> None:
        self._alignment = alignment = frame.alignment
        self._scale = alignment.scale
        fused = np.concatenate(
            [self._low(self.luminance_of(_channels(frame, core)), core) for core, _ in _bands(alignment)]
        )
        floor = DARKEST * float(fused.mean(dtype=np.float64)) + 1e-30
        self._brightness = mean_around(fused, 1) + np.float32(floor)
        self._renders = [frame.lrhs_luminance, frame.hrls_luminance]
        low, high = (render / self._brightness for render in self._renders)
        noise = np.square(np.clip((low - high) / 2, -LARGEST_DIFFERENCE, LARGEST_DIFFERENCE))
        #: For each radius in LRHS pixels: the variance of the mean of both renders.
        self._noise = {reach: _wide_mean(noise, reach) for reach in (max(1, round(r / self._scale)) for r in RADII)}

    @staticmethod
    def luminance_of(planes: Array) -> Array:
        """Luminance (h, w) of colour (3 or more, h, w)."""
        red, green, blue = (np.float32(w) * plane for w, plane in zip(LUMINANCE_WEIGHTS, planes, strict=False))
        return np.asarray(red + green + blue, np.float32)

    def trust(self, grey: Array, area: Window) -> Array:
        """How much a warped neighbour with this luminance counts, from 0 to 1, (h, w) over ``area``."""
        low = self._low(grey, area)
        top = self._rows(area).start
        rows = slice(top, top + len(low))
        brightness = self._brightness[rows]
        differences = [
            np.clip((render[rows] - low) / brightness, -LARGEST_DIFFERENCE, LARGEST_DIFFERENCE)
            for render in self._renders
        ]
        product = differences[0] * differences[1]
        trust = np.ones_like(low)
        for reach, variance in self._noise.items():
            noise = variance[rows]
            own_error = noise * np.float32(self._scale**2 / PIXELS_AVERAGED) + np.float32(EQUAL)
            uncertainty = np.float32(DOUBT * 2 / (2 * reach + 1)) * noise
            change = np.maximum(_wide_mean(product, reach) - uncertainty - own_error, 0)
            np.minimum(trust, own_error / (own_error + change), out=trust)
        low_area = self._low_area(area)
        return upsample_linear(trust, self._scale, slice(0, len(trust)))[area.slices(low_area)]

    def _rows(self, area: Window) -> slice:
        """The rows of the LRHS's grid that an area covers."""
        grid = self._alignment.grid
        return slice(area.y0 // self._scale - grid.y0, -(-area.y1 // self._scale) - grid.y0)

    def _low_area(self, area: Window) -> Window:
        """An area, widened to whole LRHS pixels."""
        grid, scale = self._alignment.grid, self._scale
        return Window(grid.x0 * scale, area.y0 // scale * scale, grid.x1 * scale, -(-area.y1 // scale) * scale)

    def _low(self, grey: Array, area: Window) -> Array:
        """A plane over ``area`` at the LRHS's resolution, over the width of the grid."""
        whole = self._low_area(area)
        if whole != area:
            rows, columns = mirrored_pixels(whole, area)
            grey = grey[rows - area.y0].take(columns - area.x0, axis=1)
        return box_downsample(grey, self._scale)


def _wide_mean(plane: Array, radius: int) -> Array:
    """Mean over the pixels up to ``radius`` rows and columns away that exist, in a time that does not depend on it."""
    for axis in (0, 1):
        size = plane.shape[axis]
        sums = np.insert(np.cumsum(plane, axis=axis, dtype=np.float64), 0, 0, axis=axis)
        start, stop = (np.clip(np.arange(size) + offset, 0, size) for offset in (-radius, radius + 1))
        count = stop - start
        total = sums.take(stop, axis) - sums.take(start, axis)
        plane = (total / (count[:, None] if axis == 0 else count)).astype(np.float32)
    return plane


def _channels(frame: FusedFrame, area: Window) -> Array:
    """Colour and alpha, if there is one, over an area of the data window, as planes (3 or 4, h, w)."""
    part = area.slices(frame.alignment.hr_data_window)
    colour = planes_of(frame.rgb[part])
    return colour if frame.alpha is None else np.concatenate([colour, frame.alpha[part][None, ..., 0]])


def _add(total: Array, weights: Array, squares: Array, warped: Array, weight: Array) -> None:
    """Add weighted planes (c, h, w) to the totals."""

    def work(rows: slice) -> None:
        for plane, values in zip(total, warped, strict=False):  # this frame may lack the alpha
            plane[rows] += weight[rows] * values[rows]
        weights[rows] += weight[rows]
        squares[rows] += np.square(weight[rows])

    for_row_blocks(work, len(weights), weights.shape[1] * len(total))
