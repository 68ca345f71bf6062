# SPDX-License-Identifier: Apache-2.0
"""Compare this package with Open Image Denoise (OIDN) on scenes that everybody can render: no file is needed.

    python -m research.benchmarks.outsiders OUT --quick
    python -m research.benchmarks.outsiders OUT --oidn /path/to/another/python

Mitsuba 3 renders the scenes of `research.benchmarks.render.own_scenes`. For n samples per pixel in all, a pair has an
HRLS of n/2 spp and an LRHS of half its size with as many samples, and OIDN gets an ordinary render with n spp, or the
HRLS alone. With 1 spp there is one render, and both get it. OIDN runs as its documentation recommends: high quality,
albedo and normal prefiltered. Seconds are those of the whole command. A shot in which the camera moves is scored by its
flicker, too: see `research.benchmarks.shots.measures`.

OUT gets the renders, the results, ``table.csv``, and a page of pictures for each scene, in a folder ``quick`` or
``full``. A run that was stopped continues. ``--oidn`` names a Python with another pyoidn, NumPy and OpenEXR; its rows
join those of the first one.
"""

from __future__ import annotations

import argparse
import functools
import shutil
import subprocess
import sys
import sysconfig
import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from oiio_msspl.compare import scores
from oiio_msspl.image.colour import srgb
from oiio_msspl.image.parallel import available_cores
from research.benchmarks import oidn, results
from research.benchmarks.accuracy import mean_flip
from research.benchmarks.render.film import write_exr
from research.benchmarks.render.own_scenes import GROUPS, SCENES, lamps
from research.benchmarks.render.sequences import Camera
from research.benchmarks.shots.measures import flicker
from research.datagen.mitsuba import start as start_mitsuba

LAYERS = ("R", "G", "B", "albedo.R", "albedo.G", "albedo.B", "N.X", "N.Y", "N.Z")
MOTION = ("motionFore.X", "motionFore.Y")
QUALITIES = ("fast", "balanced", "best")
#: What OIDN denoises: its file in the folder of a pair.
OIDN = {"on the HRLS": "hr", "at full resolution": "full"}
#: Columns that tell rows apart.
KEYS = ("scene", "filter", "spp", "method")
#: Columns that are printed.
COLUMNS = (*KEYS, "psnr", "relmse", "flip", "flicker", "seconds")
SCALE = 2
SHOT = "shot"
#: Degrees that the camera of the shot turns from frame to frame, and its horizontal field of view.
PAN, ANGLE = 0.6, 45.0
#: Distance of the camera from the middle of a scene.
DISTANCE = 3.6

Image = NDArray[np.float32]


@dataclass(frozen=True)
class Extent:
    """How much is measured."""

    size: tuple[int, int]
    scenes: tuple[str, ...]
    filters: tuple[str, ...]
    spp: tuple[int, ...]
    """Samples per pixel in all: 1, or an even number."""
    frames: int
    reference: int
    """Samples per pixel of the references."""


FULL = Extent((640, 384), tuple(SCENES), ("box", "gaussian"), (1, 2, 8, 32, 128, 256), 12, 8192)
QUICK = Extent((192, 128), ("room", "glass", "hair", "lamps", "stars"), ("box",), (2, 8), 3, 256)


class Renderer:
    """Renders the scenes with Mitsuba."""

    def __init__(self, mi: Any, size: tuple[int, int]) -> None:
        self._mi, self.size = mi, size
        self._scenes: dict[Any, Any] = {}

    def frame(self, name: str, pixel_filter: str, scale: int, spp: int, seed: str, at: float = 0.0) -> dict[str, Image]:
        """Render a scene at 1/scale of the size: its layers by channel name, light groups included.

        Args:
            name: of the scene.
            pixel_filter: ``box`` or ``gaussian``.
            scale, spp: of the render.
            seed: the random numbers follow from it.
            at: frame of the shot.
        """
        if name == "lamps":
            parts = [self._shoot((name, group), pixel_filter, scale, spp, f"{seed} {group}") for group in GROUPS]
            layers = parts[0] | {c: np.asarray(parts[0][c] + parts[1][c]) for c in "RGB"}
            for group, part in zip(GROUPS, parts, strict=True):
                layers |= {f"lg_{group}.{c}": part[c] for c in "RGB"}
            return layers
        return self._shoot((name, None), pixel_filter, scale, spp, seed, at)

    def _shoot(
        self, key: tuple[str, str | None], pixel_filter: str, scale: int, spp: int, seed: str, at: float = 0.0
    ) -> dict[str, Image]:
        mi = self._mi
        if key not in self._scenes:
            name, group = key
            build = {"type": "scene", **(lamps(mi, group) if group else SCENES[name if name != SHOT else "room"](mi))}
            self._scenes[key] = mi.load_dict(build)
        path = {"type": "volpath" if key[0] == "fog" else "path", "max_depth": 12}
        integrator = mi.load_dict({"type": "aov", "aovs": "a:albedo,n:sh_normal,p:position", "image": path})
        width, height = (side // scale for side in self.size)
        film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": pixel_filter}}
        lens = {"type": "thinlens", "aperture_radius": 0.06, "focus_distance": DISTANCE}
        sensor = mi.load_dict({
            **(lens if key[0] == "foliage" else {"type": "perspective"}),
            "fov": ANGLE,
            "to_world": mi.ScalarTransform4f(_camera(at)),
            "film": film | {"pixel_format": "rgb"},
        })  # fmt: skip
        number = zlib.crc32(seed.encode()) & 0x7FFFFFFF
        image = np.array(mi.render(self._scenes[key], sensor=sensor, integrator=integrator, spp=spp, seed=number))
        image = np.nan_to_num(image.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)
        layers = dict(zip(LAYERS, np.moveaxis(image[..., :9], -1, 0), strict=True))
        if key[0] == SHOT and scale == 1:
            layers |= dict(zip(MOTION, np.moveaxis(self._motion(image[..., 9:12], at), -1, 0), strict=True))
        return layers

    def _motion(self, positions: Image, at: float) -> Image:
        """Return how far each pixel's surface moves to the next frame, in pixels (x, y)."""
        here, there = (self._project(positions, frame) for frame in (at, at + 1))
        return np.asarray(there - here, np.float32)

    def _project(self, positions: Image, at: float) -> NDArray[Any]:
        return Camera(_camera(at), self.size[0] / 2 / np.tan(np.radians(ANGLE) / 2), (0, 0)).project(positions)


def _camera(at: float) -> NDArray[Any]:
    """Return the camera's place (4, 4) at a frame of the shot; it looks along -z, with x to the left as Mitsuba's."""
    c, s = np.cos(np.radians(PAN * at)), np.sin(np.radians(PAN * at))
    return np.array([[-c, 0, s, 0.02 * at], [0, 1, 0, 0], [-s, 0, -c, DISTANCE], [0, 0, 0, 1]])


def render(renderer: Renderer, extent: Extent, folder: Path, name: str, pixel_filter: str) -> None:
    """Render the files of a scene that do not exist yet: ``ref``, and ``full``, ``lr`` and ``hr`` for each spp."""
    frames: Sequence[int | None] = range(1, extent.frames + 1) if name == SHOT else [None]
    for frame in frames:
        jobs = [(folder / f"ref{_number(frame)}", 1, extent.reference)]
        for spp in extent.spp:
            parts = [("full", 1, spp)]
            if spp > 1:
                parts += [("lr", SCALE, SCALE**2 * spp // 2), ("hr", 1, spp // 2)]
            jobs += [(folder / f"{spp}spp/{part}{_number(frame)}", scale, count) for part, scale, count in parts]
        for path, scale, count in jobs:
            if not path.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
                layers = renderer.frame(name, pixel_filter, scale, count, str(path), float(frame or 0))
                write_exr(path, np.stack([*layers.values()], axis=-1), [*layers])


def _number(frame: int | None) -> str:
    return ".exr" if frame is None else f".{frame:04}.exr"


def measure(folder: Path, done: set[Any], key: tuple[str, str, int], python: str) -> Iterator[results.Row]:
    """Run every method on the renders of a scene that has no row yet, and yield its row.

    Args:
        folder: of the scene and filter.
        done: keys of the rows that exist.
        key: scene, filter and samples per pixel in all.
        python: the Python that runs OIDN.
    """
    scene, _, spp = key
    renders, is_shot = folder / f"{spp}spp", scene == SHOT
    parts = ("full",) if spp == 1 else ("lr", "hr")
    inputs = [str(renders / f"{part}{'.####' if is_shot else ''}.exr") for part in parts]
    version = oidn_version(python)
    oidn_methods = {f"OIDN {version} {name}": part for name, part in OIDN.items() if part in (*parts, "full")}
    for method in (*QUALITIES, *oidn_methods):
        if (*key, method) in done:
            continue
        target = renders / method.replace(" ", "_")
        target.mkdir(exist_ok=True)
        start = time.perf_counter()
        if method in QUALITIES:
            out = str(target / ("out.####.exr" if is_shot else "out.exr"))
            _run([_program("msspl-fuse"), *inputs, "-o", out, "--quality", method, "--overwrite", "--no-preview"])
        else:
            part = oidn_methods[method]
            for source in sorted(renders.glob(f"{part}.*exr")):
                _run([python, oidn.__file__, str(source), str(target / source.name.replace(part, "out", 1))])
        seconds = time.perf_counter() - start
        yield dict(zip(KEYS, (*key, method), strict=True)) | _scores(folder, target) | {"seconds": round(seconds, 2)}


@functools.cache
def oidn_version(python: str) -> str:
    """Return the version of the pyoidn that a Python has."""
    return _run([python, "-c", "import importlib.metadata as m; print(m.version('pyoidn'))"]).strip()


def _program(name: str) -> str:
    """Return the program of this Python's environment, or else the one on the path."""
    return shutil.which(name, path=sysconfig.get_path("scripts")) or name


def _run(command: Sequence[str]) -> str:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}\n{done.stderr[-2000:]}")
    return done.stdout


def _scores(folder: Path, target: Path) -> dict[str, float]:
    """Return the mean scores of the results in a folder; for a shot also how it differs from frame to frame."""
    references = [_pixels(path) for path in sorted(folder.glob("ref*.exr"))]
    images = [_pixels(path) for path in sorted(target.glob("out*.exr"))]
    rows = [scores(*pair) | {"flip": mean_flip(*pair)} for pair in zip(images, references, strict=True)]
    means = {name: float(np.mean([row[name] for row in rows])) for name in ("psnr", "relmse", "flip")}
    if len(images) > 1:
        shown, truth = srgb(np.stack(images)), srgb(np.stack(references))
        means["flicker"] = flicker(shown, (truth, truth))
    return means


def _pixels(path: Path) -> Image:
    return np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT), np.float32)[..., :3]


def write_pages(out: Path, rows: Sequence[results.Row]) -> None:
    """Write a page of pictures for each scene, filter and number of samples, unless it is newer than all results."""
    # A page opens with the first two.
    parts = ("best/out", "OIDN*/out", "balanced/out", "fast/out", "full", "hr")
    for scene, kind, spp in dict.fromkeys(tuple(row[key] for key in KEYS[:3]) for row in rows):
        folder, frame = out / scene / kind, ".0001" if scene == SHOT else ""
        page, renders = folder / f"{spp}spp.html", folder / f"{spp}spp"
        images = [path for part in parts for path in sorted(renders.glob(f"{part}{frame}.exr"))]
        if not page.exists() or page.stat().st_mtime <= max(path.stat().st_mtime for path in images):
            reference = str(folder / f"ref{frame}.exr")
            _run([_program("msspl"), "compare", *map(str, images), "--reference", reference, "--html", str(page)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--quick", action="store_true", help="small frames, few scenes: minutes on two cores")
    parser.add_argument("--oidn", metavar="PYTHON", default=sys.executable, help="a Python that has a pyoidn")
    parser.add_argument("--threads", type=int, default=0, help="of Mitsuba; 0: one a core")
    args = parser.parse_args()
    extent = QUICK if args.quick else FULL
    out = args.out.resolve() / ("quick" if args.quick else "full")
    table = out / "table.csv"
    mi = start_mitsuba(args.threads or available_cores())
    renderer = Renderer(mi, extent.size)
    rows = results.read(table) if table.exists() else []
    jobs = [(name, kind) for name in (*extent.scenes, SHOT) for kind in extent.filters]
    for count, (name, kind) in enumerate(jobs, 1):
        print(f"{count} of {len(jobs)}: {name}, {kind} filter", file=sys.stderr, flush=True)
        folder = out / name / kind
        render(renderer, extent, folder, name, kind)
        for spp in extent.spp:
            done = {tuple(row[key] for key in KEYS) for row in rows}
            for row in measure(folder, done, (name, kind, spp), args.oidn):
                rows.append(row)
                results.write(table, rows)
    order = {job: position for position, job in enumerate(jobs)}
    rows.sort(key=lambda row: (order[row["scene"], row["filter"]], row["spp"]))
    write_pages(out, rows)
    print(results.plain([{name: row[name] for name in COLUMNS if name in row} for row in rows]))


if __name__ == "__main__":
    main()
