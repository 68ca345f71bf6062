# SPDX-License-Identifier: Apache-2.0
"""The graph of :class:`training.joint.JointFusion`: its U-Net in 8 bits, what it mixes in 32.

As with Open Image Denoise's own networks (:mod:`training.eight_bit`), the file holds by how many steps of 8 bits a
weight differs from the nearest one of Open Image Denoise's, which whoever loads it has.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, compose, helper
from torch import Tensor, nn
from torch.nn import functional as F

from datagen.views import Folder
from oiio_msspl import eight_bit
from oiio_msspl.contract import Contract
from oiio_msspl.denoiser import for_model
from training import batches, data
from training.eight_bit import COLOURS, SIGNED_RANGE, SIGNED_ZERO, Codes, Fit, Given, Graph, Values, walk_values
from training.joint import DECODED, OUTPUTS, JointFusion, seen
from training.mix import blend
from training.paper import LRHS_CHANNELS
from training.unet import SMALLER

#: Pairs that the 8 bits are fitted to, and their HRLS pixels across.
PAIRS, PATCH = 64, 256
#: Slices of the range that colours are written in: the HRLS's, both renders' together, the LRHS's; and what is made.
OF_HRLS, OF_BOTH, OF_LRHS, OUT = 3, 3, 2, 9
#: Of the LRHS's channels: both renders together, and its own.
BOTH, LOW = slice(LRHS_CHANNELS, 2 * LRHS_CHANNELS), slice(0, LRHS_CHANNELS)
#: Entries of the table from network values to what Open Image Denoise sees.
ENTRIES = 1 << 16


class Blend(nn.Module):
    """What is done with what the U-Net makes."""

    def forward(self, lrhs: Tensor, hrls: Tensor, denoised: Tensor, logits: Sequence[Tensor]) -> Tensor:
        return blend(lrhs, hrls, denoised, logits)


# What the U-Net reads, in codes


def sliced(values: Tensor, count: int) -> Tensor:
    """Codes (N, count * C, H, W) of values (N, C, H, W) in [0, 1]: how far each slice of the range is filled."""
    slices = [(values * count - i).clamp(0, 1) for i in range(count)]
    return torch.cat(slices, dim=1).mul(255).round()


def codes_of_sliced(count: int, first: int) -> Codes:
    """Of three colours, which are the channels from ``first`` on."""
    return Codes(torch.full((3 * count,), 1 / count / 255), torch.arange(first, first + 3).repeat(count))


def joined(*parts: Codes) -> Codes:
    """And a channel of zeros, which makes 16."""
    zero = Codes(torch.zeros(1), torch.zeros(1, dtype=torch.long))
    return Codes(*(torch.cat([getattr(part, name) for part in (*parts, zero)]) for name in ("worth", "of")))


def pictures(pairs: Sequence[tuple[Tensor, Tensor]], scale: int) -> list[Values]:
    """What the U-Net reads of pairs of the network's inputs, at H and at H/2."""
    plain = Codes(torch.full((6,), 1 / 255), torch.arange(3, 9))
    how = [
        joined(codes_of_sliced(OF_HRLS, 0), plain),
        joined(codes_of_sliced(OF_BOTH, 0), codes_of_sliced(OF_LRHS, 3)),
    ]
    codes: list[list[Tensor]] = [[], []]
    for lrhs, hrls in pairs:
        albedo, normal = hrls[:, 3:6].clamp(0, 1) * 255, hrls[:, 6:9] * 127.5 + SIGNED_ZERO
        full = torch.cat([sliced(seen(hrls[:, :3]), OF_HRLS), albedo.round(), normal.round().clamp(0, 255)], dim=1)
        both, low = (sliced(seen(lrhs[:, part]), count) for part, count in ((BOTH, OF_BOTH), (LOW, OF_LRHS)))
        half = F.interpolate(torch.cat([both, low], dim=1), scale_factor=scale // 2, mode="nearest")
        for images, image in zip(codes, (full, half), strict=True):
            images.append(F.pad(image, (0, 0, 0, 0, 0, 1)))

    return [
        Values([written.values(image[0])[None] for image in images], images, written)
        for images, written in zip(codes, how, strict=True)
    ]


def drawn(views: Path, contract: Contract, count: int = PAIRS) -> list[tuple[Tensor, Tensor]]:
    """Pairs as training draws them."""
    denoiser, rng = for_model(contract.denoiser, 0), np.random.default_rng(0)
    folder = [batches.Pixels.of(view, torch.device("cpu")) for view in Folder(views).split("train")]
    with torch.no_grad():
        each = (batches.draw(folder, contract.scale, PATCH, 1, rng, data.Sampling(), denoiser) for _ in range(count))
        return [(batch["lrhs"].contiguous(), batch["hrls"].contiguous()) for batch in each]


# The fit


def fitted(network: JointFusion, scale: int, pairs: Sequence[tuple[Tensor, Tensor]]) -> Fit:
    """The U-Net in 8 bits."""
    weights, given = {}, {}
    for name, conv in network.convs.items():
        weights[f"{name}.weight"], weights[f"{name}.bias"] = conv.parameters_in_all()
        given[name] = Given(
            *(network.given[f"{name}.{kind}"] for kind in ("weight", "bias")), *network.given_channels(name)
        )
    for kind in ("weight", "bias"):
        heads = [getattr(head, kind) for head in network.heads]
        last = f"{SMALLER.last}.{kind}"
        weights[last] = torch.cat([weights[last], heads[0]])
        # What is expected to be wrong, four pixels for each of H/2, is made beside that level's logits
        heads[1] = torch.cat([heads[1], getattr(network.error, kind)])
        weights |= {f"head{level}.{kind}": heads[level] for level in range(1, len(heads))}
    fit = Fit(SMALLER, {name: value.detach() for name, value in weights.items()}, given, OUT)
    level_of_layer = {name: level for level, name in enumerate(DECODED)}

    def conv(name: str, values: Values) -> Values:
        result = fit.conv(name, values)
        if 0 < level_of_layer.get(name, 0) < scale.bit_length():
            fit.conv(f"head{level_of_layer[name]}", result)
        return result

    with torch.no_grad():
        walk_values(SMALLER, pictures(pairs, scale), conv)
    return fit


# The graph


class JointGraph(Graph):
    """All of it: channels, height and width outside, height, width and channels within the U-Net."""

    def __init__(self, fit: Fit, scale: int) -> None:
        super().__init__(fit)
        self._scale = scale
        self.initializers |= {
            "entries": np.float32((ENTRIES - 1) / eight_bit.largest()),
            "nothing": np.float32(0),
            "last_entry": np.float32(ENTRIES - 1),
            "seen": eight_bit.seen(ENTRIES).astype(np.float32),
            "unseen": eight_bit.values_by_code(OUT),
        }

    def whole(
        self, mixing: onnx.ModelProto, inputs: list[onnx.ValueInfoProto], outputs: list[onnx.ValueInfoProto]
    ) -> onnx.ModelProto:
        """With the graph of :class:`Blend`, whose inputs have the names of what is made here."""
        full = self._packed(
            [
                *self._slices(self._seen(self._part("hrls", 0, 3)), OF_HRLS),
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
                self._none("hrls"),
            ],
            "full",
        )
        half = self._packed(
            [
                *self._slices(self._seen(self._part("lrhs", BOTH.start, BOTH.stop)), OF_BOTH),
                *self._slices(self._seen(self._part("lrhs", LOW.start, LOW.stop)), OF_LRHS),
                self._none("lrhs"),
            ],
            "half",
        )
        if self._scale > 2:
            half = self.enlarged(half, 16, self._scale // 2)
        sums = self.colours([full, half], "sums")
        pixels = self._add("Gather", ["unseen", sums], "denoised.pixels")
        self._add("Transpose", [pixels], "denoised", perm=[0, 3, 1, 2])
        count = len(self.fit.layers[SMALLER.last].step) - COLOURS
        self._add("Identity", [self._planes(SMALLER.last, COLOURS * OUT, count)], "logits0")
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

    def _seen(self, values: str) -> str:
        """Network values as Open Image Denoise sees them."""
        entries = self._add("Mul", [values, "entries"], f"{values}.entries")
        entries = self._add("Clip", [entries, "nothing", "last_entry"], f"{values}.clipped")
        entries = self._add("Cast", [entries], f"{values}.entry", to=TensorProto.INT32)
        return self._add("Gather", ["seen", entries], f"{values}.seen")

    def _slices(self, values: str, count: int) -> list[str]:
        step = self._constant(f"slice{count}", np.float32(1 / count / 255))
        parts = []
        for i in range(count):
            begin = self._constant(f"begin{count}.{i}", np.float32(i / count))
            part = self._add("Sub", [values, begin], f"{values}.{count}.{i}.from") if i else values
            parts.append(self._add("QuantizeLinear", [part, step, "zero"], f"{values}.{count}.{i}"))
        return parts

    def _none(self, image: str) -> str:
        """A plane of zeros."""
        return self._add(
            "QuantizeLinear",
            [self._cut(image, 0, 1, f"{image}.any"), self._constant("vast", np.float32(1e30)), "zero"],
            f"{image}.none",
        )

    def _packed(self, planes: list[str], name: str) -> str:
        return self._add("Transpose", [self._add("Concat", planes, f"{name}.planes", axis=1)], name, perm=[0, 2, 3, 1])

    def _planes(self, layer: str, start: int, count: int) -> str:
        """Signed outputs of a layer as planes of values."""
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
        pairs: inputs of the network, to which the 8 bits are fitted, see :func:`drawn`.
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
