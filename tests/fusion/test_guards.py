# SPDX-License-Identifier: Apache-2.0
"""Guards around the network."""

import numpy as np
import pytest

from oiio_msspl.aovs.features import ALBEDO, RADIANCE_FEATURES, RGB
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.guards import FIREFLY_FACTOR, dim_fireflies
from oiio_msspl.fusion.tile_features import TilePair


def tile(lrhs, hrls):
    """A tile of x2 without a border."""
    size = len(lrhs)
    area, whole, pixels = Window(0, 0, size, size), Window(0, 0, 2 * size, 2 * size), (slice(0, size), slice(0, size))
    return TilePair({RGB: lrhs}, hrls, 2, area, whole, whole, pixels, pixels)


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
    assert 40 <= dimmed[RGB][30, 30].max() <= 64 * 40 and lrhs[20, 20].max() <= 64 * 40


def test_a_lamp_makes_no_fireflies_around_it_believable():
    """Its light is in one square only."""
    low, high = np.full((64, 64, 3), 0.01, np.float32), np.full((128, 128, 3), 0.01, np.float32)
    low[24:32, 24:32], high[48:64, 48:64] = 1e4, 1e4
    high[80, 80] = 1e4
    _, dimmed = dim_fireflies(tile(low, {RGB: high}))
    assert dimmed[RGB][80, 80].max() == np.float32(0.01) * FIREFLY_FACTOR
    assert (dimmed[RGB][48:64, 48:64] == 1e4).all()
