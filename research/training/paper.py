# SPDX-License-Identifier: Apache-2.0
"""The network of Hou et al. 2021, "Fast Monte Carlo Rendering via Multi-Resolution Sampling", section 4.

Two encoders and one decoder. Deshuffle layers fold the HRLS down to the size of the LRHS. The two are fused, nearly all
work happens at that resolution, and shuffle layers unfold the result.

Decisions where the paper is silent or contradicts itself; they are taken in this file alone:

* *Kernels*: 3x3 everywhere, 1x1 for the fusion, as "Implement details" says; so an RDB's last convolution is 3x3, where
  the RDN it builds on has 1x1. Convolutions pad with zeros.
* *Growth rate* (not given): 32. The three dense convolutions of an RDB add 32 channels each and the fourth goes back
  to 64. The paper's times fit 64 better: they fall by 3.07 from x2 to x4 and by 2.27 from x4 to x8, the
  multiplications with 64 by 3.27 and 2.31, those with 32 by 2.78 and 1.80. With 64 they would be twice as many at
  x2. We keep 32, because the weights that ship have it.
* *Fusion*: the text says ``F_0`` is the concatenation, the figure shows a fusion module and "Implement details" gives
  fusion features 64 channels: concatenation, then a 1x1 convolution to 64.
* *ReLU*: "every convolutional layer is followed by ReLU except for the last". We read "last" as the last of every
  residual block and the last of the network, as RDN does: a residual that passes a ReLU could only ever add.
* *What is added back after the groups*: the text and the figure say ``F_LRHS``, the equation says ``F_0``. We add
  ``F_LRHS``: so the network can start out as a plain upsampling of the LRHS.
* *Deshuffle layer*: 2x2 pixel unshuffle (64 -> 256 channels), then a convolution to 64 with ReLU.
* *Upscale*: log2(s) stages, each a convolution to 256 channels with ReLU, then a 2x2 pixel shuffle (back to 64).
* *Initialisation* (not given): see :meth:`MultiResolutionFusion.reset_parameters`.
* There is no skip from an input image to the output; the paper has none.
"""

from __future__ import annotations

import math
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from oiio_msspl.aovs.features import HRLS_FEATURES, RGB
from oiio_msspl.model.contract import SCALES

#: The LRHS branch reads RGB alone.
LRHS_CHANNELS = HRLS_FEATURES[RGB]
HRLS_CHANNELS = sum(HRLS_FEATURES.values())


def conv3x3(inputs: int, outputs: int) -> nn.Conv2d:
    """Return a 3x3 convolution that keeps the image's size."""
    return nn.Conv2d(inputs, outputs, kernel_size=3, padding=1)


class Deshuffle(nn.Module):
    """``DSF``: (N, C, 2h, 2w) -> (N, C, h, w). The convolution reads all four pixels of each 2x2 square."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = conv3x3(4 * channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        """Fold 2x2 pixels into channels."""
        return F.relu(self.conv(F.pixel_unshuffle(x, 2)))

    @torch.no_grad()
    def reset_to_average(self) -> None:
        """Set the weights so that every channel is the mean of 2x2 pixels of the same channel."""
        for parameter in self.conv.parameters():
            nn.init.zeros_(parameter)
        for channel in range(self.conv.out_channels):
            self.conv.weight[channel, 4 * channel : 4 * channel + 4, 1, 1] = 0.25


class Shuffle(nn.Module):
    """One stage of ``UP``: (N, C, h, w) -> (N, C, 2h, 2w)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = conv3x3(channels, 4 * channels)

    def forward(self, x: Tensor) -> Tensor:
        """Unfold channels into 2x2 pixels."""
        return F.pixel_shuffle(F.relu(self.conv(x)), 2)

    @torch.no_grad()
    def reset_to_bilinear(self, channels: int) -> None:
        """Set the weights so that the first ``channels`` outputs upsample the same inputs (>= 0) bilinearly."""
        # Weights of the previous, same and next pixel for the first and the second half of a pixel
        taps = torch.tensor([[0.25, 0.75, 0.0], [0.0, 0.75, 0.25]])
        for channel in range(channels):
            outputs = slice(4 * channel, 4 * channel + 4)
            self.conv.weight[outputs] = 0.0
            self.conv.weight[outputs, channel] = torch.einsum("ri,cj->rcij", taps, taps).flatten(0, 1)
            cast(Tensor, self.conv.bias)[outputs] = 0.0


class RDB(nn.Module):
    """Residual dense block: every convolution reads the outputs of all convolutions before it."""

    def __init__(self, channels: int, growth: int, dense: int) -> None:
        super().__init__()
        self.dense = nn.ModuleList(conv3x3(channels + i * growth, growth) for i in range(dense))
        self.last = conv3x3(channels + dense * growth, channels)

    def forward(self, x: Tensor) -> Tensor:
        """Add the block's residual to features (N, C, h, w)."""
        features = x
        for conv in self.dense:
            features = torch.cat([features, F.relu(conv(features))], dim=1)
        residual: Tensor = self.last(features)
        return x + residual


class RDG(nn.Module):
    """Residual dense group: ``F_g = RDB_B(... RDB_1(F_{g-1})) + F_{g-1}``."""

    def __init__(self, channels: int, growth: int, dense: int, blocks: int) -> None:
        super().__init__()
        self.blocks = nn.Sequential(*(RDB(channels, growth, dense) for _ in range(blocks)))

    def forward(self, x: Tensor) -> Tensor:
        """Add the group's residual to features (N, C, h, w)."""
        residual: Tensor = self.blocks(x)
        return x + residual


class MultiResolutionFusion(nn.Module):
    """``I_SR`` from ``I_LRHS`` and ``I_HRLS``, both encoded as in :mod:`oiio_msspl.model.encoding`."""

    def __init__(
        self,
        scale: int,  #        s: upsampling factor, a power of two; D = log2(s) deshuffle and shuffle layers
        channels: int = 64,  # of shallow, fusion and dense features
        growth: int = 32,  #  channels that each dense convolution adds within an RDB
        groups: int = 3,  #   G: RDGs
        blocks: int = 5,  #   B: RDBs in an RDG
        dense: int = 3,  #    dense convolutions in an RDB, before its last one: 4 convolutional layers
        lrhs_channels: int = LRHS_CHANNELS,  # more than 3 if the LRHS has AOVs, for ablations
    ) -> None:
        super().__init__()
        if scale not in SCALES:
            raise ValueError(f"scale must be one of {SCALES}, got {scale}")
        self.config = {
            "scale": scale, "channels": channels, "growth": growth, "groups": groups, "blocks": blocks, "dense": dense,
            "lrhs_channels": lrhs_channels,
        }  # fmt: skip
        self.lrhs_channels, self.hrls_channels = lrhs_channels, HRLS_CHANNELS
        self.scale = scale
        self.multiple = scale
        """Height and width of the HRLS must be multiples of this."""
        stages = int(math.log2(scale))
        self.h_lrhs = conv3x3(lrhs_channels, channels)
        self.h_hrls = conv3x3(HRLS_CHANNELS, channels)
        self.deshuffle: Any = nn.Sequential(*(Deshuffle(channels) for _ in range(stages)))
        self.fuse = nn.Conv2d(2 * channels, channels, kernel_size=1)
        self.groups = nn.Sequential(*(RDG(channels, growth, dense, blocks) for _ in range(groups)))
        self.upscale: Any = nn.Sequential(*(Shuffle(channels) for _ in range(stages)))
        self.h_rec = conv3x3(channels, 3)
        self.reset_parameters()

    def forward(self, lrhs: Tensor, hrls: Tensor) -> Tensor:
        """Fuse an LRHS (N, 3, h, w) and an HRLS (N, 16, s*h, s*w) to (N, 3, s*h, s*w)."""
        # Shallow features
        f_lrhs = F.relu(self.h_lrhs(lrhs))
        f_hrls = F.relu(self.h_hrls(hrls))

        # Fold the HRLS to the size of the LRHS and fuse them: F_0
        f_hrls = self.deshuffle(f_hrls)
        f_0 = F.relu(self.fuse(torch.cat([f_lrhs, f_hrls], dim=1)))

        # Dense features: F_DF
        f_df = self.groups(f_0) + f_lrhs

        # Unfold and reconstruct
        result: Tensor = self.h_rec(self.upscale(f_df))
        return result

    def reset_parameters(self) -> None:
        """Start as a bilinear upsampling of the LRHS with small random corrections.

        The LRHS is non-negative, so every ReLU passes its three channels unchanged: ``h_lrhs`` copies them, ``F_LRHS``
        is added behind the groups, each upscale stage interpolates them, ``h_rec`` returns them. All other weights are
        He-initialised. The last convolution of each residual branch is scaled down, because G*B of them are summed.
        """
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                nn.init.zeros_(cast(Tensor, module.bias))
        with torch.no_grad():
            for module in self.modules():
                if isinstance(module, RDB):
                    module.last.weight *= 0.1
            self.fuse.weight *= 0.1  # F_0 is added to F_LRHS, and must not drown the copied channels
            self.h_rec.weight *= 0.1
            for stage in self.upscale:
                stage.reset_to_bilinear(LRHS_CHANNELS)
            self.fuse.weight[:LRHS_CHANNELS] = 0.0
            for conv in (self.h_lrhs, self.h_rec):
                conv.weight[:LRHS_CHANNELS] = 0.0
                for channel in range(LRHS_CHANNELS):
                    conv.weight[channel, channel, 1, 1] = 1.0
