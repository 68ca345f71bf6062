# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from oiio_msspl import find_model, fuse
from oiio_msspl.arrays import box_downsample
from oiio_msspl.exr.render import Render, Window
from oiio_msspl.fusion.alignment import align
from oiio_msspl.fusion.tile_features import read_lrhs, read_tile
from oiio_msspl.fusion.tiling import Tile, aligned_grid
from oiio_msspl.model.encoding import encode_radiance
from oiio_msspl.model.session import Session
from tests.conftest import downsample, noisy, picture


def cut(render, width, height):
    """The top left of a render, as a crop region of the same frame."""
    layers = {name: np.ascontiguousarray(values[:height, :width]) for name, values in render.layers.items()}
    return Render(layers, Window(0, 0, width, height), render.display_window, name=render.name)


def features_beyond(low, high, alignment_of_model):
    """Colour of both renders over the aligned grid, and the alignment."""
    alignment = align(low, high)
    grid = aligned_grid(alignment.grid, alignment_of_model)
    lrhs = read_lrhs(low, alignment, grid, ["rgb"], {})
    return read_tile(Tile(grid, grid), lrhs, grid, high, alignment, ["rgb"], {}), alignment


@pytest.mark.parametrize("size", [(40, 56), (72, 104), (8, 8), (8, 120)])
@pytest.mark.parametrize("lrhs_is_larger", [False, True])
def test_beyond_the_frame_both_renders_are_mirrored_alike(size, lrhs_is_larger):
    """Also in frames smaller than what is added, and where the LRHS goes on behind the HRLS's crop region."""
    clean = np.random.default_rng(0).random((128, 128, 3), np.float32)
    low, high = Render.from_arrays("lr", rgb=downsample(clean, 8)), cut(Render.from_arrays("hr", rgb=clean), *size)
    low = low if lrhs_is_larger else cut(low, size[0] // 8, size[1] // 8)
    pair, _ = features_beyond(low, high, 32)
    width, height = size
    mirrored = np.pad(clean[:height, :width], ((0, 256 - height), (0, 256 - width), (0, 0)), mode="symmetric")
    np.testing.assert_array_equal(pair.hrls["rgb"], mirrored)
    np.testing.assert_allclose(pair.lrhs["rgb"], box_downsample(mirrored, 8), rtol=1e-5)


@pytest.mark.parametrize("lrhs_side", [7, 8])
def test_odd_sizes_are_mirrored_at_the_same_lrhs_pixel(lrhs_side):
    """59 pixels are 7.4 LRHS pixels: the eighth is completed first."""
    clean = np.random.default_rng(0).random((59, 59, 3), np.float32)
    low = Render.from_arrays("lr", rgb=clean[:lrhs_side, :lrhs_side].copy())
    pair, alignment = features_beyond(low, Render.from_arrays("hr", rgb=clean), 16)
    assert alignment.grid == Window(0, 0, 8, 8)
    for values, side in ((pair.lrhs["rgb"], 8), (pair.hrls["rgb"], 64)):
        np.testing.assert_array_equal(values[side:], values[:side][::-1])
        np.testing.assert_array_equal(values[:, side:], values[:, :side][:, ::-1])
    np.testing.assert_array_equal(pair.hrls["rgb"][59:64, :59], clean[:53:-1])


@pytest.mark.parametrize("rows", [1080, 1081, 858, 2160, 230])
@pytest.mark.parametrize("scale", [2, 4, 8])
def test_the_last_rows_are_as_good_as_inside_a_larger_frame(scale, rows):
    """Where a network reads more rows than there are, it takes nothing for texture. Rows with less around them are a
    little worse by nature: the error is 1.1 to 2.7 times as large, and up to 17 times where rows are repeated."""
    height = 160 + rows % 32  # the number of missing rows depends on this remainder
    clean = picture(256, 256)
    low = Render.from_arrays("lr", rgb=noisy(downsample(clean, scale), scale**2))
    high = Render.from_arrays("hr", rgb=noisy(clean, 1, seed=1))
    session = Session(find_model(scale, "pyramid"))
    errors = []
    for pair in ((low, high), (cut(low, 256 // scale, -(-height // scale)), cut(high, 256, height))):
        fused = fuse(*pair, session)
        error = encode_radiance(fused.rgb, fused.exposure) - encode_radiance(clean, fused.exposure)[: len(fused.rgb)]
        errors.append(np.square(error[height - 8 : height]).mean())
    assert errors[1] < 3 * errors[0]
