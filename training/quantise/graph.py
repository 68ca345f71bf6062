# SPDX-License-Identifier: Apache-2.0
"""The ONNX graph of a quantised U-Net. Tensor names are those of the files that ship.

Only standard operators are used. ONNX Runtime's own ones read pixels with their channels side by side, but transposes
around the standard ones, which it removes, are as fast.
"""

from __future__ import annotations

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from oiio_msspl.model.mean_denoiser import INPUT_CHANNELS
from training.oidn import run_unet
from training.quantise.gptq import COLOURS, Fit


class Graph:
    """Builds the ONNX graph of a quantised U-Net: tensors are (1, H, W, C), activations are codes throughout."""

    def __init__(self, fit: Fit) -> None:
        self.fit = fit
        self.nodes: list[onnx.NodeProto] = []
        self.initializers: dict[str, np.ndarray] = {
            "one": np.float32(1), "zero": np.uint8(0), "no_offset": np.int8(0)
        }  # fmt: skip

    def model(self) -> onnx.ModelProto:
        """The graph of a network that denoises."""
        self.colours(["layers"], "codes")
        return self.finished(
            "oidn",
            [helper.make_tensor_value_info("layers", TensorProto.UINT8, [1, "h", "w", INPUT_CHANNELS])],
            [helper.make_tensor_value_info("codes", TensorProto.INT32, [1, "h", "w", 3])],
        )

    def finished(
        self, name: str, inputs: list[onnx.ValueInfoProto], outputs: list[onnx.ValueInfoProto]
    ) -> onnx.ModelProto:
        values = (numpy_helper.from_array(np.asarray(v), k) for k, v in self.initializers.items())
        graph = helper.make_graph(self.nodes, name, inputs, outputs, list(values))
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)

    def colours(self, inputs: list[str], output: str) -> str:
        """Add the U-Net, and the sum of the slices of its last layer's colours."""
        last = run_unet(self.fit.shape, inputs, self.conv, self._pool, self._upsample, self._concat)
        outputs = self.fit.layers[last].outputs
        all_slices = np.zeros((len(outputs.source_channel), COLOURS), np.int8)
        rows = np.arange(COLOURS * self.fit.slices_out)
        all_slices[rows, rows % COLOURS] = 1
        self.initializers["all_slices"] = all_slices
        return self._add("MatMulInteger", [last, "all_slices", "zero", "no_offset"], output)

    def _add(self, kind: str, inputs: list[str], output: str, **attributes: object) -> str:
        self.nodes.append(helper.make_node(kind, inputs, [output], name=output, **attributes))
        return output

    def _add_on_planes(self, kind: str, inputs: list[str], output: str, **attributes: object) -> str:
        """Add an operator that reads and writes (1, C, H, W), where the rest of the U-Net has (1, H, W, C)."""
        planes = self._add("Transpose", inputs[:1], f"{output}.in", perm=[0, 3, 1, 2])
        result = self._add(kind, [planes, *inputs[1:]], f"{output}.out", **attributes)
        return self._add("Transpose", [result], output, perm=[0, 2, 3, 1])

    def _constant(self, name: str, values: np.ndarray) -> str:
        self.initializers[name] = values
        return name

    def conv(self, name: str, values: str) -> str:
        """Add a convolution. An output value in several slices has a channel for each slice."""
        layer = self.fit.layers[name]
        source, steps = layer.outputs.source_channel.numpy(), layer.step.numpy()
        weights, bias = layer.weights.numpy().astype(np.int8), np.round(layer.bias.numpy() / steps).astype(np.int32)
        steps = steps[source]
        offset = np.round(layer.offset.numpy() / steps).astype(np.int32)
        return self._add_on_planes(
            "QLinearConv",
            [
                values,
                "one",
                "zero",
                self._constant(f"{name}.weight", weights[source]),
                self._constant(f"{name}.scale", steps / layer.outputs.scale.numpy()),
                self._constant(f"{name}.offset", np.zeros(len(steps), np.int8)),
                "one",
                "zero",
                self._constant(f"{name}.bias", bias[source] - offset),
            ],
            name,
            kernel_shape=[3, 3],
            pads=[1, 1, 1, 1],
        )

    def _pool(self, values: str) -> str:
        return self._add_on_planes("MaxPool", [values], f"{values}.halved", kernel_shape=[2, 2], strides=[2, 2])

    def _upsample(self, values: str) -> str:
        """Repeat every pixel of a layer in a 2 x 2 square."""
        return self.repeat(values, len(self.fit.layers[values].outputs.source_channel), 2)

    def repeat(self, values: str, channels: int, factor: int) -> str:
        """Repeat every pixel in a square of factor x factor."""
        height_width = self._add("Shape", [values], f"{values}.small", start=1, end=3)
        factors, one = self._constant(f"by{factor}", np.array([factor, factor])), self._constant("only", np.array([1]))
        count = self._constant(f"{values}.channels", np.array([channels]))
        large = self._add(
            "Concat",
            [one, self._add("Mul", [height_width, factors], f"{values}.times"), count],
            f"{values}.shape",
            axis=0,
        )
        apart = self._add("Unsqueeze", [values, self._constant("apart", np.array([2, 4]))], f"{values}.apart")
        squares = self._constant(f"squares{factor}", np.array([1, 1, factor, 1, factor, 1]))
        return self._add(
            "Reshape", [self._add("Expand", [apart, squares], f"{values}.squares"), large], f"{values}.large"
        )

    def _concat(self, one: str, other: str) -> str:
        return self._add("Concat", [one, other], f"{one}+{other}", axis=3)
