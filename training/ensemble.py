# SPDX-License-Identifier: Apache-2.0
"""The ``ensemble`` models: ``joint``, Open Image Denoise's large network, and a network that weighs their results.

    python -m training.quantise.ensemble VIEWS --out RUN
    python -m training.ensemble RUN --steps 2000
    python -m training.quantise.ensemble VIEWS --out RUN --export

Open Image Denoise (OIDN) denoises the HRLS as its documentation recommends: base networks denoise albedo and normal,
and the large network denoises the colour with them. Its result and that of ``joint`` err in different places, so a
weighted mean has a smaller error than either. Only the weights are learnt here. The first command writes the two
results for many training pairs, from the 8-bit networks that ship; the second trains on them.

``ensemble-spread`` is the plain mean of ``joint-spread`` and of a large network that reads its result, see
:mod:`training.large`.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.optim.lr_scheduler import LambdaLR

from oiio_msspl.metrics import psnr, relmse
from training import losses
from training.data import turned
from training.encoding import log_decode
from training.joint import JointFusion, within_renders
from training.large import LargeDenoiser, LayerDenoisers
from training.ops import box_downsample, conv3x3, log2_scale, upsample
from training.paper import LRHS_CHANNELS
from training.train import lr_factor, warming_ema

#: Images that the network reads at H: the results of ``joint`` and of OIDN's large network, the HRLS's colour, all
#: log-encoded; and the denoised albedo and normal in [0, 1].
IMAGES = ("joint", "large", "samples", "albedo", "normal")
#: Widths of the network's levels, from H/2 on.
WIDTHS = (32, 48, 64, 64)
#: Each band of the pictures has a weight: details below 4 pixels, below 16 pixels, and the rest.
BANDS = (4, 16)
#: A result is at least the darker of the two times the first, and at most the brighter one times the second,
#: log-encoded: a band of one may hold more than all of the other.
AGREED = (0.8, 1.25)
#: Largest change of the logarithm of the error that ``joint`` expects.
MAX_CHANGE = 2.0
#: Share of the expected error's likelihood in the loss. Its gradient does not reach the other layers.
ERROR_SHARE = 0.02

BATCH, LEARNING_RATE, DECAY = 4, 2e-3, 1e-4
#: Steps between two lines of the log.
REPORT = 250


class BandWeights(nn.Module):
    """A U-Net that weighs the results of ``joint`` and of OIDN's large network, in three bands of each pixel.

    Weights lie in [0, 1] and start at one half. The result stays near the range of the two (``AGREED``), and is clamped
    to that of ``joint``, see :func:`training.joint.within_renders`. Sizes are multiples of ``multiple`` HRLS pixels.
    """

    multiple = 16

    def __init__(self) -> None:
        super().__init__()
        first, second, third, last = WIDTHS
        self.enter = conv3x3(4 * 3 * len(IMAGES) + 2 * LRHS_CHANNELS, first)
        self.down = nn.ModuleList(conv3x3(a, b) for a, b in itertools.pairwise((first, *WIDTHS)))
        self.up = nn.ModuleList([conv3x3(last + third, third), conv3x3(third + second, second)])
        self.leave = conv3x3(second + first, first)
        self.weights = conv3x3(first, 4 * (len(BANDS) + 1))
        self.error = conv3x3(first, 4)
        for head in (self.weights, self.error):
            nn.init.zeros_(head.weight)
            nn.init.zeros_(head.bias)

    def forward(
        self,
        joint: Tensor,
        large: Tensor,
        albedo: Tensor,
        normal: Tensor,
        lrhs: Tensor,
        hrls: Tensor,
        joint_error: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """
        Args:
            joint, large: (N, 3, s*h, s*w), log-encoded: the two results.
            albedo, normal: (N, 3, s*h, s*w) in [0, 1], denoised.
            lrhs, hrls: inputs of ``joint``, see :meth:`training.joint.JointFusion.fuse`.
            joint_error: (N, 1, s*h, s*w), the logarithm of the expected error of ``joint``.

        Returns:
            The weighted mean, and the logarithm of its expected error, as :meth:`training.joint.JointFusion.fuse`.
        """
        samples = hrls[:, :3]
        full = F.pixel_unshuffle(torch.cat([joint, large, samples, albedo, normal], dim=1), 2)
        values = torch.cat([full, upsample(lrhs, 2 ** (log2_scale(lrhs, hrls) - 1))], dim=1)
        values = F.relu(self.enter(values.to(self.enter.weight.dtype)))
        skipped = []
        for level, conv in enumerate(self.down):
            if level:
                skipped.append(values)
                values = F.max_pool2d(values, 2)
            values = F.relu(conv(values))
        for conv in (*self.up, self.leave):
            values = F.relu(conv(torch.cat([upsample(values, 2), skipped.pop()], dim=1)))
        logits = F.pixel_shuffle(self.weights(values), 2).float()
        change = F.pixel_shuffle(self.error(values.detach()), 2).float()
        log_error = joint_error + change.clamp(-MAX_CHANGE, MAX_CHANGE)

        difference = large - joint
        coarse = [upsample(box_downsample(difference, size), size, "bilinear") for size in BANDS]
        bands = [a - b for a, b in itertools.pairwise([difference, *coarse])] + coarse[-1:]
        fused = joint
        for band, weight in zip(bands, torch.sigmoid(logits).split(1, dim=1), strict=True):
            fused = fused + weight * band
        fused = torch.clamp(fused, AGREED[0] * torch.minimum(joint, large), AGREED[1] * torch.maximum(joint, large))
        return within_renders(fused, lrhs, samples), log_error


class PlainMean(nn.Module):
    """The mean of the two results, within the range of the renders; its arguments are those of :class:`BandWeights`."""

    def forward(
        self,
        joint: Tensor,
        large: Tensor,
        albedo: Tensor,
        normal: Tensor,
        lrhs: Tensor,
        hrls: Tensor,
        joint_error: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """See :meth:`BandWeights.forward`."""
        return within_renders(0.5 * (joint + large), lrhs, hrls[:, :3]), joint_error


class EnsembleFusion(nn.Module):
    """The whole model, as the files for GPUs compute it.

    Args:
        joint: a finished network; only its part after the denoiser runs.
        large: denoises the HRLS.
        weights: of the two results, a :class:`BandWeights` or a :class:`PlainMean`.
    """

    def __init__(self, joint: JointFusion, large: LargeDenoiser, weights: nn.Module) -> None:
        super().__init__()
        self.joint, self.large, self.weights = joint, large, weights
        self.layers = LayerDenoisers()

    def forward(self, lrhs: Tensor, hrls: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """See :meth:`training.joint.JointFusion.fuse`. Also returns the denoised albedo and normal, in [0, 1]."""
        joint, error = self.joint.fuse(lrhs, hrls)
        albedo, normal = self.layers(hrls[:, 3:6], hrls[:, 6:9])
        large = self.large(hrls[:, :3], albedo, normal, joint)
        return *self.weights(joint, large, albedo, normal, lrhs, hrls, error), albedo, normal


def load(path: Path, joint: JointFusion) -> tuple[EnsembleFusion, dict[str, Any]]:
    """The ensemble of a checkpoint with its ``joint``, and how it was trained.

    A checkpoint of :func:`main` has the weights of the results; one of :mod:`training.large` the large network.
    """
    stored = torch.load(path, map_location="cpu", weights_only=True)
    large, weights = LargeDenoiser(reads_joint="large" in stored), BandWeights()
    learnt: nn.Module = large if large.reads_joint else weights
    state = stored.pop("large" if large.reads_joint else "network")
    learnt.load_state_dict({name: values.float() for name, values in state.items()})
    network = EnsembleFusion(joint, large, PlainMean() if large.reads_joint else weights)
    return network.requires_grad_(False).eval(), stored


# Training

Pair = dict[str, Tensor]


def batches(files: Sequence[Path], rng: np.random.Generator) -> Iterator[Pair]:
    """Endless random batches of stored pairs of one scale, mirrored and transposed at random."""
    by_scale: dict[str, list[Path]] = {}
    for file in files:
        by_scale.setdefault(file.stem.split("-")[0], []).append(file)
    names = sorted(by_scale)
    shares = np.array([len(by_scale[name]) for name in names], float)
    while True:
        chosen = by_scale[names[rng.choice(len(names), p=shares / shares.sum())]]
        pairs = [read_pair(chosen[i]) for i in rng.integers(len(chosen), size=BATCH)]
        batch = turned({name: torch.cat([pair[name] for pair in pairs]) for name in pairs[0]}, rng)
        order = torch.from_numpy(rng.permutation(3)) if rng.random() < 0.5 else torch.arange(3)
        for name in batch.keys() - {"joint_error", "normal"}:
            permuted = torch.cat([part[:, order] for part in batch[name].split(3, dim=1)], dim=1)
            batch[name] = permuted.contiguous(memory_format=torch.channels_last)
        yield batch


def read_pair(file: Path) -> Pair:
    """A stored pair: the arguments of :meth:`BandWeights.forward`, and ``target``."""
    with np.load(file) as stored:
        return {name: torch.from_numpy(stored[name].astype(np.float32)) for name in stored.files}


@torch.inference_mode()
def evaluate(network: BandWeights | None, files: Sequence[Path]) -> dict[str, float]:
    """Mean PSNR and RelMSE of stored pairs; of the plain mean of the two results for no network."""
    network = network or BandWeights()
    scores = []
    for file in files:
        pair = read_pair(file)
        target = pair.pop("target")
        output, reference = (log_decode(image)[0].permute(1, 2, 0).numpy() for image in (network(**pair)[0], target))
        scores.append((psnr(output, reference), relmse(output, reference)))
    mean = np.mean(scores, axis=0)
    return {"psnr": float(mean[0]), "relmse": float(mean[1])}


def train(files: Sequence[Path], held_out: Sequence[Path], steps: int, *, seed: int = 0) -> BandWeights:
    """Train the weights; return their moving average."""
    torch.manual_seed(seed)
    network, average = BandWeights(), BandWeights()
    network = network.to(memory_format=torch.channels_last)
    average.load_state_dict(network.state_dict())
    optimizer = torch.optim.AdamW(network.parameters(), lr=LEARNING_RATE, weight_decay=DECAY)
    schedule = LambdaLR(optimizer, lambda step: lr_factor(step / steps))
    print(f"plain mean: {evaluate(None, held_out)}", flush=True)
    for step, batch in enumerate(islice(batches(files, np.random.default_rng(seed)), steps), start=1):
        target = batch.pop("target")
        output, log_error = network(**batch)
        error = losses.error_likelihood(log_error, output.detach(), target)
        loss = losses.relative(output, target) + ERROR_SHARE * error
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        warming_ema(list(average.parameters()), list(network.parameters()), step)
        if step % REPORT == 0 or step == steps:
            print(f"step {step}, loss {float(loss.detach()):.4f}: {evaluate(average, held_out)}", flush=True)
    return average.requires_grad_(False).eval()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder with the folders train and validation of stored pairs")
    parser.add_argument("--steps", type=int, default=2000, help="(default: %(default)s)")
    args = parser.parse_args()
    files, held_out = (sorted((args.run / split).glob("x*[0-9].npz")) for split in ("train", "validation"))
    network = train(files, held_out, args.steps)
    state = {name: values.half() for name, values in network.state_dict().items()}
    torch.save({"network": state, "steps": args.steps, "pairs": len(files)}, args.run / "weights.pt")


if __name__ == "__main__":
    main()
