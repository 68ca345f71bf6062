# SPDX-License-Identifier: Apache-2.0
"""The network in 8 bits that denoises the mean of both renders."""

import numpy as np
import pytest

from oiio_msspl.aovs.features import ALBEDO, HRLS_FEATURES, NORMAL, RGB
from oiio_msspl.arrays import box_downsample
from oiio_msspl.model.encoding import decode_radiance, encode_features, encode_radiance
from oiio_msspl.model.mean_denoiser import INPUT_CHANNELS, MeanDenoiser, quantise
from oiio_msspl.model.pu_curve import pu_encode
from oiio_msspl.model.render_mean import denoiser_images, mean_of_renders
from tests.conftest import noisy, picture


def pair(size, **layers):
    """An encoded pair of scale 2 with equal noise, and the clean picture at the LRHS's resolution, log-encoded."""
    clean = picture(size, size)
    hrls = encode_features({RGB: noisy(clean, 4)} | layers, HRLS_FEATURES, 1.0)
    lrhs, expected = (encode_radiance(box_downsample(image, 2), 1.0) for image in (noisy(clean, 4, seed=1), clean))
    return lrhs, hrls, expected


def test_the_slices_of_a_value_add_up_to_it():
    clean = picture(21, 35)
    colour = encode_radiance(noisy(clean, 4), 1.0)
    colour[0, 0] = encode_radiance(np.float32([0.0, 1.0, 60000.0]), 1.0)
    albedo, noise = clean.clip(0, 1), np.full((21, 35, 1), 0.25, np.float32)
    normal = np.broadcast_to(np.float32([0.6, -0.8, 0.0]), clean.shape)
    codes = quantise(colour, albedo, normal, noise)
    assert codes.shape == (32, 48, INPUT_CHANNELS)
    slices = codes[:21, :35, :9].reshape(21, 35, 3, 3).sum(-1, dtype=int) / (3 * 255)
    radiance = decode_radiance(colour, 1.0).astype(np.float64)
    np.testing.assert_allclose(slices, pu_encode(radiance), atol=0.6 / (3 * 255))
    np.testing.assert_allclose(codes[:21, :35, 9:12] / 255, albedo, atol=0.6 / 255)
    np.testing.assert_allclose(codes[:21, :35, 12:15] / 127.5 - 1, normal, atol=1.01 / 255)
    np.testing.assert_allclose(codes[:21, :35, 15:] / 255, noise, atol=0.6 / 255)
    np.testing.assert_array_equal(codes[21:], np.broadcast_to(codes[20], (11, 48, 16)))


@pytest.mark.parametrize("layers", [(), (ALBEDO,), (ALBEDO, NORMAL)])
def test_it_denoises_the_mean_about_as_well_as_open_image_denoise(layers):
    """In 8 bits its error is at most 1.3 times OIDN's, with or without albedo and normal, and for sides of any size."""
    pytest.importorskip("pyoidn")
    from benchmarks.oidn import run_filter

    clean = picture(200, 200)
    normal = np.broadcast_to(np.float32([0.6, -0.8, 0.0]), clean.shape)
    there = {ALBEDO: noisy(clean.clip(0, 1), 1024).clip(0, 1), NORMAL: normal}
    lrhs, hrls, expected = pair(200, **{name: there[name] for name in layers})
    low, high = MeanDenoiser(threads=1)(lrhs, hrls)
    assert high is hrls
    np.testing.assert_array_equal(low[..., :3], lrhs)
    mean = mean_of_renders(lrhs, denoiser_images(hrls))
    if ALBEDO in layers:
        mean[ALBEDO] = run_filter({"albedo": mean[ALBEDO]})
    images = {"color": decode_radiance(mean["colour"], 1.0)} | {name: mean[name] for name in layers}
    theirs = encode_radiance(run_filter(images, input_scale=1.0, hdr=True, cleanAux=bool(layers)), 1.0)
    assert np.abs(low[..., 3:] - expected).mean() < 1.3 * np.abs(theirs - expected).mean()


def test_it_takes_most_of_the_noise():
    lrhs, hrls, expected = pair(192)
    denoised = MeanDenoiser(threads=1)(lrhs, hrls)[0][..., 3:]
    mean = mean_of_renders(lrhs, denoiser_images(hrls))["colour"]
    assert np.abs(denoised - expected).mean() < 0.4 * np.abs(mean - expected).mean()


def test_sizes_may_change_between_calls():
    denoiser = MeanDenoiser(threads=1)
    for size in (96, 64, 128):
        assert denoiser(*pair(size)[:2])[0].shape == (size // 2, size // 2, 6)
