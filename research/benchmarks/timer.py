# SPDX-License-Identifier: Apache-2.0
"""Measure seconds and peak memory of commands and functions, each in a fresh process, in turn with others.

Taking turns favours none of them on a machine whose speed drifts. Processor seconds (user and system, of all threads)
hardly depend on what else the machine does; wall seconds do.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from research.benchmarks.results import Row

#: The kernel counts memory in KB, on macOS in bytes.
MAXRSS_IN_MB = 1 << 20 if sys.platform == "darwin" else 1 << 10


@dataclass(frozen=True)
class Function:
    """A function that runs in a fresh process: it returns the call that is timed, or None if all of it is timed."""

    name: str
    """``module:function``."""
    arguments: Sequence[str | int] = ()
    repeats: int = 1
    """Calls that are timed, after one that warms up."""


@dataclass(frozen=True)
class Run:
    """What one process took."""

    seconds: tuple[float, ...]
    cpu_seconds: float
    """Of the whole process, preparation included."""
    peak_mb: float


def in_turn(jobs: Mapping[Any, Function | Sequence[str]], rounds: int) -> dict[Any, list[Run]]:
    """Run every job, a function or a command as a list of words, once in each round; return the runs of each.

    Raises:
        SystemExit: a job fails. The message is what it printed.
    """
    runs: dict[Any, list[Run]] = {name: [] for name in jobs}
    for _ in range(rounds):
        for name, job in jobs.items():
            runs[name].append(run(job))
    return runs


def run(job: Function | Sequence[str]) -> Run:
    """Run one job in a fresh process."""
    if isinstance(job, Function):
        timed = [job.name, str(job.repeats), json.dumps(job.arguments)]
        command = [sys.executable, "-m", "research.benchmarks.timer", *timed]
    else:
        command = list(job)
    with tempfile.TemporaryFile("w+") as output, tempfile.TemporaryFile("w+") as errors:
        start = time.perf_counter()
        process = subprocess.Popen(command, stdout=output, stderr=errors)
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        for file in (output, errors):
            file.seek(0)
        if process.returncode:
            raise SystemExit(f"{' '.join(command)}\n{errors.read()}")
        cpu = usage.ru_utime + usage.ru_stime
        if not isinstance(job, Function):
            return Run((seconds,), cpu, usage.ru_maxrss / MAXRSS_IN_MB)
        measured = json.loads(output.read().splitlines()[-1])
        return Run(tuple(measured["seconds"]), cpu, measured["peak_mb"])


def summary(runs: Sequence[Run]) -> Row:
    """Return the median, fastest and slowest seconds of all runs, median processor seconds, and the largest memory."""
    seconds = [value for done in runs for value in done.seconds]
    row: Row = {"seconds": statistics.median(seconds), "fastest": min(seconds), "slowest": max(seconds)}
    row["cpu_seconds"] = statistics.median(done.cpu_seconds for done in runs)
    return row | {"peak_mb": max(done.peak_mb for done in runs), "rounds": len(runs), "cores": os.cpu_count()}


def seconds_of(
    call: Callable[[], Any], repeats: int, warm_up: int = 1, wait: Callable[[], Any] = lambda: None
) -> list[float]:
    """Time calls in this process, after some that warm up. ``wait`` blocks until a GPU has finished."""
    seconds = []
    for repeat in range(repeats + warm_up):
        wait()
        start = time.perf_counter()
        call()
        wait()
        if repeat >= warm_up:
            seconds.append(time.perf_counter() - start)
    return seconds


def peak_mb() -> float:
    """Return the largest resident set of this process so far, in MB.

    On Linux, `getrusage` would also count the program that started this one, so the kernel's own mark is read.
    """
    status = Path("/proc/self/status")
    if status.exists() and (mark := re.search(r"VmHWM:\s+(\d+) kB", status.read_text())):
        return int(mark[1]) / (1 << 10)
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / MAXRSS_IN_MB


def main() -> None:
    """Run a :class:`Function` in this process and print its seconds and its peak memory as JSON."""
    name, repeats, arguments = sys.argv[1:]
    module, _, function = name.partition(":")
    start = time.perf_counter()
    call = getattr(importlib.import_module(module), function)(*json.loads(arguments))
    seconds = [time.perf_counter() - start] if call is None else seconds_of(call, int(repeats))
    print(json.dumps({"seconds": seconds, "peak_mb": peak_mb()}))


if __name__ == "__main__":
    main()
