# SPDX-License-Identifier: Apache-2.0
"""Render short sequences for `research.benchmarks.shots`, with Mitsuba 3.

    python -m research.benchmarks.render.sequences SEQUENCES --scenes SCENES
    python -m research.benchmarks.render.sequences SPREAD --scenes SCENES --spread

Two scenes from files get two sequences each. In ``static`` the frames differ only by their noise. In ``moving`` the
camera pans and trucks, so that near surfaces move faster. A room of our own gets the animations of
`research.benchmarks.render.moving_scenes`. A frame has these files::

    hr.####.exr                      1 spp, with albedo, normal, depth, position and motion
    full.####.exr                    2 spp, with albedo and normal
    lr_x2.####.exr, lr_x4.####.exr   4 spp at half, 16 spp at a quarter of the resolution
    ref_a.####.exr, ref_b.####.exr   two halves of the reference, with independent noise

``motionBack`` and ``motionFore`` say where the surface of a pixel was in the frame before, and will be in the next
one, in HRLS pixels from here, x to the right and y downwards. They are exact: the positions that rays hit, moved with
their object and projected. The name of a file gives its seed. Files that exist are kept. With ``--spread``, each sample
counts in the pixels around it, too, in layers as in the beauty.
"""

from __future__ import annotations

import argparse
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from research.benchmarks.render import moving_scenes as rooms
from research.benchmarks.render.film import frame_size, set_crop, write_exr
from research.benchmarks.render.moving_scenes import ANIMATIONS, Room
from research.datagen.mitsuba import start as start_mitsuba

SCALES = (2, 4)
#: The sequence in which nothing moves: one reference is enough.
STATIC = "static"
FRAMES = 10
#: Width and height of a frame. Scenes from files show a crop of a frame whose longer side is `LONGER`.
WIDTH, HEIGHT, LONGER = 320, 224, 1024
#: Motion of the camera in files, in HRLS pixels a frame: the pan moves everything, the truck a surface at the median
#: depth.
PAN, TRUCK = 0.9, 0.8
MAX_DEPTH = 8
#: spp of each half of the reference. The noise of fewer shifts sRGB values of dark rooms: with 24, PSNR falls by 1 dB.
REFERENCE_HALF = 48
#: Samples that are rendered at once; more need more memory.
LAUNCH = 2_000_000

AOVS = "albedo:albedo,nn:sh_normal,dd:depth,pp:position"
CHANNELS = (
    *("R", "G", "B", "albedo.R", "albedo.G", "albedo.B", "nn.X", "nn.Y", "nn.Z"),
    *("dd.Z", "position.X", "position.Y", "position.Z"),
)
MOTION = ("motionBack.X", "motionBack.Y", "motionFore.X", "motionFore.Y")
#: Scene -> centre of the crop, as shares of the frame.
SCENES = {"staircase2": (0.53, 0.60), "lamp": (0.47, 0.40)}


@dataclass(frozen=True)
class Camera:
    """A camera at ``to_world`` (4 x 4), with x to the left as Mitsuba's.

    ``focal`` is in pixels; ``centre`` is where the axis meets the picture. ``aperture`` is the lens's radius, 0 for a
    pinhole, and ``focus`` the distance at which it is sharp.
    """

    to_world: NDArray[Any]
    focal: float
    centre: tuple[float, float]
    aperture: float = 0.0
    focus: float = 1.0

    def project(self, positions: NDArray[Any]) -> NDArray[Any]:
        """Project world positions (..., 3) to pixels (..., 2), y downwards."""
        inverse = np.linalg.inv(self.to_world)
        seen = positions @ inverse[:3, :3].T + inverse[:3, 3]
        return np.asarray(self.centre) - self.focal * seen[..., :2] / seen[..., 2:]

    def rays(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return origins and directions through the centres of the pixels, (pixels, 3) each."""
        y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
        seen = [(self.centre[0] - x) / self.focal, (self.centre[1] - y) / self.focal, np.ones_like(x)]
        directions = np.stack(seen, axis=-1).reshape(-1, 3) @ self.to_world[:3, :3].T
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return np.broadcast_to(self.to_world[:3, 3], directions.shape), directions


class _FileScene:
    """A static scene from a file, seen by a camera that stands or moves."""

    def __init__(self, mi: Any, file: Path, *, moving: bool) -> None:
        self._step = 1.0 if moving else 0.0
        self._room = Room(mi.load_file(str(file)))
        self.size = frame_size(self._room.scene.sensors()[0], LONGER).tolist()
        sensor = mi.traverse(self._room.scene.sensors()[0])
        self.offset = [
            min(max(int((share * size - crop / 2) // 8 * 8), 0), size - crop)
            for share, size, crop in zip(SCENES[file.parent.name], self.size, (WIDTH, HEIGHT), strict=True)
        ]
        self._focal = self.size[0] / 2 / np.tan(np.radians(float(sensor["x_fov"][0])) / 2)
        self._start = np.array(sensor["to_world"].matrix, dtype=np.float64).reshape(4, 4)
        self._depth = 0.0  # of what the camera moves by `TRUCK` pixels; not known yet
        self._depth = float(np.median(surfaces(mi, self._room, self.camera(0.0))[..., 3]))

    def camera(self, at: float) -> Camera:
        angle = at * self._step * PAN / self._focal
        c, s = np.cos(angle), np.sin(angle)
        truck = at * self._step * TRUCK * self._depth / self._focal
        move = np.array([[c, 0, s, truck], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1]])
        centre = self.size[0] / 2 - self.offset[0], self.size[1] / 2 - self.offset[1]
        return Camera(self._start @ move, self._focal, centre)

    def room(self, frame: int, at: float) -> Room:
        return self._room

    def object_moves(self, at: float, other: float) -> NDArray[Any]:
        return np.eye(4)


class _AnimatedRoom:
    """Our own room."""

    size, offset = (WIDTH, HEIGHT), (0, 0)

    def __init__(self, name: str) -> None:
        self._animation = ANIMATIONS[name]

    def camera(self, at: float) -> Camera:
        focal = WIDTH / 2 / np.tan(np.radians(rooms.ANGLE) / 2)
        centre, aperture = (WIDTH / 2, HEIGHT / 2), self._animation.aperture
        return Camera(rooms.camera_matrix(self._animation, at), focal, centre, aperture, rooms.FOCUS)

    def room(self, frame: int, at: float) -> Room:
        return rooms.build_room(self._animation, frame, at)

    def object_moves(self, at: float, other: float) -> NDArray[Any]:
        """Return the matrix from the moving object's place at one time to that at another, (4, 4)."""
        return np.asarray(
            rooms.object_matrix(self._animation, other) @ np.linalg.inv(rooms.object_matrix(self._animation, at))
        )


def surfaces(mi: Any, room: Room, camera: Camera) -> NDArray[Any]:
    """Return what the centre of each pixel shows, (h, w, 5): its position, its depth, and whether it moves.

    A ray that hits nothing has the depth 0.
    """
    origins, directions = camera.rays()
    ray = mi.Ray3f(mi.Point3f(*origins.T), mi.Vector3f(*directions.T))
    hit = room.scene.ray_intersect(ray)
    valid = np.array(hit.is_valid())
    depth = np.where(valid, np.array(hit.t), 0)
    moves = np.zeros(len(depth), bool)
    for shape in room.moved:
        moves |= np.array(hit.shape == mi.ShapePtr(shape))
    far = np.where(valid, depth, 1e5)[:, None]
    columns = [origins + far * directions, depth[:, None], moves[:, None]]
    return np.concatenate(columns, axis=1).reshape(HEIGHT, WIDTH, 5)


def motion(shown: NDArray[Any], scene: Any, at: float, other: float) -> NDArray[Any]:
    """Return where the surfaces (h, w, 5) of one time are at another, in pixels from their place, (h, w, 2)."""
    positions = shown[..., :3]
    matrix = scene.object_moves(at, other)
    moved = positions @ matrix[:3, :3].T + matrix[:3, 3]
    there = scene.camera(other).project(np.where(shown[..., 4:5] > 0, moved, positions))
    return np.asarray(there - scene.camera(at).project(positions))


def render_sequence(mi: Any, scene: Any, folder: Path, pixel_filter: str) -> None:
    """Render the files of a sequence that do not exist yet."""
    path_tracer = {"type": "path", "max_depth": MAX_DEPTH, "rr_depth": 4}
    integrator = mi.load_dict(path_tracer)
    with_aovs = mi.load_dict({"type": "aov", "aovs": AOVS, "img": path_tracer})
    middle = (FRAMES - 1) / 2
    kinds = [("hr", 1, 1), ("full", 1, 2), *((f"lr_x{s}", s, s * s) for s in SCALES)]
    references = [(name, 1, REFERENCE_HALF) for name in ("ref_a", "ref_b")]
    for frame in range(FRAMES):
        at = frame - middle
        wanted = kinds if folder.name == STATIC and frame > 0 else [*kinds, *references]
        paths = {kind: folder / f"{kind}.{frame + 1:04d}.exr" for kind, _, _ in wanted}
        if all(path.exists() for path in paths.values()):
            continue
        folder.mkdir(parents=True, exist_ok=True)
        room, camera = scene.room(frame, at), scene.camera(at)
        shown = surfaces(mi, room, camera)
        vectors = np.concatenate([motion(shown, scene, at, at + step) for step in (-1, 1)], axis=-1)
        for kind, scale, spp in wanted:
            if paths[kind].exists():
                continue
            seed = zlib.crc32(f"{folder.parent.name}/{folder.name}/{paths[kind].name}".encode())
            tracer = integrator if kind.startswith("ref") else with_aovs
            image = _shoot(mi, room.scene, tracer, scene, camera, spp, scale, seed, pixel_filter)
            if kind == "hr":
                write_exr(paths[kind], np.concatenate([image, vectors], axis=-1), (*CHANNELS, *MOTION), np.float32)
            else:
                write_exr(paths[kind], image[..., :9], CHANNELS)


def _shoot(
    mi: Any,
    loaded: Any,
    integrator: Any,
    scene: Any,
    camera: Camera,
    spp: int,
    scale: int,
    seed: int,
    pixel_filter: str,
) -> NDArray[Any]:
    """Return a frame at 1/``scale`` of the resolution, float64 (h, w, 13): `CHANNELS`, or (h, w, 3) without AOVs."""
    angle = np.degrees(2 * np.arctan(scene.size[0] / 2 / camera.focal))
    lens: dict[str, Any] = {"type": "perspective"}
    if camera.aperture:
        lens = {"type": "thinlens", "aperture_radius": camera.aperture, "focus_distance": camera.focus}
    sensor = mi.load_dict({
        **lens, "fov": angle, "fov_axis": "x", "to_world": mi.ScalarTransform4f(camera.to_world),
        "film": {"type": "hdrfilm", "rfilter": {"type": pixel_filter}, "pixel_format": "rgb"},
        "sampler": {"type": "independent"},
    })  # fmt: skip
    size, offset = ([v // scale for v in values] for values in (scene.size, scene.offset))
    set_crop(mi, mi.traverse(sensor), size, (WIDTH // scale, HEIGHT // scale), offset)
    launch = max(1, LAUNCH // (WIDTH * HEIGHT // scale**2))
    total, done = np.zeros(1), 0
    while done < spp:
        count = min(launch, spp - done)
        part_seed = zlib.crc32(f"{seed} {done}".encode())
        image = mi.render(loaded, integrator=integrator, sensor=sensor, spp=count, seed=part_seed)
        values = np.array(image, np.float64)
        total = total + np.where(np.isfinite(values), values, 0) * count
        done += count
    return total / spp


def main() -> None:
    names = [f"{scene}/{camera}" for scene in SCENES for camera in (STATIC, "moving")]
    names += [f"room/{name}" for name in ANIMATIONS]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", type=Path, required=True, help="a folder with a scene.xml for each scene")
    parser.add_argument("--sequence", action="append", choices=names, help="default: all")
    parser.add_argument("--spread", action="store_true", help="with Mitsuba's default filter, which spreads samples")
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    mi = start_mitsuba(args.threads)
    for name in args.sequence or names:
        scene, _, kind = name.partition("/")
        print(name, flush=True)
        file = args.scenes / scene / "scene.xml"
        made = _AnimatedRoom(kind) if scene == "room" else _FileScene(mi, file, moving=kind == "moving")
        render_sequence(mi, made, args.folder / scene / kind, "gaussian" if args.spread else "box")


if __name__ == "__main__":
    main()
