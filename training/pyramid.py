# SPDX-License-Identifier: Apache-2.0
"""The ``pyramid`` network: it predicts kernels instead of colours, and applies them in a pyramid of light.

The paper's network predicts the colour of every pixel. This one predicts which samples of both renders are averaged:

1. A U-Net whose finest level is half the HRLS's resolution reads both renders.
2. Light is separated from texture. Predicted 3x3 kernels filter the HRLS's albedo, and a predicted share ``gamma`` per
   pixel says how much of the colour is proportional to it (none for mirrors, glass, emitters and sky).
3. From coarse to fine, H/16 to H, every level averages its own samples with predicted kernels: the downsampled HRLS,
   from the LRHS's resolution on the LRHS, and the coarser level's result. Each sample also has a predicted weight of
   its own, so that a firefly is left out of all kernels that reach it.
4. Every pixel is clamped to the range of its neighbourhood in both renders.
5. A last convolution predicts the absolute error of each pixel.

The result is a weighted mean of rendered light times a filtered albedo, so it stays within the rendered range for any
input. Kernel-predicting denoisers are Bako et al. 2017 and Vogels et al. 2018. Weights of samples beside weights of
taps resemble the splats of Gharbi et al. 2019.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from training.encoding import log_decode, log_encode
from training.ops import (
    Pyramid,
    divided,
    from_finest,
    from_phases,
    highest_around,
    log2_scale,
    pointwise,
    pointwise_split,
    positive,
    pyramid,
    to_phases,
    upsample,
    weighted,
    weighted_sum,
)
from training.trunk import Trunk

#: Channels of the U-Net at H/2, H/4, ... H/32.
PYRAMID_CHANNELS = (48, 64, 96, 128, 128)
#: Levels of the pyramid of light: H, H/2, ... H/16.
LEVELS = 5
#: Lower bound of the albedo that light is divided by.
MIN_ALBEDO = 0.02
#: Slices of the HRLS's channels.
_COLOUR, _ALBEDO, _COLOUR_AND_ALBEDO = slice(0, 3), slice(3, 6), slice(0, 6)


class PyramidFusion(Trunk):
    """See the module's docstring. One set of weights serves every scale; the image sizes give the scale.

    Sizes must be multiples of ``multiple`` HRLS pixels.

    Args:
        channels: of the U-Net's levels H/2, H/4, H/8, ...
        own_size: size of the kernels over a level's own samples at H, H/2, ...; odd.
    """

    def __init__(self, channels: Sequence[int] = PYRAMID_CHANNELS, own_size: Sequence[int] = (5, 5, 5, 5, 5)) -> None:
        super().__init__(channels)
        self.config = {"channels": list(channels), "own_size": list(own_size)}
        self.own_size = own_size

        # One head per level of light; the head of level 0 reads H/2 and predicts four pixels at a time
        reads = [channels[0], *channels]
        self.heads = nn.ModuleList(
            nn.Conv2d(reads[level], sum(self.outputs(level)) * (1 if level else 4), 1) for level in range(LEVELS)
        )
        self.reset_parameters()

    def outputs(self, level: int) -> list[int]:
        """Sizes of a head's outputs: taps over the level's own samples, weight of the HRLS's samples, taps over the
        coarser level, weight of the LRHS's samples, taps over the albedo, share of the albedo."""
        own, coarser = self.own_size[level] ** 2, 9 if level < LEVELS - 1 else 0
        return [own, 1, coarser, 1, 0, 0] if level else [own, 1, coarser, 0, 9, 1]

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Kernels start close to a box filter."""
        self.reset_convolutions()
        for head in self.heads:
            head.weight.mul_(0.1)

    def gather(self, albedo: Tensor, colours: Pyramid, lows: Pyramid, features: list[Tensor]) -> Tensor:
        """Predict kernels from the features and apply them; return the fused image as log-encoded radiance.

        The HRLS's albedo, the result and level 0 of all pyramids are (N, 3, 4, H/2, W/2), see
        :func:`training.ops.to_phases`.
        """
        logits = []
        for level, head in enumerate(self.heads):
            phases = 1 if level else 4
            sizes = [size * phases for size in self.outputs(level)]
            parts = pointwise_split(head, features[max(level - 1, 0)], sizes)
            logits.append([part.float().unflatten(1, (-1, phases)) for part in parts])

        # Albedo, and the share of it that colours the light
        *_, albedo_taps, gamma = logits[0]
        filtered = divided(weighted_sum(positive(albedo_taps), weighted(albedo, torch.ones_like(albedo[:, :1]))))
        share = torch.sigmoid(gamma + 2.0)
        tint = (share * filtered + (1 - share)).clamp_min(MIN_ALBEDO)
        tints = {0: tint} | pyramid(tint.mean(dim=2), 1, LEVELS)

        def as_light(images: Pyramid, level: int) -> Tensor:
            return images[level] / tints[level] if level == 0 else (images[level] / tints[level]).unsqueeze(2)

        light: Tensor | None = None
        for level in reversed(range(LEVELS)):
            own, importance, coarser, low_importance, *_ = logits[level]
            samples = weighted(as_light(colours, level), positive(importance))
            if level in lows:
                samples = samples + weighted(as_light(lows, level), positive(low_importance + 1.0))
            total = weighted_sum(positive(own), samples)
            if light is not None:
                around = torch.cat([light, torch.ones_like(light[:, :1])], dim=1)
                if level > 0:
                    around = upsample(around.squeeze(2), 2).unsqueeze(2)
                total = total + weighted_sum(positive(coarser), around, dilation=2)
            light = divided(total)
        assert light is not None
        return log_encode(light * tint)

    def forward(self, lrhs: Tensor, hrls: Tensor) -> tuple[Tensor, Tensor]:
        """
        Args:
            lrhs: (N, 3, h, w), log-encoded radiance.
            hrls: (N, 16, s*h, s*w), encoded features in the order of :mod:`oiio_msspl.aovs.features`.

        Returns:
            The fused image (N, 3, s*h, s*w), log-encoded, and the logarithm of its expected absolute error
            (N, 1, s*h, s*w), mean of the channels. The error has no gradient into the features.
        """
        deepest = len(self.mix) + 2
        phases = to_phases(hrls[:, _COLOUR_AND_ALBEDO])
        colours = from_finest(log_decode(phases[:, _COLOUR]), deepest)
        lows = pyramid(log_decode(lrhs), log2_scale(lrhs, hrls), deepest)
        features = self.features(lrhs, hrls, colours, lows)
        fused = self.gather(phases[:, _ALBEDO], colours, lows, features)
        lowest, highest = (
            (sign * highest_around(sign * lrhs, sign * hrls[:, :3])).unsqueeze(2) for sign in (-1.0, 1.0)
        )
        error = pointwise(self.error, features[0].detach()).float().unsqueeze(1)
        return from_phases(torch.clamp(fused, lowest, highest)), from_phases(error)
