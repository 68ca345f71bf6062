# SPDX-License-Identifier: Apache-2.0
"""Images as codes of 8 bits, which quantised networks read and return.

Colours have a range of 2^30, which 8 bits cannot hold. So the PU-encoded range is cut into equal slices, and each slice
has a channel that says how much of it is filled, from 0 to 255. The sum over the slices is the value.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor
from torch.nn import functional as F

from oiio_msspl.image.arrays import Array
from oiio_msspl.model.encoding import encode_radiance
from research.training.encoding import log_to_pu, pu_decode

#: Slices of a colour channel at the input and at the output of the denoiser of both renders' mean.
INPUT_SLICES, OUTPUT_SLICES = 3, 10
#: Its input channels: three colours in slices, albedo, normal and noise.
INPUT_CHANNELS = 3 * INPUT_SLICES + 7


def sliced(values: Tensor, count: int) -> Tensor:
    """Quantise values (N, C, H, W) in [0, 1] to codes of slices, (N, count * C, H, W)."""
    slices = [(values * count - i).clamp(0, 1) for i in range(count)]
    return torch.cat(slices, dim=1).mul(255).round()


def denoiser_codes(colour: Tensor, noise: Tensor, albedo: Tensor, normal: Tensor) -> Tensor:
    """Quantise the images of :func:`research.training.render_mean.mean_of_renders` to (N, INPUT_CHANNELS, h, w).

    The slices of each colour lie side by side.
    """
    slices = sliced(log_to_pu(colour), INPUT_SLICES).unflatten(1, (INPUT_SLICES, 3)).transpose(1, 2).flatten(1, 2)
    rest = torch.cat([albedo, 0.5 * normal + 0.5, noise], dim=1)
    return torch.cat([slices, rest.mul(255).round().clamp(0, 255)], dim=1)


def full_size_codes(colour: Tensor, albedo: Tensor, normal: Tensor) -> Tensor:
    """Quantise what the denoiser of one render reads, (N, 3, H, W) each, to (N, K, H, W).

    A dark albedo is a few steps of 255, so it has slices, too. Zeros fill K up to a multiple of four.

    Args:
        colour: log-encoded.
        albedo, normal: in [0, 1].
    """
    slices = [sliced(image, INPUT_SLICES) for image in (log_to_pu(colour), albedo)]
    codes = torch.cat([*slices, normal.mul(255).round()], dim=1)
    return F.pad(codes, (0, 0, 0, 0, 0, -codes.shape[1] % 4))


@functools.cache
def log_encoded_of_code(slices: int) -> Array:
    """Return the log-encoded colour for each sum of the codes of all slices: (255 * slices + 1,)."""
    sums = torch.linspace(0, 1, 255 * slices + 1, dtype=torch.double)
    return encode_radiance(pu_decode(sums).float().numpy(), 1.0)
