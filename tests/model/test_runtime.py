# SPDX-License-Identifier: Apache-2.0
"""ONNX Runtime as this package sets it up."""

import numpy as np
import pytest

from oiio_msspl.model.runtime import load_network


def test_convolutions_in_8_bits_are_exact_on_every_processor(tmp_path):
    """Processors without VNNI add the products of two neighbouring channels in 16 bits. The models' weights fit: those
    of one sign sum to 128 at most."""
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper, numpy_helper

    channels, step = 32, 1 << 11
    weights = np.array([[100, 28], [-1, -127], [127, 1], [-64, -64]] * 4, np.int8).ravel()
    constants = {
        "one": np.float32(1),
        "zero": np.uint8(0),
        "weights": weights[None, :, None, None],
        "scale": np.float32([1 / step]),
        "offset": np.zeros(1, np.int8),
        "middle": np.uint8(128),
    }
    convolution = helper.make_node(
        "QLinearConv", ["codes", "one", "zero", "weights", "scale", "offset", "one", "middle"], ["sums"]
    )
    image = [helper.make_tensor_value_info("codes", TensorProto.UINT8, [1, channels, "h", "w"])]
    result = [helper.make_tensor_value_info("sums", TensorProto.UINT8, [1, 1, "h", "w"])]
    initializers = [numpy_helper.from_array(np.asarray(values), name) for name, values in constants.items()]
    graph = helper.make_graph([convolution], "sum", image, result, initializers)
    onnx.save(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9), tmp_path / "sum.onnx"
    )
    codes = np.random.default_rng(0).choice(np.uint8([0, 255]), (1, channels, 16, 16))
    (found,) = load_network(tmp_path / "sum.onnx", 1).run(["sums"], {"codes": codes})
    expected = np.tensordot(codes[0].astype(int), weights.astype(int), (0, 0)) / step + 128
    np.testing.assert_array_equal(found[0, 0], np.rint(expected))
