# SPDX-License-Identifier: Apache-2.0
"""Averages a fused frame with its neighbours, warped along the motion of their surfaces, as far as they can be trusted.

Two questions decide how much a pixel of a neighbour counts:

- Does it show the same surface? A vector leads to the neighbour, and the neighbour's own vector must lead back. A pixel
  at the border of two surfaces has the light of both, and their shares differ from frame to frame. So there a neighbour
  also counts less the more its brightness differs.
- Has the light changed? See :mod:`oiio_msspl.fusion.light`.

A pixel that no neighbour may change keeps its bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from oiio_msspl.arrays import Array, planes_of
from oiio_msspl.colour import LUMINANCE_WEIGHTS
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.fusion.light import Light, bands, from_grid, rows_in_bands, to_grid
from oiio_msspl.fusion.warp import Mask, Path, Step, near_borders, sample
from oiio_msspl.parallel import for_row_blocks

#: At the border of two surfaces, a neighbour counts half if it is brighter or darker by this share.
DIFFERENT_MIX = 0.3
#: Memory for each pixel of the rows that are averaged at a time.
BYTES_PER_PIXEL = 96


@dataclass(frozen=True)
class Accumulated:
    """A frame that is averaged with its neighbours."""

    rgb: Array
    """(h, w, 3)"""
    alpha: Array | None
    """(h, w, 1)"""
    frames: Array
    """(h, w, 1): the number of frames with equal weight whose mean would have as little noise: 1 where the frame stands
    alone."""


def accumulate(frame: FusedFrame, before: Sequence[Step[FusedFrame]], after: Sequence[Step[FusedFrame]]) -> Accumulated:
    """Average a frame with its neighbours.

    Args:
        frame: the frame.
        before: steps to the frame before it, to the one before that, and so on.
        after: steps to the frames after it, the nearest first.
    """
    window = frame.alignment.hr_data_window
    rgb = np.empty_like(frame.rgb)
    alpha = None if frame.alpha is None else np.empty_like(frame.alpha)
    frames = np.empty((window.height, window.width, 1), np.float32)
    light = _light_of(frame)
    for core, area in bands(frame.alignment):
        total, weights, squares = _accumulate_band(frame, before, after, light, area)
        total /= weights
        inside, target = core.slices(area), core.slices(window)
        rgb[target] = np.moveaxis(total[:3], 0, -1)[inside]
        if alpha is not None:
            alpha[target] = total[3][inside][..., None]
        frames[target] = (np.square(weights) / squares)[inside][..., None]
    if frame.frames is not None:
        # Averages of averages. If all weights are equal, this is the exact number within 7 percent.
        frames = np.sqrt(np.square(frames) + np.square(frame.frames) - 1)
    return Accumulated(rgb, alpha, frames)


def memory_to_accumulate(window: Window) -> int:
    """Bytes that :func:`accumulate` needs beside its arguments and its result, for a frame of this data window."""
    return rows_in_bands(window) * window.width * BYTES_PER_PIXEL


def _light_of(frame: FusedFrame) -> Light:
    alignment = frame.alignment
    fused = [to_grid(alignment, _luminance(_channels(frame, core)), core) for core, _ in bands(alignment)]
    return Light(alignment, frame.lrhs_luminance, frame.hrls_luminance, np.concatenate(fused))


def _accumulate_band(
    frame: FusedFrame, before: Sequence[Step[FusedFrame]], after: Sequence[Step[FusedFrame]], light: Light, area: Window
) -> tuple[Array, Array, Array]:
    """The weighted sum of colour and alpha (3 or 4, h, w), the weights (h, w), and their squares."""
    window = frame.alignment.hr_data_window
    total = _channels(frame, area)
    weights = np.ones(total.shape[1:], np.float32)
    squares = np.ones_like(weights)
    own = _luminance(total)
    for steps in (before, after):
        path = Path(area, window)
        trusted: Array | None = None
        borders = _borders(steps, area, window)
        for step in steps:
            path.follow(step)
            warped = _warp(step.frame, path)
            low = to_grid(frame.alignment, np.where(path.valid, _luminance(warped), own), area)
            weight = light.trust(low, low, area)
            # A light that has changed in the nearer frame has changed in the farther one.
            trusted = weight if trusted is None else np.minimum(trusted, weight)
            if len(warped) < len(total):  # the neighbour has no alpha
                warped = np.concatenate([warped, _channels(frame, area)[3:]])
            weight = from_grid(frame.alignment, trusted, area) * path.valid
            if borders is not None:
                weight[borders] *= _likeness(own[borders], _luminance(warped)[borders], light.darkest)
            _add(total, weights, squares, warped, weight)
    return total, weights, squares


def _borders(steps: Sequence[Step[FusedFrame]], area: Window, window: Window) -> Mask | None:
    """Pixels (h, w) over ``area`` that may show two surfaces; None if nothing moves."""
    if not steps or steps[0].vectors is None:
        return None
    return near_borders(steps[0].vectors[area.slices(window)], steps[0].tolerance)


def _likeness(own: Array, other: Array, darkest: float) -> Array:
    """How much pixels count whose brightness may differ because they show other shares of two surfaces, from 0 to 1.

    Args:
        own, other: luminance.
        darkest: differences are relative to at least this luminance.
    """
    difference = (own - other) / np.maximum(np.maximum(own, other), np.float32(darkest))
    return np.asarray(1 / (1 + np.square(difference / np.float32(DIFFERENT_MIX))), np.float32)


def _warp(frame: FusedFrame, path: Path) -> Array:
    """Colour and alpha (3 or 4, h, w) of another frame at the positions of a path."""
    place = path.place_in(frame.alignment.hr_data_window)
    planes = _channels(frame, place)
    if path.x is None:
        return planes

    def positions(rows: slice) -> tuple[Array, Array]:
        x, y = path.positions(rows)
        return x - place.x0, y - place.y0

    return sample(planes, positions, path.valid.shape)


def _luminance(planes: Array) -> Array:
    """Luminance (h, w) of colour (3 or more, h, w)."""
    red, green, blue = (np.float32(w) * plane for w, plane in zip(LUMINANCE_WEIGHTS, planes, strict=False))
    return np.asarray(red + green + blue, np.float32)


def _channels(frame: FusedFrame, area: Window) -> Array:
    """Colour and alpha, if there is one, over an area of the data window, as planes (3 or 4, h, w)."""
    part = area.slices(frame.alignment.hr_data_window)
    colour = planes_of(frame.rgb[part])
    return colour if frame.alpha is None else np.concatenate([colour, frame.alpha[part][None, ..., 0]])


def _add(total: Array, weights: Array, squares: Array, warped: Array, weight: Array) -> None:
    """Add weighted planes (c, h, w) to the totals."""

    def work(rows: slice) -> None:
        for plane, values in zip(total, warped, strict=False):  # this frame may lack the alpha
            plane[rows] += weight[rows] * values[rows]
        weights[rows] += weight[rows]
        squares[rows] += np.square(weight[rows])

    for_row_blocks(work, len(weights), weights.shape[1] * len(total))
