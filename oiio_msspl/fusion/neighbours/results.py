# SPDX-License-Identifier: Apache-2.0
"""Averages a fused frame with its neighbours, warped along the motion of their surfaces, as far as they can be trusted.

Two questions decide how much a pixel of a neighbour counts:

- Does it show the same surface? A vector leads to the neighbour, and the neighbour's own vector must lead back. A pixel
  at the border of two surfaces has the light of both, and their shares differ from frame to frame. So at the borders of
  either frame a neighbour also counts less the more its brightness differs.
- Has the light changed? See :mod:`oiio_msspl.fusion.neighbours.trust`.

A pixel that no neighbour may change keeps its bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from oiio_msspl.aovs.features import RGB
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.fusion.neighbours.bands import for_bands, from_grid, rows_in_bands, to_grid
from oiio_msspl.fusion.neighbours.path import Path, Step, near_borders
from oiio_msspl.fusion.neighbours.trust import Light, relative_difference
from oiio_msspl.fusion.neighbours.weights import WeightedSum, rows_of
from oiio_msspl.image.arrays import Array, Mask, blank
from oiio_msspl.image.colour import luminance
from oiio_msspl.image.filters import grown
from oiio_msspl.image.sampling import sample_cubic

#: At the border of two surfaces, a neighbour counts half if it is brighter or darker by this share.
DIFFERENT_MIX = 0.3
#: Memory for each pixel of the rows that are averaged at a time.
BYTES_PER_PIXEL = 96

Images = dict[str, Array]


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
    own = _images(frame, window)
    images: Images = {name: blank(image.shape, on_disk=False) for name, image in own.items()}
    frames = np.empty((window.height, window.width, 1), np.float32)
    light = _light_of(frame)

    def average(core: Window, area: Window) -> None:
        target = core.slices(window)
        for name, image in images.items():
            image[target] = own[name][target]
        total = WeightedSum({name: image[target] for name, image in images.items()})
        for steps in (before, after):
            _add_side(total, frame, steps, light, core, area)
        frames[target] = total.divide()

    for_bands(frame.alignment, average)
    if frame.frames is not None:
        # Averages of averages. If all weights are equal, this is the exact number within 7 percent.
        frames = np.sqrt(np.square(frames) + np.square(frame.frames) - 1)
    return Accumulated(images[RGB], images.get("alpha"), frames)


def memory_to_accumulate(window: Window) -> int:
    """Bytes that :func:`accumulate` needs beside its arguments and its result, for a frame of this data window."""
    return rows_in_bands(window) * window.width * BYTES_PER_PIXEL


def _light_of(frame: FusedFrame) -> Light:
    alignment = frame.alignment
    fused = for_bands(alignment, lambda core, _: to_grid(alignment, luminance(_images(frame, core)[RGB]), core))
    return Light(alignment, frame.lrhs_luminance, frame.hrls_luminance, np.concatenate(fused))


def _add_side(
    total: WeightedSum, frame: FusedFrame, steps: Sequence[Step[FusedFrame]], light: Light, core: Window, area: Window
) -> None:
    """Add the neighbours on one side to ``core``, the rows of ``area`` that are computed."""
    alignment = frame.alignment
    window = alignment.hr_data_window
    path = Path(area, window)
    own = _images(frame, area)
    here = luminance(own[RGB])
    borders = _borders(steps, area, window)
    inside = core.slices(area)
    trusted: Array | None = None
    for step in steps:
        path.follow(step)
        warped = _warp(step.frame, path)
        there = luminance(warped[RGB])
        low = to_grid(alignment, np.where(path.valid, there, here), area)
        weight = light.trust(low, low, area)
        # A light that has changed in the nearer frame has changed in the farther one.
        trusted = weight if trusted is None else np.minimum(trusted, weight)
        weight = from_grid(alignment, trusted, area) * path.valid
        mixed = _borders_there(step, path)
        if borders is not None:
            mixed = borders if mixed is None else borders | mixed
        if mixed is not None:
            weight[mixed] *= _likeness(here[mixed], there[mixed], light.darkest)
        # A neighbour may have no alpha.
        total.add(rows_of({name: warped.get(name, image)[inside] for name, image in own.items()}), weight[inside])


def _borders(steps: Sequence[Step[FusedFrame]], area: Window, window: Window) -> Mask | None:
    """Pixels (h, w) over ``area`` that may show two surfaces; None if nothing moves."""
    if not steps:
        return None
    first, part = steps[0], area.slices(window)
    borders = None if first.vectors is None else _near_borders(first.vectors, first.borders, first.tolerance, part)
    if first.moved_objects is None:
        return borders
    moved_objects = grown(first.moved_objects[part], 2)
    return moved_objects if borders is None else borders | moved_objects


def _borders_there(step: Step[FusedFrame], path: Path) -> Mask | None:
    """Pixels (h, w) of a path that lead to pixels of a neighbour that may show two surfaces; None if nothing moves."""
    if step.back is None:
        return None
    window = step.frame.alignment.hr_data_window
    place = path.place_in(window)
    borders = _near_borders(step.back, step.back_borders, step.tolerance, place.slices(window))
    if path.nearest is None:
        return borders
    return borders.reshape(-1).take(path.nearest - (place.y0 - window.y0) * window.width, mode="clip")


def _near_borders(vectors: Array, known: Mask | None, tolerance: float, part: tuple[slice, slice]) -> Mask:
    """:func:`near_borders` over a part of a frame: as ``known`` for all of it, or computed."""
    return near_borders(vectors[part], tolerance) if known is None else known[part]


def _likeness(own: Array, other: Array, darkest: float) -> Array:
    """How much pixels count whose brightness may differ because they show other shares of two surfaces, from 0 to 1.

    Args:
        own, other: luminance.
        darkest: differences are relative to at least this luminance.
    """
    difference = relative_difference(own, other, darkest)
    with np.errstate(over="ignore"):
        return np.asarray(1 / (1 + np.square(difference / np.float32(DIFFERENT_MIX))), np.float32)


def _warp(frame: FusedFrame, path: Path) -> Images:
    """Colour and alpha of another frame at the valid positions of a path, (h, w, c) each."""
    place = path.place_in(frame.alignment.hr_data_window)
    images = _images(frame, place)
    if path.x is None:
        return images

    def positions(rows: slice) -> tuple[Array, Array]:
        x, y = path.positions(rows)
        return x - place.x0, y - place.y0

    warped = sample_cubic(list(images.values()), positions, path.valid.shape, path.valid)
    return dict(zip(images, warped, strict=True))


def _images(frame: FusedFrame, area: Window) -> Images:
    """Colour and alpha, if there is one, over an area of the data window, (h, w, c) each."""
    part = area.slices(frame.alignment.hr_data_window)
    return {RGB: frame.rgb[part]} | ({} if frame.alpha is None else {"alpha": frame.alpha[part]})
