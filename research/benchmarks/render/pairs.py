# SPDX-License-Identifier: Apache-2.0
"""Render pairs and references of scenes for `research.benchmarks.accuracy`, with either pixel filter and all layers.

    python -m research.benchmarks.render.pairs SCENES OUT --filter blackman-harris

Of every ``NAME/scene.xml`` a crop of 384 x 256 pixels is rendered with Mitsuba 3, in the middle of a frame whose longer
side has 1280 pixels: a reference, HRLS of 1 to 8 spp, and LRHS with 1, 2 and 4 samples for every HRLS pixel. HRLS and
LRHS have albedo, normal, diffuse and specular. Files that exist are kept.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.model.contract import SCALES
from research.benchmarks.render.film import CROP, frame_size, set_crop, write_exr
from research.datagen.mitsuba import start as start_mitsuba

HRLS = (1, 2, 3, 4, 6, 7, 8)
#: Samples of the LRHS for every HRLS pixel.
LRHS = (1, 2, 4)
#: Samples that are rendered at once; more need more memory.
LAUNCH = 1_500_000
LAYERS = ("", "albedo.", "nn.", "diffuse.", "specular.")
CHANNELS = [layer + c for layer in LAYERS for c in ("XYZ" if layer == "nn." else "RGB")]


class SensorCamera:
    """A scene's own camera, for :func:`research.datagen.mitsuba.trace.render_passes`."""

    def __init__(self, mi: Any, sensor: Any) -> None:
        self.mi, self.sensor = mi, sensor
        self.parameters, self.full = mi.traverse(sensor), frame_size(sensor)

    def at(self, scale: int) -> tuple[int, int]:
        """Render the crop at 1/scale of the resolution from now on; its width and height."""
        size, crop = self.full // scale, np.array(CROP) // scale
        set_crop(self.mi, self.parameters, size, crop, (self.full - CROP) // 2 // 8 * 8 // scale)
        return int(crop[0]), int(crop[1])

    def rays(self, x: Any, y: Any, lens: Any) -> Any:
        ray, _ = self.sensor.sample_ray(0.0, 0.5, self.mi.Point2f(x, y), lens)
        return ray


def render(file: Path, folder: Path, pixel_filter: str, reference: int) -> None:
    """Render the files of one scene that do not exist yet. ``reference`` is in spp."""
    import mitsuba as mi

    from research.datagen.mitsuba.trace import blackman_harris, box

    scene = mi.load_file(str(file))
    camera = SensorCamera(mi, scene.sensors()[0])
    placing = blackman_harris() if pixel_filter == "blackman-harris" else box
    jobs = [(f"hr_{spp}spp", 1, spp) for spp in HRLS] + [("ref", 1, reference)]
    jobs += [(f"lr_x{scale}_{scale**2 * n}spp", scale, scale**2 * n) for scale in SCALES for n in LRHS]
    for name, scale, spp in jobs:
        path = folder / f"{name}.exr"
        if path.exists():
            continue
        title = f"{folder.name} {pixel_filter} {name}"
        image = mean_of_samples(scene, camera, camera.at(scale), spp, title, placing, layers=name != "ref")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_exr(path, image, CHANNELS)


def mean_of_samples(
    scene: Any, camera: SensorCamera, size: tuple[int, int], spp: int, title: str, placing: Any, *, layers: bool
) -> NDArray[np.float64]:
    """Render samples in launches that fit into memory and average them: (h, w, 15), or (h, w, 3) without layers.

    Args:
        size: width and height.
        title: the random numbers follow from it.
        placing: pixel filter of :mod:`research.datagen.mitsuba.trace`.
    """
    from research.datagen.mitsuba.trace import LAYERS as SAMPLED

    names = SAMPLED[:5] if layers else SAMPLED[:1]
    total = np.zeros((size[1], size[0], 3 * len(names)))
    for samples in launched(scene, camera, size, spp, title, names, LAUNCH, pixel_filter=placing):
        total += np.concatenate([samples[name] for name in names], axis=-1).sum(axis=0, dtype=np.float64)
    return total / spp


def launched(
    scene: Any, camera: Any, size: tuple[int, int], spp: int, title: str, layers: tuple[str, ...], most: int,
    **options: Any,
) -> Iterator[dict[str, NDArray[Any]]]:  # fmt: skip
    """Yield the samples of :func:`research.datagen.mitsuba.trace.render_samples`, in launches of ``most`` at most.

    The random numbers follow from the title.
    """
    from research.datagen.mitsuba.trace import render_samples

    per_launch = max(1, most // (size[0] * size[1]))
    for done in range(0, spp, per_launch):
        count, seed = min(per_launch, spp - done), zlib.crc32(f"{title} {done}".encode())
        yield render_samples(scene, camera, size, count, seed, layers, **options)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--filter", choices=("box", "blackman-harris"), default="blackman-harris")
    parser.add_argument("--reference", type=int, default=2048, help="spp")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    start_mitsuba(args.threads)
    for file in sorted(args.scenes.glob("*/scene.xml")):
        print(file.parent.name, flush=True)
        render(file, args.out / file.parent.name, args.filter, args.reference)


if __name__ == "__main__":
    main()
