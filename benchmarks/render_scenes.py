# SPDX-License-Identifier: Apache-2.0
"""Render scenes of other people for `benchmarks.quality`, with the pixel filter that is asked for.

    python -m benchmarks.render_scenes SCENES OUT --filter blackman-harris

Of every ``NAME/scene.xml`` the middle 384 x 256 pixels of a frame whose longer side is 1280 pixels: a reference, HRLS
of 1, 2, 4 and 8 spp and LRHS of as many samples for every one of their pixels, both with albedo, normal, diffuse and
specular. Files that exist are kept.
"""

from __future__ import annotations

import argparse
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.flicker_render import write_exr
from benchmarks.render_time import CROP, LONGER
from oiio_msspl.schema import SCALES
from training import mitsuba_start, views

HRLS = (1, 2, 3, 4, 6, 7, 8)
#: Samples of the LRHS for every pixel of the frame.
LRHS = (1, 2, 4)
#: Samples of one launch, so that memory stays small.
LAUNCH = 1_500_000
LAYERS = ("", "albedo.", "nn.", "diffuse.", "specular.")
CHANNELS = [layer + c for layer in LAYERS for c in ("XYZ" if layer == "nn." else "RGB")]


class SensorCamera:
    """A scene's own camera, for :func:`training.mitsuba_views.trace.render_passes`."""

    def __init__(self, mi: Any, sensor: Any) -> None:
        self.mi, self.sensor = mi, sensor
        self.film = mi.traverse(sensor)
        original = np.array(sensor.film().size())
        self.full = np.round(original * LONGER / original.max() / 8).astype(int) * 8

    def at(self, scale: int) -> tuple[int, int]:
        """Take the crop at 1/scale of the resolution; its width and height."""
        size, crop = self.full // scale, np.array(CROP) // scale
        self.film["film.size"] = self.mi.ScalarVector2u(*size)
        self.film["film.crop_size"] = self.mi.ScalarVector2u(*crop)
        self.film["film.crop_offset"] = self.mi.ScalarPoint2u(*((self.full - CROP) // 2 // 8 * 8 // scale))
        self.film.update()
        return int(crop[0]), int(crop[1])

    def rays(self, x: Any, y: Any, lens: Any) -> Any:
        ray, _ = self.sensor.sample_ray(0.0, 0.5, self.mi.Point2f(x, y), lens)
        return ray


def render(file: Path, folder: Path, pixel_filter: str, reference: int) -> None:
    """Render what is missing of a scene."""
    import mitsuba as mi
    from training.mitsuba_views.trace import blackman_harris, box, render_passes

    scene = mi.load_file(str(file))
    camera = SensorCamera(mi, scene.sensors()[0])
    placing = blackman_harris() if pixel_filter == "blackman-harris" else box
    jobs = [(f"hr_{spp}spp", 1, spp) for spp in HRLS] + [("ref", 1, reference)]
    jobs += [(f"lr_x{scale}_{scale**2 * n}spp", scale, scale**2 * n) for scale in SCALES for n in LRHS]
    for name, scale, spp in jobs:
        path = folder / f"{name}.exr"
        if path.exists():
            continue
        size = camera.at(scale)
        per_launch = max(1, LAUNCH // (size[0] * size[1]))
        layers = name != "ref"
        total, done = np.zeros((size[1], size[0], 15 if layers else 3)), 0
        while done < spp:
            count = min(per_launch, spp - done)
            seed = zlib.crc32(f"{folder.name} {pixel_filter} {name} {done}".encode())
            passes = render_passes(scene, camera, size, count, seed, layers, pixel_filter=placing)  # type: ignore[arg-type]
            total += passes.sum(axis=0, dtype=np.float64)
            done += count
        path.parent.mkdir(parents=True, exist_ok=True)
        write_exr(path, total / spp, CHANNELS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--filter", choices=views.FILTERS, default="blackman-harris")
    parser.add_argument("--reference", type=int, default=2048, help="spp")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    mitsuba_start.start(args.threads)
    for file in sorted(args.scenes.glob("*/scene.xml")):
        start = time.perf_counter()
        render(file, args.out / file.parent.name, args.filter, args.reference)
        print(f"{file.parent.name}: {time.perf_counter() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
