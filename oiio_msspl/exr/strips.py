# SPDX-License-Identifier: Apache-2.0
"""Cache strips: decoded rows, as wide as the part that stores them.

An EXR of scan lines can only be decoded in full rows. Tiles are narrower than the frame, so the tiles of one row of
tiles share strips. A cache keeps them from one tile to the next.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.image.arrays import blank, unload

#: Rows of a strip, which is at least one chunk. OpenImageIO decodes chunks in parallel; one chunk has 16 rows for ZIP,
#: 32 for PIZ and DWAA, 256 for DWAB.
ROWS_PER_STRIP = 64
#: Bytes of a strip with all channels of its part, unless a single chunk has more.
LARGEST_STRIP = 64 << 20
#: Fewer bytes of a strip are not put into a temporary file.
SMALLEST_FILE = 1 << 20


class StripKey(NamedTuple):
    """The channels, by their indices in the part, and the rows that a strip holds; ``last`` is exclusive."""

    path: Path
    part: int
    channels: tuple[int, ...]
    first: int
    last: int


@dataclass
class StripCache:
    """Decoded strips, up to a number of bytes.

    A strip is kept until a read needs other rows. One that does not fit is not kept: every tile decodes it again.
    """

    max_bytes: int = 0
    """Bytes that the strips may take together. With 0, nothing is kept."""
    _in_memory: dict[StripKey, NDArray[Any]] = field(default_factory=dict, repr=False)
    _spilled: dict[StripKey, NDArray[Any]] = field(default_factory=dict, repr=False)
    """Strips in temporary files, and small ones that do not count."""

    @property
    def bytes(self) -> int:
        """Bytes that the strips take in memory at the moment."""
        return sum(strip.nbytes for strip in self._in_memory.values())

    def get(self, key: StripKey) -> NDArray[Any] | None:
        """Return the strip, or None if it is not kept."""
        return self._in_memory.get(key)

    def pop(self, key: StripKey) -> NDArray[Any] | None:
        """Return the strip and forget it, or return None if it is not kept."""
        return (self._in_memory if key in self._in_memory else self._spilled).pop(key, None)

    def keep(self, key: StripKey, strip: NDArray[Any], *, copy: bool = False) -> bool:
        """Keep a strip, or a copy of it, if there is room; return whether there was."""
        if has_room := self.bytes + strip.nbytes <= self.max_bytes:
            self._in_memory[key] = strip.copy() if copy else strip
        return has_room

    def keep_all(self, parts: Mapping[StripKey, NDArray[Any]]) -> None:
        """Keep copies of parts of a strip; those without room in one temporary file, or in memory if they are small.

        Raises:
            MssplError: the disk has no room.
        """
        spilled = {key: part for key, part in parts.items() if not self.keep(key, part, copy=True)}
        if sum(part.nbytes for part in spilled.values()) < SMALLEST_FILE:
            self._spilled |= {key: part.copy() for key, part in spilled.items()}
            return
        ends = np.cumsum([part.size for part in spilled.values()])
        block = blank((int(ends[-1]),), next(iter(spilled.values())).dtype, on_disk=True)
        for (key, part), flat in zip(spilled.items(), np.split(block, ends[:-1]), strict=True):
            self._spilled[key] = flat.reshape(part.shape)
            self._spilled[key][:] = part
        unload(block)

    def drop_outside(self, first: int, last: int) -> None:
        """Forget the strips that have none of the rows from ``first`` to ``last`` (exclusive)."""
        for key in [*self._in_memory, *self._spilled]:
            if key.last <= first or key.first >= last:
                self.pop(key)

    def clear(self) -> None:
        """Forget all strips."""
        self._in_memory.clear()
        self._spilled.clear()


def strip_rows(start: int, stop: int, origin: int, height: int, end: int) -> Iterator[tuple[int, int]]:
    """Yield the rows (first, last exclusive) of the strips that cover rows ``start`` to ``stop`` (exclusive).

    Strips begin on multiples of ``height`` rows below ``origin``, the part's first row, so that they hold whole chunks.
    The last one ends at ``end``, the part's last row (exclusive).
    """
    for first in range(origin + (start - origin) // height * height, stop, height):
        yield first, min(first + height, end)
