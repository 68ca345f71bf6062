# SPDX-License-Identifier: Apache-2.0
"""Quantise a U-Net of Open Image Denoise's layout to 8 bits, layer after layer.

Activations are unsigned 8-bit codes. A value whose rounding would be visible is split into slices: its range is cut
into n equal parts, and each part has a code channel that says how far it is filled. The sum of the channels is the
value.

Weights are chosen on images of training views. First they are refitted by least squares, so that the codes of the layer
before give the outputs that its exact values gave. Then they are rounded one by one, and the remaining weights of the
row compensate for the error (Frantar et al. 2023, "GPTQ", after Hassibi and Stork 1993).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from research.training.oidn import LARGE, Shape, Weights, run_unet
from research.training.ops import upsample
from research.training.quantise.codes import INPUT_SLICES, OUTPUT_SLICES

#: Pixels of each image that a layer's weights are fitted to.
PIXELS = 4000
#: Share of a layer's values, in every image, that the range of its codes covers.
COVERED = 0.9995
#: On the decoder's levels below the last one, the range is the largest value of all images times this: rare light of
#: other scenes has brighter values there, and the rounding of these levels does not show.
HEADROOM = 2.0
#: Channel ranges lie between one range for the whole layer (0) and a range of its own for each channel (1). In between,
#: neither the values of a weak channel nor the weights that read it have too few codes.
OWN_RANGE = 0.75
#: Strength of the regularisation towards the original weights, relative to the power of the inputs, if there are as
#: many weights per output as pixels.
DAMPING = 1.0
#: Largest absolute code of a weight.
MAX_WEIGHT = 127
#: Largest sum of the weights of one sign of a pair. ONNX Runtime multiplies the codes of two neighbouring input
#: channels, and processors without VNNI instructions add both products in 16 bits. 255 times this fits.
MAX_PAIR = 128
#: Further code channels by layer, for slices. Rounding errors of the last level go straight into the colour, mostly
#: from a few channels. The large network has more channels there.
EXTRA_SLICES = dict.fromkeys(("dec_conv1a", "dec_conv1b"), 16)
EXTRA_SLICES_LARGE = dict.fromkeys(EXTRA_SLICES, 32)
#: Those of the denoiser of one render at full size, which sees less noise, so that its rounding shows.
FULL_SIZE_SLICES = {"enc_conv1a": 16, "enc_conv1b": 32, "dec_conv2b": 32, "dec_conv1a": 48, "dec_conv1b": 48}
#: Power of the rounding error of a weight after the other weights of its row have made up for it, as a share of that
#: before; and mean square of a code.
COMPENSATED, CODE_POWER = 0.3, 40.0**2
#: Weights that are rounded before the ones behind them make up for it; a block at a time is faster.
BLOCK = 128
#: Convolutions that read a layer of the U-Net but are no part of it. Their outputs, and the last layer's outputs after
#: the colours, are logits and logarithms: signed, in [-SIGNED_RANGE, SIGNED_RANGE], with SIGNED_ZERO as the code of 0.
HEADS = ("head1", "head2", "head3")
COLOURS, SIGNED_RANGE, SIGNED_ZERO = 3, 10.0, 128


@dataclass
class CodeLayout:
    """How values are stored in code channels.

    Attributes:
        scale: (K,), dequantises each code channel.
        source_channel: (K,), the value channel that each code channel contributes to. Slices of one value share it.
    """

    scale: Tensor
    source_channel: Tensor

    def dequantise(self, codes: Tensor) -> Tensor:
        """Convert codes (K, H, W) to values (C, H, W)."""
        result = torch.zeros(int(self.source_channel.max()) + 1, *codes.shape[1:])
        return result.index_add_(0, self.source_channel, codes * self.scale[:, None, None])


@dataclass
class Activations:
    """A layer's outputs for all images: exact values (1, C, H, W), and codes (1, K, H, W) of the 8-bit layers."""

    exact: list[Tensor]
    codes: list[Tensor]
    layout: CodeLayout


def activations(codes: Sequence[Tensor], layout: CodeLayout) -> Activations:
    """Return the inputs of a network, whose exact values are those of their codes."""
    return Activations([layout.dequantise(image[0])[None] for image in codes], list(codes), layout)


@dataclass
class QuantisedConv:
    """A convolution in 8 bits.

    Attributes:
        weights: (O, I, 3, 3), integers; times ``step`` they are the weights of the input's codes.
        step: (O,).
        bias: (O,), of values.
        inputs, outputs: layouts of the codes that are read and written.
        offset: (K,), the value at which the slice of each output code channel starts.
    """

    weights: Tensor
    step: Tensor
    bias: Tensor
    inputs: CodeLayout
    outputs: CodeLayout
    offset: Tensor

    def __call__(self, codes: Tensor) -> Tensor:
        """Return the output codes."""
        weights = self.weights * self.step[:, None, None, None]
        values = F.conv2d(codes, weights, self.bias, padding=1)[:, self.outputs.source_channel]
        in_codes = (values - self.offset[:, None, None]) / self.outputs.scale[:, None, None]
        return in_codes.round_().clamp_(0, 255)


# Layouts


def sliced_layout(count: int, first: int) -> CodeLayout:
    """Return the layout of sliced colours, which are the value channels from ``first`` on."""
    return CodeLayout(torch.full((3 * count,), 1 / count / 255), torch.arange(first, first + 3).repeat(count))


def concatenated(*parts: CodeLayout) -> CodeLayout:
    """Concatenate layouts, and code channels of zeros up to a multiple of four channels.

    For other numbers, ONNX Runtime's convolutions take more than twice the memory.
    """
    count = -sum(len(part.scale) for part in parts) % 4
    parts = (*parts, CodeLayout(torch.zeros(count), torch.zeros(count, dtype=torch.long)))
    scale, source = ([getattr(part, name) for part in parts] for name in ("scale", "source_channel"))
    return CodeLayout(torch.cat(scale), torch.cat(source))


# The fit


@dataclass
class Fit:
    """Quantises the layers of a network in the order in which :meth:`conv` is called.

    Attributes:
        shape: layout of the U-Net.
        weights: of its convolutions and of the heads.
        slices_out: slices of the output colour.
        extra_slices: see ``EXTRA_SLICES``, which holds if None.
        headroom: see ``HEADROOM``.
        layers: the result.
    """

    shape: Shape
    weights: Weights
    slices_out: int = OUTPUT_SLICES
    extra_slices: Mapping[str, int] | None = None
    headroom: float = HEADROOM
    layers: dict[str, QuantisedConv] = field(default_factory=dict)
    _random: torch.Generator = field(default_factory=lambda: torch.Generator().manual_seed(0))

    def conv(self, name: str, inputs: Activations) -> Activations:
        """Quantise a convolution; return its outputs."""
        weights, bias = self.weights[f"{name}.weight"], self.weights[f"{name}.bias"]
        # So many outputs, the first ones, pass a ReLU. The others are signed.
        rectified = 0 if name in HEADS else COLOURS if name == self.shape.last else len(bias)
        exact, power, products = [], torch.zeros((), dtype=torch.double), torch.zeros((), dtype=torch.double)
        for image, codes in zip(inputs.exact, inputs.codes, strict=True):
            result = F.conv2d(image, weights, bias, padding=1)
            pixels = torch.randperm(result[0, 0].numel(), generator=self._random)[:PIXELS]
            patches = _patches(codes, pixels)
            power = power + (patches.T @ patches).double() / len(patches)
            products = products + (patches.T @ result[0].flatten(1)[:, pixels].T).double() / len(patches)
            result[:, :rectified].relu_()
            exact.append(result)
        of_codes = weights[:, inputs.layout.source_channel] * inputs.layout.scale[:, None, None]
        original = torch.cat([of_codes.flatten(1), bias[:, None]], dim=1)
        count = len(exact)
        chosen, step, bias = gptq(power / count, products / count, count * len(pixels), original)
        layout, offset = self._output_layout(name, exact, rectified)
        layer = QuantisedConv(chosen.reshape(of_codes.shape), step, bias, inputs.layout, layout, offset)
        self.layers[name] = layer
        return Activations(exact, [layer(codes) for codes in inputs.codes], layout)

    def _noise_gain(self, name: str) -> Tensor:
        """Return the power of noise in the colours per power of noise in each output of a convolution.

        ReLUs are ignored. Above the last level, all outputs count alike.
        """
        level = [*self.shape.up[-1], self.shape.last]
        if name not in level:
            return torch.ones(len(self.weights[f"{name}.bias"]))
        result = (torch.arange(len(self.weights[f"{self.shape.last}.bias"])) < COLOURS).float()
        for reader in level[: level.index(name) : -1]:
            result = result @ self.weights[f"{reader}.weight"].square().sum(dim=(2, 3))
        return result

    def _slices(self, name: str, tops: Tensor) -> Tensor:
        """Return the number of slices of each output of a convolution, given the largest values (C,)."""
        usual = EXTRA_SLICES_LARGE if self.shape is LARGE else EXTRA_SLICES
        extra, order = usual if self.extra_slices is None else self.extra_slices, self.shape.order
        if name not in extra:
            return torch.ones(len(tops), dtype=torch.long)
        reader = order[order.index(name) + 1]
        weights = self.weights[f"{reader}.weight"][:, : len(tops)]
        return slices_per_channel(tops, weights, self._noise_gain(reader), extra[name])

    def _output_layout(self, name: str, exact: list[Tensor], rectified: int) -> tuple[CodeLayout, Tensor]:
        """Return the layout of a layer's output codes, and the value at which each code channel's slice starts."""
        count = len(exact[0][0])
        if name == self.shape.last or rectified < count:
            tops, slices = torch.ones(rectified), torch.full((rectified,), self.slices_out)
        else:
            below = any(name in level for level in self.shape.up[:-1])
            share, headroom = (1.0, self.headroom) if below else (COVERED, 1.0)
            rows = [image[0].flatten(1) for image in exact]
            quantiles = [x.kthvalue(max(round(share * x.shape[1]), 1), dim=1).values for x in rows]
            tops = headroom * torch.stack(quantiles).amax(dim=0)
            tops = tops.clamp_min(1e-3 * tops.max())
            tops = tops**OWN_RANGE * tops.max() ** (1 - OWN_RANGE)
            slices = self._slices(name, tops)
        # The first slice of every channel, then the second slice of those that have one, ...
        nth, source = (torch.arange(int(slices.sum()))[:, None] < slices).nonzero(as_tuple=True)
        width = (tops / slices)[source]
        offset, scale = nth * width, width / 255
        signed = torch.arange(rectified, count)
        source = torch.cat([source, signed])
        scale = torch.cat([scale, torch.full(signed.shape, 2 * SIGNED_RANGE / 255)])
        offset = torch.cat([offset, torch.full(signed.shape, -SIGNED_ZERO * 2 * SIGNED_RANGE / 255)])
        if name == self.shape.last or rectified < count:
            source, scale, offset = (F.pad(x, (0, -len(x) % 16), value=float(x[0])) for x in (source, scale, offset))
        return CodeLayout(scale, source), offset


def slices_per_channel(tops: Tensor, weights: Tensor, gain: Tensor, extra: int) -> Tensor:
    """Distribute ``extra`` slices, beyond one per channel, for the least noise.

    n slices divide the rounding error of a channel by n, and also the weights that read it. The largest weight of a row
    decides how finely all others are rounded, so slices of the channel that it reads make the whole row finer.

    Args:
        tops: (C,), the largest value of each channel.
        weights: (R, C, 3, 3), of the convolution that reads them.
        gain: (R,), the power of noise that counts per power of noise in each output of this convolution.
    """
    rounding = gain @ weights.square().sum(dim=(2, 3)) * (tops / 255).square()
    largest = weights.abs().amax(dim=(2, 3)) * tops / 255
    codes = COMPENSATED * CODE_POWER * 9 * len(tops)

    def noise(slices: Tensor) -> Tensor:
        # A mean of high powers: if two weights are the largest, slices of either are the first half of the way
        step = (largest / slices[:, None]).pow(12).sum(dim=-1).pow(1 / 12) / MAX_WEIGHT
        return (rounding / slices.square()).sum(dim=-1) + codes * step.square() @ gain

    slices = torch.ones(len(tops))
    for _ in range(extra):
        candidates = slices + torch.eye(len(slices))
        slices = candidates[noise(candidates).argmin()]
    return slices.long()


def _patches(image: Tensor, pixels: Tensor) -> Tensor:
    """Return the 3 x 3 neighbourhoods of pixels of an image (1, C, H, W), ordered as a kernel's weights, and a 1.

    The shape is (P, 9 C + 1).
    """
    width = image.shape[3]
    padded = F.pad(image[0], (1, 1, 1, 1)).permute(1, 2, 0).flatten(0, 1).contiguous()
    first = pixels // width * (width + 2) + pixels % width
    parts = [padded.index_select(0, first + y * (width + 2) + x) for y in range(3) for x in range(3)]
    return torch.cat([torch.stack(parts, dim=2).flatten(1), torch.ones(len(pixels), 1)], dim=1)


def gptq(power: Tensor, products: Tensor, pixels: int, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Choose integer weights in [-MAX_WEIGHT, MAX_WEIGHT] and their steps, so that inputs give outputs.

    Channels 2 i and 2 i + 1 are a pair: at each of the 3 x 3 pixels, their weights of one sign sum to ``MAX_PAIR`` at
    most.

    Args:
        power: (K + 1, K + 1), mean products of the inputs: 3 x 3 pixels of each of an even number of channels, and a 1.
        products: (K + 1, O), mean products of inputs and outputs.
        pixels: whose means these are.
        weights: (O, K + 1), the original weights; bias last.

    Returns:
        Integers (O, K), the step of each row (O,), bias (O,).
    """
    count = len(power) - 1
    damping = torch.diag(DAMPING * count / pixels * power.diagonal() + 1e-6 * power.diagonal().mean())
    damping[count, count] = 1e-9
    original = weights.double()
    weights = torch.linalg.solve(power + damping, products + damping @ original.T).T
    pairs = torch.stack([weights, -weights])[:, :, :count].clamp_min(0).reshape(2, len(weights), -1, 2, 9).sum(dim=3)
    # Bounded, so that biases in steps fit into 32 bits
    step = (pairs.amax(dim=(0, 2, 3)) / MAX_PAIR).maximum(weights[:, :count].abs().amax(dim=1) / MAX_WEIGHT)
    step = step.clamp_min(1e-8)
    # Strong inputs first, while other weights can compensate for their error; the unrounded bias last
    order = torch.cat([power.diagonal()[:count].argsort(descending=True), torch.tensor([count])])
    inverse = torch.cholesky_inverse(torch.linalg.cholesky((power + damping)[order][:, order]))
    upper = torch.linalg.cholesky(inverse, upper=True)
    rest, chosen = weights[:, order].clone(), torch.zeros(len(weights), count, dtype=torch.double)
    channel, pixel = torch.arange(count) // 9, torch.arange(count) % 9
    beside = (channel ^ 1) * 9 + pixel
    for start in range(0, count, BLOCK):
        stop = min(start + BLOCK, count)
        errors = torch.zeros(len(weights), stop - start, dtype=torch.double)
        for i in range(start, stop):
            partner = chosen[:, beside[order[i]]]
            largest = (MAX_PAIR - partner.clamp_min(0)).clamp_max(MAX_WEIGHT)
            smallest = (-MAX_PAIR - partner.clamp_max(0)).clamp_min(-MAX_WEIGHT)
            chosen[:, order[i]] = (rest[:, i] / step).round().clamp(smallest, largest)
            errors[:, i - start] = (rest[:, i] - chosen[:, order[i]] * step) / upper[i, i]
            rest[:, i:stop] -= errors[:, i - start, None] * upper[i, i:stop]
        rest[:, stop:] -= errors @ upper[start:stop, stop:]
    return chosen.float(), step.float(), rest[:, count].float()


def run_unet_on_activations(
    shape: Shape, inputs: Sequence[Activations], conv: Callable[[str, Activations], Activations]
) -> Activations:
    """Run a U-Net on exact values and codes alike."""

    def changed(change: Callable[[Tensor], Tensor], values: Activations) -> Activations:
        return Activations([change(i) for i in values.exact], [change(i) for i in values.codes], values.layout)

    def concat(above: Activations, skipped: Activations) -> Activations:
        exact, codes = (
            [torch.cat(pair, dim=1) for pair in zip(*images, strict=True)]
            for images in ((above.exact, skipped.exact), (above.codes, skipped.codes))
        )
        source = torch.cat([above.layout.source_channel, skipped.layout.source_channel + above.exact[0].shape[1]])
        return Activations(exact, codes, CodeLayout(torch.cat([above.layout.scale, skipped.layout.scale]), source))

    with torch.no_grad():
        pool = functools.partial(changed, functools.partial(F.max_pool2d, kernel_size=2))
        return run_unet(shape, inputs, conv, pool, functools.partial(changed, lambda image: upsample(image, 2)), concat)


def quantise_denoiser(shape: Shape, weights: Weights, codes: Sequence[Tensor], *, full_size: bool = False) -> Fit:
    """Quantise a denoiser: of both renders' mean, or of one render at full size.

    Args:
        shape: of its U-Net.
        weights: in full precision.
        codes: inputs of the network, see :func:`research.training.quantise.codes.denoiser_codes`, or
            :func:`research.training.quantise.codes.full_size_codes`.
    """
    if full_size:
        normals = CodeLayout(torch.full((3,), 1 / 255), torch.arange(6, 9))
        layout = concatenated(sliced_layout(INPUT_SLICES, 0), sliced_layout(INPUT_SLICES, 3), normals)
        # Its values are those of the calibration: unlike the mean of two renders of few spp, it has no rare light
        fit = Fit(shape, weights, extra_slices=FULL_SIZE_SLICES, headroom=1.0)
    else:
        scale = [1 / INPUT_SLICES / 255] * (3 * INPUT_SLICES) + [1 / 255] * 7
        layout = CodeLayout(torch.tensor(scale), torch.tensor([*np.repeat(range(3), INPUT_SLICES), *range(3, 10)]))
        fit = Fit(shape, weights)
    run_unet_on_activations(shape, [activations(codes, layout)], fit.conv)
    return fit
