# SPDX-License-Identifier: Apache-2.0
"""Keeps the frames of a shot until those are complete that need them: what waits for what, and in which order."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from oiio_msspl.errors import InputError, MssplError, explain
from oiio_msspl.exr.render import Render
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.fusion.motion.shot import ShotMotion
from oiio_msspl.fusion.motion.source import MotionFrame
from oiio_msspl.fusion.neighbours.average import average_results
from oiio_msspl.fusion.neighbours.hops import find_hops
from oiio_msspl.fusion.neighbours.path import Hop
from oiio_msspl.fusion.neighbours.renders import RenderPair
from oiio_msspl.image.arrays import kept
from oiio_msspl.jobs.sequence import Frame
from oiio_msspl.jobs.temporal import Temporal
from oiio_msspl.model.session import Session

if TYPE_CHECKING:
    from oiio_msspl.jobs.stages import LoadedFrame

T = TypeVar("T")

#: The hops to the neighbours whose renders are averaged: those before a frame, and those after it.
Neighbours = tuple[Sequence[Hop[RenderPair]], Sequence[Hop[RenderPair]]]


@dataclass(frozen=True)
class FusedAlone:
    """A frame that is fused, and not yet averaged with fused neighbours."""

    loaded: LoadedFrame
    session: Session
    fused: FusedFrame
    seconds: float
    """Wall time of fusing."""
    averaged: tuple[Render, Render] | None = None
    """Both renders with their passes, averaged with those of the neighbours; None if no pass is to be fused, or there
    are no neighbours."""


class FrameWindow:
    """Fuses each frame as soon as the renders of its neighbours are there, and keeps it as long as it is needed.

    Args:
        temporal: which frames need which.
        frames: what is to be written.
        fuse: fuses a frame whose renders are averaged with those of these neighbours; it may return what went wrong.
    """

    def __init__(
        self,
        temporal: Temporal,
        frames: Sequence[Frame],
        fuse: Callable[[LoadedFrame, Neighbours], FusedAlone | Exception],
    ) -> None:
        self._temporal, self._fuse = temporal, fuse
        self._wanted = {frame.number: frame for frame in frames}
        results = {n for each in self._wanted for n in temporal.neighbours(each, temporal.results)}
        #: The frames that are still to be fused, in order.
        self._unfused = sorted(results | self._wanted.keys()) if temporal.count else list(self._wanted)
        self._loaded: dict[int, LoadedFrame | Exception] = {}
        self._fused: dict[int, FusedAlone | Exception] = {}
        self._pairs: dict[int, RenderPair] = {}
        self._motion = ShotMotion(temporal.motion, with_borders=temporal.results > 0) if temporal.motion else None
        self._warnings: dict[int, list[str]] = {}

    def order(self) -> list[Frame]:
        """The frames to read, in this order: what is to be written, and what that depends on."""
        if not self._temporal.count:
            return list(self._wanted.values())
        needed = sorted({each for n in self._wanted for each in (n, *self._temporal.neighbours(n))})
        return [self._wanted.get(n) or self._temporal.frames[n] for n in needed]

    def add(self, number: int, outcome: LoadedFrame | Exception) -> list[tuple[Frame, FusedAlone | Exception]]:
        """Take a frame that is read, or the reason why it could not be. Fuse those that have all they need now.

        Returns:
            The frames to write that have all their neighbours now, in order.
        """
        self._loaded[number] = outcome
        for n in list(self._unfused):
            if all(each in self._loaded for each in (n, *self._temporal.neighbours(n, self._temporal.renders))):
                self._unfused.remove(n)
                self._fused[n] = self._fuse_frame(n)
                self._release_renders()
        ready = [
            (frame, self._fused[n])
            for n, frame in self._wanted.items()
            if all(each in self._fused for each in (n, *self._temporal.neighbours(n, self._temporal.results)))
        ]
        for frame, _ in ready:
            del self._wanted[frame.number]
        return ready

    def accumulate(self, number: int) -> FusedFrame:
        """A frame averaged with its fused neighbours. Neighbours that are missing or broken are named in its warnings.

        Raises:
            MssplError: a neighbour has failed, and not for its files.
        """
        fused = self._fused[number]
        assert isinstance(fused, FusedAlone)
        if not self._temporal.count:
            return fused.fused
        warnings = self._warnings[number]
        before, after = (self._result_hops(number, side, warnings) for side in (-1, 1))
        warnings = list(dict.fromkeys([*fused.fused.warnings, *warnings]))
        if not before and not after:
            return replace(fused.fused, warnings=warnings)
        return replace(average_results(fused.fused, before, after), warnings=warnings)

    def release(self) -> None:
        """Forget the frames that no other one needs any more."""
        results = self._temporal.results
        needed = {each for n in self._wanted for each in (n, *self._temporal.neighbours(n, results))}
        self._fused = {n: outcome for n, outcome in self._fused.items() if n in needed}
        for n, outcome in self._fused.items():
            if isinstance(outcome, FusedAlone) and n not in self._wanted:
                # Its passes are fused, or are not asked for. Neighbours need the picture alone.
                fused = replace(outcome.fused, clean_aovs={}, error=None, frames=None)
                self._fused[n] = replace(outcome, averaged=None, fused=fused)
        self._release_renders()
        known = self._loaded.keys() | self._fused.keys()
        if self._motion is not None:
            self._motion.keep(known)

    def _release_renders(self) -> None:
        """Forget the renders that no frame needs that is still to be fused."""
        renders = self._temporal.renders
        needed = {each for n in self._unfused for each in (n, *self._temporal.neighbours(n, renders))}
        self._loaded = {n: outcome for n, outcome in self._loaded.items() if n in needed}
        self._pairs = {n: pair for n, pair in self._pairs.items() if n in needed}

    def _fuse_frame(self, number: int) -> FusedAlone | Exception:
        loaded = self._loaded[number]
        if isinstance(loaded, Exception):
            return loaded
        missing = self._temporal.missing(number)
        warnings = [f"frame {each} is missing, so fewer neighbours are averaged" for each in missing]
        self._warnings[number] = warnings
        before: Sequence[Hop[RenderPair]] = ()
        after: Sequence[Hop[RenderPair]] = ()
        if self._temporal.renders:
            try:
                before, after = (self._render_hops(number, side, warnings) for side in (-1, 1))
            except Exception as error:
                return error
        outcome = self._fuse(loaded, (before, after))
        if isinstance(outcome, FusedAlone) and self._temporal.results:
            fused = outcome.fused
            fused.rgb = kept(fused.rgb)
            fused.alpha, fused.error = (None if image is None else kept(image) for image in (fused.alpha, fused.error))
        return outcome

    def _render_hops(self, number: int, side: int, warnings: list[str]) -> list[Hop[RenderPair]]:
        """The hops to the neighbours on one side, -1 or 1, whose renders are averaged with those of a frame."""
        assert self._motion is not None
        usable = partial(_usable, self._loaded, number)

        def frame_of(n: int) -> tuple[MotionFrame, RenderPair]:
            loaded = usable(n)
            if n not in self._pairs:
                self._pairs[n] = RenderPair(loaded.lr_pixels, loaded.hr_pixels)
            return _motion_frame(loaded), self._pairs[n]

        return find_hops(self._motion, number, self._on_side(number, side, self._temporal.renders), frame_of, warnings)

    def _result_hops(self, number: int, side: int, warnings: list[str]) -> list[Hop[FusedFrame]]:
        """The hops to the fused neighbours on one side, -1 or 1."""
        assert self._motion is not None
        usable = partial(_usable, self._fused, number)

        def frame_of(n: int) -> tuple[MotionFrame, FusedFrame]:
            alone = usable(n)
            return replace(_motion_frame(alone.loaded), rgb=alone.fused.rgb), alone.fused

        return find_hops(self._motion, number, self._on_side(number, side, self._temporal.results), frame_of, warnings)

    def _on_side(self, number: int, side: int, count: int) -> list[int]:
        """The numbers of a frame's neighbours on one side, the nearest first."""
        return [n for n in self._temporal.neighbours(number, count) if (n - number) * side > 0][::side]


def _motion_frame(loaded: LoadedFrame) -> MotionFrame:
    return MotionFrame(
        loaded.hr, vectors=loaded.vectors, pixels=loaded.hr_pixels, number=loaded.frame.number, lr=loaded.lr
    )


def _usable(outcomes: Mapping[int, T | Exception], frame: int, number: int) -> T:
    """A frame, or an error that says why it can't be used: an InputError if its files are the reason."""
    outcome = outcomes[number]
    assert number != frame or not isinstance(outcome, Exception)
    if isinstance(outcome, InputError):
        raise outcome
    if isinstance(outcome, Exception):
        raise MssplError(f"frame {number}, its neighbour, has failed: {explain(outcome)[0]}") from outcome
    return outcome
