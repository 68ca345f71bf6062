# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from oiio_msspl.errors import InputError
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.tiling import aligned_grid, largest_tile, plan_tiles, smallest_memory
from oiio_msspl.model.contract import Contract


@pytest.mark.parametrize("grid", [Window(0, 0, 480, 270), Window(-7, 3, 90, 400), Window(0, 0, 1, 1)])
@pytest.mark.parametrize("largest", [4096, 20000, 10**9])
def test_cores_cover_the_grid_once_and_areas_fit(grid, largest):
    covered = np.zeros((grid.height, grid.width), int)
    for tile in plan_tiles(grid, largest, overlap=8):
        covered[tile.core.slices(grid)] += 1
        assert tile.area.width * tile.area.height <= largest
        assert tile.area.intersect(grid) == tile.area
        assert tile.area.intersect(tile.core) == tile.core
        for inner, outer, border in (
            (tile.core.x0, tile.area.x0, grid.x0),
            (tile.core.y0, tile.area.y0, grid.y0),
        ):
            assert inner - outer == 8 or outer == border
    assert (covered == 1).all()


@pytest.mark.parametrize("grid", [Window(0, 0, 480, 270), Window(-7, 3, 90, 400), Window(0, 0, 1, 1)])
def test_aligned_tiles_lie_on_the_blocks_of_the_whole_frame(grid):
    wider = aligned_grid(grid, 8)
    assert grid.intersect(wider) == grid
    assert (wider.x0, wider.y0) == (grid.x0, grid.y0)
    assert wider.width - grid.width < 8 > wider.height - grid.height
    covered = np.zeros((wider.height, wider.width), int)
    for tile in plan_tiles(wider, 20000, overlap=24, alignment=8):
        covered[tile.core.slices(wider)] += 1
        assert tile.area.width * tile.area.height <= 20000
        for window in (tile.core, tile.area):
            sides = window.x0 - grid.x0, window.y0 - grid.y0, window.width, window.height
            assert not any(side % 8 for side in sides)
    assert (covered == 1).all()


def test_too_little_memory_is_said():
    with pytest.raises(InputError, match="--max-memory is too small"):
        list(plan_tiles(Window(0, 0, 500, 300), 100, overlap=16))


@pytest.mark.parametrize(("alignment", "overlap"), [(1, 16), (8, 32), (16, 48)])
@pytest.mark.parametrize("size", [(40, 30), (500, 300), (1921, 1081)])
def test_the_smallest_memory_is_the_one_threshold(size, alignment, overlap):
    """With it there is a plan, with a byte less there is none."""
    contract = Contract(name="any", scale=4, alignment=alignment, overlap=overlap, bytes_per_pixel=1000)
    grid = aligned_grid(Window(0, 0, *size), alignment)
    needed = smallest_memory(grid, contract, 10**6)
    assert plan_tiles(grid, largest_tile(contract, 10**6, needed), overlap, alignment)
    with pytest.raises(InputError, match="--max-memory is too small"):
        plan_tiles(grid, largest_tile(contract, 10**6, needed - 1), overlap, alignment)
