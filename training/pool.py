# SPDX-License-Identifier: Apache-2.0
"""Training pairs that are drawn ahead and kept on a GPU.

    python -m training.pool VIEWS POOL --draws 6
    python -m training.train --network joint --spread --scale 2 4 8 --pool POOL --data VIEWS --out RUN --minutes 10

A GPU takes a step in less time than :func:`training.data.draw` takes for one pair. So a process of its own draws whole
views some times each: other samples, filters, light and missing layers at each draw. It writes the pairs of a view into
a file of POOL, and goes on with the views that a renderer adds, until it is stopped. Training keeps all pairs on the
GPU. Each batch has crops of some of them, mirrored, turned, and with permuted colours.
"""

from __future__ import annotations

import argparse
import logging
import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from datagen.views import Folder, SampleView, View
from oiio_msspl.aovs.features import HRLS_FEATURES
from training.data import Batch, SampleTensors, Sampling, ViewTensors, draw
from training.joint import FEATURES, mean_and_noise

log = logging.getLogger(__name__)

#: Channels of the HRLS that pairs keep: those that `joint` reads.
CHANNELS = sum(HRLS_FEATURES[name] for name in FEATURES)
#: Widths of a view are cut to a multiple of this.
ALIGNMENT = 128
#: Seconds between two looks for new files.
RESCAN_SECONDS = 5.0

Pair = dict[str, Tensor]


# Drawing


@torch.no_grad()
def draw_pairs(view: View | SampleView, scales: tuple[int, ...], count: int, device: torch.device) -> list[Pair]:
    """Draw a view ``count`` times: ``lrhs`` (7, h, w), ``hrls`` (9, s*h, s*w), ``target`` (3, s*h, s*w), half floats.

    The LRHS has the mean of both renders and its noise, see :func:`training.joint.with_mean`.
    """
    kind = SampleTensors if isinstance(view, SampleView) else ViewTensors
    tensors = kind.of(view, device)
    rng = np.random.default_rng([*view.path.name.encode(), count])
    patch = min(tensors.size) // ALIGNMENT * ALIGNMENT
    pairs = []
    for _ in range(count):
        batch = draw([tensors], int(rng.choice(scales)), patch, 1, rng, Sampling())
        lrhs, hrls = batch["lrhs"], batch["hrls"]
        batch = {"lrhs": torch.cat([lrhs, *mean_and_noise(lrhs, hrls)], dim=1), "hrls": hrls[:, :CHANNELS]} | {
            "target": batch["target"]
        }
        pair = {name: image[0].half().contiguous().cpu() for name, image in batch.items()}
        if all(bool(image.isfinite().all()) for image in pair.values()):
            pairs.append(pair)
    return pairs


def fill(
    views: Path, pool: Path, scales: tuple[int, ...], draws: int, part: int, parts: int, device: torch.device
) -> None:
    """Write the pairs of every ``parts``-th view of the training split, and wait for more."""
    folder = Folder(views)
    pool.mkdir(parents=True, exist_ok=True)
    while True:
        todo = [
            view
            for view in (*folder.split("train"), *folder.sample_views("train"))
            if sum(view.path.name.encode()) % parts == part and not (pool / f"{view.path.name}.pt").exists()
        ]
        for view in todo:
            file = pool / f"{view.path.name}.pt"
            torch.save(draw_pairs(view, scales, draws, device), file.with_suffix(".partial"))
            os.replace(file.with_suffix(".partial"), file)
            log.info("%s", file.name)
        time.sleep(0 if todo else 1)
        folder.scan()


# Batches


class PooledBatches:
    """Endless random batches of the pairs of a folder, on a GPU.

    Args:
        pool: the folder that :func:`fill` writes.
        scales: of each batch, one of these at random.
        patch: width and height of a patch in HRLS pixels.
        batch: pairs per batch.
    """

    def __init__(
        self, pool: Path, scales: tuple[int, ...], patch: int, batch: int, seed: int, device: torch.device
    ) -> None:
        self.pool, self.scales, self.patch, self.batch, self.device = pool, scales, patch, batch, device
        self.rng = np.random.default_rng(seed)
        self.pairs: dict[int, list[Pair]] = {scale: [] for scale in scales}
        self.loaded: set[Path] = set()

    def load(self) -> None:
        """Load the files that are new."""
        for file in sorted(set(self.pool.glob("*.pt")) - self.loaded):
            self.loaded.add(file)
            for pair in torch.load(file, weights_only=True):
                scale = pair["hrls"].shape[-1] // pair["lrhs"].shape[-1]
                if scale in self.pairs and pair["hrls"].shape[-1] >= self.patch:
                    self.pairs[scale].append({name: image.to(self.device) for name, image in pair.items()})

    def loader(self) -> Iterator[Batch]:
        """Endless batches, see :data:`training.data.Batch`. Waits until the pool has a pair."""
        looked = -RESCAN_SECONDS
        while True:
            if time.monotonic() - looked > RESCAN_SECONDS:
                self.load()
                looked = time.monotonic()
            ready = [scale for scale in self.scales if self.pairs[scale]]
            if not ready:
                time.sleep(0.2)
                self.load()
                continue
            yield self.draw(int(self.rng.choice(ready)))

    def draw(self, scale: int) -> Batch:
        """A batch of one scale."""
        rng, pairs = self.rng, self.pairs[scale]
        parts: dict[str, list[Tensor]] = {"lrhs": [], "hrls": [], "target": []}
        for index in rng.integers(len(pairs), size=self.batch):
            pair = pairs[index]
            top, left = (int(rng.integers((side * scale - self.patch) // scale + 1)) for side in pair["lrhs"].shape[1:])
            order = rng.permutation(3) if rng.random() < 0.5 else np.arange(3)
            channels = torch.from_numpy(np.concatenate([order, order + 3, [6, 7, 8]])).to(self.device)
            for name, image in pair.items():
                step = 1 if name == "lrhs" else scale
                crop = image[
                    :, top * step : top * step + self.patch // (scale // step),
                    left * step : left * step + self.patch // (scale // step),
                ]  # fmt: skip
                parts[name].append(crop[channels[: len(crop)]])
        axes = [axis for axis in (2, 3) if rng.random() < 0.5]
        swap = rng.random() < 0.5
        batch = {}
        for name, crops in parts.items():
            image = torch.stack(crops).float().flip(axes)
            batch[name] = (image.transpose(2, 3) if swap else image).contiguous(memory_format=torch.channels_last)
        return batch


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m training.pool", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("views", type=Path, help="folder of training views")
    parser.add_argument("pool", type=Path, help="folder for the pairs")
    parser.add_argument("--scale", type=int, nargs="+", default=(2, 4, 2, 4, 8), help="drawn from these (2 4 2 4 8)")
    parser.add_argument("--draws", type=int, default=6, help="pairs per view (%(default)s)")
    parser.add_argument("--part", type=int, nargs=2, default=(0, 1), metavar=("I", "N"), help="draw part I of N")
    parser.add_argument("--device", default="cuda")
    args = parser.parse_args()
    torch.set_num_threads(1)
    fill(args.views, args.pool, tuple(args.scale), args.draws, *args.part, torch.device(args.device))


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    main()
