# SPDX-License-Identifier: Apache-2.0
"""Measure how long every method takes: a frame in memory, whole commands, shots, and rendering itself.

    python -m research.benchmarks.runtime command --table research/benchmarks/results/time_command.csv
    python -m research.benchmarks.runtime frame --table research/benchmarks/results/time_frame.csv
    python -m research.benchmarks.runtime shots --table research/benchmarks/results/time_shots.csv
    python -m research.benchmarks.runtime render SCENES --table research/benchmarks/results/time_render.csv

- ``command``: `msspl-fuse` on a pair of half-float EXRs with beauty, albedo and normal, from start to written file, and
  a program that denoises the full-resolution render with prefiltered Open Image Denoise (OIDN).
- ``frame``: the call on arrays alone, as in the paper's table of runtimes.
- ``shots``: :mod:`research.benchmarks.shots.moving_wall`, frame by frame and averaged with neighbours.
- ``render``: Mitsuba 3 on the development scenes, for one sample in each of 1024 x 1024 pixels of an HRLS.

:mod:`research.benchmarks.timer` runs each in a fresh process, in turn with the others.
"""

from __future__ import annotations

import argparse
import fnmatch
import statistics
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from research.benchmarks import results, timer
from research.benchmarks.results import Row

#: Width of the squares of :func:`frame` in pixels.
SQUARE = 24
OIDN, OIDN_FAST, OIDN_PREFILTERED = "OIDN", "OIDN fast", "OIDN prefiltered"
#: See :func:`research.benchmarks.peers.oidn_split`.
OIDN_SPLIT = "OIDN prefiltered, on every second pixel"
#: Method of :mod:`research.benchmarks.accuracy` -> its name here, where it does not matter which render it gets.
SAME_WORK = {
    "OIDN on the HRLS": OIDN,
    "OIDN, same samples": OIDN,
    "OIDN fast on the HRLS": OIDN_FAST,
    "OIDN prefiltered on the HRLS": OIDN_PREFILTERED,
    "OIDN prefiltered, same samples": OIDN_PREFILTERED,
    "OIDN prefiltered and split, same samples": OIDN_SPLIT,
}
#: Values of ``--temporal``: the first one is what the others are compared with.
WAYS = ("off", "2", "auto")
#: spp with which rendering is timed.
RENDER_SPP = 4
MEGAPIXEL = 1024 * 1024


def frame(height: int, width: int, seed: int = 0) -> dict[str, Any]:
    """Return layers (height, width, 3) of lit squares. The light has the noise of 1 spp, which depends on ``seed``."""
    squares = np.random.default_rng(0).random((2, -(-height // SQUARE), -(-width // SQUARE), 3), np.float32)
    albedo, normal = squares.repeat(SQUARE, axis=1).repeat(SQUARE, axis=2)[:, :height, :width]
    normal = 2 * normal - 1
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    noise = np.random.default_rng(seed).standard_exponential((height, width, 1), np.float32)
    light = np.float32(0.2) + np.maximum(normal[..., :1], 0)
    return {"rgb": albedo * light * noise, "albedo": albedo, "normal": normal}


def pair(height: int, width: int, scale: int) -> tuple[Any, Any]:
    """Return both renders of such a frame, with as many samples in each."""
    from oiio_msspl import Render
    from oiio_msspl.image.filters import box_downsample

    low = {name: box_downsample(values, scale) for name, values in frame(height, width, 1).items()}
    return Render.from_arrays("lr", **low), Render.from_arrays("hr", **frame(height, width))


def write_pair(folder: Path, width: int, height: int, scale: int) -> tuple[Path, Path]:
    """Write both renders as half-float EXRs; return their paths."""
    from oiio_msspl.image.filters import box_downsample
    from research.benchmarks.shots.moving_wall import write_layers

    paths = folder / "lr.exr", folder / "hr.exr"
    for path, factor, seed in zip(paths, (scale, 1), (1, 0), strict=True):
        pixels = frame(height, width, seed)
        layers = {"": pixels["rgb"], "albedo": pixels["albedo"], "N": pixels["normal"]}
        write_layers(path, {name: (box_downsample(image, factor), "RGB") for name, image in layers.items()})
    return paths


def prepare(name: str, height: int, width: int) -> Callable[[], Any]:
    """Return a call of a model or of OIDN on arrays."""
    from oiio_msspl import Render, Session, find_model, fuse
    from research.benchmarks import oidn, peers

    if name not in SAME_WORK.values():
        session = Session(find_model(0, name))
        return partial(fuse, *pair(height, width, session.contract.scale), session)
    layers = frame(height, width)
    images = {"color": layers["rgb"], "albedo": layers["albedo"], "normal": layers["normal"]}
    if name == OIDN_SPLIT:
        return partial(peers.oidn_split, Render.from_arrays("full", **layers))
    if name == OIDN_PREFILTERED:
        return partial(oidn.denoise_prefiltered, **images)
    return partial(oidn.denoise, **images, quality="fast" if name == OIDN_FAST else "high")


def oidn_version() -> Row:
    """Return the column ``oidn``: the version of Open Image Denoise."""
    return {"oidn": ".".join(version("pyoidn").split(".")[:3])}


def time_frame(args: argparse.Namespace) -> list[Row]:
    """Time each method on arrays."""
    from oiio_msspl.model.catalogue import shipped_models

    width, height = args.size
    cases = [*shipped_models(), OIDN, OIDN_FAST, OIDN_PREFILTERED, OIDN_SPLIT]
    jobs = {
        case: timer.Function("research.benchmarks.runtime:prepare", (case, height, width), args.repeats)
        for case in fnmatch.filter(cases, args.methods)
    }
    return [
        {"method": case, "size": f"{width}x{height}", **results.model_of(case), **timer.summary(runs)}
        | (oidn_version() if case in SAME_WORK.values() else {})
        for case, runs in timer.in_turn(jobs, args.rounds).items()
    ]


def time_command(args: argparse.Namespace) -> list[Row]:
    """Time whole commands: read files, fuse or denoise, write."""
    from oiio_msspl.model.catalogue import find_model
    from oiio_msspl.model.contract import ONE_SIZE

    width, height = args.size
    with tempfile.TemporaryDirectory() as folder:
        pair = write_pair(Path(folder), width, height, args.scale)
        files, high = pair[args.scale == ONE_SIZE :], pair[1]  # one render, or two of two sizes
        fuse = [str(Path(sys.executable).with_name("msspl-fuse")), *map(str, files), "-o", f"{folder}/out.exr"]
        fuse += ["--overwrite", "--no-preview"]
        models = [find_model(args.scale, name).stem for name in args.quality]
        jobs = {model: [*fuse, "--model", model] for model in models}
        jobs[OIDN_PREFILTERED] = [sys.executable, "-m", "research.benchmarks.oidn", str(high), f"{folder}/oidn.exr"]
        runs = timer.in_turn(jobs, args.rounds)
    size = {"size": f"{width}x{height}", "scale": args.scale}
    return [
        {"method": name, **size, **results.model_of(name), **timer.summary(done)}
        | (oidn_version() if name == OIDN_PREFILTERED else {})
        for name, done in runs.items()
    ]


def fuse_shot_in_process(folder: str, quality: str, frames: str) -> None:
    """Fuse a shot of :mod:`research.benchmarks.shots.moving_wall`."""
    from oiio_msspl import fuse_shot
    from oiio_msspl.jobs.plan import TemporalOptions

    files = [Path(folder, name) for name in ("lr", "hr", "out")]
    files[2].mkdir(exist_ok=True)
    report = fuse_shot(*files, model=quality, temporal=TemporalOptions(frames), overwrite=True)
    if report.exit_code:
        raise SystemExit(next(result.message for result in report.results.values() if result.message))


def time_shots(args: argparse.Namespace) -> list[Row]:
    """Time a shot for each quality: frame by frame, and averaged with neighbours."""
    from oiio_msspl.model.catalogue import find_model
    from research.benchmarks.shots.moving_wall import write_shot

    width, height = args.size
    ways = [(quality, frames) for quality in args.quality for frames in WAYS]
    with tempfile.TemporaryDirectory() as folder:
        write_shot(Path(folder), args.frames, width, height, args.scale)
        name = "research.benchmarks.runtime:fuse_shot_in_process"
        runs = timer.in_turn({way: timer.Function(name, (folder, *way)) for way in ways}, args.rounds)
    shot = {"frames": args.frames, "size": f"{width}x{height}", "scale": args.scale}
    return [
        {"quality": quality, "temporal": frames, **shot, "model": find_model(args.scale, quality).stem}
        | timer.summary(runs[quality, frames])
        for quality, frames in ways
    ]


def _render(mi: Any, scene: Any, integrator: Any) -> Any:
    return mi.render(scene, integrator=integrator, spp=RENDER_SPP).numpy()


def time_render(args: argparse.Namespace) -> list[Row]:
    """Time one sample in each of 1024 x 1024 pixels of every scene."""
    import mitsuba as mi

    from research.benchmarks.render.film import CROP, frame_size, set_crop

    mi.set_variant("llvm_ad_rgb")
    rows: list[Row] = []
    for path in sorted(args.scenes.glob("*/*.xml")):
        scene, path_tracer = mi.load_file(str(path)), {"type": "path", "max_depth": 12}
        integrator: Any = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,nn:sh_normal", "img": path_tracer})
        sensor = scene.sensors()[0]
        parameters, full = mi.traverse(sensor), frame_size(sensor)
        set_crop(mi, parameters, full, CROP, (full - CROP) // 2)
        seconds = statistics.median(timer.seconds_of(partial(_render, mi, scene, integrator), args.rounds))
        samples = CROP[0] * CROP[1] * RENDER_SPP
        rows.append({"scene": path.parent.name, "hrls_s": seconds * MEGAPIXEL / samples})
    return rows


#: Question -> how it is measured, the columns that tell its rows apart, and the size of the frame.
QUESTIONS = {
    "frame": (time_frame, ("method", "machine"), "1024x1024"),
    "command": (time_command, ("method", "size", "scale", "machine"), "1920x1080"),
    "shots": (time_shots, ("quality", "temporal", "machine"), "1920x1080"),
    "render": (time_render, ("scene", "machine"), "1024x1024"),
}


def main() -> None:
    parser = results.parser(__doc__)
    parser.add_argument("question", choices=QUESTIONS)
    parser.add_argument("scenes", type=Path, nargs="?", help="render: the folder of scenes")
    parser.add_argument("--size", metavar="WxH")
    parser.add_argument("--scale", type=int, default=2, help="of the pair; 1 for one render")
    parser.add_argument("--rounds", type=int, default=3, help="times that all are measured, in turn")
    parser.add_argument("--quality", nargs="+", default=["fast", "balanced", "best", "paper"], help="or models")
    parser.add_argument("--methods", metavar="PATTERN", default="*", help="frame: measure only these")
    parser.add_argument("--repeats", type=int, default=2, help="frame: calls that are timed in a process")
    parser.add_argument("--frames", type=int, default=24, help="shots: frames of the shot")
    args = parser.parse_args()
    measure, keys, size = QUESTIONS[args.question]
    args.size = [int(side) for side in (args.size or size).split("x")]
    rows = [{"machine": results.processor(), **row} for row in measure(args)]
    results.show(rows, args.table, keys)


if __name__ == "__main__":
    main()
