# SPDX-License-Identifier: Apache-2.0
"""Cuts a frame into overlapping tiles, so that memory depends on the tile and not on the frame.

Tiles depend on the model and on the size of the frame, and those of a pass also on where it has light. Other tiles give
slightly other pixels, so they never depend on memory: frames of one shot must not differ from machine to machine.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from oiio_msspl.errors import InputError
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.model.contract import ONE_SIZE, Contract

#: Bytes that a process may use by default.
MAX_MEMORY = 3 << 30
#: Bytes that do not grow with the frame: interpreter, libraries, weights.
FIXED_MEMORY = 350 << 20
#: Fraction of the memory for decoded rows that neighbouring tiles read. ``bytes_per_pixel`` of a model includes it.
STRIPS_FRACTION = 1 / 6
#: Most bytes of a tile: what ``MAX_MEMORY`` leaves beside an 8K frame.
TILE_MEMORY = 1720 << 20
#: Memory is estimated from this many LRHS pixels on a side: larger frames, or damaged headers, have no larger tiles.
_LARGEST_SIDE = 16384
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
    """Extend a grid to the right and to the bottom until its sides are multiples of ``alignment``."""
    width, height = (-(-side // alignment) * alignment for side in (grid.width, grid.height))
    return Window(grid.x0, grid.y0, grid.x0 + width, grid.y0 + height)


def plan_tiles(grid: Window, contract: Contract, part: Window | None = None) -> list[Tile]:
    """Cover ``grid`` by tiles of at most ``TILE_MEMORY``, row by row, so that the network computes the fewest pixels.

    No tile reaches beyond the grid: the network sees the end of the picture there, as in training. Offsets are
    multiples of the contract's alignment, so a network divides a tile into blocks as it divides the frame. Only
    ``part`` of the grid is covered, if given; the tiles may exceed it.
    """
    alignment = contract.alignment
    overlap = -(-contract.overlap // alignment) * alignment
    largest = TILE_MEMORY // (contract.bytes_per_pixel * contract.scale**2)
    if part is None:
        part = grid
    else:  # extended to multiples of the alignment, or to the end of the grid
        x0, y0 = part.x0 - (part.x0 - grid.x0) % alignment, part.y0 - (part.y0 - grid.y0) % alignment
        part = aligned_grid(Window(x0, y0, part.x1, part.y1), alignment).intersect(grid)
    # The smallest tile is taken if it exceeds the memory, too. Then the fewest pixels count, then the fewest tiles.
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


def sample_bands(grid: Window, scale: int) -> list[Window]:
    """Return bands of rows, evenly spread over a grid, from which a frame is judged before its tiles are read."""
    # EXR files store whole rows, often in blocks of 16.
    rows = min(max(16 // scale, 4), grid.height)
    last = grid.height // rows - 1
    tops = sorted({grid.y0 + last * i // (SAMPLE_BANDS - 1) * rows for i in range(SAMPLE_BANDS)})
    return [Window(grid.x0, top, grid.x1, top + rows) for top in tops]


def tile_bytes(alignment: Alignment, contract: Contract) -> int:
    """Return the bytes of the largest tile of a frame, with the network's intermediate results."""
    grid = aligned_grid(alignment.grid, contract.alignment)
    corner = grid.intersect(Window(grid.x0, grid.y0, grid.x0 + _LARGEST_SIDE, grid.y0 + _LARGEST_SIDE))
    pixels = max(tile.area.width * tile.area.height for tile in plan_tiles(corner, contract))
    return pixels * contract.scale**2 * contract.bytes_per_pixel


def result_bytes(alignment: Alignment, *, error: bool) -> int:
    """Return the bytes of a fused frame in float32: colour, alpha (even if there is none), perhaps the error."""
    return alignment.hr_data_window.width * alignment.hr_data_window.height * (5 if error else 4) * 4


def memory_to_fuse(alignment: Alignment, contract: Contract, *, error: bool) -> int:
    """Return the smallest ``max_memory`` with which a frame can be fused, from its headers."""
    grid = aligned_grid(alignment.grid, contract.alignment)
    # The LRHS lies in memory: alpha has 1 channel, other features have 3. Of one of full size, only the beauty does.
    channels = 3 if contract.scale == ONE_SIZE else 3 * len(contract.lrhs) + 1
    lrhs = grid.width * grid.height * channels * 4
    return FIXED_MEMORY + result_bytes(alignment, error=error) + lrhs + tile_bytes(alignment, contract)


def strips_memory(max_memory: int, held: int) -> int:
    """Return the bytes for decoded rows that neighbouring tiles or bands read, beside ``held`` bytes."""
    return max(0, int((max_memory - held) * STRIPS_FRACTION))


def require_memory(needed: int, contract: Contract, max_memory: int, hint: str = "") -> None:
    """Raise InputError if a frame needs more than ``max_memory``; ``hint`` says what else helps."""
    if needed > max_memory:
        raise InputError(
            f"--max-memory: this frame needs more with model {contract.name}; allow at least "
            f"{math.ceil(needed / 2**30 * 10) / 10:.1f}G{hint}"
        )


class _Split(NamedTuple):
    """A side of the grid, cut into ranges of pixels: the ranges, and the longest and all of them with their overlap."""

    cores: list[tuple[int, int]]
    largest: int
    computed: int


def _splits(side: tuple[int, int], grid: tuple[int, int], overlap: int, alignment: int) -> Iterator[_Split]:
    """Yield all ways to cut a side (start, end) of the grid into multiples of ``alignment``, equal but for the last."""
    start, end = side
    units = -(-(end - start) // alignment)
    for length in sorted({-(-units // count) * alignment for count in range(1, units + 1)}):
        cores = [(a, min(a + length, end)) for a in range(start, end, length)]
        lengths = [min(b + overlap, grid[1]) - max(a - overlap, grid[0]) for a, b in cores]
        yield _Split(cores, max(lengths), sum(lengths))
