# SPDX-License-Identifier: Apache-2.0
"""Time and accuracy of the `joint` models in 8 bits beside the same networks in 32 bits, computed by PyTorch.

    python -m benchmarks.eight_bit VIEWS

PSNR is of sRGB pictures, with 1, 2 and 4 spp in either render, over every third validation view
(:mod:`datagen.views`). Times are medians for a frame of 1024 x 1024 pixels; both take turns in one process.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch

from benchmarks import results, scenes
from benchmarks.results import Row
from benchmarks.runtime import frame
from datagen.views import Folder
from oiio_msspl import Render, Session, find_model, fuse
from oiio_msspl.aovs.features import RGB
from oiio_msspl.arrays import Array
from oiio_msspl.exr.render import ReadableRender
from oiio_msspl.metrics import psnr
from oiio_msspl.model.contract import SCALES
from oiio_msspl.model.render_mean import NO_IMAGES, Images, MeanSettings, denoiser_images, mean_of_renders
from training.checkpoints import load as load_checkpoint
from training.data import to_tensor
from training.joint import JointFusion

SPP = (1, 2, 4)
SIZE, REPEATS = 1024, 5
CHECKPOINT = Path(__file__).parents[1] / "training/checkpoints/joint.pt"


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


def accuracy(
    views: list[scenes.Scene], scale: int, ways: list[Callable[[ReadableRender, ReadableRender], Array]]
) -> list[float]:
    """Mean PSNR of each way to use LRHS and HRLS: for each of `SPP`, all ways."""
    return [
        statistics.fmean(psnr(way(view.lrhs(scale, spp), view.hrls(spp)), view.reference) for view in views)
        for spp in SPP
        for way in ways
    ]


class InTorch(Session):
    """A joint model computed by PyTorch in 32 bits, from its checkpoint."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        network, _ = load_checkpoint(CHECKPOINT)
        assert isinstance(network, JointFusion)
        self._network = network

    def run(
        self,
        lrhs: Array,
        hrls: Array,
        *,
        lrhs_aovs: Images = NO_IMAGES,
        mean: MeanSettings | None = None,
        error: bool = False,
    ) -> tuple[Array, Array | None]:
        light = lrhs[..., :3]
        layers = mean_of_renders(light, denoiser_images(hrls), lrhs_aovs, mean)
        images = np.concatenate([light, self._network.mean_denoiser.denoise(layers)], axis=-1), hrls
        with torch.inference_mode():
            fused, _ = self._network.fuse(*(to_tensor(image[None], torch.device("cpu")) for image in images))
        return fused[0].permute(1, 2, 0).numpy(), None


def row(name: str, seconds: list[float], psnr: Sequence[float]) -> Row:
    """One row, from pairs of figures in 32 and in 8 bits."""
    columns = [f"psnr_{spp}spp_{bits}bit" for spp in SPP for bits in (32, 8)]
    return {
        "method": name,
        "seconds_32bit": seconds[0],
        "seconds_8bit": seconds[1],
        **dict(zip(columns, psnr, strict=True)),
    }


def layout(rows: list[Row]) -> str:
    """A line for each model."""
    head = ["", "seconds", "in 8 bits", *(cell for spp in SPP for cell in (f"PSNR at {spp} spp", "in 8 bits"))]
    columns = [column for column in rows[0] if column != "method"]
    body = [[r["method"], *(f"{r[c]:.2f}" for c in columns)] for r in rows]
    return results.markdown(head, body)


def measure(views: list[scenes.Scene], models: list[str]) -> Iterator[Row]:
    """A row for each model."""
    layers = frame(SIZE, SIZE)
    hr = Render.from_arrays("hr", **layers)
    for name in models:
        path = find_model(0, name)
        sessions = [InTorch(path), Session(path)]
        scale = sessions[0].contract.scale
        lr = Render.from_arrays("lr", rgb=layers[RGB][::scale, ::scale].copy())
        seconds = medians([partial(fuse, lr, hr, session) for session in sessions])
        ways = [lambda lr, hr, session=session: fuse(lr, hr, session).rgb for session in sessions]
        yield row(name, seconds, accuracy(views, scale, ways))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("views", type=Path)
    parser.add_argument("--models", nargs="+", default=[f"joint-x{scale}" for scale in SCALES])
    results.add_option(parser)
    args = parser.parse_args()
    views = [scenes.of_view(view) for view in Folder(args.views).split("validation")[::3]]
    rows = list(measure(views, args.models))
    print(layout(rows))
    if args.table:
        results.write(args.table, rows)


if __name__ == "__main__":
    main()
