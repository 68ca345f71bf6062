# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise's networks for albedo and normal in 8 bits, which `--quality best` runs before the colour."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import onnx
import torch
from torch import Tensor
from torch.nn import functional as F

from research.training.denoisers import LayerDenoisers
from research.training.encoding import from_srgb, srgb
from research.training.oidn import FineTunedUNet
from research.training.quantise.codes import sliced
from research.training.quantise.gptq import Fit, activations, concatenated, run_unet_on_activations, sliced_layout
from research.training.quantise.graph import ENTRIES, Graph, Nodes

#: Slices of albedo and normal before and after they are denoised.
SLICES = 5
#: Bounds of the powers of brighter albedos, see :func:`varied`.
BRIGHTER = (0.1, 1.0)

#: The networks by layer, ``albedo`` and ``normal``.
Networks = dict[str, onnx.ModelProto]


def varied(images: Sequence[Tensor]) -> list[Tensor]:
    """Give some encoded HRLS an albedo that training views lack.

    Weights and codes only suit what calibration has seen; the rest becomes darker. So every second image gets a
    brighter albedo, up to white, in some channels, as bright walls have. Every fourth one gets a black albedo, as
    mirrors, glass and lamps have.
    """
    generator = torch.Generator().manual_seed(0)
    result = [image.clone() for image in images]
    for image in result[1::2]:
        power = BRIGHTER[0] + (BRIGHTER[1] - BRIGHTER[0]) * torch.rand(1, 3, 1, 1, generator=generator)
        image[:, 3:6] = image[:, 3:6].clamp(0, 1) ** power
    for image in result[2::4]:
        image[:, 3:6] = 0
    return result


def fitted(network: FineTunedUNet, images: Sequence[Tensor]) -> tuple[Fit, list[Tensor]]:
    """Quantise a network on its inputs, sRGB-encoded albedos or normals (1, 3, H, W) in [0, 1].

    Returns:
        The fit, and the exact outputs (1, 3, H, W).
    """
    codes = [F.pad(sliced(image, SLICES), (0, 0, 0, 0, 0, 1)) for image in images]
    fit = Fit(network.shape, network.weights(), SLICES)
    inputs = activations(codes, concatenated(sliced_layout(SLICES, 0)))
    result = run_unet_on_activations(network.shape, [inputs], fit.conv)
    return fit, [image[:, :3].clamp(0, 1) for image in result.exact]


def quantised(layers: LayerDenoisers, images: Sequence[Tensor]) -> tuple[Networks, list[tuple[Tensor, Tensor]]]:
    """Quantise both networks on encoded HRLS (1, 9 or more, H, W).

    Returns:
        The networks, and the denoised albedo and normal of every image, (1, 3, H, W) in [0, 1], exactly computed.
    """
    albedo, albedos = fitted(layers.albedo, [srgb(image[:, 3:6]) for image in images])
    normal, normals = fitted(layers.normal, [0.5 * image[:, 6:9] + 0.5 for image in images])
    networks = {"albedo": Graph(albedo).model(), "normal": Graph(normal).model()}
    return networks, list(zip(map(from_srgb, albedos), normals, strict=True))


def add_layers(graph: Nodes, networks: Networks, albedo: str, normal: str, zeros: str) -> None:
    """Add both networks to a graph: tensors ``albedo`` and ``normal``, (1, 3, H, W) in [0, 1].

    Args:
        albedo, normal: the noisy images (1, 3, H, W), in [0, 1] and in [-1, 1].
        zeros: a plane of zeros of that size.
    """
    # OIDN denoises an albedo in sRGB, and reads it linear beside the colour
    graph.constant("srgb", srgb(torch.linspace(0, 1, ENTRIES)).numpy())
    half = graph.constant("one_half", np.float32(0.5))
    shifted = graph.add("Add", [graph.add("Mul", [normal, half], "normal.scaled"), half], "normal.shifted")
    values = torch.linspace(0, 1, 255 * SLICES + 1)
    for name, noisy, of_code in (
        ("albedo", graph.table(albedo, 1.0, "srgb"), from_srgb(values)),
        ("normal", shifted, values),
    ):
        packed = graph.packed([*graph.slices(noisy, SLICES), zeros], f"{name}.layers")
        codes = f"{name}.codes"
        graph.embed(networks[name], f"{name}.", {"layers": packed, "codes": codes})
        pixels = graph.look_up(graph.constant(f"{name}.table", of_code.numpy()), codes, f"{name}.pixels")
        graph.add("Transpose", [pixels], name, perm=[0, 3, 1, 2])
