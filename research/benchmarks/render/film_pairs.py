# SPDX-License-Identifier: Apache-2.0
"""Renders the same views with a box filter and with Mitsuba's default one, a Gaussian that spreads samples.

    python -m research.benchmarks.render.film_pairs SCENES OUT --threads 2

Of every ``NAME/scene.xml``, a crop of 376 x 232 pixels in the middle is rendered by Mitsuba's own film into
``OUT/box/NAME`` and ``OUT/gaussian/NAME``: HRLS of 1 to 8 spp, LRHS, and a reference with the same filter.
`research.benchmarks.accuracy` reads both folders. Files that exist are kept.
"""

from __future__ import annotations

import argparse
import re
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from oiio_msspl.errors import InputError
from oiio_msspl.model.contract import SCALES
from research.benchmarks.render.film import frame_size, set_crop, write_exr
from research.datagen.mitsuba.start import start as start_mitsuba

#: Width and height in pixels: no multiples of 16.
CROP = np.array((376, 232))
FILTERS = ("box", "gaussian")
#: Name, scale and spp of each render.
RENDERS = [("ref", 1, 256), *((f"hr_{n}spp", 1, n) for n in (1, 2, 4, 8))]
RENDERS += [(f"lr_x{scale}_{scale**2 * n}spp", scale, scale**2 * n) for scale in SCALES for n in (1, 2, 4)]
#: Samples that are rendered at once; more need more memory.
LAUNCH = 1_500_000
DEPTH = 16
CHANNELS = ("R", "G", "B", "albedo.R", "albedo.G", "albedo.B", "nn.X", "nn.Y", "nn.Z")


def render(mi: Any, file: Path, out: Path, pixel_filter: str) -> None:
    """Render the files of one scene with one filter that do not exist yet."""
    mi.file_resolver().prepend(str(file.parent))  # before the folders of other scenes
    scene = mi.load_string(re.sub(r'<rfilter type="\w+"', f'<rfilter type="{pixel_filter}"', file.read_text()))
    sensor = scene.sensors()[0]
    if pixel_filter not in str(sensor.film().rfilter()).lower():
        raise InputError(f"{file}: has no <rfilter> that could be replaced")
    frame = frame_size(sensor)
    path = {"type": "path", "max_depth": DEPTH}
    layers = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,nn:sh_normal", "img": path})
    for name, scale, spp in RENDERS:
        target = out / pixel_filter / file.parent.name / f"{name}.exr"
        if target.exists():
            continue
        set_crop(mi, mi.traverse(sensor), frame // scale, CROP // scale, (frame - CROP) // 2 // 8 * 8 // scale)
        per_launch, total = max(1, LAUNCH // int(np.prod(CROP // scale))), 0.0
        for done in range(0, spp, per_launch):
            count = min(per_launch, spp - done)
            seed = zlib.crc32(f"{target.parent.name} {pixel_filter} {name} {done}".encode())
            image = np.asarray(mi.render(scene, integrator=layers, spp=count, seed=seed), np.float64)
            total = total + count * image
        target.parent.mkdir(parents=True, exist_ok=True)
        write_exr(target, np.asarray(total / spp, np.float32)[..., : len(CHANNELS)], CHANNELS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    mi = start_mitsuba(args.threads)
    for file in sorted(args.scenes.glob("*/scene.xml")):
        for pixel_filter in FILTERS:
            start = time.perf_counter()
            render(mi, file, args.out, pixel_filter)
            print(f"{file.parent.name}, {pixel_filter}: {time.perf_counter() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
