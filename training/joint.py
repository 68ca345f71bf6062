# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise's networks, taught to read both renders.

Open Image Denoise has learnt from far more pictures than we can render; what it has not learnt is what a second render
says. So this network begins as its usual one for HDR colour with albedo and normal. At H/2 it reads two pictures more,
the LRHS and both renders denoised together at the LRHS's resolution (:mod:`training.together`), which count for nothing
at first; and all of its weights go on learning, for renders of so few samples alone.

Its parameters are what they differ by from Open Image Denoise's, which are read from the installed library: no file
holds the latter. Weight decay pulls towards them.

No pixel may be darker or brighter than everything around it in both renders.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from oiio_msspl import schema
from oiio_msspl.denoiser import layers_of, merged
from oiio_msspl.render import Array
from training.mix import COARSEST, FINER, blend
from training.paper import LRHS_CHANNELS
from training.pyramid import level_of
from training.together import Together
from training.unet import SMALLER, Retrained, convolutions, given_weights, seen, unseen, walk_tensors

#: Channels that H/2 reads more: both together, the LRHS.
MORE = 6
#: The convolutions that read them.
READERS = ("enc_conv2", "dec_conv2a")
#: Of each level that has logits, H, H/2, H/4, H/8: the last convolution, and how many it has.
DECODED = ("dec_conv1b", "dec_conv2b", "dec_conv3b", "dec_conv4b")
#: On the way up, the convolution whose outputs are another one's first inputs.
BEFORE = {
    name: before for before, name in itertools.pairwise([*(n for level in SMALLER.up for n in level), SMALLER.last])
}
OUTPUTS = (len(FINER) + 1, *[len(FINER) + len(COARSEST)] * 3)


class JointFusion(nn.Module):
    """See the module's docstring. One set of weights serves every scale, which follows from the images' sizes.

    Sizes must be multiples of ``multiple`` HRLS pixels.
    """

    multiple = 16

    def __init__(self, kept: Mapping[str, Sequence[int]] | None = None) -> None:
        super().__init__()
        self.kept = dict(kept or {})
        self.config = {"kept": self.kept}
        self.lrhs_channels, self.hrls_channels = (sum(features.values()) for features in schema.inputs("together"))
        self.given = given_weights("usual")
        self.together = Together()
        self.convs = nn.ModuleDict()
        for name in convolutions(self.given):
            rows, columns = self.given_channels(name)
            weight, bias = self.given[f"{name}.weight"][rows][:, columns], self.given[f"{name}.bias"][rows]
            self.convs[name] = Retrained(weight, bias, MORE if name in READERS else 0)
        self.heads = nn.ModuleList(
            nn.Conv2d(len(self.convs[name].bias), size, 3, padding=1)
            for name, size in zip(DECODED, OUTPUTS, strict=True)
        )
        self.error = nn.Conv2d(len(self.convs[DECODED[1]].bias), 4, 3, padding=1)
        with torch.no_grad():
            for level, head in enumerate(self.heads):
                nn.init.kaiming_normal_(head.weight)
                head.weight.mul_(0.1)
                head.bias.copy_(torch.tensor(FINER + COARSEST if level else (*FINER, 2.0)))
        self.reset_error()

    def given_channels(self, name: str) -> tuple[list[int], list[int]]:
        """Which of a given convolution's outputs and inputs the network has."""
        count, inputs = self.given[f"{name}.weight"].shape[:2]
        rows, columns = list(self.kept.get(name, range(count))), list(range(inputs))
        if before := BEFORE.get(name):
            everything = len(self.given[f"{before}.bias"])
            columns = [*self.kept.get(before, range(everything)), *columns[everything:]]
        return rows, columns

    def retrained(self) -> Iterator[nn.Parameter]:
        """Parameters that are added to given ones."""
        for conv in (*self.convs.values(), *self.together.convs.values()):
            yield from conv.retrained()

    def beginning(self) -> dict[str, Tensor]:
        """Of a network that is new, all parameters but those of the expected error, without what is random."""
        return {
            name: value.clone() if name.startswith("heads") and name.endswith("bias") else torch.zeros_like(value)
            for name, value in self.state_dict().items()
            if not name.startswith("error")
        }

    @torch.no_grad()
    def reset_error(self) -> None:
        """The predicted error starts alike everywhere. :mod:`training.error` teaches it."""
        self.error.weight.zero_()
        self.error.bias.fill_(math.log(0.05))

    def forward(self, lrhs: Tensor, hrls: Tensor) -> tuple[Tensor, Tensor]:
        """
        Args:
            lrhs: (N, 7, h, w), network values: the LRHS, both renders' mean and its noise (:func:`with_mean`).
            hrls: (N, 16, s*h, s*w), network values: the HRLS's layers.

        Returns:
            What :meth:`fuse` does.
        """
        low, mean, noise = lrhs.split([LRHS_CHANNELS, LRHS_CHANNELS, 1], dim=1)
        scale = 2 ** level_of(lrhs, hrls)
        albedo, normal = (F.avg_pool2d(image, scale) for image in (hrls[:, 3:6].clamp(0, 1), hrls[:, 6:9]))
        return self.fuse(torch.cat([low, self.together(mean, noise, albedo, normal)], dim=1), hrls)

    def fuse(self, lrhs: Tensor, hrls: Tensor) -> tuple[Tensor, Tensor]:
        """
        Args:
            lrhs: (N, 6, h, w), network values: the LRHS, and both renders denoised together.
            hrls: (N, 16, s*h, s*w), network values: the HRLS's layers.

        Returns:
            The fused image (N, 3, s*h, s*w) in network values, and the logarithm of its expected absolute error
            (N, 1, s*h, s*w), mean of the channels, in network values too. Nothing else learns from the latter.
        """
        samples, albedo, normal = hrls[:, :3], hrls[:, 3:6], hrls[:, 6:9]
        picture = torch.cat([seen(samples), albedo.clamp(0, 1), 0.5 * normal + 0.5], dim=1)
        more = seen(torch.cat([lrhs[:, LRHS_CHANNELS:], lrhs[:, :LRHS_CHANNELS]], dim=1))
        more = F.interpolate(more, scale_factor=2 ** (level_of(lrhs, hrls) - 1), mode="nearest")
        features: dict[str, Tensor] = {}

        def conv(name: str, values: Tensor) -> Tensor:
            features[name] = F.relu(self.convs[name](values))
            return features[name]

        colour = walk_tensors(SMALLER, [picture, more], conv)
        logits = [head(features[name]).float() for head, name in zip(self.heads, DECODED, strict=True)]
        log_error = F.pixel_shuffle(self.error(features[DECODED[1]].detach()).float(), 2)
        denoised = unseen(colour.float().clamp_max(1.0))
        return blend(lrhs, hrls, denoised, logits), log_error


def with_mean(lrhs: Array, hrls: Array) -> tuple[Array, Array]:
    """What the network reads, of a pair as renders are: (h, w, 3) and (s*h, s*w, 16), transformed."""
    low = merged(lrhs, layers_of(hrls, complete=True))
    return np.concatenate([lrhs, low["colour"], low["noise"]], axis=-1), hrls
