# SPDX-License-Identifier: Apache-2.0
"""Ways to denoise both renders with Open Image Denoise at the LRHS's resolution, as `oiio_msspl.model.oidn` does.

    python -m benchmarks.together VIEWS

Every third validation view (:mod:`datagen.views`) is used. PSNR is of sRGB pictures, in two places: at the LRHS's
resolution, against the mean of the reference over s x s pixels; and at full resolution, where the denoised HRLS gets
the local means of that picture. OIDN has the quality "high".
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from benchmarks import results
from benchmarks.peers import match_local_means
from benchmarks.results import Row
from datagen.views import Folder, View, as_float32, mean_lrhs, read_hrls, split_features
from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.arrays import Array, box_downsample
from oiio_msspl.metrics import psnr
from oiio_msspl.model.contract import SCALES
from oiio_msspl.model.encoding import encode_radiance, find_exposure
from oiio_msspl.model.render_mean import lrhs_weight

#: spp of the HRLS, and average spp of the LRHS.
SPP = (1, 4)


def denoise(color: Array, albedo: Array, normal: Array, *, clean: bool = False, albedo_first: bool = False) -> Array:
    """Open Image Denoise on an HDR picture (h, w, 3). ``albedo_first`` prefilters the albedo and implies ``clean``."""
    import pyoidn

    albedo = np.ascontiguousarray(albedo.clip(0, 1))
    if albedo_first:
        albedo = pyoidn.denoise(albedo).clip(0, 1)
    image = pyoidn.denoise(
        np.ascontiguousarray(color), albedo, np.ascontiguousarray(normal), hdr=True, clean_aux=clean or albedo_first
    )
    return np.maximum(image, 0)


def ways(lrhs: Array, color: Array, albedo: Array, normal: Array) -> dict[str, Array]:
    """Results of every way to denoise, from images (h, w, 3) at the LRHS's resolution."""
    share = lrhs_weight(encode_radiance(lrhs, 1.0), encode_radiance(color, 1.0))
    weighted = share * lrhs + (1 - share) * color
    return {
        "the LRHS alone": denoise(lrhs, albedo, normal),
        "mean of both": denoise((lrhs + color) / 2, albedo, normal),
        "mean, weighted by noise": denoise(weighted, albedo, normal),
        "weighted, cleanAux": denoise(weighted, albedo, normal, clean=True),
        "weighted, cleanAux, albedo prefiltered": denoise(weighted, albedo, normal, albedo_first=True),
    }


def measure(view: View) -> list[Row]:
    """A row for each scale, spp of the HRLS, average spp of the LRHS and way."""
    rows = []
    whole = slice(None)
    passes = read_hrls(view, list(range(max(SPP))), whole, whole)
    for spp in SPP:
        layers = split_features(passes[:spp].mean(axis=0))
        for average in SPP:
            chosen = np.flatnonzero(view.lr_spp == average)[:1]
            exposure = np.float32(find_exposure(mean_lrhs(view, chosen, SCALES[0])))
            color, albedo, normal = layers[RGB] * exposure, layers[ALBEDO], layers[NORMAL]
            reference = as_float32(view.ref) * exposure
            alone = denoise(color, albedo, normal)
            for scale in SCALES:
                small = [box_downsample(image, scale) for image in (color, albedo, normal)]
                expected = box_downsample(reference, scale)
                for way, image in ways(mean_lrhs(view, chosen, scale) * exposure, *small).items():
                    full = match_local_means(alone, image)
                    row: Row = {"scale": scale, "hrls_spp": spp, "lrhs_spp": average, "method": way}
                    row |= {"psnr_low": psnr(image, expected), "psnr_full": psnr(full, reference)}
                    rows.append(row)
    return rows


def means(rows: list[Row]) -> list[Row]:
    """Mean PSNR over the views."""
    groups: dict[tuple[int, int, int, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["hrls_spp"], row["lrhs_spp"], row["scale"], row["method"]), []).append(row)
    columns = ("psnr_low", "psnr_full")
    return [
        members[0] | {c: float(np.mean([row[c] for row in members])) for c in columns} for members in groups.values()
    ]


def layout(rows: list[Row]) -> str:
    """One table for each of the two places, a column for each way."""
    names = list(dict.fromkeys(row["method"] for row in rows))
    found = results.index(rows, "scale", "hrls_spp", "lrhs_spp", "method")
    tables = []
    for column, title in (("psnr_low", "at the LRHS's resolution"), ("psnr_full", "at full resolution")):
        body = [
            [f"x{scale}, HRLS {spp} spp, LRHS {average} on average"]
            + [f"{found[scale, spp, average, name][column]:.2f}" for name in names]
            for scale, spp, average in dict.fromkeys((row["scale"], row["hrls_spp"], row["lrhs_spp"]) for row in rows)
        ]
        tables.append(results.markdown([title, *names], body))
    return "\n".join(tables)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("views", type=Path)
    results.add_option(parser)
    args = parser.parse_args()
    views = Folder(args.views).split("validation")[::3]
    rows = means([row for view in views for row in measure(view)])
    print(f"Means over {len(views)} views.\n\n{layout(rows)}")
    if args.table:
        results.write(args.table, rows)


if __name__ == "__main__":
    main()
