# SPDX-License-Identifier: Apache-2.0
"""Cuts a frame into overlapping tiles, so that memory depends on the tile and not on the frame."""

from __future__ import annotations

from collections.abc import Iterator
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
#: HRLS pixels of the largest tile; larger ones are no faster.
LARGEST_TILE = 2048 * 2048
#: Shortest side of a tile's core, in LRHS pixels; smaller ones would spend nearly all work on the overlap.
SMALLEST_CORE = 16


@dataclass(frozen=True)
class Tile:
    """Two windows in LRHS pixels; ``core`` is inside ``area``."""

    core: Window
    """The pixels that the tile contributes to the frame. The cores cover the grid once."""
    area: Window
    """The pixels that the network reads: the core plus the overlap, cut at the borders of the grid."""


def aligned_grid(grid: Window, alignment: int) -> Window:
    """Extend ``grid`` to the right and to the bottom until its sides are multiples of ``alignment``."""
    width, height = (-(-side // alignment) * alignment for side in (grid.width, grid.height))
    return Window(grid.x0, grid.y0, grid.x0 + width, grid.y0 + height)


def largest_tile(contract: Contract, frame_bytes: int, max_memory: int) -> int:
    """LRHS pixels of the largest tile that fits into memory.

    Args:
        frame_bytes: memory for the whole frame: the result and the LRHS.
        max_memory: memory for the whole process.

    Returns:
        0 or less if not even the frame fits.
    """
    left = max_memory - FIXED_MEMORY - frame_bytes
    pixels = min(left // contract.bytes_per_pixel, LARGEST_TILE)
    return int(pixels) // contract.scale**2


def smallest_memory(grid: Window, contract: Contract, frame_bytes: int) -> int:
    """Memory with which a frame can be fused: in the smallest tiles that :func:`plan_tiles` makes.

    Args:
        grid: LRHS pixels to cover.
        frame_bytes: as for :func:`largest_tile`.
    """
    smallest = min(width * height for _, _, width, height in _cuts(grid, contract.overlap, contract.alignment))
    return FIXED_MEMORY + frame_bytes + smallest * contract.scale**2 * contract.bytes_per_pixel


def check_memory(needed: int, max_memory: int, hint: str = "") -> None:
    """Raise InputError if a frame needs more than ``max_memory``; ``hint`` says what else would help."""
    if needed > max_memory:
        tenths = -(-needed * 10 // 2**30)
        raise InputError(f"--max-memory is too small for this frame; allow at least {tenths / 10:.1f}G{hint}")


def plan_tiles(grid: Window, largest: int, overlap: int, alignment: int = 1) -> list[Tile]:
    """Cover ``grid`` by tiles, row by row, whose area has at most ``largest`` LRHS pixels.

    There is no overlap at the borders of the grid: the network sees the end of the picture there, as in training.
    ``overlap`` and the sides of the grid are multiples of ``alignment``. So are the sides and offsets of all tiles, so
    that a network that works on blocks of pixels divides a tile as it divides the frame.

    Raises:
        InputError: ``largest`` is too small for a core.
    """
    fitting = (cut for cut in _cuts(grid, overlap, alignment) if cut[2] * cut[3] <= largest)
    width, height, _, _ = next(fitting, (0, 0, 0, 0))
    if not width:
        raise InputError(f"--max-memory is too small: no tile of {grid.size} low-resolution pixels fits; raise it")
    columns, rows = _ranges(grid.x0, grid.x1, width), _ranges(grid.y0, grid.y1, height)
    return [
        Tile(Window(x0, y0, x1, y1), Window(x0 - overlap, y0 - overlap, x1 + overlap, y1 + overlap).intersect(grid))
        for y0, y1 in rows
        for x0, x1 in columns
    ]


def _cuts(grid: Window, overlap: int, alignment: int) -> Iterator[tuple[int, int, int, int]]:
    """Ways to cut a grid into more and more tiles: width and height of a core, and of a tile's area.

    The longer side is cut first, so tiles are nearly square.
    """
    nx = ny = 1
    while True:
        width, height = _step(grid.width, nx, alignment), _step(grid.height, ny, alignment)
        yield width, height, width + (2 * overlap if nx > 1 else 0), height + (2 * overlap if ny > 1 else 0)
        if min(width, height) < max(SMALLEST_CORE, alignment + 1):
            return
        if width >= height:
            nx += 1
        else:
            ny += 1


def _step(side: int, count: int, alignment: int) -> int:
    """The smallest multiple of ``alignment`` with which ``count`` steps cover a side."""
    return -(-side // (count * alignment)) * alignment


def _ranges(start: int, end: int, step: int) -> list[tuple[int, int]]:
    return [(a, min(a + step, end)) for a in range(start, end, step)]
