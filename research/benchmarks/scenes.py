# SPDX-License-Identifier: Apache-2.0
"""Load the development scenes: pairs of renders with a reference, of scenes that no network was trained on.

Models and defaults are chosen by them, so they are no blind test. A folder holds one of two kinds:

- Renders: a folder for each scene, with ``ref.exr``, ``hr_<n>spp.exr`` and ``lr_x<s>_<n>spp.exr``.
- Views of :mod:`research.datagen.views`: those of the split ``test`` whose reference is clean enough are used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RADIANCE_FEATURES
from oiio_msspl.aovs.mapped_render import ReadableRender
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.exr.render import Render
from oiio_msspl.image.arrays import Array, repair
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.model.encoding import find_exposure
from research.datagen.views import Folder, View, as_float32, mean_lrhs, read_hrls, split_features

#: The references of these scenes are full of fireflies. No mean includes them.
NOISY_REFERENCE = {"veach-bidir"}
#: PSNR in dB that a view's reference must have against the noise-free picture.
MIN_REFERENCE = 30.0


@dataclass(frozen=True)
class Scene:
    """A frame to measure. Renders with different arguments have independent noise."""

    name: str
    """The scene's name. Views of the same scene share it."""
    reference: Array
    """(h, w, 3), linear, exposed for display."""
    hrls: Callable[[int], ReadableRender]
    """The HRLS of a number of spp."""
    lrhs: Callable[[int, int], ReadableRender]
    """The LRHS of a scale s and n: it has n samples for every HRLS pixel, which is ``s^2 n`` spp."""
    has: Callable[[int], bool] = lambda spp: True
    """Whether there is an HRLS of a number of spp."""


def load(folder: Path) -> list[Scene]:
    """Return all scenes of a folder.

    Raises:
        SystemExit: there are none.
    """
    if references := sorted(folder.glob("*/ref.exr")):
        return [_render(reference.parent) for reference in references]
    views = Folder(folder).split("test")
    if clean := [view for view in views if view.meta.get("ref_psnr", 0.0) >= MIN_REFERENCE]:
        return [of_view(view) for view in clean]
    raise SystemExit(f"{folder}: neither scenes with a ref.exr nor views for testing with clean references")


def beauty(source: ReadableRender) -> Array:
    """Return the beauty (h, w, 3) of a whole render, without NaN, Inf and negative values."""
    return repair(source.read(source.data_window, ["rgb"])["rgb"])[0]


def _render(folder: Path) -> Scene:
    def file(name: str) -> ReadableRender:
        return map_render(open_exr(folder / name))

    return Scene(
        name=folder.name,
        reference=beauty(file("ref.exr")),
        hrls=lambda spp: file(f"hr_{spp}spp.exr"),
        lrhs=lambda scale, spp: file(f"lr_x{scale}_{scale**2 * spp}spp.exr"),
        has=lambda spp: (folder / f"hr_{spp}spp.exr").exists(),
    )


def of_view(view: View) -> Scene:
    """Return a rendered view as a scene."""
    reference = as_float32(view.ref)
    exposure = np.float32(find_exposure(reference))
    whole = slice(None)

    def hrls(spp: int) -> ReadableRender:
        passes = read_hrls(view, list(range(spp)), whole, whole).mean(axis=0)
        layers = split_features(passes)
        for name in layers.keys() & set(RADIANCE_FEATURES):
            layers[name] = layers[name] * exposure
        return Render.from_arrays(f"{view.path.name}, {spp} spp", **layers)

    def lrhs(scale: int, spp: int) -> ReadableRender:
        chosen = np.flatnonzero(view.lr_spp == spp)[:1]
        image = mean_lrhs(view, chosen, scale) * exposure
        # The last passes: the HRLS of the same pair has the first ones, so the noise is independent
        features = split_features(read_hrls(view, list(range(len(view.hr)))[-spp:], whole, whole).mean(axis=0))
        layers = {name: box_downsample(features[name], scale) for name in (ALBEDO, NORMAL)}
        return Render.from_arrays(f"{view.path.name}, x{scale}", rgb=image, **layers)

    return Scene(view.scene, reference * exposure, hrls, lrhs)
