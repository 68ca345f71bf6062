# SPDX-License-Identifier: Apache-2.0
"""The network alone, taken out of the file of a whole model."""

from __future__ import annotations

import copy

import onnx
from onnx import TensorProto, helper

from research.training.whole_model import NETWORK


def network_of(model: onnx.ModelProto) -> onnx.ModelProto:
    """The network in the graph of a model: the reverse of :func:`whole_model`."""
    names = {"encoded.both": "lrhs", "encoded.lrhs": "lrhs", "encoded.hrls": "hrls", "encoded.fused": "fused"}
    results = {"encoded.fused", *(value.name for value in model.graph.output)} - {"fused"}
    nodes = [
        copy.deepcopy(node)
        for node in model.graph.node
        if all(name.startswith(NETWORK) or name in results for name in node.output)
    ]
    for node in nodes:
        for tensors in (node.input, node.output):
            tensors[:] = [names.get(name, name) for name in tensors]
    read, written = ({name for node in nodes for name in getattr(node, kind)} for kind in ("input", "output"))
    tensors = [tensor for tensor in model.graph.initializer if tensor.name in read]
    kind = TensorProto.FLOAT
    inputs = [helper.make_tensor_value_info(name, kind, [1, None, None, None]) for name in ("lrhs", "hrls")]
    outputs = [value for value in model.graph.output if value.name in written]
    graph = helper.make_graph(nodes, "network", inputs, outputs, tensors)
    return helper.make_model(graph, opset_imports=model.opset_import, ir_version=model.ir_version)
