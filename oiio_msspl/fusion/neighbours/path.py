# SPDX-License-Identifier: Apache-2.0
"""Follows surfaces from frame to frame along motion vectors, and fetches pixels where they are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.image.arrays import Array, Mask
from oiio_msspl.image.filters import grown
from oiio_msspl.image.parallel import for_row_blocks
from oiio_msspl.image.sampling import nearest_indices

#: A vector and the way back may differ by this, in HRLS pixels: by rounding, and by what vectors change within a pixel.
#: Vectors of optical flow are estimates, so more is allowed.
ROUND_TRIP, ROUND_TRIP_OF_FLOW = 0.25, 1.0


class Placed(Protocol):
    """A frame whose place in the picture is known."""

    @property
    def alignment(self) -> Alignment:
        """How its pair lies over each other."""


F = TypeVar("F", bound=Placed, covariant=True)


@dataclass(frozen=True)
class Step(Generic[F]):
    """From a frame to the next one, forwards or backwards in time."""

    frame: F
    """The frame that it leads to."""
    vectors: Array | None
    """(h, w, 2) over the data window of the frame that it starts from: where the surface of a pixel is, in HRLS pixels
    from there, as (x, y) with y downwards. None: it stays."""
    valid: Mask | None
    """(h, w) over the same window: which of them can be believed; None if all can."""
    back: Array | None
    """(h, w, 2) over the data window of ``frame``: the way back. None: it stays."""
    back_valid: Mask | None
    """(h, w) over the data window of ``frame``: which of ``back`` can be believed; None if all can."""
    tolerance: float = ROUND_TRIP
    """How far the way back may miss the pixel, in HRLS pixels."""
    moved_objects: Mask | None = None
    """(h, w): where an object has moved that the vectors do not follow, see
    :meth:`oiio_msspl.fusion.motion.source.MotionSource.moved_objects`. Such pixels are not ``valid``."""
    borders: Mask | None = None
    """(h, w): :func:`near_borders` of ``vectors``; None if it is not known yet."""
    back_borders: Mask | None = None
    """(h, w): :func:`near_borders` of ``back``; None if it is not known yet."""


class Path:
    """Where the surfaces of a frame are in another one, followed from frame to frame."""

    def __init__(self, area: Window, window: Window) -> None:
        """``area``: the pixels that are followed, in a frame whose data window is ``window``."""
        self._area, self._area_window = area, window
        #: Positions (h, w) in pixels, and None for "at the pixel itself".
        self.x: Array | None = None
        self.y: Array | None = None
        self.valid: Mask = np.ones((area.height, area.width), bool)
        #: Where an object has moved that is not followed (h, w); None if no step says so.
        self.moved_objects: Mask | None = None
        #: Flat indices (h, w) of the nearest pixels in the data window of the last frame; None with ``x``.
        self.nearest: NDArray[np.intp] | None = None
        self._last = window

    def follow(self, step: Step[Placed]) -> None:
        """Go on to the next frame."""
        start, end = self._last, step.frame.alignment.hr_data_window
        valid = self.valid.copy()
        moves = step.vectors is not None
        moved = step.moved_objects
        # A complex number is gathered in half the time of two real ones.
        vectors, back = (None if v is None else _as_complex(v) for v in (step.vectors, step.back))
        shape = valid.shape
        moved_objects = np.zeros(shape, np.bool_)
        found: tuple[Array, Array, NDArray[np.intp]] | None = None
        if moves or start != end:
            found = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.intp)

        def work(rows: slice) -> None:
            from_x, from_y = self.positions(rows)
            to_x, to_y = from_x, from_y
            good = valid[rows]
            at = None if self.nearest is None else self.nearest[rows]
            if step.valid is not None:
                good &= self._values(step.valid, rows, at)
            if moved is not None:
                moved_objects[rows] = self._values(moved, rows, at)
            if vectors is not None:
                vector = self._values(vectors, rows, at)
                to_x, to_y = from_x + vector.real, from_y + vector.imag
            # False for NaN, too.
            good &= (to_x > end.x0 - 0.5) & (to_x < end.x1 - 0.5) & (to_y > end.y0 - 0.5) & (to_y < end.y1 - 0.5)
            if vectors is not None and not good.all():
                bad = ~good
                to_x[bad], to_y[bad] = from_x[bad], from_y[bad]
            there = at
            if found is not None:
                there = nearest_indices(to_x - end.x0, to_y - end.y0, (end.height, end.width))
                found[0][rows], found[1][rows], found[2][rows] = to_x, to_y, there
            if vectors is not None or back is not None or step.back_valid is not None:
                home = np.complex64(0) if vectors is None else vector
                if back is not None:
                    home = home + self._values(back, rows, there)
                good &= np.square(home.real) + np.square(home.imag) < step.tolerance**2  # false for NaN, too
                if step.back_valid is not None:
                    good &= self._values(step.back_valid, rows, there)

        for_row_blocks(work, len(valid), valid.shape[1])
        if found is not None:
            self.x, self.y, self.nearest = found
        if moved is not None:
            self.moved_objects = moved_objects if self.moved_objects is None else self.moved_objects | moved_objects
        self.valid, self._last = valid, end

    def _values(self, values: NDArray[Any], rows: slice, at: NDArray[np.intp] | None) -> NDArray[Any]:
        """Values over a data window at flat indices; at these rows of the area if that is None."""
        if at is not None:
            return values.reshape(-1).take(at, mode="clip")  # a check of all indices takes as long as to take them
        area, window = self._area, self._area_window
        part = Window(area.x0, area.y0 + rows.start, area.x1, area.y0 + min(rows.stop, area.height))
        return np.asarray(values[part.slices(window)])

    def positions(self, rows: slice) -> tuple[Array, Array]:
        """Positions of some rows, (n, w) each."""
        if self.x is not None and self.y is not None:
            return self.x[rows], self.y[rows]
        area = self._area
        x = np.arange(area.x0, area.x1, dtype=np.float32)
        y = np.arange(area.y0 + rows.start, area.y0 + rows.stop, dtype=np.float32)[:, None]
        x, y = np.broadcast_arrays(x, y)
        return x, y

    def place_in(self, window: Window) -> Window:
        """The rows of a window that lie around the positions, as far as cubic interpolation reaches."""
        if self.y is None:
            return self._area
        low, high = int(np.floor(self.y.min())) - 2, int(np.ceil(self.y.max())) + 3
        top = min(max(low, window.y0), window.y1 - 1)
        return Window(window.x0, top, window.x1, max(min(high, window.y1), top + 1))


def near_borders(vectors: Array, tolerance: float) -> Mask:
    """Pixels (h, w) within one pixel of a border between two surfaces, where vectors change by more than ``tolerance``.

    Args:
        vectors: (h, w, 2), in pixels. NaN counts as another surface.
    """
    motion = _as_complex(vectors)
    across, down = (~(np.abs(np.diff(motion, axis=axis)) < tolerance) for axis in (1, 0))
    borders = np.zeros(motion.shape, bool)
    for pixels in (borders[:, :-1], borders[:, 1:]):
        pixels |= across
    for pixels in (borders[:-1], borders[1:]):
        pixels |= down
    return grown(borders)


def _as_complex(vectors: Array) -> NDArray[np.complex64]:
    """(h, w, 2) as (h, w): x + i y."""
    return np.ascontiguousarray(vectors, np.float32).view(np.complex64)[..., 0]
