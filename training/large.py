# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise's large network as a part of the ``ensemble`` models, and its training.

    python -m training.large POOL training/checkpoints/joint_spread.pt training/checkpoints/ensemble_spread.pt

Open Image Denoise (OIDN) denoises the HRLS with an albedo and a normal that are denoised before. For renders whose
pixel filter has spread the noise, it must learn that noise first. There it also reads the result of ``joint``, so it
knows what both renders show. Training needs a GPU, and the pairs of :mod:`training.pool`.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from training import checkpoints, losses
from training.data import Batch
from training.encoding import log_to_pu, pu_to_log
from training.joint import JointFusion
from training.layer_denoisers import LayerDenoisers, untouched
from training.oidn import LARGE, LARGE_HDR, FineTunedUNet, Start
from training.pool import PooledBatches
from training.train import lr_factor, warming_ema

BATCH, PATCH, LEARNING_RATE, DECAY = 8, 256, 1e-3, 1e-4
#: Share of the learning rate for OIDN's own weights.
FINE_TUNE = 0.1
#: Steps between two lines of the log.
REPORT = 250


class LargeDenoiser(FineTunedUNet):
    """OIDN's large network.

    Args:
        reads_joint: it is fine-tuned, and reads the result of ``joint`` after its own input; otherwise it is OIDN's.
    """

    def __init__(self, *, reads_joint: bool = False) -> None:
        self.reads_joint = reads_joint
        readers = "enc_conv1a", "dec_conv1a"
        super().__init__(Start(LARGE_HDR, LARGE, readers, 3) if reads_joint else untouched(LARGE_HDR, LARGE))

    def forward(self, samples: Tensor, albedo: Tensor, normal: Tensor, joint: Tensor) -> Tensor:
        """
        Args:
            samples: (N, 3, H, W), the HRLS's colour, log-encoded.
            albedo, normal: (N, 3, H, W) in [0, 1], denoised.
            joint: (N, 3, H, W), the result of ``joint``, log-encoded.

        Returns:
            The denoised colour (N, 3, H, W), log-encoded.
        """
        images = [log_to_pu(samples), albedo, normal, *([log_to_pu(joint)] if self.reads_joint else [])]
        return pu_to_log(self.run(torch.cat(images, dim=1)).clamp(0, 1))


class Training:
    """Trains the large network of an ensemble with a finished ``joint``."""

    def __init__(self, joint: JointFusion, device: torch.device) -> None:
        self.device, self.steps = device, 0
        networks = joint.requires_grad_(False), LayerDenoisers(), LargeDenoiser(reads_joint=True)
        self.joint, self.layers, self.large = (each.to(device, memory_format=torch.channels_last) for each in networks)
        learnt = [p for conv in self.large.convs.values() for p in conv.differences()]
        known = {id(p) for p in learnt}
        new = [p for p in self.large.parameters() if id(p) not in known]
        groups = [{"params": new}, {"params": learnt, "lr": LEARNING_RATE * FINE_TUNE}]
        self.optimizer = torch.optim.AdamW(groups, lr=LEARNING_RATE, weight_decay=DECAY, eps=1e-6)
        self.average = copy.deepcopy(self.large).requires_grad_(False)

    def step(self, batch: Batch) -> float:
        """Train on a batch; return its loss."""
        hrls = batch["hrls"]
        with torch.no_grad(), torch.autocast(self.device.type, torch.bfloat16):
            joint, _ = self.joint(batch["lrhs"], hrls)
            albedo, normal = self.layers(hrls[:, 3:6], hrls[:, 6:9])
        with torch.autocast(self.device.type, torch.bfloat16):
            output = self.large(hrls[:, :3], albedo, normal, joint)
        loss = losses.relative(output.float(), batch["target"])
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if bool(torch.isfinite(nn.utils.clip_grad_norm_(self.large.parameters(), 1.0))):
            self.optimizer.step()
            self.steps += 1
            warming_ema(list(self.average.parameters()), list(self.large.parameters()), self.steps)
        return float(loss.detach())

    def run(self, batches: Iterator[Batch], minutes: float) -> None:
        """Train for some minutes; print the mean loss from time to time."""
        started, peaks, total = time.monotonic(), [group["lr"] for group in self.optimizer.param_groups], 0.0
        for taken, batch in enumerate(batches, start=1):
            progress = (time.monotonic() - started) / (60 * minutes)
            if progress >= 1:
                return
            for group, peak in zip(self.optimizer.param_groups, peaks, strict=True):
                group["lr"] = peak * lr_factor(progress)
            total += self.step(batch)
            if taken % REPORT == 0:
                print(f"step {taken}, {progress:.0%}: {total / REPORT:.4f}", flush=True)
                total = 0.0

    def state(self, provenance: dict[str, Any]) -> dict[str, Any]:
        """What is stored: the moving average, in half floats."""
        weights = {name: values.half().cpu() for name, values in self.average.state_dict().items()}
        return {"large": weights, "steps": self.steps, "batch": BATCH, "patch": PATCH} | provenance


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pool", type=Path, help="folder of pairs that training.pool has drawn")
    parser.add_argument("joint", type=Path, help="checkpoint of the finished joint network")
    parser.add_argument("out", type=Path, help="checkpoint to write")
    parser.add_argument("--minutes", type=float, default=5, help="(default: %(default)s)")
    parser.add_argument("--scale", type=int, nargs="+", default=(2, 4, 2, 4, 8), help="drawn from these (2 4 2 4 8)")
    parser.add_argument("--device", default="cuda")
    args = parser.parse_args()
    torch.manual_seed(0)
    joint, _ = checkpoints.load(args.joint)
    if not isinstance(joint, JointFusion):
        raise SystemExit(f"{args.joint}: not a joint network")
    device = torch.device(args.device)
    training = Training(joint, device)
    batches = PooledBatches(args.pool, tuple(args.scale), PATCH, BATCH, 0, device)
    training.run(batches.loader(), args.minutes)
    pairs = sum(map(len, batches.pairs.values()))
    checkpoints.save(training.state({"minutes": args.minutes, "pairs": pairs}), args.out)


if __name__ == "__main__":
    main()
