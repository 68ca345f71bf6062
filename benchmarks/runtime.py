# SPDX-License-Identifier: Apache-2.0
"""Time and peak memory for one 1024 x 1024 frame at x2, x4 and x8: the work of the paper's table of runtimes.

    python -m benchmarks.runtime --json results/runtime.json

Each measurement is a process of its own; the network's time is the median of the repeats after one that warms up, and
OIDN's (if pyoidn is installed) is taken in turn with ours, so that a machine whose speed drifts does not favour one.
Peak memory is the process's largest resident set, libraries and weights included. `--size 8192x4320` shows what an 8K
frame takes from file to file.
"""

from __future__ import annotations

import argparse
import json
import platform
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

#: OIDN's qualities that are measured, by what the table calls them.
OIDN = {"OIDN 2.5.1, quality high": "high", "OIDN 2.5.1, quality fast": "fast"}
#: Seconds on a Titan Xp GPU and MB of its memory, from the paper's table 3 and text.
PAPER = {2: (0.362, 1134), 4: (0.118, 749), 8: (0.052, 737)}


def frame(height: int, width: int, seed: int = 0) -> dict[str, Any]:
    """Random layers: times do not depend on what is in the pixels."""
    import numpy as np

    rng = np.random.default_rng(seed)
    return {
        "rgb": rng.random((height, width, 3), dtype=np.float32),
        "albedo": rng.random((height, width, 3), dtype=np.float32),
        "normal": rng.random((height, width, 3), dtype=np.float32),
    }


def measure_model(name: str, height: int, width: int, repeats: int, threads: int) -> dict[str, Any]:
    """Seconds of :func:`oiio_msspl.fuse` on arrays, and the process's peak memory (in this process)."""
    from oiio_msspl import Render, Session, find_model, fuse
    from oiio_msspl.transforms import box_downsample

    session = Session(find_model(0, name), threads=threads)
    scale = session.contract.scale
    layers = frame(height, width)
    high = Render.from_arrays("hr", **layers)
    aovs = {name: box_downsample(layers[name], scale) for name in ("albedo", "normal")}
    low = Render.from_arrays("lr", rgb=layers["rgb"][::scale, ::scale].copy(), **aovs)
    fuse(low, high, session)
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        fuse(low, high, session)
        times.append(time.perf_counter() - start)
    return {"seconds": times, "peak_mb": peak_mb()}


def measure_oidn(quality: str, height: int, width: int, repeats: int) -> dict[str, Any]:
    import pyoidn

    layers = frame(height, width)
    guides = {name: layers[name] for name in ("albedo", "normal")}
    pyoidn.denoise(layers["rgb"], **guides, hdr=True, quality=quality)
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        pyoidn.denoise(layers["rgb"], **guides, hdr=True, quality=quality)
        times.append(time.perf_counter() - start)
    return {"seconds": times, "peak_mb": peak_mb()}


def measure_files(scale: int, height: int, width: int, max_memory: int) -> dict[str, Any]:
    """A whole job from file to file: half-float EXRs with the layers of a Cycles render."""
    from oiio_msspl import fuse_files

    with tempfile.TemporaryDirectory() as folder:
        for name, h, w in (("lr", height // scale, width // scale), ("hr", height, width)):
            # Written by a process of its own, so that its memory is not ours.
            subprocess.run(
                [sys.executable, "-m", "benchmarks.runtime", "--write", f"{folder}/{name}.exr", f"{w}x{h}"], check=True
            )
        start = time.perf_counter()
        preview = Path(folder, "out.png")
        files = [f"{folder}/{name}.exr" for name in ("lr", "hr", "out")]
        report = fuse_files(*files, max_memory=max_memory, preview_path=preview)
        return {
            "seconds": [time.perf_counter() - start],
            "peak_mb": peak_mb(),
            "tiles": report.tiles,
            "parts": report.seconds,
        }


def write_frame(path: str, width: int, height: int) -> None:
    import numpy as np
    import OpenEXR

    layers = frame(height, width)
    channels = {}
    for name, suffixes in (
        ("rgb", "RGB"),
        ("albedo", "RGB"),
        ("normal", "XYZ"),
        ("diffuse", "RGB"),
        ("specular", "RGB"),
    ):
        source = layers.get(name, layers["rgb"])
        for i, suffix in enumerate(suffixes):
            channel = suffix if name == "rgb" else f"{name}.{suffix}"
            channels[channel] = np.ascontiguousarray(source[..., i].astype(np.float16))
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, channels) as file:
        file.write(path)


def processor() -> str:
    """What this machine computes with; of Linux, Python says nothing."""
    info = Path("/proc/cpuinfo")
    names = re.findall(r"model name\s*: (.*)", info.read_text()) if info.exists() else []
    return names[0] if names else platform.processor()


def peak_mb() -> float:
    """Largest resident set of this process so far, in MB (Linux counts in KiB, macOS in bytes)."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)


def in_process(module: str, *arguments: str) -> dict[str, Any]:
    """What a module prints as JSON in a process of its own."""
    done = subprocess.run([sys.executable, "-m", module, *arguments], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout)


def measured(kind: str, size: str, *extra: str) -> dict[str, Any]:
    """``kind``: ``files``, one of ``OIDN`` or a model."""
    return in_process("benchmarks.runtime", "--measure", kind, "--size", size, *extra)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="1024x1024")
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=5, help="times that each is measured, in turn")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--max-memory", type=int, default=3 << 30)
    parser.add_argument(
        "--files", type=int, metavar="SCALE", help="measure a whole job from file to file at this scale"
    )
    parser.add_argument("--json", type=Path)
    parser.add_argument("--model", action="append", default=[], help="a shipped model or an ONNX file; all if none")
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    parser.add_argument("--write", nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    width, height = (int(v) for v in (args.write[1] if args.write else args.size).split("x"))
    if args.write:
        return write_frame(args.write[0], width, height)
    if args.measure:
        if args.measure == "files":
            result = measure_files(args.files, height, width, args.max_memory)
        elif args.measure in OIDN:
            result = measure_oidn(OIDN[args.measure], height, width, args.repeats)
        else:
            result = measure_model(args.measure, height, width, args.repeats, args.threads)
        print(json.dumps(result))
        return None
    if args.files:
        result = measured("files", args.size, "--files", str(args.files), "--max-memory", str(args.max_memory))
        print(
            f"{args.size} x{args.files}, file to file: {result['seconds'][0]:.1f} s, peak {result['peak_mb']:.0f} MB, "
            f"{result['tiles']} tiles; {result['parts']}"
        )
        results: Any = {"files": result}
    else:
        results = compare(args)
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        args.json.write_text(json.dumps({"size": args.size, "machine": processor(), "results": results}, indent=1))
    return None


def compare(args: argparse.Namespace) -> dict[str, Any]:
    """Each model and OIDN, in turn; prints the table."""
    from oiio_msspl.contract import Contract
    from oiio_msspl.session import find_model, shipped_models

    scales = {name: Contract.of_file(find_model(0, name)).scale for name in args.model or shipped_models()}
    cases = [*scales]
    try:
        import pyoidn  # noqa: F401

        cases += OIDN
    except ImportError:
        pass
    seconds: dict[str, list[float]] = {case: [] for case in cases}
    peak: dict[str, float] = dict.fromkeys(cases, 0.0)
    for _ in range(args.rounds):
        for case in cases:
            result = measured(case, args.size, "--repeats", str(args.repeats), "--threads", str(args.threads))
            seconds[case] += result["seconds"]
            peak[case] = max(peak[case], result["peak_mb"])
    reference = statistics.median(seconds[next(iter(OIDN))]) if len(cases) > len(scales) else None
    print(f"| {args.size} | median s | of OIDN's time | peak MB | the paper's network, Titan Xp |")
    print("|---|---|---|---|---|")
    table = {}
    for case in cases:
        median = statistics.median(seconds[case])
        ratio = f"{median / reference:.2f}" if reference else "-"
        paper = "{} s, {} MB".format(*PAPER[scales[case]]) if case in scales else "-"
        print(f"| {case} | {median:.2f} | {ratio} | {peak[case]:.0f} | {paper} |")
        table[case] = {"seconds": seconds[case], "peak_mb": peak[case], "scale": scales.get(case)}
    return table


if __name__ == "__main__":
    main()
