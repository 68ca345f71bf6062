# SPDX-License-Identifier: Apache-2.0
"""HRLS of 3, 6 and 7 spp beside the renders that `benchmarks.quality` judges by, for pairs that are not halved.

    python -m benchmarks.uneven_renders SCENES RENDERS

The same crops by the same integrator as the HRLS that are there, with noise of their own. Files that exist are kept.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from benchmarks.flicker_render import AOVS, MAX_DEPTH, write_exr
from benchmarks.render_time import CROP
from training import mitsuba_start

#: Scene -> longer side of the whole frame, and where the crop begins (x, y). Found by its albedo and normals.
CROPS = {
    "cornell-box": (768, (112, 448)),
    "lamp": (1280, (576, 384)),
    "spaceship": (1280, (384, 264)),
    "staircase2": (1280, (448, 304)),
    "tire": (1280, (384, 704)),
}
SPP = (3, 6, 7)


def render(file: Path, folder: Path, longer: int, offset: tuple[int, int]) -> None:
    """What is missing of one scene."""
    mi = mitsuba_start.start()
    scene = mi.load_file(str(file))
    film = mi.traverse(scene.sensors()[0])
    original = np.array(scene.sensors()[0].film().size())
    full = np.round(original * longer / original.max() / 8).astype(int) * 8
    film["film.size"] = mi.ScalarVector2u(*full)
    film["film.crop_size"] = mi.ScalarVector2u(*CROP)
    film["film.crop_offset"] = mi.ScalarPoint2u(*offset)
    film.update()
    aovs = ",".join(aov for aov in AOVS.split(",") if not aov.startswith("pp:"))
    integrator = mi.load_dict({"type": "aov", "aovs": aovs, "img": {"type": "path", "max_depth": MAX_DEPTH}})
    for i, spp in enumerate(SPP):
        path = folder / f"hr_{spp}spp.exr"
        if not path.exists():
            image = np.array(mi.render(scene, integrator=integrator, spp=spp, seed=(300 + i) * 1000))
            write_exr(path, np.where(np.isfinite(image), image, 0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("renders", type=Path)
    args = parser.parse_args()
    for name, (longer, offset) in CROPS.items():
        render(args.scenes / name / "scene.xml", args.renders / name, longer, offset)
        print(name, flush=True)


if __name__ == "__main__":
    main()
