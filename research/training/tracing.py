# SPDX-License-Identifier: Apache-2.0
"""PyTorch modules as ONNX graphs."""

from __future__ import annotations

from typing import Any

import onnx
import torch
from onnx import TensorProto, helper
from torch import Tensor, nn
from torch.utils._pytree import tree_leaves, tree_map

#: Operators and file format of all models.
OPSET, IR_VERSION = 18, 9


def traced(
    module: nn.Module, inputs: tuple[Any, ...], names: list[str], outputs: list[str], alignment: int,
    translations: dict[Any, Any] | None = None,
) -> onnx.ModelProto:  # fmt: skip
    """Export a module for images of any size, and for numbers.

    Sides of the first input are multiples of ``alignment``; the other images keep their size relative to the first.
    """
    first = tree_leaves(inputs)[0]
    height, width = torch.export.Dim("h", min=2), torch.export.Dim("w", min=2)

    def dynamic(image: Tensor) -> dict[int, Any]:
        if not image.ndim:
            return {}
        size = alignment * image.shape[2] // first.shape[2]
        return {2: size * height, 3: size * width}

    program = torch.onnx.export(
        module.eval(), inputs, input_names=names, output_names=outputs, opset_version=OPSET, dynamo=True, verbose=False,
        dynamic_shapes=tree_map(dynamic, inputs), custom_translation_table=translations or {},
    )  # fmt: skip
    assert program is not None
    model = program.model_proto
    _strip_traces(model)
    return model


def network_example(network: Any, scale: int, alignment: int) -> tuple[Tensor, Tensor]:
    """Return random ``lrhs`` and ``hrls``, as a network that fuses them reads them."""
    lrhs = torch.rand(1, network.lrhs_channels, 4 * alignment, 6 * alignment)
    return lrhs, torch.rand(1, network.hrls_channels, 4 * alignment * scale, 6 * alignment * scale)


def prepend(graph: onnx.GraphProto, nodes: list[onnx.NodeProto]) -> None:
    """Put nodes before those of a graph."""
    nodes = [*nodes, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)


def image_info(name: str, channels: int, size: str = "HW") -> onnx.ValueInfoProto:
    """Describe images (1, channels, H, W) of any size, or a number if it has no channels."""
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, channels, *size] if channels else [])


def _strip_traces(model: onnx.ModelProto) -> None:
    """Remove the exporter's metadata: stack traces with paths of this machine."""
    graph = model.graph
    for item in (model, graph, *graph.node, *graph.initializer, *graph.value_info, *graph.input, *graph.output):
        item.doc_string = ""
        del item.metadata_props[:]
    del graph.value_info[:]
