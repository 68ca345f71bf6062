# SPDX-License-Identifier: Apache-2.0
"""The networks by name, as ``--network`` and checkpoints name them."""

from __future__ import annotations

from training.paper import MultiResolutionFusion
from training.pyramid import PyramidFusion

Network = MultiResolutionFusion | PyramidFusion
NETWORKS: dict[str, type[MultiResolutionFusion] | type[PyramidFusion]] = {
    "paper": MultiResolutionFusion,
    "pyramid": PyramidFusion,
}
