# SPDX-License-Identifier: Apache-2.0
"""Fuses the frames of a shot with their neighbours: which ones, in which order, and what waits for what.

A frame depends on the frames up to ``count`` before and after it, and on nothing else. So a shot that is cut into
chunks, or resumed, has the same pixels as one run: the neighbours of a chunk are fused again, and not written.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.arrays import Array
from oiio_msspl.errors import InputError, explain
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.fusion.motion import CAMERA, FLOW, NONE, STATIC, VECTORS, Mask, MotionFrame, MotionSource, find_motion
from oiio_msspl.fusion.temporal import Step, accumulate, memory_to_accumulate, shared_noise
from oiio_msspl.jobs.inputs import InputOptions, map_pair
from oiio_msspl.jobs.sequence import Frame, Shot
from oiio_msspl.model.session import Session

if TYPE_CHECKING:
    from oiio_msspl.jobs.stages import LoadedFrame

log = logging.getLogger(__name__)

T = TypeVar("T", bound=np.generic)

#: What ``--temporal`` takes beside a number.
AUTO, OFF = "auto", "off"
#: Frames before and after a frame, where motion is known.
AUTO_COUNT = 2
#: The most that can be asked for.
MOST = 8
#: Frames have the same noise above this correlation. Independent ones stay below 0.1.
SAME_NOISE = 0.5
SAME_SEED = "have the same noise, which no average removes; let the renderer change its seed from frame to frame"
#: Bytes of a pixel: a fused frame with alpha, a vector and whether it is believed, and the averaged frame.
FRAME_BYTES, VECTOR_BYTES, RESULT_BYTES = 16, 9, 20
#: The neighbours of frames with more pixels are kept in temporary files.
MOST_PIXELS = 5_000_000


@dataclass(frozen=True)
class TemporalOptions:
    """How a shot is fused over time.

    Raises:
        InputError: ``frames`` is none of what it may be.
    """

    frames: str | int = AUTO
    """``auto``, ``off``, or the number of frames before and after each frame."""
    motion_format: str | None = None
    """How motion vectors are stored, see :func:`oiio_msspl.aovs.motion.user_fields`; None to find it out."""

    def __post_init__(self) -> None:
        if self.frames not in (AUTO, OFF) and not (str(self.frames).isdecimal() and int(self.frames) <= MOST):
            raise InputError(f"--temporal {self.frames}: give auto, off, or a number of frames up to {MOST}")

    @property
    def count(self) -> int:
        """Frames before and after each frame, if their motion is known."""
        return {AUTO: AUTO_COUNT, OFF: 0}[str(self.frames)] if self.frames in (AUTO, OFF) else int(self.frames)


@dataclass(frozen=True)
class Temporal:
    """How the frames of a shot are fused with their neighbours."""

    count: int = 0
    """Frames before and after a frame; 0 fuses each frame alone."""
    motion: MotionSource | None = None
    frames: Mapping[int, Frame] = field(default_factory=dict)
    """Every frame of the shot that has both renders, whether it is to be fused or not."""
    text: str = ""
    """One sentence for the user; empty if the user has switched it off."""

    def neighbours(self, number: int) -> list[int]:
        """The frames that a frame depends on, in order. Behind a missing frame there are none."""
        found = []
        for step in (-1, 1):
            for offset in range(1, self.count + 1):
                if number + step * offset not in self.frames:
                    break
                found.append(number + step * offset)
        return sorted(found)

    def absolute(self) -> Temporal:
        """The same with absolute paths, for workers with other working directories."""
        return replace(self, frames={n: frame.absolute() for n, frame in self.frames.items()})

    def files_beside(self, hr: Path) -> list[Path]:
        """The files of the neighbours of the frame whose HRLS this is."""
        number = next((n for n, frame in self.frames.items() if frame.hr == hr), None) if self.count else None
        beside = [] if number is None else [self.frames[n] for n in self.neighbours(number)]
        return [path for frame in beside for path in (frame.lr, frame.hr) if path is not None]

    def memory(self, window: Window) -> int:
        """Bytes that the neighbours of a frame take, and averaging them; from its data window."""
        if not self.count:
            return 0
        pixels = window.width * window.height
        held = 2 * self.count * (FRAME_BYTES + 2 * VECTOR_BYTES) if pixels <= MOST_PIXELS else 0
        return (held + RESULT_BYTES) * pixels + memory_to_accumulate(window)

    def missing(self, number: int) -> list[int]:
        """The numbers next to a frame that lie within the shot, and of which a render is missing."""
        if not self.count or not self.frames:
            return []
        first, last = min(self.frames), max(self.frames)
        near = range(number - self.count, number + self.count + 1)
        return [each for each in near if first < each < last and each not in self.frames and each != number]


def plan_temporal(shot: Shot, inputs: InputOptions, options: TemporalOptions) -> Temporal:
    """Decide how a shot is fused over time. The decision depends on all files of the shot, not on the frames chosen.

    Raises:
        InputError: the user asks for neighbours, and nothing is known of the motion.
    """
    count, asked = options.count, options.frames != AUTO
    if count == 0:
        return Temporal()
    low, high = shot.lr.files, shot.hr.files
    frames = {n: Frame(n, low[n], high[n], shot.output.path(n)) for n in sorted(low.keys() & high.keys())}
    pairs = [n for n in frames if n + 1 in frames]
    if not pairs:
        if asked:
            raise InputError(f"--temporal {count}: {shot.hr.pattern} has no two frames that follow each other")
        return Temporal(text="frame by frame: no two frames follow each other")
    source = _motion_of(frames, pairs, inputs, options, required=asked)
    if source.kind == NONE or (source.kind == FLOW and not asked):
        hint = "; --temporal 2 uses it all the same" if source.kind == FLOW else ""
        return Temporal(text=f"frame by frame: {source.text}{hint}")
    frame_count = "one frame" if count == 1 else f"{count} frames"
    return Temporal(count, source, frames, f"with {frame_count} before and after each: {source.text}")


def _motion_of(
    frames: Mapping[int, Frame],
    pairs: Sequence[int],
    inputs: InputOptions,
    options: TemporalOptions,
    *,
    required: bool,
) -> MotionSource:
    """How the motion of a shot is known, by the first pair of frames, the middle one and the last one.

    The camera may stand still at one end. A pair that can't be read is passed over, because the run says so when its
    turn comes.
    """
    found: list[MotionSource] = []
    problem: InputError | None = None
    for number in dict.fromkeys((pairs[0], pairs[len(pairs) // 2], pairs[-1])):
        try:
            first, second = (_map_hrls(frames[n], inputs) for n in (number, number + 1))
            found.append(find_motion(first, second, options.motion_format, required=required))
        except InputError as error:
            problem = problem or error
            log.debug("frames %d and %d: %s", number, number + 1, error)
            continue
        if found[-1].kind == VECTORS:
            break
    for kind in (VECTORS, CAMERA, STATIC, FLOW):
        for source in found:
            if source.kind == kind:
                return source
    if found:
        return found[0]
    assert problem is not None
    if required or options.motion_format is not None:
        raise problem
    return MotionSource(NONE, str(problem))


def _map_hrls(frame: Frame, inputs: InputOptions) -> MappedRender:
    assert frame.lr is not None and frame.hr is not None
    return map_pair(frame.lr, frame.hr, inputs)[1]


@dataclass(frozen=True)
class FusedAlone:
    """A frame that is fused without its neighbours."""

    loaded: LoadedFrame
    session: Session
    fused: FusedFrame
    seconds: float
    """Wall time of fusing."""


class FrameWindow:
    """Keeps fused frames until those are complete that need them.

    Args:
        temporal: which frames need which.
        frames: what is to be written.
    """

    def __init__(self, temporal: Temporal, frames: Sequence[Frame]) -> None:
        self._temporal = temporal
        self._wanted = {frame.number: frame for frame in frames}
        self._done: dict[int, FusedAlone | BaseException] = {}
        self._vectors: dict[tuple[int, int], tuple[Array | None, Mask | None]] = {}

    def order(self) -> list[Frame]:
        """The frames to fuse, in this order: what is to be written, and what that depends on."""
        if not self._temporal.count:
            return list(self._wanted.values())
        needed = sorted({each for n in self._wanted for each in (n, *self._temporal.neighbours(n))})
        return [self._wanted.get(n) or self._temporal.frames[n] for n in needed]

    def add(self, number: int, outcome: FusedAlone | BaseException) -> list[tuple[Frame, FusedAlone | BaseException]]:
        """Keep a frame that is fused, or the reason why it could not be.

        Returns:
            The frames to write that have all their neighbours now, in order.
        """
        if isinstance(outcome, FusedAlone) and self._temporal.count:
            fused = outcome.fused
            fused.rgb, fused.alpha = kept(fused.rgb), None if fused.alpha is None else kept(fused.alpha)
        self._done[number] = outcome
        ready = [
            (frame, self._done[n])
            for n, frame in self._wanted.items()
            if n in self._done and all(each in self._done for each in self._temporal.neighbours(n))
        ]
        for frame, _ in ready:
            del self._wanted[frame.number]
        return ready

    def accumulate(self, number: int) -> FusedFrame:
        """A frame averaged with its neighbours. Neighbours that are missing or broken are named in its warnings."""
        alone = self._done[number]
        assert isinstance(alone, FusedAlone)
        if not self._temporal.count:
            return alone.fused
        warnings = list(alone.fused.warnings)
        missing = self._temporal.missing(number)
        warnings += [f"frame {each} is missing, so fewer neighbours are averaged" for each in missing]
        before, after = (self._steps(number, step, warnings) for step in (-1, 1))
        if not before and not after:
            return replace(alone.fused, warnings=warnings)
        result = accumulate(alone.fused, before, after)
        return replace(alone.fused, rgb=result.rgb, alpha=result.alpha, frames=result.frames, warnings=warnings)

    def release(self) -> None:
        """Forget the frames that no other one needs any more."""
        needed = {each for n in self._wanted for each in (n, *self._temporal.neighbours(n))}
        self._done = {n: outcome for n, outcome in self._done.items() if n in needed}
        self._vectors = {(a, b): kept for (a, b), kept in self._vectors.items() if a in self._done and b in self._done}

    def _steps(self, number: int, step: int, warnings: list[str]) -> list[Step]:
        """The way from a frame to its neighbours on one side, up to the first that can't be used."""
        steps: list[Step] = []
        here = self._done[number]
        assert isinstance(here, FusedAlone)
        neighbours = [n for n in self._temporal.neighbours(number) if (n - number) * step > 0]
        for n in neighbours[::step]:
            there = self._done[n]
            problem = explain(there)[0] if isinstance(there, Exception) else None
            if isinstance(there, FusedAlone):
                problem = _difference(here, there)
                if problem is None and abs(n - number) == 1 and shared_noise(here.fused, there.fused) > SAME_NOISE:
                    warnings.append(f"frames {number} and {n} {SAME_SEED}")
                if problem is None:
                    (vectors, valid), (back, back_valid) = (
                        self._read_vectors(start, end) for start, end in ((n - step, n), (n, n - step))
                    )
                    steps.append(Step(there.fused, vectors, valid, back, back_valid))
            if problem is not None:
                warnings.append(f"frame {n} is not averaged: {problem}")
                break
        return steps

    def _read_vectors(self, start: int, end: int) -> tuple[Array | None, Mask | None]:
        """Motion from one frame to the next or the previous one."""
        if (start, end) not in self._vectors:
            one, other = (self._done[n] for n in (start, end))
            assert isinstance(one, FusedAlone) and isinstance(other, FusedAlone) and self._temporal.motion is not None
            frame, neighbour = (MotionFrame(each.loaded.hr, each.fused.rgb) for each in (one, other))
            vectors, valid = self._temporal.motion.read(frame, neighbour, end - start)
            self._vectors[start, end] = kept(vectors) if vectors.any() else None, None if valid.all() else kept(valid)
        return self._vectors[start, end]


def kept(values: NDArray[T]) -> NDArray[T]:
    """Values (h, w, ...) of a frame that waits for others: in memory, or in a temporary file if there are many."""
    if values.shape[0] * values.shape[1] <= MOST_PIXELS:
        return values
    with tempfile.TemporaryFile(prefix="msspl-") as file:
        on_disk = np.memmap(file, values.dtype, "w+", shape=values.shape)
    on_disk[:] = values
    return on_disk


def _difference(frame: FusedAlone, neighbour: FusedAlone) -> str | None:
    """Why two frames can't be averaged, or None."""
    one, other = frame.fused.alignment, neighbour.fused.alignment
    if one.scale != other.scale:
        return f"its pair is x{other.scale}"
    sizes = [each.loaded.hr.display_window.size for each in (frame, neighbour)]
    return None if sizes[0] == sizes[1] else f"its size is {sizes[1]}"
