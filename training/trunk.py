# SPDX-License-Identifier: Apache-2.0
"""The U-Net of the kernel-predicting network."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from oiio_msspl.model.contract import NO_DENOISER, network_inputs
from training.encoding import log_encode
from training.ops import Pyramid, conv3x3, upsample

#: Kernel size of the first convolution over the HRLS.
STEM_SIZE = 6


class Trunk(nn.Module):
    """U-Net that reads both renders and returns features from H/2 down. The subclass adds heads.

    Sizes must be multiples of ``multiple`` HRLS pixels.

    Args:
        channels: of the levels H/2, H/4, H/8, ...
    """

    def __init__(self, channels: Sequence[int]) -> None:
        super().__init__()
        self.multiple = 2 ** len(channels)
        finest, *coarser = channels

        # Down: H/2 reads every pixel of the HRLS; each coarser level also reads the downsampled colours of both renders
        self.lrhs_channels, self.hrls_channels = (sum(features.values()) for features in network_inputs(NO_DENOISER))
        self.stem = nn.Conv2d(self.hrls_channels, finest, STEM_SIZE, stride=2, padding=STEM_SIZE // 2 - 1)
        self.stem_low = conv3x3(self.lrhs_channels, finest)
        self.down = nn.ModuleList(nn.Conv2d(above, here, 3, stride=2, padding=1) for above, here in pairwise(channels))
        self.mix = nn.ModuleList(conv3x3(here + 3 + self.lrhs_channels, here) for here in coarser)

        # Up
        self.skip = nn.ModuleList(conv3x3(here, here) for here in channels[:-1])
        self.up = nn.ModuleList(conv3x3(below, here) for here, below in pairwise(channels))
        self.refine = nn.ModuleList(conv3x3(here, here) for here in channels[:-1])
        self.error = nn.Conv2d(finest, 4, 1)

    @torch.no_grad()
    def reset_convolutions(self) -> None:
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                nn.init.zeros_(module.bias)
        self.reset_error()

    @torch.no_grad()
    def reset_error(self) -> None:
        """Predict the same error everywhere. :mod:`training.error` trains the prediction."""
        self.error.weight.zero_()
        self.error.bias.fill_(math.log(0.05))

    def features(self, lrhs: Tensor, hrls: Tensor, colours: Pyramid, lows: Pyramid) -> list[Tensor]:
        """Features at H/2, H/4, ...

        Args:
            lrhs, hrls: the network's inputs.
            colours: pyramid of the HRLS's colour, linear.
            lows: pyramid of the LRHS's channels, linear, from the LRHS's own level on.
        """

        def low(level: int) -> Tensor:
            """The LRHS at a level; its pixels are repeated at finer levels."""
            first = min(lows)
            if level >= first:
                return log_encode(lows[level])
            return upsample(lrhs, 2 ** (first - level))

        x = F.relu(self.stem(hrls) + self.stem_low(low(1)))
        encoded = [x]
        for level, (down, mix) in enumerate(zip(self.down, self.mix, strict=True), start=2):
            x = F.relu(mix(torch.cat([F.relu(down(x)), log_encode(colours[level]), low(level)], dim=1)))
            encoded.append(x)
        decoded = [x]
        for i in reversed(range(len(self.skip))):
            x = F.relu(self.skip[i](encoded[i]) + upsample(self.up[i](x), 2))
            x = F.relu(self.refine[i](x))
            decoded.append(x)
        return decoded[::-1]
