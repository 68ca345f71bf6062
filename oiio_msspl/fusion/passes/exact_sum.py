# SPDX-License-Identifier: Apache-2.0
"""Makes the layers of a set sum to the beauty, to the last bits.

What estimated layers lack of the beauty is spread over them, by the light of each and by how far the two renders differ
in it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import RGB
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.passes.bands import Band, PassSources, dimmed, estimated_of, in_both
from oiio_msspl.fusion.passes.lines import downsampled
from oiio_msspl.fusion.passes.plan import PassJob
from oiio_msspl.fusion.tiles.features import in_hrls_pixels, read_features, read_lrhs
from oiio_msspl.image.arrays import Array, Mask
from oiio_msspl.image.filters import blurred, box_downsample, filled, max_around, upsample_linear
from oiio_msspl.image.parallel import for_row_blocks
from oiio_msspl.image.sampling import sample_linear

#: HRLS pixels on a side of the squares over which the shares of layers are averaged.
SQUARE = 64
#: The least doubt of a layer, relative to the largest: one without noise by chance pushes no large error into others.
LEAST_DOUBT = np.float32(0.25)
#: What is spread by doubt adds at most this share to the sum of the layers, and takes at most this share of a layer.
MOST_SPREAD = np.float32(0.9)
#: What is still lacking, such as the light of a rare lamp, is spread by the square of the doubt, at least this.
LEAST_SQUARED_DOUBT = np.float32(1e-3)
#: A colour below this can't carry light: a product of light and colour is written as product / colour.
DARKEST_COLOUR = 1e-3
#: Larger values of estimated layers are clipped before they are scaled to the sum, which would overflow.
BRIGHTEST = np.float32(1e30)


def make_exact(
    layers: Array, light: Array, job: PassJob, band: Band, shares: SharesAround, doubts: Array | None
) -> None:
    """Change the estimated layers of a set, so that they sum to ``light``.

    Args:
        layers: (layers, 3, h, w) over the core of the band.
        light: (3, h, w).
        shares: of the layers, where none has a sample near.
        doubts: see :func:`doubts_of`; None if the LRHS has no layer.
    """
    for planes, layer in zip(layers, job.estimated, strict=False):
        if layer in band.ranges:
            np.clip(planes, *band.ranges[layer], out=planes)
    # The squares of light beyond 1e19 overflow, so there is no fit there.
    layers[:, ~np.isfinite(layers).all(axis=0)] = 0
    np.clip(layers, 0, BRIGHTEST, out=layers)
    # Where no layer is left, the beauty is divided as it is around.
    dark = (layers.sum(axis=0) == 0) & (light > 0)
    if dark.any():
        layers[:, dark] = shares.at(job, band, dark)
    free = [i for i, layer in enumerate(job.estimated) if layer.factor is None]
    if len(free) < len(job.estimated):
        for planes, layer in zip(layers, job.estimated, strict=False):
            if layer.factor is not None:
                planes *= band.colours[layer.factor] >= DARKEST_COLOUR
        # Light that no layer can store, because all their colours are black, goes to the layers without colour.
        lost = (layers.sum(axis=0) == 0) & (light > 0)
        if free and lost.any():
            around = shares.at(job, band, lost)[free]
            around[:, around.sum(axis=0) == 0] = 1
            for i, share in zip(free, around, strict=True):
                layers[i][lost] = share
    spread_rest(layers, light, doubts)


def doubts_of(job: PassJob, band: Band, hrls: Array, lrhs: Array) -> Array:
    """Return how uncertain each layer is, (layers, h, w) over the core, at most 1, by :meth:`Band.renders_of`.

    It is the root of the mean difference of both renders, relative to the largest; 1 for a layer that the LRHS lacks.
    """
    shared = in_both(job, len(hrls))
    differences = np.abs(hrls - lrhs[: len(hrls)]).mean(axis=1)
    differences[~shared] = 0
    doubts = np.sqrt([blurred(plane) for plane in estimated_of(job, differences)])
    most = doubts.max(axis=0)
    doubts = np.divide(doubts, most, out=np.ones_like(doubts), where=(most > 0) & np.isfinite(most))
    doubts[~estimated_of(job, shared)] = 1
    return np.stack([upsample_linear(plane, band.scale, band.rows) for plane in doubts])


def spread_rest(layers: Array, beauty: Array, doubts: Array | None) -> None:
    """Change layers (n, 3, h, w), none of them negative, so that they sum to the beauty (3, h, w), except black ones.

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
            part += np.maximum(weights * lacking, -MOST_SPREAD * part)
            total = part.sum(axis=0)
            if is_far:
                weights = part * np.maximum(np.square(doubt), LEAST_SQUARED_DOUBT)
                weights /= np.maximum(weights.sum(axis=0), tiny)
                part += weights * np.maximum(wanted - total, 0)
                total = part.sum(axis=0)
        # The beauty divided by a tiny total would overflow; a layer's part of the total never does.
        part /= np.where(total > 0, total, 1)
        part *= wanted

    for_row_blocks(work, beauty.shape[1], layers[:, :, 0].size)


class SharesAround:
    """How the layers of a set share the light around a pixel where none has a sample: means over squares of the frame.

    The renders are read once more for that, and only if there is such a pixel.
    """

    def __init__(self, sources: PassSources) -> None:
        self._sources = sources
        #: By the name of a set, for each square, (rows, columns, layers).
        self._shares: dict[str, Array] = {}

    def at(self, job: PassJob, band: Band, where: Mask) -> Array:
        """Return the shares of the estimated layers at some values of a band's core (3, h, w): (layers, values)."""
        if job.layers.name not in self._shares:
            self._shares[job.layers.name] = self._measure(job)
        grid = in_hrls_pixels(self._sources.alignment.grid, band.scale)
        _, y, x = np.nonzero(where)
        columns, rows = (
            ((pixels + start + 0.5) / SQUARE - 0.5).astype(np.float32)
            for pixels, start in ((x, band.hrls_core.x0 - grid.x0), (y, band.hrls_core.y0 - grid.y0))
        )
        return sample_linear(self._shares[job.layers.name], columns, rows).T

    def _measure(self, job: PassJob) -> Array:
        """Return the shares in each square of the frame, (rows, columns, layers); of those around where it is black."""
        grid, side = self._sources.alignment.grid, SQUARE // self._sources.alignment.scale
        light = np.stack([self._light_of(job, rows) for rows in grid.bands(side)])
        total = light.sum(axis=-1, keepdims=True)
        lit = total[..., 0] > 0
        if not lit.any():
            return np.ones(light.shape, np.float32)
        return filled(np.divide(light, np.where(total > 0, total, 1), dtype=np.float32), ~lit)

    def _light_of(self, job: PassJob, area: Window) -> NDArray[np.float64]:
        """Return the light of the layers in each of a row of squares, (columns, layers)."""
        sources, alignment = self._sources, self._sources.alignment
        hrls_area = in_hrls_pixels(area, alignment.scale)
        beauty = downsampled(sources.planes(sources.beauty.rgb, hrls_area), alignment.scale)
        features = read_features(sources.high, hrls_area, alignment.hr_data_window, [RGB, *job.names.values()])
        low = {name: box_downsample(image, alignment.scale) for name, image in features.items()}
        layers = dimmed(job, low, beauty)
        if job.lrhs:
            lrhs = read_lrhs(sources.low, alignment, area, [RGB, *job.lrhs])
            shared = in_both(job, len(layers))
            layers[shared] = (layers[shared] + dimmed(job, lrhs, beauty)[: len(layers)][shared]) / 2
        for render in (sources.low, sources.high):
            render.unload()
        # Relative to the beauty, or a bright thing in a square would decide for all of it.
        layers /= np.maximum(max_around(beauty.sum(axis=0)), 1e-20)
        lines = estimated_of(job, layers).sum(axis=(1, 2), dtype=np.float64)
        return np.add.reduceat(lines, range(0, area.width, SQUARE // alignment.scale), axis=1).T
