# SPDX-License-Identifier: Apache-2.0
"""A shot's wall time against the slowest of its three stages, and its memory early and late.

    python -m benchmarks.shot --json results/shot.json
    python -m benchmarks.shot --frames 1000 --size 256x144 --json results/shot_1000.json

Frames of random layers are made in a temporary folder: half-float EXRs with what a render has beside its beauty. Then,
each in a process of its own and in turn, rounds of: the three stages one after the other (all frames read, fused and
written, nothing at the same time), and `fuse_shot`, where they overlap. The ratio is the shot's wall time over the
slowest stage's alone; 1 would be an overlap that costs nothing, and the sum of the stages over the slowest is what no
overlap at all would give. Inference on the CPU uses every core by itself, so there the other stages cannot be free.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

from benchmarks.runtime import in_process, peak_mb, processor, write_frame


def make_shot(folder: Path, count: int, width: int, height: int, scale: int) -> None:
    """One pair, and links to it: what differs between frames does not change what they cost."""
    for name, w, h in (("lr", width // scale, height // scale), ("hr", width, height)):
        (folder / name).mkdir()
        first = folder / name / f"{name}.0001.exr"
        write_frame(str(first), w, h)
        for frame in range(2, count + 1):
            os.link(first, folder / name / f"{name}.{frame:04d}.exr")


def measure_stages(folder: Path, device: str, threads: int) -> dict[str, Any]:
    """Seconds of each stage alone, all frames together."""
    from oiio_msspl.sequence import find_shot
    from oiio_msspl.shot import Stages

    stages = Stages(device=device, threads=threads, overwrite=True)
    seconds = dict.fromkeys(("read", "infer", "write"), 0.0)
    for frame in find_shot(folder / "lr", folder / "hr", folder / "out").frames:
        moments = [time.perf_counter()]
        ready = stages.read(frame)
        moments.append(time.perf_counter())
        report, fused = stages.fuse(ready, stages.session(ready))
        moments.append(time.perf_counter())
        stages.write(report, fused)
        moments.append(time.perf_counter())
        for stage, (before, after) in zip(seconds, pairwise(moments), strict=True):
            seconds[stage] += after - before
    return {"seconds": seconds}


def measure_shot(folder: Path, device: str, threads: int) -> dict[str, Any]:
    """Wall seconds of the whole shot, and the process's peak and present memory after each frame."""
    from oiio_msspl import fuse_shot

    peak: list[float] = []
    present: list[float] = []

    def note(*_: Any) -> None:
        peak.append(peak_mb())
        present.append(present_mb())

    report = fuse_shot(
        folder / "lr", folder / "hr", folder / "out", device=device, threads=threads, overwrite=True, progress=note
    )
    if report.exit_code:
        raise SystemExit(next(result.message for result in report.results.values() if result.message))
    return {"seconds": report.seconds, "peak_mb": peak, "present_mb": present}


def present_mb() -> float:
    """Resident set at this moment, in MB; 0 where the system has no /proc."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / (1 << 20) if statm.exists() else 0.0


def measured(kind: str, folder: Path, args: argparse.Namespace) -> dict[str, Any]:
    options = "--device", args.device, "--threads", str(args.threads)
    return in_process("benchmarks.shot", "--measure", kind, str(folder), *options)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--size", default="1024x576")
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=2, help="times that both are measured, in turn")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--measure", nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.measure:
        measure = {"stages": measure_stages, "shot": measure_shot}[args.measure[0]]
        folder = Path(args.measure[1])
        (folder / "out").mkdir(exist_ok=True)
        print(json.dumps(measure(folder, args.device, args.threads)))
        return
    width, height = (int(v) for v in args.size.split("x"))
    with tempfile.TemporaryDirectory() as name:
        make_shot(Path(name), args.frames, width, height, args.scale)
        rounds = [
            (measured("stages", Path(name), args), measured("shot", Path(name), args)) for _ in range(args.rounds)
        ]
    alone = {stage: statistics.median(r[0]["seconds"][stage] for r in rounds) for stage in ("read", "infer", "write")}
    wall = statistics.median(r[1]["seconds"] for r in rounds)
    slowest = max(alone, key=lambda stage: alone[stage])
    # Early: after the first tenth, when every stage has had its first frames.
    early = max(3, args.frames // 10) - 1
    memory = [(r[1]["peak_mb"][early], r[1]["peak_mb"][-1]) for r in rounds]
    peak_early, peak_late = max(memory, key=lambda pair: pair[1] / pair[0])

    print(f"| {args.frames} frames, {args.size} x{args.scale}, {args.device} | s | of the slowest stage |")
    print("|---|---|---|")
    for stage, seconds in alone.items():
        print(f"| {stage} alone | {seconds:.2f} | {seconds / alone[slowest]:.2f} |")
    print(f"| one after the other | {sum(alone.values()):.2f} | {sum(alone.values()) / alone[slowest]:.2f} |")
    print(f"| **the shot** | {wall:.2f} | **{wall / alone[slowest]:.2f}** |")
    print(
        f"\npeak memory after frame {early + 1}: {peak_early:.0f} MB, after frame {args.frames}: {peak_late:.0f} MB "
        f"(x{peak_late / peak_early:.3f})"
    )
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        summary = {"ratio": wall / alone[slowest], "wall": wall, "alone": alone, "peak_mb": [peak_early, peak_late]}
        settings = {k: getattr(args, k) for k in ("frames", "size", "scale", "device", "threads")}
        machine = {"machine": processor(), "cores": os.cpu_count()}
        args.json.write_text(json.dumps({**settings, **machine, **summary, "rounds": rounds}, indent=1))


if __name__ == "__main__":
    main()
