# SPDX-License-Identifier: Apache-2.0
"""Damages renders at random and fuses them: no crash, no hang, no "unexpected", and memory as asked for.

Fuse 500 damaged copies of the pairs of a folder (``NAME/lr.exr`` and ``NAME/hr.exr``), each with msspl-fuse::

    python -m tests.mutants PAIRS --count 500 --seed 0

The exit code is 1 if a run did what no run may do; the files of that run are then kept in ``--keep FOLDER``.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

#: Seconds after which a run counts as hung.
TIME_LIMIT = 30
#: The value of ``--max-memory``, in MiB. It is more than the pairs need.
MAX_MEMORY = 1024


class Attribute(NamedTuple):
    """Where an attribute of a header lies in the file."""

    name: str
    start: int
    """Offset of the name."""
    size: int
    """Offset of the size of the value; the value follows."""
    end: int


def attributes(data: bytes) -> Iterator[Attribute]:
    """Yield the attributes of all headers of an EXR."""
    position, several = 8, bool(struct.unpack_from("<I", data, 4)[0] & 0x1000)
    while data[position]:
        while data[position]:
            start, name_end = position, data.index(b"\0", position)
            size = data.index(b"\0", name_end + 1) + 1
            position = size + 4 + struct.unpack_from("<I", data, size)[0]
            yield Attribute(data[start:name_end].decode("latin-1"), start, size, position)
        position += 1
        if not several:
            return


#: What a name may turn into: Latin-1, line breaks, terminal commands, reversed text, a farm's protocol.
BAD_NAMES = (b"\xe4\xf6\xfc", b"\n", b"\x1b[2J", "\u202e".encode(), b"\nopenjd_env: A=B", b"\0", b"..", b".", b"%s{0}")
#: Sides of forged windows.
CORNERS = (-(2**31), 2**31 - 1, -1, 0, 1, 7, 10**4, 10**6, 2**20, 2**24)


def flip(data: bytearray, rng: random.Random) -> None:
    """Change a few bytes anywhere."""
    for _ in range(rng.choice((1, 3, 20))):
        data[rng.randrange(len(data))] ^= rng.randrange(1, 256)


def flip_header(data: bytearray, rng: random.Random) -> None:
    end = max(attribute.end for attribute in attributes(data))
    for _ in range(rng.choice((1, 2, 4))):
        data[rng.randrange(end)] ^= 1 << rng.randrange(8)


def truncate(data: bytearray, rng: random.Random) -> None:
    del data[rng.randrange(len(data)) :]


def forge_window(data: bytearray, rng: random.Random) -> None:
    windows = [attribute for attribute in attributes(data) if attribute.name in ("dataWindow", "displayWindow")]
    for window in rng.sample(windows, rng.randint(1, len(windows))):
        for corner in rng.sample(range(4), rng.randint(1, 4)):
            struct.pack_into("<i", data, window.size + 4 + 4 * corner, rng.choice(CORNERS))


def forge_name(data: bytearray, rng: random.Random) -> None:
    """Overwrite a part of a channel list, of a part's name, or of the name of any attribute."""
    everything = list(attributes(data))
    named = [entry for entry in everything if entry.name in ("channels", "name", "view", "multiView")] or everything
    values, names = (
        [(entry.size + 4, entry.end) for entry in named],
        [(entry.start, entry.size) for entry in everything],
    )
    start, end = rng.choice(values + names)
    bad = rng.choice(BAD_NAMES)[: end - start]
    place = rng.randint(start, max(start, end - len(bad) - 1))
    data[place : place + len(bad)] = bad


def forge_attribute(data: bytearray, rng: random.Random) -> None:
    """Overwrite the value or the size of an attribute."""
    attribute = rng.choice(list(attributes(data)))
    if rng.random() < 0.3:
        struct.pack_into("<i", data, attribute.size, rng.choice((-1, 0, 1, 2**31 - 1, 10**6)))
        return
    for place in range(attribute.size + 4, min(attribute.end, attribute.size + 4 + rng.choice((1, 4, 16)))):
        data[place] = rng.choice((0, 255, 127, 10, 27, rng.randrange(256)))


MUTATIONS: tuple[Callable[[bytearray, random.Random], None], ...] = (
    flip,
    flip_header,
    truncate,
    forge_window,
    forge_name,
    forge_attribute,
)


def mutant(data: bytes, seed: str) -> tuple[str, bytes]:
    """Damage a file, and return the name of the damage and the file."""
    rng, damaged = random.Random(seed), bytearray(data)
    mutation = rng.choice(MUTATIONS)
    mutation(damaged, rng)
    return mutation.__name__, bytes(damaged)


def mutants(pairs: list[tuple[Path, Path]], folder: Path, count: int, seed: int) -> Iterator[tuple[str, Path, Path]]:
    """Write damaged pairs to ``folder``, one at a time, and yield the damage in words, the LRHS and the HRLS."""
    rng = random.Random(seed)
    for number in range(count):
        pair = [*pairs[number % len(pairs)]]
        side = int(rng.random() < 0.75)
        damage, data = mutant(pair[side].read_bytes(), f"{seed} {number}")
        damaged = folder / pair[side].name
        damaged.write_bytes(data)
        pair[side] = damaged
        yield f"{number}: {damage} in {pairs[number % len(pairs)][side]}", pair[0], pair[1]
        damaged.unlink()


def fault(code: int, output: str, seconds: float, peak: int, limit: int) -> str:
    """Return the fault of a run in words, or an empty string.

    Args:
        code: exit code; negative for a signal.
        output: what it printed.
        seconds: wall time.
        peak: largest resident memory in MiB.
        limit: ``--max-memory`` in MiB.
    """
    if seconds > TIME_LIMIT:
        return f"took {seconds:.0f} s"
    if code not in (0, 1, 2):
        return f"ended with {code}"
    if "unexpected" in output or "Traceback" in output:
        return "an error that nobody thought of"
    if any(not line.isprintable() or line.startswith("openjd") for line in output.split("\n")):
        return "control characters were printed"
    return f"took {peak} MiB" if peak > limit else ""


def run(command: list[str]) -> tuple[int, str, float, int]:
    """Exit code, output, seconds and peak memory in MiB of a process; it is killed some time after ``TIME_LIMIT``."""
    start, peak = time.monotonic(), 0
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(command, stdout=said, stderr=subprocess.STDOUT)
        while True:
            pid, status, usage = os.wait4(process.pid, os.WNOHANG)
            if pid:
                break
            peak = max(peak, peak_mib(process.pid))
            if time.monotonic() - start > 2 * TIME_LIMIT:
                process.kill()
            time.sleep(0.01)
        process.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        text = said.read().decode("utf-8", "backslashreplace")
    return process.returncode, text, time.monotonic() - start, peak or usage.ru_maxrss // 1024


def peak_mib(pid: int | str = "self") -> int:
    """Largest resident set of a running process so far, in MiB; 0 where the kernel keeps no such mark.

    The peak that Linux reports at the end of a process counts the program that started it, too.
    """
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0
    found = re.search(r"VmHWM:\s+(\d+) kB", status)
    return int(found[1]) >> 10 if found else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", type=Path)
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    pairs = [(path.with_name("lr.exr"), path) for path in sorted(options.pairs.glob("*/hr.exr"))]
    program = "from msspl_cli.app import msspl_fuse; msspl_fuse()"
    ends: Counter[str] = Counter()
    longest, largest, faults = 0.0, 0, 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rng = random.Random(options.seed)
        for what, lr, hr in mutants(pairs, folder, options.count, options.seed):
            out = folder / "out.exr"
            layout = rng.choice(("spec", "nuke", "multilayer"))
            more = ["--layout", layout, "--max-memory", f"{MAX_MEMORY}M", "--model", "joint-small", "--threads", "2"]
            code, output, seconds, peak = run([sys.executable, "-c", program, str(lr), str(hr), "-o", str(out), *more])
            wrong = fault(code, output, seconds, peak, MAX_MEMORY)
            left = [path.name for path in folder.iterdir() if path.name.startswith(".")]
            wrong = wrong or (f"left {left}" if left else "")
            if wrong:
                faults += 1
                last = output.strip().splitlines()[-1:] or [""]
                print(f"{what}, {layout}: {wrong}: {ascii(last[0])[:300]}", flush=True)
                if options.keep:
                    kept = options.keep / what.partition(":")[0]
                    kept.mkdir(parents=True, exist_ok=True)
                    shutil.copy(lr, kept / "lr.exr")
                    shutil.copy(hr, kept / "hr.exr")
            ends[f"exit code {code}"] += 1
            longest, largest = max(longest, seconds), max(largest, peak)
            for path in folder.glob("out.*"):
                path.unlink()
    print(f"{options.count} mutants of {len(pairs)} pairs, seed {options.seed}: {dict(sorted(ends.items()))}")
    print(f"{faults} faults; longest {longest:.1f} s, largest {largest} MiB of {MAX_MEMORY} MiB")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
