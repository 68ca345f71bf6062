# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise's networks in 8 bits beside itself: time, and what it costs in accuracy.

    python -m benchmarks.eight_bit VIEWS

Of the views for validation (:mod:`training.views`), every third, at 1, 2 and 4 spp in either render: PSNR in sRGB
against the reference of the HRLS denoised, and of what the models make of both. Times are taken in turn, in one
process, on a frame of 1024 x 1024 pixels; the medians.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.runtime import frame
from oiio_msspl import Render, Session, find_model, fuse, metrics, schema, tensors, transforms
from oiio_msspl.denoiser import Denoiser, layers_of
from training import data

SPP = (1, 2, 4)
SIZE, REPEATS = 1024, 5


def pair(view: data.View, scale: int, spp: int) -> tuple[Render, Render]:
    """LRHS and HRLS of a view, without diffuse and specular."""
    whole = slice(None)
    light = data.mean_lrhs(view, np.flatnonzero(view.lr_spp == spp)[:1])
    layers = data.split_features(data.read_hrls(view, list(range(spp)), whole, whole).mean(axis=0))
    kept = {name: layers[name] for name in (schema.RGB, schema.ALBEDO, schema.NORMAL)}
    return Render.from_arrays("lr", rgb=transforms.box_downsample(light, scale)), Render.from_arrays("hr", **kept)


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("views", type=Path)
    parser.add_argument("--models", nargs="+", default=["mix-x2", "mix-x4", "mix-x8"])
    args = parser.parse_args()
    views = data.Folder(args.views).split("validation")[::3]
    both = [Denoiser(exact=True), Denoiser()]
    print("| | seconds | in 8 bits |" + "".join(f" PSNR at {spp} spp | in 8 bits |" for spp in SPP))
    print("|---|---|---|" + "---|---|" * len(SPP))

    def row(name: str, seconds: list[float], scores: list[list[float]]) -> None:
        shown = [f"{statistics.fmean(of_views):.2f}" if of_views else "" for of_views in scores]
        print(f"| {name} | " + " | ".join([*(f"{s:.2f}" for s in seconds), *shown]) + " |", flush=True)

    layers = frame(SIZE, SIZE)
    hrls = tensors.pack(layers, schema.HRLS_FEATURES, 1.0)
    scores: list[list[float]] = [[] for _ in range(2 * len(SPP))]
    for view in views:
        for i, spp in enumerate(SPP):
            lr, hr = pair(view, 2, spp)
            exposure = transforms.exposure_of(lr.layers[schema.RGB])
            read = layers_of(tensors.pack(hr.layers, schema.HRLS_FEATURES, exposure))
            for j, denoiser in enumerate(both):
                image = transforms.expand(denoiser.hrls(read), 1.0)
                scores[2 * i + j].append(metrics.psnr(image, data.read(view.ref) * np.float32(exposure)))
    row("OIDN on the HRLS", medians([partial(d.hrls, layers_of(hrls)) for d in both]), scores)
    for scale, name in ((2, "x2"), (4, "x4")):
        low = tensors.pack({schema.RGB: layers[schema.RGB][::scale, ::scale]}, schema.LRHS_FEATURES, 1.0)
        row(
            f"OIDN on both together, {name}",
            medians([partial(d.together, low, hrls) for d in both]),
            [[]] * len(scores),
        )
    for name in args.models:
        sessions = [Session(find_model(0, name), exact=exact) for exact in (True, False)]
        scale = sessions[0].contract.scale
        scores = [[] for _ in range(2 * len(SPP))]
        for view in views:
            for i, spp in enumerate(SPP):
                lr, hr = pair(view, scale, spp)
                exposure = np.float32(transforms.exposure_of(lr.layers[schema.RGB]))
                for j, session in enumerate(sessions):
                    image = fuse(lr, hr, session).rgb * exposure
                    scores[2 * i + j].append(metrics.psnr(image, data.read(view.ref) * exposure))
        hr = Render.from_arrays("hr", **layers)
        lr = Render.from_arrays("lr", rgb=layers[schema.RGB][::scale, ::scale].copy())
        row(f"`{name}`", medians([partial(fuse, lr, hr, session) for session in sessions]), scores)


if __name__ == "__main__":
    main()
