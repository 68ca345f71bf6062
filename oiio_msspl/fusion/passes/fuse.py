# SPDX-License-Identifier: Apache-2.0
"""Fuses the layers of an additive set, so that they still sum to the fused beauty.

A layer is estimated in one of two ways:

- It is fitted, around every LRHS pixel, as a line of the fused beauty, which has little noise
  (:mod:`oiio_msspl.fusion.passes.fit`). Pixels count by how much they look alike in albedo and normal. A fit needs
  averages of noisy layers only, so it is fast.
- A network fuses it, as if it were a beauty. That is more accurate, and takes a run of the network for each layer. Both
  renders must have the layer. If there are many light groups, it does so at half of the frame's resolution, and they
  are fitted to the beauty then.

What the layers then lack of the fused beauty is spread over them, by the light of each and by how far the two renders
differ in it. So their sum is the beauty to the last bits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.additive_sets import LIGHT_GROUPS, AdditiveLayer, AdditiveSet
from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.aovs.formula import FeatureFormula
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.exr.reader import Channel
from oiio_msspl.exr.render import ReadableRender, Render, Window
from oiio_msspl.exr.replaced import ReplacedChannels
from oiio_msspl.fusion.passes.fit import STEPS, LineFit, LinesNearby, downsampled, smoothed
from oiio_msspl.fusion.passes.layers import SharesAround, dimmed, in_both, to_be_fitted
from oiio_msspl.fusion.passes.plan import PassJob, plan_passes
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.fusion.tiles.features import RepairCounts, in_hrls_pixels, mirrored, read_features, read_lrhs
from oiio_msspl.fusion.tiles.guards import LAYER_REACH
from oiio_msspl.image.arrays import HALF_MAX, Array, Mask, blank, planes_of, repair, unload
from oiio_msspl.image.filters import blurred, box_downsample, grown, max_3x3, upsample_linear
from oiio_msspl.image.parallel import for_row_blocks, half_of_the_threads, in_parallel, one_ahead

T = TypeVar("T", bound=np.generic)

#: If a network fuses more light groups than this, it does so at half of the frame's resolution. That takes a quarter of
#: the time. Each lamp lights the same surfaces, so the beauty has their detail. Components have detail of their own.
MOST_AT_FULL_SIZE = 5
#: What is fitted then has little noise, so fewer pixels are averaged, see :data:`oiio_msspl.fusion.passes.fit.STEPS`.
HALF, HALF_STEPS = 2, (1,)
#: HRLS rows that are fused at a time.
BAND_ROWS = 128
#: Pixels that differ by this much have 1/e of the weight in an average: albedo, normal, logarithm of the fused beauty.
SPREAD = {ALBEDO: 0.2, NORMAL: 0.4, RGB: 0.5}
#: Light below this share of the frame's median counts as equal.
DARK = 0.3
#: A layer has no sample where its brightest pixel around is below this share of its mean over pixels that look alike.
NO_SAMPLE = 0.25
#: A render whose logarithm of light differs by this much from that of the fused beauty has 1/e of the weight.
LIGHT_SPREAD = 1.0
#: The least doubt of a layer, relative to the largest. Without it, a layer gains up to 0.01 dB more, but one that has
#: hardly any noise by chance would push a large error into others.
LEAST_DOUBT = np.float32(0.25)
#: What is spread by doubt adds at most this share to the sum of the layers, and takes at most this share of a layer's
#: light, so none becomes black where the sum is far off.
MOST_SPREAD = np.float32(0.9)
#: What is still lacking then is spread by the square of the doubt, at least this. It is the light of a rare lamp that
#: the layers of few samples miss, and not of a sky behind it, which they know.
LEAST_SQUARED_DOUBT = np.float32(1e-3)
#: A colour below this can't carry light: a product of light and colour is written as product / colour.
DARKEST_COLOUR = 1e-3
#: What known layers leave of the beauty counts as rounding below this share of it.
ROUNDING = np.float32(5e-7)
#: Channels of a colour that light is multiplied by.
Factor = tuple[Channel, ...]
NO_COLOURS: Mapping[Factor, str] = {}
#: Albedo and normal without noise, of half or float.
Guides = Mapping[str, NDArray[Any]]
NO_GUIDES: Guides = {}
#: Fuses layers, given both renders with a layer in place of the beauty, for each layer, and the alignment of these
#: pairs: (height, width, 3) over the HRLS's data window. It takes the next pair in the background.
LayerFuser = Callable[[Iterable[tuple[Render, Render]], Alignment], Iterator[Array]]
#: Larger values of fitted layers are clipped before they are scaled to the sum, which would overflow.
BRIGHTEST = np.float32(1e30)


@dataclass
class FusedPasses:
    """The fused layers of all sets."""

    sets: list[AdditiveSet]
    """The sets that were fused."""
    pixels: ReplacedChannels
    """Their new pixels, over the HRLS's data window."""
    refused: dict[str, str] = field(default_factory=dict)
    """Why other sets were not fused, by name."""
    hrls_alone: dict[str, str] = field(default_factory=dict)
    """By name of a fused set: the layers that were read from the HRLS alone, see :attr:`PassJob.hrls_alone`."""
    lacking: dict[str, float] = field(default_factory=dict)
    """By name of a fused set: the share of the beauty's light that is in no layer, for those that lack some."""
    warnings: list[str] = field(default_factory=list)
    """A sentence for each set of which the LRHS has some layers only, or layers that do not sum to its beauty, or of
    which values were too bright for half."""


def fuse_passes(
    lr: MappedRender,
    hr: MappedRender,
    rgb: Array,
    alignment: Alignment,
    sets: Sequence[AdditiveSet],
    cache_bytes: int = 0,
    pixels: ReplacedChannels | None = None,
    guides: Guides = NO_GUIDES,
    fuse_layers: LayerFuser | None = None,
    averaged: tuple[Render, Render] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> FusedPasses:
    """Fuse the layers of additive sets of the HRLS.

    Args:
        lr, hr: the pair. Layers that the LRHS lacks are fused from the HRLS alone.
        rgb: the fused beauty, (height, width, 3), over the HRLS's data window.
        alignment: of the pair.
        sets: of ``hr.additive_sets``. Those that do not sum to its beauty are refused.
        cache_bytes: memory for decoded rows that two bands need.
        pixels: where the fused layers go; None for a new store.
        guides: albedo and normal without noise, (height, width, 3) as the HRLS's own, as far as they are known. Albedos
            above 1 are taken from the HRLS.
        fuse_layers: the network that fuses single layers. Layers that it can't fuse are fitted, and all without one.
        averaged: LRHS and HRLS with the features of :func:`pass_features`, averaged with those of other frames; None to
            read the files.
        progress: called with (steps done, :func:`pass_steps`).

    Raises:
        InputError: pixels can't be decoded.
    """
    jobs, refused, warnings = plan_passes(lr, hr, sets)
    window = alignment.hr_data_window
    pixels = ReplacedChannels() if pixels is None else pixels
    pixels.add([channel for job in jobs for channel in job.channels], window.width, window.height)
    in_order = sorted(jobs, key=lambda job: sets.index(job.layers))
    fused_sets = [replace(job.layers, coarser=tuple(job.coarser)) for job in in_order]
    hrls_alone = {job.layers.name: job.hrls_alone for job in in_order if job.hrls_alone}
    lacking = {job.layers.name: job.lacking for job in in_order if job.remainder}
    fused = FusedPasses(fused_sets, pixels, refused, hrls_alone, lacking, warnings)
    later = {part for job in jobs for parts in job.known.values() for part in parts}
    tell = progress or (lambda done, count: None)
    by_network = fuse_layers is not None and any(job.lrhs for job in jobs)
    steps = pass_steps(alignment, sets, by_network=fuse_layers is not None)
    done = steps - len(_bands(alignment)) * sum(1 + by_network * len(job.fitted) for job in jobs)
    tell(done, steps)
    fused_light: dict[AdditiveLayer, Array] = {}
    half_light: dict[AdditiveLayer, Array] = {}
    clipped = dict.fromkeys((job.layers.name for job in jobs), 0)
    broken: dict[str, int] = {}
    colours = _colour_names(jobs)
    low_layers = {key: each for job in jobs for key, each in job.lrhs.items()}
    high_layers = {key: layer for job in jobs for layer, key in job.keys.items()}
    low: MappedRender | Render = _with_layers_of(lr, low_layers)
    high: MappedRender | Render = _with_layers_of(hr, high_layers, colours)
    if averaged is not None:
        usable = {RGB, ALBEDO, NORMAL, *low_layers}
        low = replace(averaged[0], layers={name: v for name, v in averaged[0].layers.items() if name in usable})
        high = averaged[1]
        if colours:
            # Light is divided by the colours of this frame, because those are written.
            of_colours, _ = _decoded(_with_layers_of(replace(hr, features={}), {}, colours))
            high = replace(high, layers=high.layers | of_colours.layers)
    if fuse_layers is not None and by_network:
        (low, low_lit), (high, high_lit) = in_parallel(partial(_decoded, low), partial(_decoded, high))
        for job in jobs:
            many = job.layers.name == LIGHT_GROUPS and len(job.lit(low_lit & high_lit)) > MOST_AT_FULL_SIZE
            pairs = _HalfPairs(low, high, alignment) if many else _Pairs(low, high, alignment)
            for layer, light in _fused_layers(pairs, job, low_lit, high_lit, fuse_layers):
                if light is not None:
                    (fused_light if light.shape == rgb.shape else half_light)[layer] = light
                done += len(_bands(alignment))
                tell(done, steps)
    lit = rgb[::4, ::4][rgb[::4, ::4] > 0]
    dark = DARK * float(np.median(lit)) if lit.size else 1.0
    shares = SharesAround(low, high, rgb, alignment)
    with hr.cache_strips(cache_bytes // 2), lr.cache_strips(cache_bytes // 2):

        def prepare(core: Window) -> _Band:
            with half_of_the_threads():
                lights = fused_light, half_light
                return _Band(low, high, colours, rgb, alignment, core, dark, jobs, guides, *lights, shares)

        # The next band is read and compared while the layers of this one are fitted.
        for band in one_ahead(map(prepare, _bands(alignment))) if jobs else []:
            lights: dict[AdditiveLayer, Array] = {}
            for job in jobs:
                with half_of_the_threads():
                    made, too_bright = band.fuse(job, pixels, lights)
                clipped[job.layers.name] += too_bright
                # Copies, because a layer alone would keep the memory of its whole set.
                lights |= {layer: made[layer].copy() for layer in made.keys() & later}
                done += 1
                tell(done, steps)
            for name, count in band.broken.items():
                broken[name] = broken.get(name, 0) + count
            for image in (*fused_light.values(), *half_light.values(), *guides.values()):
                unload(image)
            for render in (low, high):
                render.unload()
    fused.warnings += [
        f"{name}: {count} values are too bright for half and were clipped to {HALF_MAX:.0f}, so the layers do not sum "
        "to the beauty there; render them as float"
        for name, count in clipped.items()
        if count
    ]
    fused.warnings += [
        f"{name}: {count} values of the HRLS are NaN or infinite; they were repaired" for name, count in broken.items()
    ]
    return fused


def pass_steps(alignment: Alignment, sets: Sequence[AdditiveSet], *, by_network: bool) -> int:
    """The steps in which sets are fused, for progress: each set in each band of rows. A layer that a network fuses
    counts as much as a set."""
    layers = sum(len(each.layers) for each in sets) if by_network else 0
    return len(_bands(alignment)) * (len(sets) + layers)


def _bands(alignment: Alignment) -> list[Window]:
    """The bands of LRHS rows that are fused one after the other."""
    grid, rows = alignment.grid, BAND_ROWS // alignment.scale
    return [Window(grid.x0, top, grid.x1, min(top + rows, grid.y1)) for top in range(grid.y0, grid.y1, rows)]


def _colour_names(jobs: Iterable[PassJob]) -> dict[Factor, str]:
    """Names, as features, of the colours by which layers that are fitted are multiplied."""
    factors = dict.fromkeys(each.factor for job in jobs for each in job.fitted if each.factor is not None)
    return {factor: f"colour {i}" for i, factor in enumerate(factors)}


def _with_layers_of(
    render: MappedRender, layers: Mapping[str, AdditiveLayer], colours: Mapping[Factor, str] = NO_COLOURS
) -> MappedRender:
    """A render whose features are the beauty, albedo and normal, the light of some layers, and some colours."""
    formulas = {name: render.features[name] for name in (RGB, ALBEDO, NORMAL) if name in render.features}
    formulas |= {name: layer.formula for name, layer in layers.items()}
    formulas |= {name: FeatureFormula((factor,)) for factor, name in colours.items()}
    return replace(render, features=formulas, alpha=None)


class _Pairs:
    """Both renders with one layer each in place of the beauty.

    Args:
        low, high: both renders with all layers, see :func:`_decoded`.
        alignment: of the pair.
    """

    def __init__(self, low: Render, high: Render, alignment: Alignment) -> None:
        self.low, self.high, self.alignment = low, high, alignment

    def pair(self, layer: str) -> tuple[Render, Render]:
        """Both renders with a layer."""
        return _as_beauty(self.low, layer), _as_beauty(self.high, layer)


class _HalfPairs(_Pairs):
    """The same with the HRLS averaged over 2 x 2 pixels, over the whole grid."""

    def __init__(self, low: Render, high: Render, alignment: Alignment) -> None:
        scale = alignment.scale // HALF
        window = in_hrls_pixels(alignment.grid, scale)
        super().__init__(low, high, replace(alignment, scale=scale, hr_data_window=window))
        self._data_window = alignment.hr_data_window
        self._guides = {name: self._half_of(name) for name in (ALBEDO, NORMAL) if name in high.layers}

    def pair(self, layer: str) -> tuple[Render, Render]:
        window = self.alignment.hr_data_window
        frame = Window(0, 0, window.x1, window.y1)
        half = Render({RGB: self._half_of(layer), **self._guides}, window, frame, name=self.high.name)
        return _as_beauty(self.low, layer), half

    def _half_of(self, layer: str) -> Array:
        image, window = self.high.layers[layer], self.alignment.hr_data_window
        result: Array = blank((window.height, window.width, image.shape[-1]))
        for top in range(window.y0, window.y1, BAND_ROWS):
            part = Window(window.x0, top, window.x1, min(top + BAND_ROWS, window.y1))
            full = mirrored(image, self._data_window, in_hrls_pixels(part, HALF))
            result[part.slices(window)] = box_downsample(full, HALF)
        unload(image)
        unload(result)
        return result


def _fused_layers(
    pairs: _Pairs, job: PassJob, low_lit: set[str], high_lit: set[str], fuse_layers: LayerFuser
) -> Iterator[tuple[AdditiveLayer, Array | None]]:
    """Each layer of a set that is to be fitted, and its light as a network fuses it; None if that can't be done.

    The light of a black layer has the full size.

    Args:
        pairs: of the layers.
        low_lit, high_lit: names of features of both renders that are not black.
    """
    low, high = pairs.low, pairs.high
    lit = job.lit(low_lit & high_lit)
    fused = fuse_layers((pairs.pair(key) for key in lit.values()), pairs.alignment)
    for layer in job.fitted:
        key = job.keys[layer]
        if layer in lit:
            light = next(fused)
            if layer in job.noise_free and light.shape == high.layers[key].shape:
                _keep_in_range(light, high.layers[key])
                unload(high.layers[key])
            unload(light)
            yield layer, light
        else:
            black = key in low.layers and key not in low_lit | high_lit
            yield layer, np.zeros_like(high.layers[key]) if black else None


def _decoded(render: MappedRender | Render) -> tuple[Render, set[str]]:
    """The features of a render, which wait in temporary files if they have many pixels; and the names of those that
    are not black. A file is decoded once, because it has all layers together."""
    if isinstance(render, Render):
        lit = set()
        for name, values in render.layers.items():
            if any(values[y : y + BAND_ROWS].any() for y in range(0, len(values), BAND_ROWS)):
                lit.add(name)
            unload(values)
        return render, lit
    window = render.data_window
    pixels: dict[str, Array] = {}
    lit = set()
    tops = range(window.y0, window.y1, BAND_ROWS)
    parts = [Window(window.x0, y, window.x1, min(y + BAND_ROWS, window.y1)) for y in tops]
    for part, features in zip(parts, one_ahead(render.read(part, render.features) for part in parts), strict=True):
        for name, rows in features.items():
            if name not in pixels:
                pixels[name] = blank((window.height, window.width, rows.shape[-1]))
            pixels[name][part.slices(window)] = rows
            unload(pixels[name])
            if name not in lit and rows.any():
                lit.add(name)
    return Render(pixels, window, render.display_window, render.pixel_aspect, name=render.name), lit


def _as_beauty(render: Render, layer: str) -> Render:
    """A render of :func:`_decoded` with a layer in place of the beauty."""
    guides = {name: render.layers[name] for name in (ALBEDO, NORMAL) if name in render.layers}
    return replace(render, layers={RGB: render.layers[layer], **guides})


def _keep_in_range(light: Array, samples: Array) -> None:
    """Bound each pixel of a layer without noise by the 3 x 3 pixels of the HRLS around. Both are (height, width, 3).

    The LRHS's pixels at the edge of a window or of a lamp show a part of it, and its light would leak over the edge.
    """

    def work(rows: slice) -> None:
        around = slice(max(rows.start - 1, 0), rows.stop + 1)
        lowest, highest = _range_around(repair(samples[around])[0])
        inside = slice(rows.start - around.start, rows.stop - around.start)
        np.clip(light[rows], lowest[inside], highest[inside], out=light[rows])

    for_row_blocks(work, len(light), light[0].size)


def _range_around(samples: Array) -> tuple[Array, Array]:
    """The lowest and highest values of 3 x 3 pixels, (h, w, 3)."""
    return -max_3x3(-samples), max_3x3(samples)


class _Band:
    """Some rows of the frame, with what their layers are fitted to."""

    def __init__(
        self,
        low: ReadableRender,
        high: ReadableRender,
        colours: Mapping[Factor, str],
        rgb: Array,
        alignment: Alignment,
        core: Window,
        dark: float,
        jobs: Sequence[PassJob],
        guides: Guides,
        fused_light: Mapping[AdditiveLayer, Array],
        half_light: Mapping[AdditiveLayer, Array],
        shares: SharesAround,
    ) -> None:
        """
        Args:
            low, high: both renders with all layers, see :func:`_with_layers_of`.
            colours: see :func:`_colour_names`.
            dark: light that counts as equal to none in logarithms.
            guides: see :func:`fuse_passes`.
            fused_light: light (height, width, 3) of the layers that a network has fused, over the HRLS's data window.
            half_light: the same at half of the resolution, over the whole grid.
            shares: of the layers, where none has a sample near.
        """
        self._fused_light, self._half_light, self._shares = fused_light, half_light, shares
        self._alignment, self._core, self._scale, self._dark = alignment, core, alignment.scale, dark
        reach = 2 * sum(STEPS[self._scale]) + 2
        area = Window(core.x0, core.y0 - reach, core.x1, core.y1 + reach)
        self._area = area.intersect(alignment.grid)
        self._core_rows = slice(core.y0 - self._area.y0, core.y1 - self._area.y0)
        self._hrls_area = in_hrls_pixels(self._area, alignment.scale)
        self._hrls_rows = in_hrls_pixels(core, alignment.scale).slices(self._hrls_area)[0]
        window = alignment.hr_data_window
        # A frame that is stored as half is fused as half. Variances would be lost in its rounding.
        self._beauty = planes_of(mirrored(rgb, window, self._hrls_area)).astype(np.float32)
        self._low_beauty = downsampled(self._beauty, self._scale)
        self._to_fit = [job for job in jobs if job.remainder or self._has_light_to_fit(job, low, high)]
        read = self._read(low, high, colours, [job for job in jobs if job.lrhs or job in self._to_fit])
        if self._to_fit:
            self._prepare_fit(read, guides)

    def _has_light_to_fit(self, job: PassJob, low: ReadableRender, high: ReadableRender) -> bool:
        """Whether the band has light of a layer that no network has fused."""
        keys = [job.keys[layer] for layer in job.fitted if layer not in self._fused_light]
        area = self._area
        # An LRHS of an odd size is up to a pixel away.
        low_area = Window(area.x0, area.y0 - 1, area.x1, area.y1 + 1)
        both = (high, self._hrls_area), (low, low_area)
        return not all(_is_black(render, key, window) for key in keys for render, window in both)

    def _prepare_fit(self, read: Mapping[str, Array], guides: Guides) -> None:
        """Compare pixels by the albedo and normal that are ``read`` from the HRLS, or by the ``guides``."""
        log = np.log(np.maximum(self._beauty.mean(axis=0), 0) + self._dark)
        planes = [log[None] / SPREAD[RGB]]
        for name, image in read.items():
            noisy = planes_of(image)
            guide = smoothed(noisy, log)
            if name in guides:
                clean = planes_of(mirrored(guides[name], self._alignment.hr_data_window, self._hrls_area))
                # Some renderers write the colour of an emitter as its albedo, and tell lamps apart by that.
                guide = np.where((noisy > 1).any(axis=0), guide, clean)
            planes.append(guide / SPREAD[name])
        self._guides = np.concatenate(planes, dtype=np.float32)
        self._fits: dict[tuple[int, ...], _Fit] = {}

    def _fit_at(self, scale: int, steps: Sequence[int]) -> _Fit:
        """What layers with 1/scale of the frame's resolution are fitted to."""
        if (scale, *steps) not in self._fits:
            rows = slice(self._hrls_rows.start // scale, self._hrls_rows.stop // scale)
            self._fits[scale, *steps] = _Fit(self._beauty, self._guides, scale, steps, rows)
        return self._fits[scale, *steps]

    def _read(
        self, low: ReadableRender, high: ReadableRender, colours: Mapping[Factor, str], jobs: Sequence[PassJob]
    ) -> dict[str, Array]:
        """Read all that the band needs, at once, because a file decodes all layers together.

        The light of the layers of ``jobs`` stays at low resolution, and the colours of products over the core.

        Returns:
            Albedo and normal (height, width, 3), as far as the HRLS has them and a layer is fitted.
        """
        needed = list(colours.values())
        if jobs:
            needed += [RGB, *(key for job in jobs for key in job.keys.values())]
        if self._to_fit:
            needed += [ALBEDO, NORMAL]
        features: dict[str, Array] = {}
        counts = RepairCounts()
        if needed:
            core = in_hrls_pixels(self._core, self._scale)
            window = self._alignment.hr_data_window
            features = read_features(high, self._hrls_area, window, needed, counts=counts, counted=core)
        self._colours = {factor: planes_of(features.pop(name)[self._hrls_rows]) for factor, name in colours.items()}
        guides = {name: features.pop(name) for name in (ALBEDO, NORMAL) if name in features}
        #: For each layer without noise that is fitted, the range of the HRLS around each pixel of the core.
        self._ranges: dict[AdditiveLayer, list[Array]] = {}
        for job in self._to_fit:
            for layer in job.fitted:
                if layer in job.noise_free and layer not in self._fused_light:
                    both = _range_around(features[job.keys[layer]])
                    self._ranges[layer] = [planes_of(values[self._hrls_rows]) for values in both]
        self._low_layers = {name: box_downsample(values, self._scale) for name, values in features.items()}
        theirs = [key for job in jobs for key in job.lrhs]
        self._lrhs_layers = {}
        if theirs:
            self._lrhs_layers = read_lrhs(low, self._alignment, self._area, [RGB, *theirs], RepairCounts())
        #: How many values of each layer of the HRLS were NaN or infinite.
        keys = {key: layer for job in jobs for layer, key in job.keys.items()}
        self.broken = {keys[key].name: count for key, count in counts.repaired.items() if key in keys}
        return guides

    def fuse(
        self,
        job: PassJob,
        pixels: ReplacedChannels,
        earlier: Mapping[AdditiveLayer, Array],
    ) -> tuple[dict[AdditiveLayer, Array], int]:
        """Fuse the layers of one set and store them.

        Args:
            job: the set, one of those that the band was made for.
            pixels: gets the rows of the band.
            earlier: light (3, h, w) of layers of earlier sets.

        Returns:
            The light of each layer, and the number of values that were too bright for half.
        """
        rows = self._hrls_rows
        lights = {layer: _total(earlier, parts) for layer, parts in job.known.items()}
        colours = {layer: self._colours[layer.factor] for layer in job.fitted if layer.factor is not None}
        if job.fitted:
            rest = self._beauty[:, rows]
            if lights:
                rest = rest - _total(lights, lights)
                rest[rest < ROUNDING * self._beauty[:, rows]] = 0
            lights |= self._fitted(job, rest, colours)
        lights |= {layer: _total(lights, parts) for layer, parts in job.coarser.items()}
        window = self._alignment.hr_data_window
        core = in_hrls_pixels(self._core, self._scale)
        inside = core.intersect(window)
        clipped = 0
        for layer, light in lights.items():
            if layer in earlier:
                continue  # an earlier set has stored it
            if layer in colours:
                light = np.divide(light, np.maximum(colours[layer], DARKEST_COLOUR), dtype=np.float32)
            for channel, plane in zip(layer.channels, light, strict=True):
                clipped += pixels.put(channel, inside.y0 - window.y0, plane[inside.slices(core)])
        return lights, clipped

    def _fitted(self, job: PassJob, light: Array, colours: Mapping[AdditiveLayer, Array]) -> dict[AdditiveLayer, Array]:
        """Divide ``light`` (3, h, w) among the layers of a set that earlier sets do not know."""
        layers = job.fitted
        fitted = np.zeros((len(layers) + job.remainder, *light.shape), np.float32)
        for planes, layer in zip(fitted, layers, strict=False):
            if layer in self._fused_light:
                planes[:] = self._over_core(self._fused_light[layer])
        renders = self._renders_of(job)
        doubts = self._doubts(job, *renders) if job.lrhs else None
        if job in self._to_fit:
            by_network = self._fused_light.keys() | self._half_light
            missing = [i for i in range(len(fitted)) if i >= len(layers) or layers[i] not in by_network]
            noisy = self._average(job, *renders)
            if missing := [i for i in missing if noisy[i].any()]:
                fit = self._fit_at(self._scale, STEPS[self._scale])
                fit.fit_layers([noisy[i] for i in missing], [fitted[i] for i in missing], few_samples=True)
            if halves := [i for i, layer in enumerate(layers) if layer in self._half_light]:
                low = [self._half_over_area(layers[i]) for i in halves]
                self._fit_at(HALF, HALF_STEPS).fit_layers(low, [fitted[i] for i in halves])
                rows = slice(self._hrls_rows.start // HALF, self._hrls_rows.stop // HALF)
                for i, means in zip(halves, low, strict=True):
                    _draw_towards(fitted[i], means[:, rows])
        for planes, layer in zip(fitted, layers, strict=False):
            if layer in self._ranges:
                np.clip(planes, *self._ranges[layer], out=planes)
        # The squares of light beyond 1e19 overflow, so there is no fit there.
        fitted[:, ~np.isfinite(fitted).all(axis=0)] = 0
        np.clip(fitted, 0, BRIGHTEST, out=fitted)
        # Where no layer is left, the beauty is divided as it is around.
        dark = (fitted.sum(axis=0) == 0) & (light > 0)
        if dark.any():
            fitted[:, dark] = self._shares_at(job, dark)
        if colours:
            self._respect_black_colours(job, fitted, light, colours)
        _make_sum(fitted, light, doubts)
        return dict(zip(layers, fitted, strict=False))

    def _respect_black_colours(
        self, job: PassJob, fitted: Array, light: Array, colours: Mapping[AdditiveLayer, Array]
    ) -> None:
        """Take the light that can't be stored, because its colour is black, from the layers of a set (layers, 3, h, w).
        Where none is left of ``light`` (3, h, w), the layers without colour get it."""
        for planes, layer in zip(fitted, job.fitted, strict=False):
            if layer in colours:
                planes *= colours[layer] >= DARKEST_COLOUR
        lost = (fitted.sum(axis=0) == 0) & (light > 0)
        free = [i for i, layer in enumerate(job.fitted) if layer not in colours]
        if free and lost.any():
            shares = self._shares_at(job, lost)[free]
            shares[:, shares.sum(axis=0) == 0] = 1
            for i, share in zip(free, shares, strict=True):
                fitted[i][lost] = share

    def _shares_at(self, job: PassJob, where: Mask) -> Array:
        """The shares that layers have around some values of the core (3, h, w), (layers, values)."""
        _, y, x = np.nonzero(where)
        core = in_hrls_pixels(self._core, self._scale)
        return self._shares.at(job, x + core.x0, y + core.y0)

    def _over_core(self, image: Array) -> Array:
        """An image (height, width, 3) over the HRLS's data window, mirrored beyond it, as planes over the core."""
        core = in_hrls_pixels(self._core, self._scale)
        return planes_of(mirrored(image, self._alignment.hr_data_window, core))

    def _half_over_area(self, layer: AdditiveLayer) -> Array:
        """A layer at half of the resolution, as planes over the area."""
        half = self._scale // HALF
        area, grid = (in_hrls_pixels(window, half) for window in (self._area, self._alignment.grid))
        return planes_of(self._half_light[layer][area.slices(grid)])

    def _renders_of(self, job: PassJob) -> list[Array]:
        """The layers of the HRLS, and of the LRHS if it has some, see :func:`dimmed`. Empty if they were not read."""
        renders = [dimmed(job, self._low_layers, self._low_beauty)] if job.lrhs or job in self._to_fit else []
        return [*renders, dimmed(job, self._lrhs_layers, self._low_beauty)] if job.lrhs else renders

    def _doubts(self, job: PassJob, hrls: Array, lrhs: Array) -> Array:
        """How uncertain each layer is, (layers, h, w) over the core, at most 1: the root of the mean difference between
        the two renders, relative to the layer where that is largest. A layer that the LRHS lacks is most uncertain."""
        both = in_both(job, len(hrls))
        differences = np.abs(hrls - lrhs[: len(hrls)]).mean(axis=1)
        differences[~both] = 0
        doubts = np.sqrt([blurred(plane) for plane in to_be_fitted(job, differences)])
        most = doubts.max(axis=0)
        doubts = np.divide(doubts, most, out=np.ones_like(doubts), where=(most > 0) & np.isfinite(most))
        doubts[~to_be_fitted(job, both)] = 1
        return np.stack([upsample_linear(plane, self._scale, self._core_rows) for plane in doubts])

    def _average(self, job: PassJob, hrls: Array, lrhs: Array | None = None) -> Array:
        """The mean of both renders' layers (layers, 3, h, w), of those that are fitted. It may be written over
        ``hrls``."""
        if lrhs is not None:
            weight = self._likeness(lrhs)
            for i in np.flatnonzero(in_both(job, len(hrls))):
                hrls[i] += weight * lrhs[i]
                hrls[i] /= 1 + weight
        return to_be_fitted(job, hrls)

    def _likeness(self, layers: Array) -> Array:
        """The weight (h, w) of the LRHS's layers (layers, 3, h, w): 1 where the fused beauty has as much light.

        The pixel filter of the LRHS is wider. Small lights and highlights lose light to the pixels around them, and so
        do their layers.
        """
        lights = (layers.sum(axis=(0, 1), dtype=np.float64), self._low_beauty.sum(axis=0, dtype=np.float64))
        ours, fused = (np.log(light + 3 * self._dark) for light in lights)
        return np.exp(-np.square((ours - fused) / LIGHT_SPREAD)).astype(np.float32)


def _draw_towards(image: Array, means: Array) -> None:
    """Change a fitted layer (3, h, w), so that its means over 2 x 2 pixels are half-way to ``means``, the layer as the
    network has fused it: the geometric mean of both.

    A fit can't tell apart two lamps that are equally bright and a few pixels apart, so the light of one would leak into
    the layer of the other. The network can, but its result has more noise than the fit.
    """

    def work(rows: slice) -> None:
        part = image[:, rows]
        half = slice(rows.start // HALF, -(-rows.stop // HALF))
        found = downsampled(part, HALF)
        wanted = means[:, half]
        factors = np.sqrt(wanted / np.maximum(found, np.float32(1e-6) * wanted + np.finfo(np.float32).tiny))
        factors[found <= 0] = 1
        part *= factors.repeat(HALF, axis=1).repeat(HALF, axis=2)

    for_row_blocks(work, image.shape[1], image[:, 0].size, multiple=HALF)


class _Fit:
    """What layers of a band are fitted to, at one resolution.

    Args:
        beauty: the fused one, (3, h, w).
        guides: planes (guides, h, w) in units of their spread.
        scale: layers have 1/scale of this resolution.
        steps: see :data:`oiio_msspl.fusion.passes.fit.STEPS`.
        rows: of the layers, that are wanted.
    """

    def __init__(self, beauty: Array, guides: Array, scale: int, steps: Sequence[int], rows: slice) -> None:
        self._scale = scale
        low = downsampled(guides, scale)
        with np.errstate(over="ignore", invalid="ignore"):
            self._lines = LineFit(downsampled(beauty, scale), low, steps)
        self._nearby = LinesNearby(low, guides, scale, rows)
        self._beauty = self._nearby.phases(beauty[:, rows.start * scale : rows.stop * scale])

    def fit_layers(self, layers: Sequence[Array], results: Sequence[Array], *, few_samples: bool = False) -> None:
        """Fit layers to the fused beauty.

        Args:
            layers: (3, h, w) each, at their own resolution.
            results: get the wanted rows, (3, h, w) each.
            few_samples: the layers are as rendered, so pixels may have no sample of a light by chance.
        """

        def fit(part: slice) -> None:
            # NumPy's settings for errors belong to the thread.
            with np.errstate(over="ignore", invalid="ignore"):
                for layer, out in zip(layers[part], results[part], strict=True):
                    fit_layer(layer, out)

        def fit_layer(layer: Array, out: Array) -> None:
            lines, means = self._lines.lines(layer)
            # The renders around bound the fit: where it mixes two surfaces, it would leave their range.
            lowest, highest = (np.stack([sign * max_3x3(sign * plane) for plane in layer]) for sign in (-1, 1))
            if few_samples:
                # Where a rare light has no sample by chance, the mean over pixels that look alike is the bound. This
                # ends two LRHS pixels before LAYER_REACH, because the bounds are interpolated.
                near_light = grown(np.any(layer != 0, axis=0), LAYER_REACH // self._scale - 2)
                highest = np.where(near_light & (highest < means * np.float32(NO_SAMPLE)), means, highest)
            self._nearby.apply(lines, np.concatenate([lowest, highest]), self._beauty, out)

        for_row_blocks(fit, len(layers), self._beauty.size)


def _is_black(render: ReadableRender, layer: str, area: Window) -> bool:
    """Whether a layer that is in memory has no light in an area, relative to the top left of the display window. One
    in a file would have to be decoded, so it may have some."""
    if not isinstance(render, Render):
        return False
    if layer not in render.layers:
        return True
    shifted = area.shift(render.display_window.x0, render.display_window.y0)
    return not render.read(shifted.intersect(render.data_window), [layer])[layer].any()


def _total(lights: Mapping[AdditiveLayer, Array], layers: Iterable[AdditiveLayer]) -> Array:
    """The light of some layers together."""
    first, *others = layers
    total = lights[first].copy()
    for layer in others:
        total += lights[layer]
    return total


def _make_sum(layers: Array, beauty: Array, doubts: Array | None) -> None:
    """Change layers (n, 3, h, w), none of them negative, so that they sum to the beauty (3, h, w). Where all are
    black, they stay black.

    Args:
        doubts: how uncertain each layer is (n, h, w), from 0 to 1. What is lacking is spread in proportion to light
            times doubt, and the rest of it to light times squared doubt; in proportion to light if this is None.
    """

    tiny = np.finfo(np.float32).tiny

    def work(rows: slice) -> None:
        part, wanted = layers[:, :, rows], beauty[:, rows]
        total = part.sum(axis=0)
        if doubts is not None:
            doubt, most = doubts[:, None, rows], MOST_SPREAD * total
            is_far = bool((wanted - total > most).any())
            lacking = np.clip(wanted - total, -most, most)
            weights = part * np.maximum(doubt, LEAST_DOUBT)
            lacking /= np.maximum(weights.sum(axis=0), tiny)
            weights *= lacking
            part += np.maximum(weights, -MOST_SPREAD * part)
            total = part.sum(axis=0)
            if is_far:
                weights = part * np.maximum(np.square(doubt), LEAST_SQUARED_DOUBT)
                weights /= np.maximum(weights.sum(axis=0), tiny)
                weights *= np.maximum(wanted - total, 0)
                part += weights
                total = part.sum(axis=0)
        # The beauty divided by a tiny total would overflow; a layer's share of the total never does.
        part /= np.where(total > 0, total, 1)
        part *= wanted

    for_row_blocks(work, beauty.shape[1], layers[:, :, 0].size)
