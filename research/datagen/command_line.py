# SPDX-License-Identifier: Apache-2.0
"""The command line that all renderers of training views share: the options, and the loop over scenes."""

from __future__ import annotations

import argparse
import gc
import shutil
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

#: Rendering stops when the disk has fewer bytes left.
MIN_FREE = 15 * 2**30
#: Help of the option that the renderers with Mitsuba have.
ASSETS = "folder with hdri/ and models/; without it all content is procedural"


def _seeds(text: str) -> range:
    """``first``, ``first:last`` or ``first:last:step``; the last one is not included."""
    first, *rest = map(int, text.split(":"))
    return range(first, *(rest or [first + 1]))


def parser(module: str, description: str, ref_spp: int) -> argparse.ArgumentParser:
    """Return the options of every renderer; a renderer may add its own."""
    p = argparse.ArgumentParser(prog=f"python -m {module}", description=description)
    p.add_argument(
        "--out", type=Path, required=True, help="folder of the .npz files; finished views are not rendered again"
    )
    seeds = "first:last or first:last:step, last not included (0:400)"
    p.add_argument("--seeds", type=_seeds, default=range(0, 400), help=seeds)
    p.add_argument("--views", type=int, default=3, help="views per scene (%(default)s)")
    p.add_argument("--threads", type=int, default=1, help="CPU threads (%(default)s)")
    p.add_argument("--ref-spp", type=int, default=ref_spp, help="spp of a reference; noisy ones get more (%(default)s)")
    return p


def render_all(args: argparse.Namespace, render_scene: Callable[[int], tuple[int, str]]) -> int:
    """Render the scenes of all seeds and print a line for each; return the exit code.

    Args:
        render_scene: takes a seed, returns the number of views written and the kind of scene.
    """
    args.out.mkdir(parents=True, exist_ok=True)
    start, total = time.monotonic(), 0
    for seed in args.seeds:
        if shutil.disk_usage(args.out).free < MIN_FREE:
            print("disk nearly full", file=sys.stderr)
            return 1
        before = time.monotonic()
        try:
            count, kind = render_scene(seed)
        except Exception:  # one broken scene must not end a long run
            print(f"{seed:6d} failed", file=sys.stderr)
            traceback.print_exc()
            continue
        total += count
        rate = total / (time.monotonic() - start) * 60
        seconds = time.monotonic() - before
        print(f"{seed:6d} {kind:12s} {count} views, {seconds:5.1f} s; {rate:.1f} views/min", flush=True)
        gc.collect()  # scenes are reference cycles, which only the collector frees
    return 0
