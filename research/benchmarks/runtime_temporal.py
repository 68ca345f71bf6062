# SPDX-License-Identifier: Apache-2.0
"""Time of a shot whose frames are averaged with their neighbours, beside the same shot frame by frame.

    python -m research.benchmarks.runtime_temporal --table research/benchmarks/results/runtime_temporal.csv
    python -m research.benchmarks.runtime_temporal --lamps 4

A shot of real size is written to a temporary folder: a textured wall past which the camera moves, with noise of 1 spp,
albedo, normal, depth and exact motion vectors, as half-float EXRs. With ``--lamps`` both renders have light groups,
whose passes are fused. All ways (`WAYS`) take turns for each quality, file to file, each in its own process; the median
of all rounds counts. The ratio depends on the number of frames: the first and the last ones have fewer neighbours, and
how motion is stored is found out once. Peak memory is that of the largest round.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from oiio_msspl.image.arrays import Array
from oiio_msspl.image.filters import box_downsample, enlarged
from research.benchmarks import results
from research.benchmarks.results import Row
from research.benchmarks.runtime import in_process, peak_mb, processor

#: How many pixels the wall moves to the left from one frame to the next.
STEP = 3
#: Size of the wall's stains in pixels.
STAIN = 8
#: Size of the places where one lamp or another is brighter.
LIT = 48
#: Values of ``--temporal``: the first one is what the others are compared with.
OFF = "off"
WAYS = (OFF, "2", "auto")


def wall(height: int, width: int) -> Array:
    """Its colour (height, width, 3), in [0.1, 0.9]."""
    stains = np.random.default_rng(0).random((-(-height // STAIN), -(-width // STAIN), 3), np.float32)
    return (0.1 + 0.8 * enlarged(stains, STAIN)[:height, :width]).astype(np.float32)


def clean_frame(number: int, count: int, width: int, height: int, lamps: int) -> tuple[Array, list[Array]]:
    """The wall's colour in a frame, (height, width, 3), and its light from each lamp; from all together without groups.

    Args:
        count: frames of the shot.
    """
    shares = np.ones((1, height, width + STEP * count, 1), np.float32)
    if lamps:
        stains = np.random.default_rng(1).random(
            (lamps, -(-height // LIT), -(-(width + STEP * count) // LIT), 1), np.float32
        )
        shares = np.stack([enlarged(each, LIT) for each in stains / stains.sum(axis=0)])
    colour, *parts = (
        image[:height, STEP * number :][:, :width] for image in (wall(height, width + STEP * count), *shares)
    )
    return colour, [np.float32(0.5) * colour * part for part in parts]


def write_shot(folder: Path, count: int, width: int, height: int, scale: int, lamps: int = 0) -> None:
    """Write the frames of both renders, with the light of each lamp as a layer."""
    for name in ("lr", "hr"):
        (folder / name).mkdir()
    for number in range(1, count + 1):
        colour, clean = clean_frame(number, count, width, height, lamps)
        for name, factor, spp in (("lr", scale, scale**2), ("hr", 1, 1)):
            albedo = box_downsample(colour, factor)
            rng = np.random.default_rng([number, factor])
            noise = rng.gamma(spp, 1 / spp, (len(clean), *albedo.shape[:2], 1)).astype(np.float32)
            light = [box_downsample(each, factor) * part for each, part in zip(clean, noise, strict=True)]
            layers = {"": (sum(light), "RGB"), "albedo": (albedo, "RGB")}
            layers |= {f"light_{i}": (each, "RGB") for i, each in enumerate(light[:lamps])}
            layers["N"] = (np.full_like(albedo, (0, 0, 1)), "XYZ")
            if name == "hr":
                back = np.full((height, width, 2), (STEP, 0), np.float32)
                layers |= {"depth": (np.full((height, width, 1), 5, np.float32), "Z")}
                layers |= {"motionBack": (back, "XY"), "motionFore": (-back, "XY")}
            channels = {
                f"{layer}.{letter}".lstrip("."): np.ascontiguousarray(image[..., i], np.float16)
                for layer, (image, letters) in layers.items()
                for i, letter in enumerate(letters)
            }
            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            with OpenEXR.File(header, channels) as file:
                file.write(str(folder / name / f"{name}.{number:04d}.exr"))


def measure(folder: Path, quality: str, frames: str) -> dict[str, Any]:
    """Fuse the shot in this process."""
    from oiio_msspl import fuse_shot
    from oiio_msspl.jobs.plan import TemporalOptions

    report = fuse_shot(
        *(folder / name for name in ("lr", "hr", "out")),
        model=quality,
        temporal=TemporalOptions(frames),
        overwrite=True,
    )
    if report.exit_code:
        raise SystemExit(next(result.message for result in report.results.values() if result.message))
    return {"seconds": report.seconds, "peak_mb": peak_mb()}


def layout(rows: list[Row]) -> str:
    """A line for each quality and way."""
    alone = {row["quality"]: row["seconds"] for row in rows if row["temporal"] == OFF}
    body = [
        [
            f"`--quality {row['quality']} --temporal {row['temporal']}`",
            f"{row['seconds'] / row['frames']:.2f}",
            f"{row['seconds'] / alone[row['quality']]:.2f}",
            f"{row['peak_mb']:.0f}",
        ]
        for row in rows
    ]
    first = rows[0]
    lamps = f", {first['lamps']} light groups" if first.get("lamps") else ""
    head = f"{first['frames']} frames, {first['size'].replace('x', ' x ')}, x{first['scale']}{lamps}, "
    head += f"{first['cores']} cores"
    return results.markdown([f"{head}, {first['machine']}", "seconds a frame", "ratio", "peak MB"], body)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--scale", type=int, default=2)
    parser.add_argument("--lamps", type=int, default=0, help="light groups of the shot")
    parser.add_argument("--qualities", nargs="+", default=["balanced", "best"])
    parser.add_argument("--rounds", type=int, default=1, help="times that all ways are measured, in turn")
    parser.add_argument("--measure", nargs=3, help=argparse.SUPPRESS)
    results.add_option(parser)
    args = parser.parse_args()
    if args.measure:
        folder, quality, frames = args.measure
        (Path(folder) / "out").mkdir(exist_ok=True)
        print(json.dumps(measure(Path(folder), quality, frames)))
        return
    width, height = (int(v) for v in args.size.split("x"))
    ways = [(quality, frames) for quality in args.qualities for frames in WAYS]
    measured: dict[tuple[str, str], list[dict[str, Any]]] = {way: [] for way in ways}
    with tempfile.TemporaryDirectory() as folder:
        write_shot(Path(folder), args.frames, width, height, args.scale, args.lamps)
        for _ in range(args.rounds):
            for way in ways:
                measured[way].append(in_process("research.benchmarks.runtime_temporal", "--measure", folder, *way))
    shot = {name: getattr(args, name) for name in ("frames", "size", "scale", "lamps")}
    machine = {"machine": processor(), "cores": os.cpu_count()}
    rows: list[Row] = [
        {
            "quality": quality,
            "temporal": frames,
            **shot,
            **machine,
            "seconds": statistics.median(found["seconds"] for found in measured[quality, frames]),
            "peak_mb": max(found["peak_mb"] for found in measured[quality, frames]),
        }
        for quality, frames in ways
    ]
    print(layout(rows))
    if args.table:
        results.write(args.table, rows)


if __name__ == "__main__":
    main()
