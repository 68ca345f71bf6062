# SPDX-License-Identifier: Apache-2.0
"""The motion between the frames of a shot: read once for each two frames, and kept as long as these are needed."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from oiio_msspl.errors import InputError
from oiio_msspl.fusion.motion.source import FLOW, STATIC, MotionFrame, MotionSource
from oiio_msspl.image.arrays import Array, Mask, kept

#: A vector and the way back may differ by this, in HRLS pixels: by rounding, and by what vectors change within a pixel.
#: Vectors of optical flow are estimates, so more is allowed.
ROUND_TRIP, ROUND_TRIP_OF_FLOW = 0.25, 1.0


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
    tolerance: float = ROUND_TRIP
    """How far the way back may miss the pixel, in HRLS pixels."""


class ShotMotion:
    """The motion between frames of a shot that follow each other, for one view.

    Args:
        source: how the motion is known.
    """

    def __init__(self, source: MotionSource) -> None:
        self._source = source
        #: By the numbers of two frames: forwards and backwards; None if the vectors are 0 and can't be believed.
        self._motions: dict[tuple[int, int], tuple[Motion, Motion] | None] = {}

    def between(self, here: MotionFrame, there: MotionFrame) -> tuple[Motion, Motion]:
        """Return the motion from a frame to the one before or after it, and back.

        Raises:
            InputError: pixels can't be decoded, or vectors are 0 everywhere although the picture moves.
        """
        # Always in the same order, so that pixels do not depend on which frame comes first.
        first, second = (here, there) if here.number < there.number else (there, here)
        numbers = first.number, second.number
        if numbers not in self._motions:
            motions = self._read(first, second)
            zero = any(m.vectors is None and (m.known is None or m.known.any()) for m in motions)
            self._motions[numbers] = None if zero and not self._source.zeros_are_right(first, second) else motions
        ways = self._motions[numbers]
        if ways is None:
            frames = f"frames {numbers[0]} and {numbers[1]}"
            raise InputError(f"motion vectors between {frames} are 0, though the picture moves")
        return ways if first is here else ways[::-1]

    def keep(self, numbers: Collection[int]) -> None:
        """Forget the motion of all frames but these."""
        self._motions = {pair: ways for pair, ways in self._motions.items() if set(pair) <= set(numbers)}

    def _read(self, first: MotionFrame, second: MotionFrame) -> tuple[Motion, Motion]:
        """Read the motion between two frames, forwards and backwards."""
        source, forth = self._source, self._motion(first, second, 1)
        # If nothing but objects moves, they have moved at the same pixels of both frames.
        if source.kind == STATIC and not source.fields and first.hr.data_window == second.hr.data_window:
            return forth, forth
        return forth, self._motion(second, first, -1)

    def _motion(self, here: MotionFrame, there: MotionFrame, hop: int) -> Motion:
        """Read the motion to a neighbour, and keep it as it waits for the frames that need it."""
        vectors, known = self._source.read(here, there, hop)
        objects = self._source.moved_objects(here, there, vectors, known) if known.any() else None
        if objects is not None:
            known &= ~objects
        return Motion(
            kept(vectors) if vectors.any() else None,
            None if known.all() else kept(known),
            kept(objects) if objects is not None and objects.any() else None,
            ROUND_TRIP_OF_FLOW if self._source.kind == FLOW else ROUND_TRIP,
        )
