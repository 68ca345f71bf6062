# SPDX-License-Identifier: Apache-2.0
"""Networks by name, and checkpoints of training runs: write, read, and start another network from one.

A checkpoint is a dictionary that ``torch.save`` wrote:

* ``architecture`` and ``config``: the network's name and its constructor's arguments;
* ``ema``: the averaged weights, which are exported;
* ``network`` and ``optimizer``: the state of the run, if it is to continue;
* ``training_spp``, ``provenance``: for the exported model's contract.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from oiio_msspl.exr.atomic import replacing
from research.training.joint import JointFusion
from research.training.paper import MultiResolutionFusion

State = dict[str, Any]
Network = MultiResolutionFusion | JointFusion
NETWORKS: dict[str, type[Network]] = {"paper": MultiResolutionFusion, "joint": JointFusion}
log = logging.getLogger(__name__)

#: Parts of a checkpoint that only a continued run needs.
RUN_STATE = ("network", "optimizer", "best_psnr")
#: Parts of a parameter's name that older checkpoints have, and what they are called now.
RENAMED = {"together.": "mean_denoiser.", ".more": ".extra"}


def run(network: Network, lrhs: Tensor, hrls: Tensor) -> tuple[Tensor, Tensor | None]:
    """Run a network; return the fused image and the logarithm of its expected error, None if it predicts none."""
    result = network(lrhs, hrls)
    return result if isinstance(result, tuple) else (result, None)


def save(state: State | list[Any], path: Path) -> None:
    """Write a file whole or not at all, because a run may be killed at any time."""
    with replacing(path, overwrite=True) as temporary:
        torch.save(state, temporary)


def read(path: Path) -> State:
    """Read a checkpoint; parameters get their present names."""
    state = torch.load(path, map_location="cpu", weights_only=True)
    for key in state.keys() & {"ema", "network"}:
        for old, new in RENAMED.items():
            state[key] = {name.replace(old, new): value for name, value in state[key].items()}
    return state


def finished(state: State) -> State:
    """Return a checkpoint without what only a continued run needs."""
    return {key: value for key, value in state.items() if key not in RUN_STATE}


def load(path: Path) -> tuple[Network, State]:
    """Return the network of a checkpoint with its averaged weights, and the whole checkpoint."""
    state = read(path)
    network = NETWORKS[state["architecture"]](**state["config"])
    network.load_state_dict(state["ema"])
    return network.eval(), state


def load_joint(path: Path) -> tuple[JointFusion, State]:
    """Return the joint network of a checkpoint with its averaged weights, and the whole checkpoint.

    Raises:
        SystemExit: the checkpoint is of another network.
    """
    network, state = load(path)
    if not isinstance(network, JointFusion):
        raise SystemExit(f"{path}: not a joint network")
    return network, state


def warm_start(network: Network, path: Path) -> None:
    """Copy the averaged weights of another run that fit: all scales share the trunk, and stages by position.

    Stages that the other network lacks start as resampling of their features. So the paper's network for a larger scale
    starts as the one for the smaller scale followed by bilinear upsampling.
    """
    if isinstance(network, MultiResolutionFusion):
        for deshuffle, shuffle in zip(network.deshuffle, network.upscale, strict=True):
            deshuffle.reset_to_average()
            shuffle.reset_to_bilinear(network.config["channels"])
    theirs, ours = read(path)["ema"], network.state_dict()
    fitting = {name: value for name, value in theirs.items() if name in ours and ours[name].shape == value.shape}
    network.load_state_dict(ours | fitting)
    log.info("took %d of %d tensors from %s", len(fitting), len(ours), path)
