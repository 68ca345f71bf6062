# SPDX-License-Identifier: Apache-2.0
"""A network that only mixes what Open Image Denoise (OIDN) makes of both renders.

Where OIDN has filtered, kernels over samples gain next to nothing and cost the most (:mod:`training.pyramid`). This
network has none. It reads what OIDN makes of the HRLS and of both renders together at the LRHS's resolution, and
decides pixel by pixel how much it believes of each:

1. At the LRHS's resolution: both renders denoised together, the denoised HRLS's mean, either render's samples.
2. At every finer level, up to the HRLS's: the denoised HRLS as it is; the same at the coarser level's brightness; the
   coarser level's light times the HRLS's albedo; the samples themselves.

No pixel may be darker or brighter than everything around it in both renders.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from training.paper import HRLS_CHANNELS, LRHS_CHANNELS
from training.pyramid import (
    MIN_ALBEDO,
    Trunk,
    highest_around,
    level_of,
    linear,
    logarithmic,
    pointwise,
    pyramid,
)

#: Channels of its U-Net, H/2, H/4, H/8, H/16.
MIX_CHANNELS = (24, 32, 48, 64)
#: Logits that training starts from, at the LRHS's resolution: both renders together, the denoised HRLS, its samples,
#: the LRHS's samples.
COARSEST = (2.0, 0.0, -2.0, -2.0)
#: And at finer levels: the denoised HRLS at the coarser level's brightness, the denoised HRLS, light times albedo, its
#: samples.
FINER = (2.0, 0.0, 0.0, -2.0)
#: Levels that have logits: H, H/2, H/4, H/8.
LEVELS = 4
#: Largest factor by which a level's light is told to differ from the denoised HRLS, and its inverse the smallest.
MAX_RATIO = 8.0
#: Added to both sides of that ratio, in exposed radiance: black is no light to compare with.
RATIO_FLOOR = 1e-3


def mixed(logits: Tensor, images: Sequence[Tensor]) -> Tensor:
    """The images' mean, weighted by the softmax of the logits (N, len(images), H, W)."""
    # Plane by plane: ONNX Runtime's softmax over another axis than the last takes several times as long
    planes = [logits[:, i : i + 1] for i in range(len(images))]
    highest = functools.reduce(torch.maximum, planes).detach()
    weights = [torch.exp(plane - highest) for plane in planes]
    rest = 1 / functools.reduce(torch.add, weights)
    return functools.reduce(torch.add, (rest * weight * image for weight, image in zip(weights, images, strict=True)))


def smoothly_doubled(image: Tensor) -> Tensor:
    return F.interpolate(image, scale_factor=2, mode="bilinear", align_corners=False)


def blend(lrhs: Tensor, hrls: Tensor, denoised: Tensor, logits: Sequence[Tensor]) -> Tensor:
    """The fused image that such logits mean."""
    first = level_of(lrhs, hrls)
    samples, albedo = hrls[:, :3], hrls[:, 3:6]
    means = pyramid(linear(samples), 0, first + 1)
    filtered = pyramid(linear(denoised), 0, first + 1)
    share = torch.sigmoid(logits[0][:, len(FINER) :])
    tints = pyramid((share * albedo + (1 - share)).clamp_min(MIN_ALBEDO), 0, first + 1)
    fused = mixed(
        logits[first][:, len(FINER) :],
        [
            lrhs[:, LRHS_CHANNELS:],
            logarithmic(filtered[first]),
            logarithmic(means[first]),
            lrhs[:, :LRHS_CHANNELS],
        ],
    )
    for level in reversed(range(first)):
        radiance, below = linear(fused), filtered[level + 1]
        light = smoothly_doubled(radiance / tints[level + 1])
        ratio = ((radiance + RATIO_FLOOR) / (below + RATIO_FLOOR)).clamp(1 / MAX_RATIO, MAX_RATIO)
        fused = mixed(
            logits[level],
            [
                logarithmic(filtered[level] * smoothly_doubled(ratio)),
                logarithmic(filtered[level]) if level else denoised,
                logarithmic(light * tints[level]),
                logarithmic(means[level]) if level else samples,
            ],
        )
    lowest, highest = (
        F.interpolate(
            sign * highest_around(sign * lrhs[:, :LRHS_CHANNELS], sign * samples), scale_factor=2, mode="nearest"
        )
        for sign in (-1.0, 1.0)
    )
    return torch.clamp(fused, lowest, highest)


class MixFusion(Trunk):
    """See the module's docstring. One set of weights serves every scale, which follows from the images' sizes.

    Args:
        channels: of the U-Net's levels H/2, H/4, H/8, ...; four or more.
        stem_size: HRLS pixels across that a pixel of H/2 is first made of; if more than 2, H/2 has a last convolution.
    """

    def __init__(self, channels: Sequence[int] = MIX_CHANNELS, stem_size: int = 2) -> None:
        super().__init__(channels, "high", stem_size, refined=stem_size > 2)
        self.config = {"channels": list(channels), "stem_size": stem_size}
        # Of level 0, four pixels for each of H/2, and the share of the albedo too
        reads = [channels[0], *channels]
        outputs = [4 * (len(FINER) + 1), *[len(FINER) + len(COARSEST)] * (LEVELS - 1)]
        self.heads = nn.ModuleList(nn.Conv2d(reads[i], size, 1) for i, size in enumerate(outputs))
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Every pixel starts with the same shares."""
        self.reset_convolutions()
        for level, head in enumerate(self.heads):
            head.weight.mul_(0.1)
            start = torch.tensor(FINER + COARSEST if level else (*FINER, 2.0))
            head.bias.copy_(start if level else start.repeat_interleave(4))

    def forward(self, lrhs: Tensor, hrls: Tensor) -> tuple[Tensor, Tensor]:
        """
        Args:
            lrhs: (N, 6, h, w), network values: the LRHS, and both renders denoised together.
            hrls: (N, 19, s*h, s*w), network values: the HRLS's layers, and the denoised HRLS.

        Returns:
            The fused image (N, 3, s*h, s*w) in network values, and the logarithm of its expected absolute error
            (N, 1, s*h, s*w), mean of the channels, in network values too. Nothing else learns from the latter.
        """
        logits, log_error = self.decide(lrhs, hrls)
        return blend(lrhs, hrls, hrls[:, HRLS_CHANNELS:], logits), log_error

    def decide(self, lrhs: Tensor, hrls: Tensor) -> tuple[list[Tensor], Tensor]:
        """Logits of every level, H, H/2, ..., and of the expected error: all that is learnt."""
        deepest = len(self.mix) + 2
        colours = pyramid(linear(hrls[:, :3]), 0, deepest)
        features = self.features(lrhs, hrls, colours, pyramid(linear(lrhs), level_of(lrhs, hrls), deepest))
        logits = [pointwise(head, features[max(level - 1, 0)]).float() for level, head in enumerate(self.heads)]
        log_error = pointwise(self.error, features[0].detach()).float()
        return [F.pixel_shuffle(logits[0], 2), *logits[1:]], F.pixel_shuffle(log_error, 2)


def disagreement(logits: Sequence[Tensor], others: Sequence[Tensor], first: int) -> Tensor:
    """How far one network's decisions are from another's: the divergence of their shares, mean of all pixels, summed
    over the levels that a scale of 2**first uses; and of the albedo's share, the squared difference."""
    total = (torch.sigmoid(logits[0][:, len(FINER) :]) - torch.sigmoid(others[0][:, len(FINER) :])).square().mean()
    for level in range(first + 1):
        used = slice(len(FINER)) if level < first else slice(len(FINER), None)
        ours, theirs = (torch.log_softmax(each[level][:, used], dim=1) for each in (logits, others))
        total = total + (theirs.exp() * (theirs - ours)).sum(dim=1).mean()
    return total
