# SPDX-License-Identifier: Apache-2.0
"""Averages both renders of a frame with those of its neighbours, before they are fused.

This is as if the frame had more samples. The network then sees less noise, so it keeps detail that an average of fused
frames no longer has. A neighbour counts where it shows the same surface in the same light, as in
:mod:`oiio_msspl.fusion.temporal`.

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

from oiio_msspl.aovs.features import RADIANCE_FEATURES, RGB, VARIANCE
from oiio_msspl.arrays import Array, blank, repair
from oiio_msspl.exr.render import ReadableRender, Render, Window
from oiio_msspl.fusion.alignment import Alignment, align
from oiio_msspl.fusion.light import Light, bands, from_grid, grid_rows, rows_in_bands, to_grid
from oiio_msspl.fusion.pair_checks import bounded_luminance
from oiio_msspl.fusion.tile_features import RepairCounts, read_lrhs
from oiio_msspl.fusion.warp import Mask, Path, Step, nearest, sample
from oiio_msspl.parallel import for_row_blocks

#: An LRHS pixel of a neighbour counts if this share of its HRLS pixels shows the same surface.
COVERED = 0.9
#: Memory for each pixel of the rows that are averaged at a time, beside their features.
BYTES_PER_PIXEL = 80

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
        """Luminance of the LRHS, and of the HRLS averaged over its pixels, (h, w) each over the alignment's grid."""
        alignment = self.alignment
        lrhs = read_lrhs(self.lr, alignment, alignment.grid, [RGB], RepairCounts())[RGB]
        high = [to_grid(alignment, _luminance(_read(self.hr, core, [RGB])), core) for core, _ in bands(alignment)]
        return bounded_luminance(lrhs), np.concatenate(high)


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
    high: Features = {}
    frames: Array = blank((window.height, window.width, 1))
    for core, area in bands(alignment):
        band = _Band(pair, area, light, features)
        for steps in (before, after):
            band.add(steps)
        inside, target = core.slices(area), core.slices(window)
        for name, values in band.high.means(inside).items():
            if name not in high:
                high[name] = blank((window.height, window.width, values.shape[-1]))
            high[name][target] = values
        frames[target] = band.high.frames(inside)
        band.put_low(low, core)
    return AveragedPair(_replaced(pair.lr, low), _replaced(pair.hr, high), frames)


def shared_noise(frame: RenderPair, other: RenderPair) -> float:
    """Correlation, from -1 to 1, of the noise of two frames: of what their LRHS and HRLS differ by.

    A renderer that uses one seed for all frames gives each pixel the same noise in all of them. 0 for frames whose
    pixels lie over different places.

    Raises:
        InputError: pixels can't be decoded.
    """
    noise, both = [], [each.luminances for each in (frame, other)]
    if frame.alignment.grid != other.alignment.grid:
        return 0.0
    for low, high in both:
        light = low + high
        # The difference relative to the light is at most 1, so fireflies do not decide.
        noise.append(np.divide(low - high, light, out=np.zeros_like(light), where=light > 0).ravel())
    lengths = np.linalg.norm(noise[0]) * np.linalg.norm(noise[1])
    return float(np.dot(*noise) / lengths) if lengths > 0 else 0.0


def memory_to_average(window: Window, channels: int) -> int:
    """Bytes that :func:`average_renders` needs beside its arguments and its result.

    Args:
        window: the HRLS's data window.
        channels: of the HRLS's features.
    """
    return rows_in_bands(window) * window.width * (BYTES_PER_PIXEL + 2 * 4 * channels)


class _Sum:
    """Weighted sums of features over a rectangle, and of their weights."""

    def __init__(self, own: Features) -> None:
        self._totals = {name: values.copy() for name, values in own.items()}
        shape = next(iter(own.values())).shape[:2]
        self._weights = np.ones(shape, np.float32)
        self._squares = np.ones_like(self._weights)

    def add(self, features: Features, weight: Array) -> None:
        """Add finite features with a weight (h, w)."""
        width = sum(values.shape[-1] for values in features.values())

        def work(rows: slice) -> None:
            part = weight[rows]
            square = np.square(part)
            self._weights[rows] += part
            self._squares[rows] += square
            with np.errstate(over="ignore", invalid="ignore"):  # the frame's own pixels may be NaN or infinite
                for name, total in self._totals.items():
                    total[rows] += (square if name == VARIANCE else part)[..., None] * features[name][rows]

        for_row_blocks(work, len(weight), weight.shape[1] * width)

    def means(self, part: tuple[slice, slice]) -> Features:
        """Means over a part. The variance of a mean is a mean with squared weights."""
        weights = self._weights[part][..., None]
        return {
            name: np.divide(total[part], np.square(weights) if name == VARIANCE else weights, dtype=np.float32)
            for name, total in self._totals.items()
        }

    def frames(self, part: tuple[slice, slice]) -> Array:
        """(h, w, 1), see :class:`AveragedPair`."""
        return np.divide(np.square(self._weights[part]), self._squares[part], dtype=np.float32)[..., None]


class _Band:
    """Some rows of a frame."""

    def __init__(self, pair: RenderPair, area: Window, light: Light, features: Sequence[str] | None) -> None:
        self._area, self._light, self._features = area, light, features
        self._alignment = alignment = pair.alignment
        rows = grid_rows(alignment, area)
        grid = alignment.grid
        #: The grid pixels of the area.
        self._grid = Window(grid.x0, grid.y0 + rows.start, grid.x1, grid.y0 + rows.stop)
        own = _read(pair.hr, area, features)
        self.high = _Sum(own)
        self._luminance = _luminance(own)
        self._low_luminance = pair.luminances[0][rows]
        #: The LRHS may lack a row or a column of the grid.
        self._low_place = self._grid.intersect(alignment.lr_data_window)
        self._low = _Sum(_read(pair.lr, self._low_place, features))

    def add(self, steps: Sequence[Step[RenderPair]]) -> None:
        """Add the neighbours on one side."""
        path = Path(self._area, self._alignment.hr_data_window)
        trusted: Array | None = None
        for step in steps:
            path.follow(step)
            high = _fetch_nearest(step.frame, path, self._features)
            valid = path.valid & _make_finite(high)
            share = to_grid(self._alignment, valid.astype(np.float32), self._area)
            low, usable = self._fetch_low(step.frame, path, valid, share)
            usable &= _make_finite(low) & (share >= COVERED)
            own = self._luminance
            hrls = to_grid(self._alignment, np.where(valid, _luminance(high), own), self._area)
            lrhs = np.where(usable, _luminance(low), self._low_luminance)
            trust = self._light.trust(lrhs, hrls, self._area)
            # A light that has changed in the nearer frame has changed in the farther one.
            trusted = trust if trusted is None else np.minimum(trusted, trust)
            self.high.add(high, from_grid(self._alignment, trusted, self._area) * valid)
            place = self._low_place.slices(self._grid)
            self._low.add({name: values[place] for name, values in low.items()}, (trusted * usable)[place])

    def put_low(self, low: Features, core: Window) -> None:
        """Write the LRHS's pixels of some rows ``core`` into ``low``, which covers its data window."""
        rows, grid = grid_rows(self._alignment, core), self._alignment.grid
        place = Window(grid.x0, grid.y0 + rows.start, grid.x1, grid.y0 + rows.stop).intersect(self._low_place)
        for name, values in self._low.means(place.slices(self._low_place)).items():
            low[name][place.slices(self._alignment.lr_data_window)] = values

    def _fetch_low(self, frame: RenderPair, path: Path, valid: Mask, share: Array) -> tuple[Features, Mask]:
        """The neighbour's LRHS over the grid pixels, and which of them lie in it: moved as their HRLS pixels are on
        average."""
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
        x, y = np.clip(x, data.x0, data.x1 - 1), np.clip(y, data.y0, data.y1 - 1)
        top, bottom = max(int(y.min()) - 1, data.y0), min(int(y.max()) + 3, data.y1)
        place = Window(data.x0, top, data.x1, bottom)
        stored = _read(frame.lr, place, self._features)
        x, y = x - place.x0, y - place.y0
        if path.x is None:
            rows, columns = y[:, 0].astype(int), x[0].astype(int)
            return {name: values[rows].take(columns, axis=1) for name, values in stored.items()}, usable

        def positions(rows: slice) -> tuple[Array, Array]:
            return x[rows], y[rows]

        smooth = {
            name: np.moveaxis(stored.pop(name), -1, 0)
            for name in (*RADIANCE_FEATURES, VARIANCE, "alpha")
            if name in stored
        }
        result = _nearest_pixels(stored, positions, x.shape)
        for name, planes in smooth.items():
            with np.errstate(invalid="ignore"):  # NaN is sorted out later
                result[name] = np.moveaxis(sample(planes, positions, x.shape), 0, -1)
        return result, usable


def _difference(to: Array, at: Array, valid: Mask) -> Array:
    """``to - at`` where it is valid, otherwise 0, (h, w)."""
    result = np.empty(to.shape, np.float32)

    def work(rows: slice) -> None:
        np.subtract(to[rows], at[rows], out=result[rows])
        result[rows] *= valid[rows]

    for_row_blocks(work, len(to), to[0].size)
    return result


def _fetch_nearest(frame: RenderPair, path: Path, features: Sequence[str] | None) -> Features:
    """The neighbour's HRLS at the pixels that are nearest to the positions of a path."""
    place = path.place_in(frame.alignment.hr_data_window)
    stored = _read(frame.hr, place, features)
    if path.x is None:
        return stored

    def positions(rows: slice) -> tuple[Array, Array]:
        x, y = path.positions(rows)
        return x - place.x0, y - place.y0

    return _nearest_pixels(stored, positions, path.valid.shape)


def _nearest_pixels(
    features: Features, positions: Callable[[slice], tuple[Array, Array]], size: tuple[int, int]
) -> Features:
    """The pixels of features that are nearest to positions in them; the arguments are those of
    :func:`oiio_msspl.fusion.warp.sample`."""
    height, width = size
    flat = {name: np.ascontiguousarray(v).reshape(-1, v.shape[-1]) for name, v in features.items()}
    result = {name: np.empty((height, width, v.shape[-1]), np.float32) for name, v in features.items()}
    window = Window(0, 0, *next((v.shape[1::-1] for v in features.values()), (1, 1)))

    def work(rows: slice) -> None:
        at = nearest(*positions(rows), window)
        for name, values in flat.items():
            values.take(at, axis=0, out=result[name][rows], mode="wrap")  # "wrap" writes straight into the result

    for_row_blocks(work, height if flat else 0, width * sum(v.shape[-1] for v in flat.values()))
    return result


def _make_finite(features: Features) -> Mask:
    """Where all features are finite, (h, w). Other pixels are set to 0."""
    finite = np.ones(next(iter(features.values())).shape[:2], bool)
    # The extremes of an image are found ten times as fast as its pixels are tested.
    doubtful = [values for values in features.values() if not np.isfinite([values.min(), values.max()]).all()]
    for values in doubtful:
        finite &= np.isfinite(values).all(axis=-1)
    if doubtful:
        for name, values in features.items():
            features[name] = np.where(finite[..., None], values, np.float32(0))
    return finite


def _luminance(features: Features) -> Array:
    """Luminance (h, w) of the beauty, finite and >= 0."""
    return bounded_luminance(repair(features[RGB])[0])


def _read(render: ReadableRender, window: Window, features: Sequence[str] | None = None) -> Features:
    """Features over a window that is relative to the top left of the display window."""
    return render.read(window.shift(render.display_window.x0, render.display_window.y0), features)


def _replaced(render: ReadableRender, layers: Features) -> Render:
    """A render with other pixels."""
    return Render(layers, render.data_window, render.display_window, render.pixel_aspect, name=render.name)
