# SPDX-License-Identifier: Apache-2.0
"""Estimates layers by a network, which fuses each as if it were a beauty, at full or at half of the resolution.

That is more accurate than a fit, and takes a run of the network for each layer. Both renders must have the layer.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import cast

import numpy as np

from oiio_msspl.aovs.additive_sets import LIGHT_GROUPS, AdditiveLayer
from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.exr.render import Render, Window
from oiio_msspl.fusion.passes.bands import BAND_ROWS, Band, PassSources
from oiio_msspl.fusion.passes.layers import is_black
from oiio_msspl.fusion.passes.lines import downsampled
from oiio_msspl.fusion.passes.plan import PassJob
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.fusion.tiles.features import in_hrls_pixels, mirrored
from oiio_msspl.image.arrays import Array, blank, planes_of, unload
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.image.parallel import for_row_blocks

#: More light groups than this are fused at half of the resolution at x2, in 0.4 of the time. Each lamp lights the same
#: surfaces, so the beauty has their detail. Components have detail of their own.
MOST_AT_FULL_SIZE = 5
#: The scale at which half of the resolution is that of the LRHS.
HALF = 2
#: Layers at half of the resolution have little noise, so fewer pixels are averaged than by ``lines.STEPS``.
HALF_STEPS = (1,)

#: Fuses layers, given both renders with a layer in place of the beauty, for each layer, and the alignment of these
#: pairs: (height, width, 3) over the HRLS's data window. It takes the next pair in the background.
LayerFuser = Callable[[Iterable[tuple[Render, Render]], Alignment], Iterator[Array]]


class AtFullSize:
    """Layers that a network fuses at the frame's resolution."""

    def __init__(self, low: Render, high: Render, alignment: Alignment) -> None:
        self._low, self._high, self.alignment = low, high, alignment
        self.light: dict[AdditiveLayer, Array] = {}

    def pair(self, name: str) -> tuple[Render, Render]:
        """Return both renders with a layer in place of the beauty."""
        return _as_beauty(self._low, name), _as_beauty(self._high, name)

    def estimate(self, band: Band, job: PassJob, out: Array) -> list[int]:
        """Copy the fused light, see :meth:`LayersByNetwork.estimate`."""
        fused = [i for i, layer in enumerate(job.estimated) if layer in self.light]
        for i in fused:
            out[i] = band.over_core(self.light[job.estimated[i]])
        return fused


class AtHalfSize:
    """Layers of an x2 pair that a network fuses at the LRHS's resolution, and that are fitted to the beauty then.

    The HRLS is averaged over 2 x 2 pixels, over the whole grid.
    """

    def __init__(self, low: Render, high: Render, alignment: Alignment) -> None:
        self._low, self._high = low, high
        self.alignment = replace(alignment, scale=1, hr_data_window=alignment.grid)
        self._data_window = alignment.hr_data_window
        self._guides = {name: self._half_of(name) for name in (ALBEDO, NORMAL) if name in high.layers}
        self.light: dict[AdditiveLayer, Array] = {}

    def pair(self, name: str) -> tuple[Render, Render]:
        """Return both renders with a layer in place of the beauty."""
        window = self.alignment.grid
        frame = Window(0, 0, window.x1, window.y1)
        half = Render({RGB: self._half_of(name), **self._guides}, window, frame, name=self._high.name)
        return _as_beauty(self._low, name), half

    def estimate(self, band: Band, job: PassJob, out: Array) -> list[int]:
        """Fit the fused light to the beauty, and draw the fit towards it, see :meth:`LayersByNetwork.estimate`."""
        fused = [i for i, layer in enumerate(job.estimated) if layer in self.light]
        if fused and band.needs_fit(job):
            area = band.area.slices(self.alignment.grid)
            low = [planes_of(self.light[job.estimated[i]][area]) for i in fused]
            band.fit_at(HALF_STEPS).fit_layers(low, [out[i] for i in fused])
            for i, means in zip(fused, low, strict=True):
                _draw_towards(out[i], means[:, band.rows])
        return fused

    def _half_of(self, name: str) -> Array:
        image, window = self._high.layers[name], self.alignment.grid
        result: Array = blank((window.height, window.width, image.shape[-1]))
        for top in range(window.y0, window.y1, BAND_ROWS):
            part = Window(window.x0, top, window.x1, min(top + BAND_ROWS, window.y1))
            full = mirrored(image, self._data_window, in_hrls_pixels(part, HALF))
            result[part.slices(window)] = box_downsample(full, HALF)
        unload(image)
        unload(result)
        return result


class LayersByNetwork:
    """The layers of a frame that a network fuses, in either way.

    Args:
        sources: of the frame, decoded if there is a network.
        jobs: the sets.
        fuse: the network; None if there is none.
    """

    def __init__(self, sources: PassSources, jobs: Sequence[PassJob], fuse: LayerFuser | None) -> None:
        self._fuse, self._scale = fuse if any(job.lrhs for job in jobs) else None, sources.alignment.scale
        self._renders = cast(tuple[Render, Render], (sources.low, sources.high))
        self._full_size = AtFullSize(*self._renders, sources.alignment)
        self._ways: list[AtFullSize | AtHalfSize] = [self._full_size]

    @property
    def at_full_size(self) -> Collection[AdditiveLayer]:
        """The layers that were fused at full resolution."""
        return self._full_size.light

    def count(self, job: PassJob) -> int:
        """Return how many layers :meth:`fuse` yields."""
        return len(job.estimated) if self._fuse else 0

    def fuse(self, job: PassJob) -> Iterator[AdditiveLayer]:
        """Fuse the layers of a set that have light in both renders.

        Yields:
            Each layer that is to be estimated, whether a network has fused it or not.
        """
        if self._fuse is None:
            return
        lit = {layer: job.names[layer] for layer in job.estimated if job.names[layer] in job.lrhs}
        lit = {layer: name for layer, name in lit.items() if not any(is_black(x, name) for x in self._renders)}
        self.unload()
        way = self._way(job, len(lit))
        fused = self._fuse((way.pair(name) for name in lit.values()), way.alignment)
        for layer in job.estimated:
            if layer in lit:
                way.light[layer] = light = next(fused)
                for channel in range(3):
                    if not any((render.layers[lit[layer]][..., channel] > 0).any() for render in self._renders):
                        light[..., channel] = 0  # a saturated lamp gets no light of another colour
                unload(light)
            yield layer

    def _way(self, job: PassJob, count: int) -> AtFullSize | AtHalfSize:
        """Choose how to fuse a set of which so many layers have light."""
        if self._scale != HALF or job.layers.name != LIGHT_GROUPS or count <= MOST_AT_FULL_SIZE:
            return self._full_size
        self._ways.append(AtHalfSize(*self._renders, self._full_size.alignment))
        return self._ways[-1]

    def estimate(self, band: Band, job: PassJob, out: Array) -> set[int]:
        """Put the fused layers of a set into ``out``, (layers, 3, h, w) over the core of a band. Return which ones."""
        return {i for way in self._ways for i in way.estimate(band, job, out)}

    def unload(self) -> None:
        """Give the memory of pixels that wait in temporary files back to the system."""
        for render in self._renders:
            render.unload()
        for image in itertools.chain.from_iterable(way.light.values() for way in self._ways):
            unload(image)


def _as_beauty(render: Render, name: str) -> Render:
    """Return a render with a layer in place of the beauty."""
    guides = {guide: render.layers[guide] for guide in (ALBEDO, NORMAL) if guide in render.layers}
    return replace(render, layers={RGB: render.layers[name], **guides})


def _draw_towards(image: Array, means: Array) -> None:
    """Change a fitted layer (3, h, w), so that its means over 2 x 2 pixels are half-way to ``means``, the network's."""
    # A fit can't tell apart two lamps that are equally bright and a few pixels apart, so the light of one would leak
    # into the layer of the other. The network can, but its result has more noise. Half-way is the geometric mean.

    def work(rows: slice) -> None:
        part = image[:, rows]
        wanted = means[:, rows.start // HALF : -(-rows.stop // HALF)]
        fitted = downsampled(part, HALF)
        factors = np.sqrt(wanted / np.maximum(fitted, np.float32(1e-6) * wanted + np.finfo(np.float32).tiny))
        factors[fitted <= 0] = 1
        part *= factors.repeat(HALF, axis=1).repeat(HALF, axis=2)

    for_row_blocks(work, image.shape[1], image[:, 0].size, multiple=HALF)
