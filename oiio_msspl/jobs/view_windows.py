# SPDX-License-Identifier: Apache-2.0
"""Frames with several views or view layers, each of which is averaged with its own neighbours."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

from oiio_msspl.errors import InputError
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.jobs.frame_window import FrameWindow, FusedAlone, Neighbours
from oiio_msspl.jobs.report import name_of
from oiio_msspl.jobs.sequence import Frame
from oiio_msspl.jobs.temporal import Temporal

if TYPE_CHECKING:
    from oiio_msspl.jobs.stages import LoadedFrame


class ViewWindows:
    """The windows of all views of a shot, with the methods of :class:`FrameWindow`.

    Args:
        temporal, frames, fuse: see :class:`FrameWindow`.
    """

    def __init__(
        self,
        temporal: Temporal,
        frames: Sequence[Frame],
        fuse: Callable[[LoadedFrame, Neighbours], FusedAlone | Exception],
    ) -> None:
        self._first = FrameWindow(temporal, frames, fuse)
        self._others = {view: FrameWindow(each, frames, fuse) for view, each in temporal.views.items()}
        #: What became of views beside the first one, by view and frame, of the frames that can be written now. That is
        #: the same for all views, because all need the same number of neighbours.
        self._outcomes: dict[tuple[str, int], FusedAlone | Exception] = {}

    def order(self) -> list[Frame]:
        """See :meth:`FrameWindow.order`. It is the same for all views."""
        return self._first.order()

    def add(self, number: int, outcome: LoadedFrame | Exception) -> list[tuple[Frame, FusedAlone | Exception]]:
        """See :meth:`FrameWindow.add`.

        Returns:
            Frames, with what became of their first view. It is an error if that of another view is one.
        """
        for view, window in self._others.items():
            lacking = InputError(f"it has no pair for {name_of(view)}")
            loaded = outcome if isinstance(outcome, Exception) else outcome.views.get(view, lacking)
            self._outcomes |= {(view, frame.number): result for frame, result in window.add(number, loaded)}
        ready = self._first.add(number, outcome)
        return [(frame, self._error(frame.number, result) or result) for frame, result in ready]

    def _error(self, number: int, first: FusedAlone | Exception) -> Exception | None:
        """Why a frame can't be written whose first view is fused, if that is so."""
        if isinstance(first, Exception):
            return None
        outcomes = (self._outcomes[view, number] for view in first.loaded.views)
        return next((each for each in outcomes if isinstance(each, Exception)), None)

    def accumulate(self, number: int) -> FusedFrame:
        """See :meth:`FrameWindow.accumulate`: the first view."""
        return self._first.accumulate(number)

    def others(self, number: int) -> Iterator[tuple[FusedAlone, FusedFrame]]:
        """The views beside the first one that are averaged: each as fused alone, and averaged with its neighbours."""
        for view, window in self._others.items():
            outcome = self._outcomes[view, number]
            if isinstance(outcome, FusedAlone):
                yield outcome, window.accumulate(number)

    def release(self) -> None:
        """See :meth:`FrameWindow.release`. The frames that could be written are."""
        self._outcomes.clear()
        self._first.release()
        for window in self._others.values():
            window.release()
