# SPDX-License-Identifier: Apache-2.0
"""The ONNX graph of :class:`research.training.joint.JointFusion`: its U-Net in 8 bits, the blending in float32."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import numpy as np
import onnx
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from oiio_msspl.model.contract import Contract
from research.training.data import Batches, Prepare, Sampling
from research.training.encoding import log_to_pu
from research.training.joint import DECODED, HRLS_CHANNELS, MARGIN, OUTPUTS, JointFusion, blend
from research.training.ops import log2_scale, upsample
from research.training.paper import LRHS_CHANNELS
from research.training.quantise import gptq
from research.training.quantise.codes import log_encoded_of_code, sliced
from research.training.quantise.graph import Graph
from research.training.quantise.layers import Networks, add_layers
from research.training.tracing import image_info, network_example, traced

#: Calibration pairs, and their width in HRLS pixels.
PAIRS, PATCH = 64, 256
#: Slices of the HRLS's colour, the denoised mean, the LRHS and the output.
HRLS_SLICES, MEAN_SLICES, LRHS_SLICES, SLICES_OUT = 3, 3, 2, 9


class Blend(nn.Module):
    """The blending after the U-Net, as a module for the exporter."""

    def __init__(self, size: str) -> None:
        super().__init__()
        self.margin = MARGIN[size]

    def forward(
        self, lrhs: Tensor, samples: Tensor, albedo: Tensor, denoised: Tensor, logits: Sequence[Tensor]
    ) -> Tensor:
        """Blend as :func:`research.training.joint.blend`."""
        return blend(lrhs, samples, albedo, denoised, logits, self.margin)


# The U-Net's inputs as codes


def unet_inputs(pairs: Sequence[tuple[Tensor, Tensor]]) -> list[gptq.Activations]:
    """Return the U-Net's inputs at H and at H/2, for pairs of the network's inputs."""
    plain = gptq.CodeLayout(torch.full((6,), 1 / 255), torch.arange(3, 9))
    layouts = [
        gptq.concatenated(gptq.sliced_layout(HRLS_SLICES, 0), plain),
        gptq.concatenated(gptq.sliced_layout(MEAN_SLICES, 0), gptq.sliced_layout(LRHS_SLICES, 3)),
    ]
    codes: list[list[Tensor]] = [[], []]
    for lrhs, hrls in pairs:
        albedo, normal = hrls[:, 3:6].clamp(0, 1) * 255, hrls[:, 6:9] * 127.5 + gptq.SIGNED_ZERO
        full = torch.cat(
            [sliced(log_to_pu(hrls[:, :3]), HRLS_SLICES), albedo.round(), normal.round().clamp(0, 255)], dim=1
        )
        low, mean = (
            sliced(log_to_pu(image), count)
            for image, count in zip(lrhs.split(LRHS_CHANNELS, dim=1), (LRHS_SLICES, MEAN_SLICES), strict=True)
        )
        half = upsample(torch.cat([mean, low], dim=1), 2 ** (log2_scale(lrhs, hrls) - 1))
        for images, image in zip(codes, (full, half), strict=True):
            images.append(F.pad(image, (0, 0, 0, 0, 0, 1)))
    return [gptq.activations(images, layout) for images, layout in zip(codes, layouts, strict=True)]


def calibration_pairs(
    views: Path, scales: Sequence[int], prepare: Prepare | None, count: int = PAIRS, *, spread: bool = False
) -> list[tuple[Tensor, Tensor]]:
    """Draw inputs of the network from views, as training does.

    Args:
        scales: of each pair, one of these at random.
        prepare: see :func:`research.training.denoisers.with_denoised_mean`.
        spread: of views with single samples, only pixel filters that spread noise; otherwise only others.
    """
    batches = Batches(views, scales, PATCH, 1, prepare, Sampling(spread_noise=spread), without_reference=True)
    return [(batch["lrhs"].contiguous(), batch["hrls"].contiguous()) for batch in islice(batches, count)]


# The fit


def fitted(network: JointFusion, scale: int, pairs: Sequence[tuple[Tensor, Tensor]]) -> gptq.Fit:
    """Quantise the U-Net and its heads, those that ``scale`` and smaller ones need."""
    weights = {}
    for name, layer in network.convs.items():
        weights[f"{name}.weight"], weights[f"{name}.bias"] = layer.total()
    for kind in ("weight", "bias"):
        heads = [getattr(head, kind) for head in network.heads]
        last = f"{network.shape.last}.{kind}"
        weights[last] = torch.cat([weights[last], heads[0]])
        # The expected error, four pixels for each pixel of H/2, is predicted with that level's logits
        heads[1] = torch.cat([heads[1], getattr(network.error, kind)])
        weights |= {f"head{level}.{kind}": heads[level] for level in range(1, len(heads))}
    weights = {name: value.detach() for name, value in weights.items()}
    # Without further slices, the small network's finest level reads a third fewer channels. 8 bits cost it 0.05 to
    # 0.07 dB at x2
    fit = gptq.Fit(network.shape, weights, SLICES_OUT, extra_slices={} if network.size == "small" else None)
    level_of_layer = {name: level for level, name in enumerate(DECODED)}

    def conv(name: str, values: gptq.Activations) -> gptq.Activations:
        result = fit.conv(name, values)
        if 0 < level_of_layer.get(name, 0) < scale.bit_length():
            fit.conv(f"head{level_of_layer[name]}", result)
        return result

    with torch.no_grad():
        gptq.run_unet_on_activations(network.shape, unet_inputs(pairs), conv)
    return fit


# The graph


def to_onnx(network: JointFusion, fit: gptq.Fit, contract: Contract, layers: Networks | None) -> onnx.ModelProto:
    """Return the graph with inputs ``lrhs`` and ``hrls`` and outputs ``fused`` and ``log_error``.

    Tensors are (1, C, H, W) outside the U-Net, (1, H, W, C) within.

    Args:
        fit: see :func:`fitted`, for the scale of the contract or larger ones.
        layers: denoise albedo and normal first, see :mod:`research.training.quantise.layers`. They are outputs, too.
    """
    scale = contract.scale
    graph = Graph(fit)
    graph.constant("unseen", log_encoded_of_code(SLICES_OUT))
    colour, albedo, normal = graph.split("hrls", {"colour": 3, "albedo": 3, "normal": 3})
    step, half_step = graph.constant("step", np.float32(1 / 255)), graph.constant("half_step", np.float32(1 / 127.5))
    zeros = graph.zeros(albedo)
    if layers:
        add_layers(graph, layers, albedo, normal, zeros)
        albedo = "albedo"
        normal_codes = graph.add("QuantizeLinear", ["normal", step, "zero"], "normal.rounded")
    else:
        middle = graph.constant("middle", np.uint8(gptq.SIGNED_ZERO))
        normal_codes = graph.add("QuantizeLinear", [normal, half_step, middle], "normal.rounded")
    albedo_codes = graph.add("QuantizeLinear", [albedo, step, "zero"], "albedo.rounded")
    colours = graph.slices(graph.log_to_pu(colour), HRLS_SLICES)
    full = graph.packed([*colours, albedo_codes, normal_codes, zeros], "full")
    low, mean = graph.split("lrhs", {"colour": LRHS_CHANNELS, "mean": LRHS_CHANNELS})
    means = graph.slices(graph.log_to_pu(mean), MEAN_SLICES)
    half = graph.packed([*means, *graph.slices(graph.log_to_pu(low), LRHS_SLICES), graph.zeros(low)], "half")
    if scale > 2:
        half = graph.repeat(half, 16, scale // 2)
    sums = graph.colours([full, half], "sums")
    pixels = graph.look_up("unseen", sums, "denoised.pixels")
    graph.add("Transpose", [pixels], "denoised", perm=[0, 3, 1, 2])
    last = fit.shape.last
    count = len(fit.layers[last].step) - gptq.COLOURS
    graph.add("Identity", [_planes(graph, last, gptq.COLOURS * SLICES_OUT, count)], "logits0")
    for level in range(1, scale.bit_length()):
        name = graph.conv(f"head{level}", DECODED[level])
        count = len(fit.layers[name].step)
        planes = _planes(graph, name, 0, count)
        graph.cut(planes, 0, OUTPUTS[level], f"logits{level}")
        if level == 1:
            phases = graph.cut(planes, OUTPUTS[level], count, "log_error.phases")
            graph.add("DepthToSpace", [phases], "log_error", blocksize=2, mode="CRD")
    graph.embed(_blending(network, contract), "mix.", {"hrls.albedo": albedo})
    inputs = [image_info("lrhs", 2 * LRHS_CHANNELS, "hw"), image_info("hrls", HRLS_CHANNELS)]
    results = {"fused": gptq.COLOURS, "log_error": 1} | ({"albedo": 3, "normal": 3} if layers else {})
    return graph.finished("joint", inputs, [image_info(name, count) for name, count in results.items()])


def _blending(network: JointFusion, contract: Contract) -> onnx.ModelProto:
    """Export :class:`Blend`, whose inputs have the names of tensors of the whole graph."""
    lrhs, hrls = network_example(network, contract.scale, contract.alignment)
    levels = range(contract.scale.bit_length())
    sizes = [[network.heads[level].out_channels, *(side >> level for side in hrls.shape[2:])] for level in levels]
    image = hrls[:, :3]
    inputs = (lrhs, image, image.clone(), image.clone(), [torch.rand(1, *size) for size in sizes])
    names = ["lrhs", "hrls.colour", "hrls.albedo", "denoised", *(f"logits{level}" for level in levels)]
    return traced(Blend(network.size), inputs, names, ["fused"], contract.alignment)


def _planes(graph: Graph, layer: str, start: int, count: int) -> str:
    """Dequantise signed outputs of a layer, as (1, C, H, W)."""
    # To transpose all channels and cut them then takes half of the time of the other order.
    planes = graph.add("Transpose", [layer], f"{layer}.planes", perm=[0, 3, 1, 2])
    part = graph.cut(planes, start, start + count, f"{layer}.beside")
    step = graph.constant("signed_step", np.float32(2 * gptq.SIGNED_RANGE / 255))
    middle = graph.constant("middle", np.uint8(gptq.SIGNED_ZERO))
    return graph.add("DequantizeLinear", [part, step, middle], f"{layer}.values")
