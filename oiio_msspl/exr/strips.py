# SPDX-License-Identifier: Apache-2.0
"""Strips: decoded rows, as wide as the part that stores them.

An EXR of scan lines can only be decoded in full rows. Tiles are narrower than the frame, so the tiles of one row of
tiles share strips. A cache keeps them from one tile to the next.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

#: Rows of a strip, which is at least one chunk. OpenImageIO decodes chunks in parallel; one chunk has 16 rows for ZIP,
#: 32 for PIZ and DWAA, 256 for DWAB.
ROWS_PER_STRIP = 64


class StripKey(NamedTuple):
    """What a strip holds."""

    path: Path
    part: int
    channels: tuple[int, ...]
    """Indices of the channels in the part."""
    first: int
    """First row."""
    last: int
    """Last row, exclusive."""


@dataclass
class StripCache:
    """Strips that were decoded, up to a number of bytes.

    Tiles are read row by row of tiles, and all tiles of such a row need the same strips. So a strip is kept until a
    read needs other rows. A strip that does not fit any more is not kept: each tile then decodes only these again.
    """

    max_bytes: int = 0
    """Bytes that the strips may take together. With 0, nothing is kept."""
    _strips: dict[StripKey, NDArray[Any]] = field(default_factory=dict, repr=False)

    @property
    def bytes(self) -> int:
        """Bytes that the strips take at the moment."""
        return sum(strip.nbytes for strip in self._strips.values())

    def get(self, key: StripKey) -> NDArray[Any] | None:
        """The strip, if it is kept."""
        return self._strips.get(key)

    def pop(self, key: StripKey) -> NDArray[Any] | None:
        """The strip, if it is kept, and forget it."""
        return self._strips.pop(key, None)

    def keep(self, key: StripKey, strip: NDArray[Any]) -> None:
        """Keep a strip if there is room."""
        if self.bytes + strip.nbytes <= self.max_bytes:
            self._strips[key] = strip

    def drop_outside(self, first: int, last: int) -> None:
        """Forget the strips that have none of the rows from ``first`` to ``last`` (exclusive)."""
        for key in [key for key in self._strips if key.last <= first or key.first >= last]:
            del self._strips[key]

    def clear(self) -> None:
        """Forget all strips."""
        self._strips.clear()


def strip_rows(start: int, stop: int, origin: int, height: int, end: int) -> Iterator[tuple[int, int]]:
    """Rows (first, last exclusive) of the strips that cover the rows from ``start`` to ``stop`` (exclusive).

    Strips begin on multiples of ``height`` rows below ``origin``, the part's first row, so that they hold whole chunks.
    The last one ends at ``end``, the part's last row (exclusive).
    """
    for first in range(origin + (start - origin) // height * height, stop, height):
        yield first, min(first + height, end)
