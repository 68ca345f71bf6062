# SPDX-License-Identifier: Apache-2.0
import sys

import numpy as np
import pytest

from oiio_msspl import schema, tensors, transforms
from oiio_msspl.denoiser import Denoiser
from oiio_msspl.errors import InputError
from tests.conftest import noisy, picture


def packed(size=96, **layers):
    """An HRLS as the network sees it, and the clean picture."""
    clean = picture(size, size)
    return tensors.pack({schema.RGB: noisy(clean, 4)} | layers, schema.HRLS_FEATURES, 1.0), clean


def error(values, clean):
    return float(np.abs(values - transforms.compress(clean, 1.0)).mean())


@pytest.fixture(scope="module")
def denoiser():
    pytest.importorskip("pyoidn")
    return Denoiser(threads=1)


def test_it_denoises(denoiser):
    hrls, clean = packed()
    assert error(denoiser(hrls), clean) < 0.5 * error(hrls[..., :3], clean)


def test_it_sees_albedo_and_normal_where_they_are(denoiser):
    """Layers that show an edge keep it sharp; one call's layers do not linger in the next."""
    stripes = np.repeat((np.arange(96) % 8 < 4)[None, :, None], 96, 0)
    albedo = np.broadcast_to(np.where(stripes, 0.2, 0.6), (96, 96, 3)).astype(np.float32)
    normal = np.broadcast_to(np.where(stripes, (0, 0, 1), (0, 1, 0)), (96, 96, 3)).astype(np.float32)
    dim = noisy(albedo, 1)
    plain = tensors.pack({schema.RGB: dim}, schema.HRLS_FEATURES, 1.0)
    before = denoiser(plain)
    for layers in ({schema.ALBEDO: albedo}, {schema.NORMAL: normal}, {schema.ALBEDO: albedo, schema.NORMAL: normal}):
        hrls = tensors.pack({schema.RGB: dim} | layers, schema.HRLS_FEATURES, 1.0)
        assert error(denoiser(hrls), albedo) < 0.95 * error(before, albedo)
    np.testing.assert_allclose(denoiser(plain), before, atol=1e-5)


def test_sizes_may_change_between_calls(denoiser):
    for size in (96, 64, 128):
        assert denoiser(packed(size)[0]).shape == (size, size, 3)


def test_its_exposure_is_the_frames_not_the_tiles(denoiser):
    """A dark corner beside a bright one comes out alike, whether the bright one is in the tile or not."""
    hrls, _ = packed(256)
    hrls[:, 160:, :3] += 2.0
    part = denoiser(np.ascontiguousarray(hrls[:, :128]))
    np.testing.assert_allclose(part[:, :40], denoiser(hrls)[:, :40], atol=0.01)


def test_without_the_package_the_way_out_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with pytest.raises(InputError, match="pip install pyoidn, or choose another --model"):
        Denoiser()
