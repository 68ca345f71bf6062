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
    area = Window(0, 0, 8, 8)
    whole, pixels = Window(0, 0, 16, 16), (slice(0, 8), slice(0, 8))
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
