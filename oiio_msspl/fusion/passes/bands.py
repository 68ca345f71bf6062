# SPDX-License-Identifier: Apache-2.0
"""Reads a frame in bands of rows, each with all that its layers are estimated from."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.additive_sets import AdditiveLayer, AdditiveSet
from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.aovs.mapped_render import MappedRender, ReadableRender
from oiio_msspl.exr.render import Render, Window
from oiio_msspl.fusion.passes.layers import Factor, is_black
from oiio_msspl.fusion.passes.lines import STEPS, BeautyFit, downsampled, smoothed
from oiio_msspl.fusion.passes.plan import PassJob
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.fusion.tiles.features import RepairCounts, in_hrls_pixels, mirrored, read_features, read_lrhs
from oiio_msspl.fusion.tiles.network import FusedPixels
from oiio_msspl.image.arrays import Array, planes_of
from oiio_msspl.image.filters import box_downsample, max_around

#: HRLS rows that are fused at a time.
BAND_ROWS = 128
#: Pixels that differ by this much have 1/e of the weight in an average: albedo, normal, logarithm of the fused beauty.
SPREAD = {ALBEDO: 0.2, NORMAL: 0.4, RGB: 0.5}
#: Light below this share of the frame's median counts as equal.
DARK = 0.3
#: Light of an LRHS pixel, relative to the fused beauty there, above which its layers are dimmed by one factor.
FIREFLY = 4.0


@dataclass(frozen=True)
class PassInputs:
    """A fused pair, and the sets of layers that are to be fused."""

    lr: MappedRender
    """The LRHS. Layers that it lacks are fused from the HRLS alone."""
    hr: MappedRender
    """The HRLS."""
    beauty: FusedPixels
    """The fused beauty, and the HRLS's albedo and normal without noise, if there are some."""
    sets: Sequence[AdditiveSet]
    """Of the HRLS's ``additive_sets``. Those that do not sum to its beauty are refused."""
    averaged: tuple[Render, Render] | None = None
    """LRHS and HRLS with the features of :func:`oiio_msspl.fusion.passes.layers.pass_features`, averaged with those of
    other frames; None to read the files."""
    decoded: tuple[ReadableRender, ReadableRender] | None = None
    """LRHS and HRLS as the beauty was fused from them. If their light is in memory, it is not decoded again."""

    @property
    def alignment(self) -> Alignment:
        """How the pair lies over each other."""
        return self.beauty.alignment


@dataclass(frozen=True, kw_only=True)
class PassSources(PassInputs):
    """A fused pair whose layers can be read."""

    low: ReadableRender
    high: ReadableRender
    """LRHS and HRLS, with the features of :class:`oiio_msspl.fusion.passes.layers.LayerLight`."""
    colours: Mapping[Factor, str]
    """Names, as features of the HRLS, of the colours by which layers are multiplied."""

    @cached_property
    def dark(self) -> float:
        """Light that counts as equal to none in logarithms."""
        some = self.beauty.rgb[::4, ::4]
        lit = some[some > 0]
        return DARK * float(np.median(lit)) if lit.size else 1.0

    def planes(self, image: NDArray[Any], area: Window) -> Array:
        """Return an image (height, width, 3) over the HRLS's data window as planes over ``area``, mirrored beyond.

        A frame that is stored as half is fused as half. Variances would be lost in its rounding, so this is float32.
        """
        return planes_of(mirrored(image, self.alignment.hr_data_window, area)).astype(np.float32, copy=False)


def band_windows(alignment: Alignment) -> list[Window]:
    """Return the bands of LRHS rows that are fused one after the other."""
    return list(alignment.grid.bands(BAND_ROWS // alignment.scale))


class Band:
    """Some rows of a frame: the fused beauty, and the layers of both renders at the LRHS's resolution.

    Args:
        core: the LRHS pixels that are fused.
        full_size: layers that a network has fused at full resolution.
    """

    def __init__(
        self, sources: PassSources, core: Window, jobs: Sequence[PassJob], full_size: Collection[AdditiveLayer]
    ) -> None:
        alignment = sources.alignment
        self.sources, self.scale = sources, alignment.scale
        reach = 2 * sum(STEPS[self.scale]) + 2
        self.area = Window(core.x0, core.y0 - reach, core.x1, core.y1 + reach).intersect(alignment.grid)
        """The core and the pixels around that are read, in LRHS pixels."""
        self.rows = core.slices(self.area)[0]
        """The core's rows in the area."""
        self.hrls_core, self._hrls_area = (in_hrls_pixels(window, self.scale) for window in (core, self.area))
        self._hrls_rows = self.hrls_core.slices(self._hrls_area)[0]
        self._beauty = sources.planes(sources.beauty.rgb, self._hrls_area)
        self.beauty = self._beauty[:, self._hrls_rows]
        """The fused beauty (3, h, w) over the core."""
        self.low_beauty = downsampled(self._beauty, self.scale)
        """The fused beauty (3, h, w) over the area, at the LRHS's resolution."""
        self.to_fit = [job for job in jobs if job.remainder or self._has_light(job, full_size)]
        """The sets that have light here that no network has fused at full resolution."""
        factors = {layer.factor for job in jobs for layer in job.estimated}
        colours = {factor: name for factor, name in sources.colours.items() if factor in factors}
        names = {name: layer.name for job in jobs for layer, name in job.names.items()}
        # A file decodes all layers together, so all are read at once.
        needed = [*colours.values(), RGB, *names, *([ALBEDO, NORMAL] if self.to_fit else [])]
        window, counts = alignment.hr_data_window, RepairCounts()
        features = read_features(sources.high, self._hrls_area, window, needed, counts=counts, counted=self.hrls_core)
        broken = ((name, n) for (kind, name), n in counts.items() if kind == "repaired")
        self.repaired = {names[name]: n for name, n in broken if n and name in names}
        """How many values of each layer of the HRLS were NaN or infinite."""
        self.colours: dict[Factor, Array] = {
            factor: planes_of(features.pop(name)[self._hrls_rows]) for factor, name in colours.items()
        }
        """What products of light and colour are divided by, (3, h, w) over the core."""
        images = {name: features.pop(name) for name in (ALBEDO, NORMAL) if name in features}
        # LRHS pixels at the edge of a window or of a lamp show a part of it, and its light would leak over the edge.
        self.ranges = {
            layer: tuple(planes_of(sign * max_around(sign * samples)[self._hrls_rows]) for sign in (-1, 1))
            for job in jobs
            for layer in job.noise_free.intersection(job.estimated)
            for samples in (features[job.names[layer]],)
        }
        """For each layer without noise, the lowest and highest values around each pixel of the core, (3, h, w)."""
        self._low_layers = {name: box_downsample(values, self.scale) for name, values in features.items()}
        lrhs = [name for job in jobs for name in job.lrhs]
        self._lrhs_layers = read_lrhs(sources.low, alignment, self.area, [RGB, *lrhs]) if lrhs else {}
        self._fits: dict[Sequence[int], BeautyFit] = {}
        self._guides = self._compared(images) if self.to_fit else None

    def fit_at(self, steps: tuple[int, ...]) -> BeautyFit:
        """Return the beauty that layers are fitted to, see :data:`oiio_msspl.fusion.passes.lines.STEPS`."""
        if steps not in self._fits:
            assert self._guides is not None
            self._fits[steps] = BeautyFit(self._beauty, self._guides, self.scale, steps, self.rows)
        return self._fits[steps]

    def renders_of(self, job: PassJob) -> list[Array]:
        """Return the layers of the HRLS, and of the LRHS if it has some, see :func:`dimmed`."""
        renders = [self._low_layers, self._lrhs_layers] if job.lrhs else [self._low_layers]
        return [dimmed(job, pixels, self.low_beauty) for pixels in renders]

    def _has_light(self, job: PassJob, full_size: Collection[AdditiveLayer]) -> bool:
        """Return whether an estimated layer, except those at full resolution, has light in the area."""
        # An LRHS of an odd size is up to a pixel away.
        low_area = Window(self.area.x0, self.area.y0 - 1, self.area.x1, self.area.y1 + 1)
        names = [job.names[layer] for layer in job.estimated if layer not in full_size]
        return any(not is_black(self.sources.high, name, self._hrls_area) for name in names) or any(
            not is_black(self.sources.low, name, low_area) for name in names if name in job.lrhs
        )

    def _compared(self, images: Mapping[str, Array]) -> Array:
        """Return planes by which pixels are compared, given albedo and normal (h, w, 3) of the HRLS."""
        log = np.log(np.maximum(self._beauty.mean(axis=0), 0) + self.sources.dark)
        planes = [log[None] / SPREAD[RGB]]
        for name, image in images.items():
            noisy = planes_of(image)
            guide = smoothed(noisy, log)
            if name in self.sources.beauty.clean_aovs:
                clean = self.sources.planes(self.sources.beauty.clean_aovs[name], self._hrls_area)
                # Some renderers write the colour of an emitter as its albedo, and tell lamps apart by that.
                guide = np.where((noisy > 1).any(axis=0), guide, clean)
            planes.append(guide / SPREAD[name])
        return np.concatenate(planes, dtype=np.float32)


def dimmed(job: PassJob, pixels: Mapping[str, Array], beauty: Array) -> Array:
    """Return the layers of one render at low resolution, (layers, 3, h, w), without fireflies.

    Layers that it lacks are black. The rest of its beauty is the last layer, if layers are missing or light is in none.

    Args:
        pixels: features (h, w, 3) of the render.
        beauty: the fused one (3, h, w).
    """
    black = np.zeros_like(beauty)
    layers = np.stack([planes_of(pixels[name]) if name in pixels else black for name in job.names.values()])
    if job.remainder or not pixels.keys() >= set(job.names.values()):
        rest = np.maximum(planes_of(pixels[RGB]) - layers.sum(axis=0), 0)
        layers = np.concatenate([layers, rest[None]])
    light = layers.sum(axis=(0, 1))
    allowed = FIREFLY * max_around(beauty.sum(axis=0))
    layers *= np.minimum(1, allowed / np.maximum(light, 1e-20))
    return layers


def in_both(job: PassJob, count: int) -> NDArray[np.bool_]:
    """Return which of the first ``count`` layers of :func:`dimmed` are in both renders.

    The remainder comes last: both have it if they have all layers.
    """
    shared = [name in job.lrhs for name in job.names.values()]
    return np.array([*shared, all(shared)])[:count]


def estimated_of(job: PassJob, layers: NDArray[Any]) -> NDArray[Any]:
    """Return those layers of :func:`dimmed`, on the first axis, that are to be estimated."""
    derived = [i for i, layer in enumerate(job.layers.layers) if layer in job.derived]
    return np.delete(layers, derived, axis=0) if derived else layers
