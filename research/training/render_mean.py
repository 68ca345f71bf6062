# SPDX-License-Identifier: Apache-2.0
"""The weighted mean of both renders at the LRHS's resolution, which `joint` denoises first.

The LRHS and the HRLS are independent samples of one scene. At the LRHS's resolution, the mean of the LRHS and of the
box-averaged HRLS therefore has less noise than either, and the box-averaged albedo and normal of the HRLS have hardly
any. :mod:`oiio_msspl.model.render_mean` finds the weights.
"""

from __future__ import annotations

import torch
from torch import Tensor

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.model.render_mean import lrhs_share
from research.training.encoding import log_decode, log_encode
from research.training.ops import box_downsample, log2_scale

#: Factor that brings the estimated noise into [0, 1].
NOISE_GAIN = 2.0

Images = dict[str, Tensor]


def mean_of_renders(lrhs: Images, hrls: Images, shares: Images) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Average both renders.

    Args:
        lrhs: ``rgb`` (N, 3, h, w), exposed radiance in [0, MAX_RADIANCE]; ``albedo`` and ``normal``, encoded, if they
            are averaged, too.
        hrls: all three features at s times the size.
        shares: of each feature of the LRHS, its weight in the mean, in [0, 1]: a number, or one for each pair.

    Returns:
        The colour (N, 3, h, w), log-encoded. Its noise (N, 1, h, w): the estimated standard deviation times
        ``NOISE_GAIN``, at most 1. The albedo (N, 3, h, w) in [0, 1] and the normal in [-1, 1].
    """
    scale = hrls[RGB].shape[-1] // lrhs[RGB].shape[-1]
    means = {name: box_downsample(hrls[name], scale) for name in (RGB, NORMAL)}
    means[ALBEDO] = box_downsample(hrls[ALBEDO].clamp(0.0, 1.0), scale)
    share = shares[RGB]
    colour = log_encode(means[RGB] + share * (lrhs[RGB] - means[RGB]))
    difference = (log_encode(lrhs[RGB]) - log_encode(means[RGB])).abs().mean(dim=1, keepdim=True)
    # Scale |LRHS - HRLS| to the standard deviation of the weighted mean.
    noise = (NOISE_GAIN * torch.sqrt(share * (1 - share)) * difference).clamp_max(1.0)
    for name, low in ((ALBEDO, 0.0), (NORMAL, -1.0)):
        if name in lrhs:
            means[name] = means[name] + shares[name] * (lrhs[name].clamp(low, 1.0) - means[name])
    return colour, noise, means[ALBEDO], means[NORMAL]


def with_mean(lrhs: Tensor, hrls: Tensor) -> Tensor:
    """Append the mean of both renders and its noise to an encoded LRHS: (1, 3, h, w) to (1, 7, h, w).

    The HRLS is (1, 9 or more, s*h, s*w).
    """
    features = {RGB: log_decode(hrls[:, :3]), ALBEDO: hrls[:, 3:6], NORMAL: hrls[:, 6:9]}
    means = log_encode(box_downsample(features[RGB], 2 ** log2_scale(lrhs, hrls)))
    low, high = (image[0].permute(1, 2, 0).cpu().numpy() for image in (lrhs, means))
    share = torch.tensor(lrhs_share(low, high), device=lrhs.device)
    colour, noise, *_ = mean_of_renders({RGB: log_decode(lrhs)}, features, {RGB: share})
    return torch.cat([lrhs, colour, noise], dim=1)
