# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise's networks in 8 bits beside itself: time, and what it costs in accuracy.

    python -m benchmarks.eight_bit VIEWS

Of the views for validation (:mod:`training.views`), every third, at 1, 2 and 4 spp in either render: PSNR in sRGB
against the reference of the HRLS denoised, and of what the models make of both. In 32 bits, Open Image Denoise works
itself, and a joint network by PyTorch. Times are taken in turn, in one process, on a frame of 1024 x 1024 pixels; the
medians.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch

from benchmarks import scenes
from benchmarks.runtime import frame
from oiio_msspl import Render, Session, find_model, fuse, metrics, schema, tensors, transforms
from oiio_msspl.contract import Contract
from oiio_msspl.denoiser import NO_LAYERS, Denoiser, Layers, layers_of, merged
from oiio_msspl.pairing import Source
from oiio_msspl.render import Array
from training import data, export
from training.joint import JointFusion
from training.train import to_tensor

SPP = (1, 2, 4)
SIZE, REPEATS = 1024, 5
CHECKPOINT = Path(__file__).parents[1] / "training/checkpoints/joint.pt"


def medians(ways: list[Callable[[], object]]) -> list[float]:
    """Seconds of each, taken in turn."""
    seconds: list[list[float]] = [[] for _ in ways]
    for repeat in range(REPEATS + 1):
        for way, taken in zip(ways, seconds, strict=True):
            start = time.perf_counter()
            way()
            if repeat:
                taken.append(time.perf_counter() - start)
    return [statistics.median(taken) for taken in seconds]


def accuracy(views: list[scenes.Scene], scale: int, ways: list[Callable[[Source, Source], Array]]) -> list[float]:
    """Mean PSNR of what each way makes of LRHS and HRLS, for each number of samples."""
    return [
        statistics.fmean(metrics.psnr(way(view.lrhs(scale, spp), view.hrls(spp)), view.reference) for view in views)
        for spp in SPP
        for way in ways
    ]


def denoised(denoiser: Denoiser, lr: Source, hr: Source) -> Array:
    """The HRLS alone, exposed as fusion would."""
    exposure = transforms.exposure_of(scenes.beauty(lr))
    layers = tensors.pack(tensors.read(hr, hr.data_window, hr.data_window), schema.HRLS_FEATURES, exposure)
    return transforms.expand(denoiser.hrls(layers_of(layers)), exposure)


class InTorch(Session):
    """A joint network in 32 bits, from its checkpoint."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        network, _ = export.load(CHECKPOINT)
        assert isinstance(network, JointFusion)
        self._network = network

    def run(
        self, lrhs: Array, hrls: Array, *, low_aovs: Layers = NO_LAYERS, error: bool = False
    ) -> tuple[Array, Array | None]:
        light = lrhs[..., :3]
        together = self._network.together.denoised(merged(light, layers_of(hrls, complete=True), low_aovs))
        images = np.concatenate([light, together], axis=-1), hrls
        with torch.inference_mode():
            fused, _ = self._network.fuse(*(to_tensor(image[None], torch.device("cpu")) for image in images))
        return fused[0].permute(1, 2, 0).numpy(), None


def in_32_bits(name: str) -> Session:
    """A model of which nothing that can be otherwise is computed in 8 bits."""
    path = find_model(0, name)
    return InTorch(path) if Contract.of_file(path).weights else Session(path, exact=True)


def row(name: str, seconds: list[float], psnr: list[float]) -> None:
    cells = [f"{s:.2f}" for s in seconds] + ([f"{value:.2f}" for value in psnr] or [""] * (2 * len(SPP)))
    print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("views", type=Path)
    parser.add_argument(
        "--models", nargs="+", default=[f"{family}-x{scale}" for family in ("mix", "joint") for scale in schema.SCALES]
    )
    args = parser.parse_args()
    views = [scenes.of_view(view) for view in data.Folder(args.views).split("validation")[::3]]
    print("| | seconds | in 8 bits |" + "".join(f" PSNR at {spp} spp | in 8 bits |" for spp in SPP))
    print("|---|---|---|" + "---|---|" * len(SPP))
    layers = frame(SIZE, SIZE)
    hrls = tensors.pack(layers, schema.HRLS_FEATURES, 1.0)
    both = [Denoiser(exact=exact) for exact in (True, False)]
    seconds = medians([partial(denoiser.hrls, layers_of(hrls)) for denoiser in both])
    row("OIDN on the HRLS", seconds, accuracy(views, 2, [partial(denoised, denoiser) for denoiser in both]))
    for scale in schema.SCALES[:2]:
        low = tensors.pack({schema.RGB: layers[schema.RGB][::scale, ::scale]}, schema.LRHS_FEATURES, 1.0)
        seconds = medians([partial(denoiser.together, low, hrls) for denoiser in both])
        row(f"OIDN on both together, x{scale}", seconds, [])
    hr = Render.from_arrays("hr", **layers)
    for name in args.models:
        sessions = [in_32_bits(name), Session(find_model(0, name))]
        scale = sessions[0].contract.scale
        lr = Render.from_arrays("lr", rgb=layers[schema.RGB][::scale, ::scale].copy())
        seconds = medians([partial(fuse, lr, hr, session) for session in sessions])
        ways = [lambda lr, hr, session=session: fuse(lr, hr, session).rgb for session in sessions]
        row(f"`{name}`", seconds, accuracy(views, scale, ways))


if __name__ == "__main__":
    main()
