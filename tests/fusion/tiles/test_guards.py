# SPDX-License-Identifier: Apache-2.0
"""Guards around the network."""

import numpy as np
import pytest

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RADIANCE_FEATURES, RGB
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.tiles.features import TileFeatures
from oiio_msspl.fusion.tiles.guards import (
    FIREFLY_FACTOR,
    LIGHT,
    SMEAR,
    EmptyRegions,
    _rare_light,
    bright_lights,
    dim_fireflies,
    is_noise_free,
    with_pure_colours,
    without_pure_colours,
)


def tile(lrhs, hrls, scale=2):
    """A tile without a border."""
    size = len(lrhs)
    area, whole, pixels = (
        Window(0, 0, size, size),
        Window(0, 0, scale * size, scale * size),
        (slice(0, size), slice(0, size)),
    )
    return TileFeatures({RGB: lrhs}, hrls, scale, area, whole, whole, pixels, pixels)


@pytest.mark.parametrize("feature", RADIANCE_FEATURES)
def test_a_firefly_is_dimmed_in_every_layer_of_light(feature):
    """To a multiple of the LRHS around it. Other pixels, and layers that are no light, keep their values."""
    hrls = {name: np.full((16, 16, 3), 0.5, np.float32) for name in {*RADIANCE_FEATURES, ALBEDO}}
    hrls[feature][5, 6] = 1e6
    hrls[ALBEDO][5, 6] = 1e6
    lrhs, dimmed = dim_fireflies(tile(np.full((8, 8, 3), 0.5, np.float32), hrls))
    assert (dimmed[feature][5, 6] == 0.5 * FIREFLY_FACTOR).all()
    dimmed[feature][5, 6] = 0.5
    for name in RADIANCE_FEATURES:
        assert (dimmed[name] == 0.5).all()
    assert (dimmed[ALBEDO] == hrls[ALBEDO]).all()
    assert (lrhs == 0.5).all()


def test_a_firefly_of_the_lrhs_is_dimmed_to_what_the_hrls_allows():
    low = np.full((8, 8, 3), 0.5, np.float32)
    low[3, 3] = 1e6
    lrhs, _ = dim_fireflies(tile(low, {RGB: np.full((16, 16, 3), 0.25, np.float32)}))
    assert (lrhs[3, 3] == 0.25 * FIREFLY_FACTOR).all()
    lrhs[3, 3] = 0.5
    assert (lrhs == 0.5).all()


@pytest.mark.parametrize("size", [64, 61])
def test_rare_light_is_no_firefly(size):
    """One sample of 40 finds the light, all others a trace of it. Each is kept, also where all 3 x 3 pixels around have
    missed the light in the other render. What is far brighter is a firefly all the same."""
    rng = np.random.default_rng(0)

    def rendered(side, spp):
        return (1e-4 + 40 * rng.binomial(spp, 1 / 40, (side, side, 1)) / spp).repeat(3, 2).astype(np.float32)

    low, high = rendered(size, 4), rendered(2 * size, 1)
    lrhs, dimmed = dim_fireflies(tile(low, {RGB: high}))
    np.testing.assert_array_equal(lrhs, low)
    np.testing.assert_array_equal(dimmed[RGB], high)
    high[30, 30] = low[20, 20] = 1e6
    lrhs, dimmed = dim_fireflies(tile(low, {RGB: high}))
    most = FIREFLY_FACTOR * 40
    assert 40 <= dimmed[RGB][30, 30].max() <= most and lrhs[20, 20].max() <= most


def test_a_layer_with_rare_light_has_no_holes():
    """Few samples find a defocused lamp, and the others the empty background. Far from the lamp, nothing is."""
    low, high = np.zeros((64, 64, 3), np.float32), np.zeros((128, 128, 3), np.float32)
    low[::8, :32:8], high[::16, :64:16] = 1.0, 1.0
    pair, whole = tile(low, {RGB: high, NORMAL: np.zeros_like(high)}), (slice(0, 64), slice(0, 64))
    beauty, layer = (EmptyRegions(low, 7, of_pass=of_pass).mask(pair, whole) for of_pass in (False, True))
    assert beauty[:, :48].mean() > 0.5 and not layer[:, :48].any()
    assert layer[:, 112:].all()


def test_a_surface_has_no_hole_where_only_the_hrls_has_found_light():
    """The network spreads the light of that sample. Farther away, neither render has any."""
    low, high = np.zeros((64, 64, 3), np.float32), np.zeros((128, 128, 3), np.float32)
    high[60, 20] = 1.0
    pair, whole = tile(low, {RGB: high, NORMAL: np.ones_like(high)}), (slice(0, 64), slice(0, 64))
    empty = EmptyRegions(low, 7).mask(pair, whole)
    assert not empty[46:76, 6:36].any()
    assert empty[:, 36:].all()


def test_a_lamp_makes_no_fireflies_around_it_believable():
    """Its light is in one square only."""
    low, high = np.full((64, 64, 3), 0.01, np.float32), np.full((128, 128, 3), 0.01, np.float32)
    low[24:32, 24:32], high[48:64, 48:64] = 1e4, 1e4
    high[80, 80] = 1e4
    _, dimmed = dim_fireflies(tile(low, {RGB: high}))
    assert dimmed[RGB][80, 80].max() == np.float32(0.01) * FIREFLY_FACTOR
    assert (dimmed[RGB][48:64, 48:64] == 1e4).all()


@pytest.mark.parametrize("edge", [24, 25, 31])
@pytest.mark.parametrize("scale", [2, 4, 8])
def test_a_firefly_near_the_edge_of_a_bright_area_is_one(scale, edge):
    """As beside a window, wherever squares of pixels lie."""
    for diagonal in (0, 1):
        y, x = np.mgrid[:48, :48]
        low = np.where(x + diagonal * (y - 24) < edge, 10, 0.01)[..., None].repeat(3, 2).astype(np.float32)
        high = low.repeat(scale, 0).repeat(scale, 1)
        pixel = 24 * scale, (edge + 4) * scale
        high[pixel] = 5000
        _, dimmed = dim_fireflies(tile(low, {RGB: high}, scale))
        assert dimmed[RGB][pixel].max() == np.float32(0.01) * FIREFLY_FACTOR


def test_tiles_have_the_same_squares():
    """Wherever they begin."""
    rng = np.random.default_rng(0)
    low = (1e-4 + 40 * (rng.random((64, 64, 1)) < 0.1)).repeat(3, 2).astype(np.float32)
    whole = _rare_light(low, 0, 0)
    assert whole.any()
    for y, x in ((3, 5), (8, 2)):
        part = _rare_light(low[y:, x:], y % 8, x % 8)
        np.testing.assert_array_equal(part[24:, 24:], whole[y + 24 :, x + 24 :])


def test_one_pixel_that_differs_is_noise():
    low, high = np.full((8, 8, 3), 0.5, np.float32), np.full((16, 16, 3), 0.5, np.float32)
    pair = tile(low, {RGB: high})
    assert is_noise_free(pair, low, high, 1.0)
    high[4, 4] = 0.7
    assert not is_noise_free(pair, low, high, 1.0)


def test_black_beside_light_of_the_lrhs_is_not_empty():
    """The network may spread the light that far."""
    low, high = np.zeros((8, 8, 3), np.float32), np.zeros((16, 16, 3), np.float32)
    low[4, 4] = 1
    empty = EmptyRegions(low, 7).mask(tile(low, {RGB: high}), (slice(0, 8), slice(0, 8)))[..., 0]
    assert not empty[6:12, 6:12].any()
    assert empty[:6].all() and empty[12:].all()


def wall_with_lamp():
    """Both renders, in which a lamp covers one LRHS pixel."""
    low, high = np.full((8, 8, 3), 0.5, np.float32), np.full((16, 16, 3), 0.5, np.float32)
    low[4, 4], high[8:10, 8:10] = 2 * LIGHT, 2 * LIGHT
    return low, high


def test_a_firefly_beside_a_lamp_is_dimmed_by_its_own_lrhs_pixel():
    """The lamp in the next pixel does not make it believable."""
    low, high = wall_with_lamp()
    high[8, 10] = 2 * LIGHT
    lights = bright_lights(low, high, 1.0)
    assert (lights[8:10, 8:10] == 2 * LIGHT).all()
    assert (lights[8, 10] <= 0.5 * FIREFLY_FACTOR).all()


def test_a_firefly_in_a_lamp_gets_no_more_than_the_lamp():
    low, high = wall_with_lamp()
    high[9, 9] = 1000 * LIGHT
    lights = bright_lights(low, high, 1.0)
    assert (lights[8:10, 8:10] == 2 * LIGHT).all()


def test_the_pixels_around_a_surface_are_not_empty_where_light_is_near():
    """A smear of motion blur has empty samples between those that hit it."""
    low, high = np.zeros((16, 16, 3), np.float32), np.zeros((32, 32, 3), np.float32)
    low[0, 0], high[:2, :2] = 1, 1
    alpha = np.zeros((32, 32, 1), np.float32)
    alpha[16, 16] = 1
    empty = EmptyRegions(low).mask(tile(low, {RGB: high, "alpha": alpha}), (slice(0, 16), slice(0, 16)))[..., 0]
    near = np.s_[16 - SMEAR : 17 + SMEAR]
    assert not empty[near, near].any() and empty[17 + SMEAR :].all()


def test_only_bright_pixels_that_lack_a_channel_get_one():
    usual = np.random.default_rng(0).uniform(0.05, 3, (8, 8, 3)).astype(np.float32)
    assert without_pure_colours(usual, 1.0) is usual
    dark = np.zeros((8, 8, 3), np.float32)
    dark[..., 1] = 0.5
    assert without_pure_colours(dark, 1.0) is dark
    np.testing.assert_allclose(without_pure_colours(3 * dark, 1.0), np.float32([0.01, 1.5, 0.01]) + 0 * dark)


@pytest.mark.parametrize("red", [0.0, 0.04])
def test_a_pure_colour_comes_back_and_the_pixels_beside_it_stay(red):
    rgb = np.full((24, 24, 3), 0.2, np.float32)
    rgb[:, :12] = red, 10, 0
    mixed = without_pure_colours(rgb, 1.0)
    np.testing.assert_allclose(with_pure_colours(mixed, rgb, mixed, 1.0), rgb, atol=1e-6)


def test_rare_light_of_another_colour_stays_in_pure_light():
    rgb = np.zeros((32, 32, 3), np.float32) + np.float32([0, 10, 0])
    rgb[::4, ::4, 0] = 8
    mixed = without_pure_colours(rgb, 1.0)
    fused = np.broadcast_to(mixed.mean(axis=(0, 1)), mixed.shape)
    red = with_pure_colours(fused, rgb, mixed, 1.0)[8:-8, 8:-8, 0]
    np.testing.assert_allclose(red.mean(), 0.5, rtol=0.15)
