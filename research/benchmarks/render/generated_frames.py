# SPDX-License-Identifier: Apache-2.0
"""Render whole frames of generated scenes for `research.benchmarks.pair_checks`, with Mitsuba 3.

    python -m research.benchmarks.render.generated_frames OUT --assets ASSETS

The scenes are those of `research.datagen.mitsuba`, two cameras each. Every camera gets a folder with HRLS of 1 and 8
spp, LRHS of one sample for every HRLS pixel, and one of four samples at x4. All have albedo and normal. Even seeds have
a box filter of one pixel. Odd seeds have a Gaussian filter that spreads every sample over the pixels around it. Frames
of the second camera have an odd size. Files that exist are kept.
"""

from __future__ import annotations

import argparse
import gc
import itertools
import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from oiio_msspl.image.arrays import Array
from research.benchmarks.render.film import write_exr
from research.benchmarks.render.sequences import CHANNELS
from research.datagen.mitsuba import start as start_mitsuba

#: The first seed.
FIRST = 9000
#: Folder's suffix -> width and height of the frame.
SIZES = {"": (640, 400), "-right": (645, 397)}
HRLS = (1, 8)
#: Scale, and samples of the LRHS for every HRLS pixel.
LRHS = ((2, 1), (4, 1), (4, 4), (8, 1))
#: Samples that are rendered at once.
LAUNCH = 1_000_000
#: Standard deviation and radius of the Gaussian filter in pixels: Mitsuba's default.
DEVIATION, RADIUS = 0.5, 2.0


def splat(values: Array, place: Array) -> tuple[Array, Array]:
    """Spread samples (n, h, w, c) over the pixels around them, by a Gaussian filter of their places (n, h, w, 2).

    Returns:
        The weighted sums (h, w, c), and the sums of the weights (h, w, 1).
    """
    reach = int(RADIUS)
    height, width = values.shape[1:3]
    sums = np.zeros((height + 2 * reach, width + 2 * reach, values.shape[3] + 1), np.float32)
    values = np.concatenate([values, np.ones_like(values[..., :1])], axis=-1)
    outermost = np.exp(-(RADIUS**2) / (2 * DEVIATION**2))
    weights = {}
    for step in range(-reach, reach + 1):
        distance = step + np.float32(0.5) - place  # to the centre of the pixel that is this many pixels further
        weights[step] = np.maximum(np.exp(-np.square(distance) / (2 * DEVIATION**2)) - outermost, 0)
    for y, x in itertools.product(weights, repeat=2):
        weight = weights[x][..., 0] * weights[y][..., 1]
        spread = np.einsum("nhwc,nhw->hwc", values, weight)
        sums[reach + y : reach + y + height, reach + x : reach + x + width] += spread
    sums = sums[reach:-reach, reach:-reach]
    return sums[..., :-1], sums[..., -1:]


def render(scene: Any, camera: Any, folder: Path, size: tuple[int, int], gaussian: bool) -> None:
    """Render the files of one camera that do not exist yet."""
    from research.datagen.mitsuba.trace import render_samples

    aspect = size[1] / size[0]  # the camera's own picture is square
    wide: Any = SimpleNamespace(rays=lambda x, y, lens: camera.rays(x, (y - 0.5) * aspect + 0.5, lens))
    jobs = [(f"hr_{spp}spp", 1, spp) for spp in HRLS]
    jobs += [(f"lr_x{scale}_{scale**2 * n}spp", scale, scale**2 * n) for scale, n in LRHS]
    for name, scale, spp in jobs:
        path = folder / f"{name}.exr"
        if path.exists():
            continue
        width, height = (n // scale for n in size)
        per_launch = max(1, LAUNCH // (width * height))
        total, weights = np.zeros((height, width, 9), np.float32), np.zeros((height, width, 1), np.float32)
        for done in range(0, spp, per_launch):
            count = min(per_launch, spp - done)
            seed = zlib.crc32(f"{folder.name} {name} {done}".encode())
            samples = render_samples(scene, wide, (width, height), count, seed)
            values = np.concatenate([samples[layer] for layer in ("color", "albedo", "normal")], axis=-1)
            sums = splat(values, samples["place"]) if gaussian else (values.sum(axis=0), np.float32(count))
            total, weights = total + sums[0], weights + sums[1]
        folder.mkdir(parents=True, exist_ok=True)
        write_exr(path, total / np.maximum(weights, 1e-6), CHANNELS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", type=int, default=12)
    parser.add_argument("--assets", type=Path, required=True, help="folder of HDRIs and models")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    start_mitsuba(args.threads)
    # These modules name Mitsuba's types, which exist only after a variant is set.
    from research.datagen.mitsuba import scenes
    from research.datagen.mitsuba.assets import Assets
    from research.datagen.mitsuba.render import find_cameras

    assets = Assets(args.assets)
    for seed in range(FIRST, FIRST + args.scenes):
        scene, plan = scenes.build(seed, assets)
        print(f"{plan.kind}-{seed}", flush=True)
        for view, (suffix, size) in enumerate(SIZES.items()):
            camera = next(find_cameras(scene, plan, seed, view), None)
            if camera is not None:
                render(scene, camera, args.out / f"{plan.kind}-{seed}{suffix}", size, seed % 2 == 1)
        gc.collect()  # scenes are reference cycles, which only the collector frees


if __name__ == "__main__":
    main()
