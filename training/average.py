# SPDX-License-Identifier: Apache-2.0
"""The mean of networks that went on from one another, as a checkpoint to export or to train on from.

    python -m training.average training/checkpoints/NEW.pt training/checkpoints/OLD.pt RUN/checkpoint.pt

Where kernels of the last one have fewer taps, the others' are cut to them.

Between a network and what more training made of it lie others that have most of what either is better at (Wortsman et
al. 2022). The result is stored in half precision, and says of itself what the last one does.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch

from training.train import cut_kernels, save

#: What only the run itself needs.
OF_THE_RUN = ("network", "optimizer", "best_gain")


def mean(states: list[dict[str, Any]]) -> dict[str, Any]:
    """A checkpoint with the mean of the averaged weights of several.

    Raises:
        SystemExit: they are of different networks.
    """
    last = states[-1]
    for state in states[:-1]:
        if "own_size" in last["config"] and state["config"].keys() == last["config"].keys():
            cut_kernels(state["ema"], state["config"]["own_size"], last["config"]["own_size"])
            state["config"]["own_size"] = last["config"]["own_size"]
    if any((state["config"], state["denoiser"]) != (last["config"], last["denoiser"]) for state in states):
        raise SystemExit("these checkpoints are of different networks")
    weights = {name: torch.stack([state["ema"][name].float() for state in states]).mean(dim=0) for name in last["ema"]}
    kept = {name: value for name, value in last.items() if name not in OF_THE_RUN}
    provenance = last["provenance"] | {"mean_of": [state["provenance"] for state in states]}
    return kept | {"ema": {name: value.half() for name, value in weights.items()}, "provenance": provenance}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("checkpoints", type=Path, nargs="+")
    args = parser.parse_args()
    save(mean([torch.load(path, map_location="cpu", weights_only=True) for path in args.checkpoints]), args.out)


if __name__ == "__main__":
    main()
