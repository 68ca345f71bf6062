# SPDX-License-Identifier: Apache-2.0
"""Views of a scene as training files: choose cameras, render, expose, write."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import mitsuba as mi
import numpy as np

from oiio_msspl.transforms import luminance as luminance_of
from oiio_msspl.transforms import srgb

from . import scenes
from .assets import Assets
from .trace import MAX_DEPTH, Camera, render_passes

SIZE = 256
HR_PASSES = 8
LR_SPP = (1, 1, 2, 4, 8)
VIEWS = 3
_ATTEMPTS, _RENDERS = 12, 2  # cameras tried, and how many of them are rendered at most, per view
_GOOD_REFERENCE, _WORST_REFERENCE = 27.0, 21.0  # dB, of the reference's own noise
_BATCH = 16  # samples a pixel per wavefront: bounds the memory


def split(seed: int) -> str:
    """Whole scenes are held out, never single views of one."""
    return {0: "validation", 1: "test"}.get(seed % 20, "train")


def path_of(out: Path, seed: int, view: int) -> Path:
    return out / f"mitsuba-{seed:06d}-{view}.npz"


def _interest(probe: np.ndarray) -> tuple[bool, str]:
    """Whether a (spp, n, n, 15) probe shows something, and if not, why."""
    mean = probe.mean(0)
    luminance = luminance_of(mean[..., :3])
    albedo, normal = mean[..., 3:6], mean[..., 6:9]

    def edges(x: np.ndarray, threshold: float) -> float:
        return float((np.abs(np.diff(x, axis=0)).max(-1) > threshold).mean())

    # Dark regions are wanted, views of nothing else are not.
    if (luminance > 3e-3 * max(np.percentile(luminance, 90), 1e-9)).mean() < 0.6:
        return False, "black"
    if (np.abs(normal).max(-1) == 0).mean() > 0.6:
        return False, "background"
    if edges(normal, 0.3) < 0.06 or edges(normal, 0.3) + edges(albedo, 0.08) < 0.15:
        return False, "empty"
    return True, ""


def find_cameras(scene: mi.Scene, plan: scenes.Scene, seed: int, view: int) -> Iterator[Camera]:
    """A few random cameras that are not inside something, facing a wall, or in the dark."""
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([seed, view, attempt, scenes.VERSION])
        camera = scenes.camera(plan, rng)
        probe = render_passes(scene, camera, 32, 16, seed=int(rng.integers(2**31)))
        if _interest(probe)[0] and _distance(scene, camera) > 0.15:
            yield camera


def _distance(scene: mi.Scene, camera: Camera) -> float:
    """The 10th percentile of the distance to what a 16 x 16 grid of pixels sees, in metres."""
    y, x = np.mgrid[0:16, 0:16].reshape(2, -1) / 16
    rays = camera.rays(mi.Float(x), mi.Float(y), mi.Point2f(0.5))
    t = scene.ray_intersect(rays).t.numpy()
    return float(np.percentile(np.minimum(t, 1e3), 10))


def _log_mean(color: np.ndarray) -> float:
    """The log-mean luminance of linear colour (..., 3)."""
    luminance = luminance_of(color)
    return float(np.exp(np.log(luminance + 1e-4 * luminance.mean() + 1e-12).mean()))


def _reference(scene: mi.Scene, camera: Camera, spp: int, seed: int) -> tuple[np.ndarray, int, float] | None:
    """The mean of `spp` samples a pixel, (SIZE, SIZE, 3), or of twice as many where that is noisy.

    Also the number of samples, and the reference's own error as an sRGB PSNR: its halves differ by twice it.
    None where the first samples show that this will not do.
    """
    halves, done = np.zeros((2, SIZE, SIZE, 3)), 0

    def quality() -> float:
        a, b = halves * (2 / done)
        exposure = 0.18 / _log_mean((a + b) / 2)
        error = np.square(srgb(a * exposure) - srgb(b * exposure)).mean() / 4
        return float(-10 * np.log10(max(error, 1e-12)))

    while True:
        for half in range(2):
            passes = render_passes(scene, camera, SIZE, _BATCH, seed + done + half, layers=False)
            halves[half] += passes.sum(0, dtype=np.float64)
        done += 2 * _BATCH
        if done == 2 * _BATCH and quality() + 10 * np.log10(2 * spp / done) < _WORST_REFERENCE:
            return None
        if done >= 2 * spp or (done >= spp and quality() > _GOOD_REFERENCE):
            return halves.sum(0) / done, done, quality()


def _half(x: np.ndarray) -> np.ndarray:
    return np.clip(x, -65504, 65504).astype(np.float16)


def render_view(
    scene: mi.Scene, plan: scenes.Scene, camera: Camera, seed: int, view: int, ref_spp: int
) -> dict[str, np.ndarray] | None:
    """All arrays of one training file as the package's docstring has them; None if it will not converge."""
    rng = np.random.default_rng([seed, view, 7])
    # A stretch of 1000 seeds for each of the independent renders.
    base = [int(s) * 1000 for s in rng.choice(4_000_000, 3, replace=False)]
    found = _reference(scene, camera, ref_spp, base[0])
    if found is None:
        return None
    ref, spent, quality = found
    hr = render_passes(scene, camera, SIZE, HR_PASSES, base[1])
    passes = render_passes(scene, camera, SIZE, sum(LR_SPP), base[2], layers=False)
    groups = np.split(passes, np.cumsum(LR_SPP)[:-1])
    lr = np.stack([g.mean(0) for g in groups])

    # Light is linear: scale it now so that half precision holds it, over three decades of brightness.
    luminance = luminance_of(ref)
    target = 10 ** rng.uniform(-1.5, 1.3)
    scale = target / _log_mean(ref)
    hr[..., :3] *= scale
    hr[..., 9:] *= scale
    meta = {
        "seed": seed, "view": view, "split": split(seed), "generator": scenes.VERSION, "kind": plan.kind,
        "renderer": f"Mitsuba {mi.__version__}, variant {mi.variant()}, own path tracer, {MAX_DEPTH} bounces",
        "sampler": "independent", "filter": "box", "ref_spp": spent, "ref_psnr": quality,
        "assets": sorted(plan.sources), "camera": camera.__dict__,
        "exposure": {
            "scale": scale, "log_mean": target, "mean": float(luminance.mean() * scale),
            "p1": float(np.percentile(luminance, 1) * scale),
            "p99": float(np.percentile(luminance, 99) * scale),
        },
    }  # fmt: skip
    return {
        "hr": _half(hr),
        "lr": _half(lr * scale),
        "lr_spp": np.array(LR_SPP, np.int32),
        "ref": _half(ref * scale),
        "meta": np.array(json.dumps(meta)),
    }


def render_scene(out: Path, seed: int, assets: Assets, ref_spp: int) -> tuple[int, str]:
    """Write the missing views of a scene; return how many were written and the kind of the scene."""
    missing = [v for v in range(VIEWS) if not path_of(out, seed, v).exists()]
    if not missing:
        return 0, "done before"
    scene, plan = scenes.build(seed, assets)
    written = 0
    for view in missing:
        renders = (render_view(scene, plan, c, seed, view, ref_spp) for c in find_cameras(scene, plan, seed, view))
        arrays = next((r for r in islice(renders, _RENDERS) if r is not None), None)
        if arrays is None:
            continue
        path = path_of(out, seed, view)
        # A reader never sees half a file; the process id keeps two writers apart.
        temporary = path.with_name(f".{path.stem}.{os.getpid()}.npz")
        np.savez(temporary, **arrays)
        os.replace(temporary, path)
        written += 1
    return written, plan.kind
