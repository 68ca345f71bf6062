# SPDX-License-Identifier: Apache-2.0
"""Means, sums, extremes and masks over the pixels around each pixel."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.arrays import Array, Mask
from oiio_msspl.parallel import for_row_blocks


def neighbours(values: NDArray[Any], distance: int = 1) -> Iterator[NDArray[Any]]:
    """The 3 x 3 neighbours of each pixel (h, w, ...) at a distance, one (h, w, ...) each; the edge pixel is
    repeated."""
    height, width = values.shape[:2]
    margins = [(distance, distance) if axis < 2 else (0, 0) for axis in range(values.ndim)]
    padded = np.pad(values, margins, mode="edge")
    for y, x in itertools.product(range(0, 3 * distance, distance), repeat=2):
        yield padded[y : y + height, x : x + width]


def all_within(mask: Mask, reach: int) -> Mask:
    """Where a mask (h, w, ...) holds for all pixels up to ``reach`` rows and columns away."""
    distance = 1
    while reach > 0:
        mask = reduce(np.logical_and, neighbours(mask, min(distance, reach)))
        reach, distance = reach - distance, 2 * distance
    return mask


def grown(mask: Mask, reach: int = 1) -> Mask:
    """A mask (h, w, ...) with all pixels up to ``reach`` rows and columns away, too."""
    return ~all_within(~mask, reach)


def max_3x3(values: Array) -> Array:
    """The largest of the 3 x 3 pixels around each, (h, w, ...)."""
    largest = values.copy(order="K")
    for axis in (0, 1):  # a 3 x 3 maximum is one of three rows and one of three columns
        lines = largest.swapaxes(0, axis)
        before = lines.copy(order="K")
        np.maximum(lines[1:], before[:-1], out=lines[1:])
        np.maximum(lines[:-1], before[1:], out=lines[:-1])
    return largest


def sum_3x3(values: Array) -> Array:
    """Sum over 3 x 3 pixels (h, w, ...); the edge pixel is repeated."""
    for axis in (1, 0):
        lines = values.swapaxes(0, axis)
        total = lines.copy(order="K")
        for pixels, beside in ((slice(1, None), slice(-1)), (slice(-1), slice(1, None)), ((0,), (0,)), ((-1,), (-1,))):
            total[pixels] += lines[beside]
        values = total.swapaxes(0, axis)
    return values


def blurred(plane: Array, times: int = 1) -> Array:
    """Mean over 3 x 3 pixels with the weights 1, 2, 1 in rows and in columns, so many times; the edge is repeated."""
    for axis in (0, 1) * times:
        lines = plane.swapaxes(0, axis)
        total = 2 * lines
        total[1:] += lines[:-1]
        total[:-1] += lines[1:]
        total[0] += lines[0]
        total[-1] += lines[-1]
        total *= np.float32(1 / 4)
        plane = total.swapaxes(0, axis)
    return plane


def mean_around(plane: Array, reach: int) -> Array:
    """Mean over the pixels up to ``reach`` rows and columns away that exist, in a time that does not depend on it."""
    for axis in (0, 1):
        plane = _mean_along(plane, reach, axis)
    return plane


def _mean_along(plane: Array, reach: int, axis: int) -> Array:
    """The same along one axis."""
    size = plane.shape[axis]
    start, stop = (np.clip(np.arange(size) + offset, 0, size) for offset in (-reach, reach + 1))
    count = (stop - start)[:, None] if axis == 0 else stop - start
    result = np.empty_like(plane)

    def lines(which: slice) -> tuple[slice, ...]:
        return (which, slice(None)) if axis == 0 else (slice(None), which)

    def work(part: slice) -> None:
        block = plane[:, part] if axis == 0 else plane[part]
        sums = np.zeros([n + (i == axis) for i, n in enumerate(block.shape)])
        np.cumsum(block, axis=axis, out=sums[lines(slice(1, None))])
        if size > 2 * reach:  # slices are read much faster than by index
            total = np.empty(block.shape)
            first, last = lines(slice(0, reach)), lines(slice(size - reach, size))
            total[first] = sums[lines(slice(reach + 1, 2 * reach + 1))]
            inner = lines(slice(2 * reach + 1, None)), lines(slice(0, size - 2 * reach))
            np.subtract(sums[inner[0]], sums[inner[1]], out=total[lines(slice(reach, size - reach))])
            total[last] = sums[lines(slice(size, None))] - sums[lines(slice(size - 2 * reach, size - reach))]
        else:
            total = sums.take(stop, axis) - sums.take(start, axis)
        (result[:, part] if axis == 0 else result[part])[:] = total / count

    for_row_blocks(work, plane.shape[1 - axis], 4 * size)
    return result
