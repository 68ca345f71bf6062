# SPDX-License-Identifier: Apache-2.0
"""The weighted mean of both renders."""

import numpy as np
import pytest

from oiio_msspl.arrays import box_downsample
from oiio_msspl.model.encoding import encode_radiance
from oiio_msspl.model.render_mean import NOISE_GAIN, lrhs_weight, mean_of_renders, mean_settings
from tests.conftest import noisy, picture


def small(image):
    """An image as an LRHS of scale 2."""
    return encode_radiance(box_downsample(image, 2), 1.0)


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


@pytest.mark.parametrize("same", [True, False])
def test_a_frame_is_averaged_as_its_parts_suggest_together(same):
    """Cut into bands, an image gives the settings of the whole, but for what crosses their borders."""
    clean = 0.3 + 0.4 * picture(192, 192).clip(0, 1)
    lrhs, hrls = small(noisy(clean, 12)), np.dstack([encode_radiance(noisy(clean, 4, seed=1), 1.0), clean, clean])
    albedo = box_downsample(clean if same else clean[::-1], 2)
    whole = mean_settings([(lrhs, hrls, {"albedo": albedo})])
    rows = [slice(i, i + 8) for i in range(0, 96, 8)]
    parts = [(lrhs[r], hrls[2 * r.start : 2 * r.stop], {"albedo": albedo[r]}) for r in rows]
    together = mean_settings(parts)
    assert together.lrhs_weight == pytest.approx(whole.lrhs_weight, abs=0.02)
    assert together.lrhs_aovs == whole.lrhs_aovs == (("albedo",) if same else ())
