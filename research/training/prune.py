# SPDX-License-Identifier: Apache-2.0
"""Prune output channels of a joint network's convolutions that matter least to the next convolution.

    python -m research.training.prune RUN/checkpoint.pt PRUNED.pt --data VIEWS --keep dec_conv1a=48 dec_conv2b=48

A pruned channel is replaced by its mean, which goes into the next bias. Training on from PRUNED.pt recovers the rest.
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import torch
from torch import Tensor, nn

from research.training import checkpoints, data
from research.training.joint import DECODED, PREDECESSOR, JointFusion
from research.training.oidn import FineTunedConv
from research.training.render_mean import with_mean

PAIRS, PATCH = 24, 256


def statistics(network: JointFusion, name: str, pairs: list[data.Batch]) -> tuple[Tensor, Tensor]:
    """Return the mean and variance of each output channel of a convolution, (C,) each."""
    outputs: list[Tensor] = []
    hook = network.convs[name].register_forward_hook(
        lambda _, __, out: outputs.append(out.relu().transpose(0, 1).flatten(1))
    )
    with torch.inference_mode():
        for pair in pairs:
            network(pair["lrhs"], pair["hrls"])
    hook.remove()
    values = torch.cat(outputs, dim=1)
    return values.mean(dim=1).clone(), values.var(dim=1).clone()


@torch.no_grad()
def pruned(network: JointFusion, name: str, count: int, pairs: list[data.Batch]) -> JointFusion:
    """Return a copy that keeps the ``count`` most important output channels of a convolution.

    The importance of a channel is its variance times the power of the weights that read it.
    """
    if name not in PREDECESSOR.values():
        prunable = ", ".join(PREDECESSOR.values())
        raise SystemExit(f"--keep {name}: only convolutions on the way up can be pruned: {prunable}")
    following = network.convs[next(n for n, before in PREDECESSOR.items() if before == name)]
    heads = zip((*network.heads, network.error), (*DECODED, DECODED[1]), strict=True)
    readers: list[FineTunedConv | nn.Conv2d] = [following, *(head for head, source in heads if source == name)]
    mean, variance = statistics(network, name, pairs)
    weight, _ = following.total()
    importance = variance * weight[:, : len(variance)].square().sum(dim=(0, 2, 3))
    kept = importance.argsort(descending=True)[:count].sort().values
    removed = torch.tensor(sorted(set(range(len(mean))) - set(kept.tolist())))
    rows, _ = network.pretrained_channels(name)
    result = JointFusion(network.kept | {name: [rows[i] for i in kept]}, network.size, spread=network.spread)
    weights = network.state_dict()
    prefixes = {id(module): prefix for prefix, module in network.named_modules()}
    for kind in ("weight", "bias", "extra"):
        if (key := f"convs.{name}.{kind}") in weights:
            weights[key] = weights[key][kept]
    for reader in readers:
        prefix = prefixes[id(reader)]
        whole = reader.total()[0] if isinstance(reader, FineTunedConv) else reader.weight
        weights[f"{prefix}.bias"] = weights[f"{prefix}.bias"] + whole[:, removed].sum(dim=(2, 3)) @ mean[removed]
        rest = range(len(mean), weights[f"{prefix}.weight"].shape[1])
        weights[f"{prefix}.weight"] = weights[f"{prefix}.weight"][:, [*kept, *rest]]
    result.load_state_dict(weights)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("output", type=Path, help="checkpoint to write")
    parser.add_argument("--data", type=Path, required=True, help="folder of views")
    parser.add_argument("--keep", nargs="+", required=True, metavar="NAME=COUNT", help="best multiples of 16")
    args = parser.parse_args()
    network, state = checkpoints.load_joint(args.checkpoint)
    if network.size == "large":
        raise SystemExit(f"{args.checkpoint}: not a joint network of the size usual or small")
    pairs = list(itertools.islice(data.Batches(args.data, [2], PATCH, 1, with_mean), PAIRS))
    for name, _, count in (part.partition("=") for part in args.keep):
        network = pruned(network, name, int(count), pairs)
    state |= {"ema": network.state_dict(), "config": network.config}
    checkpoints.save(checkpoints.finished(state), args.output)


if __name__ == "__main__":
    main()
