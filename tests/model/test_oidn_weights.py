# SPDX-License-Identifier: Apache-2.0
"""Weights of Open Image Denoise in its library."""

import hashlib
import struct

import numpy as np
import pytest

from oiio_msspl.model.oidn_weights import NETWORKS, read_weights
from oiio_msspl.model.quantised import WEIGHTS


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
    monkeypatch.setitem(NETWORKS, "rt_alb", (len(blob), hashlib.sha256(blob).hexdigest()))
    library = tmp_path / "library.so"
    library.write_bytes(b"\xd7\x41\x02\x00other" + tza(b=np.float16([3])) + b"padding" + blob + b"rest")
    found = read_weights("rt_alb", library)
    assert list(found) == list(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values)
    library.write_bytes(library.read_bytes().replace(np.float16(-2).tobytes(), np.float16(-3).tobytes()))
    assert read_weights("rt_alb", library) is None


def test_the_package_has_no_weights_of_open_image_denoise():
    """The files hold differences to them, and most of these are at most one step of 8 bits."""
    onnx = pytest.importorskip("onnx")
    files = list(WEIGHTS.glob("*.onnx"))
    assert len(files) == 4
    for file in files:
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
