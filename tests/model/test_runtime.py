# SPDX-License-Identifier: Apache-2.0
"""ONNX Runtime as this package sets it up."""

import numpy as np
import pytest

from oiio_msspl.model.runtime import load_network


def test_convolutions_in_8_bits_are_exact_on_every_processor(tmp_path):
    """Processors without VNNI add two products in 16 bits. With the largest codes and weights, that overflows."""
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper, numpy_helper

    channels = 32
    constants = {
        "one": np.float32(1),
        "zero": np.uint8(0),
        "weights": np.full((1, channels, 1, 1), 127, np.int8),
        "scale": np.float32([1 / (channels * 255)]),
        "offset": np.zeros(1, np.int8),
    }
    convolution = helper.make_node(
        "QLinearConv", ["codes", "one", "zero", "weights", "scale", "offset", "one", "zero"], ["sums"]
    )
    image = [helper.make_tensor_value_info("codes", TensorProto.UINT8, [1, channels, "h", "w"])]
    result = [helper.make_tensor_value_info("sums", TensorProto.UINT8, [1, 1, "h", "w"])]
    initializers = [numpy_helper.from_array(np.asarray(values), name) for name, values in constants.items()]
    graph = helper.make_graph([convolution], "sum", image, result, initializers)
    onnx.save(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9), tmp_path / "sum.onnx"
    )
    codes = np.full((1, channels, 16, 16), 255, np.uint8)
    (found,) = load_network(tmp_path / "sum.onnx", 1).run(["sums"], {"codes": codes})
    np.testing.assert_array_equal(found, 127)
