# SPDX-License-Identifier: Apache-2.0
"""What both renders are worth to Open Image Denoise at the LRHS's resolution: the figures behind `oiio_msspl.denoiser`.

    python -m benchmarks.together VIEWS

Of the views for validation (:mod:`training.views`), every third, the PSNR in sRGB of ways to denoise: at the LRHS's
resolution, against the mean of the reference over s x s pixels; and "at full resolution" of the HRLS's own result when
it is brought to the local brightness of each of them. Quality high.
"""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path

import numpy as np
import pyoidn

from benchmarks.quality import brought_to
from oiio_msspl import metrics, schema, transforms
from oiio_msspl.denoiser import lrhs_share
from oiio_msspl.render import Array
from oiio_msspl.schema import SCALES
from training import data

SPP = (1, 4)


def denoise(color: Array, albedo: Array, normal: Array, *, clean: bool = False, albedo_first: bool = False) -> Array:
    """Open Image Denoise on an HDR picture (h, w, 3)."""
    albedo = np.ascontiguousarray(albedo.clip(0, 1))
    if albedo_first:
        albedo = pyoidn.denoise(albedo).clip(0, 1)
    image = pyoidn.denoise(
        np.ascontiguousarray(color), albedo, np.ascontiguousarray(normal), hdr=True, clean_aux=clean or albedo_first
    )
    return np.maximum(image, 0)


def results(lrhs: Array, color: Array, albedo: Array, normal: Array) -> dict[str, Array]:
    """By the way it was made, of images (h, w, 3) at the LRHS's resolution."""
    share = lrhs_share(transforms.compress(lrhs, 1.0), transforms.compress(color, 1.0))
    together = share * lrhs + (1 - share) * color
    return {
        "the LRHS": denoise(lrhs, albedo, normal),
        "both, half of each": denoise((lrhs + color) / 2, albedo, normal),
        "both, by their noise": denoise(together, albedo, normal),
        "told that albedo and normal are clean": denoise(together, albedo, normal, clean=True),
        "and the albedo denoised first": denoise(together, albedo, normal, albedo_first=True),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("views", type=Path)
    args = parser.parse_args()
    views = data.Folder(args.views).split("validation")[::3]
    whole = slice(None)
    scores: dict[tuple[str, int, int, int], list[tuple[float, float]]] = {}
    for view in views:
        passes = data.read_hrls(view, list(range(max(SPP))), whole, whole)
        for spp in SPP:
            for average in SPP:
                chosen = np.flatnonzero(view.lr_spp == average)[:1]
                layers = data.split_features(passes[:spp].mean(axis=0))
                color, albedo, normal = (layers[name] for name in (schema.RGB, schema.ALBEDO, schema.NORMAL))
                exposure = np.float32(transforms.exposure_of(data.mean_lrhs(view, chosen, SCALES[0])))
                reference = data.read(view.ref) * exposure
                alone = denoise(color * exposure, albedo, normal)
                for scale in SCALES:
                    of_hrls = [transforms.box_downsample(image, scale) for image in (color * exposure, albedo, normal)]
                    small = [data.mean_lrhs(view, chosen, scale) * exposure, *of_hrls]
                    expected = transforms.box_downsample(reference, scale)
                    for name, image in results(*small).items():
                        scores.setdefault((name, scale, spp, average), []).append(
                            (metrics.psnr(image, expected), metrics.psnr(brought_to(alone, image), reference))
                        )
    print(f"{len(views)} views\n")
    ways = list(dict.fromkeys(key[0] for key in scores))
    for part, title in enumerate(("at the LRHS's resolution", "at full resolution")):
        print(f"| {title} | " + " | ".join(ways) + " |\n|---|" + "---|" * len(ways))
        for scale, spp, average in sorted({key[1:] for key in scores}, key=lambda case: (case[1:], case[0])):
            means = (statistics.fmean(pair[part] for pair in scores[way, scale, spp, average]) for way in ways)
            row = " | ".join(f"{mean:.2f}" for mean in means)
            print(f"| x{scale}, HRLS {spp} spp, LRHS {average} on average | {row} |")
        print()


if __name__ == "__main__":
    main()
