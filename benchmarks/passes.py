# SPDX-License-Identifier: Apache-2.0
"""Accuracy and time of fused passes, beside other ways to get clean layers that sum to the beauty.

    python -m benchmarks.passes PASSES --table benchmarks/results/passes.csv
    python -m benchmarks.passes PASSES --picture docs/images/passes.png

PASSES is made by :mod:`benchmarks.render.passes`. The methods, all but the first two with the albedo and the normal:

- "HRLS": the layers as they are rendered.
- "ratio": the fused beauty, divided as the noisy layers of the HRLS divide theirs.
- "OIDN": Open Image Denoise on each layer of the HRLS, the plain call. Its layers do not sum to a denoised beauty.
- "OIDN, rescaled": the same, scaled so that they sum to the fused beauty.
- "msspl": :mod:`oiio_msspl.fusion.passes`.
- "msspl, HRLS alone": the same without the layers of the LRHS.

"Regraded" is what a compositor makes of the layers: the first one is switched off, the second has four times its light.
"Worst" is the PSNR of the worst percent of the regraded pixels. The time is that of all layers of a set, without the
beauty, as a multiple of OIDN's plain call on the beauty.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks import results
from benchmarks.oidn import denoise
from benchmarks.results import MEAN, Row
from oiio_msspl import Session, find_model, fuse
from oiio_msspl.aovs.additive_sets import AdditiveSet
from oiio_msspl.aovs.features import ALBEDO, NORMAL
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.arrays import Array
from oiio_msspl.colour import srgb
from oiio_msspl.exr.preview import write_png
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.fusion.alignment import align
from oiio_msspl.fusion.passes import fuse_passes
from oiio_msspl.fusion.sums import layer_keys, with_layers
from oiio_msspl.metrics import psnr, relmse

SCALES, SPP, REPEATS = (2, 4), (1, 2), 3
KEYS = ("scene", "set", "spp", "method")


def layers_of(render: MappedRender, layers: AdditiveSet) -> Array:
    """The layers of a set, (layers, h, w, 3)."""
    pixels = with_layers(render, layers).read(render.data_window, layer_keys(layers))
    return np.stack([np.maximum(pixels[name], 0) for name in layer_keys(layers)])


def rescaled(layers: Array, beauty: Array) -> Array:
    """Layers that sum to the beauty, in the ratio of these."""
    total = layers.sum(axis=0)
    return layers * np.where(total > 0, beauty / np.where(total > 0, total, 1), 0)


def methods(
    lr: MappedRender, hr: MappedRender, beauty: Array, layers: AdditiveSet
) -> Iterator[tuple[str, Callable[[], Array]]]:
    """The name of each method, and a function that computes the layers."""
    noisy = layers_of(hr, layers)
    guides = hr.read(hr.data_window, [ALBEDO, NORMAL])

    def each() -> Array:
        return np.stack([denoise(layer, guides[ALBEDO], guides[NORMAL]) for layer in noisy])

    def ours(low: MappedRender) -> Array:
        fused = fuse_passes(low, hr, beauty, align(lr, hr), [layers])
        assert not fused.refused
        height = hr.data_window.height
        planes = [[fused.pixels.get(c, 0, height) for c in layer.channels] for layer in layers.layers]
        return np.moveaxis(np.asarray(planes, np.float32), 1, -1)

    yield "HRLS", lambda: noisy
    yield "ratio", lambda: rescaled(noisy, beauty)
    yield "OIDN", each
    yield "OIDN, rescaled", lambda: rescaled(np.maximum(each(), 0), beauty)
    yield "msspl", lambda: ours(lr)
    yield "msspl, HRLS alone", lambda: ours(replace(lr, additive_sets=[]))


def regraded(layers: Array) -> Array:
    """The beauty with the first layer switched off, and four times the light of the second one."""
    grades = np.array([0, 4, *[1] * (len(layers) - 2)], np.float32)
    return np.einsum("i,ihwc->hwc", grades, layers)


def picture(folder: Path, output: Path, model: str) -> None:
    """The light groups of a scene as rendered, fused and as they should be; below them the regraded beauty."""
    lr, hr, reference = (map_render(open_exr(folder / f"{name}.exr")) for name in ("lr_x4_32spp", "hr_2spp", "ref"))
    beauty = fuse(lr, hr, Session(find_model(4, model))).rgb
    layers = hr.additive_sets[0]
    made = dict(methods(lr, hr, beauty, layers))
    columns = [made["HRLS"](), made["msspl"](), layers_of(reference, reference.additive_sets[0])]
    columns = [column[:, :, 100:292] for column in columns]  # a PNG of noise is large
    rows = [np.concatenate([srgb(column[i]) for column in columns], axis=1) for i in range(2)]
    write_png(output, np.concatenate([*rows, np.concatenate([srgb(regraded(c)) for c in columns], axis=1)], axis=0))


def scores(layers: Array, reference: Array) -> Row:
    """Means over the layers, and the regraded picture."""
    graded, truth = regraded(layers), regraded(reference)
    errors = np.mean((srgb(graded) - srgb(truth)) ** 2, axis=-1).ravel()
    worst = np.sort(errors)[-len(errors) // 100 :].mean()
    pairs = list(zip(layers, reference, strict=True))
    return {
        "psnr": float(np.mean([psnr(a, b) for a, b in pairs])),
        "relmse": float(np.mean([relmse(a, b) for a, b in pairs])),
        "regraded_psnr": psnr(graded, truth),
        "regraded_relmse": relmse(graded, truth),
        "worst_psnr": float(-10 * np.log10(worst)),
    }


def timed(function: Callable[[], Array]) -> tuple[Array, float]:
    """The result and the median time of some calls."""
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        result = function()
        times.append(time.perf_counter() - start)
    return result, median(times)


def measure(folder: Path, scale: int, spp: int, model: str) -> list[Row]:
    """One scene: a row for each set and method."""
    names = f"lr_x{scale}_{scale**2 * spp}spp", f"hr_{spp}spp", "ref"
    lr, hr, reference = (map_render(open_exr(folder / f"{name}.exr")) for name in names)
    beauty = fuse(lr, hr, Session(find_model(scale, model))).rgb
    pixels = hr.load().layers
    _, oidn_seconds = timed(lambda: denoise(pixels["rgb"], pixels[ALBEDO], pixels[NORMAL]))
    rows = []
    for layers, truth in zip(hr.additive_sets, reference.additive_sets, strict=True):
        clean = layers_of(reference, truth)
        for name, function in methods(lr, hr, beauty, layers):
            result, seconds = timed(function)
            ours = name.startswith("msspl")
            row: Row = {"scene": folder.name, "set": layers.name, "spp": 2 * spp, "layers": len(clean)}
            row |= {"method": name.replace("msspl", f"msspl-x{scale}") if ours else name}
            rows.append(row | scores(result, clean) | {"time": 0.0 if name == "HRLS" else seconds / oidn_seconds})
    return rows


def means(rows: list[Row]) -> list[Row]:
    """Means over the scenes."""
    found = []
    for key in dict.fromkeys(tuple(row[k] for k in KEYS[1:]) for row in rows):
        same = [row for row in rows if tuple(row[k] for k in KEYS[1:]) == key]
        numbers = {k: float(np.mean([row[k] for row in same])) for k, v in same[0].items() if isinstance(v, float)}
        layers = float(np.mean([row["layers"] for row in same]))
        found.append({"scene": MEAN, **dict(zip(KEYS[1:], key, strict=True)), "layers": layers, **numbers})
    return found


def layout(rows: list[Row]) -> str:
    """The means, as a table."""
    titles = {"psnr": "PSNR", "relmse": "RelMSE", "regraded_psnr": "regraded: PSNR", "regraded_relmse": "RelMSE"}
    titles |= {"worst_psnr": "worst: PSNR", "time": "time / OIDN's"}
    formats = {key: "{:.4f}" if "relmse" in key else "{:.2f}" for key in titles}
    shown = [row for row in rows if row["scene"] == MEAN]
    body = [
        [row["set"], str(row["spp"]), row["method"], *(formats[key].format(row[key]) for key in titles)]
        for row in shown
    ]
    return results.markdown(["set", "spp", "method", *titles.values()], body)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("passes", type=Path)
    parser.add_argument("--model", default="joint")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="write a picture instead")
    parser.add_argument("--scene", default="lamp", help="of the picture")
    results.add_option(parser)
    args = parser.parse_args()
    if args.picture:
        picture(args.passes / args.scene, args.picture, args.model)
        return
    rows: list[Row] = []
    for file in sorted(args.passes.glob("*/ref.exr")):
        for spp in SPP:
            for scale in SCALES:
                known = {tuple(row[k] for k in KEYS) for row in rows}
                new = measure(file.parent, scale, spp, args.model)
                # What has no LRHS, and the ratio of another beauty, are measured at the first scale alone.
                rows += [row for row in new if tuple(row[k] for k in KEYS) not in known]
    rows += means(rows)
    print(layout(rows))
    if args.table:
        results.write(args.table, rows)


if __name__ == "__main__":
    main()
