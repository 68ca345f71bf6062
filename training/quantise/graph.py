# SPDX-License-Identifier: Apache-2.0
"""The ONNX graph of a quantised U-Net.

The file holds the differences from Open Image Denoise's weights, in 8-bit steps. The weights themselves are external
tensors, which whoever loads the graph reads from the installed Open Image Denoise. Tensor names are those of the files
that ship; ``.in_codes.more`` are the differences.
"""

from __future__ import annotations

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from oiio_msspl.model.quantised import INPUT_CHANNELS
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
        self.external: list[onnx.TensorProto] = []

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
        graph = helper.make_graph(self.nodes, name, inputs, outputs, [*self.external, *values])
        opsets = [helper.make_opsetid("", 18), helper.make_opsetid("com.microsoft", 1)]
        return helper.make_model(graph, opset_imports=opsets, ir_version=9)

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
        domain = "com.microsoft" if kind in ("QLinearConv", "NhwcMaxPool") else ""
        self.nodes.append(helper.make_node(kind, inputs, [output], domain=domain, name=output, **attributes))
        return output

    def _constant(self, name: str, values: np.ndarray) -> str:
        self.initializers[name] = values
        return name

    def _external(self, name: str, values: np.ndarray, rows: np.ndarray) -> str:
        """Some rows of an external tensor, which is supplied when the graph is loaded."""
        tensor = TensorProto(name=name, data_type=TensorProto.FLOAT16, dims=values.shape)
        tensor.data_location = TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value="oidn")
        self.external.append(tensor)
        if len(rows) < len(values):
            name = self._add("Gather", [name, self._constant(f"{name}.kept", rows)], f"{name}.rows", axis=0)
        return self._add("Cast", [name], f"{name}.float", to=TensorProto.FLOAT)

    def conv(self, name: str, values: str) -> str:
        """Add a convolution, whose weights are computed at loading: pretrained ones in steps, plus differences."""
        layer, pretrained = self.fit.layers[name], self.fit.pretrained.get(name)
        steps, outputs = layer.step.numpy(), layer.outputs
        integers, bias = layer.weights.numpy().astype(np.int8), np.round(layer.bias.numpy() / steps).astype(np.int32)
        if pretrained is None:
            weights, biases = self._constant(f"{name}.weight", integers), self._constant(f"{name}.bias", bias)
        else:
            rows, columns = np.array(pretrained.rows), np.array(pretrained.columns)
            source = layer.inputs.source_channel.numpy()
            known = source < len(columns)  # the others have no pretrained weights
            source = columns[np.where(known, source, 0)]
            scale = np.where(known, layer.inputs.scale.numpy(), 0).astype(np.float32)
            original = self._external(f"{name}.weight", pretrained.weight.numpy(), rows)
            original = self._add(
                "Gather", [original, self._constant(f"{name}.of", source)], f"{name}.weight.of", axis=1
            )
            scales = self._constant(f"{name}.worth", scale[None, :, None, None])
            original = self._add("Mul", [original, scales], f"{name}.weight.in_codes")
            near = pretrained.weight.numpy()[rows][:, source] * scale[:, None, None]
            weights = self._plus_difference(original, near, integers, steps[:, None, None, None])
            original = self._external(f"{name}.bias", pretrained.bias.numpy(), rows)
            biases = self._plus_difference(original, pretrained.bias.numpy()[rows], bias, steps)
        if len(outputs.source_channel) > len(steps):
            source = outputs.source_channel.numpy()
            slices, steps = self._constant(f"{name}.slices", source), steps[source]
            offset = self._constant(f"{name}.begins", np.round(layer.offset.numpy() / steps).astype(np.int32))
            weights = self._add("Gather", [weights, slices], f"{name}.weight.sliced")
            biases = self._add(
                "Sub", [self._add("Gather", [biases, slices], f"{name}.bias.sliced"), offset], f"{name}.bias.begun"
            )
        scales = self._constant(f"{name}.scale", steps / outputs.scale.numpy())
        offsets = self._constant(f"{name}.offset", np.zeros(len(steps), np.int8))
        return self._add(
            "QLinearConv",
            [values, "one", "zero", weights, scales, offsets, "one", "zero", biases],
            name,
            channels_last=1,
            kernel_shape=[3, 3],
            pads=[1, 1, 1, 1],
        )

    def _plus_difference(self, name: str, near: np.ndarray, chosen: np.ndarray, steps: np.ndarray) -> str:
        """The chosen integers, stored as differences from the pretrained values, rounded to whole steps.

        Rows that have no pretrained values are stored as they are.
        """
        count = len(near)
        in_steps = self._add("Div", [name, self._constant(f"{name}.step", steps[:count])], f"{name}.in_steps")
        nearest = self._add("Round", [in_steps], f"{name}.nearest")
        more = self._constant(f"{name}.more", (chosen[:count] - np.round(near / steps[:count])).astype(chosen.dtype))
        added = self._add("Cast", [more], f"{name}.added", to=TensorProto.FLOAT)
        kind = TensorProto.INT8 if chosen.dtype == np.int8 else TensorProto.INT32
        whole = self._add("Cast", [self._add("Add", [nearest, added], f"{name}.chosen")], f"{name}.whole", to=kind)
        if count == len(chosen):
            return whole
        rest = self._constant(f"{name}.rest", chosen[count:])
        return self._add("Concat", [whole, rest], f"{name}.all", axis=0)

    def _pool(self, values: str) -> str:
        return self._add("NhwcMaxPool", [values], f"{values}.halved", kernel_shape=[2, 2], strides=[2, 2])

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
