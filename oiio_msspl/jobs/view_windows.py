# SPDX-License-Identifier: Apache-2.0
"""Frames with several views or view layers, each of which is averaged with its own neighbours."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from oiio_msspl.aovs.views import name_of
from oiio_msspl.errors import InputError
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.jobs.frame_window import FrameWindow, FusedAlone, Neighbours
from oiio_msspl.jobs.sequence import Frame
from oiio_msspl.jobs.temporal import Temporal

if TYPE_CHECKING:
    from oiio_msspl.jobs.stages import LoadedFrame


class NoSuchView(InputError):
    """A frame lacks a view that other frames of the shot have."""


class ViewWindows:
    """The windows of all views of a shot, with the methods of :class:`FrameWindow`.

    Frames become ready at the same time in all of them, because all have the same ``count`` and the same frames.

    Args:
        temporal, frames, fuse: see :class:`FrameWindow`.
    """

    def __init__(
        self,
        temporal: Temporal,
        frames: Sequence[Frame],
        fuse: Callable[[LoadedFrame, Neighbours], FusedAlone | Exception],
    ) -> None:
        self._windows: dict[str | None, FrameWindow] = {None: FrameWindow(temporal, frames, fuse)}
        self._windows |= {view: FrameWindow(each, frames, fuse) for view, each in temporal.views.items()}
        #: What became of each view, by the numbers of the frames that can be written now. The first view is None.
        self._ready: dict[int, dict[str | None, FusedAlone | Exception]] = {}

    def order(self) -> list[Frame]:
        """See :meth:`FrameWindow.order`."""
        return self._windows[None].order()

    def add(
        self, number: int, outcome: Mapping[str | None, LoadedFrame | Exception] | Exception
    ) -> list[tuple[Frame, FusedAlone | Exception]]:
        """See :meth:`FrameWindow.add`. Takes all views, see :meth:`oiio_msspl.jobs.stages.Stages.read_views`.

        Returns:
            Frames, with what became of their first view. It is an error if that of another view is one.
        """
        frames: dict[int, Frame] = {}
        for view, window in self._windows.items():
            lacking = NoSuchView(f"it has no pair for {name_of(view or '')}")
            loaded = outcome if isinstance(outcome, Exception) else outcome.get(view, lacking)
            for frame, result in window.add(number, loaded):
                frames[frame.number] = frame
                self._ready.setdefault(frame.number, {})[view] = result
        return [(frame, self._result(n)) for n, frame in frames.items()]

    def _result(self, number: int) -> FusedAlone | Exception:
        """What became of the first view, or why another view could not be fused."""
        views = self._ready[number]
        errors = (each for each in views.values() if isinstance(each, Exception) and not isinstance(each, NoSuchView))
        return next(errors, views[None])

    def accumulate(self, number: int) -> FusedFrame:
        """See :meth:`FrameWindow.accumulate`: the first view."""
        return self._windows[None].accumulate(number)

    def others(self, number: int) -> Iterator[tuple[FusedAlone, FusedFrame]]:
        """The views beside the first one that are averaged: each as fused alone, and averaged with its neighbours."""
        for view, alone in self._ready[number].items():
            if view is not None and isinstance(alone, FusedAlone):
                yield alone, self._windows[view].accumulate(number)

    def release(self) -> None:
        """See :meth:`FrameWindow.release`. The frames that could be written are."""
        self._ready.clear()
        for window in self._windows.values():
            window.release()
