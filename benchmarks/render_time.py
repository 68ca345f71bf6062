# SPDX-License-Identifier: Apache-2.0
"""How long the scenes of `benchmarks.quality` take to render: the larger part of what a user waits for.

    python -m benchmarks.render_time ../shared/scenes --json results/render_time.json

Every ``NAME/*.xml`` is rendered with Mitsuba 3, albedo and normal, as its HRLS was: a 384 x 256 crop, here the middle,
of a frame whose longer side is 1280 pixels. Printed: seconds for one sample a pixel of 1024 x 1024, the median of the
repeats after one that compiles; and the same at a quarter of the resolution with 16 times the samples, which should
take as long.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np

LONGER, CROP = 1280, (384, 256)
SPP, SCALE = 4, 4
MEGAPIXEL = 1024 * 1024


def seconds_per_spp(path: Path, repeats: int) -> dict[str, float]:
    """``hrls`` and ``lrhs``: seconds for one sample in each of 1024 x 1024 pixels."""
    import mitsuba as mi

    scene = mi.load_file(str(path))
    integrator: Any = mi.load_dict(
        {"type": "aov", "aovs": "albedo:albedo,nn:sh_normal", "img": {"type": "path", "max_depth": 12}}
    )
    film = mi.traverse(scene.sensors()[0])
    original = np.array(scene.sensors()[0].film().size())
    full = np.round(original * LONGER / original.max() / 8).astype(int) * 8
    result = {}
    for name, scale in (("hrls", 1), ("lrhs", SCALE)):
        size, crop = full // scale, np.array(CROP) // scale
        film["film.size"] = mi.ScalarVector2u(*size)
        film["film.crop_size"] = mi.ScalarVector2u(*crop)
        film["film.crop_offset"] = mi.ScalarPoint2u(*((size - crop) // 2))
        film.update()
        spp = SPP * scale**2
        times = []
        for seed in range(repeats + 1):
            start = time.perf_counter()
            mi.render(scene, integrator=integrator, spp=spp, seed=seed).numpy()
            times.append(time.perf_counter() - start)
        result[name] = statistics.median(times[1:]) * MEGAPIXEL / (crop[0] * crop[1] * spp)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    import mitsuba as mi

    mi.set_variant(args.variant)
    rows = {path.parent.name: seconds_per_spp(path, args.repeats) for path in sorted(args.scenes.glob("*/*.xml"))}
    print("| scene | HRLS, s | LRHS x4, s |\n|---|---|---|")
    for name, row in rows.items():
        print(f"| {name} | {row['hrls']:.2f} | {row['lrhs']:.2f} |")
    if args.json:
        args.json.write_text(json.dumps({"seconds_per_spp": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
