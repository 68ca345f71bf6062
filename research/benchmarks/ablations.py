# SPDX-License-Identifier: Apache-2.0
"""Repeat the paper's ablations at x4: the features that each branch reads, and the loss.

    python -m research.benchmarks.ablations VIEWS --table research/benchmarks/results/ablations.csv

As in the paper, the HRLS has 1 spp, the LRHS has far more (all ``lr`` passes of a view, 256 spp at x4), and the branch
that is not varied reads colour only. For every row a reduced network of the paper's architecture is trained from
scratch, for the same few steps on the same batches, and scored on the validation views. Rows can be compared with each
other, not with the shipped models. The LRHS's AOVs come from the ``hr`` passes that are not in the HRLS. Rows that the
table already has are kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR

from oiio_msspl.image.arrays import Array
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.image.metrics import psnr, relmse
from oiio_msspl.model.encoding import decode_radiance, encode_radiance, find_exposure
from research.benchmarks import results
from research.datagen.views import Folder, View, as_float32, mean_lrhs, read_hrls, split_features
from research.training import losses
from research.training.data import to_tensor
from research.training.encoding import log_decode, packed
from research.training.paper import HRLS_CHANNELS, MultiResolutionFusion

REDUCED = {"channels": 32, "growth": 16, "groups": 2, "blocks": 3}
SCALE, BATCH, PATCH, LEARNING_RATE = 4, 4, 96, 4e-4
#: Batches that are drawn. Every row trains on them repeatedly.
POOL = 400
#: The paper's upper bound of radiance.
CLIP = 100.0


#: A render's first channels, in the order of :data:`oiio_msspl.aovs.features.HRLS_FEATURES`.
COLOUR, ALL = 3, 15


@dataclass(frozen=True)
class Variant:
    """One row of the table."""

    name: str
    lrhs: int = COLOUR
    """How many of the first channels a branch reads."""
    hrls: int = COLOUR
    loss: Callable[[Tensor, Tensor], Tensor] = losses.l1


def _in_linear(loss: Callable[[Tensor, Tensor], Tensor]) -> Callable[[Tensor, Tensor], Tensor]:
    return lambda output, reference: loss(*(log_decode(values).clamp(0.0, CLIP) for values in (output, reference)))


VARIANTS = [
    Variant("both RGB, l1"),
    Variant("HRLS: none", hrls=0),
    Variant("HRLS: and diffuse, specular", hrls=ALL),
    Variant("LRHS: and diffuse, specular", lrhs=ALL),
    *(Variant(f"robust loss, beta {beta:g}", loss=partial(losses.robust, beta=beta)) for beta in (0.1, 1.0)),
    Variant("l1 of linear radiance", loss=_in_linear(losses.l1)),
    Variant("robust loss of linear radiance, beta 0.1", loss=_in_linear(losses.robust)),
]


def pair_of(view: View, top: int, left: int, patch: int, chosen: int) -> tuple[Array, Array, Array]:
    """Return a crop at ``top``, ``left`` whose HRLS is the ``hr`` pass ``chosen``.

    Returns:
        The LRHS (h, w, 16) and the HRLS (s h, s w, 16), encoded, with the channels of
        :data:`oiio_msspl.aovs.features.HRLS_FEATURES`, and the reference (s h, s w, 3), exposed.
    """
    rows, columns = slice(top, top + patch), slice(left, left + patch)
    colour = mean_lrhs(view, list(range(len(view.lr_spp))), SCALE)
    exposure = find_exposure(colour)
    low_rows, low_columns = (slice(side.start // SCALE, side.stop // SCALE) for side in (rows, columns))

    others = [p for p in range(len(view.hr)) if p != chosen]
    low = box_downsample(read_hrls(view, others, rows, columns).mean(axis=0), SCALE)
    low[..., :3] = colour[low_rows, low_columns]
    high = read_hrls(view, [chosen], rows, columns)[0]
    lrhs, hrls = (packed(split_features(passes), exposure) for passes in (low, high))
    return lrhs, hrls, as_float32(view.ref[rows, columns]) * np.float32(exposure)


def first(count: int) -> Tensor:
    """Return the mask (16, 1, 1) of the first channels."""
    return (torch.arange(HRLS_CHANNELS) < count).float()[:, None, None]


def pool(views: list[View]) -> list[list[Tensor]]:
    """Return batches of LRHS, HRLS and target, encoded."""
    rng = np.random.default_rng(0)
    batches = []
    for _ in range(POOL):
        pairs = []
        for view in (views[i] for i in rng.integers(len(views), size=BATCH)):
            top, left = 8 * rng.integers((view.ref.shape[0] - PATCH) // 8 + 1, size=2)
            pairs.append(pair_of(view, int(top), int(left), PATCH, int(rng.integers(len(view.hr)))))
        lrhs, hrls, references = (np.stack(images) for images in zip(*pairs, strict=True))
        batches.append([to_tensor(x, torch.device("cpu")) for x in (lrhs, hrls, encode_radiance(references, 1.0))])
    return batches


def train(variant: Variant, batches: list[list[Tensor]], steps: int) -> MultiResolutionFusion:
    """Return a network after ``steps`` training steps."""
    torch.manual_seed(0)
    network = MultiResolutionFusion(SCALE, **REDUCED, lrhs_channels=HRLS_CHANNELS)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.AdamW(network.parameters(), lr=LEARNING_RATE, eps=1e-6)
    low_mask, high_mask = first(variant.lrhs), first(variant.hrls)
    schedule = LambdaLR(optimizer, lambda step: min(1.0, 2 * (1 - step / steps)))  # constant, then linear to zero
    for step in range(steps):
        lrhs, hrls, target = (torch.rot90(image, step // POOL % 4, (2, 3)) for image in batches[step % POOL])
        with torch.autocast("cpu", torch.bfloat16):
            output = network(lrhs * low_mask, hrls * high_mask)
        optimizer.zero_grad(set_to_none=True)
        variant.loss(output.float(), target).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
    return network


@torch.inference_mode()
def evaluate(network: MultiResolutionFusion, variant: Variant, views: list[View]) -> dict[str, float]:
    """Return mean sRGB PSNR and RelMSE of the network."""
    scored = []
    for view in views:
        *pair, reference = pair_of(view, 0, 0, view.ref.shape[0], 0)
        lrhs, hrls = (to_tensor(image[None], torch.device("cpu")) for image in pair)
        fused = network(lrhs * first(variant.lrhs), hrls * first(variant.hrls))[0].permute(1, 2, 0)
        image = decode_radiance(fused.numpy(), 1.0)
        scored.append([psnr(image, reference), relmse(image, reference)])
    return dict(zip(("psnr", "relmse"), np.mean(scored, axis=0).tolist(), strict=True))


def main() -> None:
    """Train and score the rows that the table does not have."""
    parser = results.parser(__doc__)
    parser.add_argument("views", type=Path, help="folder of views")
    parser.add_argument("--steps", type=int, default=1500, help="per row (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads (default: %(default)s)")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    folder = Folder(args.views)
    views, held_out = (folder.split(split) for split in ("train", "validation"))
    effort = {"steps": args.steps, "train_views": len(views), "held_out_views": len(held_out)}
    done = {row["name"] for row in results.read(args.table)} if args.table and args.table.exists() else set()
    batches = pool(views)
    for variant in VARIANTS:
        if variant.name not in done:
            network = train(variant, batches, args.steps)
            row = {"name": variant.name, **evaluate(network, variant, held_out), **effort}
            results.show([row], args.table, ("name",))


if __name__ == "__main__":
    main()
