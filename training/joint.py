# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise's network, taught to read both renders.

Open Image Denoise has learnt from far more pictures than we can render; what it has not learnt is what a second render
says. So this network begins as its usual one for HDR colour with albedo and normal. At H/2 it reads two pictures more,
the LRHS and both renders denoised together at the LRHS's resolution (:mod:`oiio_msspl.denoiser`), which count for
nothing at first; and all of its weights go on learning, for renders of so few samples alone.

Its parameters are what they differ by from Open Image Denoise's, which are read from the installed library: no file
holds the latter. Weight decay pulls towards them.

No pixel may be darker or brighter than everything around it in both renders.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from oiio_msspl import schema, transforms
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
from training.mix import COARSEST, FINER, blend
from training.paper import LRHS_CHANNELS
from training.pyramid import level_of, linear, logarithmic
from training.unet import SMALLER, walk

#: Channels that H/2 reads more: both together, the LRHS.
MORE = 6
#: The convolutions that read them.
READERS = ("enc_conv2", "dec_conv2a")
#: Of each level that has logits, H, H/2, H/4, H/8: the last convolution, and how many it has.
DECODED = ("dec_conv1b", "dec_conv2b", "dec_conv3b", "dec_conv4b")
#: On the way up, the convolution whose outputs are another one's first inputs.
BEFORE = {
    name: before for before, name in itertools.pairwise([*(n for level in SMALLER.up for n in level), SMALLER.last])
}
OUTPUTS = (len(FINER) + 1, *[len(FINER) + len(COARSEST)] * 3)


class Retrained(nn.Module):
    """A 3 x 3 convolution whose parameters are added to given ones.

    Args:
        weight, bias: the given ones.
        more: input channels, behind the others, for which there are none.
    """

    def __init__(self, weight: Tensor, bias: Tensor, more: int = 0) -> None:
        super().__init__()
        self.register_buffer("given_weight", weight, persistent=False)
        self.register_buffer("given_bias", bias, persistent=False)
        self.weight = nn.Parameter(torch.zeros_like(weight))
        self.bias = nn.Parameter(torch.zeros_like(bias))
        self.more = nn.Parameter(weight.new_zeros(len(weight), more, 3, 3)) if more else None

    def parameters_in_all(self) -> tuple[Tensor, Tensor]:
        """Weight and bias that the convolution has."""
        weight = self.given_weight + self.weight
        if self.more is not None:
            weight = torch.cat([weight, self.more], dim=1)
        return weight, self.given_bias + self.bias

    def forward(self, image: Tensor) -> Tensor:
        return F.conv2d(image, *self.parameters_in_all(), padding=1)


class JointFusion(nn.Module):
    """See the module's docstring. One set of weights serves every scale, which follows from the images' sizes.

    Sizes must be multiples of ``multiple`` HRLS pixels.
    """

    multiple = 16

    def __init__(self, kept: Mapping[str, Sequence[int]] | None = None) -> None:
        super().__init__()
        self.kept = dict(kept or {})
        self.config = {"kept": self.kept}
        self.lrhs_channels, self.hrls_channels = (sum(features.values()) for features in schema.inputs("together"))
        self.given = {
            name: torch.from_numpy(values.astype("float32")) for name, values in installed_weights("usual").items()
        }
        self.convs = nn.ModuleDict()
        for name in (name.removesuffix(".weight") for name in self.given if name.endswith(".weight")):
            rows, columns = self.given_channels(name)
            weight, bias = self.given[f"{name}.weight"][rows][:, columns], self.given[f"{name}.bias"][rows]
            self.convs[name] = Retrained(weight, bias, MORE if name in READERS else 0)
        self.heads = nn.ModuleList(
            nn.Conv2d(len(self.convs[name].bias), size, 3, padding=1)
            for name, size in zip(DECODED, OUTPUTS, strict=True)
        )
        self.error = nn.Conv2d(len(self.convs[DECODED[1]].bias), 4, 3, padding=1)
        with torch.no_grad():
            for level, head in enumerate(self.heads):
                nn.init.kaiming_normal_(head.weight)
                head.weight.mul_(0.1)
                head.bias.copy_(torch.tensor(FINER + COARSEST if level else (*FINER, 2.0)))
        self.reset_error()

    def given_channels(self, name: str) -> tuple[list[int], list[int]]:
        """Which of a given convolution's outputs and inputs the network has."""
        count, inputs = self.given[f"{name}.weight"].shape[:2]
        rows, columns = list(self.kept.get(name, range(count))), list(range(inputs))
        if before := BEFORE.get(name):
            everything = len(self.given[f"{before}.bias"])
            columns = [*self.kept.get(before, range(everything)), *columns[everything:]]
        return rows, columns

    def retrained(self) -> Iterator[nn.Parameter]:
        """Parameters that are added to given ones."""
        for conv in self.convs.values():
            yield from (conv.weight, conv.bias)

    @torch.no_grad()
    def reset_error(self) -> None:
        """The predicted error starts alike everywhere. :mod:`training.error` teaches it."""
        self.error.weight.zero_()
        self.error.bias.fill_(math.log(0.05))

    def forward(self, lrhs: Tensor, hrls: Tensor) -> tuple[Tensor, Tensor]:
        """
        Args:
            lrhs: (N, 6, h, w), network values: the LRHS, and both renders denoised together.
            hrls: (N, 16, s*h, s*w), network values: the HRLS's layers.

        Returns:
            The fused image (N, 3, s*h, s*w) in network values, and the logarithm of its expected absolute error
            (N, 1, s*h, s*w), mean of the channels, in network values too. Nothing else learns from the latter.
        """
        samples, albedo, normal = hrls[:, :3], hrls[:, 3:6], hrls[:, 6:9]
        picture = torch.cat([seen(samples), albedo.clamp(0, 1), 0.5 * normal + 0.5], dim=1)
        more = seen(torch.cat([lrhs[:, LRHS_CHANNELS:], lrhs[:, :LRHS_CHANNELS]], dim=1))
        more = F.interpolate(more, scale_factor=2 ** (level_of(lrhs, hrls) - 1), mode="nearest")
        features: dict[str, Tensor] = {}

        def conv(name: str, values: Tensor) -> Tensor:
            features[name] = F.relu(self.convs[name](values))
            return features[name]

        colour = walk(
            SMALLER,
            [picture, more],
            conv,
            halve=lambda values: F.max_pool2d(values, 2),
            double=lambda values: F.interpolate(values, scale_factor=2, mode="nearest"),
            join=lambda one, other: torch.cat([one, other], dim=1),
        )
        logits = [head(features[name]).float() for head, name in zip(self.heads, DECODED, strict=True)]
        log_error = F.pixel_shuffle(self.error(features[DECODED[1]].detach()).float(), 2)
        denoised = unseen(colour.float().clamp_max(1.0))
        return blend(lrhs, hrls, denoised, logits), log_error


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
