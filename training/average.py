# SPDX-License-Identifier: Apache-2.0
"""The mean of networks that went on from one another, as a checkpoint to export or to train on from.

    python -m training.average training/checkpoints/NEW.pt training/checkpoints/OLD.pt RUN/checkpoint.pt
    python -m training.average training/checkpoints/NEW.pt RUN/checkpoint.pt --kernels 1 3 3 3 3

    python -m training.average training/checkpoints/joint.pt RUN/checkpoint.pt --beginning 0.25 0.75

A pyramid's kernels are cut to ``--kernels``, or to those of the last one. Of a joint network, a share of the mean may
be what it begins as: Open Image Denoise, and the same choice everywhere of what to believe.

Between a network and what more training made of it lie others that have most of what either is better at (Wortsman et
al. 2022). The result is stored in half precision, and says of itself what the last one does.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch

from training.joint import JointFusion
from training.pyramid import LEVELS
from training.train import cut_kernels, save

#: What only the run itself needs.
OF_THE_RUN = ("network", "optimizer", "best_gain")


def mean(
    states: list[dict[str, Any]], kernels: list[int] | None = None, beginning: tuple[float, float] = (0, 0)
) -> dict[str, Any]:
    """A checkpoint with the mean of the averaged weights of several.

    Args:
        kernels: of a pyramid, by level; the last one's if None.
        beginning: of a joint network, shares of the mean that its beginning has: of itself, and of what denoises both
            renders together.

    Raises:
        SystemExit: they are of different networks.
    """
    last = states[-1]
    kernels = kernels or last["config"].get("own_size")
    for state in states:
        if kernels and "own_size" in state["config"]:
            cut_kernels(state["ema"], state["config"]["own_size"], kernels)
            state["config"]["own_size"] = kernels
    if any((state["config"], state["denoiser"]) != (last["config"], last["denoiser"]) for state in states):
        raise SystemExit("these checkpoints are of different networks")
    weights = {name: torch.stack([state["ema"][name].float() for state in states]).mean(dim=0) for name in last["ema"]}
    if any(beginning):
        if last["architecture"] != "joint":
            raise SystemExit("--beginning: only a joint network begins as something that is of use")
        for name, start in JointFusion(**last["config"]).beginning().items():
            weights[name] = torch.lerp(weights[name], start, beginning[name.startswith("together.")])
    kept = {name: value for name, value in last.items() if name not in OF_THE_RUN}
    if len(states) > 1:
        kept["provenance"] = last["provenance"] | {"mean_of": [state["provenance"] for state in states]}
    if any(beginning):
        kept["provenance"] = kept["provenance"] | {"share_of_beginning": list(beginning)}
    return kept | {"ema": {name: value.half() for name, value in weights.items()}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("checkpoints", type=Path, nargs="+")
    parser.add_argument("--kernels", type=int, nargs=LEVELS, metavar="TAPS", help="as of training.train")
    parser.add_argument(
        "--beginning",
        type=float,
        nargs=2,
        default=(0, 0),
        metavar="SHARE",
        help="of a joint network: of itself, and of what denoises both renders together",
    )
    args = parser.parse_args()
    states = [torch.load(path, map_location="cpu", weights_only=True) for path in args.checkpoints]
    save(mean(states, args.kernels, tuple(args.beginning)), args.out)


if __name__ == "__main__":
    main()
