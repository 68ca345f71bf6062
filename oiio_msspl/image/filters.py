# SPDX-License-Identifier: Apache-2.0
"""Filters of images: resizing, holes that are filled, and means, sums, extremes and masks around each pixel."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from functools import reduce
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.image.arrays import FLOAT_MAX, Array, Mask, all_finite, planes_of
from oiio_msspl.image.parallel import for_row_blocks

T = TypeVar("T", bound=np.generic)


def box_downsample(image: NDArray[Any], scale: int) -> Array:
    """Return the mean of ``scale`` x ``scale`` pixels, half or float: (H, W, ...) to (H/s, W/s, ...).

    Rows and columns that are left over do not count. The means are finite if the pixels are. They have the memory
    layout of ``image``.
    """
    height, width = (side // scale for side in image.shape[:2])
    image = image[: height * scale, : width * scale]
    result = np.empty_like(image, np.float32, subok=False, shape=(height, width, *image.shape[2:]))

    def work(rows: slice) -> None:
        # Sums of strided views are ten times as fast as np.mean over short axes. Sums of half floats would be rounded.
        block = image[rows].astype(np.float32, copy=False)
        with np.errstate(over="ignore"):
            row_sums = reduce(np.add, (block[y::scale] for y in range(scale)))
            sums = reduce(np.add, (row_sums[:, x::scale] for x in range(scale)))
        if not all_finite(sums):
            np.clip(sums, -FLOAT_MAX, FLOAT_MAX, out=sums)
        np.multiply(sums, np.float32(1 / scale**2), out=result[rows.start // scale : rows.stop // scale])

    for_row_blocks(work, len(image), image[:1].size, multiple=scale)
    return result


def halved(image: Array) -> Array:
    """Return the mean of 2 x 2 pixels (h/2, w/2, ...), rounded up: the last row and column of an odd size repeat."""
    margins = [(0, side % 2) if axis < 2 else (0, 0) for axis, side in enumerate(image.shape)]
    return box_downsample(np.pad(image, margins, mode="edge") if margins[0][1] or margins[1][1] else image, 2)


def even_and_odd(plane: Array) -> tuple[Array, Array]:
    """Return two pictures of one (h, w, ...), by its even and by its odd pixels, as on a chessboard.

    Where a picture lacks a pixel, it is the mean of the four pixels around. So the noise of the two is independent if
    that of the pixels is.
    """
    padded = np.pad(plane, [(1, 1), (1, 1), *[(0, 0)] * (plane.ndim - 2)], mode="edge")
    around = (padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]) * np.float32(0.25)
    rows, columns = np.ogrid[: plane.shape[0], : plane.shape[1]]
    is_even = ((rows + columns) % 2 == 0).reshape(*plane.shape[:2], *[1] * (plane.ndim - 2))
    return np.where(is_even, plane, around), np.where(is_even, around, plane)


def columns_apart(image: Array) -> tuple[Array, Array]:
    """Return two pictures of one (h, w, ...), by every fourth column and by those in the middle between them.

    They are two pixels apart, so their noise is independent even if a pixel filter has spread it. The columns between
    are interpolated.
    """
    columns = np.arange(image.shape[1])
    first, second = (interpolate(image[:, min(i, len(columns) - 1) :: 4], (columns - i) / 4, 1) for i in (0, 2))
    return first, second


def interpolate(values: Array, positions: NDArray[np.float64], axis: int) -> Array:
    """Sample an image (height, width, ...) linearly at positions between pixels along an axis, in pixels.

    The edge pixel is repeated outside. If the positions are exactly the pixels, the image itself is returned.
    """
    last = values.shape[axis] - 1
    if np.array_equal(positions, np.arange(last + 1)):
        return values
    positions = np.clip(positions, 0, last)
    before = positions.astype(np.int64)
    if np.array_equal(positions, before):
        return values.take(before, axis)
    after = np.minimum(before + 1, last)
    weight = (positions - before).astype(np.float32).reshape([-1 if i == axis else 1 for i in range(values.ndim)])
    return values.take(before, axis) * (1 - weight) + values.take(after, axis) * weight


def enlarged(image: Array, scale: int) -> Array:
    """Interpolate an image (h, w, c) linearly at ``scale`` times its resolution."""
    return np.stack([upsample_linear(plane, scale) for plane in planes_of(image)], axis=-1)


def filled(image: Array, missing: NDArray[np.bool_]) -> Array:
    """Fill missing pixels (h, w) of a finite image (h, w, c) from those around.

    Missing pixels are interpolated from the image at half the size, which is filled in the same way (push-pull, Gortler
    et al. 1996, *The Lumigraph*). If all pixels are missing, the image is returned as it is.
    """
    if missing.all() or not missing.any():
        return image
    margins = [(0, side % 2) for side in missing.shape]
    present = np.pad(~missing, margins)[..., None]
    coverage = box_downsample(present.astype(np.float32), 2)
    sums = box_downsample(np.pad(image, [*margins, (0, 0)]) * present, 2)
    half = np.divide(sums, coverage, out=np.zeros_like(sums), where=coverage > 0)
    half = filled(half, coverage[..., 0] == 0)
    around = enlarged(half, 2)[: len(image), : image.shape[1]]
    return np.where(missing[..., None], around, image)


def upsample_linear(plane: Array, scale: int, rows: slice | None = None) -> Array:
    """Interpolate a plane (h, w), or some of its rows, linearly at ``scale`` times its resolution."""
    height, width = plane.shape
    first, last, _ = (rows or slice(None)).indices(height)
    result = np.empty(((last - first) * scale, width * scale), np.float32)

    def work(part: slice) -> None:
        top, bottom = first + part.start - 1, first + part.stop + 1
        margins = (max(-top, 0), max(bottom - height, 0)), (1, 1)
        padded = np.pad(plane[max(top, 0) : bottom], margins, mode="edge")
        tall = np.empty(((part.stop - part.start) * scale, width + 2), np.float32)
        out = result[part.start * scale : part.stop * scale]
        _interleave(padded[:-2], padded[1:-1], padded[2:], [tall[phase::scale] for phase in range(scale)])
        _interleave(tall[:, :-2], tall[:, 1:-1], tall[:, 2:], [out[:, phase::scale] for phase in range(scale)])

    for_row_blocks(work, last - first, width * scale**2)
    return result


def _interleave(before: Array, here: Array, after: Array, phases: Sequence[Array]) -> None:
    """Fill the lines of an enlarged plane that lie in the lines ``here``."""
    for phase, lines in enumerate(phases):
        position = (phase + 0.5) / len(phases) - 0.5
        change = (before if position < 0 else after) - here
        change *= np.float32(abs(position))
        np.add(here, change, out=lines)


def neighbours(values: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Yield the 3 x 3 pixels around each pixel as nine shifted images (h, w, ...). The edge pixel is repeated."""
    height, width = values.shape[:2]
    padded = np.pad(values, [(1, 1), (1, 1), *[(0, 0)] * (values.ndim - 2)], mode="edge")
    for y, x in itertools.product(range(3), repeat=2):
        yield padded[y : y + height, x : x + width]


def all_within(mask: Mask, reach: int) -> Mask:
    """Return where a mask (h, w, ...) is true for all pixels up to ``reach`` rows and columns away (erosion)."""
    return ~max_around(~mask, reach)


def in_squares(whole: Mask, partly: Mask, side: int, fraction: float) -> Mask:
    """Return the pixels (h, w) that lie in squares of ``side`` x ``side`` pixels that fulfil two conditions.

    Args:
        whole: true in all of the square.
        partly: true in at least this ``fraction`` of the square.
    """
    if min(whole.shape) < side or not whole.any():
        return np.zeros_like(whole)
    in_whole, in_partly = (_window_sums(mask.astype(np.int32), side) for mask in (whole, partly))
    squares = (in_whole == side**2) & (in_partly >= fraction * side**2)
    return _window_sums(np.pad(squares.astype(np.int32), side - 1), side) > 0


def max_around(values: NDArray[T], reach: int = 1) -> NDArray[T]:
    """Return the largest value up to ``reach`` rows and columns away from each pixel, (h, w, ...).

    That extends a mask by so many pixels on all sides (dilation).
    """
    for axis in (0, 1):
        distance, left = 1, reach
        while left > 0:  # windows that overlap double their reach with each maximum
            step = min(distance, left)
            lines = values.swapaxes(0, axis)
            largest = lines.copy(order="K")
            np.maximum(largest[step:], lines[:-step], out=largest[step:])
            np.maximum(largest[:-step], lines[step:], out=largest[:-step])
            values, left, distance = largest.swapaxes(0, axis), left - step, 2 * distance
    return values


def sum_3x3(values: Array) -> Array:
    """Return the sum of the 3 x 3 values around each pixel, (h, w, ...). The edge pixel is repeated."""
    for axis in (1, 0):
        values = _sum_of_three(values, axis, 1)
    return values


def blurred(plane: Array, times: int = 1) -> Array:
    """Blur a plane (h, w) with the weights 1, 2, 1 in rows and in columns, repeatedly. The edge pixel is repeated."""
    for axis in (0, 1) * times:
        plane = _sum_of_three(plane, axis, 2)
    plane *= np.float32(1 / 16**times)
    return plane


def _sum_of_three(values: Array, axis: int, weight: int) -> Array:
    """Return each pixel, times ``weight``, plus those on both sides of it along an axis."""
    lines = values.swapaxes(0, axis)
    total = weight * lines
    total[1:] += lines[:-1]
    total[:-1] += lines[1:]
    total[0] += lines[0]
    total[-1] += lines[-1]
    return total.swapaxes(0, axis)


def _window_sums(values: NDArray[Any], size: int) -> NDArray[Any]:
    """Return the sums of all squares of ``size`` x ``size`` values that lie inside, (h - size + 1, w - size + 1)."""
    for axis in (0, 1):
        lines = values.swapaxes(0, axis)
        count, width, start = len(lines) - size + 1, 1, 0
        parts = []  # a window consists of windows whose widths are powers of 2
        while start < size:
            if size & width:
                parts.append(lines[start : start + count])
                start += width
            if start < size:
                lines, width = lines[width:] + lines[:-width], 2 * width
        values = reduce(np.add, parts).swapaxes(0, axis)
    return values


def means_around(plane: Array, reach: int) -> Array:
    """Return the mean of the pixels up to ``reach`` rows and columns away, (h, w).

    Pixels beyond the edge do not count.
    """
    height, width = plane.shape
    result = np.empty((height, width), np.float32)

    def work(rows: slice) -> None:
        top, bottom = max(rows.start - reach, 0), min(rows.stop + reach, height)
        first = top - rows.start + reach
        padded = np.zeros((rows.stop - rows.start + 2 * reach, width + 2 * reach), np.float32)
        padded[first : first + bottom - top, reach : reach + width] = plane[top:bottom]
        lines, columns = (
            (np.minimum(places + reach + 1, size) - np.maximum(places - reach, 0)).astype(np.float32)
            for places, size in ((np.arange(rows.start, rows.stop), height), (np.arange(width), width))
        )
        counts = lines[:, None] * columns if lines.min() < lines.max() else lines[0] * columns
        np.divide(_window_sums(padded, 2 * reach + 1), counts, out=result[rows])

    for_row_blocks(work, height, 2 * width)
    return result
