# SPDX-License-Identifier: Apache-2.0
"""Time of fused passes on a frame of real size, beside OIDN on each layer.

    python -m research.benchmarks.runtime_passes --table research/benchmarks/results/runtime_passes.csv
    python -m research.benchmarks.runtime_passes --pair LR.exr HR.exr --table
    research/benchmarks/results/runtime_passes_cycles.csv

A pair of half-float EXRs has eight light groups that sum to the beauty, an albedo and a normal. All of them have light
everywhere, which takes longest. ``--pair`` measures all sets of a rendered pair instead, such as one of
``research.datagen.cycles.passes``: some of its layers are black, or are so in parts.

Ours reads the layers from the files. OIDN gets them as arrays in memory, without those that are black. The methods take
turns; the median of all ``--rounds`` counts, after one that does not. With ``--quality best``, a network fuses each
layer. :mod:`research.benchmarks.passes` measures accuracy, on frames that are much smaller.
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

from oiio_msspl import FusedFrame, fuse, map_render, open_exr
from oiio_msspl.aovs.additive_sets import AdditiveSet
from oiio_msspl.aovs.features import ALBEDO, NORMAL
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.fusion.fuse import layer_fuser
from oiio_msspl.fusion.passes.fuse import PassInputs, fuse_passes
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.fusion.tiles.tiling import MAX_MEMORY, strips_memory
from oiio_msspl.image.arrays import Array, box_downsample, planes_of
from oiio_msspl.model.catalogue import load_model
from oiio_msspl.model.session import Session
from research.benchmarks import results
from research.benchmarks.oidn import denoise, denoise_with_clean, prefiltered
from research.benchmarks.passes import layers_of
from research.benchmarks.results import Row
from research.benchmarks.runtime import frame, processor

LAYERS = 8
BEAUTY, OURS = "beauty", "ours"
PLAIN, PREFILTERED = "OIDN on each layer", "OIDN on each layer, prefiltered once"


def write_pair(folder: Path, width: int, height: int, scale: int) -> tuple[MappedRender, MappedRender]:
    """Write both renders; open them."""
    shares = np.random.default_rng(1).dirichlet(np.ones(LAYERS), (height // 8, width // 8))
    shares = shares.repeat(8, axis=0).repeat(8, axis=1).astype(np.float32)
    found = []
    for name, factor, seed in (("lr", scale, 1), ("hr", 1, 0)):
        pixels = frame(height, width, seed)
        lights = {f"light_{i}": pixels["rgb"] * shares[..., i, None] for i in range(LAYERS)}
        layers = {"": sum(lights.values()), "albedo": pixels["albedo"], "N": pixels["normal"], **lights}
        channels = {
            f"{layer}.{component}".lstrip("."): np.ascontiguousarray(plane, np.float16)
            for layer, image in layers.items()
            for component, plane in zip("RGB", planes_of(box_downsample(image, factor)), strict=True)
        }
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, channels) as file:
            file.write(str(folder / f"{name}.exr"))
        found.append(map_render(open_exr(folder / f"{name}.exr")))
    return found[0], found[1]


#: A set, a method, and the model that it is for; no set for a beauty, and no model for a peer.
Key = tuple[str, str, str]


def methods(lr: MappedRender, hr: MappedRender, sessions: Sequence[Session]) -> dict[Key, Callable[[], Any]]:
    """What is timed."""
    guides = hr.read(hr.data_window, [ALBEDO, NORMAL])

    def passes(layers: AdditiveSet, session: Session, beauty: FusedFrame) -> None:
        cache_bytes = strips_memory(MAX_MEMORY, beauty.nbytes)  # as in the job of a frame
        inputs = PassInputs(lr, hr, beauty.rgb, beauty.alignment, [layers], beauty.clean_aovs)
        done = fuse_passes(inputs, fuse_layers=layer_fuser(session, beauty), cache_bytes=cache_bytes)
        assert not done.refused

    def each_plain(noisy: Sequence[Array]) -> None:
        for layer in noisy:
            denoise(layer, guides[ALBEDO], guides[NORMAL])

    def each_prefiltered(noisy: Sequence[Array]) -> None:
        clean = prefiltered(guides)
        for layer in noisy:
            denoise_with_clean(layer, clean)

    calls: dict[Key, Callable[[], Any]] = {}
    beauties = {session.name: fuse(lr, hr, session, clean_aovs=True) for session in sessions}
    for session in sessions:
        calls["", BEAUTY, session.name] = partial(fuse, lr, hr, session)
    for layers in hr.additive_sets:
        noisy = [layer for layer in layers_of(hr, layers) if layer.any()]
        title = f"{layers.name}: {len(noisy)} of {len(layers.layers)} layers have light"
        for session in sessions:
            calls[title, OURS, session.name] = partial(passes, layers, session, beauties[session.name])
        calls[title, PLAIN, ""] = partial(each_plain, noisy)
        calls[title, PREFILTERED, ""] = partial(each_prefiltered, noisy)
    return calls


def layout(rows: list[Row]) -> str:
    """A table with a line for each method."""
    seconds = {(row.get("set") or "", row["method"], row.get("model") or ""): row["seconds"] for row in rows}
    body = []
    for (name, method, model), value in seconds.items():
        title = f"the beauty, `{model}`" if method == BEAUTY else f"{name}, `{model}`" if model else f"{name}, {method}"
        peers = [f"{value / seconds[name, peer, '']:.2f}" if name else "" for peer in (PLAIN, PREFILTERED)]
        of_beauty = f"{value / seconds['', BEAUTY, model]:.2f}" if model else ""
        body.append([title, f"{value:.2f}", *peers, of_beauty])
    first = rows[0]
    head = [f"{first['size'].replace('x', ' x ')}, x{first['scale']}, {first['cores']} cores, {first['machine']}"]
    return results.markdown([*head, "seconds", "of plain OIDN's", "of prefiltered OIDN's", "of the beauty's"], body)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--scale", type=int, default=2)
    parser.add_argument("--pair", type=Path, nargs=2, metavar=("LR.exr", "HR.exr"), help="a rendered pair instead")
    parser.add_argument("--models", nargs="+", default=["balanced", "best"])
    parser.add_argument("--rounds", type=int, default=3)
    results.add_option(parser)
    args = parser.parse_args()
    width, height = (int(v) for v in args.size.split("x"))
    times: dict[Key, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        if args.pair:
            lr, hr = (map_render(open_exr(path)) for path in args.pair)
        else:
            lr, hr = write_pair(Path(folder), width, height, args.scale)
        scale, window = align(lr, hr).scale, hr.data_window
        calls = methods(lr, hr, [load_model(scale, model) for model in args.models])
        for _ in range(args.rounds + 1):
            for key, call in calls.items():
                start = time.perf_counter()
                call()
                times.setdefault(key, []).append(time.perf_counter() - start)
    size = {"size": f"{window.width}x{window.height}", "scale": scale}
    machine = {"machine": processor(), "cores": os.cpu_count()}
    rows: list[Row] = [
        {"set": name, "method": method, "model": model, **size, **machine, "seconds": statistics.median(found[1:])}
        for (name, method, model), found in times.items()
    ]
    print(layout(rows))
    if args.table:
        results.write(args.table, rows)


if __name__ == "__main__":
    main()
