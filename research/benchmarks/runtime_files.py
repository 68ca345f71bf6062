# SPDX-License-Identifier: Apache-2.0
"""Time and peak memory of a whole job from file to file, by default of an 8K frame at x4.

    python -m research.benchmarks.runtime_files --table research/benchmarks/results/runtime_files.csv
    python -m research.benchmarks.runtime_files --size 4096x2160 --scale 2 --model best --light-groups 9

The files are half-float EXRs of random pixels with the layers of a Cycles render. With light groups, which are fused,
they hold 32-bit floats. The job also writes the preview.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path

from research.benchmarks import results
from research.benchmarks.results import Row
from research.benchmarks.runtime import frame, in_process, peak_mb, processor

#: Layer -> the names of its channels.
LAYERS = {"rgb": "RGB", "albedo": "RGB", "normal": "XYZ", "diffuse": "RGB", "specular": "RGB"}


def write_frame(path: Path, width: int, height: int, scale: int = 1, groups: int = 0) -> None:
    """Write an EXR file with `LAYERS`, and light groups that sum to the beauty: the HRLS of a frame, or with a
    ``scale`` its LRHS."""
    import numpy as np
    import OpenEXR

    from oiio_msspl.image.filters import box_downsample

    pixels = {name: box_downsample(values, scale) for name, values in frame(height, width, scale).items()}
    lights = {f"light_{i}": pixels["rgb"] / groups for i in range(groups)}
    channels, stored = {}, np.float32 if groups else np.float16
    for layer, suffixes in (LAYERS | dict.fromkeys(lights, "RGB")).items():
        source = (pixels | lights).get(layer, pixels["rgb"])
        for i, suffix in enumerate(suffixes):
            name = suffix if layer == "rgb" else f"{layer}.{suffix}"
            channels[name] = np.ascontiguousarray(source[..., i].astype(stored))
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))


def measure(folder: Path, model: str, max_memory: int) -> Row:
    """Fuse `lr.exr` and `hr.exr` of a folder in this process."""
    from oiio_msspl import fuse_files

    lr, hr, out = (folder / f"{name}.exr" for name in ("lr", "hr", "out"))
    start = time.perf_counter()
    report = fuse_files(lr, hr, out, model=model, max_memory=max_memory, preview_path=folder / "out.png")
    seconds = time.perf_counter() - start
    parts = {f"{part}_s": report.seconds[part] for part in ("read", "fuse", "network", "write")}
    return {"seconds": seconds, **parts, "tiles": report.tiles, "peak_mb": peak_mb()}


def layout(rows: list[Row]) -> str:
    """A line for each size and model. "fuse" contains "network"."""
    head = ["file to file", "seconds", "read", "fuse", "network", "write", "tiles", "peak MB"]
    body = []
    for row in rows:
        parts = (f"{row[f'{part}_s']:.1f}" for part in ("read", "fuse", "network", "write"))
        title = f"{row['size'].replace('x', ' x ')}, `{row['method']}`, {row['cores']} cores, {row['machine']}"
        body.append([title, f"{row['seconds']:.1f}", *parts, str(row["tiles"]), f"{row['peak_mb']:.0f}"])
    return results.markdown(head, body)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="8192x4320")
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--model", default="auto")
    parser.add_argument("--light-groups", type=int, default=0)
    parser.add_argument("--max-memory", type=int, default=3 << 30, help="bytes")
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    results.add_option(parser)
    args = parser.parse_args()
    if args.measure:
        print(json.dumps(measure(args.measure, args.model, args.max_memory)))
        return
    from oiio_msspl import Session, find_model

    width, height = (int(v) for v in args.size.split("x"))
    name = Session(find_model(args.scale, args.model)).contract.name
    with tempfile.TemporaryDirectory() as folder:
        write_frame(Path(folder, "lr.exr"), width, height, args.scale, args.light_groups)
        write_frame(Path(folder, "hr.exr"), width, height, 1, args.light_groups)
        options = "--model", args.model, "--max-memory", str(args.max_memory)
        row = in_process("research.benchmarks.runtime_files", "--measure", folder, *options)
    rows = [{"method": name, "size": args.size, "machine": processor(), "cores": os.cpu_count(), **row}]
    print(layout(rows))
    if args.table:
        results.write(args.table, rows)


if __name__ == "__main__":
    main()
