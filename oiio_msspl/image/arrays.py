# SPDX-License-Identifier: Apache-2.0
"""Images as float32 arrays (height, width, channels), and operations on them that use all cores."""

from __future__ import annotations

import errno
import math
import mmap
import os
import tempfile
from collections.abc import Callable, Sequence
from functools import reduce
from typing import IO, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.errors import MssplError
from oiio_msspl.image.parallel import for_row_blocks

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

#: Largest finite values of half and of float.
HALF_MAX, FLOAT_MAX = 65504.0, float(np.finfo(np.float32).max)
#: Images of more pixels that wait for others are kept in temporary files.
MOST_PIXELS = 1_000_000

#: Values that tell a quantile of a frame well enough.
LARGE_SAMPLE = 1 << 20

T = TypeVar("T", bound=np.generic)


def quantile(values: NDArray[Any], share: float) -> float:
    """A quantile of values (n,), of evenly spaced ones if there are many."""
    return float(np.quantile(values[:: -(-values.size // LARGE_SAMPLE)], share))


def has_many_pixels(height: int, width: int) -> bool:
    """Whether an image that waits for others does so in a temporary file."""
    return height * width > MOST_PIXELS


def blank(
    shape: tuple[int, ...],
    dtype: type[T] | np.dtype[T] = np.float32,  # type: ignore[assignment]
    *,
    on_disk: bool | None = None,
    interleaved: bool = False,
) -> NDArray[T]:
    """A black image (h, w, ...) that is to be filled: in memory, or in a temporary file if it has many pixels.

    Args:
        on_disk: whether it is in a temporary file; None if its pixels decide.
        interleaved: the channels of a pixel lie beside each other in memory. Otherwise each channel is contiguous, as
            networks want it. NumPy is several times as fast then, because a row is longer than the list of channels.

    Raises:
        MssplError: the disk has no room.
    """
    channels_first = len(shape) > 2 and not interleaved
    stored = (*shape[2:], *shape[:2]) if channels_first else shape
    if has_many_pixels(*shape[:2]) if on_disk is None else on_disk:
        with tempfile.TemporaryFile(prefix="msspl-") as file:
            reserve(file, math.prod(shape) * np.dtype(dtype).itemsize)
            image: NDArray[T] = np.memmap(file, dtype, "r+", shape=stored)
    else:
        image = np.zeros(stored, dtype)
    return np.moveaxis(image, (-2, -1), (0, 1)) if channels_first else image


def reserve(file: IO[bytes], size: int) -> None:
    """Make a temporary file at least so large, and take the room for that on the disk.

    Otherwise, a disk that becomes full would end the process as soon as pixels are put into a file in memory.

    Raises:
        MssplError: the disk has no room.
    """
    try:
        if size and hasattr(os, "posix_fallocate"):  # not on macOS and Windows
            os.posix_fallocate(file.fileno(), 0, size)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise MssplError(
                f"{tempfile.gettempdir()}: no room for {size / 1e6:.0f} MB of temporary files ({error.strerror}); "
                "free some, or name another folder in the variable TMPDIR"
            ) from error
    if os.fstat(file.fileno()).st_size < size:
        file.truncate(size)


def planes(like: Array, channels: int) -> Array:
    """An image (h, w, channels), as high and wide as another, that is to be filled. Each channel is contiguous in
    memory, as ONNX Runtime wants it."""
    return np.empty((channels, *like.shape[:2]), np.float32).transpose(1, 2, 0)


def kept(values: NDArray[T], *, on_disk: bool | None = None) -> NDArray[T]:
    """An image that waits for others: itself, or a copy in a temporary file if it has many pixels and is in none.

    Args:
        on_disk: whether it is in a temporary file; None if its pixels decide.
    """
    if not (has_many_pixels(*values.shape[:2]) if on_disk is None else on_disk) or _file_of(values) is not None:
        return values
    copy = blank(values.shape, values.dtype, on_disk=True, interleaved=values.strides[-1] == values.itemsize)
    copy[:] = values
    unload(copy)
    return copy


def unload(values: NDArray[Any]) -> None:
    """Give the memory of an image in a temporary file, or of a part of it, back to the system. Its pixels stay in the
    file."""
    file = _file_of(values)
    if file is not None and hasattr(mmap, "MADV_DONTNEED"):  # not on Windows
        file.madvise(mmap.MADV_DONTNEED)


def _file_of(values: NDArray[Any]) -> mmap.mmap | None:
    """The temporary file in which an image, or a part of it, is; None if it is in memory."""
    owner = values.base
    while isinstance(owner, np.ndarray):
        owner = owner.base
    return owner if isinstance(owner, mmap.mmap) else None


def map_rows(function: Callable[[Array], object], source: Array, out: Array | None = None) -> Array:
    """Apply an in-place, per-value function to a float32 copy of an image.

    Args:
        function: changes the block of rows that it is given, in place.
        source: (height, ...).
        out: where to put the result; a new array if None.

    Returns:
        The result, of the shape of ``source``.
    """
    result = np.empty(np.shape(source), np.float32) if out is None else out

    def work(rows: slice) -> None:
        # The copy keeps the memory layout of the source, whatever that of the result is.
        block = np.array(source[rows], np.float32)
        function(block)
        result[rows] = block

    for_row_blocks(work, len(result), result[0].size if len(result) else 0)
    return result


def clip(values: Array, lowest: float, highest: float, out: Array | None = None) -> Array:
    """``np.clip`` on all cores."""
    return map_rows(lambda block: np.clip(block, lowest, highest, out=block), values, out)


def repair(values: Array, *, signed: bool = False) -> tuple[Array, NDArray[np.bool_] | None]:
    """Replace NaN by 0, infinities by the largest half float and, unless ``signed``, negative values by 0.

    An infinite pixel is bright in practice, and the network clips at that value anyway.

    Returns:
        The repaired values and a mask of what was changed; the input itself and None if nothing was.
    """
    bounds: list[tuple[Any, Any]] = []

    def work(rows: slice) -> None:
        block = values[rows]
        bounds.append((block.min(), block.max()))

    if values.size:
        for_row_blocks(work, len(values), values[0].size)
        if np.isfinite(bounds).all() and (signed or min(bounds)[0] >= 0):
            return values, None
    bad = ~np.isfinite(values)
    if not signed:
        bad |= values < 0
    fixed = np.nan_to_num(values, nan=0.0, posinf=HALF_MAX, neginf=-HALF_MAX if signed else 0.0)
    return (fixed if signed else np.maximum(fixed, 0.0)).astype(np.float32), bad


def box_downsample(image: NDArray[Any], scale: int) -> Array:
    """Mean over ``scale`` x ``scale`` pixels, of half or float: (H, W, ...) to (H/s, W/s, ...).

    It is finite if the pixels are.
    """
    height, width, *channels = image.shape
    # In the same layout in memory.
    result = np.empty_like(image, np.float32, subok=False, shape=(height // scale, width // scale, *channels))

    def work(rows: slice) -> None:
        # Sums of strided views are ten times as fast as np.mean over short axes. Sums of half floats would be rounded.
        block = image[rows].astype(np.float32, copy=False)
        with np.errstate(over="ignore"):
            row_sums = reduce(np.add, (block[y::scale] for y in range(scale)))
            sums = reduce(np.add, (row_sums[:, x::scale] for x in range(scale)))
        np.clip(sums, -FLOAT_MAX, FLOAT_MAX, out=sums)
        np.multiply(sums, np.float32(1 / scale**2), out=result[rows.start // scale : rows.stop // scale])

    for_row_blocks(work, height, image[0].size, multiple=scale)
    return result


def interpolate(values: Array, positions: NDArray[np.float64], axis: int) -> Array:
    """Sample an image along one axis at fractional pixel positions, linearly; the edge pixel is repeated outside.

    Args:
        values: (height, width, ...).
        positions: pixel indices along ``axis``, one for each pixel of the result.

    Returns:
        The samples; the image itself if they are all its pixels.
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
    """An image (h, w, c), interpolated linearly at ``scale`` times its resolution."""
    rows = slice(0, len(image))
    return np.stack([upsample_linear(plane, scale, rows) for plane in planes_of(image)], axis=-1)


def filled(image: Array, missing: NDArray[np.bool_]) -> Array:
    """Fill missing pixels (h, w) of a finite image (h, w, c) from those around.

    They are taken from the image at half the size, in which the pixels that are still missing are filled likewise
    (push-pull, Gortler et al. 1996, *The Lumigraph*). An image without any pixel stays as it is.
    """
    if missing.all() or not missing.any():
        return image
    margins = [(0, side % 2) for side in missing.shape]
    known = np.pad(~missing, margins)[..., None]
    shares = box_downsample(known.astype(np.float32), 2)
    sums = box_downsample(np.pad(image, [*margins, (0, 0)]) * known, 2)
    half = np.divide(sums, shares, out=np.zeros_like(sums), where=shares > 0)
    half = filled(half, shares[..., 0] == 0)
    around = enlarged(half, 2)[: len(image), : image.shape[1]]
    return np.where(missing[..., None], around, image)


def upsample_linear(plane: Array, scale: int, rows: slice) -> Array:
    """Interpolate a plane linearly at ``scale`` times its resolution; only these of its rows, in its own pixels."""
    padded = np.pad(plane, ((1, 1), (0, 0)), mode="edge")
    tall = np.empty(((rows.stop - rows.start) * scale, plane.shape[1]), np.float32)
    before, here, after = (padded[rows.start + i : rows.stop + i] for i in range(3))
    _interleave(before, here, after, [tall[phase::scale] for phase in range(scale)])
    padded = np.pad(tall, ((0, 0), (1, 1)), mode="edge")
    result = np.empty((len(tall), plane.shape[1] * scale), np.float32)
    before, here, after = (padded[:, i : i + plane.shape[1]] for i in range(3))
    _interleave(before, here, after, [result[:, phase::scale] for phase in range(scale)])
    return result


def _interleave(before: Array, here: Array, after: Array, phases: Sequence[Array]) -> None:
    """Fill the lines of an enlarged plane that lie in the lines ``here``, from first to last."""
    for phase, lines in enumerate(phases):
        position = (phase + 0.5) / len(phases) - 0.5
        other = before if position < 0 else after
        lines[:] = here + np.float32(abs(position)) * (other - here)


def planes_of(image: Array) -> Array:
    """(h, w, c) as (c, h, w), each plane contiguous."""
    return np.ascontiguousarray(np.moveaxis(image, -1, 0))
