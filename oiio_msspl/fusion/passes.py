# SPDX-License-Identifier: Apache-2.0
"""Fuses the layers of an additive set, so that they still sum to the fused beauty.

A layer is fitted, around every LRHS pixel, as a linear function of what has little noise: the fused beauty,
albedo and normal (first-order regression: Bitterli et al. 2016; the fit at low resolution: fast guided filter, He and
Sun 2015). The function is then applied at full resolution. A fit needs the averages of noisy layers only, so eight
layers cost about as much as the beauty. What the fitted layers lack of the fused beauty is spread over them in
proportion to their light, so their sum is the beauty to the last bits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence, Sized
from dataclasses import dataclass, field, replace

import numpy as np

from oiio_msspl.aovs.additive_sets import AdditiveLayer, AdditiveSet
from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.aovs.formula import FeatureFormula
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.arrays import Array, box_downsample, mean_around, planes_of, upsample_linear
from oiio_msspl.exr.reader import Channel
from oiio_msspl.exr.render import Window
from oiio_msspl.exr.replaced import ReplacedChannels
from oiio_msspl.fusion.alignment import Alignment
from oiio_msspl.fusion.guards import max_3x3
from oiio_msspl.fusion.sums import check_sum, is_sum_of, layer_keys, with_layers
from oiio_msspl.fusion.tile_features import RepairCounts, in_hrls_pixels, mirrored_pixels, read_features, read_lrhs
from oiio_msspl.parallel import for_row_blocks

#: HRLS rows that are fused at a time.
BAND_ROWS = 128
#: A fit spans so many LRHS pixels to each side: at x2 a pixel has fewer samples, so more of them are needed.
RADIUS = {2: 3, 4: 2, 8: 2}
#: The coefficients of fits that overlap are averaged over so many LRHS pixels to each side.
SMOOTHING = 1
#: Keeps a fit from following noise: variance that is added to each guide, relative to its mean square.
RIDGE = 0.03
#: Light of an LRHS pixel, relative to the fused beauty there, above which its layers are dimmed by one factor.
FIREFLY = 8.0
#: A colour below this can't carry light: a product of light and colour is written as product / colour.
DARKEST_COLOUR = 1e-3
#: What known layers leave of the beauty counts as rounding below this share of it.
ROUNDING = np.float32(5e-7)
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


def fuse_passes(
    lr: MappedRender,
    hr: MappedRender,
    rgb: Array,
    alignment: Alignment,
    sets: Sequence[AdditiveSet],
    cache_bytes: int = 0,
    pixels: ReplacedChannels | None = None,
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
        progress: called with (steps done, :func:`pass_steps`).

    Raises:
        InputError: pixels can't be decoded.
    """
    jobs, refused = _checked(lr, hr, sets)
    window = alignment.hr_data_window
    pixels = ReplacedChannels() if pixels is None else pixels
    pixels.add([channel for job in jobs for channel in job.channels], window.width, window.height)
    in_order = sorted(jobs, key=lambda job: sets.index(job.layers))
    fused = FusedPasses([replace(job.layers, coarser=tuple(job.coarser)) for job in in_order], pixels, refused)
    later = {part for job in jobs for parts in job.known.values() for part in parts}
    tell = progress or (lambda done, count: None)
    steps = pass_steps(alignment, sets)
    done = steps - pass_steps(alignment, jobs)
    tell(done, steps)
    with hr.cache_strips(cache_bytes):
        for core in _bands(alignment) if jobs else []:
            band = _Band(hr, rgb, alignment, core)
            lights: dict[AdditiveLayer, Array] = {}
            for job in jobs:
                made = band.fuse(job, lr, hr, pixels, lights)
                # Copies, because a layer alone would keep the memory of its whole set.
                lights |= {layer: made[layer].copy() for layer in made.keys() & later}
                done += 1
                tell(done, steps)
    return fused


def pass_steps(alignment: Alignment, sets: Sized) -> int:
    """The steps in which sets are fused, for progress: each set in each band of rows."""
    return len(_bands(alignment)) * len(sets)


def _bands(alignment: Alignment) -> list[Window]:
    """The bands of LRHS rows that are fused one after the other."""
    grid, rows = alignment.grid, BAND_ROWS // alignment.scale
    return [Window(grid.x0, top, grid.x1, min(top + rows, grid.y1)) for top in range(grid.y0, grid.y1, rows)]


#: Layers, each with the layers that it is the sum of.
_Sums = dict[AdditiveLayer, tuple[AdditiveLayer, ...]]


@dataclass(frozen=True)
class _Job:
    """A set that sums to the beauty."""

    layers: AdditiveSet
    lrhs: AdditiveSet | None
    """The same layers in the LRHS."""
    remainder: bool
    """Some light is in no layer."""
    known: _Sums
    """Layers of this set that are sums of layers of an earlier set, or that both sets have. The other layers are
    fitted, and share what these leave of the beauty."""
    coarser: _Sums = field(default_factory=dict)
    """Layers outside of all sets that are sums of layers of this one."""

    @property
    def fitted(self) -> list[AdditiveLayer]:
        return [layer for layer in self.layers.layers if layer not in self.known]

    @property
    def channels(self) -> list[Channel]:
        """What is written."""
        return [channel for layer in (*self.layers.layers, *self.coarser) for channel in layer.channels]


def _checked(lr: MappedRender, hr: MappedRender, sets: Sequence[AdditiveSet]) -> tuple[list[_Job], dict[str, str]]:
    """The sets that sum to the beauty, and why each of the others does not, by name.

    Sets with more layers come first, because layers of the others may be sums of theirs.
    """
    jobs: list[_Job] = []
    refused: dict[str, str] = {}
    for layers in sorted(sets, key=lambda each: -len(each.layers)):
        check = check_sum(hr, layers)
        if check.problem:
            refused[layers.name] = check.text
            continue
        # All known layers come from one set. Those of two sets could have more light than the beauty.
        known = max((_sums_of(hr, layers.layers, job.layers) for job in jobs), key=len, default={})
        taken = {channel for job in jobs for channel in job.channels}
        shared = [each.name for each in layers.layers if each not in known and not taken.isdisjoint(each.channels)]
        if shared:
            refused[layers.name] = f"shares {shared[0]} with another set that does not have its other layers"
            continue
        jobs.append(_Job(layers, _same_layers(lr, layers), check.remainder, known))
    taken = {channel for job in jobs for channel in job.channels}
    for job in jobs:
        for layer in job.layers.coarser:
            if taken.isdisjoint(layer.channels):
                job.coarser.update(_sums_of(hr, [layer], job.layers))
    return jobs, refused


def _sums_of(hr: MappedRender, layers: Sequence[AdditiveLayer], finer: AdditiveSet) -> _Sums:
    """Those of some layers that a set has, or that by name and pixels are sums of its layers.

    No layer of the set belongs to two sums.
    """
    sums: _Sums = {}
    used: set[AdditiveLayer] = set()
    for layer in layers:
        parts = tuple(each for each in finer.layers if layer.words < each.words) if layer.words else ()
        if layer in finer.layers:
            parts = (layer,)
        elif layer.factor is not None or len(parts) < 2 or not is_sum_of(hr, layer, parts):
            continue
        if used.isdisjoint(parts):
            sums[layer] = parts
            used.update(parts)
    return sums


def _same_layers(lr: MappedRender, layers: AdditiveSet) -> AdditiveSet | None:
    """The same layers of the LRHS, in the same order; None if it lacks one or they do not sum to its beauty."""
    names = [layer.name for layer in layers.layers]
    for found in lr.additive_sets:
        by_name = {layer.name: layer for layer in found.layers}
        if by_name.keys() == set(names) and not check_sum(lr, found).problem:
            return replace(found, layers=tuple(by_name[name] for name in names))
    return None


class _Band:
    """Some rows of the frame, with what their layers are fitted to."""

    def __init__(self, hr: MappedRender, rgb: Array, alignment: Alignment, core: Window) -> None:
        self._alignment, self._core, self._scale = alignment, core, alignment.scale
        self._radius = RADIUS[alignment.scale]
        reach = self._radius + SMOOTHING + 1
        area = Window(core.x0, core.y0 - reach, core.x1, core.y1 + reach)
        self._area = area.intersect(alignment.grid)
        self._hrls_area = in_hrls_pixels(self._area, alignment.scale)
        window = alignment.hr_data_window
        rows, columns = mirrored_pixels(self._hrls_area, window)
        beauty = rgb[rows - window.y0].take(columns - window.x0, axis=1)
        features = read_features(hr, self._hrls_area, window, [ALBEDO, NORMAL])
        guides = [beauty, *([features[ALBEDO]] if ALBEDO in features else [])]
        #: Guides by channel of colour: the same channel of beauty and albedo, and the normal. (3, guides, h, w).
        normal = [features[NORMAL][..., i] for i in range(3)] if NORMAL in features else []
        self._guides = np.stack([[*(guide[..., c] for guide in guides), *normal] for c in range(3)])
        self._beauty = planes_of(beauty)
        self._low_beauty = planes_of(box_downsample(beauty, self._scale))
        low = np.stack([planes_of(box_downsample(np.moveaxis(g, 0, -1), self._scale)) for g in self._guides])
        with np.errstate(over="ignore", invalid="ignore"):
            self._fit = _Fit(low, self._radius)

    def fuse(
        self,
        job: _Job,
        lr: MappedRender,
        hr: MappedRender,
        pixels: ReplacedChannels,
        earlier: Mapping[AdditiveLayer, Array],
    ) -> dict[AdditiveLayer, Array]:
        """Fuse the layers of one set and store them.

        Args:
            job: the set.
            lr, hr: the pair.
            pixels: gets the rows of the band.
            earlier: light (3, h, w) of layers of earlier sets.

        Returns:
            The light of each layer.
        """
        rows = slice((self._core.y0 - self._area.y0) * self._scale, (self._core.y1 - self._area.y0) * self._scale)
        lights = {layer: _total(earlier, parts) for layer, parts in job.known.items()}
        colours = self._colours(job, hr)
        if job.fitted:
            rest = self._beauty[:, rows]
            if lights:
                rest = rest - _total(lights, lights)
                rest[rest < ROUNDING * self._beauty[:, rows]] = 0
            lights |= self._fitted(job, lr, hr, rest, colours)
        lights |= {layer: _total(lights, parts) for layer, parts in job.coarser.items()}
        window = self._alignment.hr_data_window
        core = in_hrls_pixels(self._core, self._scale)
        inside = core.intersect(window)
        for layer, light in lights.items():
            if layer in earlier:
                continue  # an earlier set has stored it
            if layer in colours:
                light = np.divide(light, np.maximum(colours[layer], DARKEST_COLOUR), dtype=np.float32)
            for channel, plane in zip(layer.channels, light, strict=True):
                pixels.put(channel, inside.y0 - window.y0, plane[inside.slices(core)])
        return lights

    def _fitted(
        self, job: _Job, lr: MappedRender, hr: MappedRender, light: Array, colours: Mapping[AdditiveLayer, Array]
    ) -> dict[AdditiveLayer, Array]:
        """Divide ``light`` (3, h, w) among the layers of a set that are fitted."""
        noisy = self._average(job, lr, hr)
        core_rows = slice(self._core.y0 - self._area.y0, self._core.y1 - self._area.y0)
        scale = self._scale
        guides = self._guides[:, :, core_rows.start * scale : core_rows.stop * scale]
        fitted = np.empty((len(noisy), *light.shape), np.float32)
        flat_noisy, flat_fitted = noisy.reshape(-1, *noisy.shape[2:]), fitted.reshape(-1, *light.shape[1:])

        def fit(planes: slice) -> None:
            # NumPy's settings for errors belong to the thread.
            with np.errstate(over="ignore", invalid="ignore"):
                fit_planes(planes)

        def fit_planes(planes: slice) -> None:
            for i in range(planes.start, planes.stop):
                coefficients = self._fit.coefficients(flat_noisy[i], i % 3)
                *slopes, offset = (upsample_linear(plane, scale, core_rows) for plane in coefficients)
                flat_fitted[i] = offset
                for guide, slope in zip(guides[i % 3], slopes, strict=True):
                    flat_fitted[i] += guide * slope
                # The renders around bound the fit: where it mixes two surfaces, it would leave their range.
                low, high = -max_3x3(-flat_noisy[i]), max_3x3(flat_noisy[i])
                bounds = (upsample_linear(plane, scale, core_rows) for plane in (low, high))
                np.clip(flat_fitted[i], *bounds, out=flat_fitted[i])

        for_row_blocks(fit, len(flat_noisy), light[0].size)
        # The squares of light beyond 1e19 overflow, so there is no fit there.
        fitted[:, ~np.isfinite(fitted).all(axis=0)] = 0
        np.clip(fitted, 0, BRIGHTEST, out=fitted)
        # Where no layer is left, the beauty is divided as in the whole band.
        dark = fitted.sum(axis=0) == 0
        fitted[:, dark] = np.minimum(noisy, BRIGHTEST).mean(axis=(1, 2, 3))[:, None]
        layers = job.fitted
        for i, layer in enumerate(layers):
            if layer in colours:
                fitted[i] *= colours[layer] >= DARKEST_COLOUR
        _make_sum(fitted, light)
        return dict(zip(layers, fitted, strict=False))

    def _average(self, job: _Job, lr: MappedRender, hr: MappedRender) -> Array:
        """The mean of both renders' layers at low resolution, (layers, 3, h, w), of those that are fitted.

        The remainder is the last layer.
        """
        window = self._alignment.hr_data_window
        render = with_layers(hr, job.layers)
        high = read_features(render, self._hrls_area, window, render.features)
        renders = [{name: box_downsample(values, self._scale) for name, values in high.items()}]
        if job.lrhs is not None:
            low = with_layers(lr, job.lrhs)
            renders.append(read_lrhs(low, self._alignment, self._area, low.features, RepairCounts()))
        total = np.zeros((len(job.layers.layers) + job.remainder, *self._low_beauty.shape), np.float32)
        for pixels in renders:
            layers = np.stack([planes_of(pixels[name]) for name in layer_keys(job.layers)])
            if job.remainder:
                rest = np.maximum(planes_of(pixels[RGB]) - layers.sum(axis=0), 0)
                layers = np.concatenate([layers, rest[None]])
            light = layers.sum(axis=(0, 1))
            allowed = FIREFLY * max_3x3(self._low_beauty.sum(axis=0))
            total += layers * np.minimum(1, allowed / np.maximum(light, 1e-20))
        total /= np.float32(len(renders))
        known = [i for i, layer in enumerate(job.layers.layers) if layer in job.known]
        return np.delete(total, known, axis=0) if known else total

    def _colours(self, job: _Job, hr: MappedRender) -> dict[AdditiveLayer, Array]:
        """The colour (3, h, w) that the light of each product that is fitted is multiplied by."""
        colours: dict[AdditiveLayer, Array] = {}
        by_channels: dict[object, Array] = {}
        window = in_hrls_pixels(self._core, self._scale)
        for layer in job.fitted:
            if layer.factor is not None:
                if layer.factor not in by_channels:
                    render = replace(hr, features={"colour": FeatureFormula((layer.factor,))})
                    colour = read_features(render, window, self._alignment.hr_data_window, ["colour"])["colour"]
                    by_channels[layer.factor] = planes_of(colour)
                colours[layer] = by_channels[layer.factor]
        return colours


class _Fit:
    """Linear fits around every low-resolution pixel: layer = sum over guides of a_k guide_k + b."""

    def __init__(self, guides: Array, radius: int) -> None:
        """``guides``: (3, guides, h, w)."""
        self._guides, self._radius = guides, radius
        self._means = np.stack([[mean_around(g, radius) for g in channel] for channel in guides])
        count = guides.shape[1]
        self._factors = []
        for c in range(3):
            matrix = [
                [
                    mean_around(guides[c, i] * guides[c, j], radius) - self._means[c, i] * self._means[c, j]
                    for j in range(i + 1)
                ]
                for i in range(count)
            ]
            for i in range(count):
                matrix[i][i] += RIDGE * (np.square(self._means[c, i]) + np.maximum(matrix[i][i], 0)) + 1e-7
            self._factors.append(_cholesky(matrix))

    def coefficients(self, layer: Array, channel: int) -> list[Array]:
        """a_k of each guide, and b, averaged over overlapping fits: planes (h, w)."""
        guides, means, factor = self._guides[channel], self._means[channel], self._factors[channel]
        mean = mean_around(layer, self._radius)
        covariances = [mean_around(layer * g, self._radius) - mean * m for g, m in zip(guides, means, strict=True)]
        slopes = _solve(factor, covariances)
        offset = _minus_products(mean, slopes, means)
        return [mean_around(plane, SMOOTHING) for plane in (*slopes, offset)]


def _cholesky(matrix: list[list[Array]]) -> list[list[Array]]:
    """The Cholesky factor of a symmetric matrix of planes; the lower triangle of both is used."""
    factor: list[list[Array]] = []
    for i, row in enumerate(matrix):
        new: list[Array] = []
        for j in range(i):
            new.append(_minus_products(row[j], new, factor[j]) / factor[j][j])
        # Rounding can make a pivot negative where two guides are the same.
        new.append(np.sqrt(np.maximum(_minus_products(row[i], new, new), np.float32(1e-8))))
        factor.append(new)
    return factor


def _solve(factor: list[list[Array]], values: list[Array]) -> list[Array]:
    """Solve ``L L^T x = values`` for planes."""
    half: list[Array] = []
    for row, value in zip(factor, values, strict=True):
        half.append(_minus_products(value, row, half) / row[-1])
    result: list[Array] = []
    for i in reversed(range(len(factor))):
        column = [row[i] for row in factor[i + 1 :]]
        result.insert(0, _minus_products(half[i], column, result) / factor[i][i])
    return result


def _minus_products(value: Array, first: Sequence[Array], second: Sequence[Array]) -> Array:
    """``value`` minus the products of the planes of two lists; the longer list's other planes are not used."""
    for a, b in zip(first, second, strict=False):
        value = value - a * b
    return value


def _total(lights: Mapping[AdditiveLayer, Array], layers: Iterable[AdditiveLayer]) -> Array:
    """The light of some layers together."""
    first, *others = layers
    total = lights[first].copy()
    for layer in others:
        total += lights[layer]
    return total


def _make_sum(layers: Array, beauty: Array) -> None:
    """Scale layers (n, 3, h, w), none of them negative, so that they sum to the beauty (3, h, w)."""
    total = layers.sum(axis=0)
    lit = total > 0
    layers *= np.where(lit, beauty / np.where(lit, total, 1), 0)
