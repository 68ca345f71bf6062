# SPDX-License-Identifier: Apache-2.0
"""Render pairs and references whose layers sum to the beauty, for `research.benchmarks.passes`.

    python -m research.benchmarks.render.passes SCENES OUT

Of every ``NAME/scene.xml`` the crop of `research.benchmarks.render.pairs` is rendered with Mitsuba 3, once for each
group of lamps with the same random numbers: a lamp's share of each path, as renderers write light groups. So the file
has two additive sets: ``light_1`` to ``light_n``, and ``diffuse``, ``specular`` and ``other`` (seen directly or
through glass). There are HRLS of 1, 2 and 4 spp, LRHS with as many samples a HRLS pixel, and a reference. Mitsuba
orders the lamps of a scene anew when it loads it, so all files of a scene come from one run: a scene whose files all
exist is kept.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from oiio_msspl.model.contract import SCALES
from research.benchmarks.render.film import write_exr
from research.benchmarks.render.pairs import SensorCamera, mean_of_samples
from research.datagen.mitsuba import start as start_mitsuba

SPP = (1, 2, 4)
#: Most light groups of a scene; lamps that follow each other in the scene share one.
GROUPS = 4


class Lamps:
    """The lamps of a scene, in groups that can be switched."""

    def __init__(self, mi: Any, scene: Any) -> None:
        lamps = [mi.traverse(emitter) for emitter in scene.emitters()]
        count = min(GROUPS, len(lamps))
        self.groups = [lamps[len(lamps) * i // count : len(lamps) * (i + 1) // count] for i in range(count)]
        #: A lamp's brightness is its radiance; an environment map has a scale instead.
        self._keys = ["radiance.value" if "radiance.value" in lamp else "scale" for lamp in lamps]
        self._lamps, self._values = lamps, [lamp[key] * 1 for lamp, key in zip(lamps, self._keys, strict=True)]

    def switch_on(self, group: int) -> None:
        """Switch on the lamps of this group alone."""
        for lamp, key, value in zip(self._lamps, self._keys, self._values, strict=True):
            lamp[key] = value * (1 if any(lamp is other for other in self.groups[group]) else 0)
            lamp.update()


def render(file: Path, folder: Path, reference: int) -> None:
    """Render the files of one scene, unless all of them exist. ``reference`` is in spp."""
    import mitsuba as mi

    from research.datagen.mitsuba.trace import box

    scene = mi.load_file(str(file))
    camera, lamps = SensorCamera(mi, scene.sensors()[0]), Lamps(mi, scene)
    jobs = [(f"hr_{spp}spp", 1, spp) for spp in SPP]
    jobs += [(f"lr_x{scale}_{scale**2 * spp}spp", scale, scale**2 * spp) for scale in SCALES[:2] for spp in SPP]
    jobs.append(("ref", 1, reference))
    paths = {name: folder / f"{name}.exr" for name, _, _ in jobs}
    if all(path.exists() for path in paths.values()):
        return
    for name, scale, spp in jobs:
        path = paths[name]
        size, images = camera.at(scale), []
        for group in range(len(lamps.groups)):
            lamps.switch_on(group)
            title = f"{folder.name} {name}"
            images.append(mean_of_samples(scene, camera, size, spp, title, box, layers=True))
        total = np.stack(images)
        beauty, diffuse, specular = (total[..., i : i + 3].sum(axis=0) for i in (0, 9, 12))
        layers = {"": beauty, "albedo.": total[0, ..., 3:6], "nn.": total[0, ..., 6:9], "diffuse.": diffuse}
        layers |= {"specular.": specular, "other.": beauty - diffuse - specular}
        layers |= {f"light_{i}.": group[..., :3] for i, group in enumerate(total, start=1)}
        path.parent.mkdir(parents=True, exist_ok=True)
        channels = [layer + c for layer in layers for c in ("XYZ" if layer == "nn." else "RGB")]
        write_exr(path, np.concatenate(list(layers.values()), axis=-1), channels)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--reference", type=int, default=512, help="spp")
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    start_mitsuba(args.threads)
    for file in sorted(args.scenes.glob("*/scene.xml")):
        print(file.parent.name, flush=True)
        render(file, args.out / file.parent.name, args.reference)


if __name__ == "__main__":
    main()
