# SPDX-License-Identifier: Apache-2.0
"""Store pixels that replace channels of the HRLS in the fused file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.exr.reader import DTYPES, Channel
from oiio_msspl.image.arrays import FLOAT_MAX, HALF_MAX, Array, blank, unload


class ReplacedChannels:
    """New pixels for some channels, in their stored types.

    They are kept in temporary files, because forty channels of an 8K frame take gigabytes. The system deletes the files
    with the process, even a killed one. The variable ``TMPDIR`` says where they lie.
    """

    def __init__(self) -> None:
        self.planes: dict[Channel, NDArray[Any]] = {}
        """(height, width) each."""

    def add(self, channels: Sequence[Channel], width: int, height: int) -> None:
        """Make room for channels of ``width`` x ``height`` pixels; a channel that has room keeps it.

        Raises:
            MssplError: the disk has no room.
        """
        for kind, dtype in DTYPES.items():  # one file for all channels of a type
            new = [c for c in dict.fromkeys(channels) if c not in self.planes and c.type == kind]
            if new:
                planes = np.moveaxis(blank((height, width, len(new)), dtype, on_disk=True), -1, 0)
                self.planes |= zip(new, planes, strict=True)

    def put(self, channel: Channel, start: int, rows: Array) -> int:
        """Store rows (n, width) of a channel from row ``start`` on; values too bright for its type are clipped.

        Returns:
            The number of values that were too bright.
        """
        largest = HALF_MAX if channel.type == "half" else FLOAT_MAX
        plane = self.planes[channel]
        plane[start : start + len(rows)] = np.clip(rows, -largest, largest)
        unload(plane)
        return int(np.count_nonzero(rows > largest)) if rows.size and rows.max() > largest else 0
