# SPDX-License-Identifier: Apache-2.0
"""Keeps the frames of a shot until those are complete that need them: what waits for what, and in which order."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.aovs.views import name_of
from oiio_msspl.errors import InputError, MssplError, explain
from oiio_msspl.exr.render import Render
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.fusion.motion.source import FLOW, MotionFrame
from oiio_msspl.fusion.neighbours.path import ROUND_TRIP, ROUND_TRIP_OF_FLOW, Placed, Step, near_borders
from oiio_msspl.fusion.neighbours.renders import RenderPair, lacking_passes, shared_noise
from oiio_msspl.fusion.neighbours.results import accumulate
from oiio_msspl.image.arrays import Array, Mask, kept
from oiio_msspl.image.parallel import in_parallel
from oiio_msspl.jobs.sequence import Frame
from oiio_msspl.jobs.temporal import Temporal
from oiio_msspl.model.session import Session

if TYPE_CHECKING:
    from oiio_msspl.jobs.stages import LoadedFrame

F = TypeVar("F", bound=Placed)
T = TypeVar("T")

#: Frames have the same noise above this correlation. Independent ones stay below 0.1, with little noise below 0.4.
SAME_NOISE = 0.5
SAME_SEED = "have the same noise, which no average removes; let the renderer change its seed from frame to frame"
#: Vectors of frames with more pixels are read one way after the other.
LARGEST_READ = 1 << 22

#: Vectors to a neighbour, where they can be believed, where objects have moved that they do not follow, and where they
#: change, as :class:`oiio_msspl.fusion.neighbours.path.Step` has them.
Way = tuple[Array | None, Mask | None, Mask | None, Mask | None]
#: The ways to the neighbours whose renders are averaged: those before a frame, and those after it.
Neighbours = tuple[Sequence[Step[RenderPair]], Sequence[Step[RenderPair]]]


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
        self._vectors: dict[tuple[int, int], Way] = {}
        #: Where objects have moved between two frames, where they are the same both ways.
        self._moved_objects: dict[frozenset[int], Mask | None] = {}
        #: Between two frames with vectors of 0, whether these can be believed.
        self._zeros_are_right: dict[frozenset[int], bool] = {}
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
        before, after = (self._steps(number, step, self._fused, _fused_frame, warnings) for step in (-1, 1))
        warnings = list(dict.fromkeys([*fused.fused.warnings, *warnings]))
        if not before and not after:
            return replace(fused.fused, warnings=warnings)
        result = accumulate(fused.fused, before, after)
        return replace(fused.fused, rgb=result.rgb, alpha=result.alpha, frames=result.frames, warnings=warnings)

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
        self._vectors = {(a, b): found for (a, b), found in self._vectors.items() if a in known and b in known}
        self._moved_objects = {pair: found for pair, found in self._moved_objects.items() if pair <= known}
        self._zeros_are_right = {pair: found for pair, found in self._zeros_are_right.items() if pair <= known}

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
        before: Sequence[Step[RenderPair]] = ()
        after: Sequence[Step[RenderPair]] = ()
        if self._temporal.renders:
            try:
                before, after = (self._steps(number, step, self._loaded, self._pair, warnings) for step in (-1, 1))
            except Exception as error:
                return error
        outcome = self._fuse(loaded, (before, after))
        if isinstance(outcome, FusedAlone) and self._temporal.results:
            fused = outcome.fused
            fused.rgb = kept(fused.rgb)
            fused.alpha, fused.error = (None if image is None else kept(image) for image in (fused.alpha, fused.error))
        return outcome

    def _pair(self, loaded: LoadedFrame) -> tuple[LoadedFrame, RenderPair]:
        number = loaded.frame.number
        if number not in self._pairs:
            self._pairs[number] = RenderPair(loaded.lr_pixels, loaded.hr_pixels)
        return loaded, self._pairs[number]

    def _steps(
        self,
        number: int,
        step: int,
        outcomes: Mapping[int, T | Exception],
        placed: Callable[[T], tuple[LoadedFrame, F]],
        warnings: list[str],
    ) -> list[Step[F]]:
        """The way from a frame to its neighbours on one side, up to the first whose files can't be used.

        Other failures of a neighbour may not occur again, such as a full disk or too little memory. Without that
        neighbour, the frame would have other pixels than in another run. So it fails, too.

        Args:
            number: of the frame.
            step: -1 for the frames before it, 1 for those after it.
            outcomes: the frames as they are averaged: their renders, or fused.
            placed: a frame's files, and its pixels.
            warnings: gets what is wrong with a neighbour.

        Raises:
            MssplError: a neighbour has failed, and not for its files.
        """
        steps: list[Step[F]] = []
        own = outcomes[number]
        assert not isinstance(own, Exception)
        here = placed(own)
        count = self._temporal.renders if outcomes is self._loaded else self._temporal.results
        neighbours = [n for n in self._temporal.neighbours(number, count) if (n - number) * step > 0]
        for n in neighbours[::step]:
            try:
                there = placed(_usable(n, outcomes[n]))
                _check_alike(here, there)
                if abs(n - number) == 1 and _have_one_noise(here[1], there[1]):
                    warnings.append(f"frames {min(number, n)} and {max(number, n)} {SAME_SEED}")
                way, back = self._read_both_ways(n - step, n)
            except InputError as error:
                warnings.append(f"frame {n} is not averaged: {error}")
                break
            steps.append(_step(there[1], way, back, self._tolerance))
            if isinstance(here[1], RenderPair) and isinstance(there[1], RenderPair):
                names = " and ".join(lacking_passes(here[1], there[1]))
                if names:
                    warnings.append(f"frame {n} has no set of passes with {names}, so passes are not averaged")
        return steps

    def _read_both_ways(self, start: int, end: int) -> tuple[Way, Way]:
        """Motion from one frame to the next or the previous one, and back."""
        there, back = partial(self._read_vectors, start, end), partial(self._read_vectors, end, start)
        assert self._temporal.motion is not None
        window = self._motion_frame(start).hr.data_window
        # To decode vectors takes several times their memory.
        if self._temporal.motion.reads_one_frame and window.width * window.height <= LARGEST_READ:
            ways = in_parallel(there, back)
        else:
            ways = there(), back()
        if any(vectors is None and (valid is None or valid.any()) for vectors, valid, *_ in ways):
            self._check_zeros(*sorted((start, end)))
        return ways

    def _check_zeros(self, first: int, second: int) -> None:
        """Raise InputError if the vectors between two frames are 0 everywhere, though the picture moves."""
        assert self._temporal.motion is not None
        pair = frozenset((first, second))
        if pair not in self._zeros_are_right:
            frames = self._motion_frame(first), self._motion_frame(second)
            self._zeros_are_right[pair] = self._temporal.motion.zeros_are_right(*frames)
        if not self._zeros_are_right[pair]:
            raise InputError(f"motion vectors between frames {first} and {second} are 0, though the picture moves")

    def _read_vectors(self, start: int, end: int) -> Way:
        """Motion from one frame to the next or the previous one."""
        motion = self._temporal.motion
        assert motion is not None
        frame, neighbour = (self._motion_frame(n) for n in (start, end))
        if motion.reads_same_back and start > end and frame.hr.data_window == neighbour.hr.data_window:
            # Always in this order, so that pixels do not depend on which frame comes first.
            start, end, frame, neighbour = end, start, neighbour, frame
        if (start, end) not in self._vectors:
            vectors, known = motion.read(frame, neighbour, end - start)
            moved_objects = self._find_moved_objects(frame, neighbour, vectors, known, {start, end})
            if moved_objects is not None:
                known &= ~moved_objects
            moves = vectors.any()
            # Only the second average needs them.
            borders = kept(near_borders(vectors, self._tolerance)) if moves and self._temporal.results else None
            way = kept(vectors) if moves else None, None if known.all() else kept(known), moved_objects, borders
            self._vectors[start, end] = way
        return self._vectors[start, end]

    @property
    def _tolerance(self) -> float:
        """See :attr:`oiio_msspl.fusion.neighbours.path.Step.tolerance`."""
        motion = self._temporal.motion
        return ROUND_TRIP_OF_FLOW if motion is not None and motion.kind == FLOW else ROUND_TRIP

    def _find_moved_objects(
        self, frame: MotionFrame, neighbour: MotionFrame, vectors: Array, known: Mask, numbers: set[int]
    ) -> Mask | None:
        """What :meth:`MotionSource.moved_objects` finds between two frames with these numbers; None if nothing."""
        motion, pair = self._temporal.motion, frozenset(numbers)
        assert motion is not None
        same_back = motion.same_both_ways and frame.hr.data_window == neighbour.hr.data_window and bool(known.all())
        if same_back and pair in self._moved_objects:
            return self._moved_objects[pair]
        found = motion.moved_objects(frame, neighbour, vectors, known) if known.any() else None
        moved_objects = kept(found) if found is not None and found.any() else None
        if same_back:
            self._moved_objects[pair] = moved_objects
        return moved_objects

    def _motion_frame(self, number: int) -> MotionFrame:
        fused, loaded = self._fused.get(number), self._loaded.get(number)
        if isinstance(fused, FusedAlone):
            return MotionFrame(fused.loaded.hr, fused.fused.rgb, fused.loaded.vectors, fused.loaded.hr_pixels)
        assert loaded is not None and not isinstance(loaded, Exception)
        return MotionFrame(loaded.hr, vectors=loaded.vectors, pixels=loaded.hr_pixels)


def _usable(number: int, outcome: T | Exception) -> T:
    """A frame, or an error that says why it can't be used: an InputError if its files are the reason."""
    if isinstance(outcome, InputError):
        raise outcome
    if isinstance(outcome, Exception):
        raise MssplError(f"frame {number}, its neighbour, has failed: {explain(outcome)[0]}") from outcome
    return outcome


def _step(frame: F, way: Way, way_back: Way, tolerance: float) -> Step[F]:
    vectors, valid, moved_objects, borders = way
    back, back_valid, _, back_borders = way_back
    return Step(frame, vectors, valid, back, back_valid, tolerance, moved_objects, borders, back_borders)


def _fused_frame(alone: FusedAlone) -> tuple[LoadedFrame, FusedFrame]:
    return alone.loaded, alone.fused


def _have_one_noise(frame: Placed, neighbour: Placed) -> bool:
    """Whether two frames have the same noise, if they are renders and not fused yet."""
    if not isinstance(frame, RenderPair) or not isinstance(neighbour, RenderPair):
        return False
    return shared_noise(frame, neighbour) > SAME_NOISE


def _check_alike(frame: tuple[LoadedFrame, Placed], neighbour: tuple[LoadedFrame, Placed]) -> None:
    """Whether two frames can be averaged.

    Raises:
        InputError: they can't.
    """
    (one, own), (other, its) = frame, neighbour
    if own.alignment.scale != its.alignment.scale:
        raise InputError(f"its pair is x{its.alignment.scale}")
    if one.hr.view != other.hr.view:
        raise InputError(f"its first view is {name_of(other.hr.view)}")
    if one.hr.display_window.size != other.hr.display_window.size:
        raise InputError(f"its size is {other.hr.display_window.size}")
    for name, ours, theirs in (("LRHS", one.lr, other.lr), ("HRLS", one.hr, other.hr)):
        lacking = _features(ours) - _features(theirs)
        if isinstance(its, RenderPair) and lacking:
            raise InputError(f"its {name} lacks {', '.join(sorted(lacking))}")


def _features(render: MappedRender) -> set[str]:
    return {*render.features, *(["alpha"] if render.alpha else [])}
