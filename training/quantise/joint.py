# SPDX-License-Identifier: Apache-2.0
"""The ONNX graph of :class:`training.joint.JointFusion`: its U-Net in 8 bits, the blending in float32."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, compose, helper
from torch import Tensor, nn
from torch.nn import functional as F

from oiio_msspl.model.contract import Contract
from oiio_msspl.model.mean_denoiser import log_encoded_of_code
from oiio_msspl.model.pu_curve import largest_log_encoded, pu_encode_log
from oiio_msspl.model.session import make_denoiser
from training.blend import blend
from training.data import fixed_batches
from training.encoding import log_to_pu
from training.joint import DECODED, OUTPUTS, JointFusion
from training.oidn import BASE
from training.ops import upsample
from training.paper import LRHS_CHANNELS
from training.quantise.gptq import (
    COLOURS,
    SIGNED_RANGE,
    SIGNED_ZERO,
    Activations,
    CodeLayout,
    Fit,
    run_unet_on_activations,
)
from training.quantise.graph import Graph

#: Calibration pairs, and their width in HRLS pixels.
PAIRS, PATCH = 64, 256
#: Slices of the HRLS's colour, the denoised mean, the LRHS and the output.
HRLS_SLICES, MEAN_SLICES, LRHS_SLICES, SLICES_OUT = 3, 3, 2, 9
#: Channels of the input ``lrhs``: the denoised mean, and the LRHS.
MEAN, LRHS = slice(LRHS_CHANNELS, 2 * LRHS_CHANNELS), slice(0, LRHS_CHANNELS)
#: Entries of the table from log-encoded to PU-encoded radiance.
ENTRIES = 1 << 16


class Blend(nn.Module):
    """The blending after the U-Net, as a module for the exporter."""

    def forward(self, lrhs: Tensor, hrls: Tensor, denoised: Tensor, logits: Sequence[Tensor]) -> Tensor:
        return blend(lrhs, hrls, denoised, logits)


# The U-Net's inputs as codes


def sliced(values: Tensor, count: int) -> Tensor:
    """Quantise values (N, C, H, W) in [0, 1] to codes of slices, (N, count * C, H, W)."""
    slices = [(values * count - i).clamp(0, 1) for i in range(count)]
    return torch.cat(slices, dim=1).mul(255).round()


def sliced_layout(count: int, first: int) -> CodeLayout:
    """The layout of :func:`sliced` colours, which are the value channels from ``first`` on."""
    return CodeLayout(torch.full((3 * count,), 1 / count / 255), torch.arange(first, first + 3).repeat(count))


def concatenated(*parts: CodeLayout) -> CodeLayout:
    """Concatenate layouts and a code channel of zeros, for 16 channels."""
    parts = (*parts, CodeLayout(torch.zeros(1), torch.zeros(1, dtype=torch.long)))
    scale, source = ([getattr(part, name) for part in parts] for name in ("scale", "source_channel"))
    return CodeLayout(torch.cat(scale), torch.cat(source))


def unet_inputs(pairs: Sequence[tuple[Tensor, Tensor]], scale: int) -> list[Activations]:
    """The U-Net's inputs at H and at H/2, for pairs of the network's inputs."""
    plain = CodeLayout(torch.full((6,), 1 / 255), torch.arange(3, 9))
    layouts = [
        concatenated(sliced_layout(HRLS_SLICES, 0), plain),
        concatenated(sliced_layout(MEAN_SLICES, 0), sliced_layout(LRHS_SLICES, 3)),
    ]
    codes: list[list[Tensor]] = [[], []]
    for lrhs, hrls in pairs:
        albedo, normal = hrls[:, 3:6].clamp(0, 1) * 255, hrls[:, 6:9] * 127.5 + SIGNED_ZERO
        full = torch.cat(
            [sliced(log_to_pu(hrls[:, :3]), HRLS_SLICES), albedo.round(), normal.round().clamp(0, 255)], dim=1
        )
        mean, low = (
            sliced(log_to_pu(lrhs[:, part]), count) for part, count in ((MEAN, MEAN_SLICES), (LRHS, LRHS_SLICES))
        )
        half = upsample(torch.cat([mean, low], dim=1), scale // 2)
        for images, image in zip(codes, (full, half), strict=True):
            images.append(F.pad(image, (0, 0, 0, 0, 0, 1)))

    return [
        Activations([layout.dequantise(image[0])[None] for image in images], images, layout)
        for images, layout in zip(codes, layouts, strict=True)
    ]


def calibration_pairs(views: Path, contract: Contract, count: int = PAIRS) -> list[tuple[Tensor, Tensor]]:
    """Inputs of the network, from views as training draws them."""
    batches = fixed_batches(views, "train", [contract.scale], PATCH, 1, make_denoiser(contract.denoiser))
    return [(batch["lrhs"].contiguous(), batch["hrls"].contiguous()) for batch in islice(batches, count)]


# The fit


def fitted(network: JointFusion, scale: int, pairs: Sequence[tuple[Tensor, Tensor]]) -> Fit:
    """Quantise the U-Net and its heads."""
    weights = {}
    for name, conv in network.convs.items():
        weights[f"{name}.weight"], weights[f"{name}.bias"] = conv.total()
    for kind in ("weight", "bias"):
        heads = [getattr(head, kind) for head in network.heads]
        last = f"{BASE.last}.{kind}"
        weights[last] = torch.cat([weights[last], heads[0]])
        # The expected error, four pixels for each pixel of H/2, is predicted with that level's logits
        heads[1] = torch.cat([heads[1], getattr(network.error, kind)])
        weights |= {f"head{level}.{kind}": heads[level] for level in range(1, len(heads))}
    fit = Fit(BASE, {name: value.detach() for name, value in weights.items()}, SLICES_OUT)
    level_of_layer = {name: level for level, name in enumerate(DECODED)}

    def conv(name: str, values: Activations) -> Activations:
        result = fit.conv(name, values)
        if 0 < level_of_layer.get(name, 0) < scale.bit_length():
            fit.conv(f"head{level_of_layer[name]}", result)
        return result

    with torch.no_grad():
        run_unet_on_activations(BASE, unet_inputs(pairs, scale), conv)
    return fit


# The graph


class JointGraph(Graph):
    """The whole graph: tensors are (1, C, H, W) outside the U-Net, (1, H, W, C) within."""

    def __init__(self, fit: Fit, scale: int) -> None:
        super().__init__(fit)
        self._scale = scale
        self.initializers |= {
            "entries": np.float32((ENTRIES - 1) / largest_log_encoded()),
            "nothing": np.float32(0),
            "last_entry": np.float32(ENTRIES - 1),
            "seen": pu_encode_log(ENTRIES).astype(np.float32),
            "unseen": log_encoded_of_code(SLICES_OUT),
        }

    def whole(
        self, mixing: onnx.ModelProto, inputs: list[onnx.ValueInfoProto], outputs: list[onnx.ValueInfoProto]
    ) -> onnx.ModelProto:
        """The model with the graph of :class:`Blend`, whose inputs have the names of tensors that are made here."""
        full = self._packed(
            [
                *self._slices(self._log_to_pu(self._part("hrls", 0, 3)), HRLS_SLICES),
                self._add(
                    "QuantizeLinear",
                    [self._part("hrls", 3, 6), self._constant("step", np.float32(1 / 255)), "zero"],
                    "albedo",
                ),
                self._add(
                    "QuantizeLinear",
                    [
                        self._part("hrls", 6, 9),
                        self._constant("half_step", np.float32(1 / 127.5)),
                        self._constant("middle", np.uint8(SIGNED_ZERO)),
                    ],
                    "normal",
                ),
                self._zeros("hrls"),
            ],
            "full",
        )
        half = self._packed(
            [
                *self._slices(self._log_to_pu(self._part("lrhs", MEAN.start, MEAN.stop)), MEAN_SLICES),
                *self._slices(self._log_to_pu(self._part("lrhs", LRHS.start, LRHS.stop)), LRHS_SLICES),
                self._zeros("lrhs"),
            ],
            "half",
        )
        if self._scale > 2:
            half = self.repeat(half, 16, self._scale // 2)
        sums = self.colours([full, half], "sums")
        pixels = self._add("Gather", ["unseen", sums], "denoised.pixels")
        self._add("Transpose", [pixels], "denoised", perm=[0, 3, 1, 2])
        count = len(self.fit.layers[BASE.last].step) - COLOURS
        self._add("Identity", [self._planes(BASE.last, COLOURS * SLICES_OUT, count)], "logits0")
        for level in range(1, self._scale.bit_length()):
            name = self.conv(f"head{level}", DECODED[level])
            planes = self._planes(name, 0, len(self.fit.layers[name].step))
            self._cut(planes, 0, OUTPUTS[level], f"logits{level}")
            if level == 1:
                phases = self._cut(planes, OUTPUTS[level], len(self.fit.layers[name].step), "log_error.phases")
                self._add("DepthToSpace", [phases], "log_error", blocksize=2, mode="CRD")
        self.nodes += mixing.graph.node
        model = self.finished("joint", inputs, outputs)
        model.graph.initializer.extend(mixing.graph.initializer)
        return model

    def _cut(self, values: str, start: int, stop: int, output: str, axis: int = 1) -> str:
        bounds = [self._constant(f"at{n}", np.array([n])) for n in (start, stop, axis)]
        return self._add("Slice", [values, *bounds], output)

    def _part(self, image: str, start: int, stop: int) -> str:
        return self._cut(image, start, stop, f"{image}.{start}")

    def _log_to_pu(self, values: str) -> str:
        """Log-encoded to PU-encoded radiance, by a table."""
        entries = self._add("Mul", [values, "entries"], f"{values}.entries")
        entries = self._add("Clip", [entries, "nothing", "last_entry"], f"{values}.clipped")
        entries = self._add("Cast", [entries], f"{values}.entry", to=TensorProto.INT32)
        return self._add("Gather", ["seen", entries], f"{values}.seen")

    def _slices(self, values: str, count: int) -> list[str]:
        """Quantise PU-encoded radiance to the codes of slices, see :func:`sliced`."""
        step = self._constant(f"slice{count}", np.float32(1 / count / 255))
        parts = []
        for i in range(count):
            begin = self._constant(f"begin{count}.{i}", np.float32(i / count))
            part = self._add("Sub", [values, begin], f"{values}.{count}.{i}.from") if i else values
            parts.append(self._add("QuantizeLinear", [part, step, "zero"], f"{values}.{count}.{i}"))
        return parts

    def _zeros(self, image: str) -> str:
        """A plane of zeros."""
        return self._add(
            "QuantizeLinear",
            [self._cut(image, 0, 1, f"{image}.any"), self._constant("vast", np.float32(1e30)), "zero"],
            f"{image}.none",
        )

    def _packed(self, planes: list[str], name: str) -> str:
        return self._add("Transpose", [self._add("Concat", planes, f"{name}.planes", axis=1)], name, perm=[0, 2, 3, 1])

    def _planes(self, layer: str, start: int, count: int) -> str:
        """Dequantise signed outputs of a layer, as (1, C, H, W)."""
        part = self._cut(layer, start, start + count, f"{layer}.beside", axis=3)
        planes = self._add("Transpose", [part], f"{layer}.planes", perm=[0, 3, 1, 2])
        step = self._constant("signed_step", np.float32(2 * SIGNED_RANGE / 255))
        middle = self._constant("middle", np.uint8(SIGNED_ZERO))
        return self._add("DequantizeLinear", [planes, step, middle], f"{layer}.values")


def to_onnx(
    network: JointFusion, scale: int, pairs: Sequence[tuple[Tensor, Tensor]], mixing: onnx.ModelProto
) -> onnx.ModelProto:
    """Graph with inputs ``lrhs`` and ``hrls``, outputs ``fused`` and ``log_error``.

    Args:
        pairs: calibration pairs, see :func:`calibration_pairs`.
        mixing: the graph of :class:`Blend` with inputs ``lrhs``, ``hrls``, ``denoised``, ``logits0`` ... and output
            ``fused``.
    """
    outside = {value.name for value in (*mixing.graph.input, *mixing.graph.output)}
    mixing = compose.add_prefix(mixing, "mix.")
    for node in mixing.graph.node:
        for names in (node.input, node.output):
            names[:] = [own if (own := name.removeprefix("mix.")) in outside else name for name in names]
    info = helper.make_tensor_value_info
    inputs = [
        info("lrhs", TensorProto.FLOAT, [1, network.lrhs_channels, "h", "w"]),
        info("hrls", TensorProto.FLOAT, [1, network.hrls_channels, "H", "W"]),
    ]
    outputs = [
        info("fused", TensorProto.FLOAT, [1, COLOURS, "H", "W"]),
        info("log_error", TensorProto.FLOAT, [1, 1, "H", "W"]),
    ]
    return JointGraph(fitted(network, scale, pairs), scale).whole(mixing, inputs, outputs)
