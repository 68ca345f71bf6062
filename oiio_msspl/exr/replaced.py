# SPDX-License-Identifier: Apache-2.0
"""Store pixels that replace channels of the HRLS in the fused file."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.exr.reader import Channel
from oiio_msspl.image.arrays import FLOAT_MAX, HALF_MAX, Array, reserve

#: NumPy's type of each pixel type.
DTYPES: dict[str, Any] = {"half": np.float16, "float": np.float32, "uint": np.uint32}


class ReplacedChannels:
    """New pixels for some channels, in their stored types.

    They are kept in a temporary file, because forty channels of an 8K frame take gigabytes. The system deletes the file
    with the process, even a killed one. The variable ``TMPDIR`` says where it lies.
    """

    def __init__(self) -> None:
        self._places: dict[Channel, tuple[int, int]] = {}
        """Offset in the file and width of every channel."""
        self._size = 0
        self._file = tempfile.TemporaryFile(prefix="msspl-")  # noqa: SIM115 - it lives as long as this object

    def add(self, channels: Sequence[Channel], width: int, height: int) -> None:
        """Make room for channels of ``width`` x ``height`` pixels; a channel that has room keeps it.

        Raises:
            MssplError: the disk has no room.
        """
        for channel in channels:
            if channel not in self._places:
                self._places[channel] = self._size, width
                self._size += width * height * np.dtype(DTYPES[channel.type]).itemsize
        reserve(self._file, self._size)

    def __contains__(self, channel: Channel) -> bool:
        return channel in self._places

    def put(self, channel: Channel, start: int, rows: Array) -> int:
        """Store rows (n, width) of a channel from row ``start`` on; values too bright for its type are clipped.

        Returns:
            The number of values that were too bright.
        """
        largest = HALF_MAX if channel.type == "half" else FLOAT_MAX
        stored = np.clip(rows, -largest, largest).astype(DTYPES[channel.type])
        self._seek(channel, start)
        self._file.write(stored.tobytes())
        return int(np.count_nonzero(rows > largest)) if rows.size and rows.max() > largest else 0

    def get(self, channel: Channel, start: int, stop: int) -> NDArray[Any]:
        """Return rows of a channel, (stop - start, width)."""
        dtype = np.dtype(DTYPES[channel.type])
        width = self._seek(channel, start)
        data = self._file.read((stop - start) * width * dtype.itemsize)
        return np.frombuffer(data, dtype).reshape(stop - start, width)

    def apply(self, channels: Sequence[Channel], start: int, pixels: NDArray[Any]) -> NDArray[Any]:
        """Return a copy of rows (n, width, channels) from row ``start`` on, with the new pixels in it."""
        if not any(channel in self for channel in channels):
            return pixels
        pixels = pixels.copy()
        for i, channel in enumerate(channels):
            if channel in self:
                pixels[..., i] = self.get(channel, start, start + len(pixels))
        return pixels

    def _seek(self, channel: Channel, row: int) -> int:
        """Go to a row of a channel, and return the channel's width."""
        offset, width = self._places[channel]
        self._file.seek(offset + row * width * np.dtype(DTYPES[channel.type]).itemsize)
        return width
