# SPDX-License-Identifier: Apache-2.0
"""Decides which neighbours the frames of a shot are averaged with, and how their motion is known.

A frame depends only on the frames up to ``count`` before and after it. So a shot that is cut into chunks, or resumed,
has the pixels of one run: the neighbours of a chunk are fused again, and not written.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.aovs.motion import MotionField, read_format
from oiio_msspl.aovs.views import name_of
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.findings import Finding
from oiio_msspl.fusion.motion.source import CAMERA, FLOW, NONE, STATIC, VECTORS, MotionSource, find_motion
from oiio_msspl.jobs.inputs import InputOptions, MappedPair, find_views, map_other_hrls, map_pair
from oiio_msspl.jobs.sequence import FrameFiles, Shot
from oiio_msspl.jobs.settings import family_for_layers
from oiio_msspl.jobs.timeline import ALONE, Reach, Timeline
from oiio_msspl.model.catalogue import QUALITIES, family_of

log = logging.getLogger(__name__)

#: Words that ``--temporal`` takes in place of a number.
AUTO, OFF = "auto", "off"
#: Frames before and after a frame that it depends on, where motion is known. The second number is for the quality
#: `best`, which takes so long that averaging more renders adds little.
AUTO_COUNT, AUTO_COUNT_SLOW = 4, 6
#: The most fused frames on each side that are averaged. More of them gain less than more renders.
MOST_RESULTS = 2
#: The most frames on each side that can be asked for.
MOST = 8
#: Pairs of frames that are judged to find out how motion is stored.
PAIRS_JUDGED = 3


@dataclass(frozen=True)
class TemporalOptions:
    """How a shot is fused over time.

    Raises:
        InputError: ``frames`` is none of what it may be, or ``motion_format`` can't be read.
    """

    frames: str | int = AUTO
    """``auto``, ``off``, or the number of frames before and after a frame that it may depend on."""
    motion_format: str | None = None
    """How motion vectors are stored, see :func:`oiio_msspl.aovs.motion.user_fields`; None to find it out."""

    def __post_init__(self) -> None:
        if self.frames not in (AUTO, OFF) and not (str(self.frames).isdecimal() and 1 <= int(self.frames) <= MOST):
            raise InputError(f"--temporal {self.frames}: give auto, off, or a number of frames from 1 to {MOST}")
        if self.motion_format is not None:
            read_format(self.motion_format)

    def count(self, model: str | None = None) -> int:
        """Return how many frames before and after a frame it depends on, for a model or family, if motion is known."""
        if self.frames == AUTO:
            return AUTO_COUNT_SLOW if _is_slow(model) else AUTO_COUNT
        return 0 if self.frames == OFF else int(self.frames)


@dataclass(frozen=True)
class ViewPlan:
    """How the frames of one view are averaged with their neighbours."""

    reach: Reach = ALONE
    motion: MotionSource | None = None
    """How surfaces are followed from frame to frame; None if frames are fused alone."""


@dataclass(frozen=True)
class ShotPlan:
    """How the frames of a shot are averaged with their neighbours."""

    frames: Mapping[int, FrameFiles] = field(default_factory=dict)
    """Every frame of the shot that has both renders, whether it is to be fused or not."""
    views: Mapping[str | None, ViewPlan] = field(default_factory=lambda: {None: ViewPlan()})
    """The plan of the first view, None, and of the other views that are averaged. All depend on as many frames."""
    text: str = ""
    """One sentence for the user; empty if the user has switched it off."""

    @property
    def warnings(self) -> list[Finding]:
        """A warning if neighbours were wanted, and each frame is fused alone."""
        return [Finding("not_averaged", self.text)] if self.text and not self.count else []

    @property
    def count(self) -> int:
        """Frames before and after a frame that it depends on; 0 fuses each frame alone."""
        return self.views[None].reach.frames

    def timeline(self, wanted: Sequence[FrameFiles]) -> Timeline:
        """Return who needs whom, if these frames are to be written."""
        reach = {view: plan.reach for view, plan in self.views.items()}
        return Timeline(self.frames, [files.number for files in wanted], reach)

    def missing(self, number: int) -> list[int]:
        """Return the numbers next to a frame that lie within the shot and lack a render."""
        if not self.count or not self.frames:
            return []
        first, last = min(self.frames), max(self.frames)
        near = range(number - self.count, number + self.count + 1)
        return [n for n in near if first < n < last and n not in self.frames and n != number]


def _is_slow(model: str | None) -> bool:
    """Return whether a name stands for a model of the quality `best`. The path of a file does not."""
    name = family_of(model) or model or ""
    return name.startswith(QUALITIES["best"]) and Path(name).suffix != ".onnx"


def plan_temporal(
    shot: Shot,
    inputs: InputOptions,
    options: TemporalOptions,
    model: str | None = None,
    write: WriteOptions = WriteOptions(),
) -> ShotPlan:
    """Decide how a shot is fused over time. The decision depends on all files of the shot, not on the frames chosen.

    Each view and view layer has its own motion. If that of the first view is not known, all are fused frame by frame.

    Views whose beauty ``write`` leaves out are not planned.
    """
    if options.frames == OFF:
        return ShotPlan()
    asked = options.frames != AUTO
    low, high = shot.lr.files, shot.hr.files
    frames = {n: FrameFiles(n, low[n], high[n], shot.target(n)) for n in sorted(low.keys() & high.keys())}
    pairs = [n for n in frames if n + 1 in frames]
    if not pairs:
        if asked:
            raise InputError(f"--temporal {options.frames}: {shot.hr.pattern} has no two frames that follow each other")
        return ShotPlan(text="frame by frame: no two frames follow each other")
    # The first, middle and last pair are judged, and others in place of those that can't be read.
    numbers = list(dict.fromkeys((pairs[0], pairs[len(pairs) // 2], pairs[-1], *pairs)))
    mapped = functools.cache(lambda number: map_pair(low[number], high[number], inputs))
    count = options.count(_family_of_shot(mapped, frames, model))
    plan, text = _plan_view(_motion_of(mapped, numbers, inputs, options, required=asked), count, asked=asked)
    if plan is None:
        return ShotPlan(text=text)
    views: dict[str | None, ViewPlan] = {None: plan}
    for label in _other_views(mapped, numbers[:PAIRS_JUDGED], inputs, write):
        source = _motion_of(mapped, numbers, inputs, options, label, required=False)
        plan, reason = _plan_view(source, count, asked=asked)
        if plan is None:
            text += f"; {name_of(label)} {reason}"
        else:
            views[label] = plan
    return ShotPlan(frames, views, text)


def _family_of_shot(mapped: Callable[[int], MappedPair], numbers: Iterable[int], model: str | None) -> str | None:
    """Return the family of models that suits the first pair's layers; ``model`` itself if it names no family."""
    family = family_of(model)
    if family is None:
        return model
    for number in numbers:
        with suppress(MssplError):  # the run says so when the turn of this frame has come
            return family_for_layers(mapped(number)[1], family)
    return family


def _plan_view(source: MotionSource, count: int, *, asked: bool) -> tuple[ViewPlan | None, str]:
    """Return the plan of a view, None if it is fused frame by frame, and a sentence about it."""
    if source.kind == NONE or (source.kind == FLOW and not asked):
        hint = "; --temporal 2 uses it all the same" if source.kind == FLOW else ""
        return None, f"frame by frame: {source.text}{hint}"
    frame_count = "one frame" if count == 1 else f"{count} frames"
    return ViewPlan(reach_of(count, source.kind), source), f"with {frame_count} before and after each: {source.text}"


def _other_views(
    mapped: Callable[[int], MappedPair], numbers: Sequence[int], inputs: InputOptions, write: WriteOptions
) -> list[str]:
    """Return the views beside the first one that are fused in some of these frames."""
    views: list[str] = []
    for number in numbers:
        with suppress(InputError):  # the run says so when the turn of this frame has come
            views += [view.hr.view for view in find_views(*mapped(number), inputs, write)[0][1:]]
    return list(dict.fromkeys(views))


def reach_of(count: int, kind: str) -> Reach:
    """Divide ``count`` neighbours into renders and fused pictures, by the kind of the source of motion."""
    # Optical flow is computed on fused pictures, so renders can't be averaged before.
    results = count if kind == FLOW else min(MOST_RESULTS, count - count // 2)
    return Reach(count - results, results)


def _motion_of(
    mapped: Callable[[int], MappedPair],
    numbers: Iterable[int],
    inputs: InputOptions,
    options: TemporalOptions,
    view: str | None = None,
    *,
    required: bool,
) -> MotionSource:
    """Return the source of the motion of a view; None stands for each file's first view.

    The camera may stand still at one end, or move in one direction only, so several pairs of successive frames are
    judged until they tell how vectors are stored. A frame that can't be read is passed over, because the run says so
    when its turn comes.
    """

    def render(number: int) -> MappedRender:
        hr = mapped(number)[1]
        return hr if view is None else map_other_hrls(hr, view, inputs)

    def find(number: int, verified: Sequence[MotionField]) -> MotionSource:
        return find_motion(render(number), render(number + 1), options.motion_format, verified, required=required)

    sources: dict[int, MotionSource] = {}  # by the number of a pair's first frame
    vectors: MotionSource | None = None
    problem: InputError | None = None
    for number in numbers:
        try:
            known = vectors is not None and not vectors.tells_more(render(number))
            source = vectors if vectors and known else find(number, vectors.fields if vectors else ())
        except InputError as error:
            problem = problem or error
            log.debug("frames %d and %d: %s", number, number + 1, error)
            continue
        sources[number] = source
        if source.kind == VECTORS and not known:
            vectors = _agreed_vectors(number, sources, vectors or source, find)
        if (vectors and not vectors.silent) or len(sources) == PAIRS_JUDGED:
            break
    if problem is not None and not sources:
        if required or (options.motion_format is not None and view is None):
            raise problem
        return MotionSource(NONE, str(problem))
    if vectors and vectors.kind == NONE and required:
        hint = "describe them with --motion-format layer=NAME,to=next,x=right,y=up,unit=pixels"
        raise InputError(f"{vectors.text}; {hint}")
    preference = (CAMERA, STATIC, FLOW, NONE)
    return vectors or min(sources.values(), key=lambda source: preference.index(source.kind))


def _agreed_vectors(
    number: int,
    sources: Mapping[int, MotionSource],
    vectors: MotionSource,
    find: Callable[[int, Sequence[MotionField]], MotionSource],
) -> MotionSource:
    """Bring the vectors of a pair and those of the pairs before into agreement.

    What one pair shows has to hold for the pairs before. The pair that tells of most layers is returned; a source that
    is ``NONE`` if pairs contradict each other.
    """
    latest = sources[number]
    candidates = [vectors, latest]
    if not _agree(latest, vectors):
        candidates = [latest]
        for before in [n for n, source in sources.items() if source.kind == VECTORS and n != number]:
            candidates.append(find(before, latest.fields))
            if not _agree(candidates[-1], latest):
                texts = "; ".join(f"frames {n} and {n + 1}: {sources[n].text}" for n in (before, number))
                text = f"the frames contradict each other on how motion vectors are stored ({texts})"
                return MotionSource(NONE, text)
    best = max(candidates, key=lambda source: len(source.fields))
    return replace(best, silent=latest.silent & vectors.silent)


def _agree(one: MotionSource, other: MotionSource) -> bool:
    """Return whether two pairs of frames tell alike of each layer of vectors that both tell of."""
    formats = {vectors.name: vectors.format for vectors in one.fields}
    return all(formats.get(vectors.name, vectors.format) == vectors.format for vectors in other.fields)
