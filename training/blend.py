# SPDX-License-Identifier: Apache-2.0
"""Blends the denoised HRLS, the denoised mean of both renders and both renders themselves, by predicted weights.

The candidates are:

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
from torch import Tensor
from torch.nn import functional as F

from training.encoding import log_decode, log_encode
from training.ops import highest_around, log2_scale, pyramid, upsample
from training.paper import LRHS_CHANNELS
from training.pyramid import MIN_ALBEDO

#: Initial logits at the LRHS's resolution: the denoised mean of both renders, the denoised HRLS, the HRLS, the LRHS.
COARSEST = (2.0, 0.0, -2.0, -2.0)
#: Initial logits at finer levels: the denoised HRLS at the coarser level's brightness, the denoised HRLS, light times
#: albedo, the HRLS.
FINER = (2.0, 0.0, 0.0, -2.0)
#: LRHS pixels over which the renders' brightest samples allow a bright result.
FAR = 16
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
    low, mean = lrhs.split(LRHS_CHANNELS, dim=1)
    lowest, highest = (sign * highest_allowed(sign * low, sign * mean, sign * samples) for sign in (-1.0, 1.0))
    return torch.clamp(fused, lowest, highest)


def highest_allowed(lrhs: Tensor, mean: Tensor, samples: Tensor) -> Tensor:
    """The largest value that a pixel may have.

    It is the highest sample of either render close around. Where light is rare, all of these may be too dark. So the
    denoised mean of both renders counts, too, as far as some sample within ``FAR`` LRHS pixels is as bright.

    Args:
        lrhs, mean: (N, 3, h, w), the LRHS and the denoised mean of both renders.
        samples: (N, 3, s*h, s*w), the HRLS.

    Returns:
        (N, 3, s*h, s*w)
    """
    scale = 2 ** log2_scale(lrhs, samples)
    brightest = torch.maximum(lrhs, F.max_pool2d(samples.contiguous(), scale))
    for _ in range(FAR // 4):
        brightest = F.max_pool2d(brightest, 9, stride=1, padding=4)
    expected = F.max_pool2d(torch.minimum(mean, brightest), 3, stride=1, padding=1)
    return torch.maximum(upsample(highest_around(lrhs, samples), 2), upsample(expected, scale))
