# SPDX-License-Identifier: Apache-2.0
"""Tests of :mod:`oiio_msspl.image.filters`."""

import warnings

import numpy as np
import pytest

from oiio_msspl.image.filters import all_within, box_downsample, filled, max_around, means_around, upsample_linear


@pytest.mark.parametrize("size", [(40, 27), (9, 5), (1, 30)])
def test_means_are_those_of_the_pixels_around_that_exist(size):
    plane = np.random.default_rng(0).random(size, np.float32)
    for reach in (1, 4, 14):
        means = means_around(plane, reach)
        for y, x in np.ndindex(size):
            around = plane[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1]
            assert means[y, x] == pytest.approx(around.mean(dtype=np.float64), rel=1e-6)


def test_a_dark_region_beside_a_lamp_keeps_its_mean():
    plane = np.full((200, 300), 1e-3, np.float32)
    plane[:4, :4] = 65504
    means = means_around(plane, 2)
    np.testing.assert_allclose(means[50:], 1e-3, rtol=1e-4)


def test_a_mean_is_not_below_0_beside_a_lamp():
    """Its root is taken, which would be no number."""
    rng = np.random.default_rng(2)
    plane = np.zeros((48, 80), np.float32)
    plane[:, 20:30], plane[10:14] = rng.random((48, 10)) ** 4, 0.1 * rng.random((4, 80))
    assert means_around(plane, 3).min() == 0


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_means_are_exact_and_finite_up_to_the_largest_value(dtype):
    """Also where the sum of the pixels does not fit into their type."""
    image = np.full((8, 8, 3), np.finfo(dtype).max, dtype)
    image[4:] = 0.1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        means = box_downsample(image, 4)
    assert means.dtype == np.float32
    np.testing.assert_allclose(means[1], np.float32(dtype(0.1)), rtol=1e-6)
    # Sums of floats are limited
    expected = np.float32(65504) if dtype is np.float16 else np.finfo(np.float32).max / 16
    np.testing.assert_allclose(means[0], expected, rtol=1e-6)


@pytest.mark.parametrize("size", [(64, 64), (37, 51), (5, 29)])
def test_missing_pixels_are_filled_from_those_around(size):
    ramp = np.linspace(1, 2, size[1], dtype=np.float32)[None, :, None] * np.ones((*size, 3), np.float32)
    missing = np.zeros(size, bool)
    missing[size[0] // 3 : size[0] // 3 + 12, size[1] // 3 : size[1] // 3 + 5] = True
    image = np.where(missing[..., None], np.float32(0), ramp)
    result = filled(image, missing)
    np.testing.assert_array_equal(result[~missing], ramp[~missing])
    assert np.abs(result - ramp)[missing].max() < 0.2


def test_without_any_known_pixel_nothing_is_filled():
    image = np.zeros((5, 7, 3), np.float32)
    assert filled(image, np.ones((5, 7), bool)) is image
    assert filled(image, np.zeros((5, 7), bool)) is image


@pytest.mark.parametrize("reach", [0, 1, 2, 8, 15])
def test_masks_shrink_and_grow_as_far_as_asked(reach):
    mask = np.zeros((40, 50), bool)
    mask[20, 25] = True
    y, x = np.ogrid[:40, :50]
    near = (abs(y - 20) <= reach) & (abs(x - 25) <= reach)
    np.testing.assert_array_equal(max_around(mask, reach), near)
    np.testing.assert_array_equal(all_within(~mask, reach), ~near)


@pytest.mark.parametrize("scale", [2, 4, 8])
def test_an_enlarged_ramp_is_the_ramp_at_the_middles_of_its_pixels(scale):
    y, x = np.mgrid[:12, :9].astype(np.float32)
    large = upsample_linear(3 * y + 5 * x, scale, slice(2, 10))
    y, x = ((np.arange(n * scale) + 0.5) / scale - 0.5 for n in (8, 9))
    inside = (x >= 0) & (x <= 8)
    np.testing.assert_allclose(large[:, inside], (3 * (2 + y)[:, None] + 5 * x)[:, inside], rtol=1e-5)
