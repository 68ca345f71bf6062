# SPDX-License-Identifier: Apache-2.0
"""Samples images at positions between pixels."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.image.arrays import Array, Mask
from oiio_msspl.image.parallel import for_row_blocks

#: Sharpness of the interpolation: the slope of Keys' cubic at the next pixel. Softer kernels blur with every frame.
SHARPNESS = -1.0
#: Positions are rounded to the nearest pixel, halves upwards, also if they are not exact.
HALF = np.float32(0.501)
#: All pixels of a block are interpolated, unless a smaller fraction of them than this lies between pixels.
MOST_CHOSEN = 0.8


def nearest_indices(x: Array, y: Array, size: tuple[int, int]) -> NDArray[np.intp]:
    """Return the flat indices of the pixels nearest to positions in an image of ``size`` (height, width)."""
    height, width = size
    indices = _nearest(y, height) * np.intp(width)
    indices += _nearest(x, width)
    return indices


def _nearest(positions: Array, side: int) -> NDArray[np.int32]:
    """Return the rows or columns nearest to positions along a side."""
    # `rint` rounds halves to even numbers, which would give two neighbours that move alike the same pixel.
    nearest = positions + HALF
    np.floor(nearest, out=nearest)
    np.clip(nearest, 0, side - 1, out=nearest)
    return nearest.astype(np.int32)  # four times as fast as to 64 bits


def sample_linear(image: Array, x: Array, y: Array) -> Array:
    """Interpolate an image (h, w, c) linearly at pixel positions (...); its edge is repeated outside.

    Images whose channels are contiguous in memory are not copied.

    Returns:
        (..., c), with channels that are contiguous in memory.
    """
    height, width, channels = image.shape
    x, y = (np.clip(at, 0, side - 1, dtype=np.float32) for at, side in ((x, width), (y, height)))
    left, top = np.floor(x), np.floor(y)
    right, down = x - left, y - top
    corner = top.astype(np.int32) * np.intp(width) + left.astype(np.int32)  # four times as fast as to 64 bits
    beside, below = (left < width - 1).astype(np.intp), np.where(top < height - 1, np.intp(width), np.intp(0))
    corners = corner, corner + beside, corner + below, corner + below + beside
    result = np.empty((channels, *x.shape), np.float32)
    other, low, low_other = np.empty((3, *x.shape), np.float32)
    for plane, out in zip(np.moveaxis(image, -1, 0).reshape(channels, -1), result, strict=True):
        # "wrap" makes NumPy write straight into the result. No index is outside.
        for indices, pixels in zip(corners, (out, other, low, low_other), strict=True):
            plane.take(indices, out=pixels, mode="wrap")
        for start, end, share in ((out, other, right), (low, low_other, right), (out, low, down)):
            end -= start
            end *= share
            start += end
    return np.moveaxis(result, 0, -1)


def sample_cubic(
    images: Sequence[Array],
    positions: Callable[[slice], tuple[Array, Array]],
    size: tuple[int, int],
    valid: Mask,
) -> list[Array]:
    """Sample images by Keys' cubic, within the range of the four nearest pixels. The edge pixel is repeated outside.

    Args:
        images: (h, w, c) each, of one size.
        positions: takes rows of the result, and returns x and y (n, width of the result) in pixels of the images.
        size: height and width of the result.
        valid: (height, width), where the result is needed.

    Returns:
        (*size, c) each, with channels that are contiguous in memory.
    """
    rows_in, columns_in = images[0].shape[:2]
    counts = [image.shape[-1] for image in images]
    padded = np.empty((sum(counts), rows_in + 4, columns_in + 4), np.float32)
    for target, image in zip(np.split(padded, np.cumsum(counts)[:-1]), images, strict=True):
        target[:, 2:-2, 2:-2] = np.moveaxis(image, -1, 0)
    padded[:, :2, 2:-2], padded[:, -2:, 2:-2] = padded[:, 2:3, 2:-2], padded[:, -3:-2, 2:-2]
    padded[..., :2], padded[..., -2:] = padded[..., 2:3], padded[..., -3:-2]
    planes = padded.reshape(len(padded), -1)
    constant = [plane.min() == plane.max() for plane in planes]
    stride = columns_in + 4
    height, width = size
    result = np.empty((len(padded), height, width), np.float32)

    def work(rows: slice) -> None:
        x, y = positions(rows)
        x = np.clip(x, -1, columns_in - 0.01)
        y = np.clip(y, -1, rows_in - 0.01)
        left, top = np.floor(x), np.floor(y)
        # The pixel above and to the left of the four nearest pixels.
        first = (top.astype(np.intp) + 1) * stride + left.astype(np.intp) + 1
        right, down = x - left, y - top
        between = valid[rows] & ((right != 0) | (down != 0))
        chosen: NDArray[np.intp] | None = None
        if np.count_nonzero(between) < MOST_CHOSEN * between.size:
            chosen, pixel = np.flatnonzero(between), first + (stride + 1)
            right, down, first = right.take(chosen), down.take(chosen), first.take(chosen)
        cubic = _Cubic(right, down, first, stride)
        for plane, is_constant, out in zip(planes, constant, result[:, rows], strict=True):
            if is_constant:
                out[:] = plane[0]
            elif chosen is None:
                cubic.sample(plane, out)
            else:
                # "wrap" makes NumPy write straight into the result. No index is outside.
                plane.take(pixel, out=out, mode="wrap")
                out.reshape(-1)[chosen] = cubic.sample(plane, np.empty(chosen.shape, np.float32))

    for_row_blocks(work, height, 2 * width)  # the dozen arrays of a block then nearly fit into a core's cache
    return [np.moveaxis(part, 0, -1) for part in np.split(result, np.cumsum(counts)[:-1])]


class _Cubic:
    """Keys' cubic at positions that lie ``right`` and ``down`` (0 to 1) beyond a pixel.

    ``first`` are the flat indices of the pixels above and to the left of that one, in planes of rows of ``stride``
    pixels.
    """

    def __init__(self, right: Array, down: Array, first: NDArray[np.intp], stride: int) -> None:
        self._across, self._down, self._first, self._stride = _keys(right), _keys(down), first, stride
        self._buffers = np.empty((4, *first.shape), np.float32)

    def sample(self, plane: Array, out: Array) -> Array:
        """Fill ``out`` with the samples of a plane (n), and return it."""
        line, low, high, values = self._buffers
        # NumPy's settings for errors belong to the thread. The caller handles values that are not finite.
        with np.errstate(over="ignore", invalid="ignore"):
            for i, weight_y in enumerate(self._down):
                for j, weight_x in enumerate(self._across):
                    pixels = values if j else line
                    plane[i * self._stride + j :].take(self._first, out=pixels, mode="wrap")
                    if (i, j) == (1, 1):
                        low[:] = high[:] = pixels
                    elif {i, j} <= {1, 2}:
                        np.minimum(low, pixels, out=low)
                        np.maximum(high, pixels, out=high)
                    pixels *= weight_x
                    if j:
                        line += pixels
                if i:
                    line *= weight_y
                    out += line
                else:
                    np.multiply(line, weight_y, out=out)
            return np.clip(out, low, high, out=out)


def _keys(t: Array) -> list[Array]:
    """Return the weights of the four pixels around a position that lies ``t`` beyond the second one (Keys 1981)."""
    a = np.float32(SHARPNESS)
    near = [((a + 2) * d - (a + 3)) * d * d + 1 for d in (t, 1 - t)]
    far = [((a * d - 5 * a) * d + 8 * a) * d - 4 * a for d in (1 + t, 2 - t)]
    return [far[0], near[0], near[1], far[1]]
