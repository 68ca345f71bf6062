# SPDX-License-Identifier: Apache-2.0
"""What all renderers of training views share: the layout of a view's file, what is worth rendering, the command line.

NumPy alone, so that every renderer's own environment can import it. :mod:`training.data` describes the file.
"""

from __future__ import annotations

import argparse
import gc
import json
import shutil
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from oiio_msspl.output import replacing
from oiio_msspl.transforms import KEY, srgb
from oiio_msspl.transforms import luminance as luminance_of

SIZE = 256
HR_PASSES = 8
LR_SPP = (1, 1, 2, 4, 8)
FILTERS = ("box", "blackman-harris")
VIEWS = 3
"""Of each scene, if no other number is asked for."""


SPLITS = ("train", "validation", "test")


def split(seed: int) -> str:
    """Whole scenes are held out, never single views of one."""
    return {0: "validation", 1: "test"}.get(seed % 20, "train")


def path_of(out: Path, renderer: str, seed: int, view: int) -> Path:
    return out / f"{renderer}-{seed:06d}-{view}.npz"


def shows_something(probe: np.ndarray) -> bool:
    """Whether a small render (n, n, 15) is neither black nor mostly background nor a bare wall."""
    luminance = luminance_of(probe[..., :3])
    albedo, normal = probe[..., 3:6], probe[..., 6:9]

    def edges(x: np.ndarray, threshold: float) -> float:
        return float((np.abs(np.diff(x, axis=0)).max(-1) > threshold).mean())

    # Dark regions are wanted, views of nothing else are not.
    lit = (luminance > 3e-3 * max(np.percentile(luminance, 90), 1e-9)).mean() >= 0.6
    background = (np.abs(normal).max(-1) == 0).mean() > 0.6
    return bool(
        lit and not background and edges(normal, 0.3) >= 0.06 and edges(normal, 0.3) + edges(albedo, 0.08) >= 0.15
    )


def log_mean(color: np.ndarray) -> float:
    """The log-mean luminance of linear colour (..., 3)."""
    luminance = luminance_of(color)
    return float(np.exp(np.log(luminance + 1e-4 * luminance.mean() + 1e-12).mean()))


def psnr_of_mean(a: np.ndarray, b: np.ndarray) -> float:
    """sRGB PSNR of the mean of two independent renders of equal spp: they differ by twice its error."""
    exposure = KEY / log_mean((a + b) / 2)
    error = np.square(srgb(a * exposure) - srgb(b * exposure)).mean() / 4
    return float(-10 * np.log10(max(error, 1e-12)))


def _half(x: np.ndarray) -> np.ndarray:
    return np.clip(x, -65504, 65504).astype(np.float16)


def lr_key(scale: int) -> str:
    """The name of the LRHS's passes at 1/scale of the resolution."""
    return "lr" if scale == 1 else f"lr_x{scale}"


def pack(
    hr: np.ndarray, lr: dict[int, np.ndarray], ref: np.ndarray, rng: np.random.Generator, meta: dict[str, Any]
) -> dict[str, np.ndarray]:
    """All arrays of a view's file, exposed at random over three decades so that half floats hold them.

    ``lr`` has the passes at full resolution as those of scale 1, or those of every other scale.
    """
    luminance = luminance_of(ref)
    target = 10 ** rng.uniform(-1.5, 1.3)
    scale = target / log_mean(ref)
    hr = hr.copy()
    hr[..., :3] *= scale
    hr[..., 9:] *= scale
    exposure = {
        "scale": scale, "log_mean": target, "mean": float(luminance.mean() * scale),
        "p1": float(np.percentile(luminance, 1) * scale), "p99": float(np.percentile(luminance, 99) * scale),
    }  # fmt: skip
    return {
        "hr": _half(hr),
        **{lr_key(smaller): _half(passes * scale) for smaller, passes in lr.items()},
        "lr_spp": np.array(LR_SPP, np.int32),
        "ref": _half(ref * scale),
        "meta": np.array(json.dumps({**meta, "exposure": exposure})),
    }


def save(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write a view; a reader never sees half of it."""
    with replacing(path, overwrite=True) as temporary:
        np.savez(temporary, **arrays)


# The command line


def _seeds(text: str) -> range:
    first, *rest = map(int, text.split(":"))
    return range(first, *(rest or [first + 1]))


def parser(module: str, ref_spp: int) -> argparse.ArgumentParser:
    """Options of every renderer, which may add its own."""
    p = argparse.ArgumentParser(prog=f"python -m {module}", description="Render training views.")
    p.add_argument("--out", type=Path, required=True, help="folder of the .npz files; finished views are kept")
    p.add_argument(
        "--seeds", type=_seeds, default=range(0, 400), help="first:last or first:last:step, the last not included"
    )
    p.add_argument("--views", type=int, default=VIEWS, help="of each scene")
    p.add_argument("--assets", type=Path, help="folder with hdri/ and models/; procedural content only without it")
    p.add_argument("--minutes", type=float, default=float("inf"), help="start no further scene after this time")
    p.add_argument("--threads", type=int, default=1)
    p.add_argument("--ref-spp", type=int, default=ref_spp)
    p.add_argument("--min-free", type=float, default=15.0, help="stop when the disk has fewer GiB left")
    return p


def render_all(args: argparse.Namespace, render_scene: Callable[[int], tuple[int, str]]) -> int:
    """Call ``render_scene(seed)``, which returns how many views it wrote and the kind of scene, for every seed."""
    args.out.mkdir(parents=True, exist_ok=True)
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
            count, kind = render_scene(seed)
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
        gc.collect()  # scenes may hold each other in cycles
    return 0
