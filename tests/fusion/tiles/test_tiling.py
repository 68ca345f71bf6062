# SPDX-License-Identifier: Apache-2.0
import itertools

import numpy as np
import pytest

from oiio_msspl.errors import InputError
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.tiles import tiling
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.fusion.tiles.tiling import (
    FIXED_MEMORY,
    aligned_grid,
    plan_tiles,
    require_memory,
    sample_bands,
    tile_bytes,
)
from oiio_msspl.model.catalogue import shipped_models
from oiio_msspl.model.contract import Contract

GRIDS = [Window(0, 0, 480, 270), Window(-7, 3, 90, 400), Window(0, 0, 1, 1)]


def contract_of(alignment, overlap):
    return Contract(name="test", scale=2, alignment=alignment, overlap=overlap, bytes_per_pixel=100)


def whole_frame(contract, width, height):
    """The alignment of a pair whose LRHS has this size."""
    low, scale = Window(0, 0, width, height), contract.scale
    return Alignment(scale, low, low, Window(0, 0, width * scale, height * scale))


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("largest", [4096, 20000, 10**9])
@pytest.mark.parametrize(("alignment", "overlap"), [(1, 8), (8, 24), (16, 16)])
def test_cores_cover_the_grid_once_and_areas_fit(monkeypatch, grid, largest, alignment, overlap):
    """All tiles begin on the blocks of pixels that the networks work on."""
    monkeypatch.setattr(tiling, "TILE_MEMORY", largest * 2**2 * 100)
    contract = contract_of(alignment, overlap)
    grid = aligned_grid(grid, alignment)
    covered = np.zeros((grid.height, grid.width), int)
    for tile in plan_tiles(grid, contract):
        covered[tile.core.slices(grid)] += 1
        assert tile.area.width * tile.area.height <= max(largest, (2 * overlap + alignment) ** 2)
        assert tile.area.intersect(grid) == tile.area
        assert tile.area.intersect(tile.core) == tile.core
        for window in (tile.core, tile.area):
            assert (window.x0 - grid.x0) % alignment == (window.y0 - grid.y0) % alignment == 0
            assert window.width % alignment == window.height % alignment == 0
        for inner, outer, border in ((tile.core.x0, tile.area.x0, grid.x0), (tile.core.y0, tile.area.y0, grid.y0)):
            assert inner - outer == overlap or outer == border
    assert (covered == 1).all()


@pytest.mark.parametrize("part", [(30, 40, 31, 41), (0, 0, 40, 200), (77, 9, 400, 300)])
@pytest.mark.parametrize("largest", [4096, 10**9])
def test_a_part_of_the_grid_is_covered_with_few_pixels_around(monkeypatch, part, largest):
    """The network sees what is around the part, up to the borders of the grid."""
    monkeypatch.setattr(tiling, "TILE_MEMORY", largest * 2**2 * 100)
    alignment, overlap = 8, 24
    grid = Window(-16, 8, 384, 304)
    part = Window(*part).shift(grid.x0, grid.y0).intersect(grid)
    covered = np.zeros((grid.height, grid.width), int)
    for tile in plan_tiles(grid, contract_of(alignment, overlap), part=part):
        covered[tile.core.slices(grid)] += 1
        assert (tile.area.x0, tile.area.y0) == (max(tile.core.x0 - overlap, -16), max(tile.core.y0 - overlap, 8))
        assert (tile.area.x1, tile.area.y1) == (min(tile.core.x1 + overlap, 384), min(tile.core.y1 + overlap, 304))
        for length in (tile.area.x0 + 16, tile.area.y0 - 8, tile.area.width, tile.area.height):
            assert length % alignment == 0
    assert (covered[part.slices(grid)] == 1).all() and covered.max() == 1
    assert covered.sum() <= (part.width + 2 * alignment) * (part.height + 2 * alignment)


@pytest.mark.parametrize("grid", GRIDS)
def test_the_grid_grows_to_the_right_and_to_the_bottom(grid):
    wider = aligned_grid(grid, 8)
    assert grid.intersect(wider) == grid
    assert (wider.x0, wider.y0) == (grid.x0, grid.y0)
    assert wider.width - grid.width < 8 > wider.height - grid.height


@pytest.mark.parametrize("name", shipped_models())
@pytest.mark.parametrize(("size", "cost"), [((1280, 720), 1.25), ((1920, 1080), 1.4), ((8192, 4320), 1.85)])
def test_overlaps_cost_little_and_the_default_memory_suffices(name, size, cost):
    """Computed pixels by pixels of the frame."""
    contract = Contract.of_file(shipped_models()[name])
    width, height = (-(-side // contract.scale) for side in size)
    tiles = plan_tiles(aligned_grid(Window(0, 0, width, height), contract.alignment), contract)
    assert sum(tile.area.width * tile.area.height for tile in tiles) <= cost * width * height
    lrhs_channels = 3 if contract.scale == 1 else 9  # with albedo and normal
    frame_bytes = 4 * (4 * size[0] * size[1] + lrhs_channels * width * height)
    assert FIXED_MEMORY + frame_bytes + tile_bytes(whole_frame(contract, width, height), contract) <= tiling.MAX_MEMORY


def test_too_little_memory_is_said_with_what_suffices():
    contract = contract_of(1, 8)
    needed = FIXED_MEMORY + (500 << 20) + tile_bytes(whole_frame(contract, 1000, 500), contract)
    with pytest.raises(InputError, match=r"this frame needs more with model test; allow at least 1\.1G"):
        require_memory(needed, contract, 1 << 30)
    require_memory(needed, contract, int(1.1 * 2**30))


@pytest.mark.parametrize("scale", [2, 4, 8])
@pytest.mark.parametrize("height", [1, 3, 8, 135, 2160])
def test_sample_bands_are_spread_over_the_frame(scale, height):
    """Equally high, inside the frame, from its top to its end, and few in a large frame."""
    grid = Window(-5, 7, 500, 7 + height)
    bands = sample_bands(grid, scale)
    assert {(band.x0, band.x1) for band in bands} == {(-5, 500)}
    assert len({band.height for band in bands}) == 1
    assert all(above.y1 <= below.y0 for above, below in itertools.pairwise(bands))
    assert bands[0].y0 == 7
    assert 0 <= grid.y1 - bands[-1].y1 < bands[-1].height
    assert sum(band.height for band in bands) <= max(8 * 8, height)
