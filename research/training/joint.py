# SPDX-License-Identifier: Apache-2.0
"""The ``joint`` network: a network of Open Image Denoise for HDR colour, fine-tuned to read both renders.

It has three sizes. ``usual`` starts from the base network, and denoises the mean of both renders by a fine-tuned large
one. ``small`` starts from small networks for both. ``large`` starts from the large network for the HRLS, too. It reads
albedo and normal that are denoised before, as Open Image Denoise's documentation recommends.

1. Encode. At H the U-Net reads the HRLS's colour, albedo and normal, as in Open Image Denoise (OIDN). At H/2 it also
   reads the LRHS and the denoised mean of both renders at the LRHS's resolution (:mod:`research.training.denoisers`).
   Their weights start at zero, so that training starts from OIDN. All weights are trained. The parameters are
   differences from OIDN's weights, so weight decay pulls towards OIDN.
2. The U-Net, :data:`research.training.oidn.BASE` or :data:`research.training.oidn.LARGE`, returns the denoised HRLS.
3. Heads predict logits for every level of the result from the features that denoise.
4. Blend. At the LRHS's resolution, the logits choose between the denoised mean of both renders, the downsampled
   denoised HRLS, the downsampled HRLS and the LRHS. At every finer level, up to the HRLS's, they choose between the
   denoised HRLS scaled to the coarser level's brightness, the denoised HRLS, the coarser level's light times the HRLS's
   albedo, and the HRLS. Every pixel is clamped to the range of its neighbourhood in both renders.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from oiio_msspl.aovs.features import ALBEDO, HRLS_FEATURES, NORMAL, RGB
from oiio_msspl.model.contract import MEAN_DENOISER, SMALL_MEAN_DENOISER, SPREAD
from research.training import oidn
from research.training.denoisers import LayerDenoisers, MeanDenoiser, denoise_mean
from research.training.encoding import LOG_SCALE, log_decode, log_encode, log_to_pu, pu_to_log
from research.training.ops import highest_around, log2_scale, pyramid, upsample
from research.training.paper import LRHS_CHANNELS

#: Features of the HRLS that the network reads.
FEATURES = (RGB, ALBEDO, NORMAL)
HRLS_CHANNELS = sum(HRLS_FEATURES[name] for name in FEATURES)
#: By size: the network of Open Image Denoise from which the U-Net starts, and its shape.
SIZES = {
    "small": (oidn.SMALL_HDR, oidn.BASE),
    "usual": (oidn.BASE_HDR, oidn.BASE),
    "large": (oidn.LARGE_HDR, oidn.LARGE),
}
#: Initial logits at the LRHS's resolution: the denoised mean of both renders, the denoised HRLS, the HRLS, the LRHS.
COARSEST = (2.0, 0.0, -2.0, -2.0)
#: Initial logits at finer levels: the denoised HRLS at the coarser level's brightness, the denoised HRLS, light times
#: albedo, the HRLS.
FINER = (2.0, 0.0, 0.0, -2.0)
#: Lower bound of the albedo that light is divided by.
MIN_ALBEDO = 0.02
#: LRHS pixels over which the renders' brightest samples allow a bright result.
FAR = 16
#: By size: how far beyond the denoised mean a result may be where no sample is as bright, log-encoded. The size
#: ``large`` does not denoise that mean itself, and is often brighter where light is rare. Clamped to the mean, its
#: results would have dark patches between those samples that allow more. So they may be a quarter brighter.
MARGIN = {"small": 0.0, "usual": 0.0, "large": math.log(1.25) * LOG_SCALE}
#: Bounds of the ratio of a level's light to the denoised HRLS: 1 / MAX_RATIO and MAX_RATIO.
MAX_RATIO = 8.0
#: Added to both sides of that ratio, in exposed radiance, so that black pixels give a ratio of 1.
RATIO_FLOOR = 1e-3
#: Extra input channels at H/2, the denoised mean and the LRHS, and the convolutions that may read them.
EXTRA = 6
READERS = ("enc_conv2", "enc_conv2a", "dec_conv2a")
#: Of each level that has logits, H, H/2, H/4, H/8: the last convolution, and the number of logits.
DECODED = ("dec_conv1b", "dec_conv2b", "dec_conv3b", "dec_conv4b")
OUTPUTS = (len(FINER) + 1, *[len(FINER) + len(COARSEST)] * 3)
#: On the way up: the convolution whose outputs are the first inputs of a convolution.
PREDECESSOR = {
    name: before for before, name in itertools.pairwise([*(n for level in oidn.BASE.up for n in level), oidn.BASE.last])
}


class JointFusion(nn.Module):
    """The ``joint`` network. One set of weights serves every scale; the image sizes give the scale.

    Sizes must be multiples of ``multiple`` HRLS pixels.

    Args:
        kept: output channels that pruning has kept, by convolution; all channels of the others.
        size: a key of ``SIZES``.
        spread: it has learnt from pixel filters that spread each sample, too, and has a denoiser of its own.
    """

    multiple = 16

    def __init__(
        self, kept: Mapping[str, Sequence[int]] | None = None, size: str = "usual", *, spread: bool = False
    ) -> None:
        super().__init__()
        self.kept, self.size, self.spread = dict(kept or {}), size, spread
        self.config: dict[str, Any] = {"kept": self.kept, "size": size, "spread": spread}
        self.lrhs_channels, self.hrls_channels = 2 * LRHS_CHANNELS, HRLS_CHANNELS
        network, self.shape = SIZES[size]
        self.pretrained = oidn.pretrained_weights(network)
        # The large size reads the mean that the usual one has denoised
        self.mean_denoiser = None if size == "large" else MeanDenoiser(size)
        self.layers = LayerDenoisers() if size == "large" else None
        convs: dict[str, oidn.FineTunedConv] = {}
        for name in oidn.convolutions(self.pretrained):
            rows, columns = self.pretrained_channels(name)
            weight, bias = self.pretrained[f"{name}.weight"][rows][:, columns], self.pretrained[f"{name}.bias"][rows]
            convs[name] = oidn.FineTunedConv(weight, bias, EXTRA if name in READERS else 0)
        channels = [len(convs[name].pretrained_bias) for name in DECODED]
        heads = [nn.Conv2d(*sizes, 3, padding=1) for sizes in zip(channels, OUTPUTS, strict=True)]
        self.convs: Any = nn.ModuleDict(convs)
        self.heads: Any = nn.ModuleList(heads)
        self.error: Any = nn.Conv2d(channels[1], 4, 3, padding=1)
        with torch.no_grad():
            for level, head in enumerate(heads):
                nn.init.kaiming_normal_(head.weight)
                head.weight.mul_(0.1)
                cast(Tensor, head.bias).copy_(torch.tensor(FINER + COARSEST if level else (*FINER, 2.0)))
        self.reset_error()

    def denoiser(self, scale: int) -> str:
        """Return the value of ``Contract.denoiser``.

        At x4 and x8 the LRHS is so small that the large denoiser takes hardly longer than the small one, and is better.
        """
        kind = SMALL_MEAN_DENOISER if self.size == "small" and scale == 2 else MEAN_DENOISER
        return kind + SPREAD if self.spread else kind

    def pretrained_channels(self, name: str) -> tuple[list[int], list[int]]:
        """Return the indices of the outputs and inputs of a pretrained convolution that this network has."""
        count, inputs = self.pretrained[f"{name}.weight"].shape[:2]
        rows, columns = list(self.kept.get(name, range(count))), list(range(inputs))
        if before := PREDECESSOR.get(name):
            everything = len(self.pretrained[f"{before}.bias"])
            columns = [*self.kept.get(before, range(everything)), *columns[everything:]]
        return rows, columns

    def differences(self) -> list[nn.Parameter]:
        """Return the parameters that are added to pretrained ones."""
        return [p for name, p in self.named_parameters() if "convs." in name and not name.endswith(".extra")]

    def initial_state(self) -> dict[str, Tensor]:
        """Return the state of a new network without its random weights, and without the head of the expected error."""
        return {
            name: value.clone() if name.startswith("heads") and name.endswith("bias") else torch.zeros_like(value)
            for name, value in self.state_dict().items()
            if not name.startswith("error")
        }

    @torch.no_grad()
    def reset_error(self) -> None:
        """Predict the same error everywhere. :mod:`research.training.error` trains the prediction."""
        self.error.weight.zero_()
        self.error.bias.fill_(math.log(0.05))

    def forward(self, lrhs: Tensor, hrls: Tensor) -> tuple[Tensor, Tensor]:
        """Fuse as :meth:`fuse`, after denoising the mean of both renders.

        Args:
            lrhs: (N, 7, h, w), see :func:`research.training.denoisers.denoise_mean`. The size ``large`` has the
                arguments of :meth:`fuse_prepared`.
            hrls: (N, 9 or more, s*h, s*w): the HRLS's encoded colour, albedo and normal.
        """
        if self.mean_denoiser is None:
            return self.fuse_prepared(lrhs, hrls)
        return self.fuse(denoise_mean(self.mean_denoiser, lrhs, hrls), hrls)

    def fuse(self, lrhs: Tensor, hrls: Tensor) -> tuple[Tensor, Tensor]:
        """Fuse both renders.

        Args:
            lrhs: (N, 6, h, w), log-encoded: the LRHS and the denoised mean of both renders.
            hrls: (N, 9 or more, s*h, s*w): the HRLS's encoded colour, albedo and normal.

        Returns:
            The fused image (N, 3, s*h, s*w), log-encoded, and the logarithm of its expected absolute error
            (N, 1, s*h, s*w), mean of the channels. The error has no gradient into the features.
        """
        return self.fuse_prepared(lrhs, self.prepared(hrls))

    def prepared(self, hrls: Tensor) -> Tensor:
        """Return the HRLS (N, 9 or more, H, W) as the U-Net reads it: ``large`` denoises albedo and normal first."""
        return hrls if self.layers is None else self.layers.applied(hrls)

    def fuse_prepared(self, lrhs: Tensor, hrls: Tensor) -> tuple[Tensor, Tensor]:
        """Fuse as :meth:`fuse`, with an HRLS of :meth:`prepared`."""
        samples, albedo, normal = hrls[:, :3], hrls[:, 3:6], hrls[:, 6:9]
        full = torch.cat([log_to_pu(samples), albedo.clamp(0, 1), 0.5 * normal + 0.5], dim=1)
        half = log_to_pu(torch.cat([lrhs[:, LRHS_CHANNELS:], lrhs[:, :LRHS_CHANNELS]], dim=1))
        half = upsample(half, 2 ** (log2_scale(lrhs, hrls) - 1))
        features: dict[str, Tensor] = {}

        def conv(name: str, values: Tensor) -> Tensor:
            features[name] = F.relu(self.convs[name](values))
            return features[name]

        inputs = [image.to(next(self.convs.parameters()).dtype) for image in (full, half)]
        colour = oidn.run_unet_on_tensors(self.shape, inputs, conv)
        logits = [head(features[name]).float() for head, name in zip(self.heads, DECODED, strict=True)]
        log_error = F.pixel_shuffle(self.error(features[DECODED[1]].detach()).float(), 2)
        denoised = pu_to_log(colour.float().clamp_max(1.0))
        return blend(lrhs, samples, albedo, denoised, logits, MARGIN[self.size]), log_error


def mixed(logits: Tensor, images: Sequence[Tensor]) -> Tensor:
    """Average images, weighted by the softmax of the logits (N, len(images), H, W)."""
    # Plane by plane: ONNX Runtime's softmax over any axis but the last takes several times as long
    planes = [logits[:, i : i + 1] for i in range(len(images))]
    highest = functools.reduce(torch.maximum, planes).detach()
    weights = [torch.exp(plane - highest) for plane in planes]
    rest = 1 / functools.reduce(torch.add, weights)
    return functools.reduce(torch.add, (rest * weight * image for weight, image in zip(weights, images, strict=True)))


def blend(
    lrhs: Tensor, samples: Tensor, albedo: Tensor, denoised: Tensor, logits: Sequence[Tensor], margin: float = 0.0
) -> Tensor:
    """Blend the candidates with the softmax of the logits.

    Args:
        lrhs: (N, 6, h, w): the LRHS and the denoised mean of both renders, log-encoded.
        samples, albedo: (N, 3, s*h, s*w): the HRLS's colour, log-encoded, and its albedo.
        denoised: (N, 3, s*h, s*w), the denoised HRLS, log-encoded.
        logits: of the levels H, H/2, ..., (N, 8, H/2^i, W/2^i): the first four choose between the candidates of a fine
            level, the others between those of the LRHS's level. At H, the fifth is the share of the albedo.
        margin: see `MARGIN`.

    Returns:
        The fused image (N, 3, s*h, s*w), log-encoded.
    """
    first = log2_scale(lrhs, samples)
    means, filtered = pyramid(log_decode(samples), first + 1), pyramid(log_decode(denoised), first + 1)
    share = torch.sigmoid(logits[0][:, len(FINER) :])
    tints = pyramid((share * albedo + (1 - share)).clamp_min(MIN_ALBEDO), first + 1)
    fused = mixed(logits[first][:, len(FINER) :], [
        lrhs[:, LRHS_CHANNELS:], log_encode(filtered[first]), log_encode(means[first]), lrhs[:, :LRHS_CHANNELS],
    ])  # fmt: skip
    for level in reversed(range(first)):
        radiance, below = log_decode(fused), filtered[level + 1]
        light = upsample(radiance / tints[level + 1], 2, "bilinear")
        ratio = ((radiance + RATIO_FLOOR) / (below + RATIO_FLOOR)).clamp(1 / MAX_RATIO, MAX_RATIO)
        candidates = [
            log_encode(filtered[level] * upsample(ratio, 2, "bilinear")),
            log_encode(filtered[level]) if level else denoised,
            log_encode(light * tints[level]),
            log_encode(means[level]) if level else samples,
        ]
        fused = mixed(logits[level], candidates)
    low, mean = lrhs.split(LRHS_CHANNELS, dim=1)
    lowest, highest = (
        upsample(sign * highest_allowed(sign * low, sign * mean + margin, sign * samples), 2) for sign in (-1.0, 1.0)
    )
    return torch.clamp(fused, lowest, highest)


def highest_allowed(lrhs: Tensor, mean: Tensor, samples: Tensor) -> Tensor:
    """Return the largest value that each 2x2 HRLS pixels may have.

    It is the highest sample of either render close around. Where light is rare, all of these may be too dark. So the
    denoised mean of both renders counts, too, up to the brightest sample within ``FAR`` LRHS pixels.

    Args:
        lrhs, mean: (N, 3, h, w), the LRHS and the denoised mean of both renders, with the margin added.
        samples: (N, 3, s*h, s*w), the HRLS.

    Returns:
        (N, 3, s*h/2, s*w/2)
    """
    scale = 2 ** log2_scale(lrhs, samples)
    brightest = torch.maximum(lrhs, F.max_pool2d(samples.contiguous(), scale))
    for _ in range(FAR // 4):
        brightest = F.max_pool2d(brightest, 9, stride=1, padding=4)
    expected = F.max_pool2d(torch.minimum(mean, brightest), 3, stride=1, padding=1)
    return torch.maximum(highest_around(lrhs, samples), upsample(expected, scale // 2))
