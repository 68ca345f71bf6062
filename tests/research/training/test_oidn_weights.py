# SPDX-License-Identifier: Apache-2.0
"""Weights of Open Image Denoise in its library."""

import hashlib
import struct

import numpy as np
import pytest

pytest.importorskip("torch")

from research.training.oidn import NETWORKS, read_weights


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
    monkeypatch.setitem(NETWORKS, "rt_hdr_alb_nrm", (len(blob), hashlib.sha256(blob).hexdigest()))
    library = tmp_path / "library.so"
    library.write_bytes(b"\xd7\x41\x02\x00other" + tza(b=np.float16([3])) + b"padding" + blob + b"rest")
    found = read_weights("rt_hdr_alb_nrm", library)
    assert list(found) == list(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values)
    library.write_bytes(library.read_bytes().replace(np.float16(-2).tobytes(), np.float16(-3).tobytes()))
    assert read_weights("rt_hdr_alb_nrm", library) is None
