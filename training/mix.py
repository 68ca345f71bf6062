# SPDX-License-Identifier: Apache-2.0
"""The ``mix`` network: per-pixel weights for blending two results of Open Image Denoise (OIDN) and both renders.

After OIDN has filtered, predicted kernels (:mod:`training.pyramid`) gain almost nothing and take most of the time. This
network predicts weights only. OIDN has denoised the HRLS, and the mean of both renders at the LRHS's resolution. The
candidates are:

1. At the LRHS's resolution: the denoised mean of both renders, the downsampled denoised HRLS, the downsampled HRLS, the
   LRHS.
2. At every finer level, up to the HRLS's: the denoised HRLS scaled to the coarser level's brightness, the denoised
   HRLS, the coarser level's light times the HRLS's albedo, the HRLS.

Every pixel is clamped to the range of its neighbourhood in both renders.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from training.encoding import log_decode, log_encode
from training.ops import highest_around, log2_scale, pointwise, pyramid, upsample
from training.paper import HRLS_CHANNELS, LRHS_CHANNELS
from training.pyramid import MIN_ALBEDO
from training.trunk import Trunk

#: Channels of the U-Net at H/2, H/4, H/8, H/16.
MIX_CHANNELS = (24, 32, 48, 64)
#: Initial logits at the LRHS's resolution: the denoised mean of both renders, the denoised HRLS, the HRLS, the LRHS.
COARSEST = (2.0, 0.0, -2.0, -2.0)
#: Initial logits at finer levels: the denoised HRLS at the coarser level's brightness, the denoised HRLS, light times
#: albedo, the HRLS.
FINER = (2.0, 0.0, 0.0, -2.0)
#: Levels that have logits: H, H/2, H/4, H/8.
LEVELS = 4
#: Bounds of the ratio of a level's light to the denoised HRLS: 1 / MAX_RATIO and MAX_RATIO.
MAX_RATIO = 8.0
#: Added to both sides of that ratio, in exposed radiance, so that black pixels give a ratio of 1.
RATIO_FLOOR = 1e-3


def mixed(logits: Tensor, images: Sequence[Tensor]) -> Tensor:
    """Mean of the images, weighted by the softmax of the logits (N, len(images), H, W)."""
    # Plane by plane: ONNX Runtime's softmax over any axis but the last takes several times as long
    planes = [logits[:, i : i + 1] for i in range(len(images))]
    highest = functools.reduce(torch.maximum, planes).detach()
    weights = [torch.exp(plane - highest) for plane in planes]
    rest = 1 / functools.reduce(torch.add, weights)
    return functools.reduce(torch.add, (rest * weight * image for weight, image in zip(weights, images, strict=True)))


def blend(lrhs: Tensor, hrls: Tensor, denoised: Tensor, logits: Sequence[Tensor]) -> Tensor:
    """Blend the candidates with the softmax of the logits.

    Args:
        lrhs: (N, 6, h, w): the LRHS and the denoised mean of both renders, log-encoded.
        hrls: (N, 6 or more, s*h, s*w): the HRLS's colour and albedo.
        denoised: (N, 3, s*h, s*w), the denoised HRLS, log-encoded.
        logits: of the levels H, H/2, ..., (N, 8, H/2^i, W/2^i): the first four choose between the candidates of a fine
            level, the others between those of the LRHS's level. At H, the fifth is the share of the albedo.

    Returns:
        The fused image (N, 3, s*h, s*w), log-encoded.
    """
    first = log2_scale(lrhs, hrls)
    samples, albedo = hrls[:, :3], hrls[:, 3:6]
    means = pyramid(log_decode(samples), 0, first + 1)
    filtered = pyramid(log_decode(denoised), 0, first + 1)
    share = torch.sigmoid(logits[0][:, len(FINER) :])
    tints = pyramid((share * albedo + (1 - share)).clamp_min(MIN_ALBEDO), 0, first + 1)
    fused = mixed(
        logits[first][:, len(FINER) :],
        [
            lrhs[:, LRHS_CHANNELS:],
            log_encode(filtered[first]),
            log_encode(means[first]),
            lrhs[:, :LRHS_CHANNELS],
        ],
    )
    for level in reversed(range(first)):
        radiance, below = log_decode(fused), filtered[level + 1]
        light = upsample(radiance / tints[level + 1], 2, "bilinear")
        ratio = ((radiance + RATIO_FLOOR) / (below + RATIO_FLOOR)).clamp(1 / MAX_RATIO, MAX_RATIO)
        fused = mixed(
            logits[level],
            [
                log_encode(filtered[level] * upsample(ratio, 2, "bilinear")),
                log_encode(filtered[level]) if level else denoised,
                log_encode(light * tints[level]),
                log_encode(means[level]) if level else samples,
            ],
        )
    lowest, highest = (
        upsample(sign * highest_around(sign * lrhs[:, :LRHS_CHANNELS], sign * samples), 2) for sign in (-1.0, 1.0)
    )
    return torch.clamp(fused, lowest, highest)


class MixFusion(Trunk):
    """See the module's docstring. One set of weights serves every scale; the image sizes give the scale.

    Args:
        channels: of the U-Net's levels H/2, H/4, H/8, ...; four or more.
        stem_size: kernel size of the first convolution over the HRLS; if above 2, level H/2 ends with a convolution.
    """

    def __init__(self, channels: Sequence[int] = MIX_CHANNELS, stem_size: int = 2) -> None:
        super().__init__(channels, "high", stem_size, refined=stem_size > 2)
        self.config = {"channels": list(channels), "stem_size": stem_size}
        # The head of level 0 reads H/2 and predicts four pixels at a time, and the share of the albedo
        reads = [channels[0], *channels]
        outputs = [4 * (len(FINER) + 1), *[len(FINER) + len(COARSEST)] * (LEVELS - 1)]
        self.heads = nn.ModuleList(nn.Conv2d(reads[i], size, 1) for i, size in enumerate(outputs))
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Every pixel starts with the same weights."""
        self.reset_convolutions()
        for level, head in enumerate(self.heads):
            head.weight.mul_(0.1)
            start = torch.tensor(FINER + COARSEST if level else (*FINER, 2.0))
            head.bias.copy_(start if level else start.repeat_interleave(4))

    def forward(self, lrhs: Tensor, hrls: Tensor) -> tuple[Tensor, Tensor]:
        """
        Args:
            lrhs: (N, 6, h, w), log-encoded: the LRHS and the denoised mean of both renders.
            hrls: (N, 19, s*h, s*w): the HRLS's encoded features, and the denoised HRLS, log-encoded.

        Returns:
            The fused image (N, 3, s*h, s*w), log-encoded, and the logarithm of its expected absolute error
            (N, 1, s*h, s*w), mean of the channels. The error has no gradient into the features.
        """
        logits, log_error = self.predict_logits(lrhs, hrls)
        return blend(lrhs, hrls, hrls[:, HRLS_CHANNELS:], logits), log_error

    def predict_logits(self, lrhs: Tensor, hrls: Tensor) -> tuple[list[Tensor], Tensor]:
        """The logits of :func:`blend`, and the logarithm of the expected error."""
        deepest = len(self.mix) + 2
        colours = pyramid(log_decode(hrls[:, :3]), 0, deepest)
        features = self.features(lrhs, hrls, colours, pyramid(log_decode(lrhs), log2_scale(lrhs, hrls), deepest))
        logits = [pointwise(head, features[max(level - 1, 0)]).float() for level, head in enumerate(self.heads)]
        log_error = pointwise(self.error, features[0].detach()).float()
        return [F.pixel_shuffle(logits[0], 2), *logits[1:]], F.pixel_shuffle(log_error, 2)


def distillation_loss(logits: Sequence[Tensor], teacher: Sequence[Tensor], coarsest: int) -> Tensor:
    """Distance of the predicted weights from a teacher's.

    The Kullback-Leibler divergence of the weights, mean of all pixels, summed over the levels that a scale of
    2**coarsest uses, plus the squared difference of the albedo's shares.
    """
    total = (torch.sigmoid(logits[0][:, len(FINER) :]) - torch.sigmoid(teacher[0][:, len(FINER) :])).square().mean()
    for level in range(coarsest + 1):
        used = slice(len(FINER)) if level < coarsest else slice(len(FINER), None)
        ours, theirs = (torch.log_softmax(each[level][:, used], dim=1) for each in (logits, teacher))
        total = total + (theirs.exp() * (theirs - ours)).sum(dim=1).mean()
    return total
