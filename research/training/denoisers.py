# SPDX-License-Identifier: Apache-2.0
"""What `joint` denoises before it fuses: the mean of both renders, and for its size ``large`` albedo and normal.

A network of Open Image Denoise is fine-tuned to denoise the mean at the LRHS's resolution. The given network expects a
noise-free albedo and normal, and estimates the noise of the colour itself. Here albedo and normal are means of s x s
HRLS pixels, which are noisy at x2, and the difference of the two renders gives an estimate of the colour's noise. The
fine-tuned network reads all of these. Albedo and normal are denoised by Open Image Denoise's base networks as they are.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from research.training import oidn
from research.training.encoding import from_srgb, log_to_pu, pu_to_log, srgb
from research.training.ops import box_downsample, log2_scale
from research.training.paper import LRHS_CHANNELS
from research.training.render_mean import with_mean

#: Height and width of the mean are multiples of this.
ALIGNMENT = 16
#: The convolutions of the large network's two lowest levels.
LOWEST = ("enc_conv4a", "enc_conv4b", "enc_conv5a", "enc_conv5b", "dec_conv4a", "dec_conv4b")
#: By the size of :class:`research.training.joint.JointFusion`: what training starts from, its shape, and convolutions
#: that are not trained. Of the large network, the two lowest levels have two thirds of all weights.
STARTS: dict[str, tuple[str, oidn.Shape, tuple[str, ...]]] = {
    "small": (oidn.SMALL_CLEAN_HDR, oidn.BASE, ()),
    "usual": (oidn.LARGE_HDR, oidn.LARGE, LOWEST),
}


class MeanDenoiser(oidn.FineTunedUNet):
    """The denoiser of both renders' mean. Its size is a key of ``STARTS``."""

    def __init__(self, size: str = "usual") -> None:
        network, shape, frozen = STARTS[size]
        super().__init__(network, shape, extra=1, frozen=frozen)  # the extra input channel is the noise

    def forward(self, mean: Tensor, noise: Tensor, albedo: Tensor, normal: Tensor) -> Tensor:
        """Denoise the mean (N, 3, h, w) of both renders, log-encoded.

        The arguments are those that :func:`research.training.render_mean.mean_of_renders` returns.
        """
        colour = self.run(torch.cat([log_to_pu(mean), albedo.clamp(0.0, 1.0), 0.5 * normal + 0.5, noise], dim=1))
        return pu_to_log(colour.clamp_max(1.0))


class FullSizeDenoiser(oidn.FineTunedUNet):
    """Open Image Denoise's large network as it is, which denoises one render at full size."""

    def __init__(self) -> None:
        super().__init__(oidn.LARGE_HDR, oidn.LARGE)

    def forward(self, colour: Tensor, albedo: Tensor, normal: Tensor) -> Tensor:
        """Denoise a render (N, 3, H, W), log-encoded. Its albedo and normal have no noise, and are in [0, 1]."""
        denoised = self.run(torch.cat([log_to_pu(colour), albedo, normal], dim=1))
        return pu_to_log(denoised.clamp_max(1.0))


def mean_images(lrhs: Tensor, hrls: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return what :class:`MeanDenoiser` reads, given the arguments of :func:`denoise_mean`."""
    _, mean, noise = lrhs.split([LRHS_CHANNELS, LRHS_CHANNELS, 1], dim=1)
    scale = 2 ** log2_scale(lrhs, hrls)
    return mean, noise, box_downsample(hrls[:, 3:6].clamp(0, 1), scale), box_downsample(hrls[:, 6:9], scale)


def denoise_mean(denoiser: MeanDenoiser, lrhs: Tensor, hrls: Tensor) -> Tensor:
    """Replace a mean of both renders by the denoised one.

    Args:
        lrhs: (N, 7, h, w): the LRHS, the mean of both renders, its noise, see
            :func:`research.training.render_mean.with_mean`.
        hrls: (N, 9 or more, s*h, s*w): the HRLS's encoded colour, albedo and normal.

    Returns:
        (N, 6, h, w), log-encoded: the LRHS and the denoised mean.
    """
    return torch.cat([lrhs[:, :LRHS_CHANNELS], denoiser(*mean_images(lrhs, hrls))], dim=1)


@torch.no_grad()
def with_denoised_mean(denoiser: MeanDenoiser, lrhs: Tensor, hrls: Tensor) -> Tensor:
    """Append the denoised mean of both renders to an encoded LRHS."""
    return denoise_mean(denoiser, with_mean(lrhs, hrls), hrls)


class LayerDenoisers(nn.Module):
    """Open Image Denoise's base networks for albedo and normal."""

    def __init__(self) -> None:
        super().__init__()
        self.albedo = oidn.FineTunedUNet(oidn.ALBEDO_BASE, oidn.BASE)
        self.normal = oidn.FineTunedUNet(oidn.NORMAL_BASE, oidn.BASE)

    def forward(self, albedo: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
        """Denoise an albedo in [0, 1] and a normal in [-1, 1], (N, 3, H, W) each; both results are in [0, 1]."""
        return from_srgb(self.albedo.run(srgb(albedo)).clamp(0, 1)), self.normal.run(0.5 * normal + 0.5).clamp(0, 1)

    def applied(self, hrls: Tensor) -> Tensor:
        """Denoise the albedo and normal of an encoded HRLS (N, 9 or more, H, W): (N, 9, H, W)."""
        albedo, normal = self(hrls[:, 3:6], hrls[:, 6:9])
        return torch.cat([hrls[:, :3], albedo, 2 * normal - 1], dim=1)
