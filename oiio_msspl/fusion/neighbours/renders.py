# SPDX-License-Identifier: Apache-2.0
"""Averages both renders of a frame with those of its neighbours, before they are fused.

This is as if the frame had more samples. The network then sees less noise, so it keeps detail that an average of fused
frames no longer has. A neighbour counts where it shows the same surface in the same light, as in
:mod:`oiio_msspl.fusion.neighbours.results`.

- The HRLS's pixels are fetched from the nearest pixel of the neighbour. Interpolation would spread their noise, which
  networks take for texture.
- The LRHS has less noise, and its pixels are large. Its light and alpha are interpolated. Other layers, such as the
  albedo, have hardly any noise to remove, and are fetched from the nearest pixel, which takes less time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import LIGHT_OF, RADIANCE_FEATURES, RGB, VARIANCE, is_light_of_pass
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.exr.render import ReadableRender, Render, Window
from oiio_msspl.fusion.checks.pair import bounded_luminance
from oiio_msspl.fusion.neighbours.bands import for_bands, from_grid, grid_rows, rows_in_bands, to_grid
from oiio_msspl.fusion.neighbours.path import Path, Step
from oiio_msspl.fusion.neighbours.trust import Light, relative_difference
from oiio_msspl.fusion.neighbours.weights import Rows, WeightedSum, rows_of
from oiio_msspl.fusion.tiles.alignment import Alignment, align
from oiio_msspl.fusion.tiles.features import RepairCounts, read_lrhs
from oiio_msspl.image.arrays import Array, Mask, blank, repair, unload
from oiio_msspl.image.filters import grown, interpolate, means_around
from oiio_msspl.image.parallel import for_row_blocks
from oiio_msspl.image.sampling import nearest_indices, sample_cubic

#: An LRHS pixel of a neighbour counts if this share of its HRLS pixels shows the same surface.
COVERED = 0.9
#: A neighbour counts less near objects that move and are not followed: less the more of the HRLS pixels up to so many
#: away on each side show them, and not at all from this share on.
NEAR_OBJECTS, FEW = 8, 0.125
#: Where another surface is near, a neighbour counts half if it is brighter or darker by this: the difference, divided
#: by the root of the product. That is a factor of 5.
OTHER_BRIGHTNESS = np.float32(4 / np.sqrt(5))
#: There, a neighbour counts less by this, too. It lacks some pixels, so the noise changes from pixel to pixel, and the
#: network takes single noisy pixels for detail.
BESIDE_HIDDEN = np.float32(0.7)
#: Memory for each pixel of the rows that are averaged at a time, beside their features.
BYTES_PER_PIXEL = 44
#: With more channels, as passes have, bands have fewer rows.
USUAL_CHANNELS = 10

Features = dict[str, Array]


@dataclass(frozen=True)
class RenderPair:
    """Both renders of a frame."""

    lr: ReadableRender
    hr: ReadableRender

    @cached_property
    def alignment(self) -> Alignment:
        """How the pair lies over each other."""
        return align(self.lr, self.hr)

    @cached_property
    def luminances(self) -> tuple[Array, Array]:
        """Luminance of the LRHS, and of the HRLS averaged over its pixels, (h, w) each over the alignment's grid.

        Both show the same places: where an odd size was rounded, the LRHS is interpolated.
        """
        alignment = self.alignment
        lrhs = read_lrhs(self.lr, alignment, alignment.grid, [RGB], RepairCounts(), exact=True)[RGB]
        high = for_bands(alignment, lambda core, _: to_grid(alignment, self.read_hr_luminance(core), core))
        return bounded_luminance(lrhs), np.concatenate(high)

    @cached_property
    def hr_luminance(self) -> Array | None:
        """Luminance (h, w) of the HRLS over its data window, finite and >= 0; None if its pixels are not in memory."""
        if not isinstance(self.hr, Render):
            return None
        rgb = np.asarray(self.hr.layers[RGB])
        result: Array = blank(rgb.shape[:2])

        def work(rows: slice) -> None:
            result[rows] = _luminance(rgb[rows])

        for_row_blocks(work, len(rgb), rgb[0].size)
        unload(result)
        return result

    def read_hr_luminance(self, window: Window) -> Array:
        """The same over a window that is relative to the top left of the display window, in memory or not."""
        if self.hr_luminance is None:
            return _luminance(_read(self.hr, window, [RGB])[RGB])
        return np.asarray(self.hr_luminance)[window.slices(self.alignment.hr_data_window)]

    @cached_property
    def hr_is_finite(self) -> bool:
        """Whether all pixels of the HRLS are known to be finite: its layers are in memory, and were looked at."""
        return isinstance(self.hr, Render) and _finite_pixels(self.hr.layers) is None

    def unload(self) -> None:
        """Give the memory of pixels that wait in temporary files back to the system."""
        self.lr.unload()
        self.hr.unload()
        if self.hr_luminance is not None:
            unload(self.hr_luminance)


@dataclass(frozen=True)
class AveragedPair:
    """Both renders, averaged with their neighbours."""

    lr: Render
    hr: Render
    frames: Array
    """(h, w, 1) over the HRLS's data window: the number of frames with equal weight whose mean would have as little
    noise: 1 where the frame stands alone."""


def average_renders(
    pair: RenderPair,
    before: Sequence[Step[RenderPair]],
    after: Sequence[Step[RenderPair]],
    features: Sequence[str] | None = None,
) -> AveragedPair:
    """Average both renders of a frame with those of its neighbours.

    A value that no neighbour may change keeps its bits. Where a neighbour is NaN or infinite, it does not count.

    Args:
        pair: the frame.
        before: steps to the frame before it, to the one before that, and so on. All have the features of the frame.
        after: steps to the frames after it, the nearest first.
        features: what the result is to have, as far as the renders have it; all if None.

    Raises:
        InputError: pixels can't be decoded.
    """
    alignment = pair.alignment
    window = alignment.hr_data_window
    lrhs, hrls = pair.luminances
    light = Light(alignment, lrhs, hrls, lrhs)
    low = {name: values.copy() for name, values in _read(pair.lr, alignment.lr_data_window, features).items()}
    row = _read(pair.hr, Window(window.x0, window.y0, window.x1, window.y0 + 1), features)
    high: Features = {name: blank((window.height, window.width, values.shape[-1])) for name, values in row.items()}
    frames: Array = blank((window.height, window.width, 1))

    def average(core: Window, area: Window) -> None:
        target = core.slices(window)
        band = _Band(pair, core, area, light, {name: image[target] for name, image in high.items()}, low)
        for steps in (before, after):
            band.add(steps)
        frames[target] = band.finish()
        for image in (*high.values(), frames):
            unload(image)
        pair.unload()

    for_bands(alignment, average, _weight(sum(image.shape[-1] for image in high.values())))
    return AveragedPair(_replaced(pair.lr, low), _replaced(pair.hr, high), frames)


def shared_noise(frame: RenderPair, other: RenderPair) -> float:
    """Correlation, from -1 to 1, of the signs of the noise of two frames: of what their LRHS and HRLS differ by.

    A renderer that uses one seed for all frames gives each pixel the same noise in all of them. Only signs are
    compared: at edges the two renders differ by more than noise, in every frame if the camera stands still. 0 for
    frames whose pixels lie over different places.

    Raises:
        InputError: pixels can't be decoded.
    """
    both = [each.luminances for each in (frame, other)]
    if frame.alignment.grid != other.alignment.grid:
        return 0.0
    first, second = (np.sign(low - high) for low, high in both)
    alike = first * second
    count = np.count_nonzero(alike)
    return float(alike.sum(dtype=np.float64) / count) if count else 0.0


def lacking_passes(frame: RenderPair, other: RenderPair) -> list[str]:
    """Names of the passes of a frame's renders that those of another frame lack."""
    both = ((frame.lr, other.lr), (frame.hr, other.hr))
    lacking = {name for own, its in both for name in feature_names(own) - feature_names(its) if is_light_of_pass(name)}
    return sorted(name.removeprefix(LIGHT_OF) for name in lacking)


def feature_names(render: ReadableRender) -> set[str]:
    """The features of a render in memory, or of a file whose layers are mapped."""
    if isinstance(render, Render):
        return set(render.layers)
    return set(render.features) if isinstance(render, MappedRender) else set()


def memory_to_average(window: Window, channels: int) -> int:
    """Bytes that :func:`average_renders` needs beside its arguments and its result.

    Args:
        window: the HRLS's data window.
        channels: of the HRLS's features.
    """
    rows = rows_in_bands(window, _weight(channels))
    return rows * window.width * (BYTES_PER_PIXEL + 4 * channels)


def _weight(channels: int) -> float:
    """See :func:`oiio_msspl.fusion.neighbours.bands.for_bands`."""
    usual, needed = (BYTES_PER_PIXEL + 4 * count for count in (USUAL_CHANNELS, channels))
    return max(1.0, needed / usual)


class _Band:
    """Some rows of a frame."""

    def __init__(
        self, pair: RenderPair, core: Window, area: Window, light: Light, high: Features, low: Features
    ) -> None:
        """
        Args:
            core, area: see :func:`oiio_msspl.fusion.neighbours.bands.for_bands`.
            high: gets the HRLS's features over ``core``.
            low: the LRHS's features over its data window; the rows of ``core`` are changed.
        """
        self._area, self._light = area, light
        self._features, self._low_features = list(high), list(low)
        self._alignment = alignment = pair.alignment
        #: The rows of ``core`` in the area.
        self._rows = slice(core.y0 - area.y0, core.y1 - area.y0)
        grid = alignment.grid
        rows, core_rows = (grid_rows(alignment, each) for each in (area, core))
        #: The grid pixels of the area.
        self._grid = Window(grid.x0, grid.y0 + rows.start, grid.x1, grid.y0 + rows.stop)
        for name, values in _read(pair.hr, core, self._features).items():
            high[name][:] = values
        self._high = WeightedSum(high)
        self._luminance = pair.read_hr_luminance(area)
        self._low_luminance = pair.luminances[0][rows]
        core_grid = Window(grid.x0, grid.y0 + core_rows.start, grid.x1, grid.y0 + core_rows.stop)
        #: The LRHS may lack a row or a column of the grid.
        self._low_place = core_grid.intersect(alignment.lr_data_window)
        inside = self._low_place.slices(alignment.lr_data_window)
        self._low = WeightedSum({name: image[inside] for name, image in low.items()})

    def add(self, steps: Sequence[Step[RenderPair]]) -> None:
        """Add the neighbours on one side."""
        path = Path(self._area, self._alignment.hr_data_window)
        trusted: Array | None = None
        for step in steps:
            path.follow(step)
            high = _Nearest(step.frame, path, self._features)
            valid = high.finite() & path.valid
            share = to_grid(self._alignment, valid.astype(np.float32), self._area)
            low, usable = self._fetch_low(step.frame, path, valid, share)
            usable &= _make_finite(low)
            own = self._luminance
            hrls = to_grid(self._alignment, np.where(valid, high.luminance(), own), self._area)
            lrhs = self._in_grid(_luminance(low[RGB]), usable, step.frame.alignment.stretch)
            trust = self._light.trust(lrhs, hrls, self._area)
            # A light that has changed in the nearer frame has changed in the farther one.
            trusted = trust if trusted is None else np.minimum(trusted, trust)
            counted = trusted if path.moved_objects is None else trusted * self._far_from(path.moved_objects)
            hidden = grown(share < 1, 2)
            counted = counted * np.where(hidden, BESIDE_HIDDEN * self._as_bright(lrhs), np.float32(1))
            weight = from_grid(self._alignment, counted, self._area) * valid
            self._high.add(high.below(self._rows.start), weight[self._rows])
            place = self._low_place.slices(self._grid)
            self._low.add(rows_of({name: values[place] for name, values in low.items()}), (counted * usable)[place])
            step.frame.unload()

    def _in_grid(self, lrhs: Array, usable: Mask, stretch: tuple[float, float]) -> Array:
        """Luminance (h, w) of a neighbour's LRHS at the places of the grid pixels; that of the frame where the
        neighbour has none that is ``usable``.

        Args:
            lrhs: the same at LRHS pixels, which lie elsewhere if a size was rounded.
            stretch: of the neighbour, see :attr:`Alignment.stretch`.
        """
        if stretch != (1.0, 1.0):
            grid = self._grid
            columns, rows = (
                np.arange(start + 0.5, stop) * size - 0.5 - start
                for start, stop, size in zip((grid.x0, grid.y0), (grid.x1, grid.y1), stretch, strict=True)
            )
            lrhs, share = (
                interpolate(interpolate(plane, rows, 0), columns, 1) for plane in (lrhs, usable.astype(np.float32))
            )
            usable = share > 0.999  # a sum of shares may be rounded
        return np.where(usable, lrhs, self._low_luminance)

    def _far_from(self, moved_objects: Mask) -> Array:
        """How much a neighbour counts around objects that are not followed: 0 to 1, (h, w) at the LRHS's resolution.

        Beside them it does not count. Otherwise the noise would change from pixel to pixel, and the network takes
        single noisy pixels for detail.
        """
        share = to_grid(self._alignment, moved_objects.astype(np.float32), self._area)
        (near,) = means_around(share, [max(1, round(NEAR_OBJECTS / self._alignment.scale))])
        return np.maximum(1 - near / np.float32(FEW), 0)

    def _as_bright(self, lrhs: Array) -> Array:
        """How much a neighbour counts by the luminance (h, w) of its LRHS, where it may show another surface, too."""
        difference = relative_difference(self._low_luminance, lrhs, self._light.darkest) / OTHER_BRIGHTNESS
        with np.errstate(over="ignore"):
            return np.asarray(1 / (1 + np.square(np.square(difference))), np.float32)

    def finish(self) -> Array:
        """Turn the sums into means. Returns the number of frames of each pixel, as :attr:`AveragedPair.frames`."""
        self._low.divide()
        return self._high.divide()

    def _fetch_low(self, frame: RenderPair, path: Path, valid: Mask, share: Array) -> tuple[Features, Mask]:
        """The neighbour's LRHS over the grid pixels, moved as their HRLS pixels are on average; and which of these can
        be used, because they lie in it and enough of their HRLS pixels show the same surface."""
        data, grid, scale = frame.alignment.lr_data_window, self._grid, self._alignment.scale
        x, y = np.broadcast_arrays(
            np.arange(grid.x0, grid.x1, dtype=np.float32), np.arange(grid.y0, grid.y1, dtype=np.float32)[:, None]
        )
        if path.x is not None and path.y is not None:
            area = self._area
            here = Path(area, area).positions(slice(0, area.height))
            moved = [_difference(to, at, valid) for to, at in zip((path.x, path.y), here, strict=True)]
            pixels = np.maximum(share, 1e-6) * np.float32(scale)
            x, y = (
                own + to_grid(self._alignment, each, area) / pixels for own, each in zip((x, y), moved, strict=True)
            )
        usable = (x > data.x0 - 0.5) & (x < data.x1 - 0.5) & (y > data.y0 - 0.5) & (y < data.y1 - 0.5)
        usable &= share >= COVERED
        x, y = np.clip(x, data.x0, data.x1 - 1), np.clip(y, data.y0, data.y1 - 1)
        top = max(int(np.floor(y.min())) - 1, data.y0)
        bottom = min(int(np.floor(y.max())) + 3, data.y1)
        place = Window(data.x0, top, data.x1, bottom)
        stored = _with_finite_passes(_read(frame.lr, place, self._low_features))
        x, y = x - place.x0, y - place.y0
        if path.x is None:
            rows, columns = y[:, 0].astype(int), x[0].astype(int)
            return {name: values[rows].take(columns, axis=1) for name, values in stored.items()}, usable

        def positions(rows: slice) -> tuple[Array, Array]:
            return x[rows], y[rows]

        light = (*RADIANCE_FEATURES, VARIANCE, "alpha")
        names = [name for name in stored if name in light or is_light_of_pass(name)]
        smooth = sample_cubic([stored.pop(name) for name in names], positions, x.shape, usable)
        return _nearest_pixels(stored, positions, x.shape) | dict(zip(names, smooth, strict=True)), usable


def _difference(to: Array, at: Array, valid: Mask) -> Array:
    """``to - at`` where it is valid, otherwise 0, (h, w)."""
    result = np.empty(to.shape, np.float32)

    def work(rows: slice) -> None:
        np.subtract(to[rows], at[rows], out=result[rows])
        result[rows] *= valid[rows]

    for_row_blocks(work, len(to), to[0].size)
    return result


class _Nearest:
    """A neighbour's HRLS at the pixels that are nearest to the positions of a path.

    Args:
        frame: the neighbour.
        path: leads to it.
        features: names.
    """

    def __init__(self, frame: RenderPair, path: Path, features: Sequence[str]) -> None:
        window = frame.alignment.hr_data_window
        place = path.place_in(window)
        self._size = path.valid.shape
        pixels = _read(frame.hr, place, features)
        if not frame.hr_is_finite:
            pixels = _with_finite_passes(pixels)
        self._planes = {name: _flat_planes(values) for name, values in pixels.items()}
        #: Flat indices in the data window; these pixels begin at ``_first``.
        self._nearest, self._first = path.nearest, (place.y0 - window.y0) * window.width
        self._finite = None if frame.hr_is_finite else _finite_pixels(pixels)
        self._luminance = None if frame.hr_luminance is None else frame.read_hr_luminance(place).reshape(-1)

    def finite(self) -> Mask:
        """Where all features are finite, (h, w)."""
        if self._finite is None:
            return np.ones(self._size, bool)
        return self._finite.take(self._indices(slice(0, self._size[0])))

    def luminance(self) -> Array:
        """Luminance (h, w) of the beauty, finite and >= 0."""
        result = np.empty(self._size, np.float32)

        def work(rows: slice) -> None:
            if self._luminance is None:
                result[rows] = _luminance(self._pixels(RGB, rows))
            else:
                self._luminance.take(self._indices(rows), out=result[rows], mode="wrap")

        for_row_blocks(work, self._size[0], 3 * self._size[1])
        return result

    def below(self, first: int) -> Rows:
        """The pixels, with rows that are counted from ``first`` on."""
        return lambda name, rows: self._pixels(name, slice(first + rows.start, first + rows.stop))

    def _indices(self, rows: slice) -> NDArray[np.intp]:
        """Flat indices of the nearest pixels at some rows (n, w)."""
        if self._nearest is not None:
            return self._nearest[rows] - self._first
        width = self._size[1]
        first, last, _ = rows.indices(self._size[0])
        return np.arange(first * width, last * width, dtype=np.intp).reshape(-1, width)

    def _pixels(self, name: str, rows: slice) -> Array:
        """A feature at some rows (n, w, c). Pixels that are not finite are 0."""
        at = self._indices(rows)
        values = np.empty((len(self._planes[name]), *at.shape), np.float32)
        for plane, out in zip(self._planes[name], values, strict=True):
            # "wrap" makes NumPy write straight into the result; no index needs it.
            plane.take(at, out=out, mode="wrap")
        if self._finite is not None:
            values[:, ~self._finite.take(at)] = 0
        return np.moveaxis(values, 0, -1)


def _nearest_pixels(
    features: Features, positions: Callable[[slice], tuple[Array, Array]], size: tuple[int, int]
) -> Features:
    """The pixels of features that are nearest to positions in them; the arguments are those of
    :func:`oiio_msspl.image.sampling.sample_cubic`."""
    height, width = size
    flat = {name: _flat_planes(values) for name, values in features.items()}
    result = {name: np.empty((len(planes), height, width), np.float32) for name, planes in flat.items()}
    shape = next((values.shape[:2] for values in features.values()), (1, 1))

    def work(rows: slice) -> None:
        at = nearest_indices(*positions(rows), shape)
        for name, planes in flat.items():
            for plane, out in zip(planes, result[name][:, rows], strict=True):
                plane.take(at, out=out, mode="wrap")  # "wrap" writes straight into the result

    for_row_blocks(work, height if flat else 0, width * sum(len(planes) for planes in flat.values()))
    return {name: np.moveaxis(values, 0, -1) for name, values in result.items()}


def _flat_planes(image: Array) -> list[Array]:
    """The channels of an image (h, w, c), (h * w) each, which are copied only if their pixels are apart in memory."""
    return [np.asarray(plane).reshape(-1) for plane in np.moveaxis(image, -1, 0)]


def _with_finite_passes(features: Features) -> Features:
    """Features of a neighbour whose passes are repaired, so that a broken pixel of a pass does not count against the
    beauty."""
    return {name: repair(v, signed=True)[0] if is_light_of_pass(name) else v for name, v in features.items()}


def _make_finite(features: Features) -> Mask:
    """Where all features are finite, (h, w). Other pixels are set to 0."""
    finite = _finite_pixels(features)
    if finite is None:
        return np.ones(next(iter(features.values())).shape[:2], bool)
    for name, values in features.items():
        features[name] = np.where(finite[..., None], values, np.float32(0))
    return finite


def _finite_pixels(features: Features) -> Mask | None:
    """Where all features (..., c) are finite, (...); None if they are everywhere."""
    # The extremes of an image are found ten times as fast as its pixels are tested.
    doubtful = [values for values in features.values() if not np.isfinite([values.min(), values.max()]).all()]
    return np.logical_and.reduce([np.isfinite(values).all(axis=-1) for values in doubtful]) if doubtful else None


def _luminance(rgb: Array) -> Array:
    """Luminance (h, w) of a beauty (h, w, 3), finite and >= 0."""
    return bounded_luminance(repair(rgb)[0])


def _read(render: ReadableRender, window: Window, features: Sequence[str] | None = None) -> Features:
    """Features over a window that is relative to the top left of the display window."""
    return render.read(window.shift(render.display_window.x0, render.display_window.y0), features)


def _replaced(render: ReadableRender, layers: Features) -> Render:
    """A render with other pixels."""
    return Render(layers, render.data_window, render.display_window, render.pixel_aspect, name=render.name)
