# SPDX-License-Identifier: Apache-2.0
import hashlib
import struct
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from oiio_msspl.denoiser import Denoiser

from oiio_msspl import Render, Session, denoiser, eight_bit, find_model, fuse, runtime, transforms
from oiio_msspl.errors import InputError
from tests.conftest import noisy, picture


def layers(height, width, seed=0):
    clean = picture(height, width)
    normal = np.broadcast_to(np.float32([0.6, -0.8, 0.0]), clean.shape)
    return {"colour": transforms.compress(noisy(clean, 4, seed), 1.0), "albedo": clean.clip(0, 1), "normal": normal}


def test_the_curve_and_its_inverse():
    radiance = np.concatenate([[0.0], np.geomspace(1e-8, transforms.MAX_RADIANCE, 2000)])
    values = eight_bit.encode(radiance)
    assert values[0] == 0
    assert values[-1] == pytest.approx(1)
    assert (np.diff(values) > 0).all()
    np.testing.assert_allclose(eight_bit.decode(values), radiance, rtol=1e-3, atol=1e-9)


def test_layers_are_written_in_slices_that_add_up():
    drawn = layers(21, 35)
    drawn["colour"][0, 0] = transforms.compress(np.float32([0.0, 1.0, 60000.0]), 1.0)
    codes = eight_bit.pack(**drawn)
    assert codes.shape == (32, 48, eight_bit.CHANNELS_IN)
    colour = codes[:21, :35, :9].reshape(21, 35, 3, 3).sum(-1, dtype=int) / (3 * 255)
    radiance = transforms.expand(drawn["colour"], 1.0).astype(np.float64)
    np.testing.assert_allclose(colour, eight_bit.encode(radiance), atol=0.6 / (3 * 255))
    np.testing.assert_allclose(codes[:21, :35, 9:12] / 255, drawn["albedo"], atol=0.6 / 255)
    np.testing.assert_allclose(codes[:21, :35, 12:15] / 127.5 - 1, drawn["normal"], atol=1.01 / 255)
    np.testing.assert_array_equal(codes[21:], np.broadcast_to(codes[20], (11, 48, 16)))
    alone = eight_bit.pack(drawn["albedo"])
    albedo = alone[:21, :35, :15].reshape(21, 35, 3, 5).sum(-1, dtype=int) / (5 * 255)
    np.testing.assert_allclose(albedo, transforms.srgb(drawn["albedo"]), atol=0.6 / (5 * 255))


def tza(**tensors):
    """Weights as Open Image Denoise has them in its library."""
    data, table = bytearray(struct.pack("<HBBQ", 0x41D7, 2, 0, 0)), struct.pack("<I", len(tensors))
    for name, values in tensors.items():
        table += struct.pack("<H", len(name)) + name.encode() + struct.pack("<B", values.ndim)
        table += struct.pack(f"<{values.ndim}I", *values.shape) + b"oihw"[: values.ndim] + b"h"
        table += struct.pack("<Q", len(data))
        data += values.tobytes()
    struct.pack_into("<Q", data, 4, len(data))
    return bytes(data) + table


def test_weights_are_found_in_a_library_or_not_taken(tmp_path, monkeypatch):
    expected = {"a.weight": np.arange(36, dtype=np.float16).reshape(2, 2, 3, 3), "a.bias": np.float16([1, -2])}
    blob = tza(**expected)
    monkeypatch.setitem(eight_bit.NETWORKS, "usual", (len(blob), hashlib.sha256(blob).hexdigest()))
    library = tmp_path / "library.so"
    library.write_bytes(b"\xd7\x41\x02\x00other" + tza(b=np.float16([3])) + b"padding" + blob + b"rest")
    found = eight_bit.weights_of("usual", library)
    assert list(found) == list(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values)
    library.write_bytes(library.read_bytes().replace(np.float16(-2).tobytes(), np.float16(-3).tobytes()))
    assert eight_bit.weights_of("usual", library) is None


@pytest.fixture(scope="module")
def both_ways():
    pytest.importorskip("pyoidn")
    return Denoiser(threads=1), Denoiser(threads=1, exact=True)


@pytest.mark.parametrize("task", ["hrls", "both", "albedo"])
def test_eight_bits_come_near_open_image_denoise(both_ways, task):
    """By a tenth of what it takes away; also where sides are no multiple of what the network needs."""
    ours, theirs = (getattr(way, task) for way in both_ways)
    assert ours._eight_bit is not None, "pyoidn's weights are others than those known"
    drawn = layers(100, 150)
    if task == "albedo":
        drawn = {"albedo": noisy(drawn["albedo"], 4).clip(0, 1)}
    result, expected = ours(drawn), theirs(drawn)
    first = next(iter(drawn.values()))
    assert result.shape == first.shape
    assert np.abs(result - expected).mean() < 0.1 * np.abs(first - expected).mean()
    assert np.abs(result - expected).mean() < denoiser.TOLERANCE


def test_without_all_layers_open_image_denoise_does_it_itself(both_ways):
    drawn = layers(64, 64)
    del drawn["normal"]
    np.testing.assert_array_equal(both_ways[0].hrls(drawn), both_ways[1].hrls(drawn))


@pytest.mark.parametrize("trouble", ["other weights", "wrong results", "no operators"])
def test_what_cannot_be_trusted_is_not_used(both_ways, monkeypatch, caplog, trouble, forget):
    if trouble == "other weights":
        monkeypatch.setattr(eight_bit, "weights_of", lambda name, library: None)
    elif trouble == "no operators":
        monkeypatch.setattr(runtime, "load", Mock(side_effect=InputError("onnxruntime can't load it")))
    else:
        plain = eight_bit.EightBit.__call__
        monkeypatch.setattr(eight_bit.EightBit, "__call__", lambda self, **images: plain(self, **images) + 0.02)
    doubted, drawn = Denoiser(threads=1), layers(64, 64)
    with caplog.at_level("INFO", logger="oiio_msspl"):
        for task in ("hrls", "both"):
            np.testing.assert_array_equal(getattr(doubted, task)(drawn), getattr(both_ways[1], task)(drawn))
    said = {"other weights": "are unknown here", "wrong results": "wrongly, by 0.0", "no operators": "can't load it"}
    assert said[trouble] in caplog.text


def test_a_session_may_ask_for_open_image_denoise_itself(both_ways):
    clean = picture(64, 64)
    lr = Render.from_arrays("lr", rgb=transforms.box_downsample(noisy(clean, 4, seed=1), 2))
    hr = Render.from_arrays("hr", rgb=noisy(clean, 4), albedo=clean.clip(0, 1), normal=layers(64, 64)["normal"])
    model = find_model(2, "mix")
    quick, exact = (fuse(lr, hr, Session(model, threads=1, exact=exact)).rgb for exact in (False, True))
    assert 0 < np.abs(quick - exact).mean() < 0.02 * clean.mean()


def test_the_package_has_no_weights_of_open_image_denoise():
    """What is shipped is what differs from them, which is little: three of four are within a step of the nearest."""
    onnx = pytest.importorskip("onnx")
    for file in (Path(eight_bit.__file__).parent / "denoisers").glob("*.onnx"):
        tensors = {tensor.name: tensor for tensor in onnx.load(file, load_external_data=False).graph.initializer}
        convolutions = [name.removesuffix(".scale") for name in tensors if name.endswith(".scale")]
        assert len(convolutions) in (16, 19)
        for tensor in (tensors[f"{layer}.{part}"] for layer in convolutions for part in ("weight", "bias")):
            assert tensor.data_location == onnx.TensorProto.EXTERNAL
            assert not tensor.raw_data
        more = [
            onnx.numpy_helper.to_array(tensors[name]).ravel() for name in tensors if "weight" in name and "more" in name
        ]
        assert len(more) == len(convolutions)
        assert (np.abs(np.concatenate(more).astype(int)) <= 1).mean() > 0.75
