# SPDX-License-Identifier: Apache-2.0
import sys

import numpy as np
import pytest

from oiio_msspl.aovs.features import ALBEDO, HRLS_FEATURES, NORMAL, RGB
from oiio_msspl.arrays import box_downsample
from oiio_msspl.errors import InputError
from oiio_msspl.model.encoding import decode_radiance, encode_features, encode_radiance
from oiio_msspl.model.mean_denoiser import MeanDenoiser
from oiio_msspl.model.oidn import OidnDenoiser
from oiio_msspl.model.render_mean import NOISE_GAIN, lrhs_weight, mean_of_renders
from tests.conftest import noisy, picture


def packed(size=96, spp=4, **layers):
    """A pair of scale 2 with equal noise as the network sees it, and the clean picture."""
    clean = picture(size, size)
    hrls = encode_features({RGB: noisy(clean, spp)} | layers, HRLS_FEATURES, 1.0)
    return small(noisy(clean, spp, seed=1)), hrls, clean


def small(image):
    """An image as an LRHS of scale 2."""
    return encode_radiance(box_downsample(image, 2), 1.0)


def error(values, clean):
    return float(np.abs(values - encode_radiance(clean, 1.0)).mean())


@pytest.fixture(scope="module")
def denoiser():
    pytest.importorskip("pyoidn")
    return OidnDenoiser(threads=1)


def test_it_denoises_the_hrls_and_both_together(denoiser):
    lrhs, hrls, clean = packed(192)
    low, high = (image[..., -3:] for image in denoiser(lrhs, hrls))
    assert error(high, clean) < 0.5 * error(hrls[..., :3], clean)
    # At the LRHS's resolution, both renders tell more than either alone
    expected = small(clean)
    assert np.abs(low - expected).mean() < 0.9 * np.abs(small(decode_radiance(high, 1.0)) - expected).mean()
    assert np.abs(low - expected).mean() < 0.5 * np.abs(lrhs - expected).mean()


def test_it_sees_albedo_and_normal_where_they_are(denoiser):
    """Layers that show an edge keep it sharp; one call's layers do not linger in the next."""
    stripes = np.repeat((np.arange(96) % 16 < 8)[None, :, None], 96, 0)
    albedo = np.broadcast_to(np.where(stripes, 0.2, 0.6), (96, 96, 3)).astype(np.float32)
    normal = np.broadcast_to(np.where(stripes, (0, 0, 1), (0, 1, 0)), (96, 96, 3)).astype(np.float32)
    dim = noisy(albedo, 1)
    lrhs = small(noisy(albedo, 1, seed=1))

    def denoised(**layers):
        hrls = encode_features({RGB: dim} | layers, HRLS_FEATURES, 1.0)
        return [image[..., -3:] for image in denoiser(lrhs, hrls)]

    before = denoised()
    for layers in ({ALBEDO: albedo}, {NORMAL: normal}, {ALBEDO: albedo, NORMAL: normal}):
        low, high = denoised(**layers)
        assert error(high, albedo) < 0.95 * error(before[1], albedo)
        assert np.abs(low - small(albedo)).mean() < 0.95 * np.abs(before[0] - small(albedo)).mean()
    np.testing.assert_allclose(denoised()[1], before[1], atol=1e-5)


def test_sizes_may_change_between_calls(denoiser):
    for size in (96, 64, 128):
        low, high = denoiser(*packed(size)[:2])
        assert (low.shape, high.shape) == ((size // 2, size // 2, 6), (size, size, 19))


def test_its_exposure_is_the_frames_not_the_tiles(denoiser):
    """A dark corner beside a bright one comes out alike, whether the bright one is in the tile or not."""
    lrhs, hrls, _ = packed(256)
    hrls[:, 160:, :3] += 2.0
    _, part = denoiser(lrhs[:, :64], np.ascontiguousarray(hrls[:, :128]))
    _, whole = denoiser(lrhs, hrls)
    np.testing.assert_allclose(part[:, :40], whole[:, :40], atol=0.01)


@pytest.mark.parametrize("layers", [(), (ALBEDO,), (ALBEDO, NORMAL)])
def test_our_network_denoises_the_mean_as_well(denoiser, layers, quantised_networks):
    """With or without the layers, and where sides are no multiple of what it needs."""
    clean = picture(200, 200)
    normal = np.broadcast_to(np.float32([0.6, -0.8, 0.0]), clean.shape)
    there = {ALBEDO: noisy(clean.clip(0, 1), 1024).clip(0, 1), NORMAL: normal}
    lrhs, hrls, clean = packed(200, **{name: there[name] for name in layers})
    low, high = MeanDenoiser(threads=1)(lrhs, hrls)
    assert high is hrls
    np.testing.assert_array_equal(low[..., :3], lrhs)
    expected = small(clean)
    theirs = denoiser(lrhs, hrls)[0]
    assert np.abs(low[..., 3:] - expected).mean() < 1.1 * np.abs(theirs[..., 3:] - expected).mean()


def test_noise_is_estimated_from_how_far_the_renders_differ():
    """Of the mean of both, on average, whatever either render's share of samples."""
    clean = 0.5 + 0.3 * picture(192, 192)
    for spp in ((8, 8), (24, 8)):
        lrhs, hrls = (encode_radiance(noisy(clean, n, seed), 1.0) for seed, n in enumerate(spp))
        low = mean_of_renders(lrhs, {"colour": hrls})
        error = np.abs(low["colour"] - encode_radiance(clean, 1.0)).mean()
        assert low["noise"].mean() / NOISE_GAIN == pytest.approx(error, rel=0.1)
        assert 0 < low["noise"].min() <= low["noise"].max() <= 1


@pytest.mark.parametrize(("spp", "expected"), [((4, 4), 0.5), ((12, 4), 0.75), ((4, 12), 0.25)])
def test_the_less_noisy_render_counts_more(spp, expected):
    """As much as the best mean of both wants: by their samples, if noise is all that they differ by."""
    clean = 0.5 + 0.3 * picture(192, 192)
    lrhs, hrls = (encode_radiance(noisy(clean, n, seed), 1.0) for seed, n in enumerate(spp))
    assert lrhs_weight(lrhs, hrls) == pytest.approx(expected, abs=0.07)


def test_without_noise_both_renders_count_alike():
    image = encode_radiance(picture(64, 64), 1.0)
    assert lrhs_weight(image, image) == 0.5


def test_without_the_package_the_way_out_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with pytest.raises(InputError, match=r"pip install pyoidn==2\.5\.1, or choose another --model"):
        OidnDenoiser()


def test_the_layers_of_the_lrhs_take_noise_out_of_the_means():
    """By as many samples as it has; those of another picture, or of none, are left alone."""
    clean = 0.3 + 0.4 * picture(192, 192).clip(0, 1)

    def mean(image):
        return box_downsample(image, 2)

    layers = {"colour": encode_radiance(noisy(clean, 4), 1.0), "albedo": noisy(clean, 16, seed=2)}
    lrhs = small(noisy(clean, 4, seed=1))
    alone = mean_of_renders(lrhs, layers)
    both = mean_of_renders(lrhs, layers, {"albedo": mean(noisy(clean, 16, seed=3)), "normal": mean(clean)})
    assert "normal" not in both
    error, before = (np.square(image["albedo"] - mean(clean)).mean() for image in (both, alone))
    assert error == pytest.approx(before / 2, rel=0.15)
    rng = np.random.default_rng(4)
    for other in (mean(clean)[:, ::-1], rng.random((96, 96, 3), dtype=np.float32), np.zeros((96, 96, 3), np.float32)):
        np.testing.assert_array_equal(mean_of_renders(lrhs, layers, {"albedo": other})["albedo"], alone["albedo"])
