# SPDX-License-Identifier: Apache-2.0
"""The networks by name, as ``--network`` and checkpoints name them, and one way to run any of them."""

from __future__ import annotations

from torch import Tensor

from oiio_msspl.denoiser import Denoiser
from training.data import Prepare
from training.joint import JointFusion, with_mean
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

#: What is done for them when they run, see :func:`oiio_msspl.denoiser.for_model`.
DENOISERS = {"mix": "high", "joint": "together"}


def preparation(architecture: str, threads: int) -> Prepare | None:
    """How pairs are prepared for a network by this name, on so many threads; None: they are read as they are."""
    if architecture == "joint":
        return with_mean
    return Denoiser(threads) if architecture == "mix" else None


def run(network: Network, lrhs: Tensor, hrls: Tensor) -> tuple[Tensor, Tensor | None]:
    """The fused image and, from a network that predicts it, the logarithm of its error: what ``forward`` returns."""
    result = network(lrhs, hrls)
    return result if isinstance(result, tuple) else (result, None)
