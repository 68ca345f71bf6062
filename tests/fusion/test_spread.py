# SPDX-License-Identifier: Apache-2.0
"""Pairs whose noise the pixel filter has spread."""

import numpy as np
import pytest

from oiio_msspl import Render, fuse
from oiio_msspl.fusion.tiles import tiling
from oiio_msspl.image.colour import srgb
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.model.catalogue import load_model
from tests.conftest import noisy, picture, spread

SCALES = (2, 4, 8)


@pytest.fixture(scope="module", params=SCALES)
def session(request):
    return load_model(request.param, "joint-spread")


def psnr(image, reference):
    return -10 * np.log10(np.mean((srgb(image) - srgb(reference)) ** 2))


def spread_pair(clean, scale, **layers):
    low, high = noisy(box_downsample(clean, scale), scale**2, seed=1), noisy(clean, 1)
    return Render.from_arrays("lr", rgb=spread(low, 0.5)), Render.from_arrays("hr", rgb=spread(high, 0.5), **layers)


def test_spread_noise_is_removed(session):
    """The network for independent noise leaves most of it in."""
    clean = picture(256, 384)
    pair = spread_pair(clean, session.contract.scale)
    whole = load_model(session.contract.scale, "joint")
    reference = spread(clean, 0.5)
    assert psnr(fuse(*pair, session).rgb, reference) > psnr(fuse(*pair, whole).rgb, reference) + 3


@pytest.mark.parametrize(("height", "width"), [(53, 125), (48, 100)])
def test_any_size_alpha_and_error(session, height, width):
    scale = session.contract.scale
    size = (-(-height // scale), -(-width // scale))
    low, high = np.full((*size, 3), 0.5, np.float32), np.full((height, width, 3), 0.5, np.float32)
    alpha = np.ones((height, width, 1), np.float32)
    alpha[:, : width // 2] = 0
    lr_alpha = np.ones((*size, 1), np.float32)
    lr_alpha[:, : size[1] // 2] = 0
    high[::3, ::3] = 0.8
    lr, hr = Render.from_arrays("lr", rgb=low, alpha=lr_alpha), Render.from_arrays("hr", rgb=high, alpha=alpha)
    fused = fuse(lr, hr, session, error=True)
    assert fused.rgb.shape == (height, width, 3) and fused.alpha.shape == fused.error.shape == (height, width, 1)
    assert np.isfinite(fused.rgb).all() and fused.rgb.min() > 0.4 and fused.rgb.max() < 0.9
    left, right = fused.alpha[:, : width // 2 - 4 * scale], fused.alpha[:, width // 2 + 4 * scale :]
    assert np.all(left == 0) and np.all(right == 1)
    assert (fused.error > 0).any()


def test_tiles_give_nearly_the_same_as_a_whole_frame(monkeypatch):
    session = load_model(2, "joint-spread")
    pair = spread_pair(picture(512, 768), 2)
    whole = fuse(*pair, session)
    monkeypatch.setattr(tiling, "TILE_MEMORY", 130 << 20)
    tiled = fuse(*pair, session)
    assert tiled.tiles > 1
    assert np.abs(srgb(tiled.rgb) - srgb(whole.rgb)).max() < 0.02


def test_empty_pixels_stay_black(session):
    clean = picture(128, 128)
    clean[:, :64] = 0
    fused = fuse(*spread_pair(clean, session.contract.scale), session)
    assert np.all(fused.rgb[:, : 64 - 3 * session.contract.scale] == 0)
    assert fused.rgb[:, 70:].mean() > 0.01
