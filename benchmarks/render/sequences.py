# SPDX-License-Identifier: Apache-2.0
"""Renders short sequences of two scenes for `benchmarks.flicker`, with Mitsuba 3.

    python -m benchmarks.render.sequences SEQUENCES --scenes SCENES

Each scene gets two folders. In ``static`` the frames differ only by their noise, and there is one reference. In
``moving`` the camera pans and trucks, so that near surfaces move faster. The files of a frame are::

    hr.####.exr     1 spp                    } albedo, normal, depth, motion
    full.####.exr   2 spp                    }
    lr.####.exr     16 spp at a quarter of the resolution
    ref_a.####.exr, ref_b.####.exr           two halves of the reference, with independent noise

``motion.X`` and ``motion.Y`` say where the surface of a pixel was in the frame before, in HRLS pixels from here, y
downwards. They are the exact reprojection of the positions that rays hit. The name of a file gives its seed. Files
that exist are kept.
"""

from __future__ import annotations

import argparse
import sys
import time
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.render.film import set_crop, write_exr
from datagen.mitsuba.start import start as start_mitsuba
from oiio_msspl.errors import InputError, MssplError

SCALE = 4
FRAMES = 10
WIDTH, HEIGHT = 256, 192
#: Longer side of the whole frame, of which a crop is rendered.
LONGER = 1024
#: Motion in HRLS pixels a frame: the pan moves everything, the truck moves a surface at the median depth.
PAN, TRUCK = 0.9, 0.8
MAX_DEPTH = 8
#: spp of each half of the reference.
REFERENCE_HALF = 128
#: Samples that are rendered at once; more need more memory.
LAUNCH = 2_000_000

CHANNELS = ("R", "G", "B", "albedo.R", "albedo.G", "albedo.B", "nn.X", "nn.Y", "nn.Z", "dd.T", "motion.X", "motion.Y")
AOVS = "albedo:albedo,nn:sh_normal,dd:depth,pp:position"
#: Scene -> centre of the crop, as shares of the frame.
SCENES = {"staircase2": (0.53, 0.60), "lamp": (0.47, 0.40)}


@dataclass(frozen=True)
class Camera:
    """A pinhole at ``to_world`` (4 x 4). ``focal`` is in pixels; ``centre`` is where the axis meets the crop."""

    to_world: np.ndarray
    focal: float
    centre: tuple[float, float]

    def project(self, positions: np.ndarray) -> np.ndarray:
        """World positions (..., 3) to pixels of the crop (..., 2), y downwards. Mitsuba's camera has x to the left."""
        inverse = np.linalg.inv(self.to_world)
        seen = positions @ inverse[:3, :3].T + inverse[:3, 3]
        return np.asarray(self.centre) - self.focal * seen[..., :2] / seen[..., 2:]


def render_sequences(folder: Path, scenes: Path, names: list[str]) -> None:
    """Render the files of both sequences of each scene that do not exist yet.

    Raises:
        InputError: no such scene, or no Mitsuba.
    """
    try:
        mi = start_mitsuba()
    except ImportError as error:
        raise InputError("rendering needs Mitsuba 3: pip install '.[train]'") from error
    for name in names:
        file = scenes / name / "scene.xml"
        if name not in SCENES or not file.is_file():
            raise InputError(f"{file}: no such scene; --scene takes {', '.join(SCENES)}")
        start = time.perf_counter()
        _Sequences(mi, file, folder / name).render()
        print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)


class _Sequences:
    """Both sequences of a scene."""

    def __init__(self, mi: Any, file: Path, folder: Path) -> None:
        self.mi, self.folder = mi, folder
        self.scene = mi.load_file(str(file))
        self.integrator = mi.load_dict(
            {"type": "aov", "aovs": AOVS, "img": {"type": "path", "max_depth": MAX_DEPTH, "rr_depth": 4}}
        )
        self.sensor = mi.traverse(self.scene.sensors()[0])
        width, height = self.sensor["film.size"]
        self.full = [round(v * LONGER / max(width, height) / SCALE) * SCALE for v in (width, height)]
        self.offset = [
            min(max(int((share * size - crop / 2) // SCALE * SCALE), 0), size - crop)
            for share, size, crop in zip(SCENES[file.parent.name], self.full, (WIDTH, HEIGHT), strict=True)
        ]
        self.focal = self.full[0] / 2 / np.tan(np.radians(float(self.sensor["x_fov"][0])) / 2)
        self.start = np.array(self.sensor["to_world"].matrix, dtype=np.float64).reshape(4, 4)
        self.median_depth = 0.0

    def render(self) -> None:
        still = self.camera(0.0)
        self.median_depth = float(np.median(self.shoot(still, 1, 1, seed=1)[..., 9]))
        middle = (FRAMES - 1) / 2
        for name, step in (("static", 0.0), ("moving", 1.0)):
            for frame in range(FRAMES):
                at = (frame - middle) * step
                camera, before = self.camera(at), self.camera(at - step * (frame > 0))
                for kind, spp in (("hr", 1), ("full", 2), ("lr", 16)):
                    self.write(name, kind, frame, camera, before, spp)
                if frame == 0 or step:  # a static camera needs one reference for all frames
                    for kind in ("ref_a", "ref_b"):
                        self.write(name, kind, frame, camera, before, REFERENCE_HALF)

    def camera(self, at: float) -> Camera:
        """``at``: frames from the middle of the path."""
        angle = at * PAN / self.focal
        c, s = np.cos(angle), np.sin(angle)
        move = np.array(
            [[c, 0, s, at * TRUCK * self.median_depth / self.focal], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1]]
        )
        centre = tuple(size / 2 - offset for size, offset in zip(self.full, self.offset, strict=True))
        return Camera(self.start @ move, self.focal, centre)

    def write(self, sequence: str, kind: str, frame: int, camera: Camera, before: Camera, spp: int) -> None:
        path = self.folder / sequence / f"{kind}.{frame + 1:04d}.exr"
        if path.exists():
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        seed = zlib.crc32(f"{self.folder.name}/{sequence}/{path.name}".encode())
        image = self.shoot(camera, spp, SCALE if kind == "lr" else 1, seed)
        positions, image = image[..., 10:13], image[..., :10]
        if kind in ("hr", "full"):
            image = np.concatenate([image, before.project(positions) - camera.project(positions)], axis=-1)
        write_exr(path, image[..., :3] if kind.startswith("ref") else image, CHANNELS)

    def shoot(self, camera: Camera, spp: int, scale: int, seed: int) -> np.ndarray:
        """The crop at 1/``scale`` of the resolution, float64 (h, w, 13): `CHANNELS` to depth, then world positions."""
        mi, sensor = self.mi, self.sensor
        sensor["to_world"] = mi.Transform4f(mi.Matrix4f(camera.to_world))
        full, offset = ([v // scale for v in values] for values in (self.full, self.offset))
        set_crop(mi, sensor, full, (WIDTH // scale, HEIGHT // scale), offset)
        launch = max(1, LAUNCH // (WIDTH * HEIGHT // scale**2))
        total, done = 0.0, 0
        while done < spp:
            count = min(launch, spp - done)
            part_seed = zlib.crc32(f"{seed} {done}".encode())
            image = np.array(mi.render(self.scene, integrator=self.integrator, spp=count, seed=part_seed), np.float64)
            total = total + np.where(np.isfinite(image), image, 0) * count
            done += count
        return np.asarray(total) / spp


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", type=Path, required=True, help="a folder with a scene.xml for each scene")
    parser.add_argument("--scene", action="append", default=[], help=f"{', '.join(SCENES)}; default: both")
    args = parser.parse_args()
    try:
        render_sequences(args.folder, args.scenes, args.scene or list(SCENES))
    except MssplError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
