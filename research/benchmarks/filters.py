# SPDX-License-Identifier: Apache-2.0
"""Measure accuracy by pixel filter: equal samples, filtered as renderers filter them.

    python -m research.benchmarks.filters VIEWS --table research/benchmarks/results/filters.csv

VIEWS keep their samples (:mod:`research.datagen.samples`). Those that no network was trained on are used: the splits
``validation``, whose references Open Image Denoise (OIDN) has cleaned, and ``test``. Each filter gives an HRLS of 1
spp, an LRHS of half the size that is filtered in its own pixels and has as many samples, and a reference.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from oiio_msspl import Render, fuse
from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.metrics import psnr
from oiio_msspl.model.catalogue import load_model
from oiio_msspl.model.encoding import find_exposure
from research.benchmarks import results
from research.benchmarks.peers import oidn_prefiltered
from research.benchmarks.results import Row
from research.datagen.views import REF_CELLS, Folder, SampleView
from research.training.data import SampleTensors, decode_radiance
from research.training.splat import PixelFilter, apply, filter_reference

#: Spread, then importance sampled.
FILTERS = (
    PixelFilter("gaussian", 2.0),
    PixelFilter("wide-gaussian", 1.0),
    PixelFilter("blackman-harris", 0.75),
    PixelFilter("blackman-harris", 1.65),
    PixelFilter("tent", 1.0),
    PixelFilter("mitchell", 2.0),
    PixelFilter("lanczos", 2.0),
    PixelFilter("box", 1.0),
    PixelFilter("box", 0.5),
    PixelFilter("blackman-harris", 0.75, splatted=False),
)
SCALE, SPP = 2, 1
MODELS = ("joint-x2", "joint-large-x2", "joint-spread-x2", "joint-large-spread-x2")
OIDN = "OIDN prefiltered on the HRLS"
FEATURES = (RGB, ALBEDO, NORMAL)
#: Names of the stored arrays.
STORED = {RGB: "color", ALBEDO: ALBEDO, NORMAL: NORMAL}


def filtered(view: SampleTensors, prefix: str, pixel_filter: PixelFilter, scale: int) -> dict[str, Array]:
    """Return the layers of a render with ``SPP`` samples for each HRLS pixel, (h, w, 3) by name."""
    rows, columns = (slice(0, side) for side in view.size)
    stored = len(view.arrays[f"{prefix}color"])
    samples = torch.arange(min(pixel_filter.samples_for(SPP), stored))
    values = [view.read(prefix + STORED[name], samples, rows, columns) for name in FEATURES]
    place = view.read(f"{prefix}place", samples, rows, columns)
    generator = torch.Generator().manual_seed(scale)
    mean = apply(pixel_filter, place, torch.cat(values, dim=1), scale, SPP * scale**2, generator)
    return {name: part.movedim(0, -1).numpy() for name, part in zip(FEATURES, mean.split(3), strict=True)}


def pair(view: SampleView, pixel_filter: PixelFilter) -> tuple[Render, Render, Array]:
    """Return LRHS, HRLS and reference (h, w, 3), exposed."""
    tensors = SampleTensors(view, torch.device("cpu"))
    cells = decode_radiance(tensors.arrays["ref"][None])[0]
    reference = filter_reference(pixel_filter, cells, REF_CELLS).movedim(0, -1).clamp_min(0).numpy()
    exposure = np.float32(find_exposure(reference))
    renders = []
    for prefix, scale in (("lr_", SCALE), ("", 1)):
        layers = filtered(tensors, prefix, pixel_filter, scale)
        layers[RGB] = np.maximum(layers[RGB], 0) * exposure  # filters with negative lobes
        renders.append(Render.from_arrays(f"{prefix}{view.path.name}", **layers))
    return renders[0], renders[1], reference * exposure


def measure(views: list[SampleView]) -> Iterator[Row]:
    """Yield a row for each filter and method."""
    sessions = {name: load_model(SCALE, name) for name in MODELS}
    for pixel_filter in FILTERS:
        way = "" if pixel_filter.splatted else ", importance sampled"
        kind = f"{pixel_filter.kind}, radius {pixel_filter.radius}{way}"
        pairs = [pair(view, pixel_filter) for view in views]
        for method in (OIDN, *sessions):
            scores = []
            for lrhs, hrls, reference in pairs:
                image = oidn_prefiltered(hrls) if method == OIDN else fuse(lrhs, hrls, sessions[method]).rgb
                scores.append(psnr(image, reference))
            row: Row = {"filter": kind, "spp": 2 * SPP, "method": method, **results.model_of(method)}
            yield row | {"psnr": statistics.fmean(scores)}


def main() -> None:
    parser = results.parser(__doc__)
    parser.add_argument("views", type=Path)
    args = parser.parse_args()
    folder = Folder(args.views)
    views = [view for split in ("validation", "test") for view in folder.sample_views(split)]
    if not views:
        raise SystemExit(f"{args.views}: no views with samples for validation or testing")
    results.show(list(measure(views)), args.table)


if __name__ == "__main__":
    main()
