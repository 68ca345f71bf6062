# SPDX-License-Identifier: Apache-2.0
"""Fits layers at the LRHS's resolution as lines of the fused beauty, and applies the lines at full resolution.

This is first-order regression with cross-bilateral weights (Bitterli et al. 2016), at low resolution as in the fast
guided filter (He and Sun 2015). Everything here works on planes: float32 arrays (n, h, w).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from oiio_msspl.fusion.tiles.guards import LAYER_REACH
from oiio_msspl.image.arrays import Array, planes_of
from oiio_msspl.image.filters import blurred, box_downsample, max_around
from oiio_msspl.image.parallel import for_row_blocks, two_at_a_time
from oiio_msspl.model.contract import ONE_SIZE

#: Rows of a band whose weights stay in a core's cache while several planes are averaged.
CACHED_ROWS = 16
#: A fit averages 5 x 5 LRHS pixels so far apart, and then the averages likewise.
STEPS = {ONE_SIZE: (1, 2, 4), 2: (1, 3), 4: (1, 2), 8: (1, 2)}
#: Pixels of the HRLS choose among fits around them with the spread divided by this.
SHARPER = 1.4
#: Keeps a fit from following noise: variance that is added to the guide, relative to its mean square.
RIDGE = 0.03
#: A layer has no sample where its brightest pixel around is below this share of its mean over pixels that look alike.
NO_SAMPLE = 0.25
#: Variance of the logarithm of the fused beauty that counts as flat where albedo and normal are smoothed.
FLAT = 0.001


def _mean_around(planes: Array, weights: Array, step: int) -> Array:
    """Return means of planes (n, h, w) over 5 x 5 pixels, ``step`` pixels apart, by weights (5, 5, h, w)."""
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
    """Return weights (5, 5, h, w) of 5 x 5 pixels, ``step`` pixels apart, that sum to 1. Pixels outside weigh 0."""
    height, width = guides.shape[1:]
    offsets = [(y * step, x * step) for y in range(-2, 3) for x in range(-2, 3)]
    weights = np.zeros((len(offsets), height, width), np.float32)
    weights[12] = 1

    def weigh(part: slice) -> None:
        # Two pixels differ by as much, whichever of them is in the centre.
        for i, (y, x) in list(enumerate(offsets[:12]))[part]:
            if -y < height and abs(x) < width:
                pixels = slice(-y, height), slice(max(-x, 0), width - max(x, 0))
                shifted = slice(0, height + y), slice(max(x, 0), width - max(-x, 0))
                with np.errstate(over="ignore", invalid="ignore"):
                    distance = np.square(guides[:, *pixels] - guides[:, *shifted]).sum(axis=0)
                distance += np.float32((y * y + x * x) / (8 * step * step))
                weights[i][pixels] = weights[24 - i][shifted] = np.exp(-distance)

    for_row_blocks(weigh, 12, guides.size)
    weights /= weights.sum(axis=0)
    return weights.reshape(5, 5, height, width)


class LinesNearby:
    """Lines at full resolution: means of those of the four low-resolution pixels around that look alike.

    All pixels in the same place of a low-resolution pixel, a *phase*, are computed together, in contiguous arrays.
    """

    def __init__(self, low: Array, full: Array, scale: int, rows: slice) -> None:
        """``low``, ``full``: guides (guides, h, w) in units of their spread. ``rows``: of ``low``, to interpolate."""
        self._rows, self._scale = rows, scale
        height, width = rows.stop - rows.start, low.shape[2]
        positions = [(phase + 0.5) / scale - 0.5 for phase in range(scale)]
        #: For each phase, the row or column of its first corner in :meth:`_padded`, and both corners' linear weights.
        self._corners = [int(position > 0) for position in positions]
        self._nearness = [(1 - x, x) for x in (position if position > 0 else 1 + position for position in positions)]
        #: For each phase, the weights of the two rows and two columns of corners.
        self._weights = np.empty((scale, scale, 2, 2, height, width), np.float32)
        whole = self.phases(full[:, rows.start * scale : rows.stop * scale])
        padded = self._padded(low)
        for y, x in np.ndindex(scale, scale):
            weights = self._weights[y, x]
            for i, j in np.ndindex(2, 2):
                top, left = self._corners[y] + i, self._corners[x] + j
                corner = padded[:, top : top + height, left : left + width]
                distance = np.square(corner - whole[y, x]).sum(axis=0) * np.float32(SHARPER**2)
                nearness = self._nearness[y][i] * self._nearness[x][j]
                weights[i, j] = (np.exp(-distance) + np.float32(1e-4)) * np.float32(nearness)
            weights /= weights.sum(axis=(0, 1))

    def phases(self, planes: Array) -> Array:
        """Return planes (n, h, w) at full resolution as phases (scale, scale, n, h, w)."""
        n, height, width = planes.shape
        parts = planes.reshape(n, height // self._scale, self._scale, width // self._scale, self._scale)
        return np.ascontiguousarray(parts.transpose(2, 4, 0, 1, 3))

    def apply(self, lines: Array, bounds: Array, guide: Array, out: Array) -> None:
        """Compute the values of lines at full resolution, within interpolated bounds.

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
                rows = slice(self._corners[y] + start, self._corners[y] + stop + 1)
                between = _between(bounds[:, rows][:, :-1], bounds[:, rows][:, 1:], self._nearness[y][1])
                pairs = sliding_window_view(lines[:, rows], 2, axis=1)
                for x in range(scale):
                    left = self._corners[x]
                    weights = self._weights[y, x, :, :, start:stop]
                    line, right = (
                        np.einsum("ihw,nhwi->nhw", weights[:, j], pairs[:, :, left + j : left + j + width])
                        for j in (0, 1)
                    )
                    line += right
                    values = line[:n]
                    values *= guide[y, x, :, start:stop]
                    values += line[n:]
                    columns = between[..., left : left + width], between[..., left + 1 : left + 1 + width]
                    limits = _between(*columns, self._nearness[x][1])
                    np.clip(values, limits[:n], limits[n:], out=target[:, y::scale, x::scale])

    def _padded(self, planes: Array) -> Array:
        """Return the chosen rows of planes (n, h, w), with one pixel more on each side; the edge is repeated."""
        return np.pad(planes, ((0, 0), (1, 1), (1, 1)), mode="edge")[:, self._rows.start : self._rows.stop + 2]


def _between(first: Array, second: Array, weight: float) -> Array:
    """Interpolate linearly; ``weight`` is that of the second."""
    result = second - first
    result *= np.float32(weight)
    result += first
    return result


class BeautyFit:
    """The fused beauty of some rows, to which layers at the LRHS's resolution are fitted.

    A layer is ``slope beauty + offset`` around every low-resolution pixel, fitted to pixels that look alike.
    """

    def __init__(self, beauty: Array, guides: Array, scale: int, steps: Sequence[int], rows: slice) -> None:
        """``beauty``: (3, h, w). ``guides``: (n, h, w), in units of their spread. ``rows``: of the layers, to fit."""
        low, self._low_beauty = downsampled(guides, scale), downsampled(beauty, scale)
        with np.errstate(over="ignore", invalid="ignore"):
            self._kernels = {step: _kernel(low, step) for step in steps}
            means = self._mean(np.concatenate([self._low_beauty, self._low_beauty * self._low_beauty]))
            self._means = means[:3]
            variances = np.maximum(means[3:] - self._means**2, 0)
            self._variances = variances + RIDGE * (variances + self._means**2) + np.float32(1e-20)
        self._reach = LAYER_REACH // scale - 2
        self._nearby = LinesNearby(low, guides, scale, rows)
        self._beauty = self._nearby.phases(beauty[:, rows.start * scale : rows.stop * scale])

    def fit_layers(self, layers: Sequence[Array], results: Sequence[Array], *, few_samples: bool = False) -> None:
        """Fit layers to the fused beauty.

        Args:
            layers: (3, h, w) each, at their own resolution.
            results: get the wanted rows, (3, h, w) each.
            few_samples: the layers are as rendered, so pixels may have no sample of a light by chance.
        """

        def fit(part: slice) -> None:
            for layer, out in zip(layers[part], results[part], strict=True):
                self._fit(layer, out, few_samples)

        for_row_blocks(fit, len(layers), self._beauty.size)

    @np.errstate(over="ignore", invalid="ignore")
    def _fit(self, layer: Array, out: Array, few_samples: bool) -> None:
        means = self._mean(np.concatenate([layer, layer * self._low_beauty]))
        mean, products = means[:3], means[3:]
        slopes = (products - mean * self._means) / self._variances
        # The renders around bound the fit: where it mixes two surfaces, it would leave their range.
        lowest, highest = (np.stack([sign * max_around(sign * plane) for plane in layer]) for sign in (-1, 1))
        if few_samples:
            # Where a rare light has no sample by chance, the mean over pixels that look alike is the bound. This
            # ends two LRHS pixels before LAYER_REACH, because the bounds are interpolated.
            near_light = max_around(np.any(layer != 0, axis=0), self._reach)
            highest = np.where(near_light & (highest < mean * np.float32(NO_SAMPLE)), mean, highest)
        lines = np.concatenate([slopes, mean - slopes * self._means])
        self._nearby.apply(lines, np.concatenate([lowest, highest]), self._beauty, out)

    def _mean(self, planes: Array) -> Array:
        """Return means (n, h, w) over pixels around that look alike."""
        for step, kernel in self._kernels.items():
            planes = _mean_around(planes, kernel, step)
        return planes


def smoothed(planes: Array, log: Array) -> Array:
    """Remove noise from planes (n, h, w) by a guided filter (He et al. 2010) over 3 x 3 pixels.

    ``log``: the logarithm of the beauty's light, (h, w), which guides it.
    """
    mean = blurred(log)
    variance = blurred(log * log) - mean * mean + np.float32(FLAT)

    def smooth(plane: Array) -> Array:
        average = blurred(plane)
        slope = (blurred(plane * log) - average * mean) / variance
        return average + slope * (log - mean)

    return np.stack(two_at_a_time(smooth, list(planes)))


def downsampled(planes: Array, scale: int) -> Array:
    """Average planes (n, h, w) over ``scale`` x ``scale`` pixels."""
    return planes_of(box_downsample(np.moveaxis(planes, 0, -1), scale))
