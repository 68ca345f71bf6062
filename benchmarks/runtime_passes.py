# SPDX-License-Identifier: Apache-2.0
"""Time of fused passes on a frame of real size, beside OIDN on each layer.

    python -m benchmarks.runtime_passes --table benchmarks/results/runtime_passes.csv

A pair of half-float EXRs has eight light groups of random pixels that sum to the beauty, an albedo and a normal. Ours
reads the layers from the files. OIDN gets them as arrays in memory. The methods take turns; the median of all rounds
counts, after one that does not. :mod:`benchmarks.passes` measures accuracy, on frames that are much smaller.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from benchmarks import results
from benchmarks.oidn import denoise, denoise_with_clean, prefiltered
from benchmarks.results import Row
from benchmarks.runtime import frame, processor
from oiio_msspl import fuse, map_render, open_exr
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.arrays import box_downsample
from oiio_msspl.fusion.alignment import align
from oiio_msspl.fusion.passes import fuse_passes
from oiio_msspl.model.catalogue import load_model

LAYERS = 8
BEAUTY, PASSES, PLAIN = "beauty", "passes", "OIDN on each layer"
PREFILTERED = "OIDN on each layer, prefiltered once"
ROUNDS = 3


def write_pair(folder: Path, width: int, height: int, scale: int) -> tuple[MappedRender, MappedRender]:
    """Write both renders; open them."""
    pixels = frame(height, width)
    shares = np.random.default_rng(1).dirichlet(np.ones(LAYERS), (height // 8, width // 8))
    shares = shares.repeat(8, axis=0).repeat(8, axis=1).astype(np.float32)
    lights = {f"light_{i}": pixels["rgb"] * shares[..., i, None] for i in range(LAYERS)}
    layers = {"": sum(lights.values()), "albedo": pixels["albedo"], "N": pixels["normal"], **lights}
    found = []
    # The LRHS shows other pixels, or there would be no noise to remove.
    for name, factor, shift in (("lr", scale, height // 2), ("hr", 1, 0)):
        channels = {
            f"{layer}.{component}".lstrip("."): np.ascontiguousarray(plane, np.float16)
            for layer, image in layers.items()
            for component, plane in zip(
                "RGB", np.moveaxis(box_downsample(np.roll(image, shift, axis=0), factor), -1, 0), strict=True
            )
        }
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, channels) as file:
            file.write(str(folder / f"{name}.exr"))
        found.append(map_render(open_exr(folder / f"{name}.exr")))
    return found[0], found[1]


def methods(lr: MappedRender, hr: MappedRender, model: str) -> dict[str, Callable[[], Any]]:
    """What is timed."""
    alignment = align(lr, hr)
    session = load_model(alignment.scale, model)
    beauty = fuse(lr, hr, session).rgb
    (lights,) = (each for each in hr.additive_sets if len(each.layers) == LAYERS)
    pixels = frame(hr.data_window.height, hr.data_window.width)
    noisy, guides = pixels["rgb"], {name: pixels[name] for name in ("albedo", "normal")}

    def each_prefiltered() -> None:
        clean = prefiltered(guides)
        for _ in range(LAYERS):
            denoise_with_clean(noisy, clean)

    def passes() -> None:
        assert not fuse_passes(lr, hr, beauty, alignment, [lights]).refused

    return {
        BEAUTY: lambda: fuse(lr, hr, session),
        PASSES: passes,
        PLAIN: lambda: [denoise(noisy, **guides) for _ in range(LAYERS)],
        PREFILTERED: each_prefiltered,
    }


def layout(rows: list[Row]) -> str:
    """A line for each method."""
    seconds = {row["method"]: row["seconds"] for row in rows}
    first = rows[0]
    titles = {BEAUTY: f"`{first['model']}` on the beauty", PASSES: f"{LAYERS} passes, fused"}
    body = [
        [titles.get(name, name), f"{value:.2f}", f"{value / seconds[PLAIN]:.2f}", f"{value / seconds[BEAUTY]:.2f}"]
        for name, value in seconds.items()
    ]
    head = [f"{first['size'].replace('x', ' x ')}, {first['cores']} cores, {first['machine']}"]
    return results.markdown([*head, "seconds", "of plain OIDN's time", "of the beauty's"], body)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--scale", type=int, default=2)
    parser.add_argument("--model", default="balanced")
    results.add_option(parser)
    args = parser.parse_args()
    width, height = (int(v) for v in args.size.split("x"))
    times: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        lr, hr = write_pair(Path(folder), width, height, args.scale)
        calls = methods(lr, hr, args.model)
        for _ in range(ROUNDS + 1):
            for name, call in calls.items():
                start = time.perf_counter()
                call()
                times.setdefault(name, []).append(time.perf_counter() - start)
    name = load_model(args.scale, args.model).name
    key = {"size": args.size, "model": name, "machine": processor(), "cores": os.cpu_count()}
    rows: list[Row] = [
        {"method": name, **key, "seconds": statistics.median(found[1:])} for name, found in times.items()
    ]
    print(layout(rows))
    if args.table:
        results.write(args.table, rows)


if __name__ == "__main__":
    main()
