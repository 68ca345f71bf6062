# SPDX-License-Identifier: Apache-2.0
"""Operations that several networks share: resampling, and the brightest samples around a pixel."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F


def box_downsample(image: Tensor, factor: int) -> Tensor:
    """Average factor x factor pixels: (N, C, H, W) to (N, C, H / factor, W / factor)."""
    return F.avg_pool2d(image, factor)


def upsample(image: Tensor, factor: int, mode: str = "nearest") -> Tensor:
    """Resize (N, C, H, W) to (N, C, factor * H, factor * W); ``mode`` is nearest or bilinear."""
    return F.interpolate(image, scale_factor=factor, mode=mode)


def log2_scale(lrhs: Tensor, hrls: Tensor) -> int:
    """Return log2 of the upsampling factor: the pyramid level that has the LRHS's resolution."""
    return (hrls.shape[-1] // lrhs.shape[-1]).bit_length() - 1


def pyramid(image: Tensor, levels: int) -> list[Tensor]:
    """Return a box-filtered pyramid: the image at full resolution, a half, a quarter, ..."""
    images = [image]
    for _ in range(levels - 1):
        images.append(box_downsample(images[-1], 2))
    return images


def highest_around(lrhs: Tensor, hrls: Tensor) -> Tensor:
    """Return the maximum of 10x10 HRLS pixels and of 3x3 LRHS pixels around each 2x2 HRLS pixels, per channel.

    Args:
        lrhs: (N, 3, h, w).
        hrls: (N, 3, s*h, s*w).

    Returns:
        (N, 3, s*h/2, s*w/2)
    """

    def around(image: Tensor) -> Tensor:
        return F.max_pool2d(image, 3, stride=1, padding=1)

    high = around(around(F.max_pool2d(hrls.contiguous(), 2)))
    low = around(lrhs.contiguous())
    return torch.maximum(high, upsample(low, 2 ** (log2_scale(lrhs, hrls) - 1)))
