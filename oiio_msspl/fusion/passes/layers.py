# SPDX-License-Identifier: Apache-2.0
"""The layers of a set at the LRHS's resolution, as both renders have them, and their shares of the light around."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import RGB
from oiio_msspl.exr.render import ReadableRender, Window
from oiio_msspl.fusion.motion.vectors import sample_linear
from oiio_msspl.fusion.passes.fit import downsampled
from oiio_msspl.fusion.passes.plan import PassJob
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.fusion.tiles.features import RepairCounts, in_hrls_pixels, mirrored, read_features, read_lrhs
from oiio_msspl.image.arrays import Array, planes_of
from oiio_msspl.image.filters import box_downsample, filled, max_3x3

T = TypeVar("T", bound=np.generic)

#: Light of an LRHS pixel, relative to the fused beauty there, above which its layers are dimmed by one factor.
FIREFLY = 4.0
#: HRLS pixels on a side of the squares over which the shares of layers are averaged.
SQUARE = 64


def dimmed(job: PassJob, pixels: Mapping[str, Array], beauty: Array) -> Array:
    """The layers of one render at low resolution, (layers, 3, h, w), without fireflies. Layers that it lacks are black.
    The rest of its beauty is the last layer, if layers are missing or light is in none.

    Args:
        pixels: features (h, w, 3) of the render.
        beauty: the fused one (3, h, w).
    """
    black = np.zeros_like(beauty)
    layers = np.stack([planes_of(pixels[key]) if key in pixels else black for key in job.keys.values()])
    if job.remainder or not pixels.keys() >= set(job.keys.values()):
        rest = np.maximum(planes_of(pixels[RGB]) - layers.sum(axis=0), 0)
        layers = np.concatenate([layers, rest[None]])
    light = layers.sum(axis=(0, 1))
    allowed = FIREFLY * max_3x3(beauty.sum(axis=0))
    layers *= np.minimum(1, allowed / np.maximum(light, 1e-20))
    return layers


def in_both(job: PassJob, count: int) -> NDArray[np.bool_]:
    """Which of the first ``count`` layers of a set both renders have. The remainder comes behind them: both have it if
    they have all layers."""
    both = [key in job.lrhs for key in job.keys.values()]
    return np.array([*both, all(both)])[:count]


def to_be_fitted(job: PassJob, layers: NDArray[T]) -> NDArray[T]:
    """Those layers of a set, on the first axis, that are to be fitted."""
    known = [i for i, layer in enumerate(job.layers.layers) if layer in job.known]
    return np.delete(layers, known, axis=0) if known else layers


class SharesAround:
    """How the layers of a set share the light around a pixel: means over squares of the frame, interpolated.

    The beauty is divided by them where no layer has a sample near. The renders are read once more for that, and only if
    there is such a pixel. The shares do not depend on the bands in which a frame is fused.

    Args:
        low, high: both renders with all layers.
        rgb: the fused beauty, (height, width, 3) over the HRLS's data window.
        alignment: of the pair.
    """

    def __init__(self, low: ReadableRender, high: ReadableRender, rgb: Array, alignment: Alignment) -> None:
        self._low, self._high, self._rgb, self._alignment = low, high, rgb, alignment
        #: By the name of a set, for each square, (rows, columns, layers).
        self._shares: dict[str, Array] = {}

    def at(self, job: PassJob, x: NDArray[np.intp], y: NDArray[np.intp]) -> Array:
        """The shares of the layers that are to be fitted, (layers, n), at HRLS pixels (n) of the frame."""
        if job.layers.name not in self._shares:
            self._shares[job.layers.name] = self._measure(job)
        grid, scale = self._alignment.grid, self._alignment.scale
        columns, rows = (
            ((pixels - start * scale + 0.5) / SQUARE - 0.5).astype(np.float32)
            for pixels, start in ((x, grid.x0), (y, grid.y0))
        )
        return sample_linear(self._shares[job.layers.name], columns, rows).T

    def _measure(self, job: PassJob) -> Array:
        """The shares in each square of the frame, (rows, columns, layers): those of the squares around where a square
        has no light, and equal ones if none has any."""
        grid, side = self._alignment.grid, SQUARE // self._alignment.scale
        tops = range(grid.y0, grid.y1, side)
        light = np.stack([self._light_of(job, Window(grid.x0, top, grid.x1, min(top + side, grid.y1))) for top in tops])
        total = light.sum(axis=-1, keepdims=True)
        lit = total[..., 0] > 0
        if not lit.any():
            return np.full(light.shape, 1, np.float32)
        return filled(np.divide(light, np.where(total > 0, total, 1), dtype=np.float32), ~lit)

    def _light_of(self, job: PassJob, area: Window) -> NDArray[np.float64]:
        """The light of the layers in each square of a row of squares, (columns, layers)."""
        scale, window = self._alignment.scale, self._alignment.hr_data_window
        hrls_area = in_hrls_pixels(area, scale)
        beauty = downsampled(planes_of(mirrored(self._rgb, window, hrls_area)).astype(np.float32), scale)
        features = read_features(self._high, hrls_area, window, [RGB, *job.keys.values()])
        layers = dimmed(job, {name: box_downsample(image, scale) for name, image in features.items()}, beauty)
        if job.lrhs:
            theirs = read_lrhs(self._low, self._alignment, area, [RGB, *job.lrhs], RepairCounts())
            both = in_both(job, len(layers))
            layers[both] = (layers[both] + dimmed(job, theirs, beauty)[: len(layers)][both]) / 2
        for render in (self._low, self._high):
            render.unload()
        # Relative to the beauty, or a bright thing in a square would decide for all of it.
        layers /= np.maximum(max_3x3(beauty.sum(axis=0)), 1e-20)
        lines = to_be_fitted(job, layers).sum(axis=(1, 2), dtype=np.float64)
        return np.add.reduceat(lines, range(0, area.width, SQUARE // scale), axis=1).T
