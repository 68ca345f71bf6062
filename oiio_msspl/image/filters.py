# SPDX-License-Identifier: Apache-2.0
"""Means, sums, extremes and masks over the pixels around each pixel."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.image.arrays import Array, Mask
from oiio_msspl.image.parallel import for_row_blocks


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


def means_around(plane: Array, reaches: Sequence[int]) -> list[Array]:
    """Means over the pixels up to so many rows and columns away that exist, in a time that does not depend on that.

    Sums over the plane (h, w) are stored in 64 bits (Crow 1984, *Summed-area tables for texture mapping*). So means
    that are below 1e-8 of that of all pixels are not exact.
    """
    height, width = plane.shape
    sums = np.zeros((height + 1, width + 1))

    def add_columns(rows: slice) -> None:
        np.cumsum(plane[rows], axis=1, out=sums[1:, 1:][rows])

    def add_rows(columns: slice) -> None:
        for row in range(1, height):  # twice as fast as a cumulative sum along the first axis
            sums[row + 1, columns] += sums[row, columns]

    for_row_blocks(add_columns, height, 2 * width)
    for_row_blocks(add_rows, width + 1, 2 * height)
    return [_mean_of_sums(sums, reach) for reach in reaches]


def _mean_of_sums(sums: NDArray[np.float64], reach: int) -> Array:
    """The means (h, w) of a plane for one reach.

    Args:
        sums: of the values above and to the left of each corner of a pixel, (h + 1, w + 1).
    """
    height, width = (size - 1 for size in sums.shape)
    (top, bottom), (left, right) = (
        (np.maximum(np.arange(size) - reach, 0), np.minimum(np.arange(size) + reach + 1, size))
        for size in (height, width)
    )
    result = np.empty((height, width), np.float32)

    def work(rows: slice) -> None:
        lines = sums.take(bottom[rows], axis=0)
        lines -= sums.take(top[rows], axis=0)
        squares = np.empty((len(lines), width))
        if width > 2 * reach:  # slices are read much faster than by index
            inside = slice(reach, width - reach)
            np.subtract(lines[:, 2 * reach + 1 :], lines[:, : width - 2 * reach], out=squares[:, inside])
            squares[:, :reach] = lines[:, reach + 1 : 2 * reach + 1]
            squares[:, width - reach :] = lines[:, -1:] - lines[:, width - 2 * reach : width - reach]
        else:
            np.subtract(lines.take(right, axis=1), lines.take(left, axis=1), out=squares)
        squares *= 1 / (right - left)
        np.multiply(squares, 1 / (bottom - top)[rows, None], out=result[rows], casting="same_kind")

    for_row_blocks(work, height, 4 * width)
    return result
