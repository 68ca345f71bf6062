# SPDX-License-Identifier: Apache-2.0
"""Estimates layers by a network, which fuses each as if it were a beauty, at full or at half of the resolution.

That is more accurate than a fit, and takes a run of the network for each layer. Both renders must have the layer.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
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
from oiio_msspl.fusion.tiles.network import fuse_layers
from oiio_msspl.image.arrays import Array, blank, planes_of, unload
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.model.session import Session

#: More light groups than this are fused at half of the resolution at x2. The beauty has the detail of their surfaces.
MOST_AT_FULL_SIZE = 5
#: The scale at which half of the resolution is that of the LRHS.
HALF = 2
#: Layers at half of the resolution have little noise, so fewer pixels are averaged than by ``lines.STEPS``.
HALF_STEPS = (1,)


class LayersByNetwork:
    """The layers of a frame that a network fuses, at full or at half of the resolution; none without a network."""

    def __init__(self, sources: PassSources, jobs: Sequence[PassJob], session: Session | None) -> None:
        self._beauty, self._alignment = sources.beauty, sources.alignment
        self._session = session if session and session.layers and any(job.lrhs for job in jobs) else None
        self._renders = cast(tuple[Render, Render], (sources.low, sources.high))
        self._is_one_render = sources.lr is sources.hr
        self.at_full_size: dict[AdditiveLayer, Array] = {}
        """Layers that were fused at full resolution, (height, width, 3) over the HRLS's data window."""
        self._at_half_size: dict[AdditiveLayer, Array] = {}

    def count(self, job: PassJob) -> int:
        """Return how many layers :meth:`fuse` yields."""
        return len(job.estimated) if self._session else 0

    def fuse(self, job: PassJob) -> Iterator[AdditiveLayer]:
        """Fuse the layers of a set that have light in both renders. Yield each estimated one, fused or not."""
        if self._session is None:
            return
        lit = {layer: job.names[layer] for layer in job.estimated if job.names[layer] in job.lrhs}
        lit = {layer: name for layer, name in lit.items() if not any(is_black(x, name) for x in self._renders)}
        self.unload()
        alignment = self._alignment
        half = alignment.scale == HALF and job.layers.name == LIGHT_GROUPS and len(lit) > MOST_AT_FULL_SIZE
        if half:
            alignment = replace(alignment, scale=1, hr_data_window=alignment.grid)
        fused = fuse_layers(self._session, self._beauty, self._pairs(lit.values(), half=half), alignment)
        for layer in job.estimated:
            if layer in lit:
                light = next(fused)
                for channel in range(3):
                    if not any((render.layers[lit[layer]][..., channel] > 0).any() for render in self._renders):
                        light[..., channel] = 0  # a saturated lamp gets no light of another colour
                unload(light)
                (self._at_half_size if half else self.at_full_size)[layer] = light
            yield layer

    def _pairs(self, names: Iterable[str], *, half: bool) -> Iterator[tuple[Render, Render]]:
        """Yield both renders with a layer in place of the beauty; the HRLS at half of its resolution if ``half``."""
        low, high = self._renders
        guides, high_guides = ({n: x.layers[n] for n in (ALBEDO, NORMAL) if n in x.layers} for x in self._renders)
        if half:
            grid = self._alignment.grid
            high = replace(high, data_window=grid, display_window=Window(0, 0, grid.x1, grid.y1))
            high_guides = {name: _half_of(image, self._alignment) for name, image in high_guides.items()}
        for name in names:
            light = _half_of(high.layers[name], self._alignment) if half else high.layers[name]
            hrls = replace(high, layers={RGB: light, **high_guides})
            yield hrls if self._is_one_render else replace(low, layers={RGB: low.layers[name], **guides}), hrls

    def estimate(self, band: Band, job: PassJob, out: Array) -> set[int]:
        """Put the fused layers of a set into ``out``, (layers, 3, h, w) over the core of a band. Return which ones.

        Those at half of the resolution are fitted to the beauty, and the fit is drawn towards them.
        """
        full, half = (
            {i: light[layer] for i, layer in enumerate(job.estimated) if layer in light}
            for light in (self.at_full_size, self._at_half_size)
        )
        for i, light in full.items():
            out[i] = band.sources.planes(light, band.hrls_core)
        if half and job in band.to_fit:
            area = band.area.slices(self._alignment.grid)
            low = [planes_of(light[area]) for light in half.values()]
            band.fit_at(HALF_STEPS).fit_layers(low, [out[i] for i in half])
            for i, means in zip(half, low, strict=True):
                _draw_towards(out[i], means[:, band.rows])
        return {*full, *half}

    def unload(self) -> None:
        """Give the memory of pixels that wait in temporary files back to the system."""
        for render in self._renders:
            render.unload()
        for image in (*self.at_full_size.values(), *self._at_half_size.values()):
            unload(image)


def _half_of(image: Array, alignment: Alignment) -> Array:
    """Average an image over the HRLS's data window over 2 x 2 pixels, over the whole grid."""
    grid = alignment.grid
    result: Array = blank((grid.height, grid.width, image.shape[-1]))
    for part in grid.bands(BAND_ROWS):
        full = mirrored(image, alignment.hr_data_window, in_hrls_pixels(part, HALF))
        result[part.slices(grid)] = box_downsample(full, HALF)
    unload(image)
    unload(result)
    return result


def _draw_towards(image: Array, means: Array) -> None:
    """Change a fitted layer (3, h, w), so that its means over 2 x 2 pixels are half-way to ``means``, the network's."""
    # A fit can't tell apart two lamps that are equally bright and a few pixels apart, so the light of one would leak
    # into the layer of the other. The network can, but its result has more noise. Half-way is the geometric mean.
    fitted = downsampled(image, HALF)
    factors = np.sqrt(means / np.maximum(fitted, np.float32(1e-6) * means + np.finfo(np.float32).tiny))
    factors[fitted <= 0] = 1
    image *= factors.repeat(HALF, axis=1).repeat(HALF, axis=2)
