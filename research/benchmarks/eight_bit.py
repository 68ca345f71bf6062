# SPDX-License-Identifier: Apache-2.0
"""Accuracy of the files for CPUs (8 bits) and for GPUs (half floats) beside PyTorch in 32 bits, but for `paper`, which
has one file.

    python -m research.benchmarks.eight_bit RENDERS
    python -m research.benchmarks.eight_bit VIEWS

PSNR is of sRGB pictures, with 1, 2 and 4 spp in either render where there are such files, over the development scenes
(:mod:`research.benchmarks.scenes`) or every third validation view (:mod:`research.datagen.views`). The CPU runs all
three; it rounds the
weights of the file for GPUs to half floats and multiplies in 32 bits. ``--time`` adds the median seconds of PyTorch and
of the file for CPUs for a frame of 1024 x 1024 pixels, which take turns in one process.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import torch

from oiio_msspl import Session, find_model, fuse
from oiio_msspl.errors import InputError
from oiio_msspl.image.metrics import psnr
from oiio_msspl.model.contract import SCALES
from oiio_msspl.model.devices import gpu_file
from oiio_msspl.model.render_mean import Images, Shares
from research.benchmarks import results, scenes
from research.benchmarks.results import Row
from research.benchmarks.runtime import pair
from research.datagen.views import Folder
from research.training.checkpoints import load as load_checkpoint
from research.training.export import denoiser_for
from research.training.joint import JointFusion
from research.training.whole_model import InTorch

SPP = (1, 2, 4)
#: Columns: how the network computes.
WAYS = ("32bit", "8bit", "half")
SIZE, REPEATS = 1024, 5
_FOLDER = Path(__file__).parents[1] / "training/checkpoints"
#: By family of models.
CHECKPOINTS = {
    "joint": _FOLDER / "joint.pt",
    "joint-small": _FOLDER / "joint_small.pt",
    "joint-large": _FOLDER / "joint_large.pt",
}


def medians(ways: list[Callable[[], object]]) -> list[float]:
    """Median seconds of each call. They take turns, after one round that warms up."""
    seconds: list[list[float]] = [[] for _ in ways]
    for repeat in range(REPEATS + 1):
        for way, taken in zip(ways, seconds, strict=True):
            start = time.perf_counter()
            way()
            if repeat:
                taken.append(time.perf_counter() - start)
    return [statistics.median(taken) for taken in seconds]


def accuracy(views: list[scenes.Scene], scale: int, sessions: Sequence[Session]) -> Iterator[tuple[int, list[float]]]:
    """The mean PSNR of every session, for each of `SPP` that all scenes have."""
    for spp in SPP:
        try:
            pairs = [(view.lrhs(scale, spp), view.hrls(spp), view.reference) for view in views]
        except InputError:  # no such file
            continue
        yield spp, [statistics.fmean(psnr(fuse(lr, hr, s).rgb, ref) for lr, hr, ref in pairs) for s in sessions]


class InPyTorch(Session):
    """A model computed by PyTorch in 32 bits, from its checkpoint."""

    def __init__(self, path: Path, family: str) -> None:
        super().__init__(path)
        network, _ = load_checkpoint(CHECKPOINTS[family])
        assert isinstance(network, JointFusion)
        self._model = InTorch(self.contract, network.fuse, denoiser_for(network, self.contract.denoiser))

    @torch.inference_mode()
    def run(self, lrhs: Images, hrls: Images, exposure: float, shares: Shares, **_: object) -> Images:
        feed = {name: torch.from_numpy(values) for name, values in self._feed(lrhs, hrls, exposure, shares).items()}
        return {"fused": self._model(feed)[0].permute(1, 2, 0).numpy()}


def measure(views: list[scenes.Scene], models: list[str], *, timed: bool) -> Iterator[Row]:
    """A row for each model and number of spp."""
    for name in models:
        path = find_model(0, name)
        sessions = [InPyTorch(path, name.rpartition("-x")[0]), Session(path), Session(gpu_file(path) or path)]
        scale = sessions[0].contract.scale
        lr, hr = pair(SIZE, SIZE, scale)
        seconds: Row = {}
        if timed:
            took = medians([partial(fuse, lr, hr, session) for session in sessions[:2]])
            seconds = {f"seconds_{way}": value for way, value in zip(WAYS, took, strict=False)}
        for spp, found in accuracy(views, scale, sessions):
            yield {"method": name, "spp": spp} | {f"psnr_{w}": v for w, v in zip(WAYS, found, strict=True)} | seconds


def layout(rows: list[Row]) -> str:
    """A line for each model and number of spp."""
    columns = list(rows[0])
    body = [[f"{r[c]:.3f}" if isinstance(r[c], float) else str(r[c]) for c in columns] for r in rows]
    return results.markdown(columns, body)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, metavar="RENDERS_OR_VIEWS")
    models = [f"{family}-x{scale}" for family in CHECKPOINTS for scale in SCALES]
    parser.add_argument("--models", nargs="+", default=models)
    parser.add_argument("--time", action="store_true", help="also measure times")
    results.add_option(parser)
    args = parser.parse_args()
    if any(args.scenes.glob("*/ref.exr")):
        views = [scene for scene in scenes.load(args.scenes) if scene.name not in scenes.NOISY_REFERENCE]
    else:
        views = [scenes.of_view(view) for view in Folder(args.scenes).split("validation")[::3]]
    rows = list(measure(views, args.models, timed=args.time))
    print(layout(rows))
    if args.table:
        results.write(args.table, rows)


if __name__ == "__main__":
    main()
