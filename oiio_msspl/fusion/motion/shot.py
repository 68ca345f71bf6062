# SPDX-License-Identifier: Apache-2.0
"""The motion between the frames of a shot: read once for each two frames, and kept as long as these are needed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from oiio_msspl.errors import InputError
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.motion.source import FLOW, STATIC, VECTORS, MotionFrame, MotionSource
from oiio_msspl.fusion.motion.vectors import near_borders
from oiio_msspl.image.arrays import Array, Mask, kept
from oiio_msspl.image.filters import max_around
from oiio_msspl.image.sampling import nearest_indices

#: A vector and the way back may differ by this, in HRLS pixels: by rounding, and by what vectors change within a pixel.
#: Vectors of optical flow are estimates, so more is allowed.
ROUND_TRIP, ROUND_TRIP_OF_FLOW = 0.25, 1.0
#: Pixels this near to a border of two surfaces, by their vectors, are not taken for an object that has moved: they mix
#: both, and which one a pixel shows changes by rounding.
BESIDE_BORDERS = 2


@dataclass(frozen=True)
class Motion:
    """Where the surfaces of a frame are in the frame before or after it."""

    vectors: Array | None = None
    """(h, w, 2) over the frame's data window: from a pixel to the place of its surface, in HRLS pixels, as (x, y) with
    y downwards. None: every surface stays."""
    known: Mask | None = None
    """(h, w): which vectors can be believed; None if all can."""
    moved_objects: Mask | None = None
    """(h, w): where an object has moved that the vectors do not follow. Such pixels are not ``known``."""
    borders: Mask | None = None
    """(h, w): within one pixel of a border of two surfaces, by the vectors; None if these are."""
    tolerance: float = ROUND_TRIP
    """How far the way back may miss the pixel, in HRLS pixels."""


class ShotMotion:
    """The motion between frames of a shot that follow each other, for one view, as a source knows it."""

    def __init__(self, source: MotionSource) -> None:
        self._source = source
        self._tolerance = ROUND_TRIP_OF_FLOW if source.kind == FLOW else ROUND_TRIP
        #: By the numbers of two frames: forwards and backwards; or why the vectors can't be believed.
        self._motions: dict[tuple[int, int], tuple[Motion, Motion] | str] = {}

    def between(self, here: MotionFrame, there: MotionFrame) -> tuple[Motion, Motion]:
        """Return the motion from a frame to the one before or after it, and back.

        Raises:
            InputError: pixels can't be decoded, vectors are 0 everywhere although the picture moves, or they mislead.
        """
        # Always in the same order, so that pixels do not depend on which frame comes first.
        first, second = (here, there) if here.number < there.number else (there, here)
        numbers = first.number, second.number
        if numbers not in self._motions:
            self._motions[numbers] = self._read(first, second)
        ways = self._motions[numbers]
        if isinstance(ways, str):
            raise InputError(f"motion vectors between frames {numbers[0]} and {numbers[1]} {ways}")
        return ways if first is here else ways[::-1]

    def forget(self, number: int) -> None:
        """Forget the motion from and to a frame."""
        for numbers in [numbers for numbers in list(self._motions) if number in numbers]:
            del self._motions[numbers]

    def _read(self, first: MotionFrame, second: MotionFrame) -> tuple[Motion, Motion] | str:
        """Read the motion between two frames, forwards and backwards; or what is wrong with it."""
        source = self._source
        forth, known = source.read(first, second, 1)
        # If nothing but objects moves, they have moved at the same pixels of both frames.
        same = source.kind == STATIC and not source.fields and first.hr.data_window == second.hr.data_window
        back, back_known = (forth, known) if same else source.read(second, first, -1)
        borders = self._borders(forth)
        back_borders = borders if same else self._borders(back)
        zero = (borders is None and known.any()) or (back_borders is None and back_known.any())
        if zero and not source.zeros_are_right(first, second):
            return "are 0, though the picture moves"
        if source.misleads(first, second, forth, known):
            return "do not lead to the same surfaces"
        objects = source.moved_objects(first, second, forth, known) if known.any() else None
        back_objects = objects
        if objects is not None and source.kind == VECTORS:
            # Pixels are followed there and back, so one direction tells both. Where the way back leads elsewhere, the
            # surface is only hidden.
            if borders is not None:
                objects &= ~max_around(borders, BESIDE_BORDERS)
            hidden = objects & ~_leads_back(objects, forth, back, first.hr.data_window, second.hr.data_window)
            objects, known, back_objects = objects & ~hidden, known & ~hidden, None
        elif not same:
            back_objects = source.moved_objects(second, first, back, back_known) if back_known.any() else None
        there = self._motion(forth, known, objects, borders)
        return there, there if same else self._motion(back, back_known, back_objects, back_borders)

    def _borders(self, vectors: Array) -> Mask | None:
        """Find the borders of surfaces (h, w) by vectors; None if these are 0 everywhere."""
        return near_borders(vectors, self._tolerance) if vectors.any() else None

    def _motion(self, vectors: Array, known: Mask, objects: Mask | None, borders: Mask | None) -> Motion:
        """Return a motion as it waits for the frames that need it."""
        if objects is not None:
            known = known & ~objects
        return Motion(
            None if borders is None else kept(vectors),
            None if known.all() else kept(known),
            kept(objects) if objects is not None and objects.any() else None,
            None if borders is None else kept(borders),
            self._tolerance,
        )


def _leads_back(pixels: Mask, forth: Array, back: Array, window: Window, other: Window) -> Mask:
    """Find the pixels of a mask (h, w) to which the vectors of the other frame lead back."""
    result = np.zeros_like(pixels)
    y, x = np.nonzero(pixels)
    ways = forth[y, x]
    at_x, at_y = x + ways[:, 0] + (window.x0 - other.x0), y + ways[:, 1] + (window.y0 - other.y0)
    ends = back.reshape(-1, 2).take(nearest_indices(at_x, at_y, back.shape[:2]), axis=0)
    result[y, x] = np.hypot(*(ways + ends).T) < ROUND_TRIP
    return result
