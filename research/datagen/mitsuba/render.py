# SPDX-License-Identifier: Apache-2.0
"""Views of a scene as training files: choose cameras, render, expose, write."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import mitsuba as mi
import numpy as np

from research.datagen import quality, views

from . import scenes
from .assets import Assets
from .trace import MAX_DEPTH, Camera, render_passes

_ATTEMPTS = 12  # cameras that are tried for a view
_GOOD_REFERENCE, _WORST_REFERENCE = 27.0, 21.0  # dB, of the reference's own noise
_BATCH = 16  # samples a pixel per wavefront: bounds the memory


def find_cameras(scene: mi.Scene, plan: scenes.Scene, seed: int, view: int, lit_share: float = 0.6) -> Iterator[Camera]:
    """Yield random cameras that are not inside an object, in front of a bare wall or in the dark.

    At 16 spp and 32 x 32 pixels, at least `lit_share` of the pixels must have light.
    """
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([seed, view, attempt, scenes.VERSION])
        camera = scenes.camera(plan, rng)
        probe = render_passes(scene, camera, 32, 16, seed=int(rng.integers(2**31)))
        if quality.shows_something(probe.mean(0), lit_share) and _distance(scene, camera) > 0.15:
            yield camera


def _distance(scene: mi.Scene, camera: Camera) -> float:
    """Return the 10th percentile of the depths of a 16 x 16 grid of pixels, in metres."""
    y, x = np.mgrid[0:16, 0:16].reshape(2, -1) / 16
    rays = camera.rays(mi.Float(x), mi.Float(y), mi.Point2f(0.5))
    t = scene.ray_intersect(rays).t.numpy()
    return float(np.percentile(np.minimum(t, 1e3), 10))


def _reference(scene: mi.Scene, camera: Camera, spp: int, seed: int) -> tuple[np.ndarray, int, float] | None:
    """Render a reference with `spp` samples a pixel, or with twice as many if it is still noisy.

    Returns:
        The image (H, W, 3), its spp and its estimated sRGB PSNR; None if the first samples show that it would stay
        too noisy.
    """
    halves, done = np.zeros((2, views.SIZE, views.SIZE, 3)), 0

    def psnr() -> float:
        return quality.psnr_of_mean(*halves * (2 / done))

    while True:
        for half in range(2):
            passes = render_passes(scene, camera, views.SIZE, _BATCH, seed + done + half, layers=False)
            halves[half] += passes.sum(0, dtype=np.float64)
        done += 2 * _BATCH
        if done == 2 * _BATCH and psnr() + 10 * np.log10(2 * spp / done) < _WORST_REFERENCE:
            return None
        if done >= 2 * spp or (done >= spp and psnr() > _GOOD_REFERENCE):
            return halves.sum(0) / done, done, psnr()


def render_view(
    scene: mi.Scene, plan: scenes.Scene, camera: Camera, seed: int, view: int, ref_spp: int
) -> dict[str, np.ndarray] | None:
    """Render all arrays of one view, see :mod:`research.datagen.views`; None if the reference stays too noisy."""
    rng = np.random.default_rng([seed, view, 7])
    # Each of the three independent renders gets 1000 seeds of its own.
    base = [int(s) * 1000 for s in rng.choice(4_000_000, 3, replace=False)]
    reference = _reference(scene, camera, ref_spp, base[0])
    if reference is None:
        return None
    ref, ref_spp, psnr = reference
    hr = render_passes(scene, camera, views.SIZE, views.HR_PASSES, base[1])
    # Box-filtered passes at full resolution give the LRHS of every scale.
    seeds = enumerate(views.LR_SPP, start=base[2] + 100)
    lr = np.stack([render_passes(scene, camera, views.SIZE, n, seed, layers=False).mean(0) for seed, n in seeds])
    meta = {
        "seed": seed, "view": view, "split": views.split_of(seed), "generator": scenes.VERSION, "kind": plan.kind,
        "renderer": f"Mitsuba {mi.__version__}, variant {mi.variant()}, own path tracer, {MAX_DEPTH} bounces",
        "sampler": "independent", "filter": "box",
        "ref_spp": ref_spp, "ref_psnr": psnr,
        "assets": sorted(plan.sources), "camera": camera.__dict__,
    }  # fmt: skip
    return views.pack(hr, {1: lr}, ref, rng, meta)


def render_scene(out: Path, seed: int, assets: Assets, count: int, ref_spp: int) -> tuple[int, str]:
    """Render the missing ones of a scene's first `count` views; return how many were written and the kind of scene."""
    missing = views.missing(out, "mitsuba", seed, count)
    if not missing:
        return 0, "done before"
    scene, plan = scenes.build(seed, assets)

    def renders(view: int) -> Iterator[dict[str, np.ndarray] | None]:
        for camera in find_cameras(scene, plan, seed, view):
            yield render_view(scene, plan, camera, seed, view, ref_spp)

    return views.write(missing, renders), plan.kind
