# SPDX-License-Identifier: Apache-2.0
"""Training views that keep the place of every sample, see :mod:`research.datagen.samples` for the files.

    python -m research.datagen.mitsuba.render_samples --out VIEWS --seeds 0:400 --assets ASSETS --rooms ROOMS

Scenes are those of :mod:`research.datagen.mitsuba.scenes`; with ``--rooms``, every third is a variation of a room that
somebody else built (:mod:`research.datagen.mitsuba.rooms`). References for training and validation are denoised at
once, at the resolution of their cells. With ``--keep-noise``, they stay as rendered, with their albedo and normal, and
:mod:`research.training.pool` denoises them. References for testing always stay as rendered, because a denoiser must not
be scored against its own results.

With ``--ref-spp 0``, no reference is rendered, and a view takes a few seconds. Such views are only for the teacher of
:mod:`research.training.pool`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from oiio_msspl.image.filters import box_downsample
from research.datagen import command_line, quality, samples, views
from research.datagen.mitsuba import VARIANT, start
from research.datagen.references import denoised

if TYPE_CHECKING:  # Mitsuba's types exist only after a variant is set
    import mitsuba as mi

    from research.datagen.mitsuba.assets import Assets
    from research.datagen.mitsuba.scenes import Scene
    from research.datagen.mitsuba.trace import Camera

_LIT = 0.3  # share of pixels that have light at 16 spp: less than for other views, because light may be rare
_GOOD_REFERENCE, _WORST_REFERENCE = 26.0, 18.0  # dB, of the rendered reference's own noise
_BATCH = 4  # samples a reference cell per wavefront: bounds the memory


def _reference(scene: mi.Scene, camera: Camera, spp: int, seed: int) -> tuple[dict[str, np.ndarray], int, float] | None:
    """Render colour, albedo and normal of the reference's cells, (R*H, R*W, 3), at `spp` a pixel or twice as many.

    Returns:
        The images, the spp and the sRGB PSNR at the view's resolution, estimated from two halves; None if the first
        samples show that it would stay too noisy.
    """
    from research.datagen.mitsuba.trace import render_sum

    cells = views.REF_CELLS
    batch = min(_BATCH, max(spp // (2 * cells**2), 1))
    names = ("color", "albedo", "normal")
    halves = {name: np.zeros((2, *[cells * samples.SIZE] * 2, 3)) for name in names}
    done, per_step = 0, 2 * batch * cells**2
    while True:
        for half in range(2):
            for name, sums in render_sum(scene, camera, cells * samples.SIZE, batch, seed + done + half, names).items():
                halves[name][half] += sums
        done += per_step
        pixels = [box_downsample(half.astype(np.float32), cells) * (2 * cells**2 / done) for half in halves["color"]]
        psnr = quality.psnr_of_mean(pixels[0], pixels[1])
        if done == per_step and psnr + 10 * np.log10(2 * spp / done) < _WORST_REFERENCE:
            return None
        if done >= 2 * spp or (done >= spp and psnr > _GOOD_REFERENCE):
            return {name: halves[name].sum(axis=0) * (cells**2 / done) for name in names}, done, psnr


def render_view(
    scene: mi.Scene, plan: Scene, camera: Camera, seed: int, view: int, split: str, ref_spp: int, *, keep_noise: bool
) -> dict[str, np.ndarray] | None:
    """Render all arrays of one view; None if the reference stays too noisy."""
    import mitsuba as mi

    from research.datagen.mitsuba.scenes import VERSION
    from research.datagen.mitsuba.trace import LAYERS, MAX_DEPTH, render_samples

    rng = np.random.default_rng([seed, view, 7])
    # The reference, the samples of the HRLS and those of the LRHS are independent
    base = [int(s) * 1000 for s in rng.choice(4_000_000, 3, replace=False)]
    reference = _reference(scene, camera, ref_spp, base[0]) if ref_spp else ({}, 0, 0.0)
    if reference is None:
        return None
    images, ref_spp, psnr = reference

    def drawn(count: int, seed: int, names: tuple[str, ...]) -> dict[str, np.ndarray]:
        parts = [render_samples(scene, camera, samples.SIZE, 4, seed + i, names) for i in range(count // 4)]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    hr = drawn(samples.HR_SAMPLES, base[1], LAYERS)
    lr = drawn(samples.LR_SAMPLES, base[2], LAYERS[:3])
    stored_split = "train" if split == "room" else split
    meta = {
        "seed": f"{plan.kind}-{seed}" if split == "room" else seed, "view": view,
        "split": stored_split if ref_spp else views.NO_REFERENCE, "generator": VERSION, "kind": plan.kind,
        "renderer": f"Mitsuba {mi.__version__}, variant {mi.variant()}, own path tracer, {MAX_DEPTH} bounces",
        "sampler": "independent", "ref_spp": ref_spp, "ref_psnr": psnr,
        "ref_denoised": ref_spp > 0 and split != "test" and not keep_noise,
        "assets": sorted(plan.sources), "camera": camera.__dict__,
    }  # fmt: skip
    if not ref_spp:
        mean = lr["color"].mean(axis=0).repeat(views.REF_CELLS, axis=0).repeat(views.REF_CELLS, axis=1)
        return samples.pack(hr, lr, mean, rng, meta)
    if keep_noise:
        layers = {name: images[name] for name in ("albedo", "normal")}
        return samples.pack(hr, lr, images["color"], rng, meta, layers)
    return samples.pack(hr, lr, images["color"] if split == "test" else denoised(**images), rng, meta)


def render_scene(args: argparse.Namespace, assets: Assets, seed: int) -> tuple[int, str]:
    """Render the missing ones of a scene's views; return how many were written and the kind of scene."""
    from research.datagen.mitsuba import rooms, scenes
    from research.datagen.mitsuba.render import find_cameras

    missing = views.missing(args.out, "mitsuba", seed, args.views, views.SAMPLES_SUFFIX)
    if not missing:
        return 0, "done before"
    is_room = args.rooms is not None and seed % 3 == 2
    if args.kind is not None and (is_room or scenes.kind_of(seed) != args.kind):
        return 0, "another kind"
    # Rooms of other people are for training only: all seeds share their walls
    split = "room" if is_room else views.split_of(seed)
    if not args.ref_spp and split not in ("room", "train"):
        return 0, f"for {split}"
    scene, plan = rooms.build(args.rooms, seed, assets) if is_room else scenes.build(seed, assets)

    def renders(view: int) -> Iterator[dict[str, np.ndarray] | None]:
        for camera in find_cameras(scene, plan, seed, view, _LIT):
            yield render_view(scene, plan, camera, seed, view, split, args.ref_spp, keep_noise=args.keep_noise)

    return views.write(missing, renders), plan.kind


def main() -> int:
    module, description = "research.datagen.mitsuba.render_samples", "Render training views that keep their samples."
    parser = command_line.parser(module, description, ref_spp=48)
    parser.add_argument("--assets", type=Path, help=command_line.ASSETS)
    parser.add_argument("--rooms", type=Path, help="folder with bathroom2/ and living-room-3/, Mitsuba scenes")
    parser.add_argument("--kind", help="of scenes, only those of this one, such as ajar_room")
    parser.add_argument("--max-gib", type=float, default=6.0, help="start no new scene above this size (%(default)s)")
    keep = "references as rendered, for research.training.pool to denoise"
    parser.add_argument("--keep-noise", action="store_true", help=keep)
    parser.add_argument("--variant", default=VARIANT, help="of Mitsuba; cuda_ad_rgb for a GPU (%(default)s)")
    args = parser.parse_args()
    start(args.threads, args.variant)
    from research.datagen.mitsuba.assets import Assets
    from research.datagen.mitsuba.scenes import KINDS

    if args.kind and args.kind not in (kinds := [kind.__name__ for kind in KINDS]):
        parser.error(f"--kind {args.kind}: not one of {', '.join(kinds)}")
    assets = Assets(args.assets)

    def render(seed: int) -> tuple[int, str]:
        if sum(path.stat().st_size for path in args.out.glob(f"*{views.SAMPLES_SUFFIX}")) > args.max_gib * 2**30:
            raise SystemExit(f"{args.out}: holds more than {args.max_gib} GiB; raise --max-gib to go on")
        return render_scene(args, assets, seed)

    return command_line.render_all(args, render)


if __name__ == "__main__":
    sys.exit(main())
