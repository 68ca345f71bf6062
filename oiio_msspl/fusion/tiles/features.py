# SPDX-License-Identifier: Apache-2.0
"""The features of a tile: read from both renders, repaired, and mirrored where the tile reaches beyond the frame."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import NORMAL, RGB
from oiio_msspl.aovs.mapped_render import ReadableRender
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.fusion.tiles.tiling import Tile
from oiio_msspl.image.arrays import HALF_MAX, Array, Mask, repair
from oiio_msspl.image.filters import box_downsample, enlarged, filled, in_squares, interpolate, max_around

Indices = NDArray[np.int64]
T = TypeVar("T", bound=np.generic)
#: Numbers of values of a render that were changed, by kind and feature: ``repaired`` ones were NaN or infinite, and
#: ``negative`` ones, colours out of gamut, were set to 0.
RepairCounts = Counter[tuple[str, str]]

#: A pixel may be at most this many times as bright as the brightest of the 3 x 3 LRHS pixels around it in the other
#: render, except for rare light (:mod:`oiio_msspl.fusion.tiles.guards`). The LRHS is the mean of s x s HRLS pixels, so
#: s^2 would be the exact bound without noise. At 64, rooms lose up to 4 % of their light at 1 spp.
FIREFLY_FACTOR = 256.0
#: A bucket that failed spans at least this many HRLS pixels and LRHS pixels on a side, and this fraction of the other
#: render's pixels is lit there. If fewer are, or in smaller squares, rare light may miss all pixels by chance.
BUCKET_HRLS, BUCKET_LRHS, BUCKET_LIT = 16, 4, 0.75


@dataclass
class TileFeatures:
    """The features of both renders over one tile."""

    lrhs: dict[str, Array]
    """Features (h, w, c) over the tile's area."""
    hrls: dict[str, Array]
    """Features (s*h, s*w, c) over the tile's area."""
    scale: int
    lrhs_area: Window
    """The tile's area in LRHS pixels."""
    hrls_area: Window
    """The tile's area in HRLS pixels."""
    hrls_target: Window
    """The part of the HRLS's data window that the tile contributes."""
    core: Window
    """The LRHS pixels that the tile contributes and that are inside the alignment's grid."""
    inside: tuple[slice, slice]
    """Rows and columns of ``lrhs`` that are inside the alignment's grid. Others only fill the tile up to its size."""
    hrls_is_lost: bool = False
    """All pixels of the HRLS's beauty are broken, so it is filled from the LRHS."""
    failed: tuple[Mask, Mask] | None = None
    """LRHS pixels (h, w) in buckets that failed, of the LRHS and of the HRLS; None if there are none."""
    borrowed: Mask | None = None
    """LRHS pixels (h, w) in which one render has the light of the other one; None if there are none."""


def read_tile(
    tile: Tile,
    lrhs: dict[str, Array],
    grid: Window,
    hr: ReadableRender,
    alignment: Alignment,
    features: Iterable[str],
    counts: RepairCounts | None = None,
) -> TileFeatures:
    """Read both renders over a tile.

    Where the beauty of one render is broken, or a bucket failed, it gets the light of the other render.

    Args:
        lrhs: features of the LRHS over ``grid``, see :func:`read_lrhs`.
        features: names of the HRLS's features to read.
        counts: gets the numbers of repaired values in the tile's core.
    """
    scale = alignment.scale
    area, core = in_hrls_pixels(tile.area, scale), in_hrls_pixels(tile.core, scale)
    window = tile.area.slices(grid)
    broken: dict[str, Mask] = {}
    low = {name: values[window] for name, values in lrhs.items()}
    hrls = read_features(hr, area, alignment.hr_data_window, features, counts=counts, counted=core, broken=broken)
    lost = _infinite(hrls[RGB])
    if lost.any():
        lost &= ~_as_bright(low[RGB]).repeat(scale, axis=0).repeat(scale, axis=1)
    lost |= broken.get(RGB, False)
    if lost.any():
        hrls[RGB] = np.where(lost[..., None], enlarged(low[RGB], scale), hrls[RGB])
    failed = _failed_buckets(low[RGB], hrls[RGB], scale)
    if failed is not None:
        in_bucket = max_around(failed[1]).repeat(scale, axis=0).repeat(scale, axis=1)
        dead = in_bucket & _is_dead(hrls[RGB])
        hrls[RGB] = np.where(dead[..., None], enlarged(low[RGB], scale), hrls[RGB])
        for name in hrls.keys() - {RGB}:
            hrls[name] = filled(hrls[name], in_bucket & ~hrls[name].any(axis=-1))
        lost |= dead
    lost_below = _infinite(low[RGB])
    if failed is not None or lost_below.any():
        means = box_downsample(hrls[RGB], scale)
        lost_below &= ~_as_bright(means)
        if failed is not None:
            lost_below |= failed[0]
        low[RGB] = np.where(lost_below[..., None], means, low[RGB])
    borrowed = lost_below | lost.reshape(len(lost_below), scale, -1, scale).any(axis=(1, 3))
    return TileFeatures(
        lrhs=low,
        hrls=hrls,
        scale=scale,
        lrhs_area=tile.area,
        hrls_area=area,
        hrls_target=core.intersect(alignment.hr_data_window),
        core=tile.core.intersect(alignment.grid),
        inside=tile.area.intersect(alignment.grid).slices(tile.area),
        hrls_is_lost=bool(lost.all()),
        failed=failed,
        borrowed=borrowed if borrowed.any() else None,
    )


def _failed_buckets(low: Array, high: Array, scale: int) -> tuple[Mask, Mask] | None:
    """Return :attr:`TileFeatures.failed`: one render is dead in a whole square, and hardly a pixel of the other is."""
    dead_low, dead_high = _is_dead(low), _is_dead(high)
    if not dead_low.any() and not dead_high.any():
        return None
    dead_high = np.asarray(dead_high.reshape(len(low), scale, -1, scale).all(axis=(1, 3)))
    side = bucket_side(scale)
    low_alone = in_squares(dead_low, ~dead_high, side, BUCKET_LIT)
    high_alone = in_squares(dead_high, ~dead_low, side, BUCKET_LIT)
    return (low_alone, high_alone) if low_alone.any() or high_alone.any() else None


def bucket_side(scale: int) -> int:
    """Return the side of the smallest bucket that is noticed, in LRHS pixels."""
    return max(BUCKET_LRHS, BUCKET_HRLS // scale)


def _is_dead(rgb: Array) -> Mask:
    """Return the pixels (h, w) without green whose red and blue are equal: black, or magenta as of missing shaders."""
    return np.logical_and(rgb[..., 1] == 0, rgb[..., 0] == rgb[..., 2])


def _infinite(rgb: Array) -> Mask:
    """Return where pixels (h, w) of a repaired beauty were infinite: as bright as half floats can be."""
    return np.logical_or.reduce([rgb[..., c] == HALF_MAX for c in range(3)])


def _as_bright(rgb: Array) -> Mask:
    """Return where the 3 x 3 pixels of one render (h, w, 3) confirm an infinite pixel of the other as a lamp."""
    return max_around(rgb).max(axis=-1) >= HALF_MAX / FIREFLY_FACTOR


def read_lrhs(
    lr: ReadableRender,
    alignment: Alignment,
    grid: Window,
    features: Iterable[str],
    counts: RepairCounts | None = None,
    *,
    exact: bool = False,
) -> dict[str, Array]:
    """Read features of the LRHS over ``grid``. Features that it lacks are left out.

    Each grid pixel gets the LRHS pixel that is nearest to the mean position of its HRLS pixels: half an LRHS pixel off
    at most, if an odd size was rounded. Interpolated neighbours would share their noise, and networks take such noise
    for texture. The LRHS is interpolated only where the HRLS is mirrored.

    Args:
        counts: gets the numbers of repaired values.
        exact: interpolate everywhere, for comparisons of both renders.
    """
    data, scale = alignment.lr_data_window, alignment.scale
    hrls_rows, hrls_columns = _mirrored_pixels(in_hrls_pixels(grid, scale), alignment.hr_data_window)
    rows = np.clip(_lrhs_positions(hrls_rows, scale, alignment.stretch[1], exact), data.y0, data.y1 - 1)
    columns = np.clip(_lrhs_positions(hrls_columns, scale, alignment.stretch[0], exact), data.x0, data.x1 - 1)
    y0, x0 = int(np.floor(rows.min())), int(np.floor(columns.min()))
    stored = Window(x0, y0, int(np.ceil(columns.max())) + 1, int(np.ceil(rows.max())) + 1)
    layers = read_features(lr, stored, data, features, counts=counts, counted=stored)
    return {name: interpolate(interpolate(v, rows - y0, 0), columns - x0, 1) for name, v in layers.items()}


def _lrhs_positions(hrls_pixels: Indices, scale: int, stretch: float, exact: bool) -> NDArray[np.float64]:
    """Return the mean position of every ``scale`` HRLS pixels, in LRHS pixels; rounded unless mirrored or ``exact``."""
    groups = hrls_pixels.reshape(-1, scale)
    positions = (groups.mean(axis=1) + 0.5) / scale * stretch - 0.5
    in_place = (groups[:, 0] % scale == 0) & (groups[:, -1] - groups[:, 0] == scale - 1)
    return positions if exact else np.where(in_place, np.rint(positions), positions)


def read_features(
    render: ReadableRender,
    window: Window,
    data_window: Window,
    features: Iterable[str] | None = None,
    *,
    counts: RepairCounts | None = None,
    counted: Window | None = None,
    broken: dict[str, Mask] | None = None,
) -> dict[str, Array]:
    """Read and repair features over a window. Beyond the data window the picture is mirrored.

    Repeating the last pixel would turn its noise into lines, which networks take for texture. Pixels that are NaN or
    minus infinity are filled from those around (:func:`oiio_msspl.image.filters.filled`).

    Args:
        window, data_window: both relative to the top left of the display window.
        features: names of features; all if None. Features that the render lacks are left out.
        counts: gets the numbers of repaired values inside ``counted``. Overlaps of tiles are read twice.
        broken: gets a mask (h, w) of the filled pixels, for each feature that has some.
    """
    rows, columns = _mirrored_pixels(window, data_window)
    stored = Window(int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1)
    layers = render.read(stored.shift(render.display_window.x0, render.display_window.y0), features)
    result = {}
    for name, values in layers.items():
        repaired, bad = repair(values, signed=name == NORMAL)
        if bad is not None:
            if counts is not None and counted is not None:
                inside = counted.intersect(stored).slices(stored)
                lost = int(np.count_nonzero(~np.isfinite(values[inside])))
                counts["repaired", name] += lost
                counts["negative", name] += int(np.count_nonzero(bad[inside])) - lost
            missing = np.any(np.isnan(values) | np.isneginf(values), axis=-1)
            repaired = filled(repaired, missing)
            if broken is not None:
                broken[name] = _at(missing, rows - stored.y0, columns - stored.x0)
        result[name] = _at(repaired, rows - stored.y0, columns - stored.x0)
    return result


def mirrored(image: NDArray[T], inside: Window, window: Window) -> NDArray[T]:
    """Return an image (h, w, ...) over ``inside`` at the pixels of ``window``, mirrored beyond ``inside``."""
    rows, columns = _mirrored_pixels(window, inside)
    return _at(image, rows - inside.y0, columns - inside.x0)


def _at(values: NDArray[T], rows: Indices, columns: Indices) -> NDArray[T]:
    """Return some rows and columns of an image (h, w, ...), in its layout in memory."""
    for axis, indices in enumerate((rows, columns)):
        lines = values.swapaxes(0, axis)
        # Nearly all lines follow each other. Copying these together is faster than taking each one.
        breaks = np.flatnonzero(np.diff(indices) != 1) + 1
        chosen = lines[indices[0] : indices[-1] + 1]
        if breaks.size:
            chosen = np.empty_like(lines, shape=(len(indices), *lines.shape[1:]))
            for start, stop in itertools.pairwise([0, *breaks, len(indices)]):
                chosen[start:stop] = lines[indices[start] : indices[start] + stop - start]
        values = chosen.swapaxes(0, axis)
    return values


def _mirrored_pixels(window: Window, inside: Window) -> tuple[Indices, Indices]:
    """Return the rows and columns of ``inside`` that a window shows if the picture is mirrored at its sides."""
    rows = (np.arange(window.y0, window.y1) - inside.y0) % (2 * inside.height)
    columns = (np.arange(window.x0, window.x1) - inside.x0) % (2 * inside.width)
    return (
        inside.y0 + np.minimum(rows, 2 * inside.height - 1 - rows),
        inside.x0 + np.minimum(columns, 2 * inside.width - 1 - columns),
    )


def in_hrls_pixels(window: Window, scale: int) -> Window:
    """Return a window of LRHS pixels in HRLS pixels."""
    return Window(window.x0 * scale, window.y0 * scale, window.x1 * scale, window.y1 * scale)
