# SPDX-License-Identifier: Apache-2.0
"""Time and peak memory of each method for one frame of 1024 x 1024 pixels, as in the paper's table of runtimes.

    python -m research.benchmarks.runtime --table research/benchmarks/results/runtime.csv

Each measurement runs in its own process. A first call warms up and is not counted. The methods take turns for several
rounds, so that a machine whose speed drifts favours none of them. Peak memory is the largest resident set of the
process, with its libraries and weights. :mod:`research.benchmarks.runtime_files` measures a whole job from file to
file.
"""

from __future__ import annotations

import argparse
import fnmatch
import json
import os
import platform
import re
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from research.benchmarks import results
from research.benchmarks.results import Row

#: Width of the squares of :func:`frame` in pixels.
SQUARE = 24
OIDN, OIDN_FAST, OIDN_PREFILTERED = "OIDN", "OIDN fast", "OIDN prefiltered"
#: See :func:`research.benchmarks.oidn.denoise_prefiltered`: with OIDN's base networks for albedo and normal.
OIDN_BASE_GUIDES = "OIDN prefiltered with base guides"
#: See :func:`research.benchmarks.peers.oidn_split`.
OIDN_SPLIT = "OIDN prefiltered, on every second pixel"
#: As :mod:`research.benchmarks.accuracy` calls them -> as they are called here, where it does not matter which render
#: they get.
SAME_WORK = {
    "OIDN on the HRLS": OIDN,
    "OIDN, same samples": OIDN,
    "OIDN fast on the HRLS": OIDN_FAST,
    "OIDN prefiltered on the HRLS": OIDN_PREFILTERED,
    "OIDN prefiltered, same samples": OIDN_PREFILTERED,
    "OIDN prefiltered with base guides on the HRLS": OIDN_BASE_GUIDES,
    "OIDN prefiltered with base guides, same samples": OIDN_BASE_GUIDES,
    "OIDN prefiltered and split, same samples": OIDN_SPLIT,
}


def frame(height: int, width: int, seed: int = 0) -> dict[str, Any]:
    """Layers (height, width, 3) of lit squares. The light has the noise of 1 spp, which depends on ``seed``."""
    import numpy as np

    squares = np.random.default_rng(0).random((2, -(-height // SQUARE), -(-width // SQUARE), 3), np.float32)
    albedo, normal = squares.repeat(SQUARE, axis=1).repeat(SQUARE, axis=2)[:, :height, :width]
    normal = 2 * normal - 1
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    noise = np.random.default_rng(seed).standard_exponential((height, width, 1), np.float32)
    light = np.float32(0.2) + np.maximum(normal[..., :1], 0)
    return {"rgb": albedo * light * noise, "albedo": albedo, "normal": normal}


def pair(height: int, width: int, scale: int) -> tuple[Any, Any]:
    """Both renders of such a frame, with as many samples in each."""
    from oiio_msspl import Render
    from oiio_msspl.image.arrays import box_downsample

    low = {name: box_downsample(values, scale) for name, values in frame(height, width, 1).items()}
    return Render.from_arrays("lr", **low), Render.from_arrays("hr", **frame(height, width))


def prepare_model(name: str, height: int, width: int, threads: int) -> Callable[[], Any]:
    """A call of :func:`oiio_msspl.fuse` on arrays."""
    from oiio_msspl import Session, find_model, fuse

    session = Session(find_model(0, name), threads=threads)
    low, high = pair(height, width, session.contract.scale)
    return lambda: fuse(low, high, session)


def prepare_oidn(name: str, height: int, width: int) -> Callable[[], Any]:
    """A call of OIDN on arrays."""
    from oiio_msspl import Render
    from research.benchmarks import oidn, peers

    layers = frame(height, width)
    images = {"color": layers["rgb"], "albedo": layers["albedo"], "normal": layers["normal"]}
    if name == OIDN_SPLIT:
        return partial(peers.oidn_split, Render.from_arrays("full", **layers))
    if name in (OIDN_PREFILTERED, OIDN_BASE_GUIDES):
        guides = "high" if name == OIDN_PREFILTERED else "balanced"
        return lambda: oidn.denoise_prefiltered(**images, guides=guides)
    return lambda: oidn.denoise(**images, quality="fast" if name == OIDN_FAST else "high")


def measure(call: Callable[[], Any], repeats: int) -> dict[str, Any]:
    """Seconds of each repeat, and the peak memory of this process."""
    call()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return {"seconds": seconds, "peak_mb": peak_mb()}


def peak_mb() -> float:
    """Largest resident set of this process so far, in MB.

    On Linux, `getrusage` would also count the program that started this one, so the kernel's own mark is read.
    """
    status = Path("/proc/self/status")
    if status.exists() and (found := re.search(r"VmHWM:\s+(\d+) kB", status.read_text())):
        return int(found[1]) / (1 << 10)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << 20 if sys.platform == "darwin" else 1 << 10)


def processor() -> str:
    """The processor's name, and whether it has AMX or VNNI, with which networks of 8 bits are faster.

    On Linux Python does not know the name, so it comes from /proc/cpuinfo. Elsewhere, neither is mentioned.
    """
    info = Path("/proc/cpuinfo")
    return named(info.read_text()) if info.exists() else platform.processor()


def named(cpuinfo: str) -> str:
    """The processor's name from the text of /proc/cpuinfo."""
    names, flags = (re.findall(rf"{key}\s*: (.*)", cpuinfo) for key in ("model name", "flags"))
    name = names[0] if names else platform.processor()
    if not flags:
        return name
    has = next((each for each in ("AMX", "VNNI") if each.lower() in flags[0]), None)
    return f"{name} with {has}" if has else f"{name} without VNNI"


def in_process(module: str, *arguments: str) -> dict[str, Any]:
    """Run a module in its own process; what it prints, read as JSON."""
    done = subprocess.run([sys.executable, "-m", module, *arguments], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def compare(args: argparse.Namespace) -> list[Row]:
    """A row for each method: median, fastest and slowest seconds, and peak memory."""
    from oiio_msspl.model.catalogue import shipped_models

    cases = [*(args.model or shipped_models()), OIDN, OIDN_FAST, OIDN_PREFILTERED, OIDN_BASE_GUIDES, OIDN_SPLIT]
    cases = [case for case in cases if fnmatch.fnmatchcase(case, args.methods or "*")]
    measured: dict[str, list[dict[str, Any]]] = {case: [] for case in cases}
    settings = "--size", args.size, "--repeats", str(args.repeats), "--threads", str(args.threads)
    for _ in range(args.rounds):
        for case, rounds in measured.items():
            rounds.append(in_process("research.benchmarks.runtime", "--measure", case, *settings))
    rows = []
    for case, rounds in measured.items():
        seconds = [value for done in rounds for value in done["seconds"]]
        row: Row = {"method": case, "size": args.size, "machine": processor(), "cores": os.cpu_count()}
        row |= {"seconds": statistics.median(seconds), "fastest": min(seconds), "slowest": max(seconds)}
        row |= {"peak_mb": max(done["peak_mb"] for done in rounds)}
        if case in SAME_WORK.values():
            row["version"] = ".".join(version("pyoidn").split(".")[:3])
        rows.append(row)
    return rows


def layout(rows: list[Row]) -> str:
    """A line for each method, beside OIDN's time."""
    found = results.index(rows, "method")
    body = []
    for name, row in found.items():
        of_oidn = f"{row['seconds'] / found[OIDN]['seconds']:.2f}" if OIDN in found else ""
        spread = f"{row['fastest']:.2f} to {row['slowest']:.2f}"
        title = name.replace(OIDN, f"{OIDN} {row['version']}", 1) if "version" in row else f"`{name}`"
        body.append([title, f"{row['seconds']:.2f}", spread, of_oidn, f"{row['peak_mb']:.0f}"])
    head = f"{rows[0]['size'].replace('x', ' x ')}, {rows[0]['cores']} cores, {rows[0]['machine']}"
    return results.markdown([head, "median s", "fastest to slowest", "of OIDN's time", "peak MB"], body)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="1024x1024")
    parser.add_argument("--repeats", type=int, default=2, help="calls that are timed in a process")
    parser.add_argument("--rounds", type=int, default=5, help="processes for each method, in turn")
    parser.add_argument("--threads", type=int, default=0, help="of ONNX Runtime; 0: one a core")
    parser.add_argument("--model", action="append", default=[], help="a shipped model or an ONNX file; default: all")
    parser.add_argument("--methods", metavar="PATTERN", help="measure only these; --table then keeps its other rows")
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    results.add_option(parser)
    args = parser.parse_args()
    if args.measure:
        width, height = (int(v) for v in args.size.split("x"))
        if args.measure in SAME_WORK.values():
            call = prepare_oidn(args.measure, height, width)
        else:
            call = prepare_model(args.measure, height, width, args.threads)
        print(json.dumps(measure(call, args.repeats)))
        return
    rows = compare(args)
    print(layout(rows))
    if args.table and args.methods:
        results.merge(args.table, rows, ("method",))
    elif args.table:
        results.write(args.table, rows)


if __name__ == "__main__":
    main()
