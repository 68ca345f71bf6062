# SPDX-License-Identifier: Apache-2.0
"""Print how difficult a set of views is: noise, dynamic range, edges.

    python -m research.datagen.stats VIEWS [--validation RENDERS]

Every view is first exposed so that its reference has a log-mean luminance of 0.18, as a photograph would.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from oiio_msspl.image.colour import luminance as luminance_of
from oiio_msspl.image.metrics import psnr
from oiio_msspl.model.encoding import KEY
from research.datagen.quality import log_mean
from research.datagen.views import SAMPLES_SUFFIX

_MEASURES = {
    "psnr": "1-spp PSNR in sRGB [dB]",
    "ref_psnr": "reference's own PSNR [dB]",
    "log_mean": "log10 of the log-mean luminance",
    "range": "decades of luminance, 1st to 99th percentile",
    "black": "black pixels at 1 spp",
    "clipped": "reference pixels over display white",
    "edges": "pixels at an albedo edge",
}


def measure(noisy: np.ndarray, reference: np.ndarray, albedo: np.ndarray) -> dict[str, float]:
    """Measure one view from its 1-spp colour, its reference and an albedo with little noise, each (H, W, 3)."""
    luminance = np.maximum(luminance_of(reference), 0)
    mean = log_mean(reference)
    exposure = KEY / mean
    low, high = np.percentile(luminance, (1, 99))
    across = np.abs(np.diff(albedo, axis=1)).max(-1)[1:] > 0.08
    down = np.abs(np.diff(albedo, axis=0)).max(-1)[:, 1:] > 0.08
    return {
        "psnr": psnr(noisy * exposure, reference * exposure),
        "log_mean": float(np.log10(mean)),
        "range": float(np.log10(max(high, 1e-9) / max(low, 1e-6 * high, 1e-9))),
        "black": float((noisy.max(-1) <= 0).mean()),
        "clipped": float((luminance * exposure > 1).mean()),
        "edges": float((across | down).mean()),
    }


def training_views(folder: Path) -> Iterator[tuple[str, dict[str, float]]]:
    """(kind of scene, measures) of each view with passes."""
    for path in sorted(folder.glob("[!.]*.npz")):
        if path.name.endswith(SAMPLES_SUFFIX):
            continue
        with np.load(path) as view:
            hr, meta = view["hr"].astype(np.float32), json.loads(str(view["meta"]))
            numbers = measure(hr[0, ..., :3], view["ref"].astype(np.float32), hr[..., 3:6].mean(0))
        yield meta["kind"], {**numbers, "ref_psnr": meta["ref_psnr"]}


def validation_views(folder: Path) -> Iterator[tuple[str, dict[str, float]]]:
    """(scene, measures) of each folder that holds ``hr_1spp.exr`` and ``ref.exr``."""
    import OpenImageIO as oiio

    def read(path: Path, names: list[str]) -> np.ndarray:
        buffer = oiio.ImageBuf(str(path))
        have = buffer.spec().channelnames
        return buffer.get_pixels(oiio.FLOAT)[..., [have.index(n) for n in names]]

    for path in sorted(folder.glob("*/hr_1spp.exr")):
        # The albedo of the highest spp: the edges of a 1-spp albedo include its aliasing.
        best = max(path.parent.glob("hr_*spp.exr"), key=lambda p: int(p.stem[3:-3]))
        rgb = list("RGB")
        albedo = read(best, ["albedo.R", "albedo.G", "albedo.B"])
        yield path.parent.name, measure(read(path, rgb), read(path.with_name("ref.exr"), rgb), albedo)


def _row(name: str, views: list[dict[str, float]], key: str) -> str:
    values = [v[key] for v in views if key in v]
    if not values:
        return f"  {name:14s} {'-':>8s}"
    p10, p50, p90 = np.percentile(values, (10, 50, 90))
    return f"  {name:14s} {p50:8.3f} {p10:8.3f} {p90:8.3f}   n={len(values)}"


def main() -> None:
    p = argparse.ArgumentParser(prog="python -m research.datagen.stats", description=__doc__.split("\n")[0])
    p.add_argument("folder", type=Path, help="folder of .npz views")
    p.add_argument("--validation", type=Path, help="folder with <scene>/hr_1spp.exr and ref.exr to compare with")
    args = p.parse_args()

    sets: dict[str, list[dict[str, float]]] = {"training": []}
    kinds: dict[str, list[dict[str, float]]] = {}
    for kind, numbers in training_views(args.folder):
        sets["training"].append(numbers)
        kinds.setdefault(kind, []).append(numbers)
    if args.validation:
        sets["validation"] = [numbers for _, numbers in validation_views(args.validation)]
    for key, title in _MEASURES.items():
        print(f"{title}: median, 10 %, 90 %")
        for name, views in sets.items():
            print(_row(name, views, key))
    print(f"{_MEASURES['psnr']} by kind: median, 10 %, 90 %")
    for kind, views in sorted(kinds.items()):
        print(_row(kind, views, "psnr"))


if __name__ == "__main__":
    main()
