# SPDX-License-Identifier: Apache-2.0
"""Cache strips: decoded rows, as wide as the part that stores them.

An EXR of scan lines can only be decoded in full rows. Tiles are narrower than the frame, so the tiles of one row of
tiles share strips. A cache keeps them from one tile to the next.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

#: Rows of a strip, which is at least one chunk. OpenImageIO decodes chunks in parallel; one chunk has 16 rows for ZIP,
#: 32 for PIZ and DWAA, 256 for DWAB.
ROWS_PER_STRIP = 64
#: Bytes of a strip with all channels of its part, unless a single chunk has more.
LARGEST_STRIP = 64 << 20


class StripKey(NamedTuple):
    """The channels, by their indices in the part, and the rows that a strip holds; ``last`` is exclusive."""

    path: Path
    part: int
    channels: tuple[int, ...]
    first: int
    last: int


class StripCache(dict[StripKey, NDArray[Any]]):
    """Decoded strips, up to a number of bytes.

    A strip is kept until a read needs other rows. One that does not fit is not kept: every tile decodes it again.
    """

    max_bytes = 0
    """Bytes that the strips may take together. With 0, nothing is kept."""

    def keep(self, key: StripKey, strip: NDArray[Any]) -> None:
        """Keep a strip if there is room."""
        if sum(kept.nbytes for kept in self.values()) + strip.nbytes <= self.max_bytes:
            self[key] = strip

    def drop_outside(self, first: int, last: int) -> None:
        """Forget the strips that have none of the rows from ``first`` to ``last`` (exclusive)."""
        for key in [key for key in self if key.last <= first or key.first >= last]:
            del self[key]


def strip_rows(start: int, stop: int, origin: int, height: int, end: int) -> Iterator[tuple[int, int]]:
    """Yield the rows (first, last exclusive) of the strips that cover rows ``start`` to ``stop`` (exclusive).

    Strips begin on multiples of ``height`` rows below ``origin``, the part's first row, so that they hold whole chunks.
    The last one ends at ``end``, the part's last row (exclusive).
    """
    for first in range(origin + (start - origin) // height * height, stop, height):
        yield first, min(first + height, end)
