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
4. No pixel may be darker or brighter than everything around it in both renders.

5. A last convolution predicts how far each pixel is still off.

So the result is nearly a weighted mean of the light that was rendered, times a filtered albedo, and whatever the input,
it stays within what was rendered. Kernel-predicting denoisers are Bako et al. 2017 and Vogels et al. 2018; weights of
samples beside weights of taps are like the splats of Gharbi et al. 2019.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from oiio_msspl import schema, transforms
from training.paper import conv3x3

#: Channels of its U-Net, H/2, H/4, ... H/32.
PYRAMID_CHANNELS = (48, 64, 96, 128, 128)
#: Levels of the pyramid of light: H, H/2, ... H/16.
LEVELS = 5
#: Smallest reflectance that light is divided by.
MIN_ALBEDO = 0.02
#: Weights are exponentials of the network's outputs within these bounds.
MAX_LOGIT = 12.0

_LOG_SCALE = 1.0 / math.log1p(transforms.MU)
#: Of the HRLS's channels: colour, albedo, and all up to these.
_COLOUR, _ALBEDO, _SEEN = slice(0, 3), slice(3, 6), 6


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


def to_phases(image: Tensor) -> Tensor:
    """(N, C, H, W) to (N, C, 4, H/2, W/2): the pixels of every 2x2 square one behind the other."""
    return F.pixel_unshuffle(image, 2).unflatten(1, (-1, 4))


def from_phases(image: Tensor) -> Tensor:
    """(N, C, 4, H/2, W/2) to (N, C, H, W)."""
    return F.pixel_shuffle(image.flatten(1, 2), 2)


def weighted_sum(weights: Tensor, image: Tensor, dilation: int = 1) -> Tensor:
    """Sum of an image's neighbours with a weight for each tap and pixel.

    Args:
        weights: (N, k * k, P, H, W), taps row by row; P is 1, or 4 for an image of (2H, 2W) by :func:`to_phases`.
        image: (N, C, P, H, W); zero beyond its edges, which leaves them out where one channel carries the weights. Or
            (N, C, 1, H, W) for all four phases of the weights: an image of half the size, every pixel four times.
        dilation: pixels between taps; for P = 1.
    """
    size = math.isqrt(weights.shape[1])
    if weights.shape[2] == 1:
        reach = size // 2 * dilation
        reads = [(tap, 0, 0, reach + y * dilation, reach + x * dilation) for tap, (y, x) in enumerate(_offsets(size))]
    elif image.shape[2] == 1:
        reach = size // 2
        reads = [(tap, ALL, 0, reach + y, reach + x) for tap, (y, x) in enumerate(_offsets(size))]
    else:
        reach = (size // 2 + 1) // 2
        reads = [
            (tap, 2 * v + u, (v + y) % 2 * 2 + (u + x) % 2, reach + (v + y) // 2, reach + (u + x) // 2)
            for v, u in itertools.product(range(2), repeat=2)
            for tap, (y, x) in enumerate(_offsets(size))
        ]
    padded = F.pad(image, (reach,) * 4)
    if torch.is_grad_enabled():
        return _WeightedSum.apply(weights.contiguous(), padded, reads)
    sums: dict[int, Tensor] = {}
    for tap, into, source, y, x in reads:
        # Ends are counted from behind, which makes them constants of the exported graph
        rows, columns = (slice(start, start - 2 * reach or None) for start in (y, x))
        term = weights[:, tap : tap + 1, _phase(into)] * padded[:, :, _phase(source), rows, columns]
        sums[into] = sums[into] + term if into in sums else term
    return torch.cat([sums[into] for into in sorted(sums)], dim=2) if len(sums) > 1 else sums[reads[0][1]]


#: What one product of a weighted sum reads and where it is added: tap, phase it is added to, phase it reads, and the
#: row and the column of the padded image where reading starts.
Read = tuple[int, int, int, int, int]
#: Instead of a phase.
ALL = -1


def _phase(index: int) -> slice:
    return slice(None) if index == ALL else slice(index, index + 1)


def _offsets(size: int) -> list[tuple[int, int]]:
    """Row and column of each tap, from the middle."""
    return list(itertools.product(range(-(size // 2), size // 2 + 1), repeat=2))


class _WeightedSum(torch.autograd.Function):
    """The same for training: in place, its gradient too."""

    @staticmethod
    def forward(ctx: Any, weights: Tensor, padded: Tensor, reads: list[Read]) -> Tensor:
        height, width = weights.shape[-2:]
        total = weights.new_zeros(padded.shape[0], padded.shape[1], *weights.shape[2:])
        for tap, into, source, y, x in reads:
            neighbour = padded[:, :, _phase(source), y : y + height, x : x + width]
            total[:, :, _phase(into)].addcmul_(neighbour, weights[:, tap : tap + 1, _phase(into)])
        ctx.save_for_backward(weights, padded)
        ctx.reads = reads
        return total

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        weights, padded = ctx.saved_tensors
        height, width = weights.shape[-2:]
        of_weights, of_padded = torch.zeros_like(weights), torch.zeros_like(padded)
        for tap, into, source, y, x in ctx.reads:
            area = slice(y, y + height), slice(x, x + width)
            for phase in range(weights.shape[2]) if into == ALL else (into,):
                here = gradient[:, :, phase]
                neighbour = padded[:, :, source, *area]
                for channel in range(gradient.shape[1]):
                    of_weights[:, tap, phase].addcmul_(here[:, channel], neighbour[:, channel])
                of_padded[:, :, source, *area].addcmul_(here, weights[:, tap : tap + 1, phase])
        return of_weights, of_padded, None


class _Exponential(torch.autograd.Function):
    """``exp``, within bounds that its gradient does not see: several times faster than through ``clamp``."""

    @staticmethod
    def forward(ctx: Any, logits: Tensor) -> Tensor:
        values = logits.clamp(-MAX_LOGIT, MAX_LOGIT).exp_()
        ctx.save_for_backward(values)
        return values

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (values,) = ctx.saved_tensors
        return gradient * values


def pointwise(head: nn.Conv2d, features: Tensor) -> Tensor:
    """A 1x1 convolution that leaves its output plane by plane, as sums of planes read it.

    Convolutions leave theirs pixel by pixel, and to sort the many channels of a head would take longer than to make
    them.
    """
    (planes,) = pointwise_split(head, features, [head.out_channels])
    return planes


def pointwise_split(head: nn.Conv2d, features: Tensor, sizes: list[int]) -> list[Tensor]:
    """The same in parts of so many channels. Its weights are split instead of the result, which would be copied."""
    assert head.bias is not None
    flat = features.contiguous().flatten(2)
    images = flat.unbind() if len(flat) > 1 else [flat.flatten(0, 1)]  # which takes no copy
    # A product and a sum in one, which ONNX has for matrices alone
    planes = (
        torch.stack([torch.addmm(bias[:, None], weight, image) for image in images]) if len(weight) else flat[:, :0]
        for weight, bias in zip(head.weight.flatten(1).split(sizes), head.bias.split(sizes), strict=True)
    )
    return [part.unflatten(2, features.shape[2:]) for part in planes]


def weighted(image: Tensor, weight: Tensor) -> Tensor:
    """An image times its weight, and the weight as its last channel: sums of such can be divided in the end."""
    return torch.cat([image * weight, weight], dim=1)


def divided(image: Tensor) -> Tensor:
    """The image that a sum of :func:`weighted` stands for."""
    return image[:, :-1] / image[:, -1:].clamp_min(1e-12)


def positive(logits: Tensor) -> Tensor:
    """Weights of logits."""
    if torch.is_grad_enabled():
        return _Exponential.apply(logits)
    return torch.exp(logits.clamp(-MAX_LOGIT, MAX_LOGIT))


#: An image by level.
Pyramid = dict[int, Tensor]


def pyramid(image: Tensor, first: int, levels: int) -> Pyramid:
    """Means of 2x2 pixels of means of 2x2 pixels ...: the image as level ``first``, up to level ``levels - 1``."""
    images = {first: image}
    for level in range(first + 1, levels):
        images[level] = halve(images[level - 1])
    return images


def from_finest(phases: Tensor, levels: int) -> Pyramid:
    """The same of an image (N, C, 4, H/2, W/2), which stays level 0."""
    return {0: phases} | pyramid(phases.mean(dim=2), 1, levels)


def level_of(lrhs: Tensor, hrls: Tensor) -> int:
    """log2 of the scale."""
    return (hrls.shape[-1] // lrhs.shape[-1]).bit_length() - 1


def highest_around(lrhs: Tensor, hrls: Tensor) -> Tensor:
    """Per 2x2 HRLS pixels, the largest value of 10x10 HRLS pixels and of 3x3 LRHS pixels around, channel by channel."""

    def around(image: Tensor) -> Tensor:
        return F.max_pool2d(image, 3, stride=1, padding=1)

    high = around(around(F.max_pool2d(hrls.contiguous(), 2)))
    low = around(lrhs.contiguous())
    return torch.maximum(high, F.interpolate(low, scale_factor=2 ** (level_of(lrhs, hrls) - 1), mode="nearest"))


class Trunk(nn.Module):
    """The U-Net that sees both renders; what it makes of them is decided by the networks that build on it.

    Sizes must be multiples of ``multiple`` HRLS pixels.

    Args:
        channels: of the levels H/2, H/4, H/8, ...
        denoiser: what another denoiser adds to the inputs' channels, see :func:`oiio_msspl.schema.inputs`.
        stem_size: HRLS pixels across that a pixel of H/2 is first made of; even.
        refined: whether H/2 has a last convolution, as the coarser levels have.
    """

    def __init__(self, channels: Sequence[int], denoiser: str, stem_size: int, refined: bool) -> None:
        super().__init__()
        self.multiple = 2 ** len(channels)
        finest, *coarser = channels

        # Down: H/2 sees every pixel of the HRLS, the levels below the colours of both renders anew
        self.lrhs_channels, self.hrls_channels = (sum(features.values()) for features in schema.inputs(denoiser))
        self.stem = nn.Conv2d(self.hrls_channels, finest, stem_size, stride=2, padding=stem_size // 2 - 1)
        self.stem_low = conv3x3(self.lrhs_channels, finest)
        self.down = nn.ModuleList(nn.Conv2d(above, here, 3, stride=2, padding=1) for above, here in pairwise(channels))
        self.mix = nn.ModuleList(conv3x3(here + 3 + self.lrhs_channels, here) for here in coarser)

        # Up
        self.skip = nn.ModuleList(conv3x3(here, here) for here in channels[:-1])
        self.up = nn.ModuleList(conv3x3(below, here) for here, below in pairwise(channels))
        self.refine = nn.ModuleList(conv3x3(here, here) for here in channels[:-1])
        if not refined:
            self.refine[0] = nn.Identity()
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
        """The predicted error starts alike everywhere. :mod:`training.error` teaches it."""
        self.error.weight.zero_()
        self.error.bias.fill_(math.log(0.05))

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


class PyramidFusion(Trunk):
    """See the module's docstring. One set of weights serves every scale, which follows from the images' sizes.

    Sizes must be multiples of ``multiple`` HRLS pixels.

    Args:
        channels: of the U-Net's levels H/2, H/4, H/8, ...
        own_size: taps across of the kernels over a level's own samples, H, H/2, ... ; odd.
    """

    def __init__(self, channels: Sequence[int] = PYRAMID_CHANNELS, own_size: Sequence[int] = (5, 5, 5, 5, 5)) -> None:
        super().__init__(channels, "", stem_size=6, refined=True)
        self.config = {"channels": list(channels), "own_size": list(own_size)}
        self.own_size = own_size

        # Kernels of every level of the light; those of level 0 are made at H/2, for four pixels each
        reads = [channels[0], *channels]
        self.heads = nn.ModuleList(
            nn.Conv2d(reads[level], sum(self.outputs(level)) * (1 if level else 4), 1) for level in range(LEVELS)
        )
        self.reset_parameters()

    def outputs(self, level: int) -> list[int]:
        """Channels of a level's head: taps over its own samples, weight of the HRLS's samples, taps over the coarser
        level, weight of the LRHS's samples, taps over the albedo, share of the albedo."""
        own, coarser = self.own_size[level] ** 2, 9 if level < LEVELS - 1 else 0
        return [own, 1, coarser, 1, 0, 0] if level else [own, 1, coarser, 0, 9, 1]

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Every kernel starts close to a plain mean."""
        self.reset_convolutions()
        for head in self.heads:
            head.weight.mul_(0.1)

    def gather(self, albedo: Tensor, colours: Pyramid, lows: Pyramid, features: list[Tensor]) -> Tensor:
        """Make kernels of the features and apply them: the fused image in network values.

        Albedo of the HRLS and the result are (N, 3, 4, H/2, W/2); so is level 0 of all.
        """
        logits = []
        for level, head in enumerate(self.heads):
            phases = 1 if level else 4
            sizes = [size * phases for size in self.outputs(level)]
            parts = pointwise_split(head, features[max(level - 1, 0)], sizes)
            logits.append([part.float().unflatten(1, (-1, phases)) for part in parts])

        # Albedo, and the part of it that colours the light
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
                    around = double(around.squeeze(2)).unsqueeze(2)
                total = total + weighted_sum(positive(coarser), around, dilation=2)
            light = divided(total)
        assert light is not None
        return logarithmic(light * tint)

    def forward(self, lrhs: Tensor, hrls: Tensor) -> tuple[Tensor, Tensor]:
        """
        Args:
            lrhs: (N, 3, h, w), network values.
            hrls: (N, 16, s*h, s*w).

        Returns:
            The fused image (N, 3, s*h, s*w) in network values, and the logarithm of its expected absolute error
            (N, 1, s*h, s*w), mean of the channels, in network values too. Nothing else learns from the latter.
        """
        deepest = len(self.mix) + 2
        phases = to_phases(hrls[:, :_SEEN])
        colours = from_finest(linear(phases[:, _COLOUR]), deepest)
        lows = pyramid(linear(lrhs), level_of(lrhs, hrls), deepest)
        features = self.features(lrhs, hrls, colours, lows)
        fused = self.gather(phases[:, _ALBEDO], colours, lows, features)
        lowest, highest = (
            (sign * highest_around(sign * lrhs, sign * hrls[:, :3])).unsqueeze(2) for sign in (-1.0, 1.0)
        )
        error = pointwise(self.error, features[0].detach()).float().unsqueeze(1)
        return from_phases(torch.clamp(fused, lowest, highest)), from_phases(error)
