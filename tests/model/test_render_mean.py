# SPDX-License-Identifier: Apache-2.0
"""How much each render counts in the mean of both."""

import numpy as np
import pytest

from oiio_msspl.image.filters import box_downsample
from oiio_msspl.model.encoding import encode_radiance
from oiio_msspl.model.render_mean import find_shares, lrhs_share
from tests.conftest import noisy, picture


@pytest.mark.parametrize(("spp", "expected"), [((4, 4), 0.5), ((12, 4), 0.75), ((4, 12), 0.25)])
def test_the_less_noisy_render_counts_more(spp, expected):
    """As much as the best mean of both wants: by their samples, if noise is all that they differ by."""
    clean = 0.5 + 0.3 * picture(192, 192)
    lrhs, hrls = (encode_radiance(noisy(clean, n, seed), 1.0) for seed, n in enumerate(spp))
    assert lrhs_share(lrhs, hrls) == pytest.approx(expected, abs=0.07)


def test_without_noise_both_renders_count_alike():
    image = encode_radiance(picture(64, 64), 1.0)
    assert lrhs_share(image, image) == 0.5


@pytest.mark.parametrize("shape", [(1, 32, 3), (32, 1, 3)])
def test_of_one_row_both_renders_count_alike(shape):
    """There is nothing to compare."""
    assert lrhs_share(np.ones(shape, np.float32), np.ones(shape, np.float32)) == 0.5


def test_layers_of_the_lrhs_count_if_they_show_the_same():
    """And only if both renders have them."""
    clean = 0.3 + 0.4 * picture(192, 192).clip(0, 1)
    hrls = {"rgb": noisy(clean, 4), "albedo": noisy(clean, 16, seed=2)}

    def shares(**layers):
        lrhs = {"rgb": box_downsample(noisy(clean, 4, seed=1), 2)} | layers
        return find_shares([(lrhs, hrls)], 1.0)

    alone = shares()
    low = box_downsample(clean, 2)
    found = shares(albedo=box_downsample(noisy(clean, 16, seed=3), 2), normal=low)
    assert found == {"rgb": alone["rgb"], "albedo": alone["rgb"]}
    rng = np.random.default_rng(4)
    for other in (low[:, ::-1], rng.random(low.shape, dtype=np.float32), np.zeros_like(low)):
        assert shares(albedo=other) == alone


def test_the_exposure_does_not_change_with_the_light():
    """A darker frame with a higher exposure gives the same shares."""
    clean = 0.3 + 0.4 * picture(192, 192).clip(0, 1)
    lrhs, hrls = box_downsample(noisy(clean, 12), 2), noisy(clean, 4, seed=1)
    shares = find_shares([({"rgb": lrhs}, {"rgb": hrls})], 1.0)
    darker = find_shares([({"rgb": lrhs / 512}, {"rgb": hrls / 512})], 512.0)
    assert darker["rgb"] == pytest.approx(shares["rgb"], abs=1e-4)


@pytest.mark.parametrize("same", [True, False])
def test_a_frame_is_averaged_as_its_parts_suggest_together(same):
    """Cut into bands, an image gives the shares of the whole, but for what crosses their borders."""
    clean = 0.3 + 0.4 * picture(192, 192).clip(0, 1)
    lrhs = {"rgb": box_downsample(noisy(clean, 12), 2), "albedo": box_downsample(clean if same else clean[::-1], 2)}
    hrls = {"rgb": noisy(clean, 4, seed=1), "albedo": clean}

    def rows(images, first, count):
        return {name: image[first : first + count] for name, image in images.items()}

    whole = find_shares([(lrhs, hrls)], 1.0)
    together = find_shares([(rows(lrhs, i, 8), rows(hrls, 2 * i, 16)) for i in range(0, 96, 8)], 1.0)
    assert together["rgb"] == pytest.approx(whole["rgb"], abs=0.02)
    assert together.keys() == whole.keys() == ({"rgb", "albedo"} if same else {"rgb"})


def test_neither_render_is_left_out_of_the_mean():
    clean = 0.5 + 0.3 * picture(64, 64)
    free, rough = (encode_radiance(image, 1.0) for image in (clean, noisy(clean, 1)))
    assert lrhs_share(free, rough) == 0.95
    assert lrhs_share(rough, free) == 0.05
