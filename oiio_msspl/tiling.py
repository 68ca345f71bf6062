# SPDX-License-Identifier: Apache-2.0
"""Cutting a frame into overlapping tiles, so that memory depends on the tile and not on the frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from oiio_msspl.errors import InputError
from oiio_msspl.render import Window

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


def tiles(grid: Window, largest: int, overlap: int) -> Iterator[Tile]:
    """Cover ``grid`` by tiles whose area holds at most ``largest`` LRHS pixels.

    The grid's own borders get no overlap: there the network sees the end of the picture, as in training.

    Raises:
        InputError: ``largest`` leaves no room for a core.
    """
    columns, rows = _split(grid, largest, overlap)
    for y0, y1 in rows:
        for x0, x1 in columns:
            core = Window(x0, y0, x1, y1)
            yield Tile(core, Window(x0 - overlap, y0 - overlap, x1 + overlap, y1 + overlap).intersect(grid))


def _split(grid: Window, largest: int, overlap: int) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Fewest cuts that fit, cutting the longer side first so that tiles stay near square."""
    nx = ny = 1
    while True:
        width, height = -(-grid.width // nx), -(-grid.height // ny)
        area_width = width + (2 * overlap if nx > 1 else 0)
        area_height = height + (2 * overlap if ny > 1 else 0)
        if area_width * area_height <= largest:
            break
        if min(width, height) < SMALLEST_CORE:
            raise InputError(
                f"not enough memory: even a tile of {width}x{height} low-resolution pixels needs more; "
                "raise --max-memory"
            )
        if width >= height:
            nx += 1
        else:
            ny += 1
    return _cuts(grid.x0, grid.x1, nx), _cuts(grid.y0, grid.y1, ny)


def _cuts(start: int, end: int, count: int) -> list[tuple[int, int]]:
    step = -(-(end - start) // count)
    return [(a, min(a + step, end)) for a in range(start, end, step)]
