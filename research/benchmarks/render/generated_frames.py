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
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from research.benchmarks.render.film import write_exr
from research.benchmarks.render.pairs import launched
from research.benchmarks.render.sequences import CHANNELS
from research.datagen.mitsuba import start as start_mitsuba
from research.training.splat import BOX, PixelFilter, apply

#: The first seed.
FIRST = 9000
#: Folder's suffix -> width and height of the frame.
SIZES = {"": (640, 400), "-right": (645, 397)}
HRLS = (1, 8)
#: Scale, and samples of the LRHS for every HRLS pixel.
LRHS = ((2, 1), (4, 1), (4, 4), (8, 1))
#: Samples that are rendered at once.
LAUNCH = 1_000_000
LAYERS = ("color", "albedo", "normal")
#: The second one is Mitsuba's default.
FILTERS = BOX, PixelFilter("gaussian", 2.0)


def render(scene: Any, camera: Any, folder: Path, size: tuple[int, int], pixel_filter: PixelFilter) -> None:
    """Render the files of one camera that do not exist yet."""
    aspect = size[1] / size[0]  # the camera's own picture is square
    wide: Any = SimpleNamespace(rays=lambda x, y, lens: camera.rays(x, (y - 0.5) * aspect + 0.5, lens))
    jobs = [(f"hr_{spp}spp", 1, spp) for spp in HRLS]
    jobs += [(f"lr_x{scale}_{scale**2 * n}spp", scale, scale**2 * n) for scale, n in LRHS]
    for name, scale, spp in jobs:
        path = folder / f"{name}.exr"
        if path.exists():
            continue
        low = (size[0] // scale, size[1] // scale)
        launches = list(launched(scene, wide, low, spp, f"{folder.name} {name}", LAYERS, LAUNCH))
        layers = {layer: torch.from_numpy(np.concatenate([x[layer] for x in launches])) for layer in launches[0]}
        values = torch.cat([layers[layer].movedim(-1, 1) for layer in LAYERS], dim=1)
        folder.mkdir(parents=True, exist_ok=True)
        write_exr(path, apply(pixel_filter, layers["place"], values).movedim(0, -1).numpy(), CHANNELS)


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
                render(scene, camera, args.out / f"{plan.kind}-{seed}{suffix}", size, FILTERS[seed % 2])
        gc.collect()  # scenes are reference cycles, which only the collector frees


if __name__ == "__main__":
    main()
