# SPDX-License-Identifier: Apache-2.0
"""A leaner network than the paper's: predicted kernels in a pyramid of light, instead of predicted colours.

The paper's network computes every pixel anew. This one decides, pixel by pixel, which of the samples that both renders
hold are averaged:

1. A U-Net whose finest level is half the HRLS's resolution reads both renders.
2. Light is told from texture: the HRLS's albedo is filtered by predicted 3x3 kernels, and a predicted share ``gamma``
   per pixel says how far the colour follows it (not at all for mirrors, glass, emitters and sky).
3. From coarse to fine, H/16 to H, every level averages its own samples (the downsampled HRLS and, from the LRHS's
   resolution on, the LRHS) over predicted kernels, together with the coarser level's result around the pixel. Samples
   also carry predicted weights of their own, so that a firefly is left out wherever it might be read.

4. Two convolutions see that result beside the features and retouch it, within ``MAX_RETOUCH``: samples that hit or miss
   an edge make it jagged, and no mean of samples is as straight as the edge.

5. No pixel may be darker or brighter than everything around it in both renders.

So the result is nearly a weighted mean of the light that was rendered, times a filtered albedo, and whatever the input,
it stays within what was rendered. Kernel-predicting denoisers are
Bako et al. 2017 and Vogels et al. 2018; weights of samples beside weights of taps are like the splats of Gharbi et al.
2019.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from oiio_msspl import schema, transforms
from training.paper import HRLS_CHANNELS, LRHS_CHANNELS, conv3x3

#: Levels of the pyramid of light: H, H/2, ... H/16.
LEVELS = 5
#: Smallest reflectance that light is divided by.
MIN_ALBEDO = 0.02
#: Largest change of the last step, in network values: from mid-grey, about two stops.
MAX_RETOUCH = 0.5
#: Weights are exponentials of the network's outputs within these bounds.
MAX_LOGIT = 12.0

_LOG_SCALE = 1.0 / math.log1p(transforms.MU)
_ALBEDO = slice(schema.HRLS_FEATURES[schema.RGB], schema.HRLS_FEATURES[schema.RGB] + 3)


def linear(values: Tensor) -> Tensor:
    """Network values to exposed radiance, as :func:`oiio_msspl.transforms.expand`."""
    return torch.expm1(values / _LOG_SCALE) / transforms.MU


def logarithmic(radiance: Tensor) -> Tensor:
    """Exposed radiance to network values, as :func:`oiio_msspl.transforms.compress`."""
    return torch.log1p(transforms.MU * radiance) * _LOG_SCALE


def halve(image: Tensor) -> Tensor:
    """Mean of 2x2 pixels."""
    return F.avg_pool2d(image, 2)


def double(image: Tensor) -> Tensor:
    """Every pixel four times."""
    return F.interpolate(image, scale_factor=2, mode="nearest")


def weighted_sum(weights: Tensor, image: Tensor, dilation: int = 1) -> Tensor:
    """Sum of an image's neighbours with a weight for each tap and pixel.

    Args:
        weights: (N, k * k, H, W), taps row by row.
        image: (N, C, H, W); zero beyond its edges, which leaves them out where one channel carries the weights.
        dilation: pixels between taps.
    """
    if torch.is_grad_enabled():
        return _WeightedSum.apply(weights.contiguous(), image.contiguous(), dilation)
    shifted = _shifted(_pad(image, weights, dilation), weights, dilation)
    return sum(weights[:, tap : tap + 1] * neighbour for tap, neighbour in enumerate(shifted))


def _pad(image: Tensor, weights: Tensor, dilation: int) -> Tensor:
    return F.pad(image, (math.isqrt(weights.shape[1]) // 2 * dilation,) * 4)


def _shifted(padded: Tensor, weights: Tensor, dilation: int) -> Iterator[Tensor]:
    """A window into a padded image for each tap."""
    size = math.isqrt(weights.shape[1])
    height, width = weights.shape[-2:]
    for y in range(0, size * dilation, dilation):
        for x in range(0, size * dilation, dilation):
            yield padded[..., y : y + height, x : x + width]


class _WeightedSum(torch.autograd.Function):
    """The same for training: in place, its gradient too. Saves a third of a step's time."""

    @staticmethod
    def forward(ctx: Any, weights: Tensor, image: Tensor, dilation: int) -> Tensor:
        padded = _pad(image, weights, dilation)
        total = torch.zeros_like(image)
        for tap, neighbour in enumerate(_shifted(padded, weights, dilation)):
            total.addcmul_(neighbour, weights[:, tap : tap + 1])
        ctx.save_for_backward(weights, padded)
        ctx.dilation = dilation
        return total

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        weights, padded = ctx.saved_tensors
        of_weights, of_padded = torch.zeros_like(weights), torch.zeros_like(padded)
        pairs = zip(*(_shifted(image, weights, ctx.dilation) for image in (padded, of_padded)), strict=True)
        for tap, (neighbour, of_neighbour) in enumerate(pairs):
            for channel in range(gradient.shape[1]):
                of_weights[:, tap].addcmul_(gradient[:, channel], neighbour[:, channel])
            of_neighbour.addcmul_(gradient, weights[:, tap : tap + 1])
        reach = (padded.shape[-1] - gradient.shape[-1]) // 2
        inside = slice(reach, reach + gradient.shape[-2]), slice(reach, reach + gradient.shape[-1])
        return of_weights, of_padded[..., *inside], None


def weighted(image: Tensor, weight: Tensor) -> Tensor:
    """An image times its weight, and the weight as its last channel: sums of such can be divided in the end."""
    return torch.cat([image * weight, weight], dim=1)


def divided(image: Tensor) -> Tensor:
    """The image that a sum of :func:`weighted` stands for."""
    return image[:, :-1] / image[:, -1:].clamp_min(1e-12)


def positive(logits: Tensor) -> Tensor:
    """Weights of logits."""
    return torch.exp(logits.float().clamp(-MAX_LOGIT, MAX_LOGIT))


#: An image by level.
Pyramid = dict[int, Tensor]


def pyramid(image: Tensor, first: int, levels: int) -> Pyramid:
    """Means of 2x2 pixels of means of 2x2 pixels ...: the image as level ``first``, up to level ``levels - 1``."""
    images = {first: image}
    for level in range(first + 1, levels):
        images[level] = halve(images[level - 1])
    return images


def level_of(lrhs: Tensor, hrls: Tensor) -> int:
    """log2 of the scale."""
    return (hrls.shape[-1] // lrhs.shape[-1]).bit_length() - 1


def highest_around(lrhs: Tensor, hrls: Tensor) -> Tensor:
    """Per HRLS pixel, the largest value of 10x10 HRLS pixels and of 3x3 LRHS pixels around it, channel by channel."""
    high = F.max_pool2d(F.max_pool2d(hrls, 2), 5, stride=1, padding=2)
    low = F.max_pool2d(lrhs, 3, stride=1, padding=1)
    return double(torch.maximum(high, F.interpolate(low, scale_factor=2 ** (level_of(lrhs, hrls) - 1), mode="nearest")))


class PyramidFusion(nn.Module):
    """See the module's docstring. One set of weights serves every scale, which follows from the images' sizes.

    Sizes must be multiples of ``multiple`` HRLS pixels.

    Args:
        channels: of the U-Net's levels H/2, H/4, H/8, ...
        own_size: taps across of the kernels over a level's own samples, H, H/2, ... ; odd.
    """

    def __init__(
        self, channels: Sequence[int] = (48, 64, 96, 128, 128), own_size: Sequence[int] = (5, 5, 5, 5, 5)
    ) -> None:
        super().__init__()
        self.config = {"channels": list(channels), "own_size": list(own_size)}
        self.own_size = own_size
        self.multiple = 2 ** len(channels)
        finest, *coarser = channels

        # Down: H/2 sees every pixel of the HRLS, the levels below the colours of both renders anew
        self.stem = nn.Conv2d(HRLS_CHANNELS, finest, 6, stride=2, padding=2)
        self.stem_low = conv3x3(LRHS_CHANNELS, finest)
        self.down = nn.ModuleList(nn.Conv2d(above, here, 3, stride=2, padding=1) for above, here in pairwise(channels))
        self.mix = nn.ModuleList(conv3x3(here + 3 + LRHS_CHANNELS, here) for here in coarser)

        # Up
        self.skip = nn.ModuleList(conv3x3(here, here) for here in channels[:-1])
        self.up = nn.ModuleList(conv3x3(below, here) for here, below in pairwise(channels))
        self.refine = nn.ModuleList(conv3x3(here, here) for here in channels[:-1])

        # Kernels of every level of the light; those of level 0 are made at H/2, for four pixels each
        reads = [finest, *channels]
        self.heads = nn.ModuleList(
            nn.Conv2d(reads[level], sum(self.outputs(level)) * (1 if level else 4), 1) for level in range(LEVELS)
        )
        self.retouch = nn.ModuleList([conv3x3(finest + 4 * 3, finest), conv3x3(finest, 4 * 3)])
        self.reset_parameters()

    def outputs(self, level: int) -> list[int]:
        """Channels of a level's head: taps over its own samples, weight of the HRLS's samples, taps over the coarser
        level, weight of the LRHS's samples, taps over the albedo, share of the albedo."""
        own = self.own_size[level] ** 2
        return [own, 1, 9 if level < LEVELS - 1 else 0, 1 if level else 0, 0 if level else 9, 0 if level else 1]

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Every kernel starts close to a plain mean."""
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                nn.init.zeros_(module.bias)
        for head in self.heads:
            head.weight.mul_(0.1)
        self.retouch[-1].weight.zero_()

    def features(self, lrhs: Tensor, hrls: Tensor, colours: Pyramid, lows: Pyramid) -> list[Tensor]:
        """What the U-Net makes of both renders: H/2, H/4, ..., with the channels of each level."""

        def low(level: int) -> Tensor:
            """The LRHS at a level, its pixels repeated where that is finer."""
            first = min(lows)
            if level >= first:
                return logarithmic(lows[level])
            return F.interpolate(lrhs, scale_factor=2 ** (first - level), mode="nearest")

        x = F.relu(self.stem(hrls) + self.stem_low(low(1)))
        encoded = [x]
        for level, (down, mix) in enumerate(zip(self.down, self.mix, strict=True), start=2):
            x = F.relu(mix(torch.cat([F.relu(down(x)), logarithmic(colours[level]), low(level)], dim=1)))
            encoded.append(x)
        decoded = [x]
        for i in reversed(range(len(self.skip))):
            x = F.relu(self.skip[i](encoded[i]) + double(self.up[i](x)))
            x = F.relu(self.refine[i](x))
            decoded.append(x)
        return decoded[::-1]

    def gather(self, hrls: Tensor, colours: Pyramid, lows: Pyramid, features: list[Tensor]) -> Tensor:
        """Make kernels of the features and apply them: the fused image in network values, before its retouch."""
        maps = [F.pixel_shuffle(self.heads[0](features[0]), 2)]
        maps += [self.heads[level](features[level - 1]) for level in range(1, LEVELS)]
        logits = [values.float().split(self.outputs(level), dim=1) for level, values in enumerate(maps)]

        # Albedo, and the part of it that colours the light
        albedo = hrls[:, _ALBEDO]
        *_, albedo_taps, gamma = logits[0]
        filtered = divided(weighted_sum(positive(albedo_taps), weighted(albedo, torch.ones_like(albedo[:, :1]))))
        share = torch.sigmoid(gamma + 2.0)
        tint = (share * filtered + (1 - share)).clamp_min(MIN_ALBEDO)

        tints = pyramid(tint, 0, LEVELS)
        light: Tensor | None = None
        for level in reversed(range(LEVELS)):
            own, importance, coarser, low_importance, *_ = logits[level]
            samples = weighted(colours[level] / tints[level], positive(importance))
            if level in lows:
                samples = samples + weighted(lows[level] / tints[level], positive(low_importance + 1.0))
            total = weighted_sum(positive(own), samples)
            if light is not None:
                around = double(weighted(light, torch.ones_like(light[:, :1])))
                total = total + weighted_sum(positive(coarser), around, dilation=2)
            light = divided(total)
        assert light is not None
        return logarithmic(light * tint)

    def forward(self, lrhs: Tensor, hrls: Tensor) -> Tensor:
        """
        Args:
            lrhs: (N, 3, h, w), network values.
            hrls: (N, 16, s*h, s*w), likewise.

        Returns:
            (N, 3, s*h, s*w) in network values.
        """
        deepest = len(self.mix) + 2
        colours = pyramid(linear(hrls[:, :3]), 0, deepest)
        lows = pyramid(linear(lrhs), level_of(lrhs, hrls), deepest)
        features = self.features(lrhs, hrls, colours, lows)
        fused = self.gather(hrls, colours, lows, features)
        seen = torch.cat([features[0], F.pixel_unshuffle(fused, 2)], dim=1)
        change = self.retouch[1](F.relu(self.retouch[0](seen)))
        change = MAX_RETOUCH * torch.tanh(F.pixel_shuffle(change, 2).float() / MAX_RETOUCH)
        colour = hrls[:, :3]
        return torch.clamp(fused + change, -highest_around(-lrhs, -colour), highest_around(lrhs, colour))
