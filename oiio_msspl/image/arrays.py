# SPDX-License-Identifier: Apache-2.0
"""Images as float32 arrays (height, width, channels): where they are stored, and how bad values are repaired."""

from __future__ import annotations

import errno
import math
import mmap
import os
import tempfile
from collections.abc import Callable
from typing import IO, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.errors import MssplError
from oiio_msspl.image.parallel import for_row_blocks

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

#: Largest finite values of half and of float.
HALF_MAX, FLOAT_MAX = 65504.0, float(np.finfo(np.float32).max)
#: An image that waits for other images lies in a temporary file if it has more pixels than this.
MOST_PIXELS = 1_000_000

#: A quantile is computed from at most about this many values.
LARGE_SAMPLE = 1 << 20

T = TypeVar("T", bound=np.generic)


def quantile(values: NDArray[Any], fraction: float) -> float:
    """Return a quantile of values (n,); of evenly spaced ones if there are more than ``LARGE_SAMPLE``."""
    return float(np.quantile(values[:: -(-values.size // LARGE_SAMPLE)], fraction))


def has_many_pixels(height: int, width: int) -> bool:
    """Return whether an image of this size lies in a temporary file while it waits for other images."""
    return height * width > MOST_PIXELS


def blank(
    shape: tuple[int, ...],
    dtype: type[T] | np.dtype[T] = np.float32,  # type: ignore[assignment]
    *,
    on_disk: bool | None = None,
    interleaved: bool = False,
) -> NDArray[T]:
    """Return a black image (h, w, ...), in memory or in a temporary file.

    Args:
        on_disk: True for a temporary file, False for memory, None to decide by :func:`has_many_pixels`.
        interleaved: store the channels of a pixel beside each other. Otherwise each channel is contiguous, as networks
            read it, and NumPy is several times as fast, because a row has more values than a pixel.

    Raises:
        MssplError: the disk has no room.
    """
    channels_first = len(shape) > 2 and not interleaved
    stored = (*shape[2:], *shape[:2]) if channels_first else shape
    if has_many_pixels(*shape[:2]) if on_disk is None else on_disk:
        with tempfile.TemporaryFile(prefix="msspl-") as file:
            reserve(file, math.prod(shape) * np.dtype(dtype).itemsize)
            # NumPy takes longer for parts of a memmap than for those of a plain array.
            image: NDArray[T] = np.asarray(np.memmap(file, dtype, "r+", shape=stored))
    else:
        image = np.zeros(stored, dtype)
    return np.moveaxis(image, (-2, -1), (0, 1)) if channels_first else image


def reserve(file: IO[bytes], size: int) -> None:
    """Make a temporary file at least ``size`` bytes large, and reserve them on the disk.

    Otherwise a full disk would end the process when pixels are written into a file that is mapped into memory.
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


def kept(values: NDArray[T], *, on_disk: bool | None = None) -> NDArray[T]:
    """Return an image that waits for other images: itself, or a copy in a file if :func:`blank` would use one."""
    if not (has_many_pixels(*values.shape[:2]) if on_disk is None else on_disk) or file_of(values) is not None:
        return values
    copy = blank(values.shape, values.dtype, on_disk=True, interleaved=values.strides[-1] == values.itemsize)
    copy[:] = values
    unload(copy)
    return copy


def unload(values: NDArray[Any]) -> None:
    """Give the memory of an image in a temporary file back to the system; an image in memory is left alone."""
    file = file_of(values)
    if file is not None and hasattr(mmap, "MADV_DONTNEED"):  # not on Windows
        file.madvise(mmap.MADV_DONTNEED)


def file_of(values: NDArray[Any]) -> mmap.mmap | None:
    """Return the temporary file of an image, or of the image that it is a part of; None if it is in memory."""
    owner = values.base
    while isinstance(owner, np.ndarray):
        owner = owner.base
    return owner if isinstance(owner, mmap.mmap) else None


def map_rows(function: Callable[[Array], object], source: Array) -> Array:
    """Return a float32 copy of an image (height, ...), whose blocks of rows ``function`` has changed in place."""
    result = np.empty(source.shape, np.float32)

    def work(rows: slice) -> None:
        block = np.array(source[rows], np.float32)
        function(block)
        result[rows] = block

    for_row_blocks(work, len(result), result[0].size if len(result) else 0)
    return result


def all_finite(values: Array) -> bool:
    """Return whether no value is NaN or infinite; perhaps False where the sum overflows."""
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.isfinite(values.sum()))  # ten times as fast as a test of each


def finite(values: Array) -> Array:
    """Return values with 0 in place of NaN and infinities; the input itself if there are none."""
    return values if all_finite(values) else np.where(np.isfinite(values), values, np.float32(0))


def repair(values: Array, *, signed: bool = False) -> tuple[Array, NDArray[np.bool_] | None]:
    """Replace NaN by 0, infinities by the largest half float and, unless ``signed``, negative values by 0.

    Infinity becomes the value at which the network clips.

    Returns:
        The repaired values and a mask of the changed ones; the input itself and None if none was changed.
    """
    bounds = (values.min(), values.max()) if values.size else (0, 0)
    if np.isfinite(bounds).all() and (signed or bounds[0] >= 0):
        return values, None
    bad = ~np.isfinite(values)
    if not signed:
        bad |= values < 0
    fixed = np.nan_to_num(values, nan=0.0, posinf=HALF_MAX, neginf=-HALF_MAX if signed else 0.0)
    return (fixed if signed else np.maximum(fixed, 0.0)).astype(np.float32), bad


def planes_of(image: Array) -> Array:
    """Return an image (h, w, c) as contiguous planes (c, h, w)."""
    return np.ascontiguousarray(np.moveaxis(image, -1, 0))


def in_planes(image: Array) -> Array:
    """Return an image (h, w, c) with channels that are contiguous in memory."""
    return np.moveaxis(planes_of(image), 0, -1)
