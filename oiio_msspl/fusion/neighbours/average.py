# SPDX-License-Identifier: Apache-2.0
"""Averages a frame with its neighbours: both of its renders before they are fused, and the fused frame after that.

One engine does both, in bands of rows, see ``docs/design/temporal.md``. What differs is a strategy each:
:class:`RenderBand` and :class:`ResultBand`. A value that no neighbour may change keeps its bits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Protocol, TypeVar

import numpy as np

from oiio_msspl.aovs.features import RGB, VARIANCE
from oiio_msspl.aovs.mapped_render import ReadableRender
from oiio_msspl.exr.render import Render, Window
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.fusion.neighbours.bands import for_bands, rows_in_bands, whole_grid
from oiio_msspl.fusion.neighbours.path import Hop, Path
from oiio_msspl.fusion.neighbours.renders import SQUARES, USUAL_CHANNELS, Features, RenderBand, RenderPair, read
from oiio_msspl.fusion.neighbours.results import Images, ResultBand, images_of
from oiio_msspl.fusion.neighbours.trust import WHOLE, Judge, Light, RenderLight, ResultLight, cells
from oiio_msspl.image.arrays import Array, blank, unload
from oiio_msspl.image.parallel import two_at_a_time
from oiio_msspl.image.sampling import sample_linear

#: Bytes for each pixel of the rows that are averaged at a time: of renders without their features, and of results.
BYTES_OF_RENDERS, BYTES_OF_RESULTS = 56, 96

F = TypeVar("F", RenderPair, FusedFrame)
C = TypeVar("C", RenderPair, FusedFrame, contravariant=True)


class Band(Protocol[C]):
    """Some rows of a frame, to which those of neighbours are added: :class:`RenderBand` or :class:`ResultBand`."""

    def add(self, hop: Hop[C], path: Path, judge: Judge) -> None:
        """Add the neighbour that a path leads to by its last hop. Call ``judge`` once."""

    def finish(self) -> Array:
        """Turn the sums into means. Return the number of frames (h, w, 1), see :meth:`WeightedSum.divide`."""


def average_renders(
    pair: RenderPair,
    before: Sequence[Hop[RenderPair]],
    after: Sequence[Hop[RenderPair]],
    features: Sequence[str] | None = None,
) -> tuple[Render, Render, Array]:
    """Average both renders of a frame with those of its neighbours.

    Where a neighbour is NaN or infinite, it does not count.

    Args:
        pair: the frame.
        before, after: hops to the frames before and after it, the nearest first. All have the features of the frame.
        features: which features the result has, if the renders have them; all if None. If one render lacks a
            ``variance`` of colours, its frames tell it.

    Returns:
        The LRHS, the HRLS (one render is both), and the number of frames with equal weight whose mean would have the
        same noise, (h, w, 1) over the HRLS's data window: 1 where the frame stands alone.

    Raises:
        InputError: pixels can't be decoded.
    """
    alignment = pair.alignment
    window = alignment.hr_data_window
    light = RenderLight(alignment, *pair.colours, pair.colours[0])
    low: Features = {}
    if not pair.is_one_render:
        low = {name: values.copy() for name, values in read(pair.lr, alignment.lr_data_window, features).items()}
    row = read(pair.hr, Window(window.x0, window.y0, window.x1, window.y0 + 1), features)
    high: Features = {name: blank((window.height, window.width, values.shape[-1])) for name, values in row.items()}
    of_colours = VARIANCE in high and high[VARIANCE].shape[-1] == 3
    if pair.is_one_render and not of_colours and VARIANCE in (features or ()):
        high[SQUARES] = blank((window.height, window.width, 3))

    band = partial(RenderBand, pair, light, low, high)
    weight = _weight(sum(image.shape[-1] for image in high.values()))
    frames = _average(light, before, after, band, lambda pair: pair.cells, weight)
    if SQUARES in high:
        high[VARIANCE] = high.pop(SQUARES)
    hr = _replaced(pair.hr, high, window)
    return hr if pair.is_one_render else _replaced(pair.lr, low, alignment.lr_data_window), hr, frames


def average_results(
    frame: FusedFrame, before: Sequence[Hop[FusedFrame]], after: Sequence[Hop[FusedFrame]]
) -> FusedFrame:
    """Average a fused frame with its fused neighbours.

    Args:
        frame: the frame.
        before, after: hops to the frames before and after it, the nearest first.

    Returns:
        The frame with averaged colour and alpha, and with its number of frames.
    """
    alignment = frame.alignment
    window = alignment.hr_data_window
    renders = frame.lrhs_luminance[..., None], frame.hrls_luminance[..., None]
    light = ResultLight(alignment, *renders, _picture(frame))
    images: Images = {name: blank(image.shape, on_disk=False) for name, image in images_of(frame, window).items()}
    frames = _average(light, before, after, partial(ResultBand, frame, light, images), _cells)
    if frame.frames is not None:
        # Averages of averages. If all weights are equal, this is the exact number within 7 percent.
        frames = np.sqrt(np.square(frames) + np.square(frame.frames) - 1)
    return replace(frame, rgb=images[RGB], alpha=images.get("alpha"), frames=frames)


def _cells(frame: FusedFrame) -> list[Array]:
    """Return the colours of a fused frame, averaged to large cells. They are kept for its other neighbours."""
    if frame.coarse is None:
        frame.coarse = cells(_picture(frame), frame.alignment.scale, WHOLE)
    return [frame.coarse]


def _picture(frame: FusedFrame) -> Array:
    """Return the colours of a fused frame (h, w, 3) over the grid."""
    return whole_grid(frame.alignment, lambda core: images_of(frame, core)[RGB])


def _average(
    light: Light,
    before: Sequence[Hop[F]],
    after: Sequence[Hop[F]],
    band_of: Callable[[Window, Window], Band[F]],
    cells_of: Callable[[F], Sequence[Array]],
    weight: float = 1.0,
) -> Array:
    """Average a frame with its neighbours, band by band, and return the number of frames (h, w, 1)."""
    window = light.alignment.hr_data_window
    frames: Array = blank((window.height, window.width, 1))
    sides = two_at_a_time(lambda hops: (hops, _coarse_trust(light, hops, cells_of)), (before, after))

    def work(core: Window, area: Window) -> None:
        band = band_of(core, area)
        for hops, coarse in sides:
            path, judge = Path(area, window), light.judge(area, coarse)
            for hop in hops:
                path.follow(hop.there, hop.back, hop.frame.alignment.hr_data_window)
                band.add(hop, path, judge)
        frames[core.slices(window)] = band.finish()
        unload(frames)

    for_bands(light.alignment, work, weight)
    return frames


def _coarse_trust(light: Light, hops: Sequence[Hop[F]], cells_of: Callable[[F], Sequence[Array]]) -> list[Array]:
    """Return how much each neighbour on one side counts by the light of large areas, see :meth:`Light.coarse_trust`."""
    alignment, window = light.alignment, light.alignment.hr_data_window
    rows, columns = np.indices(light.shape).astype(np.float32)
    x = np.minimum(columns * WHOLE + WHOLE // 2, window.width - 1) + window.x0
    y = np.minimum(rows * WHOLE + WHOLE // 2, window.height - 1) + window.y0
    path, result = Path(window, window, (x, y)), []
    for hop in hops:
        path.follow(hop.there, hop.back, hop.frame.alignment.hr_data_window)
        # Cells count from the corner of each frame's grid.
        here, there = alignment.grid, hop.frame.alignment.grid
        at_x = columns + (path.x - x + np.float32((here.x0 - there.x0) * alignment.scale)) / np.float32(WHOLE)
        at_y = rows + (path.y - y + np.float32((here.y0 - there.y0) * alignment.scale)) / np.float32(WHOLE)
        colours = [sample_linear(image, at_x, at_y) for image in cells_of(hop.frame)]
        result.append(light.coarse_trust(colours, path.valid))
    return result


def memory_to_average_renders(window: Window, channels: int) -> int:
    """Return the bytes that :func:`average_renders` needs beside its arguments and its result.

    Args:
        window: the HRLS's data window.
        channels: of the HRLS's features.
    """
    rows = rows_in_bands(window, _weight(channels))
    return rows * window.width * (BYTES_OF_RENDERS + 4 * channels)


def memory_to_average_results(window: Window) -> int:
    """Return the bytes that :func:`average_results` needs beside its arguments and its result, by the data window."""
    return rows_in_bands(window) * window.width * BYTES_OF_RESULTS


def _weight(channels: int) -> float:
    """Return the memory of a pixel relative to that with the usual channels: passes have many more."""
    usual, needed = (BYTES_OF_RENDERS + 4 * count for count in (USUAL_CHANNELS, channels))
    return max(1.0, needed / usual)


def _replaced(render: ReadableRender, layers: Features, window: Window) -> Render:
    display = render.display_window
    return Render(layers, window.shift(display.x0, display.y0), display, render.pixel_aspect, name=render.name)
