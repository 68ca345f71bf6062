# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from oiio_msspl.image.metrics import RELMSE_GHARBI, psnr, relmse, ssim
from tests.conftest import picture


def test_equal_pictures_have_infinite_psnr_no_relmse_and_ssim_one():
    image = picture(32, 32)
    assert psnr(image, image) == math.inf
    assert relmse(image, image) == 0
    assert ssim(image, image) == pytest.approx(1)


def test_psnr_is_that_of_the_srgb_pictures():
    """A difference of 0.1 in sRGB everywhere is 20 dB, whatever it is in linear light."""
    low, high = (np.full((4, 4, 3), ((v + 0.055) / 1.055) ** 2.4, np.float32) for v in (0.5, 0.6))
    assert psnr(low, high) == pytest.approx(20, abs=1e-3)


def test_relmse_follows_both_conventions():
    image, truth = np.full((2, 2, 3), 3, np.float32), np.full((2, 2, 3), 2, np.float32)
    assert relmse(image, truth) == pytest.approx(0.5 * 1 / 4.01)
    assert relmse(image, truth, RELMSE_GHARBI) == pytest.approx(1 / 4.0001)


def test_highlights_above_white_do_not_count_in_psnr_but_in_relmse():
    truth = np.full((2, 2, 3), 5, np.float32)
    assert psnr(truth * 2, truth) == math.inf
    assert relmse(truth * 2, truth) > 0.4


def test_ssim_of_unrelated_noise_is_near_zero_and_falls_with_noise():
    rng = np.random.default_rng(0)
    a, b = (rng.random((64, 64, 3)).astype(np.float32) for _ in range(2))
    assert abs(ssim(a, b)) < 0.05
    image = picture(64, 64)
    scores = [ssim(image + s * (a - 0.5), image) for s in (0.0, 0.1, 0.4)]
    assert scores == sorted(scores, reverse=True)


def test_ssim_agrees_with_its_definition_on_one_window():
    """On 11 x 11 pixels there is a single window: the formula can be written out."""
    rng = np.random.default_rng(1)
    x, y = rng.random((2, 11, 11))
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    weights = np.outer(taps, taps) / taps.sum() ** 2
    mx, my = (weights * x).sum(), (weights * y).sum()
    vx, vy = (weights * (x - mx) ** 2).sum(), (weights * (y - my) ** 2).sum()
    cov = (weights * (x - mx) * (y - my)).sum()
    expected = (2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))

    def linear(srgb):
        return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)

    images = [np.repeat(linear(v)[..., None], 3, -1).astype(np.float32) for v in (x, y)]
    assert ssim(*images) == pytest.approx(expected, abs=1e-4)


def test_ssim_refuses_pictures_smaller_than_its_window():
    with pytest.raises(ValueError, match="at least 11 x 11"):
        ssim(picture(8, 20), picture(8, 20))
