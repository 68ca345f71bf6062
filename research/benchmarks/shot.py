# SPDX-License-Identifier: Apache-2.0
"""Wall time of a shot against the slowest of its three stages, and its memory early and late.

    python -m research.benchmarks.shot --table research/benchmarks/results/shot.csv
    python -m research.benchmarks.shot --frames 1000 --size 256x144

Frames of random pixels are written to a temporary folder, as half-float EXRs with the layers of a Cycles render. Two
jobs take turns, each in its own process: the three stages one after the other (read, fuse and write all frames), and
`fuse_shot`, where the stages overlap. The ratio is the shot's wall time over the time of the slowest stage alone. A
ratio of 1 means that the overlap costs nothing. Inference on the CPU uses every core, so there the other stages cannot
be free.
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

from research.benchmarks import results
from research.benchmarks.results import Row
from research.benchmarks.runtime import in_process, peak_mb, processor
from research.benchmarks.runtime_files import write_frame


def make_shot(folder: Path, count: int, width: int, height: int, scale: int) -> None:
    """Write one pair and link the other frames to it: every frame costs the same, whatever it shows."""
    for name, factor in (("lr", scale), ("hr", 1)):
        (folder / name).mkdir()
        first = folder / name / f"{name}.0001.exr"
        write_frame(first, width, height, factor)
        for frame in range(2, count + 1):
            os.link(first, folder / name / f"{name}.{frame:04d}.exr")


def measure_stages(folder: Path, device: str, threads: int) -> dict[str, Any]:
    """Seconds of each stage alone, over all frames."""
    from oiio_msspl.jobs.run import Stages
    from oiio_msspl.jobs.sequence import find_shot

    stages = Stages(device=device, threads=threads, overwrite=True)
    seconds = dict.fromkeys(("read", "infer", "write"), 0.0)
    for frame in find_shot(folder / "lr", folder / "hr", folder / "out").frames:
        moments = [time.perf_counter()]
        ready = stages.read(frame)
        moments.append(time.perf_counter())
        alone = stages.fuse(ready, stages.session(ready), ((), ()))
        report = stages.complete(alone, alone.fused)
        moments.append(time.perf_counter())
        stages.write(report, alone.fused)
        moments.append(time.perf_counter())
        for stage, (before, after) in zip(seconds, pairwise(moments), strict=True):
            seconds[stage] += after - before
    return {"seconds": seconds}


def measure_shot(folder: Path, device: str, threads: int) -> dict[str, Any]:
    """Wall seconds of the whole shot, and the process's peak memory after each frame."""
    from oiio_msspl import fuse_shot

    peak: list[float] = []

    def note(*_: Any) -> None:
        peak.append(peak_mb())

    report = fuse_shot(
        folder / "lr", folder / "hr", folder / "out", device=device, threads=threads, overwrite=True, progress=note
    )
    if report.exit_code:
        raise SystemExit(next(result.message for result in report.results.values() if result.message))
    return {"seconds": report.seconds, "peak_mb": peak}


def measured(kind: str, folder: Path, args: argparse.Namespace) -> dict[str, Any]:
    options = "--device", args.device, "--threads", str(args.threads)
    return in_process("research.benchmarks.shot", "--measure", kind, str(folder), *options)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--size", default="1024x576")
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=2, help="times that both are measured, in turn")
    parser.add_argument("--measure", nargs=2, help=argparse.SUPPRESS)
    results.add_option(parser)
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
    # After the first tenth every stage has had its first frames.
    early = max(3, args.frames // 10) - 1
    memory = [(r[1]["peak_mb"][early], r[1]["peak_mb"][-1]) for r in rounds]
    peak_early, peak_late = max(memory, key=lambda pair: pair[1] / pair[0])
    row: Row = {name: getattr(args, name) for name in ("frames", "size", "scale", "device", "threads")}
    row |= {"machine": processor(), "cores": os.cpu_count(), **{f"{stage}_s": s for stage, s in alone.items()}}
    row |= {"shot_s": wall, "peak_early_mb": peak_early, "peak_late_mb": peak_late}
    print(layout(row))
    if args.table:
        results.write(args.table, [row])


def layout(row: Row) -> str:
    """A line for each stage, for their sum and for the shot."""
    stages = {f"{stage} alone": row[f"{stage}_s"] for stage in ("read", "infer", "write")}
    slowest = max(stages.values())
    lines = stages | {"one after the other": sum(stages.values()), "the shot": row["shot_s"]}
    head = [f"{row['frames']} frames, {row['size']} x{row['scale']}, {row['device']}", "s", "of the slowest stage"]
    body = [[name, f"{seconds:.2f}", f"{seconds / slowest:.2f}"] for name, seconds in lines.items()]
    memory = f"Peak memory early in the shot: {row['peak_early_mb']:.0f} MB, at its end: {row['peak_late_mb']:.0f} MB."
    return f"{results.markdown(head, body)}\n{memory}\n"


if __name__ == "__main__":
    main()
