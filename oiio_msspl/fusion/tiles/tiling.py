# SPDX-License-Identifier: Apache-2.0
"""Cuts a frame into overlapping tiles, so that memory depends on the tile and not on the frame.

The tiles depend on the model and on the size of the frame, and those of a pass on where it has light, but never on
memory. A network sees only a part of the frame in each tile, so other tiles would give slightly other pixels. Frames of
one shot must not differ because machines have more or less memory.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from oiio_msspl.errors import InputError
from oiio_msspl.exr.render import Window
from oiio_msspl.model.contract import Contract

#: Memory that a run may use by default.
MAX_MEMORY = 3 << 30
#: Memory that does not grow with the frame: interpreter, libraries, weights.
FIXED_MEMORY = 350 << 20
#: Share of the memory for decoded rows that neighbouring tiles read. ``bytes_per_pixel`` of a model leaves room for it.
STRIPS_SHARE = 1 / 6
#: Memory of a tile. It is as large as ``MAX_MEMORY`` allows beside an 8K frame. Other tiles give other pixels, so this
#: does not depend on what the user allows.
TILE_MEMORY = 1720 << 20
#: Bands of rows that :func:`sample_bands` spreads over a frame.
SAMPLE_BANDS = 8


@dataclass(frozen=True)
class Tile:
    """Two windows in LRHS pixels; ``core`` is inside ``area``."""

    core: Window
    """The pixels that the tile contributes to the frame. The cores cover the grid, or a part of it, once."""
    area: Window
    """The pixels that the network reads: the core plus the overlap, cut at the borders of the grid."""


def aligned_grid(grid: Window, alignment: int) -> Window:
    """Extend ``grid`` to the right and to the bottom until its sides are multiples of ``alignment``."""
    width, height = (-(-side // alignment) * alignment for side in (grid.width, grid.height))
    return Window(grid.x0, grid.y0, grid.x0 + width, grid.y0 + height)


def plan_tiles(grid: Window, contract: Contract, part: Window | None = None) -> list[Tile]:
    """Cover ``grid`` by tiles of at most ``TILE_MEMORY``, row by row, so that the network computes the fewest pixels.

    There is no overlap at the borders of the grid: the network sees the end of the picture there, as in training.
    The offsets of all tiles are multiples of the contract's alignment, so that a network that works on blocks of
    pixels divides a tile as it divides the frame.

    Args:
        part: the part of the grid that is to be covered, which the tiles may exceed; None for all of it.
    """
    alignment = contract.alignment
    overlap = -(-contract.overlap // alignment) * alignment
    largest = TILE_MEMORY // (contract.bytes_per_pixel * contract.scale**2)
    part = grid if part is None else _aligned_part(part, grid, alignment)
    # The fewest pixels that are computed, in the fewest tiles; where even the smallest tile is too large, that one.
    columns, rows = min(
        itertools.product(
            _splits((part.x0, part.x1), (grid.x0, grid.x1), overlap, alignment),
            _splits((part.y0, part.y1), (grid.y0, grid.y1), overlap, alignment),
        ),
        key=lambda split: (
            max(1.0, split[0].largest * split[1].largest / largest),
            split[0].computed * split[1].computed,
            len(split[0].cores) * len(split[1].cores),
        ),
    )
    return [
        Tile(Window(x0, y0, x1, y1), Window(x0 - overlap, y0 - overlap, x1 + overlap, y1 + overlap).intersect(grid))
        for y0, y1 in rows.cores
        for x0, x1 in columns.cores
    ]


def _aligned_part(part: Window, grid: Window, alignment: int) -> Window:
    """Extend a part of a grid until its offset in the grid and its size are multiples of ``alignment``, or it ends with
    the grid."""
    x0, y0 = (
        (start - first) // alignment * alignment + first for start, first in ((part.x0, grid.x0), (part.y0, grid.y0))
    )
    x1, y1 = (start - (start - end) // alignment * alignment for start, end in ((x0, part.x1), (y0, part.y1)))
    return Window(x0, y0, x1, y1).intersect(grid)


def sample_bands(grid: Window, scale: int) -> list[Window]:
    """Bands of rows, evenly spread over ``grid``, from which the whole frame is judged before its tiles are read.

    They are as wide as the grid, because EXR files store whole rows, often in blocks of 16.
    """
    rows = min(max(16 // scale, 4), grid.height)
    last = grid.height // rows - 1
    tops = sorted({grid.y0 + last * i // (SAMPLE_BANDS - 1) * rows for i in range(SAMPLE_BANDS)})
    return [Window(grid.x0, top, grid.x1, top + rows) for top in tops]


def memory_for_tiles(contract: Contract, tiles: Sequence[Tile], frame_bytes: int) -> int:
    """Memory of a process that fuses a frame in these tiles.

    Args:
        frame_bytes: memory for the whole frame: the result, the LRHS, and what the caller holds.
    """
    pixels = max(tile.area.width * tile.area.height for tile in tiles) * contract.scale**2
    return FIXED_MEMORY + frame_bytes + pixels * contract.bytes_per_pixel


def strips_memory(max_memory: int, held: int) -> int:
    """Bytes for decoded rows that neighbouring tiles or bands read, beside ``held`` bytes."""
    return max(0, int((max_memory - held) * STRIPS_SHARE))


def require_memory(needed: int, contract: Contract, max_memory: int, hint: str = "") -> None:
    """Raise InputError if a frame needs more than ``max_memory``; ``hint`` says what else would help."""
    if needed > max_memory:
        raise InputError(
            f"--max-memory: this frame needs more with model {contract.name}; allow at least "
            f"{math.ceil(needed / 2**30 * 10) / 10:.1f}G{hint}"
        )


@dataclass(frozen=True)
class _Split:
    """A side of the grid, cut into ranges of pixels."""

    cores: list[tuple[int, int]]
    largest: int
    """Length of the longest range with its overlap."""
    computed: int
    """Length of all ranges with their overlap."""


def _splits(side: tuple[int, int], grid: tuple[int, int], overlap: int, alignment: int) -> Iterator[_Split]:
    """All ways to cut a side, from start to end, into equal steps that are multiples of ``alignment``; the last one may
    be shorter. ``grid``: start and end of the grid's side."""
    start, end = side
    units = -(-(end - start) // alignment)
    for step in sorted({-(-units // count) * alignment for count in range(1, units + 1)}):
        cores = [(a, min(a + step, end)) for a in range(start, end, step)]
        lengths = [min(b + overlap, grid[1]) - max(a - overlap, grid[0]) for a, b in cores]
        yield _Split(cores, max(lengths), sum(lengths))
