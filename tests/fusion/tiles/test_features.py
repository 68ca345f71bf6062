# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from oiio_msspl import find_model, fuse
from oiio_msspl.exr.render import Render, Window
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.fusion.tiles.features import mirrored, read_lrhs, read_tile
from oiio_msspl.fusion.tiles.tiling import Tile, aligned_grid
from oiio_msspl.image.filters import box_downsample
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
def test_odd_sizes_are_mirrored_once_at_the_last_hrls_pixel(lrhs_side):
    """59 pixels are 7.4 LRHS pixels. Mirroring at the border of the eighth as well would show pixels 54 to 58 four
    times, and repeated noise looks like texture."""
    clean = np.random.default_rng(0).random((59, 59, 3), np.float32)
    low = Render.from_arrays("lr", rgb=clean[:lrhs_side, :lrhs_side].copy())
    pair, _ = features_beyond(low, Render.from_arrays("hr", rgb=clean), 16)
    mirrored = np.pad(clean, ((0, 128 - 59), (0, 128 - 59), (0, 0)), mode="symmetric")
    np.testing.assert_array_equal(pair.hrls["rgb"], mirrored)


@pytest.mark.parametrize("first", [0, 3])
@pytest.mark.parametrize("lrhs", ["rounded up", "rounded down", "of a larger frame"])
def test_beyond_odd_sizes_both_renders_show_the_same_place(first, lrhs):
    """A ramp tells where a pixel is in the frame: that of an LRHS pixel is the mean of its HRLS pixels."""
    scale, side = 4, 59
    frame = 80 if lrhs == "of a larger frame" else side
    lrhs_side = -(-frame // scale) - (lrhs == "rounded down")
    ramps = [(np.arange(n, dtype=np.float32) + 0.5) / n * frame for n in (lrhs_side, frame)]
    low, high = (np.dstack([*np.meshgrid(ramp, ramp), np.ones((len(ramp),) * 2)]) for ramp in ramps)
    window, shown = Window(first, first, side, side), Window(0, 0, frame, frame)
    cropped = Render({"rgb": high[first:side, first:side].astype(np.float32)}, window, shown, name="hr")
    pair, _ = features_beyond(Render.from_arrays("lr", rgb=low), cropped, 32)
    places = box_downsample(pair.hrls["rgb"], scale)
    places[..., :2] = places[..., :2].clip(ramps[0][0], ramps[0][-1])  # the centres of the LRHS's first and last pixels
    off = 1e-4 if lrhs == "of a larger frame" else frame / lrhs_side / 2 + 1e-4  # the nearest LRHS pixel
    np.testing.assert_allclose(pair.lrhs["rgb"], places, atol=off)


@pytest.mark.parametrize("lrhs_side", [60, 61])
def test_pixels_of_a_rounded_lrhs_do_not_share_their_noise(lrhs_side):
    """Networks take noise that neighbours share for texture, so it stayed in frames of 1921 pixels."""
    noise = np.random.default_rng(0).random((lrhs_side, lrhs_side, 3), np.float32)
    pair, _ = features_beyond(Render.from_arrays("lr", rgb=noise), Render.from_arrays("hr", rgb=picture(121, 121)), 16)
    assert np.isin(pair.lrhs["rgb"][:60, :60], noise).all()


@pytest.mark.parametrize("rows", [1080, 1081, 858, 2160, 230])
@pytest.mark.parametrize("scale", [2, 4, 8])
def test_the_last_rows_are_as_good_as_inside_a_larger_frame(scale, rows):
    """Where a network reads more rows than there are, it takes nothing for texture. Rows with less around them are a
    little worse by nature: the error is 1.1 to 2.7 times as large, and up to 17 times where rows are repeated."""
    height = 160 + rows % 32  # the number of missing rows depends on this remainder
    clean = picture(256, 256)
    low = Render.from_arrays("lr", rgb=noisy(downsample(clean, scale), scale**2))
    high = Render.from_arrays("hr", rgb=noisy(clean, 1, seed=1))
    session = Session(find_model(scale, "joint-small"))
    errors = []
    for pair in ((low, high), (cut(low, 256 // scale, -(-height // scale)), cut(high, 256, height))):
        fused = fuse(*pair, session)
        error = encode_radiance(fused.rgb, fused.exposure) - encode_radiance(clean, fused.exposure)[: len(fused.rgb)]
        errors.append(np.square(error[height - 8 : height]).mean())
    assert errors[1] < 3 * errors[0]


@pytest.mark.parametrize("window", [(0, 0, 9, 7), (2, 1, 5, 6), (-3, -2, 12, 8), (4, 3, 30, 25), (-21, 2, -15, 4)])
@pytest.mark.parametrize("layout", ["pixels", "planes"])
def test_images_are_mirrored_as_often_as_a_window_reaches(window, layout):
    inside, window = Window(0, 0, 9, 7), Window(*window)
    image = np.random.default_rng(0).random((3, 7, 9), np.float32).transpose(1, 2, 0)
    image = np.ascontiguousarray(image) if layout == "pixels" else image
    there = np.pad(image, ((28, 28), (27, 27), (0, 0)), mode="symmetric")[
        28 + window.y0 : 28 + window.y1, 27 + window.x0 : 27 + window.x1
    ]
    result = mirrored(image, inside, window)
    np.testing.assert_array_equal(result, there)
    np.testing.assert_array_equal(np.argsort(result.strides), np.argsort(image.strides))


def bucket_pair(scale, which, colour, part=(slice(16, 48), slice(64, 112))):
    """A noisy pair with alpha, and rows and columns of HRLS pixels in which one render shows one colour alone."""
    clean = picture(96, 128)
    low, high = noisy(box_downsample(clean, scale), 4 * scale**2), noisy(clean, 4, seed=1)
    alpha = np.ones((*high.shape[:2], 1), np.float32)
    if which == "HRLS":
        high[part], alpha[part] = colour, 0
    else:
        low[tuple(slice(p.start // scale, p.stop // scale) for p in part)] = colour
    return Render.from_arrays("lr", rgb=low), Render.from_arrays("hr", rgb=high, alpha=alpha)


def read(low, high):
    alignment = align(low, high)
    lrhs = read_lrhs(low, alignment, alignment.grid, ["rgb"])
    return read_tile(Tile(alignment.grid, alignment.grid), lrhs, alignment.grid, high, alignment, ["rgb", "alpha"])


@pytest.mark.parametrize("scale", [2, 4, 8])
@pytest.mark.parametrize("which", ["LRHS", "HRLS"])
@pytest.mark.parametrize("colour", [(0, 0, 0), (1, 0, 1)])
def test_a_failed_bucket_gets_the_light_of_the_other_render(scale, which, colour):
    low, high = bucket_pair(scale, which, colour)
    pair = read(low, high)
    inside = (slice(16 // scale, 48 // scale), slice(64 // scale, 112 // scale))
    failed = pair.failed[which == "HRLS"]
    assert failed[inside].all() and failed.sum() == failed[inside].size
    means = box_downsample(pair.hrls["rgb"], scale)
    if which == "HRLS":
        np.testing.assert_allclose(means[inside].mean(), low.layers["rgb"][inside].mean(), rtol=0.05)
        assert (pair.hrls["alpha"] == 1).all()
    else:
        np.testing.assert_array_equal(pair.lrhs["rgb"][inside], means[inside])


@pytest.mark.parametrize("scale", [2, 4, 8])
def test_what_is_black_is_no_bucket_without_a_reason(scale):
    """Rare light, a thing that is black in both renders, and a square smaller than any bucket."""
    rng = np.random.default_rng(0)
    clean = picture(256, 256)
    for n in (1, 4):
        high = clean / 0.05 * (rng.random((n, 256, 256, 1)) < 0.05).mean(axis=0)
        low = box_downsample(clean / 0.05 * (rng.random((n, 256, 256, 1)) < 0.05).mean(axis=0), scale)
        pair = read(Render.from_arrays("lr", rgb=low.astype(np.float32)), Render.from_arrays("hr", rgb=high))
        assert pair.failed is None
    clean[64:192, 64:192] = 0
    high = clean.copy()
    high[8:16, 8:16] = 0
    low = Render.from_arrays("lr", rgb=box_downsample(clean, scale))
    assert read(low, Render.from_arrays("hr", rgb=high)).failed is None
