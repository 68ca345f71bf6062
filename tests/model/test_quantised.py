# SPDX-License-Identifier: Apache-2.0
"""Denoising networks in 8 bits."""

from unittest.mock import Mock

import numpy as np
import pytest

from oiio_msspl import Render, Session, find_model, fuse
from oiio_msspl.arrays import box_downsample
from oiio_msspl.colour import srgb
from oiio_msspl.errors import InputError
from oiio_msspl.model import oidn, quantised
from oiio_msspl.model.encoding import decode_radiance, encode_radiance
from oiio_msspl.model.oidn import TOLERANCE, OidnDenoiser
from oiio_msspl.model.pu_curve import pu_encode
from oiio_msspl.model.quantised import INPUT_CHANNELS, QuantisedDenoiser, quantise
from tests.conftest import noisy, picture


def layers(height, width, seed=0):
    clean = picture(height, width)
    normal = np.broadcast_to(np.float32([0.6, -0.8, 0.0]), clean.shape)
    return {"colour": encode_radiance(noisy(clean, 4, seed), 1.0), "albedo": clean.clip(0, 1), "normal": normal}


def test_the_slices_of_a_value_add_up_to_it():
    drawn = layers(21, 35)
    drawn["colour"][0, 0] = encode_radiance(np.float32([0.0, 1.0, 60000.0]), 1.0)
    codes = quantise(**drawn)
    assert codes.shape == (32, 48, INPUT_CHANNELS)
    colour = codes[:21, :35, :9].reshape(21, 35, 3, 3).sum(-1, dtype=int) / (3 * 255)
    radiance = decode_radiance(drawn["colour"], 1.0).astype(np.float64)
    np.testing.assert_allclose(colour, pu_encode(radiance), atol=0.6 / (3 * 255))
    np.testing.assert_allclose(codes[:21, :35, 9:12] / 255, drawn["albedo"], atol=0.6 / 255)
    np.testing.assert_allclose(codes[:21, :35, 12:15] / 127.5 - 1, drawn["normal"], atol=1.01 / 255)
    np.testing.assert_array_equal(codes[21:], np.broadcast_to(codes[20], (11, 48, 16)))
    alone = quantise(drawn["albedo"])
    albedo = alone[:21, :35, :15].reshape(21, 35, 3, 5).sum(-1, dtype=int) / (5 * 255)
    np.testing.assert_allclose(albedo, srgb(drawn["albedo"]), atol=0.6 / (5 * 255))


@pytest.fixture(scope="module")
def both_ways():
    pytest.importorskip("pyoidn")
    return OidnDenoiser(threads=1), OidnDenoiser(threads=1, exact=True)


@pytest.mark.parametrize("task", ["hrls", "mean", "albedo"])
def test_eight_bits_come_near_open_image_denoise(both_ways, task, quantised_networks):
    """The difference is a tenth of the noise that it removes, also where sides are no multiple of the alignment."""
    ours, theirs = (getattr(way, task) for way in both_ways)
    assert ours.is_quantised
    drawn = layers(100, 150)
    if task == "albedo":
        drawn = {"albedo": noisy(drawn["albedo"], 4).clip(0, 1)}
    result, expected = ours(drawn), theirs(drawn)
    first = next(iter(drawn.values()))
    assert result.shape == first.shape
    assert np.abs(result - expected).mean() < 0.1 * np.abs(first - expected).mean()
    assert np.abs(result - expected).mean() < TOLERANCE


def test_without_all_images_open_image_denoise_runs_itself(both_ways):
    drawn = layers(64, 64)
    del drawn["normal"]
    np.testing.assert_array_equal(both_ways[0].hrls(drawn), both_ways[1].hrls(drawn))


@pytest.mark.parametrize("trouble", ["other weights", "wrong results", "no operators"])
def test_a_network_that_cannot_be_trusted_is_not_used(
    both_ways, monkeypatch, caplog, trouble, forget_pyoidn, quantised_networks
):
    if trouble == "other weights":
        monkeypatch.setattr(oidn, "find_weights", lambda network: None)
    elif trouble == "no operators":
        monkeypatch.setattr(quantised, "load_network", Mock(side_effect=InputError("onnxruntime can't load it")))
    else:
        plain = QuantisedDenoiser.__call__
        monkeypatch.setattr(QuantisedDenoiser, "__call__", lambda self, **images: plain(self, **images) + 0.02)
    doubted, drawn = OidnDenoiser(threads=1), layers(64, 64)
    with caplog.at_level("INFO", logger="oiio_msspl"):
        for task in ("hrls", "mean"):
            np.testing.assert_array_equal(getattr(doubted, task)(drawn), getattr(both_ways[1], task)(drawn))
    said = {
        "other weights": "has other weights",
        "wrong results": "wrongly (difference 0.0",
        "no operators": "can't load it",
    }
    assert said[trouble] in caplog.text


def test_a_session_may_ask_for_open_image_denoise_itself(both_ways, quantised_networks):
    clean = picture(64, 64)
    lr = Render.from_arrays("lr", rgb=box_downsample(noisy(clean, 4, seed=1), 2))
    hr = Render.from_arrays("hr", rgb=noisy(clean, 4), albedo=clean.clip(0, 1), normal=layers(64, 64)["normal"])
    model = find_model(2, "mix")
    quick, exact = (fuse(lr, hr, Session(model, threads=1, exact=exact)).rgb for exact in (False, True))
    assert 0 < np.abs(quick - exact).mean() < 0.02 * clean.mean()
