# SPDX-License-Identifier: Apache-2.0
"""Measure accuracy and time of fused passes, beside other ways to get clean layers that sum to the beauty.

    python -m research.benchmarks.passes PASSES --table research/benchmarks/results/passes.csv

PASSES is made by :mod:`research.benchmarks.render.passes` and ``research.datagen.cycles.passes``. The methods:

- "HRLS": the layers as they are rendered.
- "OIDN, prefiltered, rescaled": Open Image Denoise on each layer of the HRLS, as its documentation recommends. The
  layers are scaled so that they sum to the beauty of ``--quality best``. Albedo and normal are prefiltered once.
- "OIDN, ordinary render": that call on a render with as many samples as LRHS and HRLS together. The layers are scaled
  so that they sum to the beauty that OIDN makes of this render.
- "msspl": :mod:`oiio_msspl.fusion.passes.fuse`.
- "msspl, best": with the beauty of ``--quality best``. A network fuses each layer.
- "msspl, best, at half size": light groups at half of the frame's resolution, as if there were many of them.

Light and colour that are stored apart are multiplied first. A layer with less than `FAINT` of the beauty's light is
part of the sum, but is not scored: every method has a high PSNR there.

The time is that of all layers of a set, without the beauty, as a multiple of OIDN's plain call on the beauty.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np

from oiio_msspl import FusedFrame, Session, fuse
from oiio_msspl.aovs.additive_sets import LIGHT_GROUPS, AdditiveSet
from oiio_msspl.aovs.features import ALBEDO, NORMAL
from oiio_msspl.aovs.formula import FeatureFormula
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.fusion.passes.fuse import PassInputs, fuse_passes
from oiio_msspl.fusion.passes.layers import layer_names, light_of
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.metrics import psnr, relmse
from oiio_msspl.jobs.settings import family_for_noise
from oiio_msspl.model.catalogue import load_model
from research.benchmarks import results, timer
from research.benchmarks.oidn import denoise, denoise_prefiltered, denoise_with_clean, prefiltered
from research.benchmarks.results import MEAN, Row

SCALES, SPP = (2, 4), (1, 2)
KEYS = ("scene", "set", "spp", "method")
#: Calls of OIDN before the one that is the unit of time: the first one loads its network.
WARM_UP = 2
#: In the column `layer`: the mean of all layers.
ALL = "all"
#: Share of the beauty's light that a scored layer has at least.
FAINT = 0.01
#: The model of each quality that is measured.
BALANCED, BEST = "joint", "joint-large"
#: What the gain is measured against.
PEER = "OIDN, prefiltered, rescaled"


def layers_of(render: MappedRender, layers: AdditiveSet) -> Array:
    """Return the layers of a set, (layers, h, w, 3)."""
    names = layer_names([layers])
    pixels = light_of(render, names).pixels.read(render.data_window, names.values())
    return np.stack([np.maximum(pixels[names[layer]], 0) for layer in layers.layers])


def rescaled(layers: Array, beauty: Array) -> Array:
    """Return layers that sum to the beauty, in the ratio of these."""
    total = layers.sum(axis=0)
    return layers * np.where(total > 0, beauty / np.where(total > 0, total, 1), 0)


def colours_of(render: MappedRender, layers: AdditiveSet) -> Array:
    """Return the colour by which each layer's light is multiplied, (layers, h, w, 3); 1 if there is none."""
    formulas = {str(i): FeatureFormula((x.factor,)) for i, x in enumerate(layers.layers) if x.factor}
    pixels = replace(render, features=formulas, alpha=None).read(render.data_window, list(formulas))
    ones = np.ones((render.data_window.height, render.data_window.width, 3), np.float32)
    return np.stack([pixels.get(str(i), ones) for i in range(len(layers.layers))])


def methods(
    lr: MappedRender,
    hr: MappedRender,
    fused: Mapping[str, tuple[FusedFrame, Session]],
    layers: AdditiveSet,
    ordinary: MappedRender,
) -> Iterator[tuple[str, Callable[[], Array]]]:
    """Yield the name of each method, and a function that computes the layers.

    Args:
        fused: the fused frame of each model, and the model.
        ordinary: a render with as many samples as LRHS and HRLS together.
    """
    noisy, colours = layers_of(hr, layers), colours_of(hr, layers)
    guides = hr.read(hr.data_window, [ALBEDO, NORMAL])

    def recommended(noisy: Array, guides: Mapping[str, Array]) -> Array:
        clean = prefiltered({name: guides[name] for name in (ALBEDO, NORMAL)})
        return np.maximum([denoise_with_clean(layer, clean) for layer in noisy], np.float32(0))

    def ours(model: str, *, half: bool = False) -> Array:
        frame, session = fused[model]
        with patch("oiio_msspl.fusion.passes.network.MOST_AT_FULL_SIZE", 0 if half else len(layers.layers)):
            made = fuse_passes(PassInputs(lr, hr, frame, [layers]), session=session)
        assert not made.refused
        planes = [[made.pixels.planes[c] for c in layer.channels] for layer in layers.layers]
        return colours * np.moveaxis(np.asarray(planes, np.float32), 1, -1)

    yield "HRLS", lambda: noisy
    yield PEER, lambda: rescaled(recommended(noisy, guides), fused[BEST][0].rgb)
    theirs = layers_of(ordinary, layers_like(ordinary, layers))
    pixels = ordinary.load().layers
    total = np.maximum(denoise_prefiltered(pixels["rgb"], pixels[ALBEDO], pixels[NORMAL]), 0)
    yield "OIDN, ordinary render", lambda: rescaled(recommended(theirs, pixels), total)
    yield "msspl", lambda: ours(BALANCED)
    yield "msspl, best", lambda: ours(BEST)
    if layers.name == LIGHT_GROUPS:
        yield "msspl, best, at half size", lambda: ours(BEST, half=True)


def layers_like(render: MappedRender, layers: AdditiveSet) -> AdditiveSet:
    """Return the set of another file with the same name and layers."""
    names = [layer.name for layer in layers.layers]
    sets = (x for x in render.additive_sets if x.name == layers.name and [y.name for y in x.layers] == names)
    return next(sets)


def fused_frames(lr: MappedRender, hr: MappedRender, scale: int) -> dict[str, tuple[FusedFrame, Session]]:
    """Return the fused frame of each model, and the model. That of single layers is loaded, too."""
    alignment = align(lr, hr)
    sessions = {
        family: load_model(scale, family_for_noise(family, lr, hr, alignment)[0]) for family in (BALANCED, BEST)
    }
    if sessions[BEST].layers:
        sessions[BEST].layer_session()
    return {model: (fuse(lr, hr, session, clean_aovs=True), session) for model, session in sessions.items()}


def scores(layers: Array, reference: Array, names: list[str]) -> list[Row]:
    """Return the mean of the layers that are bright enough, and a row for each."""
    light = reference.sum(axis=(1, 2, 3))
    rows: list[Row] = [
        {"layer": name, "psnr": psnr(layer, truth), "relmse": relmse(layer, truth)}
        for name, layer, truth, share in zip(names, layers, reference, light / light.sum(), strict=True)
        if share >= FAINT
    ]
    return [{"layer": ALL} | {key: float(np.mean([row[key] for row in rows])) for key in ("psnr", "relmse")}, *rows]


def measure(folder: Path, scale: int, spp: int, known: Collection[tuple[object, ...]] = ()) -> list[Row]:
    """Measure one scene: rows for each set and method, without those whose `KEYS` are known."""

    def opened(name: str) -> MappedRender:
        return map_render(open_exr(folder / f"{name}.exr"))

    reference, ordinary = opened("ref"), opened(f"hr_{2 * spp}spp")
    lr, hr = opened(f"lr_x{scale}_{scale**2 * spp}spp"), opened(f"hr_{spp}spp")
    fused = fused_frames(lr, hr, scale)
    pixels = hr.load().layers
    plain = partial(denoise, pixels["rgb"], pixels[ALBEDO], pixels[NORMAL])
    oidn_seconds = timer.seconds_of(plain, 1, WARM_UP)[0]
    rows = []
    for layers in hr.additive_sets:
        clean = layers_of(reference, layers_like(reference, layers))
        for name, function in methods(lr, hr, fused, layers, ordinary):
            title = name.replace("msspl", f"msspl-x{scale}") if name.startswith("msspl") else name
            key: Row = {"scene": folder.name, "set": layers.name, "spp": 2 * spp, "method": title}
            if tuple(key.values()) in known:
                continue
            start = time.perf_counter()
            made = function()
            seconds = time.perf_counter() - start
            total, *single = scores(made, clean, [layer.name for layer in layers.layers])
            if name == PEER or name.startswith("msspl"):  # the beauty to which the peer is rescaled is that of `best`
                key["model"] = fused[BEST if name == PEER or "best" in name else BALANCED][1].name
            rows += [key | total | {"time": 0.0 if name == "HRLS" else seconds / oidn_seconds}]
            rows += [key | row for row in single]
    return rows


def means(rows: list[Row]) -> list[Row]:
    """Return means over the scenes, of the methods that were measured on each. A mean has the oldest stamp."""
    made = []
    totals = results.where(rows, layer=ALL)
    scenes = {(row["set"], row["spp"], row["scene"]) for row in totals if row["method"] == PEER}
    for name, spp, method in dict.fromkeys(tuple(row[key] for key in KEYS[1:]) for row in totals):
        members = results.where(totals, set=name, spp=spp, method=method)
        if len(members) < sum((name, spp) == key[:2] for key in scenes):
            continue
        numbers = {
            k: float(np.mean([row[k] for row in members])) for k, v in members[0].items() if isinstance(v, float)
        }
        key: Row = {"scene": MEAN, "set": name, "spp": spp, "method": method, "layer": ALL}
        model = {"model": members[0]["model"]} if "model" in members[0] else {}
        made.append(key | numbers | model | results.oldest_stamp(members))
    return made


def main() -> None:
    parser = results.parser(__doc__)
    parser.add_argument("passes", type=Path)
    parser.add_argument("--scene", action="append", default=[], help="a folder in PASSES; default: all")
    args = parser.parse_args()
    scenes = args.scene or sorted(file.parent.name for file in args.passes.glob("*/ref.exr"))
    rows: list[Row] = []
    for scene, spp, scale in itertools.product(scenes, SPP, SCALES):
        measured = {tuple(row[key] for key in KEYS) for row in rows}
        # Methods without an LRHS are measured at the first scale alone.
        rows += measure(args.passes / scene, scale, spp, measured)
        print(f"{scene}, x{scale}, {2 * spp} spp", flush=True)
    print(results.plain(means(rows)))
    if args.table:
        add(args.table, rows)


def add(table: Path, rows: list[Row]) -> None:
    """Put rows of scenes into a table, whose means are computed anew."""
    results.write(table, rows, (*KEYS, "layer"))
    together = [row for row in results.read(table) if row["scene"] != MEAN]
    results.write(table, together + means(together))


if __name__ == "__main__":
    main()
