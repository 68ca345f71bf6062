# SPDX-License-Identifier: Apache-2.0
"""Time of fused passes on a frame of real size, beside OIDN on each layer.

    python -m benchmarks.runtime_passes --table benchmarks/results/runtime_passes.csv

A pair of half-float EXRs has eight light groups of random pixels that sum to the beauty, an albedo and a normal. Ours
reads the layers from the files. OIDN gets them as arrays in memory. The methods take turns; the median of all rounds
counts, after one that does not. With ``--quality best``, a network fuses each layer. :mod:`benchmarks.passes` measures
accuracy, on frames that are much smaller.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from benchmarks import results
from benchmarks.oidn import denoise, denoise_with_clean, prefiltered
from benchmarks.results import Row
from benchmarks.runtime import frame, processor
from oiio_msspl import FusedFrame, fuse, map_render, open_exr
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.arrays import box_downsample
from oiio_msspl.fusion.fuse import layer_fuser
from oiio_msspl.fusion.passes import fuse_passes
from oiio_msspl.fusion.tiling import MAX_MEMORY, strips_memory
from oiio_msspl.model.catalogue import load_model
from oiio_msspl.model.session import Session

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


#: A method, and the model that it is for; no model for a peer.
Key = tuple[str, str]


def methods(lr: MappedRender, hr: MappedRender, sessions: Sequence[Session]) -> dict[Key, Callable[[], Any]]:
    """What is timed."""
    (lights,) = (each for each in hr.additive_sets if len(each.layers) == LAYERS)
    pixels = frame(hr.data_window.height, hr.data_window.width)
    noisy, guides = pixels["rgb"], {name: pixels[name] for name in ("albedo", "normal")}

    def each_prefiltered() -> None:
        clean = prefiltered(guides)
        for _ in range(LAYERS):
            denoise_with_clean(noisy, clean)

    def passes(session: Session, beauty: FusedFrame) -> None:
        cache_bytes = strips_memory(MAX_MEMORY, beauty.nbytes)  # as in the job of a frame
        fuser = layer_fuser(session, beauty)
        done = fuse_passes(lr, hr, beauty.rgb, beauty.alignment, [lights], cache_bytes, fuse_layers=fuser)
        assert not done.refused

    calls: dict[Key, Callable[[], Any]] = {}
    for session in sessions:
        calls[BEAUTY, session.name] = partial(fuse, lr, hr, session)
        calls[PASSES, session.name] = partial(passes, session, fuse(lr, hr, session))
    calls[PLAIN, ""] = lambda: [denoise(noisy, **guides) for _ in range(LAYERS)]
    calls[PREFILTERED, ""] = each_prefiltered
    return calls


def layout(rows: list[Row]) -> str:
    """A line for each method."""
    seconds = {(row["method"], row.get("model", "")): row["seconds"] for row in rows}
    titles = {BEAUTY: "`{}` on the beauty", PASSES: f"{LAYERS} passes with `{{}}`"}
    body = [
        [
            titles.get(name, name).format(model),
            f"{value:.2f}",
            *(f"{value / seconds[peer, '']:.2f}" for peer in (PLAIN, PREFILTERED)),
            f"{value / seconds[BEAUTY, model]:.2f}" if model else "",
        ]
        for (name, model), value in seconds.items()
    ]
    first = rows[0]
    head = [f"{first['size'].replace('x', ' x ')}, {first['cores']} cores, {first['machine']}"]
    return results.markdown([*head, "seconds", "of plain OIDN's", "of prefiltered OIDN's", "of the beauty's"], body)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--scale", type=int, default=2)
    parser.add_argument("--models", nargs="+", default=["balanced", "best"])
    results.add_option(parser)
    args = parser.parse_args()
    width, height = (int(v) for v in args.size.split("x"))
    times: dict[Key, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        lr, hr = write_pair(Path(folder), width, height, args.scale)
        calls = methods(lr, hr, [load_model(args.scale, model) for model in args.models])
        for _ in range(ROUNDS + 1):
            for key, call in calls.items():
                start = time.perf_counter()
                call()
                times.setdefault(key, []).append(time.perf_counter() - start)
    machine = {"size": args.size, "machine": processor(), "cores": os.cpu_count()}
    rows: list[Row] = [
        {"method": name, "model": model, **machine, "seconds": statistics.median(found[1:])}
        for (name, model), found in times.items()
    ]
    print(layout(rows))
    if args.table:
        results.write(args.table, rows)


if __name__ == "__main__":
    main()
