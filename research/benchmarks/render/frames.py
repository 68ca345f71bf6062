# SPDX-License-Identifier: Apache-2.0
"""Render whole frames of scenes for `research.benchmarks.pair_checks`, with Mitsuba 3.

    python -m research.benchmarks.render.frames SCENES OUT

Of every ``NAME/scene.xml`` three cameras are rendered: the scene's own, and two that orbit what it looks at. Each
gets a folder with HRLS of 1 and 4 spp, with LRHS of 1 and 4 samples for every HRLS pixel, and with ``next_1spp.exr``,
the HRLS one frame later, when the camera has moved. All have albedo and normal. Files that exist are kept.
"""

from __future__ import annotations

import argparse
import itertools
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.model.contract import SCALES
from research.benchmarks.render.film import frame_size, set_crop, write_exr
from research.benchmarks.render.sequences import CHANNELS, MAX_DEPTH
from research.datagen.mitsuba import start as start_mitsuba

#: Longer side of a frame in pixels.
LONGER = 640
#: Folder's suffix -> degrees around what the camera looks at, and the factor of the distance to it.
CAMERAS = {"": (0.0, 1.0), "-left": (-14.0, 0.8), "-right": (9.0, 0.6)}
#: The camera's pan from one frame to the next in degrees.
PAN = 1.0
#: Samples of the LRHS for every HRLS pixel.
LRHS = (1, 4)
HRLS = (1, 4)


def render(mi: Any, file: Path, out: Path, camera: str) -> None:
    """Render the files of one scene that do not exist yet, for a key of `CAMERAS`."""
    scene = mi.load_file(str(file))
    integrator = mi.load_dict(
        {"type": "aov", "aovs": "albedo:albedo,nn:sh_normal", "img": {"type": "path", "max_depth": MAX_DEPTH}}
    )
    sensor = scene.sensors()[0]
    frame = frame_size(sensor, LONGER)
    parameters = mi.traverse(sensor)
    start = np.array(parameters["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    ray = sensor.sample_ray(0.0, 0.5, mi.Point2f(0.5, 0.5), mi.Point2f(0.5))[0]
    distance = float(scene.ray_intersect(ray).t.numpy()[0])
    distance = distance if np.isfinite(distance) else 5.0

    jobs = [(f"hr_{spp}spp", 1, spp, 0.0) for spp in HRLS] + [("next_1spp", 1, 1, PAN)]
    jobs += [(f"lr_x{scale}_{scale**2 * n}spp", scale, scale**2 * n, 0.0) for scale in SCALES for n in LRHS]
    angle, share = CAMERAS[camera]
    orbit = start @ _move(distance) @ _turn(angle) @ _move(-share * distance)
    folder = out / (file.parent.name + camera)
    folder.mkdir(parents=True, exist_ok=True)
    for name, scale, spp, pan in jobs:
        path = folder / f"{name}.exr"
        if path.exists():
            continue
        parameters["to_world"] = mi.Transform4f(mi.Matrix4f(orbit @ _turn(pan)))
        size = [int(v) // scale for v in frame]
        set_crop(mi, parameters, size, size, (0, 0))
        seed = zlib.crc32(f"{folder.name} {name}".encode())
        image = np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=seed), np.float32)
        write_exr(path, np.nan_to_num(image, nan=0.0, posinf=0.0, neginf=0.0), CHANNELS)


def _turn(degrees: float) -> NDArray[Any]:
    """Return a turn around the camera's upward axis, (4, 4)."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1]])


def _move(distance: float) -> NDArray[Any]:
    """Return a move along the camera's viewing direction, (4, 4)."""
    matrix = np.eye(4)
    matrix[2, 3] = distance
    return matrix


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    mi = start_mitsuba(args.threads)
    for camera, file in itertools.product(CAMERAS, sorted(args.scenes.glob("*/scene.xml"))):
        print(f"{file.parent.name}{camera}", flush=True)
        render(mi, file, args.out, camera)


if __name__ == "__main__":
    main()
