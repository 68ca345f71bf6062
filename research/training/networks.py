# SPDX-License-Identifier: Apache-2.0
"""All networks by the name that ``--network`` and checkpoints use, and one way to run any of them."""

from __future__ import annotations

from torch import Tensor

from oiio_msspl.model.contract import NO_DENOISER
from research.training.data import Prepare
from research.training.joint import JointFusion
from research.training.paper import MultiResolutionFusion
from research.training.render_mean import with_mean

Network = MultiResolutionFusion | JointFusion
NETWORKS: dict[str, type[MultiResolutionFusion] | type[JointFusion]] = {
    "paper": MultiResolutionFusion,
    "joint": JointFusion,
}


def denoiser_of(network: Network, scale: int) -> str:
    """Return the value of ``Contract.denoiser``: what denoises the mean of both renders before a network."""
    return network.denoiser(scale) if isinstance(network, JointFusion) else NO_DENOISER


def preparation(architecture: str) -> Prepare | None:
    """Return the function that adds a network's further input channels to a pair; None if it has none."""
    return with_mean if architecture == "joint" else None


def run(network: Network, lrhs: Tensor, hrls: Tensor) -> tuple[Tensor, Tensor | None]:
    """Run a network; return the fused image and the logarithm of its expected error, None if it predicts none."""
    result = network(lrhs, hrls)
    return result if isinstance(result, tuple) else (result, None)
