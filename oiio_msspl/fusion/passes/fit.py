# SPDX-License-Identifier: Apache-2.0
"""Fits noisy images at low resolution as lines of a guide without noise, and applies the lines at full resolution.

This is first-order regression with cross-bilateral weights (Bitterli et al. 2016). The fit at low resolution is that of
the fast guided filter (He and Sun 2015). Everything here works on planes: float32 arrays (n, h, w).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from oiio_msspl.image.arrays import Array, planes_of
from oiio_msspl.image.filters import blurred, box_downsample
from oiio_msspl.image.parallel import for_row_blocks

#: Rows of a band whose weights stay in a core's cache while several planes are averaged.
CACHED_ROWS = 16
#: A fit averages 5 x 5 LRHS pixels so far apart, and then the averages likewise. At x2 a pixel has fewer samples, so
#: more of them are needed.
STEPS = {2: (1, 3), 4: (1, 2), 8: (1, 2)}
#: Pixels of the HRLS choose among fits around them with the spread divided by this.
SHARPER = 1.4
#: Keeps a fit from following noise: variance that is added to the guide, relative to its mean square.
RIDGE = 0.03
#: Variance of the logarithm of the fused beauty that counts as flat where albedo and normal are smoothed.
FLAT = 0.001


class LineFit:
    """Lines ``layer = slope beauty + offset`` around every low-resolution pixel, fitted to pixels that look alike."""

    def __init__(self, beauty: Array, guides: Array, steps: Sequence[int]) -> None:
        """``beauty``: (3, h, w). ``guides``: (guides, h, w), in units of their spread."""
        self._beauty, self._steps = beauty, steps
        self._kernels = [_kernel(guides, step) for step in steps]
        means = self._mean(np.concatenate([beauty, beauty * beauty]))
        self._means = means[:3]
        variances = np.maximum(means[3:] - self._means**2, 0)
        self._variances = variances + RIDGE * (variances + self._means**2) + np.float32(1e-20)

    def lines(self, layer: Array) -> tuple[Array, Array]:
        """The slopes of a layer (3, h, w) in each channel, and then the offsets, (6, h, w); and the layer's means
        (3, h, w)."""
        means = self._mean(np.concatenate([layer, layer * self._beauty]))
        mean, products = means[:3], means[3:]
        slopes = (products - mean * self._means) / self._variances
        return np.concatenate([slopes, mean - slopes * self._means]), mean

    def _mean(self, planes: Array) -> Array:
        """Means (n, h, w) over pixels around that look alike."""
        for kernel, step in zip(self._kernels, self._steps, strict=True):
            planes = _mean_around(planes, kernel, step)
        return planes


def _mean_around(planes: Array, weights: Array, step: int) -> Array:
    """Means of planes (n, h, w) over 5 x 5 pixels, ``step`` pixels apart, with the weights (5, 5, h, w) of
    :func:`_kernel`."""
    count, height, width = planes.shape
    reach = 2 * step
    padded = np.zeros((count, height + 2 * reach, width + 2 * reach), np.float32)
    padded[:, reach : reach + height, reach : reach + width] = planes
    around = sliding_window_view(padded, (2 * reach + 1, 2 * reach + 1), axis=(1, 2))[..., ::step, ::step]
    # NumPy would add up adjacent columns pixel by pixel, which takes three times as long as row by row.
    columns = [slice(0, 5, 2), slice(1, 5, 2)] if step == 1 else [slice(0, 5)]
    result = np.zeros_like(planes)
    for start in range(0, height, CACHED_ROWS):
        rows = slice(start, start + CACHED_ROWS)
        for part in columns:
            result[:, rows] += np.einsum("ijhw,nhwij->nhw", weights[:, part, rows], around[:, rows, :, :, part])
    return result


def _kernel(guides: Array, step: int) -> Array:
    """Weights (5, 5, h, w) of 5 x 5 pixels, ``step`` pixels apart, which sum to 1. Pixels outside weigh nothing."""
    height, width = guides.shape[1:]
    offsets = [(y * step, x * step) for y in range(-2, 3) for x in range(-2, 3)]
    weights = np.zeros((len(offsets), height, width), np.float32)
    weights[12] = 1

    def weigh(part: slice) -> None:
        # Two pixels differ by as much, whichever of them is in the centre.
        for i, (y, x) in list(enumerate(offsets[:12]))[part]:
            if -y < height and abs(x) < width:
                here = slice(-y, height), slice(max(-x, 0), width - max(x, 0))
                there = slice(0, height + y), slice(max(x, 0), width - max(-x, 0))
                with np.errstate(over="ignore", invalid="ignore"):
                    distance = np.square(guides[:, here[0], here[1]] - guides[:, there[0], there[1]]).sum(axis=0)
                distance += np.float32((y * y + x * x) / (8 * step * step))
                weights[i][here] = weights[24 - i][there] = np.exp(-distance)

    for_row_blocks(weigh, 12, guides.size)
    weights /= weights.sum(axis=0)
    return weights.reshape(5, 5, height, width)


class LinesNearby:
    """Applies lines at full resolution: those of the four low-resolution pixels around, by how much they look alike.

    All pixels that lie in the same place of a low-resolution pixel, a *phase*, are computed together. They are as many
    as low-resolution pixels, so all arrays are contiguous.
    """

    def __init__(self, low: Array, full: Array, scale: int, rows: slice) -> None:
        """``low``, ``full``: guides (guides, h, w) in units of their spread. ``rows``: of ``low``, to interpolate."""
        self._rows, self._scale = rows, scale
        height, width = rows.stop - rows.start, low.shape[2]
        #: For each phase, the weights of the two rows and two columns of corners.
        self._weights = np.empty((scale, scale, 2, 2, height, width), np.float32)
        whole = self.phases(full[:, rows.start * scale : rows.stop * scale])
        padded = self._padded(low)
        for y, x in np.ndindex(scale, scale):
            weights = self._weights[y, x]
            for i, j in np.ndindex(2, 2):
                top, left = self._corner(y) + i, self._corner(x) + j
                there = padded[:, top : top + height, left : left + width]
                distance = np.square(there - whole[y, x]).sum(axis=0) * np.float32(SHARPER**2)
                share = self._share(y, i) * self._share(x, j)
                weights[i, j] = (np.exp(-distance) + np.float32(1e-4)) * np.float32(share)
            weights /= weights.sum(axis=(0, 1))

    def phases(self, planes: Array) -> Array:
        """Planes (n, h, w) at full resolution as phases (scale, scale, n, h, w)."""
        n, height, width = planes.shape
        parts = planes.reshape(n, height // self._scale, self._scale, width // self._scale, self._scale)
        return np.ascontiguousarray(parts.transpose(2, 4, 0, 1, 3))

    def apply(self, lines: Array, bounds: Array, guide: Array, out: Array) -> None:
        """The values of lines at full resolution, within interpolated bounds.

        Args:
            lines: slopes and offsets (2 n, h, w) at low resolution.
            bounds: lowest and highest values (2 n, h, w) at low resolution.
            guide: the values that the lines are functions of, as :meth:`phases` over the chosen rows.
            out: gets the chosen rows (n, h, w) at full resolution.
        """
        n, scale = len(out), self._scale
        height, width = self._weights.shape[-2:]
        lines, bounds = self._padded(lines), self._padded(bounds)
        for start in range(0, height, CACHED_ROWS):
            stop = min(start + CACHED_ROWS, height)
            target = out[:, start * scale : stop * scale]
            for y in range(scale):
                rows = slice(self._corner(y) + start, self._corner(y) + stop + 1)
                between = _between(bounds[:, rows][:, :-1], bounds[:, rows][:, 1:], self._share(y, 1))
                pairs = sliding_window_view(lines[:, rows], 2, axis=1)
                for x in range(scale):
                    left = self._corner(x)
                    weights = self._weights[y, x, :, :, start:stop]
                    line, right = (
                        np.einsum("ihw,nhwi->nhw", weights[:, j], pairs[:, :, left + j : left + j + width])
                        for j in (0, 1)
                    )
                    line += right
                    values = line[:n]
                    values *= guide[y, x, :, start:stop]
                    values += line[n:]
                    limits = _between(
                        between[..., left : left + width], between[..., left + 1 : left + 1 + width], self._share(x, 1)
                    )
                    np.clip(values, limits[:n], limits[n:], out=target[:, y::scale, x::scale])

    def _padded(self, planes: Array) -> Array:
        """The chosen rows of planes (n, h, w), and one pixel more on each side; the edge is repeated."""
        rows = slice(max(self._rows.start - 1, 0), self._rows.stop + 1)
        top = 1 - (self._rows.start - rows.start)
        bottom = max(self._rows.stop + 1 - planes.shape[1], 0)
        return np.pad(planes[:, rows], ((0, 0), (top, bottom), (1, 1)), mode="edge")

    def _corner(self, phase: int) -> int:
        """Row or column, in :meth:`_padded`, of the first corner of a phase's first pixel."""
        return int(2 * phase + 1 > self._scale)

    def _share(self, phase: int, corner: int) -> float:
        """How much the first (0) or second (1) corner of a phase counts in linear interpolation."""
        position = (phase + 0.5) / self._scale - 0.5
        second = position if position > 0 else 1 + position
        return second if corner else 1 - second


def _between(first: Array, second: Array, share: float) -> Array:
    """Linear interpolation; ``share`` is that of the second."""
    result = second - first
    result *= np.float32(share)
    result += first
    return result


def smoothed(planes: Array, log: Array) -> Array:
    """Planes (n, h, w) without noise: a guided filter (He et al. 2010) over 3 x 3 pixels, guided by the beauty."""
    mean = blurred(log)
    variance = blurred(log * log) - mean * mean + np.float32(FLAT)
    result = np.empty_like(planes)

    def smooth(part: slice) -> None:
        for plane, out in zip(planes[part], result[part], strict=True):
            average = blurred(plane)
            slope = (blurred(plane * log) - average * mean) / variance
            np.add(average, slope * (log - mean), out=out)

    for_row_blocks(smooth, len(planes), log.size)
    return result


def downsampled(planes: Array, scale: int) -> Array:
    """Planes (n, h, w), averaged over ``scale`` x ``scale`` pixels."""
    return planes_of(box_downsample(np.moveaxis(planes, 0, -1), scale))
