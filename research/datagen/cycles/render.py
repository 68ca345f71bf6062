# SPDX-License-Identifier: GPL-3.0-or-later
"""Views of a scene as files: choose cameras, render, write."""

from __future__ import annotations

import tempfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import bpy
import numpy as np
import OpenImageIO as oiio

from oiio_msspl.model.contract import SCALES
from research.datagen import quality, views

from . import scenes

_ATTEMPTS = 12  # cameras that are tried for a view
# dB: samples are added until a reference reaches the first PSNR. One below the second is not used.
_GOOD_REFERENCE, _WORST_REFERENCE = 40.0, 30.0
_STEPS = 12  # times that `ref_spp` samples are added, at most
_FILTER = "BLACKMAN_HARRIS"  # Cycles' default
LIGHT_PASSES = [f"{kind}_{part}" for kind in ("diffuse", "glossy") for part in ("direct", "indirect", "color")]


def set_up(scene: bpy.types.Scene, threads: int, codec: str) -> None:
    """Set Cycles to the CPU, without whatever would change samples, and its output to a multi-layer EXR of floats."""
    scene.render.engine = "CYCLES"
    c, r = scene.cycles, scene.render
    c.device = "CPU"
    c.use_denoising = c.use_adaptive_sampling = c.use_animated_seed = False
    c.sample_clamp_direct = c.sample_clamp_indirect = 0.0
    r.threads_mode, r.threads = "FIXED", threads
    r.use_compositing = r.use_sequencer = r.film_transparent = False
    r.resolution_percentage, r.dither_intensity = 100, 0.0
    image = r.image_settings
    image.media_type, image.file_format = "MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER"
    image.color_depth, image.exr_codec, image.use_exr_interleave = "32", codec, True


def write_frame(scene: bpy.types.Scene, path: Path, size: Sequence[int], spp: int, title: str) -> None:
    """Render a file of Blender's own; the random numbers follow from the title. It appears when it is complete."""
    part = path.with_name(f"{path.stem}.part.exr")
    scene.render.resolution_x, scene.render.resolution_y = size
    scene.cycles.samples, scene.cycles.seed = spp, zlib.crc32(title.encode()) % 2**31
    scene.render.filepath = str(part)
    bpy.ops.render.render(write_still=True)
    part.replace(path)


class Renderer:
    """Cycles on the open scene, at frame 1. It renders into one scratch file."""

    def __init__(self, scratch: Path, stage: scenes.Stage, threads: int) -> None:
        self._file = scratch / "render.exr"
        self._scene = scene = stage.scene
        set_up(scene, threads, "NONE")
        rng, c, r = stage.rng, scene.cycles, scene.render
        c.caustics_reflective = c.caustics_refractive = stage.caustics
        c.blur_glossy = 0.0 if rng.random() < 0.5 else 1.0  # "Filter Glossy": 1 is Blender's default
        # Blender's default amounts to blue noise in final renders.
        c.sampling_pattern = str(rng.choice(["BLUE_NOISE", "TABULATED_SOBOL"]))
        c.max_bounces = int(rng.integers(8, 13))
        limit = c.max_bounces if rng.random() < 0.5 else 4
        c.diffuse_bounces = c.glossy_bounces = limit
        c.transmission_bounces = c.max_bounces
        c.volume_bounces = 2
        r.use_persistent_data, r.filepath = True, str(self._file)
        self.settings = {
            "sampler": c.sampling_pattern.lower(), "bounces": c.max_bounces, "diffuse_bounces": limit,
            "caustics": stage.caustics, "motion_blur": r.use_motion_blur,
        }  # fmt: skip

    def layers(self, on: bool) -> None:
        """Switch all AOVs on, or all but the colour off."""
        layer = self._scene.view_layers[0]
        for name in LIGHT_PASSES:
            setattr(layer, f"use_pass_{name}", on)
        layer.cycles.denoising_store_passes = on

    def render(self, size: int, spp: int, seed: int, pixel_filter: str = _FILTER) -> dict[str, np.ndarray]:
        """Render; return AOVs (size, size, C) by Blender's names, scene-linear and finite."""
        c = self._scene.cycles
        c.samples, c.seed = spp, seed
        c.pixel_filter_type, c.filter_width = pixel_filter, 1.5
        self._scene.render.resolution_x = self._scene.render.resolution_y = size
        bpy.ops.render.render(write_still=True)
        buffer = oiio.ImageBuf(str(self._file))
        if buffer.has_error:
            raise RuntimeError(f"Cycles wrote no image: {buffer.geterror()}")
        pixels = np.nan_to_num(np.asarray(buffer.get_pixels(oiio.FLOAT)), nan=0.0, posinf=0.0, neginf=0.0)
        layers: dict[str, list[int]] = {}
        for i, channel in enumerate(buffer.spec().channelnames):
            layers.setdefault(channel.split(".")[-2], []).append(i)
        return {name: pixels[..., channels] for name, channels in layers.items()}


def features(layers: dict[str, np.ndarray]) -> np.ndarray:
    """Colour, albedo, normal, diffuse, specular, (H, W, 15), composed as the package composes a Cycles file."""
    diffuse = (layers["Diffuse Direct"] + layers["Diffuse Indirect"]) * layers["Diffuse Color"]
    specular = (layers["Glossy Direct"] + layers["Glossy Indirect"]) * layers["Glossy Color"]
    parts = [layers["Combined"][..., :3], layers["Denoising Albedo"], layers["Denoising Normal"], diffuse, specular]
    return np.concatenate(parts, axis=-1)


def _color(layers: dict[str, np.ndarray]) -> np.ndarray:
    return layers["Combined"][..., :3]


def find_cameras(renderer: Renderer, stage: scenes.Stage, seed: int, view: int) -> Iterator[dict[str, object]]:
    """Yield random cameras that are not inside an object, in front of a bare wall or in the dark."""
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([seed, view, attempt, scenes.VERSION])
        camera = scenes.aim(stage, rng)
        renderer.layers(True)
        probe = renderer.render(32, 16, int(rng.integers(2**31)), "BOX")
        depth = probe["Denoising Depth"]
        near = np.percentile(np.where(depth > 0, depth, 1e3), 10)  # metres; 0: background
        if (near > 0.15 or stage.hazy) and quality.shows_something(features(probe)):
            yield camera


def _reference(renderer: Renderer, rng: np.random.Generator, spp: int) -> tuple[np.ndarray, int, float] | None:
    """Render a reference, `spp` samples a pixel at a time.

    Returns:
        The image (H, W, 3), its spp and its estimated sRGB PSNR; None if it stays too noisy.
    """
    halves, done = np.zeros((2, views.SIZE, views.SIZE, 3)), 0
    while True:
        for half in range(2):
            layers = renderer.render(views.SIZE, spp // 2, int(rng.integers(2**31)))
            halves[half] += spp / 2 * _color(layers)
        done += spp
        psnr = quality.psnr_of_mean(*halves * (2 / done))
        if psnr > _GOOD_REFERENCE or done >= _STEPS * spp:
            return (halves.sum(0) / done, done, psnr) if psnr > _WORST_REFERENCE else None


def render_view(
    renderer: Renderer, stage: scenes.Stage, camera: dict[str, object], seed: int, view: int, ref_spp: int
) -> dict[str, np.ndarray] | None:
    """Render all arrays of one view, see :mod:`research.datagen.views`; None if the reference stays too noisy."""
    rng = np.random.default_rng([seed, view, 7])

    def some_seed() -> int:
        return int(rng.integers(2**31))

    renderer.layers(False)

    def lrhs(scale: int, spp: int) -> np.ndarray:
        return _color(renderer.render(views.SIZE // scale, scale**2 * spp, some_seed()))

    lr = {scale: np.stack([lrhs(scale, spp) for spp in views.LR_SPP]) for scale in SCALES}
    # The noise of the LR passes tells whether the reference can become clean enough.
    passes = lr[SCALES[0]]
    first = np.average(passes[:-1], axis=0, weights=views.LR_SPP[:-1])
    samples = SCALES[0] ** 2 * sum(views.LR_SPP)
    if quality.psnr_of_mean(first, passes[-1]) + 10 * np.log10(_STEPS * ref_spp / samples) < _WORST_REFERENCE:
        return None
    reference = _reference(renderer, rng, ref_spp)
    if reference is None:
        return None
    ref, spent, psnr = reference
    renderer.layers(True)
    hr = np.stack([features(renderer.render(views.SIZE, 1, some_seed())) for _ in range(views.HR_PASSES)])
    meta = {
        "seed": f"cycles-{seed}", "view": view, "split": views.split_of(seed), "generator": scenes.VERSION,
        "kind": stage.kind, "renderer": f"Blender {bpy.app.version_string} Cycles", **renderer.settings,
        "filter": "blackman-harris", "lr_filter": "blackman-harris", "ref_spp": spent, "ref_psnr": psnr,
        "camera": camera,
    }  # fmt: skip
    return views.pack(hr, lr, ref, rng, meta)


def render_scene(out: Path, seed: int, count: int, ref_spp: int, threads: int) -> tuple[int, str]:
    """Render the missing ones of a scene's first `count` views; return how many were written and the kind of scene."""
    missing = views.missing(out, "cycles", seed, count)
    if not missing:
        return 0, "done before"
    stage = scenes.build(seed)
    shared = Path("/dev/shm")  # a RAM disk, on Linux
    with tempfile.TemporaryDirectory(prefix="cycles-views-", dir=shared if shared.is_dir() else None) as scratch:
        renderer = Renderer(Path(scratch), stage, threads)

        def renders(view: int) -> Iterator[dict[str, np.ndarray] | None]:
            for camera in find_cameras(renderer, stage, seed, view):
                yield render_view(renderer, stage, camera, seed, view, ref_spp)

        return views.write(missing, renders), stage.kind
