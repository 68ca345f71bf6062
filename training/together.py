# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise's larger network, taught to denoise both renders together.

It has learnt to rely on an albedo and a normal that are free of noise, and to find out alone how much noise a colour
has. Here the HRLS's layers are means of s x s pixels, which at x2 are not free of it; and of the noise there is an
estimate, by how far the two renders differ. The network reads both as they are, and its outer levels go on learning.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from oiio_msspl.denoiser import Layers
from oiio_msspl.eight_bit import MULTIPLE
from oiio_msspl.render import Array
from training.unet import LARGER, Retrained, convolutions, given_weights, seen, unseen, walk_tensors

#: Convolutions that stay as they are: of the two lowest levels, two thirds of all weights.
HELD = ("enc_conv4a", "enc_conv4b", "enc_conv5a", "enc_conv5b", "dec_conv4a", "dec_conv4b")
#: Channels that the picture has more: the noise.
MORE = 1
#: The convolutions that read it.
READERS = ("enc_conv1a", "dec_conv1a")


class Together(nn.Module):
    """See the module's docstring."""

    def __init__(self) -> None:
        super().__init__()
        given = given_weights("large")
        self.convs = nn.ModuleDict(
            {
                name: Retrained(
                    given[f"{name}.weight"],
                    given[f"{name}.bias"],
                    MORE if name in READERS else 0,
                    held=name in HELD,
                )
                for name in convolutions(given)
            }
        )

    def forward(self, mean: Tensor, noise: Tensor, albedo: Tensor, normal: Tensor) -> Tensor:
        """
        Args:
            mean: (N, 3, h, w), network values of both renders' mean.
            noise: (N, 1, h, w), see :func:`oiio_msspl.denoiser.merged`.
            albedo, normal: (N, 3, h, w), the HRLS's, means of s x s pixels.

        Returns:
            Network values (N, 3, h, w).
        """
        picture = torch.cat([seen(mean), albedo.clamp(0, 1), 0.5 * normal + 0.5, noise], dim=1)
        height, width = mean.shape[2:]
        picture = F.pad(picture, (0, -width % MULTIPLE, 0, -height % MULTIPLE), mode="replicate")

        def conv(name: str, values: Tensor) -> Tensor:
            return F.relu(self.convs[name](values))

        colour = walk_tensors(LARGER, [picture], conv)[..., :height, :width]
        return unseen(colour.float().clamp_max(1.0))

    def weights(self) -> dict[str, Tensor]:
        """Of all convolutions, as Open Image Denoise names them."""
        pairs = {name: conv.parameters_in_all() for name, conv in self.convs.items()}
        return {
            f"{name}.{kind}": values.detach()
            for name, pair in pairs.items()
            for kind, values in zip(("weight", "bias"), pair, strict=True)
        }

    @torch.inference_mode()
    def denoised(self, layers: Layers) -> Array:
        """What it makes of one picture, network values (h, w, 3)."""
        images = (layers[name] for name in ("colour", "noise", "albedo", "normal"))
        result = self(*(torch.from_numpy(image).permute(2, 0, 1)[None] for image in images))
        return result[0].permute(1, 2, 0).numpy()

    @classmethod
    def of(cls, checkpoint: Path) -> Together:
        """The one of a joint network's checkpoint."""
        weights = torch.load(checkpoint, map_location="cpu", weights_only=True)["ema"]
        network = cls()
        network.load_state_dict({k.removeprefix("together."): w for k, w in weights.items() if "together." in k})
        return network.eval()
