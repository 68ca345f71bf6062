# SPDX-License-Identifier: Apache-2.0
"""What both renders show comes back, and noise does not."""

from __future__ import annotations

import numpy as np
import pytest

from oiio_msspl.fusion.tiles.trust import trust_renders
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.filters import box_downsample

SIZE, REACH = 256, 48


def wall() -> Array:
    """Return a smooth picture, (SIZE, SIZE, 3)."""
    y, x = np.mgrid[:SIZE, :SIZE].astype(np.float32)
    light = 0.4 + 0.2 * np.cos(x / 50) * np.cos(y / 60)
    return light[..., None] * np.array([0.8, 0.6, 0.5], np.float32)


def rendered(truth: Array, spp: int, seed: int) -> Array:
    """Return a render whose samples have an exponential distribution."""
    noise = np.random.default_rng(seed).gamma(spp, 1 / spp, truth.shape[:2]).astype(np.float32)
    return truth * noise[..., None]


def pair(truth: Array, spp: tuple[int, int], scale: int = 2) -> tuple[Array, Array, float]:
    """Return an LRHS and an HRLS with (LRHS, HRLS) samples a pixel, and the share of the LRHS in their mean."""
    low, high = spp
    # A sample of the LRHS lies anywhere in its pixel.
    lrhs = box_downsample(rendered(truth, max(low // scale**2, 1), 1), scale)
    return lrhs, rendered(truth, high, 2), low / (low + high * scale**2)


def trusted(
    fused: Array, lrhs: Array, hrls: Array, share: float = 0.5, exposure: float = 1.0, reach: int = REACH
) -> tuple[Array, Array]:
    return trust_renders(fused, lrhs, hrls, share=share, exposure=exposure, reach=reach)


def rms(image: Array, truth: Array) -> float:
    """Return the root mean square error relative to the truth."""
    return float(np.sqrt(np.mean(np.square((image - truth) / (truth + 0.01)))))


@pytest.mark.parametrize("scale", [2, 4, 8])
@pytest.mark.parametrize("hrls_spp", [1, 16])
def test_noise_is_not_put_back(scale: int, hrls_spp: int) -> None:
    truth = wall()
    renders = pair(truth, (hrls_spp * scale**2, hrls_spp), scale)
    result, trust = trusted(truth, *renders, reach={2: 48, 4: 32, 8: 16}[scale])
    assert rms(renders[1], truth) > 0.2
    assert rms(result, truth) < 0.005
    assert trust.mean() < 0.002


@pytest.mark.parametrize("scale", [2, 4])
def test_detail_that_both_renders_show_comes_back(scale: int) -> None:
    y, x = np.mgrid[:SIZE, :SIZE]
    truth = wall() * (1 + 0.3 * np.where((x // 2 + y // 3) % 2, 1, -1))[..., None].astype(np.float32)
    renders = pair(truth, (64 * scale**2, 64), scale)
    result, trust = trusted(wall(), *renders)
    assert rms(wall(), truth) > 0.25
    assert rms(result, truth) < rms(renders[1], truth)
    assert trust.mean() > 0.7


def test_a_picture_that_keeps_the_noise_of_the_hrls_does_not_hide_its_own_error() -> None:
    """It differs from the HRLS by no more than noise, so only the LRHS tells that it is worse."""
    truth = wall()
    renders = pair(truth, (256, 64))
    fused = rendered(renders[1], 40, 5)
    result, _ = trusted(fused, *renders)
    assert rms(fused, truth) > 1.5 * rms(renders[1], truth)
    assert rms(result, truth) < 1.15 * rms(renders[1], truth)


def test_two_renders_of_one_size_tell_their_noise() -> None:
    y, x = np.mgrid[:SIZE, :SIZE]
    truth = wall() * (1 + 0.3 * np.where((x // 2 + y // 3) % 2, 1, -1))[..., None].astype(np.float32)
    first, second = (rendered(truth, 64, seed) for seed in (1, 2))
    result, _ = trusted(wall(), first, second)
    assert rms(result, truth) < 1.05 * rms((first + second) / 2, truth)
    noise, _ = trusted(truth, first, second)
    assert rms(noise, truth) < 0.005


def test_a_firefly_of_one_render_does_not_come_back() -> None:
    truth = wall()
    for seed in range(5):
        renders = pair(truth, (16, 4))
        y, x = np.random.default_rng(seed).integers(40, SIZE - 40, 2)
        renders[1][y, x] = 200
        result, _ = trusted(truth, *renders)
        assert result[y, x].max() < 2


def test_stars_come_back() -> None:
    rng = np.random.default_rng(3)
    truth = np.full((SIZE, SIZE, 3), 0.002, np.float32)
    y, x = rng.integers(0, SIZE, (2, 600))
    truth[y, x] = rng.exponential(1, (600, 1)) + 0.2
    fused = np.full_like(truth, truth.mean() / 3)
    noisy = truth.copy()
    noisy[y, x] *= rng.normal(1, 0.1, (600, 1))
    result, _ = trusted(fused, box_downsample(truth, 2), noisy, exposure=5.0)
    assert result[y, x].mean() == pytest.approx(truth[y, x].mean(), rel=0.1)


def test_a_lamp_alone_comes_back() -> None:
    truth = wall()
    truth[100:102, 60:62] = 60
    renders = pair(wall(), (256, 64))
    renders[1][100:102, 60:62] = 60
    renders[0][50, 30] = 60
    fused = wall()
    fused[100:102, 60:62] = 5
    result, _ = trusted(fused, *renders)
    assert result[100:102, 60:62].mean() == pytest.approx(60, rel=0.05)
    assert rms(result[110:], wall()[110:]) < 0.01
    around = result[90:112, 50:72] / wall()[90:112, 50:72]
    assert np.median(around) == pytest.approx(1, abs=0.02)


def test_light_that_the_network_has_lost_comes_back() -> None:
    truth = wall()
    renders = pair(truth, (256, 16))
    result, _ = trusted(truth * np.array([1, 1.03, 0.85], np.float32), *renders)
    ratio = result.mean(axis=(0, 1)) / truth.mean(axis=(0, 1))
    assert ratio == pytest.approx(1, abs=0.01)


def test_a_wider_filter_of_the_lrhs_is_no_light() -> None:
    # An LRHS pixel with a wide filter sees what lies around it. The HRLS does not agree, so edges stay.
    y, x = np.mgrid[:SIZE, :SIZE]
    truth = wall() * np.where((x // 16 + y // 16) % 2, 1.0, 0.1)[..., None].astype(np.float32)
    low = box_downsample(truth, 4)
    padded = np.pad(low, ((1, 1), (1, 1), (0, 0)), "edge")
    blurred = sum(padded[i : i + len(low), j : j + len(low)] for i in range(3) for j in range(3)) / 9
    result, _ = trusted(truth, blurred.astype(np.float32), rendered(truth, 4, 1), 0.9, reach=32)
    assert rms(result, truth) < 0.02


def test_black_renders_stay_black() -> None:
    black = np.zeros((64, 64, 3), np.float32)
    result, trust = trusted(black, black[::2, ::2], black)
    assert not result.any() and not trust.any()


@pytest.mark.parametrize("ambient", [0.0, 0.15])
@pytest.mark.parametrize("scale", [1, 2])
def test_light_that_few_samples_find_stays(scale: int, ambient: float) -> None:
    truth, found = wall(), 0.004
    rng = np.random.default_rng(1)

    def render(side: int, spp: int) -> Array:
        hits = rng.binomial(spp, found, (side, side)) / (spp * found)
        return (ambient + (1 - ambient) * hits)[..., None].astype(np.float32)

    lrhs = render(SIZE // scale, scale**2) * box_downsample(truth, scale)
    result, _ = trusted(truth, lrhs, render(SIZE, 1) * truth)
    assert rms(result, truth) < 0.05
    assert result.min() > 0.5 * truth.min()


def test_light_that_both_renders_find_in_the_same_pixels_by_chance_is_not_lost() -> None:
    """With 16 samples that find it once in 50, a quarter of the pixels has light, and one in 13 in both renders."""
    truth, rng = wall(), np.random.default_rng(1)
    first, second = (truth * (rng.binomial(16, 0.02, (SIZE, SIZE, 1)) / 0.32).astype(np.float32) for _ in range(2))
    result, _ = trusted(truth, first, second)
    assert result.mean() == pytest.approx(truth.mean(), rel=0.02)


@pytest.mark.parametrize("scale", [1, 2])
@pytest.mark.parametrize("lit", [0.02, 0.1, 0.3, 0.5, 0.7, 0.9])
@pytest.mark.parametrize("kept", [1.0, 0.7])
def test_two_noisy_renders_do_not_agree_on_points(scale: int, lit: float, kept: float) -> None:
    """A sample is lit or in shadow, so that two often have the same light. The picture may be too dark."""
    truth, rng = wall(), np.random.default_rng(1)

    def render(side: int, spp: int) -> Array:
        samples = (rng.random((spp, side, side)) < lit) * rng.gamma(100, 1 / 100, (spp, side, side)) / lit
        return box_downsample(truth, SIZE // side) * samples.mean(axis=0)[..., None].astype(np.float32)

    renders = render(SIZE // scale, scale**2), render(SIZE, 2), 1 / 3
    result, trust = trusted(truth * np.float32(kept), *renders)
    assert rms(result, truth) < 0.02 + 1.05 * (1 - kept)
    assert trust.mean() < 0.01
