# SPDX-License-Identifier: Apache-2.0
"""Time to render the development scenes, which is most of what a user waits for.

    python -m research.benchmarks.render_time SCENES --table research/benchmarks/results/render_time.csv

Mitsuba 3 renders every ``NAME/*.xml`` with albedo and normal: a crop of 384 x 256 pixels, in the middle of a frame
whose longer side has 1280 pixels. The result is the time for one sample in each of 1024 x 1024 pixels: the median of
the repeats, after one that compiles. The LRHS, with a quarter of the resolution and 16 times the samples, should take
as long as the HRLS.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np

from research.benchmarks import results
from research.benchmarks.render.film import CROP, frame_size, set_crop

SPP, SCALE = 4, 4
MEGAPIXEL = 1024 * 1024


def seconds_per_spp(path: Path, repeats: int) -> dict[str, float]:
    """``hrls_s`` and ``lrhs_s``: seconds for one sample in each of 1024 x 1024 pixels."""
    import mitsuba as mi

    scene = mi.load_file(str(path))
    integrator: Any = mi.load_dict(
        {"type": "aov", "aovs": "albedo:albedo,nn:sh_normal", "img": {"type": "path", "max_depth": 12}}
    )
    sensor = scene.sensors()[0]
    parameters, full = mi.traverse(sensor), frame_size(sensor)
    result = {}
    for name, scale in (("hrls_s", 1), ("lrhs_s", SCALE)):
        size, crop = full // scale, np.array(CROP) // scale
        set_crop(mi, parameters, size, crop, (size - crop) // 2)
        spp = SPP * scale**2
        times = []
        for seed in range(repeats + 1):
            start = time.perf_counter()
            mi.render(scene, integrator=integrator, spp=spp, seed=seed).numpy()
            times.append(time.perf_counter() - start)
        result[name] = statistics.median(times[1:]) * MEGAPIXEL / float(crop[0] * crop[1] * spp)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--variant", default="llvm_ad_rgb")
    results.add_option(parser)
    args = parser.parse_args()
    import mitsuba as mi

    mi.set_variant(args.variant)
    paths = sorted(args.scenes.glob("*/*.xml"))
    rows = [{"scene": path.parent.name, **seconds_per_spp(path, args.repeats)} for path in paths]
    body = [[row["scene"], f"{row['hrls_s']:.2f}", f"{row['lrhs_s']:.2f}"] for row in rows]
    print(results.markdown(["scene", "HRLS, s", f"LRHS x{SCALE}, s"], body))
    if args.table:
        results.write(args.table, rows)


if __name__ == "__main__":
    main()
