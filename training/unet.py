# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise's U-Nets: their shape, and what PyTorch needs to go on training them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from oiio_msspl import transforms
from oiio_msspl.denoiser import installed_weights
from oiio_msspl.eight_bit import (
    BOUNDS,
    EXPONENT,
    FACTOR,
    LOG_FACTOR,
    LOG_OFFSET,
    LOG_SHIFT,
    OFFSET,
    SLOPE,
    encode,
    top,
)
from training.pyramid import linear, logarithmic


def given_weights(network: str) -> dict[str, Tensor]:
    """Of one of :data:`oiio_msspl.eight_bit.NETWORKS`, as Open Image Denoise has them.

    Raises:
        InputError: pyoidn is not installed, or has others.
    """
    return {name: torch.from_numpy(values.astype(np.float32)) for name, values in installed_weights(network).items()}


def convolutions(weights: Mapping[str, Tensor]) -> list[str]:
    """Names of those that there are weights of."""
    return [name.removesuffix(".weight") for name in weights if name.endswith(".weight")]


@dataclass(frozen=True)
class Shape:
    """Names of a U-Net's convolutions, all 3 x 3 and followed by a ReLU: of each level down, at the bottom, of each
    level up (which reads the level below, enlarged, and what went into the level down), and the one that makes colour.
    """

    down: list[list[str]]
    bottom: list[str]
    up: list[list[str]]
    last: str


SMALLER = Shape(
    [["enc_conv0", "enc_conv1"], ["enc_conv2"], ["enc_conv3"], ["enc_conv4"]],
    ["enc_conv5a", "enc_conv5b"],
    [[f"dec_conv{level}{part}" for part in "ab"] for level in (4, 3, 2, 1)],
    "dec_conv0",
)
LARGER = Shape(
    [[f"enc_conv{level}{part}" for part in "ab"] for level in (1, 2, 3, 4)],
    ["enc_conv5a", "enc_conv5b"],
    [[f"dec_conv{level}{part}" for part in "ab"] for level in (4, 3, 2, 1)],
    "dec_conv1c",
)

T = TypeVar("T")


def walk(
    shape: Shape,
    pictures: Sequence[T],
    conv: Callable[[str, T], T],
    halve: Callable[[T], T],
    double: Callable[[T], T],
    join: Callable[[T, T], T],
) -> T:
    """A U-Net on anything: tensors, lists of them, names of a graph.

    Args:
        pictures: what it reads, by level: the whole size, a half of it ... The first level has one.
        join: of the same size, by channels.
    """
    values, *smaller = pictures
    skipped = []
    for level in shape.down:
        skipped.append(values)
        for name in level:
            values = conv(name, values)
        values = halve(values)
        if smaller:
            values = join(values, smaller.pop(0))
    for name in shape.bottom:
        values = conv(name, values)
    for level in shape.up:
        values = join(double(values), skipped.pop())
        for name in level:
            values = conv(name, values)
    return conv(shape.last, values)


def walk_tensors(shape: Shape, pictures: Sequence[Tensor], conv: Callable[[str, Tensor], Tensor]) -> Tensor:
    """A U-Net on images (N, C, H, W)."""
    return walk(
        shape,
        pictures,
        conv,
        halve=lambda values: F.max_pool2d(values, 2),
        double=lambda values: F.interpolate(values, scale_factor=2, mode="nearest"),
        join=lambda one, other: torch.cat([one, other], dim=1),
    )


class Retrained(nn.Module):
    """A 3 x 3 convolution whose parameters are added to given ones.

    Args:
        weight, bias: the given ones.
        more: input channels, behind the others, for which there are none.
        held: nothing is added.
    """

    def __init__(self, weight: Tensor, bias: Tensor, more: int = 0, *, held: bool = False) -> None:
        super().__init__()
        self.register_buffer("given_weight", weight, persistent=False)
        self.register_buffer("given_bias", bias, persistent=False)
        self.weight = None if held else nn.Parameter(torch.zeros_like(weight))
        self.bias = None if held else nn.Parameter(torch.zeros_like(bias))
        self.more = nn.Parameter(weight.new_zeros(len(weight), more, 3, 3)) if more else None

    def retrained(self) -> list[nn.Parameter]:
        """Parameters that are added to given ones."""
        return [parameter for parameter in (self.weight, self.bias) if parameter is not None]

    def parameters_in_all(self) -> tuple[Tensor, Tensor]:
        """Weight and bias that the convolution has."""
        weight, bias = self.given_weight, self.given_bias
        if self.weight is not None and self.bias is not None:
            weight, bias = weight + self.weight, bias + self.bias
        if self.more is not None:
            weight = torch.cat([weight, self.more], dim=1)
        return weight, bias

    def forward(self, image: Tensor) -> Tensor:
        return F.conv2d(image, *self.parameters_in_all(), padding=1)


def seen(values: Tensor) -> Tensor:
    """Network values as Open Image Denoise sees them, as :func:`oiio_msspl.eight_bit.encode`."""
    radiance = linear(values.float()).clamp(0, transforms.MAX_RADIANCE)
    low, middle = BOUNDS
    power = FACTOR * radiance.clamp_min(low) ** EXPONENT + OFFSET
    curve = torch.where(radiance <= middle, power, LOG_FACTOR * torch.log(radiance + LOG_SHIFT) + LOG_OFFSET)
    return torch.where(radiance <= low, SLOPE * radiance, curve) / top()


def unseen(values: Tensor) -> Tensor:
    """Inverse of :func:`seen`, as :func:`oiio_msspl.eight_bit.decode`."""
    curve = values * top()
    low, middle = (encode(np.asarray(BOUNDS)) * top()).tolist()
    # Bounded, because what torch.where leaves out must not be infinite: its gradient would be NaN
    power = ((curve.clamp(low, middle) - OFFSET) / FACTOR) ** (1 / EXPONENT)
    logarithm = torch.exp((curve.clamp_min(middle) - LOG_OFFSET) / LOG_FACTOR) - LOG_SHIFT
    radiance = torch.where(curve <= middle, power, logarithm)
    return logarithmic(torch.where(curve <= low, curve / SLOPE, radiance))
