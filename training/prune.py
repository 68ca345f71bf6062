# SPDX-License-Identifier: Apache-2.0
"""Leave out outputs of a joint network's convolutions that the next one hardly needs.

    python -m training.prune RUN/checkpoint.pt PRUNED.pt --data VIEWS --keep dec_conv1a=48 dec_conv2b=48

What is left out counts as its mean from then on. Training from PRUNED.pt makes good for the rest.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from datagen.views import Folder
from training import batches, data, export
from training.joint import BEFORE, DECODED, JointFusion, with_mean
from training.train import save
from training.unet import Retrained

PAIRS, PATCH = 24, 256


def statistics(network: JointFusion, name: str, pairs: list[batches.Batch]) -> tuple[Tensor, Tensor]:
    """Mean and variance of a convolution's outputs."""
    seen: list[Tensor] = []
    hook = network.convs[name].register_forward_hook(
        lambda _, __, out: seen.append(out.relu().transpose(0, 1).flatten(1))
    )
    with torch.inference_mode():
        for pair in pairs:
            network(pair["lrhs"], pair["hrls"])
    hook.remove()
    values = torch.cat(seen, dim=1)
    return values.mean(dim=1).clone(), values.var(dim=1).clone()


@torch.no_grad()
def without(network: JointFusion, name: str, count: int, pairs: list[batches.Batch]) -> JointFusion:
    """The same with so many of a convolution's outputs."""
    if name not in BEFORE.values():
        raise SystemExit(f"--keep {name}: only convolutions on the way up, {', '.join(BEFORE.values())}")
    readers: list[Retrained | nn.Conv2d] = [network.convs[next(n for n, before in BEFORE.items() if before == name)]]
    readers += [
        head
        for head, source in zip((*network.heads, network.error), (*DECODED, DECODED[1]), strict=True)
        if source == name
    ]
    mean, variance = statistics(network, name, pairs)
    weight, _ = readers[0].parameters_in_all()
    importance = variance * weight[:, : len(variance)].square().sum(dim=(0, 2, 3))
    stay = importance.argsort(descending=True)[:count].sort().values
    go = torch.tensor(sorted(set(range(len(mean))) - set(stay.tolist())))
    rows, _ = network.given_channels(name)
    result = JointFusion(network.kept | {name: [rows[i] for i in stay]})
    weights = network.state_dict()
    prefixes = {id(module): prefix for prefix, module in network.named_modules()}
    for kind in ("weight", "bias", "more"):
        if (key := f"convs.{name}.{kind}") in weights:
            weights[key] = weights[key][stay]
    for reader in readers:
        prefix = prefixes[id(reader)]
        whole = reader.parameters_in_all()[0] if isinstance(reader, Retrained) else reader.weight
        weights[f"{prefix}.bias"] = weights[f"{prefix}.bias"] + whole[:, go].sum(dim=(2, 3)) @ mean[go]
        rest = range(len(mean), weights[f"{prefix}.weight"].shape[1])
        weights[f"{prefix}.weight"] = weights[f"{prefix}.weight"][:, [*stay, *rest]]
    result.load_state_dict(weights)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--data", type=Path, required=True, help="folder of views")
    parser.add_argument("--keep", nargs="+", required=True, metavar="NAME=COUNT", help="multiples of 16 pay")
    args = parser.parse_args()
    network, state = export.load(args.checkpoint)
    if not isinstance(network, JointFusion):
        raise SystemExit(f"{args.checkpoint}: not a joint network")
    folder = [batches.Pixels.of(view, torch.device("cpu")) for view in Folder(args.data).split("train")]
    rng = np.random.default_rng(0)
    with torch.no_grad():
        pairs = [batches.draw(folder, 2, PATCH, 1, rng, data.Sampling(), with_mean) for _ in range(PAIRS)]
    for name, _, count in (part.partition("=") for part in args.keep):
        network = without(network, name, int(count), pairs)
    state["ema"] = network.state_dict()
    state["config"] = network.config
    save({key: value for key, value in state.items() if key not in ("network", "optimizer")}, args.output)


if __name__ == "__main__":
    main()
