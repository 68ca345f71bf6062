# SPDX-License-Identifier: Apache-2.0
"""A network of Open Image Denoise, fine-tuned to denoise the mean of both renders at the LRHS's resolution.

The given network expects a noise-free albedo and normal, and estimates the noise of the colour itself. Here albedo and
normal are means of s x s HRLS pixels, which are noisy at x2, and the difference of the two renders gives an estimate of
the colour's noise. The fine-tuned network reads all of these as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from training.encoding import log_to_pu, pu_to_log
from training.oidn import (
    BASE,
    LARGE,
    LARGE_HDR,
    SMALL_CLEAN_HDR,
    FineTunedConv,
    Shape,
    convolutions,
    pretrained_weights,
    run_unet_on_tensors,
)

#: Height and width of its input are multiples of this.
ALIGNMENT = 16
#: The extra input channel is the noise.
EXTRA = 1


@dataclass(frozen=True)
class Start:
    """What the fine-tuning starts from."""

    network: str
    """A key of :data:`training.oidn_weights.NETWORKS`."""
    shape: Shape
    readers: tuple[str, ...]
    """The convolutions that read the input."""
    frozen: tuple[str, ...] = ()
    """Convolutions that keep the pretrained weights."""


#: By the size of :class:`training.joint.JointFusion`. Of the large network, only the outer levels are trained: the two
#: lowest ones have two thirds of all weights.
STARTS = {
    "small": Start(SMALL_CLEAN_HDR, BASE, ("enc_conv0", "dec_conv1a")),
    "usual": Start(
        LARGE_HDR,
        LARGE,
        ("enc_conv1a", "dec_conv1a"),
        ("enc_conv4a", "enc_conv4b", "enc_conv5a", "enc_conv5b", "dec_conv4a", "dec_conv4b"),
    ),
}


class MeanDenoiser(nn.Module):
    """See the module's docstring.

    Args:
        size: a key of ``STARTS``.
    """

    def __init__(self, size: str = "usual") -> None:
        super().__init__()
        self.start = STARTS[size]
        pretrained = pretrained_weights(self.start.network)
        self.convs = nn.ModuleDict(
            {
                name: FineTunedConv(
                    pretrained[f"{name}.weight"],
                    pretrained[f"{name}.bias"],
                    EXTRA if name in self.start.readers else 0,
                    frozen=name in self.start.frozen,
                )
                for name in convolutions(pretrained)
            }
        )

    def forward(self, mean: Tensor, noise: Tensor, albedo: Tensor, normal: Tensor) -> Tensor:
        """
        Args:
            mean: (N, 3, h, w), the mean of both renders, log-encoded.
            noise, albedo, normal: see :func:`training.render_mean.mean_of_renders`.

        Returns:
            The denoised mean (N, 3, h, w), log-encoded.
        """
        inputs = torch.cat([log_to_pu(mean), albedo.clamp(0.0, 1.0), 0.5 * normal + 0.5, noise], dim=1)
        inputs = inputs.to(next(self.convs.parameters()).dtype)

        def conv(name: str, values: Tensor) -> Tensor:
            return F.relu(self.convs[name](values))

        colour = run_unet_on_tensors(self.start.shape, [inputs], conv)
        return pu_to_log(colour.float().clamp_max(1.0))

    def weights(self) -> dict[str, Tensor]:
        """Weights and biases of all convolutions, by Open Image Denoise's names."""
        pairs = {name: conv.total() for name, conv in self.convs.items()}
        return {
            f"{name}.{kind}": values.detach()
            for name, pair in pairs.items()
            for kind, values in zip(("weight", "bias"), pair, strict=True)
        }
