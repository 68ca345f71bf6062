# SPDX-License-Identifier: Apache-2.0
"""Train the prediction of a joint network's own error.

    python -m research.training.error AVERAGE.pt JOINT.pt --data VIEWS

Only the convolution that predicts the error is trained, for some hundred batches; the rest of the network is final.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch.optim.lr_scheduler import LambdaLR

from research.training import checkpoints, data, losses
from research.training.denoisers import with_denoised_mean
from research.training.export import denoiser_for
from research.training.joint import JointFusion
from research.training.render_mean import with_mean
from research.training.train import lr_factor

PATCH, BATCH, LEARNING_RATE = 256, 3, 2e-3


def fit(network: JointFusion, views: Path, scales: list[int], prepare: data.Prepare, steps: int) -> float:
    """Train the prediction in place; return the mean loss of the last tenth of the steps."""
    network.requires_grad_(False)
    network.error.requires_grad_(True)
    optimizer = torch.optim.Adam(network.error.parameters(), lr=LEARNING_RATE)
    schedule = LambdaLR(optimizer, lambda step: lr_factor(step / steps))
    batches = data.Batches(views, scales, PATCH, BATCH, prepare)
    last = []
    for step, pair in zip(range(steps), batches, strict=False):
        with torch.autocast("cpu", torch.bfloat16):
            output, log_error = network(pair["lrhs"], network.prepared(pair["hrls"]))
        loss = losses.error_likelihood(log_error, output.float(), pair["target"])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step >= 0.9 * steps:
            last.append(float(loss.detach()))
    return float(np.mean(last))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("output", type=Path, help="checkpoint to write")
    parser.add_argument("--data", type=Path, required=True, help="folder of views")
    parser.add_argument("--steps", type=int, default=400, help="(default: %(default)s)")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads (default: %(default)s)")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    network, state = checkpoints.load_joint(args.checkpoint)
    network.reset_error()
    scales = [int(scale) for scale in state["training_spp"]]
    prepare: data.Prepare = with_mean
    if network.mean_denoiser is None:
        prepare = partial(with_denoised_mean, denoiser_for(network, network.denoiser(scales[0])))
    loss = fit(network, args.data, scales, prepare, args.steps)
    # In the precision of the checkpoint: research.training.average stores half floats
    state["ema"] = {name: values.to(state["ema"][name].dtype) for name, values in network.state_dict().items()}
    state["provenance"]["error_steps"] = args.steps
    checkpoints.save(state, args.output)
    print(f"{args.steps} steps, loss {loss:.3f}")


if __name__ == "__main__":
    main()
