# SPDX-License-Identifier: Apache-2.0
"""Average the weights of several checkpoints of one network; the result can be exported or trained further.

    python -m research.training.average NEW.pt OLD.pt RUN/final.pt --shares 0.65 0.35
    python -m research.training.average NEW.pt RUN/final.pt --initial 0.25 0.75

The mean of a network and of its continuation by further training often keeps the strengths of both (Wortsman et al.
2022). The mean of a joint network may include its initial state, which is Open Image Denoise with constant logits:
``--initial`` gives its shares in the network and in the denoiser of both renders' mean. The result is stored in half
precision, with the provenance of the last checkpoint.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from research.training import checkpoints
from research.training.checkpoints import State
from research.training.joint import JointFusion


def mean(states: list[State], shares: Sequence[float] = (), initial: tuple[float, float] = (0, 0)) -> State:
    """Return a checkpoint with the mean of the averaged weights of several.

    Networks for independent noise and for spread noise can be averaged; the last one says which kind the result is for.

    Args:
        shares: of each checkpoint; their sum is 1. By default, all are equal.
        initial: shares of a joint network's initial state: of the network, and of its denoiser of both renders' mean.

    Raises:
        SystemExit: the checkpoints are of different networks, or the shares do not fit them.
    """
    last = states[-1]
    if any(_network(state) != _network(last) for state in states):
        raise SystemExit("these checkpoints are of different networks")
    if any(initial) and last["architecture"] != "joint":
        raise SystemExit("--initial: only a joint network has an initial state worth averaging with")
    shares = shares or [1 / len(states)] * len(states)
    if len(shares) != len(states) or not math.isclose(sum(shares), 1):
        raise SystemExit("--shares: one for each checkpoint, with a sum of 1")
    weights = {
        name: sum(share * state["ema"][name].float() for share, state in zip(shares, states, strict=True))
        for name in last["ema"]
    }
    if any(initial):
        for name, start in JointFusion(**last["config"]).initial_state().items():
            weights[name] = torch.lerp(weights[name], start, initial[name.startswith("mean_denoiser.")])
    result = checkpoints.finished(last)
    if len(states) > 1:
        parts = [{"share": share, **state["provenance"]} for share, state in zip(shares, states, strict=True)]
        result["provenance"] = last["provenance"] | {"mean_of": parts}
    if any(initial):
        result["provenance"] = result["provenance"] | {"share_of_initial_state": list(initial)}
    return result | {"ema": {name: value.half() for name, value in weights.items()}}


def _network(state: State) -> tuple[str, dict[str, Any]]:
    return state["architecture"], state["config"] | {"spread": None}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="checkpoint to write")
    parser.add_argument("checkpoints", type=Path, nargs="+", help="checkpoints to average")
    shares, initial = "share of each checkpoint (default: equal)", "joint: shares of the initial state, see above"
    parser.add_argument("--shares", type=float, nargs="+", default=(), metavar="SHARE", help=shares)
    parser.add_argument("--initial", type=float, nargs=2, default=(0, 0), metavar="SHARE", help=initial)
    args = parser.parse_args()
    states = [checkpoints.read(path) for path in args.checkpoints]
    checkpoints.save(mean(states, args.shares, tuple(args.initial)), args.out)


if __name__ == "__main__":
    main()
