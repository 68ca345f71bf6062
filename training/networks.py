# SPDX-License-Identifier: Apache-2.0
"""The networks by name, as ``--network`` and checkpoints name them, and one way to run any of them."""

from __future__ import annotations

from torch import Tensor

from training.joint import JointFusion
from training.mix import MixFusion
from training.paper import MultiResolutionFusion
from training.pyramid import PyramidFusion

Network = MultiResolutionFusion | PyramidFusion | MixFusion | JointFusion
NETWORKS: dict[str, type[MultiResolutionFusion] | type[PyramidFusion] | type[MixFusion] | type[JointFusion]] = {
    "paper": MultiResolutionFusion,
    "pyramid": PyramidFusion,
    "mix": MixFusion,
    "joint": JointFusion,
}

#: What Open Image Denoise does for those that read its results, see :data:`oiio_msspl.denoiser.MODES`.
DENOISERS = {"mix": "high", "joint": "together"}


def run(network: Network, lrhs: Tensor, hrls: Tensor) -> tuple[Tensor, Tensor | None]:
    """The fused image and, from a network that predicts it, the logarithm of its error: what ``forward`` returns."""
    result = network(lrhs, hrls)
    return result if isinstance(result, tuple) else (result, None)
