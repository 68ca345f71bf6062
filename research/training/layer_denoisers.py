# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise's base networks for albedo and normal, as they are."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from research.training.encoding import from_srgb, srgb
from research.training.oidn import (
    ALBEDO_BASE,
    BASE,
    NORMAL_BASE,
    FineTunedUNet,
    Shape,
    Start,
    convolutions,
    pretrained_weights,
)


def untouched(network: str, shape: Shape) -> Start:
    """A network as it is in OIDN."""
    return Start(network, shape, (), 0, tuple(convolutions(pretrained_weights(network))))


class LayerDenoisers(nn.Module):
    """OIDN's networks for albedo and normal."""

    def __init__(self) -> None:
        super().__init__()
        self.albedo, self.normal = (FineTunedUNet(untouched(name, BASE)) for name in (ALBEDO_BASE, NORMAL_BASE))

    def forward(self, albedo: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
        """
        Args:
            albedo: (N, 3, H, W) in [0, 1].
            normal: (N, 3, H, W) in [-1, 1].

        Returns:
            Both denoised, in [0, 1].
        """
        return from_srgb(self.albedo.run(srgb(albedo)).clamp(0, 1)), self.normal.run(0.5 * normal + 0.5).clamp(0, 1)

    def applied(self, hrls: Tensor) -> Tensor:
        """An encoded HRLS (N, 9 or more, H, W) with denoised albedo and normal, (N, 9, H, W)."""
        albedo, normal = self(hrls[:, 3:6], hrls[:, 6:9])
        return torch.cat([hrls[:, :3], albedo, 2 * normal - 1], dim=1)
