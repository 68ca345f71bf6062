# SPDX-License-Identifier: Apache-2.0
"""Follows surfaces from frame to frame along their motion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.motion.shot import Motion
from oiio_msspl.fusion.motion.vectors import as_complex
from oiio_msspl.image.arrays import Array, Mask
from oiio_msspl.image.parallel import for_row_blocks
from oiio_msspl.image.sampling import nearest_indices

F = TypeVar("F", covariant=True)


@dataclass(frozen=True)
class Hop(Generic[F]):
    """From one frame to the next, forwards or backwards in time."""

    frame: F
    """The frame that the hop leads to: both of its renders, or the fused frame."""
    there: Motion
    """The motion from the frame where the hop starts."""
    back: Motion
    """The motion back to it."""


class Path:
    """Where the surfaces of a frame are in another one, followed hop by hop.

    Args:
        area: the pixels that are followed.
        window: data window of their frame.
        pixels: x and y (h, w) of some pixels of the area, if these alone are followed.
    """

    def __init__(self, area: Window, window: Window, pixels: tuple[Array, Array] | None = None) -> None:
        self._area, self._start, self._end = area, window, window
        #: How many hops were followed.
        self.hops = 0
        #: Positions (h, w) in pixels, not to be changed.
        self.x, self.y = pixel_positions(area) if pixels is None else pixels
        #: Flat indices (h, w) of the nearest pixels in the data window of the last frame; None for the area itself.
        self.nearest: NDArray[np.intp] | None = None
        if pixels is not None:
            self.nearest = nearest_indices(self.x - window.x0, self.y - window.y0, (window.height, window.width))
        #: Where the last frame shows the same surface (h, w).
        self.valid: Mask = np.ones(self.x.shape, bool)
        #: Where an object has moved that is not followed (h, w); None if nothing has.
        self.moved_objects: Mask | None = None

    def follow(self, there: Motion, back: Motion, window: Window) -> None:
        """Go on to the next frame, whose data window is ``window``, by the motion to it and the way back."""
        vectors, vectors_back = (None if way.vectors is None else as_complex(way.vectors) for way in (there, back))
        valid, shape = self.valid.copy(), self.valid.shape
        places: tuple[Array, Array, NDArray[np.intp]] | None = None
        if vectors is not None or window != self._end:
            places = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.intp)

        def work(rows: slice) -> None:
            start = end = None if self.nearest is None else self.nearest[rows]
            good = valid[rows]
            if there.known is not None:
                good &= self._values(there.known, rows, start)
            vector = None if vectors is None else self._values(vectors, rows, start)
            from_x, from_y = self.x[rows], self.y[rows]
            x, y = (from_x, from_y) if vector is None else (from_x + vector.real, from_y + vector.imag)
            # False for NaN, too. Pixels that leave the window stay where they are.
            good &= (x > window.x0 - 0.5) & (x < window.x1 - 0.5) & (y > window.y0 - 0.5) & (y < window.y1 - 0.5)
            if vector is not None and not good.all():
                for position, start_position in ((x, from_x), (y, from_y)):
                    np.copyto(position, start_position, where=~good)
            if places is not None:
                end = nearest_indices(x - window.x0, y - window.y0, (window.height, window.width))
                places[0][rows], places[1][rows], places[2][rows] = x, y, end
            if back.known is not None:
                good &= self._values(back.known, rows, end)
            if vector is not None or vectors_back is not None:
                miss = np.complex64(0) if vector is None else vector
                if vectors_back is not None:
                    miss = miss + self._values(vectors_back, rows, end)
                good &= np.square(miss.real) + np.square(miss.imag) < there.tolerance**2  # false for NaN, too

        for_row_blocks(work, *shape)
        ends = self.nearest if places is None else places[2]
        for objects, indices in ((there.moved_objects, self.nearest), (back.moved_objects, ends)):
            if objects is not None:
                moved = self._values(objects, slice(0, shape[0]), indices)
                self.moved_objects = moved if self.moved_objects is None else self.moved_objects | moved
        if places is not None:
            self.x, self.y, self.nearest = places
        self.valid, self._end = valid, window
        self.hops += 1

    def _values(self, values: NDArray[Any], rows: slice, indices: NDArray[np.intp] | None) -> NDArray[Any]:
        """Return values over a data window at flat indices; at these rows of the area if there are none."""
        if indices is not None:
            return values.reshape(-1).take(indices, mode="clip")  # a check of all indices takes as long as to take them
        area = replace(self._area, y0=self._area.y0 + rows.start, y1=self._area.y0 + rows.stop)
        return values[area.slices(self._start)]

    def place_in(self, window: Window) -> Window:
        """Return the rows of a window around the positions that cubic interpolation reads."""
        if self.nearest is None:
            return self._area
        low, high = int(np.floor(self.y.min())) - 2, int(np.ceil(self.y.max())) + 3
        top = min(max(low, window.y0), window.y1 - 1)
        return Window(window.x0, top, window.x1, max(min(high, window.y1), top + 1))


def pixel_positions(window: Window) -> tuple[Array, Array]:
    """Return x and y of the pixels of a window, (h, w) each; they are not to be changed."""
    x = np.arange(window.x0, window.x1, dtype=np.float32)
    y = np.arange(window.y0, window.y1, dtype=np.float32)[:, None]
    x, y = np.broadcast_arrays(x, y)
    return x, y
