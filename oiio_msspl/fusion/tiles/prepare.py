# SPDX-License-Identifier: Apache-2.0
"""Prepares the tiles of a frame for the network: reads them and applies the guards."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB, VARIANCE
from oiio_msspl.aovs.mapped_render import ReadableRender
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.fusion.tiles.features import RepairCounts, TileFeatures, read_lrhs, read_tile
from oiio_msspl.fusion.tiles.guards import (
    FAR,
    EmptyRegions,
    bright_lights,
    dim_fireflies,
    is_noise_free,
    lit_window,
    steady_lights,
)
from oiio_msspl.fusion.tiles.tiling import Tile, aligned_grid, plan_tiles, sample_bands
from oiio_msspl.image.arrays import Array, Mask
from oiio_msspl.model.contract import ONE_SIZE, Contract
from oiio_msspl.model.encoding import find_exposure
from oiio_msspl.model.render_mean import Images, Shares, find_shares

#: The variance of one render is used if in this share of its pixels it exceeds the squared colour times the second
#: number. At 1 spp it is 0, or a rounding error.
KNOWN, ROUNDING = 1e-4, 1e-6


@dataclass
class PreparedTile:
    """A tile that is ready for the network."""

    features: TileFeatures
    """As read, with alpha, albedo and normal of the HRLS only."""
    empty: Mask | None
    """Pixels that stay black, see :meth:`oiio_msspl.fusion.tiles.guards.EmptyRegions.mask`."""
    lrhs: Images | None = None
    """Inputs of the model; None for a tile that is empty everywhere."""
    hrls: Images | None = None
    lights: Array | None = None
    """Pixels that keep the colour of the HRLS, see :func:`oiio_msspl.fusion.tiles.guards.bright_lights`, or that of the
    only render, see :func:`oiio_msspl.fusion.tiles.guards.steady_lights`."""
    noise_free: bool = False
    """The renders agree, so the HRLS is the result."""
    aovs: tuple[str, ...] = ()
    """AOVs of the HRLS whose denoised pixels are kept."""
    variance: Array | None = None
    """Of one render, (h, w, 3); None if it has none. The difference of two renders tells their noise."""


class FramePair:
    """Both renders of a frame: the LRHS in memory, and the HRLS that is read tile by tile.

    Args:
        lr, hr: the renders; one render is given as both.
        alignment: how their pixels lie over each other.
        contract: of the model.
        aovs: AOVs of the HRLS whose denoised pixels are kept.
        share: of the LRHS in the mean of both renders; None to find it.
        of_pass: exposure of the beauty, and reach of :class:`oiio_msspl.fusion.tiles.guards.EmptyRegions`, if the
            renders show a pass in place of the beauty.
        on_read: called with the features of each tile.
    """

    def __init__(
        self,
        lr: ReadableRender,
        hr: ReadableRender,
        alignment: Alignment,
        contract: Contract,
        aovs: Sequence[str] = (),
        *,
        share: float | None = None,
        of_pass: tuple[float, int] | None = None,
        on_read: Callable[[TileFeatures], object] = lambda _: None,
    ) -> None:
        self._lr, self._hr, self._alignment, self._contract = lr, hr, alignment, contract
        self._aovs, self._share, self._on_read = aovs, share, on_read
        self._is_one_render = lr is hr
        self._reads_variance = lr is hr and of_pass is None
        self.grid = aligned_grid(alignment.grid, contract.alignment)
        self._lrhs_counts, self._hrls_counts = RepairCounts(), RepairCounts()
        #: Features of a full-size LRHS are read tile by tile, to save memory. One render has all but alpha in the HRLS.
        self._lrhs_by_tile = [*([] if lr is hr else contract.lrhs[1:]), "alpha"] if alignment.scale == ONE_SIZE else []
        whole = [name for name in (*contract.lrhs, "alpha") if name not in self._lrhs_by_tile]
        self._lrhs = read_lrhs(lr, alignment, self.grid, whole, self._lrhs_counts)
        self.lrhs_has_alpha = "alpha" in self._lrhs
        self.lrhs_rgb = self._lrhs[RGB][alignment.grid.slices(self.grid)]
        """Colour of the LRHS (h, w, 3) over the grid of the alignment."""
        self.exposure, reach = of_pass or (find_exposure(self.lrhs_rgb), FAR)
        self._empty_regions = EmptyRegions(self._lrhs[RGB], reach, of_pass=of_pass is not None)
        self._part = self._lit_part(reach) if of_pass else None

    @property
    def tells_noise(self) -> bool:
        """Whether two renders tell the noise of a pixel by their difference, or one by its variance.

        A variance that is 0 everywhere is that of single samples.

        Raises:
            InputError: pixels can't be decoded.
        """
        if not self._is_one_render:
            return True
        shares = []
        for band in sample_bands(self._alignment.grid, ONE_SIZE):
            render = self._read(Tile(band, band), [RGB, VARIANCE]).hrls
            variance = _variance_of_colours(render)
            if variance is None:
                return False
            least = np.float32(ROUNDING) * np.square(render[RGB]).max(axis=-1, keepdims=True)
            shares.append(float((variance > least).mean()))
        return float(np.mean(shares)) > KNOWN

    def counts(self, kind: str) -> dict[str, int]:
        """Return the numbers of values that were ``repaired`` or ``negative``, by render and feature (``lrhs.rgb``)."""
        renders = (("lrhs", self._lrhs_counts), ("hrls", self._hrls_counts))
        return {f"{of}.{name}": n for of, counts in renders for (key, name), n in counts.items() if n and key == kind}

    def tiles(self, part: Window | None = None) -> list[Tile]:
        """Return the tiles of the grid, or of a part of it. A pass is black where none of them is."""
        return plan_tiles(self.grid, self._contract, part or self._part)

    def prepare(self, tile: Tile) -> PreparedTile:
        """Read a tile and apply the guards."""
        variance = [VARIANCE] if self._reads_variance else []
        features = self._read(tile, [*self._contract.hrls, "alpha", *variance], self._hrls_counts)
        self._on_read(features)
        empty = self._empty_regions.mask(features, tile.area.slices(self.grid))
        guides = {name: values for name, values in features.hrls.items() if name in (ALBEDO, NORMAL, "alpha")}
        aovs = tuple(name for name in self._aovs if name in features.hrls)
        prepared = PreparedTile(replace(features, hrls=guides), empty, aovs=aovs)
        if self._reads_variance:
            prepared.variance = _variance_of_colours(features.hrls)
        # An empty tile may still show surfaces.
        if empty is None or not empty.all() or self._aovs:
            lrhs_rgb, prepared.hrls = dim_fireflies(features)
            prepared.lrhs = features.lrhs | {RGB: lrhs_rgb}
            prepared.lights = bright_lights(lrhs_rgb, prepared.hrls[RGB], self.exposure)
            steady = steady_lights(prepared.hrls[RGB], self.exposure) if self._is_one_render else None
            if steady is not None:
                lights = steady if prepared.lights is None else prepared.lights
                prepared.lights = np.where(steady.any(axis=-1, keepdims=True), steady, lights)
            prepared.noise_free = not self._is_one_render and is_noise_free(
                features, lrhs_rgb, prepared.hrls[RGB], self.exposure
            )
        return prepared

    def sample_shares(self) -> tuple[Shares, Shares]:
        """Return the LRHS's shares in the mean of both renders, of colour and of alpha, which many models denoise.

        They come from bands of the frame, so that neighbouring tiles agree. One render has none: they are 0.
        """
        if not self._contract.denoiser or self._is_one_render:
            return {}, {}
        colours, alphas = [], []
        for band in sample_bands(self._alignment.grid, self._contract.scale):
            features = self._read(Tile(band, band), [RGB, ALBEDO, NORMAL, "alpha"])
            lrhs_rgb, hrls = dim_fireflies(features)
            colours.append((features.lrhs | {RGB: lrhs_rgb}, hrls))
            if "alpha" in features.lrhs and "alpha" in features.hrls:
                alphas.append((alpha_as_colour(features.lrhs), alpha_as_colour(features.hrls)))
        share = self._share
        return find_shares(colours, self.exposure, share), find_shares(alphas, 1.0, share) if alphas else {}

    def exact_lrhs_rgb(self) -> Array:
        """Return the colour of the LRHS at the places of its HRLS pixels, (h, w, 3) over the grid of the alignment.

        Networks read the nearest pixels instead, which lie beside these places if an odd size was rounded.
        """
        if self._alignment.stretch == (1.0, 1.0):
            return self.lrhs_rgb
        return read_lrhs(self._lr, self._alignment, self._alignment.grid, [RGB], exact=True)[RGB]

    def _read(self, tile: Tile, features: Sequence[str], counts: RepairCounts | None = None) -> TileFeatures:
        lrhs, grid = self._lrhs, self.grid
        if self._lrhs_by_tile:
            lrhs, grid = {name: values[tile.area.slices(grid)] for name, values in lrhs.items()}, tile.area
            lrhs |= read_lrhs(self._lr, self._alignment, tile.area, self._lrhs_by_tile)
            self.lrhs_has_alpha = "alpha" in lrhs
        return read_tile(tile, lrhs, grid, self._hr, self._alignment, features, counts)

    def _lit_part(self, reach: int) -> Window | None:
        """Return the part of the grid within ``reach`` of light; None for all of it, if a render is black."""
        scale = self._alignment.scale
        low = lit_window(self._lrhs[RGB], self.grid, reach)
        high = lit_window(self._hr.read(self._hr.data_window, [RGB])[RGB], self._alignment.hr_data_window, 0)
        if low is None or high is None:
            return None
        whole = Window(high.x0 // scale, high.y0 // scale, -(-high.x1 // scale), -(-high.y1 // scale))
        return low.union(whole).intersect(self.grid)


def _variance_of_colours(hrls: Images) -> Array | None:
    """Return the variance of a render (h, w, 3); None if it has none, or one of luminance, which tells no colours."""
    variance = hrls.get(VARIANCE)
    return variance if variance is not None and variance.shape[-1] == 3 else None


def alpha_as_colour(render: Images) -> Images:
    """Return albedo and normal of a render, with its alpha as a grey colour."""
    grey = np.repeat(np.clip(render["alpha"], 0.0, 1.0), 3, axis=-1)
    return {name: render[name] for name in (ALBEDO, NORMAL) if name in render} | {RGB: grey}
