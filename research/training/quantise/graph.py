# SPDX-License-Identifier: Apache-2.0
"""Build ONNX graphs with quantised U-Nets. Tensor names are those of the files that ship.

Only standard operators are used. ONNX Runtime's own ones read pixels with their channels side by side, but transposes
around the standard ones, which it removes, are as fast.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, compose, helper, numpy_helper

from oiio_msspl.model.encoding import MAX_RADIANCE
from research.training.encoding import log_decode, log_encode, pu_encode
from research.training.oidn import run_unet
from research.training.quantise.gptq import COLOURS, Fit
from research.training.tracing import IR_VERSION, OPSET

#: Entries of the table from log-encoded to PU-encoded radiance.
ENTRIES = 1 << 16
#: Log-encoded ``MAX_RADIANCE``, the last entry.
LARGEST = float(log_encode(torch.tensor(MAX_RADIANCE, dtype=torch.double)))
#: Rows into which entries of a table are divided. The number of pixels of a tile is a multiple of it.
COPIES = 16


class Nodes:
    """Nodes and constants of a graph, and operators on images (1, C, H, W) that come before and after a U-Net."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.embedded: list[onnx.TensorProto] = []
        self.initializers: dict[str, np.ndarray | np.generic] = {"zero": np.uint8(0)}

    def finished(
        self, name: str, inputs: list[onnx.ValueInfoProto], outputs: list[onnx.ValueInfoProto]
    ) -> onnx.ModelProto:
        """Return the model."""
        graph = helper.make_graph(self.nodes, name, inputs, outputs, [*self.constants(), *self.embedded])
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)

    def constants(self) -> list[onnx.TensorProto]:
        """Return the constants."""
        return [numpy_helper.from_array(np.asarray(values), name) for name, values in self.initializers.items()]

    def embed(self, model: onnx.ModelProto, prefix: str, names: dict[str, str]) -> None:
        """Add the graph of a model.

        Args:
            prefix: of its tensors, except its inputs and outputs.
            names: other names for inputs and outputs.
        """
        outside = {value.name for value in (*model.graph.input, *model.graph.output)}
        graph = compose.add_prefix(model, prefix).graph
        for node in graph.node:
            for tensors in (node.input, node.output):
                for i, name in enumerate(tensors):
                    original = name.removeprefix(prefix)
                    tensors[i] = names.get(original, original) if original in outside else name
        self.nodes += graph.node
        self.embedded += graph.initializer

    def add(self, kind: str, inputs: list[str], output: str, **attributes: Any) -> str:
        """Add an operator and return the name of its output."""
        self.nodes.append(helper.make_node(kind, inputs, [output], name=output, **attributes))
        return output

    def constant(self, name: str, values: np.ndarray | np.generic) -> str:
        """Add a constant and return its name."""
        self.initializers[name] = values
        return name

    def cut(self, values: str, start: int, stop: int, output: str) -> str:
        """Cut channels ``start`` to ``stop`` out of an image."""
        bounds = [self.constant(f"at{n}", np.array([n])) for n in (start, stop, 1)]
        return self.add("Slice", [values, *bounds], output)

    def split(self, image: str, names: dict[str, int]) -> list[str]:
        """Cut an image into parts, whose names and numbers of channels are given.

        Slices would do the same. But ONNX Runtime would quantise the whole image for each of them before it cuts it.
        """
        sizes = self.constant(f"{image}.sizes", np.array(list(names.values())))
        parts = [f"{image}.{name}" for name in names]
        self.nodes.append(helper.make_node("Split", [image, sizes], parts, name=f"{image}.parts", axis=1))
        return parts

    def table(self, values: str, largest: float, table: str) -> str:
        """Replace values in [0, ``largest``] by those of a table with ``ENTRIES`` entries."""
        scale = self.constant(f"{table}.entries", np.float32((ENTRIES - 1) / largest))
        ends = [self.constant("nothing", np.float32(0)), self.constant("last_entry", np.float32(ENTRIES - 1))]
        entries = self.add("Mul", [values, scale], f"{values}.entries")
        entries = self.add("Clip", [entries, *ends], f"{values}.clipped")
        entries = self.add("Cast", [entries], f"{values}.entry", to=TensorProto.INT32)
        return self.look_up(table, entries, f"{values}.{table}")

    def look_up(self, table: str, entries: str, output: str) -> str:
        """Replace integers (any shape, a multiple of ``COPIES`` in all) by the entries of a table.

        ONNX Runtime's GatherElements takes a third of the time of its Gather. It reads one table for each row of
        entries, and the rows on several cores.
        """
        rows, one = self.constant("rows", np.array([COPIES, -1])), self.constant("copies", np.array([COPIES, 1]))
        # When the file is loaded, the copies are computed once.
        tables = self.add("Expand", [table, one], f"{output}.tables")
        flat = self.add("Reshape", [entries, rows], f"{output}.rows")
        results = self.add("GatherElements", [tables, flat], f"{output}.found", axis=1)
        return self.add("Reshape", [results, self.add("Shape", [entries], f"{output}.shape")], output)

    def log_to_pu(self, values: str) -> str:
        """Convert log-encoded to PU-encoded radiance, by a table."""
        radiance = log_decode(torch.linspace(0, LARGEST, ENTRIES, dtype=torch.double))
        self.constant("pu", pu_encode(radiance.clamp_max(MAX_RADIANCE)).float().numpy())
        return self.table(values, LARGEST, "pu")

    def slices(self, values: str, count: int) -> list[str]:
        """Quantise values in [0, 1] to the codes of slices, see :func:`research.training.quantise.codes.sliced`."""
        step = self.constant(f"slice{count}", np.float32(1 / count / 255))
        parts = []
        for i in range(count):
            begin = self.constant(f"begin{count}.{i}", np.float32(i / count))
            part = self.add("Sub", [values, begin], f"{values}.{count}.{i}.from") if i else values
            parts.append(self.add("QuantizeLinear", [part, step, "zero"], f"{values}.{count}.{i}"))
        return parts

    def zeros(self, image: str) -> str:
        """Add a plane of zeros of an image's size."""
        plane, vast = self.cut(image, 0, 1, f"{image}.any"), self.constant("vast", np.float32(1e30))
        return self.add("QuantizeLinear", [plane, vast, "zero"], f"{image}.none")

    def packed(self, planes: list[str], name: str) -> str:
        """Concatenate images and order them as a U-Net reads them, (1, H, W, C)."""
        return self.add("Transpose", [self.add("Concat", planes, f"{name}.planes", axis=1)], name, perm=[0, 2, 3, 1])


class Graph(Nodes):
    """The graph of a quantised U-Net: tensors are (1, H, W, C), activations are codes throughout."""

    def __init__(self, fit: Fit) -> None:
        super().__init__()
        self.fit = fit
        self.initializers |= {"one": np.float32(1), "no_offset": np.int8(0)}

    def model(self) -> onnx.ModelProto:
        """Return the graph of a network that denoises."""
        self.colours(["layers"], "codes")
        channels = len(self.fit.layers[self.fit.shape.order[0]].inputs.scale)
        return self.finished(
            "oidn",
            [helper.make_tensor_value_info("layers", TensorProto.UINT8, [1, "h", "w", channels])],
            [helper.make_tensor_value_info("codes", TensorProto.INT32, [1, "h", "w", 3])],
        )

    def colours(self, inputs: list[str], output: str) -> str:
        """Add the U-Net, and the sum of the slices of its last layer's colours."""
        last = run_unet(self.fit.shape, inputs, self.conv, self._pool, self._upsample, self._concat)
        outputs = self.fit.layers[last].outputs
        all_slices = np.zeros((len(outputs.source_channel), COLOURS), np.int8)
        rows = np.arange(COLOURS * self.fit.slices_out)
        all_slices[rows, rows % COLOURS] = 1
        self.initializers["all_slices"] = all_slices
        return self.add("MatMulInteger", [last, "all_slices", "zero", "no_offset"], output)

    def _add_on_planes(self, kind: str, inputs: list[str], output: str, **attributes: Any) -> str:
        """Add an operator that reads and writes (1, C, H, W), where the rest of the U-Net has (1, H, W, C)."""
        planes = self.add("Transpose", inputs[:1], f"{output}.in", perm=[0, 3, 1, 2])
        result = self.add(kind, [planes, *inputs[1:]], f"{output}.out", **attributes)
        return self.add("Transpose", [result], output, perm=[0, 2, 3, 1])

    def conv(self, name: str, values: str) -> str:
        """Add a convolution. An output value in several slices has a channel for each slice."""
        layer = self.fit.layers[name]
        source, steps = layer.outputs.source_channel.numpy(), layer.step.numpy()
        weights, bias = layer.weights.numpy().astype(np.int8), np.round(layer.bias.numpy() / steps).astype(np.int32)
        steps = steps[source]
        offset = np.round(layer.offset.numpy() / steps).astype(np.int32)
        constants = {
            "weight": weights[source], "scale": steps / layer.outputs.scale.numpy(),
            "offset": np.zeros(len(steps), np.int8), "bias": bias[source] - offset,
        }  # fmt: skip
        *kernel, bias_name = (self.constant(f"{name}.{kind}", array) for kind, array in constants.items())
        inputs = [values, "one", "zero", *kernel, "one", "zero", bias_name]
        return self._add_on_planes("QLinearConv", inputs, name, kernel_shape=[3, 3], pads=[1, 1, 1, 1])

    def _pool(self, values: str) -> str:
        return self._add_on_planes("MaxPool", [values], f"{values}.halved", kernel_shape=[2, 2], strides=[2, 2])

    def _upsample(self, values: str) -> str:
        """Repeat every pixel of a layer in a 2 x 2 square."""
        return self.repeat(values, len(self.fit.layers[values].outputs.source_channel), 2)

    def repeat(self, values: str, channels: int, factor: int) -> str:
        """Repeat every pixel in a square of factor x factor."""
        height_width = self.add("Shape", [values], f"{values}.small", start=1, end=3)
        factors, one = self.constant(f"by{factor}", np.array([factor, factor])), self.constant("only", np.array([1]))
        count = self.constant(f"{values}.channels", np.array([channels]))
        larger = self.add("Mul", [height_width, factors], f"{values}.times")
        large = self.add("Concat", [one, larger, count], f"{values}.shape", axis=0)
        apart = self.add("Unsqueeze", [values, self.constant("apart", np.array([2, 4]))], f"{values}.apart")
        squares = self.constant(f"squares{factor}", np.array([1, 1, factor, 1, factor, 1]))
        repeated = self.add("Expand", [apart, squares], f"{values}.squares")
        return self.add("Reshape", [repeated, large], f"{values}.large")

    def _concat(self, above: str, skipped: str) -> str:
        return self.add("Concat", [above, skipped], f"{above}+{skipped}", axis=3)
