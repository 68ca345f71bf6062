# SPDX-License-Identifier: Apache-2.0
"""Teach a trained network, of any family but the paper's, to predict its own error.

    python -m training.error RUN/best.pt --data VIEWS

Of finished weights, because they need nothing of it: only the last convolution learns, for some hundred batches as
training draws them, and the checkpoint is written again with it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from datagen.views import Folder
from training import batches, data, export, losses
from training.joint import JointFusion
from training.networks import preparation, run
from training.pyramid import Trunk
from training.train import lr_factor, save

PATCH, BATCH, LEARNING_RATE = 192, 4, 2e-3


def fit(
    network: Trunk | JointFusion,
    views: list[batches.Pixels],
    scales: list[int],
    prepare: data.Prepare | None,
    steps: int,
) -> float:
    """Train the prediction in place; return the mean of its loss over the last tenth of the steps."""
    network.requires_grad_(False)
    network.error.requires_grad_(True)
    optimizer = torch.optim.Adam(network.error.parameters())
    rng = np.random.default_rng(0)
    last = []
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = LEARNING_RATE * lr_factor(step / steps)
        with torch.no_grad():
            pair = batches.draw(views, int(rng.choice(scales)), PATCH, BATCH, rng, data.Sampling(), prepare)
        with torch.autocast("cpu", torch.bfloat16):
            output, log_error = run(network, pair["lrhs"], pair["hrls"])
        assert log_error is not None
        loss = losses.of_error(log_error, output.float(), pair["target"])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step >= 0.9 * steps:
            last.append(float(loss.detach()))
    return float(np.mean(last))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--data", type=Path, required=True, help="folder of views")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    network, state = export.load(args.checkpoint)
    if not isinstance(network, Trunk | JointFusion):
        raise SystemExit(f"{args.checkpoint}: the paper's network does not predict its error")
    views = [batches.Pixels.of(view, torch.device("cpu")) for view in Folder(args.data).split("train")]
    scales = [int(scale) for scale in state["training_spp"]]
    network.reset_error()
    loss = fit(network, views, scales, preparation(state["architecture"], args.threads), args.steps)
    state["ema"] = network.state_dict()
    state["provenance"]["error_steps"] = args.steps
    save(state, args.checkpoint)
    print(f"{args.steps} steps, loss {loss:.3f}")


if __name__ == "__main__":
    main()
