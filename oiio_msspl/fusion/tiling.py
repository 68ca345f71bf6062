# SPDX-License-Identifier: Apache-2.0
"""Cutting a frame into overlapping tiles, so that memory depends on the tile and not on the frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from oiio_msspl.errors import InputError
from oiio_msspl.exr.render import Window

#: Tiles of more HRLS pixels than this bring no more speed.
LARGEST = 2048 * 2048
#: Tiles with a core of fewer LRHS pixels a side would spend nearly all their work on the overlap.
SMALLEST_CORE = 16


@dataclass(frozen=True)
class Tile:
    """Both windows in LRHS pixels; ``core`` lies in ``area``."""

    core: Window
    """What the tile contributes: cores cover the grid once."""
    area: Window
    """What the network sees: the core and the overlap, as far as the grid goes."""


def aligned_grid(grid: Window, alignment: int) -> Window:
    """``grid`` extended to the right and below until its sides are multiples of ``alignment``."""
    width, height = (-(-side // alignment) * alignment for side in (grid.width, grid.height))
    return Window(grid.x0, grid.y0, grid.x0 + width, grid.y0 + height)


def plan_tiles(grid: Window, largest: int, overlap: int, alignment: int = 1) -> Iterator[Tile]:
    """Cover ``grid`` by tiles whose area holds at most ``largest`` LRHS pixels.

    The grid's own borders get no overlap: there the network sees the end of the picture, as in training. ``overlap``
    and the grid's sides are multiples of ``alignment``, and so are all sides and offsets of the tiles: a network that
    works on blocks of pixels divides every tile as it would divide the frame.

    Raises:
        InputError: ``largest`` leaves no room for a core.
    """
    columns, rows = _split(grid, largest, overlap, alignment)
    for y0, y1 in rows:
        for x0, x1 in columns:
            core = Window(x0, y0, x1, y1)
            yield Tile(core, Window(x0 - overlap, y0 - overlap, x1 + overlap, y1 + overlap).intersect(grid))


def _split(
    grid: Window, largest: int, overlap: int, alignment: int
) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Fewest cuts that fit, cutting the longer side first so that tiles stay near square."""
    nx = ny = 1
    while True:
        width, height = _step(grid.width, nx, alignment), _step(grid.height, ny, alignment)
        area_width = width + (2 * overlap if nx > 1 else 0)
        area_height = height + (2 * overlap if ny > 1 else 0)
        if area_width * area_height <= largest:
            break
        if min(width, height) < max(SMALLEST_CORE, alignment + 1):
            raise InputError(
                f"not enough memory: even a tile of {width}x{height} low-resolution pixels needs more; "
                "raise --max-memory"
            )
        if width >= height:
            nx += 1
        else:
            ny += 1
    return _cuts(grid.x0, grid.x1, width), _cuts(grid.y0, grid.y1, height)


def _step(side: int, count: int, alignment: int) -> int:
    """Smallest multiple of ``alignment`` of which ``count`` make up a side."""
    return -(-side // (count * alignment)) * alignment


def _cuts(start: int, end: int, step: int) -> list[tuple[int, int]]:
    return [(a, min(a + step, end)) for a in range(start, end, step)]
