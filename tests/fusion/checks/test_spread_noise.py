# SPDX-License-Identifier: Apache-2.0
"""Whether the pixel filter has spread the noise."""

import numpy as np
import pytest

from oiio_msspl import Render
from oiio_msspl.fusion.checks.noise import is_noise_spread
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.image.filters import box_downsample
from tests.conftest import noisy, picture, spread


def asked(clean, scale, spp, sigma=None):
    low, high = noisy(box_downsample(clean, scale), 4 * spp, seed=1), noisy(clean, spp)
    if sigma is not None:
        low, high = spread(low, sigma), spread(high, sigma)
    lr, hr = Render.from_arrays("lr", rgb=low), Render.from_arrays("hr", rgb=high)
    return is_noise_spread(lr, hr, align(lr, hr))


@pytest.mark.parametrize("scale", [2, 4, 8])
@pytest.mark.parametrize("spp", [1, 8])
def test_a_filter_that_spreads_samples_is_noticed(scale, spp):
    clean = picture(512, 760)
    assert not asked(clean, scale, spp)
    for sigma in (0.5, 1.0):
        assert asked(clean, scale, spp, sigma)


def test_texture_is_no_noise():
    """Neighbouring pixels of a texture are alike, but the noise on it is not."""
    rng = np.random.default_rng(0)
    texture = 0.2 + spread(rng.random((512, 512, 1), dtype=np.float32), 1.0) * np.ones(3, np.float32)
    assert not asked(texture, 4, 1000)


@pytest.mark.parametrize("light", [0.0, 0.5])
def test_black_and_flat_frames_tell_nothing(light):
    flat = np.full((128, 128, 3), light, np.float32)
    pair = Render.from_arrays("lr", rgb=flat[::2, ::2]), Render.from_arrays("hr", rgb=flat)
    assert is_noise_spread(*pair, align(*pair)) is None


@pytest.mark.parametrize("seed", range(6))
def test_flat_colours_with_crisp_edges_have_no_noise(seed):
    """Along an edge the renders differ, because samples of a pixel fall on either side."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:256, :256] * 4

    def render(size, spp):
        rows, columns = (v[::size, ::size] + 4 * size * rng.random((spp, 256 // size, 256 // size)) for v in (y, x))
        disc, ground = np.hypot(rows - 400, columns - 400) < 250, rows > 800 + columns / 3
        return Render.from_arrays("r", rgb=(0.2 + 0.5 * disc + 0.2 * ground).mean(0)[..., None].repeat(3, -1))

    lr, hr = render(4, 16), render(1, 1)
    assert is_noise_spread(lr, hr, align(lr, hr)) is None


def test_frames_without_noise_are_not_spread():
    for clean in (picture(300, 200), np.zeros((64, 64, 3), np.float32), np.ones((6, 6, 3), np.float32)):
        pair = Render.from_arrays("lr", rgb=box_downsample(clean, 2)), Render.from_arrays("hr", rgb=clean)
        assert not is_noise_spread(*pair, align(*pair))
