# SPDX-License-Identifier: Apache-2.0
"""Fixed pairs of validation views, and the scores of a network on them."""

from __future__ import annotations

import collections
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from oiio_msspl.image.metrics import psnr, relmse
from oiio_msspl.model.encoding import decode_radiance, encode_radiance, find_exposure
from research.datagen.views import Array, View, as_float32, mean_lrhs, read_hrls, split_features
from research.training.checkpoints import Network, run
from research.training.data import CPU, Prepare, to_tensor
from research.training.encoding import packed


@dataclass(frozen=True)
class ValidationPair:
    """The middle of a view with 1 spp in the HRLS and s^2 spp in the LRHS, the paper's (s^2 - 1)."""

    lrhs: Tensor
    """(1, 3, h, w), encoded, and the channels that ``prepare`` adds."""
    hrls: Tensor
    """(1, 16, s*h, s*w), encoded. One sample has no variance, so that is missing."""
    reference: Array
    """(s*h, s*w, 3), scene-linear."""
    exposure: float

    @classmethod
    def centre(cls, view: View, scale: int, patch: int, prepare: Prepare | None = None) -> ValidationPair:
        """Cut out the middle ``patch`` x ``patch`` pixels of a view."""
        height, width, _ = view.ref.shape
        top, left = (height - patch) // 2 // scale * scale, (width - patch) // 2 // scale * scale
        rows, columns = slice(top, top + patch), slice(left, left + patch)
        lrhs = mean_lrhs(view, [0], scale)
        exposure = find_exposure(lrhs)
        lrhs = lrhs[top // scale : (top + patch) // scale, left // scale : (left + patch) // scale]
        low = to_tensor(encode_radiance(lrhs, exposure)[None], CPU)
        high = to_tensor(packed(split_features(read_hrls(view, [0], rows, columns)[0]), exposure)[None], CPU)
        if prepare is not None:
            low = prepare(low, high)
        return cls(low, high, as_float32(view.ref[rows, columns]), exposure)


@torch.inference_mode()
def evaluate(network: Network, pairs: Iterable[ValidationPair], device: torch.device) -> dict[str, float]:
    """Return the mean sRGB PSNR and RelMSE of a network over all pairs, and the PSNR of each scale.

    Images are exposed as for the network, because views have any brightness.
    """
    scores: dict[str, list[float]] = collections.defaultdict(list)
    for pair in pairs:
        fused, _ = run(network, pair.lrhs.to(device), pair.hrls.to(device))
        output = decode_radiance(fused[0].permute(1, 2, 0).cpu().numpy(), pair.exposure) * pair.exposure
        reference = pair.reference * pair.exposure
        for name in ("psnr", f"psnr_x{pair.hrls.shape[-1] // pair.lrhs.shape[-1]}"):
            scores[name].append(psnr(output, reference))
        scores["relmse"].append(relmse(output, reference))
    return {name: float(np.mean(values)) for name, values in scores.items()}
