# SPDX-License-Identifier: Apache-2.0
"""The way of a shot: each frame is averaged, fused, settled and handed over as soon as its neighbours are there.

A single frame is a shot of one. Files, Blender and the tasks of a farm are sources of frames for the same
:meth:`ShotRun.take`.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any
from weakref import WeakValueDictionary

import numpy as np

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB, VARIANCE, is_light_of_pass
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.errors import InputError, MssplError, explain
from oiio_msspl.exr.contents import stored_type
from oiio_msspl.exr.render import Render
from oiio_msspl.exr.replaced import ReplacedChannels
from oiio_msspl.exr.writer import bytes_held
from oiio_msspl.findings import Finding, codes_of
from oiio_msspl.fusion.fuse import FusedFrame, fuse, memory_to_fuse
from oiio_msspl.fusion.motion.shot import ShotMotion
from oiio_msspl.fusion.motion.source import MotionFrame
from oiio_msspl.fusion.neighbours.alone import fuse_alone
from oiio_msspl.fusion.neighbours.average import average_renders, average_results
from oiio_msspl.fusion.neighbours.hops import find_hops
from oiio_msspl.fusion.neighbours.path import Hop
from oiio_msspl.fusion.neighbours.renders import RenderPair, lacking_passes
from oiio_msspl.fusion.passes.fuse import PassInputs, fuse_passes
from oiio_msspl.fusion.passes.layers import is_large
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.fusion.tiles.tiling import require_memory, result_bytes, strips_memory
from oiio_msspl.image.arrays import HALF_MAX, kept
from oiio_msspl.image.parallel import limit_threads
from oiio_msspl.jobs.existing import ExistingResults
from oiio_msspl.jobs.frame import NoSuchView, ShotFrame, features_read, read_frame
from oiio_msspl.jobs.memory import check_frame_memory, light_features
from oiio_msspl.jobs.passes import Progress, costs_of, sets_to_fuse
from oiio_msspl.jobs.plan import ShotPlan
from oiio_msspl.jobs.report import FrameReport, add_other_views, report_on, written_layers
from oiio_msspl.jobs.sequence import FrameFiles
from oiio_msspl.jobs.settings import Settings
from oiio_msspl.jobs.timeline import Key, neighbours
from oiio_msspl.jobs.write import store_view
from oiio_msspl.model.contract import ONE_SIZE


class ShotRun:
    """Fuses the frames of a shot. A frame is kept until no other frame needs it.

    Args:
        wanted: the frames to write.
        only_frame: the shot is a single frame, which has all memory to itself.
        tell: called with (thousandths done, 1000) of the work on a single frame.
        yields_errors: :meth:`take` also yields a frame with an error that is not to be written.
    """

    def __init__(
        self,
        settings: Settings,
        plan: ShotPlan,
        wanted: Sequence[FrameFiles],
        *,
        only_frame: bool = False,
        tell: Callable[[int, int], None] | None = None,
        yields_errors: bool = False,
    ) -> None:
        self.settings, self.plan = settings, plan
        self._only_frame, self._tell, self._yields_errors = only_frame, tell, yields_errors
        self._progress: Progress | None = None
        self._wanted = {files.number: files for files in wanted}
        self._timeline = plan.timeline(wanted)
        self._frames: dict[Key, ShotFrame] = {}
        self._last_read = WeakValueDictionary[str | None, ShotFrame]()
        self._motion = {view: ShotMotion(own.motion) for view, own in plan.views.items() if own.motion is not None}

    @property
    def existing(self) -> ExistingResults:
        """What becomes of results that exist."""
        return ExistingResults(self.settings, self.plan)

    @property
    def order(self) -> list[FrameFiles]:
        """The frames to read, in this order: those to write, and all that these depend on."""
        return [self._wanted.get(number) or self.plan.frames[number] for number in self._timeline.order]

    def read(self, files: FrameFiles) -> list[ShotFrame]:
        """Read a frame, and what its average needs. While one is fused, another thread can read the next one."""
        frames = read_frame(files, self.settings, self.plan, only_frame=self._only_frame)
        averaged = (frame for frame in frames if frame.was_read and frame.plan.reach.renders)
        in_memory = {frame.view: frame for frame in averaged if frame.memory and frame.memory.fits}
        for view, frame in in_memory.items():
            before = self._last_read.get(view)
            with contextlib.suppress(Exception):  # the average will meet it again, and say it
                frame.renders.prepare()
                if before is not None and frame.number == before.number + 1:
                    self._motion[view].between(before.for_motion, frame.for_motion)
        self._last_read = WeakValueDictionary(in_memory)  # which keeps no pixels
        return frames

    def take(self, views: Sequence[ShotFrame]) -> Iterator[ShotFrame]:
        """Take the views of a frame that is read, and yield each frame that can be written now, or has an error.

        Raises:
            InputError: the model can't be loaded, which no other frame would change.
        """
        self._frames.update({frame.key: frame for frame in views})
        for key in self._timeline.fusable(views[0].number):
            frame = self._frames[key]
            self._average_and_fuse(frame)
            if frame.error is not None and self._yields_errors:
                yield frame
            self._timeline.fused(key)
            for number in self._timeline.settled():
                first = self._frames[number, None]
                self._settle(first)
                yield first
                del first  # or its pixels would be held while the next frame is fused
            self._release()

    def _average_and_fuse(self, frame: ShotFrame) -> None:
        """Average the renders of a frame with those of its neighbours, and let the network fuse the means.

        The views that are fused by themselves come before.
        """
        frame.warnings += [
            Finding("missing_neighbour", f"frame {number} is missing, so fewer neighbours are averaged")
            for number in self.plan.missing(frame.number)
        ]
        if frame.error is not None:
            return
        frame.session = self.settings.session(align(frame.lr, frame.hr).scale)
        start = time.perf_counter()
        with frame.attempt():
            if not self.plan.count and self.existing.skips(frame.files):
                raise InputError("another run has fused it")  # is recorded as skipped
            layers = bytes_held(frame.hr.file, frame.hr.beauty_channels, frame.write)
            most, held = self.settings.max_memory, frame.held_bytes
            check_frame_memory(align(frame.lr, frame.hr), frame.session, frame.write, most, layers, held)
            frame.averaged = frame.read_if_small() if self._only_frame else frame.renders
            if frame.plan.reach.renders:
                self._average_renders(frame)
            if self._tell is not None:
                views = [view.hr for view in (*frame.others, frame)]
                self._progress = Progress(self._tell, costs_of(views, frame.session, frame.write))
            if frame.number in self._wanted:
                self._fuse_others(frame)
            frame.fused = self.fuse(frame)
            if frame.plan.reach.results:
                _keep(frame.fused)
        frame.seconds["fuse"] = time.perf_counter() - start

    def _average_renders(self, frame: ShotFrame) -> None:
        """Put the means over neighbours in the place of a frame's renders, and keep what its passes are fused from."""
        before, after = self._hops(frame, "renders")
        if not (before or after):
            return
        lacking = any(lacking_passes(frame.renders, hop.frame) for hop in (*before, *after))
        passes = [] if lacking else light_features(frame.stored[1])
        features = [*features_read(frame.session), *passes]
        if VARIANCE in features and (not frame.write.trust or "same_seed" in codes_of(frame.warnings)):
            features.remove(VARIANCE)
        lr, hr, frame.frame_counts = average_renders(frame.renders, before, after, features)
        frame.averaged = RenderPair(lr, hr)
        if passes:
            high = _for_passes(hr, on_disk=is_large(frame.hr))
            frame.means = high if lr is hr else _for_passes(lr, on_disk=is_large(frame.hr)), high

    def _fuse_others(self, first: ShotFrame) -> None:
        """Fuse the views without neighbours, and store them, so that memory holds one at a time."""
        for view in first.others:
            alignment = align(view.lr, view.hr)
            needed = memory_to_fuse(alignment, first.session.contract, error=False) + first.held_bytes
            require_memory(needed, first.session.contract, self.settings.max_memory)
        for view in first.others:
            view.session, view.memory = first.session, first.memory
            view.averaged = view.renders
            self._store_view(first, view, self.fuse(view))

    def _store_view(self, first: ShotFrame, view: ShotFrame, picture: FusedFrame) -> None:
        """Fuse the passes of a view, and store it among the channels that all views of a frame replace."""
        picture.replaced = first.replaced = first.replaced or ReplacedChannels()
        self._fuse_passes(view, picture)
        store_view(view.hr, picture, picture.replaced)
        view.report = report_on(view.lr, view.hr, view.session, picture, view.hr.file.path, None)

    def fuse(self, frame: ShotFrame) -> FusedFrame:
        """Fuse the averaged renders of a frame."""
        # Other views are stored as float first, and fused frames that are averaged are float.
        is_stored = frame.view is None and not self.plan.count
        fused = fuse(
            frame.averaged.lr,
            frame.averaged.hr,
            frame.session,
            error=frame.write.error_layer,
            trust=frame.write.trust,
            clean_aovs=frame.write.data_passes or bool(sets_to_fuse(frame.hr, frame.write)),
            half=is_stored and stored_type(frame.hr.beauty_channels, frame.write) == "half",
            share=_share_by_spp(frame.lr, frame.hr),
            max_memory=self.settings.max_memory,
            held=frame.held_bytes,
            progress=self._progress,
        )
        frame.averaged, fused.frames = RenderPair(*frame.stored), frame.frame_counts
        cache_bytes = strips_memory(self.settings.max_memory, frame.held_bytes)
        fuse_alone(
            frame.renders, fused, frame.session, share=_share_by_spp(frame.lr, frame.hr), cache_bytes=cache_bytes
        )
        return fused

    def _settle(self, first: ShotFrame) -> None:
        """Average the fused views of a frame with those of its neighbours, and fuse what depends on the result."""
        start = time.perf_counter()
        with first.attempt():
            views = [self._frames[first.number, view] for view in self.plan.views]
            views = [frame for frame in views if not isinstance(frame.error, NoSuchView)]
            for frame in views:
                frame.require()
            if self.plan.count and self.existing.skips(first.files):
                raise InputError("another run has fused it")  # is recorded as skipped
            picture = self._average_results(first)
            for frame in views[1:]:
                self._store_view(first, frame, self._average_results(frame))
            picture.replaced = first.replaced
            self._fuse_passes(first, picture)
            first.picture, first.report = picture, self._report(first, picture, [*first.others, *views[1:]])
            if self.settings.strict and first.report.warnings:
                raise InputError(f"not written, because warnings are errors: {'; '.join(first.report.warnings)}")
            busy = sum(frame.seconds["fuse"] for frame in views) + time.perf_counter() - start
            first.report.seconds = {"read": first.seconds["read"], "fuse": busy, **first.report.seconds}

    def _report(self, first: ShotFrame, picture: FusedFrame, others: Sequence[ShotFrame]) -> FrameReport:
        """Report on a frame that is settled: its first view with the final picture, and its other views."""
        report = report_on(first.lr, first.hr, first.session, picture, first.files.output, first.files.preview)
        report.layers = written_layers(first.hr, first.write)
        views = sorted(others, key=lambda other: first.hr.other_views.index(other.hr.view))
        passed_on = [Finding("view_not_fused", text) for text in first.passed_on]
        add_other_views(report, [view.report for view in views], passed_on)
        return report

    def _average_results(self, frame: ShotFrame) -> FusedFrame:
        """Average a fused frame with its neighbours. Those that are missing or broken are named in its warnings."""
        picture = frame.fused
        assert picture is not None
        if not self.plan.count:
            return picture
        before, after = self._hops(frame, "results")
        warnings = list(dict.fromkeys([*picture.warnings, *frame.warnings]))
        if before or after:
            picture = average_results(picture, before, after)
        # Averages of averages count no frame twice.
        most = 1 + len(neighbours(frame.number, self.plan.count, self.plan.frames))
        frames = None if picture.frames is None else np.minimum(picture.frames, np.float32(most))
        return replace(picture, warnings=warnings, frames=frames)

    def _fuse_passes(self, frame: ShotFrame, picture: FusedFrame) -> None:
        """Fuse the passes of a view and add them to its final picture."""
        sets = sets_to_fuse(frame.hr, frame.write)
        if not sets:
            return
        session, beauty, renders = frame.session, picture, (frame.renders.lr, frame.renders.hr)
        session.release_memory()  # for the passes
        if stored_type(frame.hr.beauty_channels, frame.write) == "half" and beauty.rgb.dtype != np.float16:
            # The passes sum to the beauty that is written.
            beauty = replace(picture, rgb=np.minimum(picture.rgb, np.float32(HALF_MAX)).astype(np.float16))
        held = frame.held_bytes + result_bytes(picture.alignment, error=picture.error is not None)
        with limit_threads(session.threads):
            picture.passes = fuse_passes(
                PassInputs(frame.lr, frame.hr, beauty, sets, frame.means, renders),
                picture.replaced,
                session=session,
                cache_bytes=strips_memory(self.settings.max_memory, held),
                progress=self._progress,
            )
        picture.replaced = picture.passes.pixels
        session.release_layer_memory()

    def _hops(self, frame: ShotFrame, kind: str) -> list[list[Hop[Any]]]:
        """Return the hops before and after a frame to the neighbours whose "renders" or "results" are averaged."""

        def frame_of(number: int) -> tuple[MotionFrame, Any]:
            other = self._frames[number, frame.view]
            if not other.was_read or (kind == "results" and other.fused is None):
                assert other.error is not None
                if isinstance(other.error, InputError):
                    raise other.error  # its files can't be used, so it is left out in every run
                # Without it, the frame would have other pixels than in another run.
                reason = explain(other.error)[0]
                raise MssplError(f"frame {number}, its neighbour, has failed: {reason}") from other.error
            return other.for_motion, other.fused if kind == "results" else other.renders

        motion, sides = self._motion[frame.view], self._timeline.sides(frame.key, kind)
        return [find_hops(motion, frame.number, side, frame_of, frame.warnings) for side in sides]

    def _release(self) -> None:
        """Forget what no frame needs any more."""
        renders, pictures = self._timeline.needs_renders(), self._timeline.needs_pictures()
        for key, frame in list(self._frames.items()):
            if key not in renders and frame.was_read:
                frame.renders = RenderPair(*frame.stored)  # the files can still be read, also while it is written
            if key not in renders | pictures:
                frame.vectors = {}
                del self._frames[key]
                if frame.view in self._motion:
                    self._motion[frame.view].forget(frame.number)
                continue
            if key not in pictures:
                frame.fused = None
            if not self._timeline.waits(frame.number):
                frame.means = frame.frame_counts = None
                if frame.fused is not None:
                    frame.fused = replace(frame.fused, clean_aovs={}, error=None, frames=None)


def _share_by_spp(lr: MappedRender, hr: MappedRender) -> float | None:
    """Return the share of the first of two renders of one size in their mean; None for other pairs, or unknown spp."""
    if lr.spp is None or hr.spp is None or align(lr, hr).scale != ONE_SIZE:
        return None
    return lr.spp / (lr.spp + hr.spp)


def _keep(fused: FusedFrame) -> None:
    """Let a fused picture wait for its neighbours, in temporary files if it is large."""
    fused.rgb = kept(fused.rgb)
    fused.alpha = None if fused.alpha is None else kept(fused.alpha)
    fused.error = None if fused.error is None else kept(fused.error)


def _for_passes(render: Render, *, on_disk: bool) -> Render:
    """Return what passes are fused from of a render that waits for its neighbours."""
    needed = [name for name in render.layers if name in (RGB, ALBEDO, NORMAL) or is_light_of_pass(name)]
    return replace(render, layers={name: kept(render.layers[name], on_disk=on_disk) for name in needed})
