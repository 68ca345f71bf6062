# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise's U-Nets in PyTorch: their layout, their weights, and how to fine-tune them.

A fine-tuned network stores the difference from Open Image Denoise's weights, which are read from the installed library.
No file of this project holds the original weights.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from research.training.oidn_weights import require_weights
from research.training.ops import upsample

#: Open Image Denoise's names of its networks, see :data:`research.training.oidn_weights.NETWORKS`.
SMALL_HDR, BASE_HDR, LARGE_HDR = "rt_hdr_alb_nrm_small", "rt_hdr_alb_nrm", "rt_hdr_calb_cnrm_large"
#: The small network for noise-free albedo and normal.
SMALL_CLEAN_HDR = "rt_hdr_calb_cnrm_small"
ALBEDO_BASE, NORMAL_BASE = "rt_alb", "rt_nrm"

Weights = Mapping[str, Tensor]


def pretrained_weights(network: str) -> dict[str, Tensor]:
    """Read the weights of one of :data:`research.training.oidn_weights.NETWORKS`, by Open Image Denoise's names.

    Raises:
        InputError: pyoidn is not installed, or has other weights.
    """
    return {name: torch.from_numpy(values.astype(np.float32)) for name, values in require_weights(network).items()}


def provenance(network: str) -> dict[str, str]:
    """Return what a model's file says about the weights that its training began from."""
    return {"initial_weights": f"Open Image Denoise 2.5.1, {network} (Apache-2.0)"}


def convolutions(weights: Weights) -> list[str]:
    """Return the names of the convolutions in ``weights``."""
    return [name.removesuffix(".weight") for name in weights if name.endswith(".weight")]


@dataclass(frozen=True)
class Shape:
    """Names of a U-Net's convolutions, all 3 x 3 and followed by a ReLU."""

    down: list[list[str]]
    """Of each level on the way down; max pooling follows each level."""
    bottom: list[str]
    up: list[list[str]]
    """Of each level on the way up, which reads the level below, upsampled, and the input of the same level down."""
    last: str
    """The convolution that returns the colour."""


#: Small and base networks.
BASE = Shape(
    [["enc_conv0", "enc_conv1"], ["enc_conv2"], ["enc_conv3"], ["enc_conv4"]],
    ["enc_conv5a", "enc_conv5b"],
    [[f"dec_conv{level}{part}" for part in "ab"] for level in (4, 3, 2, 1)],
    "dec_conv0",
)
LARGE = Shape(
    [[f"enc_conv{level}{part}" for part in "ab"] for level in (1, 2, 3, 4)],
    ["enc_conv5a", "enc_conv5b"],
    [[f"dec_conv{level}{part}" for part in "ab"] for level in (4, 3, 2, 1)],
    "dec_conv1c",
)

T = TypeVar("T")


def run_unet(
    shape: Shape, inputs: Sequence[T], conv: Callable[[str, T], T],
    pool: Callable[[T], T], upsample: Callable[[T], T], concat: Callable[[T, T], T],
) -> T:  # fmt: skip
    """Run a U-Net on any type of value: tensors, lists of tensors, names of a graph's tensors.

    Args:
        inputs: the input at full size, then any at half size, quarter size, ..., which are concatenated to that level.
        conv: run the convolution of a name.
    """
    values, *smaller = inputs
    skipped = []
    for level in shape.down:
        skipped.append(values)
        for name in level:
            values = conv(name, values)
        values = pool(values)
        if smaller:
            values = concat(values, smaller.pop(0))
    for name in shape.bottom:
        values = conv(name, values)
    for level in shape.up:
        values = concat(upsample(values), skipped.pop())
        for name in level:
            values = conv(name, values)
    return conv(shape.last, values)


def run_unet_on_tensors(shape: Shape, inputs: Sequence[Tensor], conv: Callable[[str, Tensor], Tensor]) -> Tensor:
    """Run a U-Net on images (N, C, H, W)."""

    def concat(above: Tensor, skipped: Tensor) -> Tensor:
        return torch.cat([above, skipped], dim=1)

    return run_unet(
        shape, inputs, conv, lambda values: F.max_pool2d(values, 2), lambda values: upsample(values, 2), concat
    )


class FineTunedConv(nn.Module):
    """A 3 x 3 convolution whose parameters are the difference from pretrained ones.

    Args:
        weight, bias: the pretrained parameters.
        extra: input channels after the others that the pretrained convolution lacks; their weights start at 0.
        frozen: keep the pretrained parameters.
    """

    pretrained_weight: Tensor
    pretrained_bias: Tensor

    def __init__(self, weight: Tensor, bias: Tensor, extra: int = 0, *, frozen: bool = False) -> None:
        super().__init__()
        self.register_buffer("pretrained_weight", weight, persistent=False)
        self.register_buffer("pretrained_bias", bias, persistent=False)
        self.weight = None if frozen else nn.Parameter(torch.zeros_like(weight))
        self.bias = None if frozen else nn.Parameter(torch.zeros_like(bias))
        self.extra = nn.Parameter(weight.new_zeros(len(weight), extra, 3, 3)) if extra else None

    def differences(self) -> list[nn.Parameter]:
        """Return the parameters that are added to pretrained ones."""
        return [parameter for parameter in (self.weight, self.bias) if parameter is not None]

    def total(self) -> tuple[Tensor, Tensor]:
        """Return weight and bias of the convolution: pretrained parameters plus differences."""
        weight, bias = self.pretrained_weight, self.pretrained_bias
        if self.weight is not None and self.bias is not None:
            weight, bias = weight + self.weight, bias + self.bias
        if self.extra is not None:
            weight = torch.cat([weight, self.extra], dim=1)
        return weight, bias

    def forward(self, image: Tensor) -> Tensor:
        """Convolve an image (N, C, H, W)."""
        return F.conv2d(image, *self.total(), padding=1)

    def merged(self) -> nn.Conv2d:
        """Return a plain convolution with the same result, for the exporter."""
        weight, bias = self.total()
        result = nn.Conv2d(weight.shape[1], len(weight), 3, padding=1)
        result.load_state_dict({"weight": weight, "bias": bias})
        return result


@dataclass(frozen=True)
class Start:
    """What the fine-tuning of a whole network starts from."""

    network: str
    """A key of :data:`research.training.oidn_weights.NETWORKS`."""
    shape: Shape
    readers: tuple[str, ...]
    """The convolutions that read the input."""
    extra: int
    """Input channels that the pretrained network lacks."""
    frozen: tuple[str, ...] = ()
    """Convolutions that keep the pretrained weights."""


def untouched(network: str, shape: Shape) -> Start:
    """Return a network as it is in Open Image Denoise, to be run and not to be trained."""
    return Start(network, shape, (), 0, tuple(convolutions(pretrained_weights(network))))


class FineTunedUNet(nn.Module):
    """A network of Open Image Denoise, fine-tuned to read further channels after its own."""

    def __init__(self, start: Start) -> None:
        super().__init__()
        self.start = start
        pretrained = pretrained_weights(start.network)
        self.convs: Any = nn.ModuleDict()  # of FineTunedConv
        for name in convolutions(pretrained):
            weight, bias = pretrained[f"{name}.weight"], pretrained[f"{name}.bias"]
            extra = start.extra if name in start.readers else 0
            self.convs[name] = FineTunedConv(weight, bias, extra, frozen=name in start.frozen)

    def run(self, image: Tensor) -> Tensor:
        """Run the network on an image (N, C, H, W); H and W are multiples of 16."""

        def conv(name: str, values: Tensor) -> Tensor:
            return F.relu(self.convs[name](values))

        dtype = next(itertools.chain(self.convs.parameters(), self.convs.buffers())).dtype
        return run_unet_on_tensors(self.start.shape, [image.to(dtype)], conv).float()

    def weights(self) -> dict[str, Tensor]:
        """Return the weights and biases of all convolutions, by Open Image Denoise's names."""
        pairs = {name: conv.total() for name, conv in self.convs.items()}
        return {
            f"{name}.{kind}": values.detach()
            for name, pair in pairs.items()
            for kind, values in zip(("weight", "bias"), pair, strict=True)
        }
