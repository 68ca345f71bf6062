# SPDX-License-Identifier: Apache-2.0
"""Renders HRLS of 3, 6 and 7 spp beside the development scenes' own, for pairs with an uneven division of samples.

    python -m research.benchmarks.render.uneven SCENES RENDERS

The crops and the integrator are those of the HRLS that are there. The noise is independent. Files that exist are kept.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from research.benchmarks.render.film import CROP, frame_size, set_crop, write_exr
from research.benchmarks.render.sequences import AOVS, CHANNELS, MAX_DEPTH
from research.datagen.mitsuba.start import start as start_mitsuba

#: Scene -> longer side of the whole frame, and where the crop begins (x, y), as found by matching albedo and normals.
CROPS = {
    "cornell-box": (768, (112, 448)),
    "lamp": (1280, (576, 384)),
    "spaceship": (1280, (384, 264)),
    "staircase2": (1280, (448, 304)),
    "tire": (1280, (384, 704)),
}
SPP = (3, 6, 7)


def render(file: Path, folder: Path, longer: int, offset: tuple[int, int]) -> None:
    """Render the files of one scene that do not exist yet."""
    mi = start_mitsuba()
    scene = mi.load_file(str(file))
    sensor = scene.sensors()[0]
    set_crop(mi, mi.traverse(sensor), frame_size(sensor, longer), CROP, offset)
    aovs = ",".join(aov for aov in AOVS.split(",") if not aov.startswith("pp:"))
    integrator = mi.load_dict({"type": "aov", "aovs": aovs, "img": {"type": "path", "max_depth": MAX_DEPTH}})
    for i, spp in enumerate(SPP):
        path = folder / f"hr_{spp}spp.exr"
        if not path.exists():
            image = np.array(mi.render(scene, integrator=integrator, spp=spp, seed=(300 + i) * 1000))
            write_exr(path, np.where(np.isfinite(image), image, 0), CHANNELS)


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
