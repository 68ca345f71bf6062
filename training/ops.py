# SPDX-License-Identifier: Apache-2.0
"""Operations that several networks share: resampling, image pyramids, predicted kernels, heads."""

from __future__ import annotations

import itertools
import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

#: Logits are clamped to these bounds before they become weights.
MAX_LOGIT = 12.0


def conv3x3(inputs: int, outputs: int) -> nn.Conv2d:
    """3x3 convolution that keeps the image's size."""
    return nn.Conv2d(inputs, outputs, kernel_size=3, padding=1)


# Resampling


def box_downsample(image: Tensor, factor: int) -> Tensor:
    """Mean of factor x factor pixels: (N, C, H, W) to (N, C, H / factor, W / factor)."""
    return F.avg_pool2d(image, factor)


def upsample(image: Tensor, factor: int, mode: str = "nearest") -> Tensor:
    """(N, C, H, W) to (N, C, factor * H, factor * W); ``mode`` is nearest, bilinear or bicubic."""
    return F.interpolate(image, scale_factor=factor, mode=mode)


def log2_scale(lrhs: Tensor, hrls: Tensor) -> int:
    """log2 of the upsampling factor: the pyramid level that has the LRHS's resolution."""
    return (hrls.shape[-1] // lrhs.shape[-1]).bit_length() - 1


#: An image by level: level 0 has the HRLS's resolution, each further level half of it.
Pyramid = dict[int, Tensor]


def pyramid(image: Tensor, first: int, levels: int) -> Pyramid:
    """Box-filtered pyramid: the image is level ``first``, the coarsest level is ``levels - 1``."""
    images = {first: image}
    for level in range(first + 1, levels):
        images[level] = box_downsample(images[level - 1], 2)
    return images


def from_finest(phases: Tensor, levels: int) -> Pyramid:
    """The same for an image (N, C, 4, H/2, W/2) in phases, which becomes level 0 as it is."""
    return {0: phases} | pyramid(phases.mean(dim=2), 1, levels)


def to_phases(image: Tensor) -> Tensor:
    """(N, C, H, W) to (N, C, 4, H/2, W/2): the four pixels of each 2x2 square (its phases) side by side."""
    return F.pixel_unshuffle(image, 2).unflatten(1, (-1, 4))


def from_phases(image: Tensor) -> Tensor:
    """Inverse of :func:`to_phases`."""
    return F.pixel_shuffle(image.flatten(1, 2), 2)


# Predicted kernels


def weighted_sum(weights: Tensor, image: Tensor, dilation: int = 1) -> Tensor:
    """Filter an image with a kernel per pixel: a weighted sum of each pixel's neighbours.

    Args:
        weights: (N, k * k, P, H, W), taps row by row; P is 1, or 4 for an image of (2H, 2W) by :func:`to_phases`.
        image: (N, C, P, H, W), padded with zeros, so that pixels beyond the edges have no weight if one channel carries
            the weights (:func:`weighted`). Or (N, C, 1, H, W) for weights of four phases: an image of half the size,
            read as if every pixel were repeated four times.
        dilation: distance between taps in pixels; for P = 1.
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
        # Negative ends become constants of the exported graph
        rows, columns = (slice(start, start - 2 * reach or None) for start in (y, x))
        term = weights[:, tap : tap + 1, _phase(into)] * padded[:, :, _phase(source), rows, columns]
        sums[into] = sums[into] + term if into in sums else term
    return torch.cat([sums[into] for into in sorted(sums)], dim=2) if len(sums) > 1 else sums[reads[0][1]]


#: One product of a weighted sum: tap, phase that it is added to, phase that it reads, and the first row and column that
#: it reads of the padded image.
Read = tuple[int, int, int, int, int]
#: All phases at once.
ALL = -1


def _phase(index: int) -> slice:
    return slice(None) if index == ALL else slice(index, index + 1)


def _offsets(size: int) -> list[tuple[int, int]]:
    """Row and column of each tap, relative to the centre."""
    return list(itertools.product(range(-(size // 2), size // 2 + 1), repeat=2))


class _WeightedSum(torch.autograd.Function):
    """The weighted sum for training: it and its gradient accumulate in place, which saves memory."""

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


def weighted(image: Tensor, weight: Tensor) -> Tensor:
    """Premultiply an image by a weight and append the weight as a channel, for a normalised sum (:func:`divided`)."""
    return torch.cat([image * weight, weight], dim=1)


def divided(image: Tensor) -> Tensor:
    """Divide a sum of :func:`weighted` images by its weight channel."""
    return image[:, :-1] / image[:, -1:].clamp_min(1e-12)


def positive(logits: Tensor) -> Tensor:
    """Weights of logits: their exponentials, clamped to ``MAX_LOGIT``."""
    if torch.is_grad_enabled():
        return _Exponential.apply(logits)
    return torch.exp(logits.clamp(-MAX_LOGIT, MAX_LOGIT))


class _Exponential(torch.autograd.Function):
    """``exp`` of clamped logits, whose gradient ignores the clamp: several times faster than ``clamp`` and ``exp``."""

    @staticmethod
    def forward(ctx: Any, logits: Tensor) -> Tensor:
        values = logits.clamp(-MAX_LOGIT, MAX_LOGIT).exp_()
        ctx.save_for_backward(values)
        return values

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (values,) = ctx.saved_tensors
        return gradient * values


# Heads and bounds


def pointwise(head: nn.Conv2d, features: Tensor) -> Tensor:
    """A 1x1 convolution with an output in planes (N, C, H, W), which the weighted sums read.

    ``nn.Conv2d`` would return channels-last memory, and reordering a head's many channels takes longer than computing
    them.
    """
    (planes,) = pointwise_split(head, features, [head.out_channels])
    return planes


def pointwise_split(head: nn.Conv2d, features: Tensor, sizes: list[int]) -> list[Tensor]:
    """The same, split into outputs of ``sizes`` channels. Splitting the weights avoids a copy of the result."""
    assert head.bias is not None
    flat = features.contiguous().flatten(2)
    images = flat.unbind() if len(flat) > 1 else [flat.flatten(0, 1)]  # a single image needs no copy
    # addmm is one operator (Gemm) in ONNX, which takes matrices only
    planes = (
        torch.stack([torch.addmm(bias[:, None], weight, image) for image in images]) if len(weight) else flat[:, :0]
        for weight, bias in zip(head.weight.flatten(1).split(sizes), head.bias.split(sizes), strict=True)
    )
    return [part.unflatten(2, features.shape[2:]) for part in planes]


def highest_around(lrhs: Tensor, hrls: Tensor) -> Tensor:
    """Per 2x2 HRLS pixels, the maximum of 10x10 HRLS pixels and of 3x3 LRHS pixels around them, per channel.

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
