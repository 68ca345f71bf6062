# SPDX-License-Identifier: Apache-2.0
"""The command line: `python -m training.mitsuba_views --out DIR --seeds 0:400`."""

from __future__ import annotations

import argparse
import ctypes.util
import gc
import os
import shutil
import sys
import time
import traceback
from pathlib import Path


def _seeds(text: str) -> range:
    first, _, last = text.partition(":")
    return range(int(first), int(last or int(first) + 1))


def _arguments() -> argparse.Namespace:
    p = argparse.ArgumentParser(prog="python -m training.mitsuba_views", description="Render training views.")
    p.add_argument("--out", type=Path, required=True, help="folder of the .npz files; finished views are kept")
    p.add_argument("--seeds", type=_seeds, default=range(0, 400), help="first:last, the last not included")
    p.add_argument("--assets", type=Path, help="folder with hdri/ and models/; procedural content only without it")
    p.add_argument("--minutes", type=float, default=float("inf"), help="start no further scene after this time")
    p.add_argument("--threads", type=int, default=1)
    p.add_argument("--ref-spp", type=int, default=96)
    p.add_argument("--min-free", type=float, default=15.0, help="stop when the disk has fewer GiB left")
    p.add_argument("--variant", default="llvm_ad_rgb")
    return p.parse_args()


def main() -> int:
    args = _arguments()
    if "DRJIT_LIBLLVM_PATH" not in os.environ and (llvm := ctypes.util.find_library("LLVM-19")):
        os.environ["DRJIT_LIBLLVM_PATH"] = llvm
    import drjit as dr
    import mitsuba as mi

    mi.set_variant(args.variant)
    dr.set_thread_count(args.threads)
    # Imported only now: these modules name Mitsuba's types, which exist once a variant is set.
    from .assets import Assets
    from .render import render_scene

    args.out.mkdir(parents=True, exist_ok=True)
    assets = Assets(args.assets)
    start, total = time.monotonic(), 0
    for seed in args.seeds:
        if time.monotonic() - start > args.minutes * 60:
            print("out of time")
            break
        if shutil.disk_usage(args.out).free < args.min_free * 2**30:
            print("disk nearly full", file=sys.stderr)
            return 1
        before = time.monotonic()
        try:
            count, kind = render_scene(args.out, seed, assets, args.ref_spp)
        except Exception:  # one impossible scene must not end a night's rendering
            print(f"{seed:6d} failed", file=sys.stderr)
            traceback.print_exc()
            continue
        total += count
        rate = total / (time.monotonic() - start) * 60
        print(
            f"{seed:6d} {kind:12s} {count} views, {time.monotonic() - before:5.1f} s; {rate:.1f} views/min",
            flush=True,
        )
        gc.collect()  # scenes hold each other in cycles
    return 0


if __name__ == "__main__":
    sys.exit(main())
