# SPDX-License-Identifier: Apache-2.0
"""The three stages of a frame: read the pair, fuse it, write the result.

A single frame takes them one after the other (:mod:`oiio_msspl.jobs.frame`). A shot, and each chunk of frames on a Dask
worker, runs them in a pipeline (:mod:`oiio_msspl.jobs.pipeline`).
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from oiio_msspl.aovs.features import ALBEDO, HRLS_FEATURES, NORMAL, RGB, is_light_of_pass
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.aovs.views import name_of
from oiio_msspl.errors import InputError
from oiio_msspl.exr.atomic import check_separate
from oiio_msspl.exr.contents import stored_type
from oiio_msspl.exr.preview import is_our_preview
from oiio_msspl.exr.render import ReadableRender, Render
from oiio_msspl.exr.replaced import ReplacedChannels
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.fusion.fuse import FusedFrame, fuse
from oiio_msspl.fusion.neighbours.renders import RenderPair, average_renders, lacking_passes
from oiio_msspl.fusion.passes.layers import pass_features
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.fusion.tiles.tiling import FIXED_MEMORY, MAX_MEMORY
from oiio_msspl.image.arrays import Array, Mask, kept
from oiio_msspl.jobs.frame_checks import check_frame_memory, check_written_layers, require_outputs
from oiio_msspl.jobs.frame_memory import FrameMemory, is_large, light_features
from oiio_msspl.jobs.frame_passes import check_passes, fuse_frame_passes, sets_to_fuse, uses_clean_aovs
from oiio_msspl.jobs.frame_window import FusedAlone, Neighbours
from oiio_msspl.jobs.frame_writing import write_frame
from oiio_msspl.jobs.inputs import InputOptions, files_by_name, files_read, map_pair
from oiio_msspl.jobs.report import FrameReport, add_other_views, report_on, written_layers
from oiio_msspl.jobs.sequence import Frame
from oiio_msspl.jobs.temporal import Temporal
from oiio_msspl.jobs.views import FusedViews, OtherViews, View, find_other_views, fuse_other_views, store_view
from oiio_msspl.model.catalogue import load_model
from oiio_msspl.model.session import Session


@dataclass(frozen=True)
class LoadedFrame:
    """A frame whose pair is open and mapped."""

    frame: Frame
    lr: MappedRender
    hr: MappedRender
    averaged_lr: MappedRender
    """``lr`` with the features of its passes, if renders are averaged with those of neighbours; otherwise ``lr``."""
    averaged_hr: MappedRender
    """``hr``, likewise."""
    lr_pixels: ReadableRender
    """The LRHS in memory, or ``averaged_lr`` itself if the pair does not fit."""
    hr_pixels: ReadableRender
    """The HRLS in memory, or ``averaged_hr`` itself if the pair does not fit."""
    seconds: float
    """Wall time of reading."""
    stages: Stages
    """The stages with what belongs to this view: its neighbours, the layers that are written of it, and the memory that
    other views take."""
    vectors: Mapping[int, tuple[Array, Mask]] = field(default_factory=dict)
    """Motion vectors that are read with the pixels, see :class:`oiio_msspl.fusion.motion.source.MotionFrame`."""
    others: OtherViews = field(default_factory=OtherViews)
    """Views beside the first one that are fused by themselves. Their pixels are read then."""


@dataclass(frozen=True)
class Stages:
    """The stages and their settings, which are those of :func:`oiio_msspl.jobs.shot.fuse_shot`.

    Each stage may run in a thread of its own, but not twice at the same time.
    """

    inputs: InputOptions = InputOptions()
    write_options: WriteOptions = WriteOptions()
    model: str | None = None
    device: str = "cpu"
    threads: int = 0
    max_memory: int = MAX_MEMORY
    view_transform: str | None = None
    overwrite: bool = False
    skip_existing: bool = False
    update: bool = False
    temporal: Temporal = field(default_factory=Temporal)
    """Which neighbours each frame is fused with."""
    held_by_other_views: int = 0
    """Memory that frames of other views take while they wait. It is 0 if only one view is averaged."""
    reads_ahead: bool = True
    """Whether the pixels of a frame are read while another one is fused. If not, there is only one frame at a time."""
    sessions: dict[tuple[int, str | None], Session] = field(default_factory=dict)
    """Models that are loaded, by scale and ``model``."""

    def skips(self, frame: Frame) -> bool:
        """Whether a frame counts as done: its EXR exists and is not to be replaced."""
        return self.skip_existing and frame.output.is_file() and not self.replaces(frame.lr, frame.hr, frame.output)

    def replaces(self, lr: Path | None, hr: Path | None, output: Path) -> bool:
        """Whether an EXR that exists is replaced: with ``overwrite`` always, with ``update`` if an input is newer."""
        return self.overwrite or (self.update and bool(self.newer_inputs(lr, hr, output)))

    def replaces_preview(self, png: Path | None) -> bool:
        """Whether a PNG that exists is replaced. If frames that exist are skipped, only a preview of ours is: a killed
        run may have left it, or it shows an EXR that is replaced."""
        return self.overwrite or (self.skip_existing and png is not None and is_our_preview(png))

    def newer_inputs(self, lr: Path | None, hr: Path | None, output: Path) -> list[Path]:
        """The files that a frame is made from and that were changed after ``output``, which exists."""
        if lr is None or hr is None or not output.exists():
            return []
        written = output.stat().st_mtime
        files = files_by_name([lr, hr, *self.temporal.files_beside(hr)], hr, self.inputs, self.model)
        return [path for path in files if path.is_file() and path.stat().st_mtime > written]

    def read(self, frame: Frame) -> LoadedFrame:
        """The first view of :meth:`read_views`.

        Raises:
            InputError: a file can't be used, or the two renders don't fit together.
        """
        loaded = self.read_views(frame)[None]
        if isinstance(loaded, Exception):
            raise loaded
        return loaded

    def read_views(self, frame: Frame) -> dict[str | None, LoadedFrame | Exception]:
        """Open and map a pair, and read its pixels if the frames that are held fit into memory beside a tile.

        Returns:
            Under None the first view, and by name those beside it that are averaged with their neighbours. In place of
            one whose pixels can't be read: the reason.

        Raises:
            InputError: a file can't be used, or the two renders don't fit together.
        """
        start = time.perf_counter()
        assert frame.lr is not None and frame.hr is not None
        lr, hr = map_pair(frame.lr, frame.hr, self.inputs)
        others = find_other_views(lr, hr, self.inputs, self.write_options)
        check_separate(files_read(lr, hr, self.inputs, self.model), frame.targets)
        align(lr, hr)  # refuses the pair before its pixels are read
        check_written_layers(hr, self.write_options)
        check_passes([hr, *others.hrls], self.write_options)
        over_time = [view for view in others.views if view.hr.view in self.temporal.views]
        alone = replace(others, views=tuple(view for view in others.views if view not in over_time))
        found: dict[str | None, LoadedFrame | Exception] = {}
        for view, stages in self._stages_of_views([View(lr, hr), *over_time]):
            found[None if view.hr is hr else view.hr.view] = stages._loaded(frame, view.lr, view.hr)
        first = found[None]
        if isinstance(first, LoadedFrame):
            found[None] = replace(first, others=alone, seconds=time.perf_counter() - start)
        return found

    def _stages_of_views(self, views: Sequence[View]) -> Iterator[tuple[View, Stages]]:
        """Views of a frame with their stages: the first one, and those that are averaged with their neighbours."""
        plans = self.temporal.views
        # Layers about the fused picture are those of the first view.
        options = replace(self.write_options, error_layer=False, data_passes=False, pixel_type=None)
        others = [replace(self, temporal=plans[view.hr.view], write_options=options) for view in views[1:]]
        stages = [self, *others]
        if not plans:
            waiting = [0]
        else:
            pairs = [each._with_passes(*view) for each, view in zip(stages, views, strict=True)]
            waiting = [each._memory(*pair).waiting for each, pair in zip(stages, pairs, strict=True)]
            waiting += [max(waiting)] * (len(plans) - len(others))  # a frame may lack a view of which others wait
        for view, each, own in zip(views, stages, waiting, strict=False):
            yield view, replace(each, held_by_other_views=sum(waiting) - own)

    def _loaded(self, frame: Frame, lr: MappedRender, hr: MappedRender) -> LoadedFrame | Exception:
        """The view of :meth:`_load`, or why its pixels can't be read."""
        try:
            return self._load(frame, lr, hr)
        except Exception as error:
            traceback.clear_frames(error.__traceback__)  # or they would keep the pixels that were read
            return error

    def _load(self, frame: Frame, lr: MappedRender, hr: MappedRender) -> LoadedFrame:
        """Read the pixels of a view if the frames that are held fit into memory beside a tile."""
        start = time.perf_counter()
        low, high = self._with_passes(lr, hr)
        memory = self._memory(low, high) if self.reads_ahead else None
        if memory is not None and self.temporal.count:
            # A damaged frame is left out by its neighbours, whether its pixels and vectors wait in memory or not.
            if not memory.fits:
                high.check_pixels(memory.motion_channels, memory.features)
                low.check_pixels((), memory.features)
            elif memory.motion_channels and not memory.vectors_ahead:
                high.check_pixels(memory.motion_channels, ())
        if memory is None or not memory.fits:
            return LoadedFrame(frame, lr, hr, low, high, low, high, time.perf_counter() - start, self)
        motion, channels = self.temporal.motion, memory.vectors_ahead
        pixels, stored = high.load_with(channels, memory.features, on_disk=memory.on_disk)
        vectors = motion.vectors_of(hr, pixels, stored) if motion and channels else {}
        waiting = {step: (kept(each), kept(known)) for step, (each, known) in vectors.items()}
        low_pixels = low.load(memory.features, on_disk=memory.on_disk)
        seconds = time.perf_counter() - start
        return LoadedFrame(frame, lr, hr, low, high, low_pixels, pixels, seconds, self, waiting)

    def _with_passes(self, lr: MappedRender, hr: MappedRender) -> tuple[MappedRender, MappedRender]:
        """A pair with the features of the passes that are to be fused, if renders are averaged with those of
        neighbours."""
        sets = sets_to_fuse(hr, self.write_options) if self.temporal.renders else []
        return pass_features(lr, hr, sets) if sets else (lr, hr)

    def _memory(self, lr: MappedRender, hr: MappedRender) -> FrameMemory:
        """The memory of the frames of a view, from a pair of :meth:`_with_passes`."""
        error = self.write_options.error_layer
        features = self._features(lr, hr)
        return FrameMemory(lr, hr, features, self.temporal, error, self.max_memory, self.held_by_other_views)

    def session(self, loaded: LoadedFrame) -> Session:
        """The model for this pair's scale. Each model is loaded once.

        Raises:
            InputError: there is no such model, or it does not make a layer that is asked for.
        """
        session = self._session(loaded.lr, loaded.hr)
        require_outputs(session, self.write_options)
        return session

    def _session(self, lr: MappedRender, hr: MappedRender) -> Session:
        scale = align(lr, hr).scale
        session = self.sessions.get((scale, self.model))
        if session is None:
            session = self.sessions[scale, self.model] = load_model(scale, self.model, self.device, self.threads)
        return session

    def _features(self, lr: MappedRender, hr: MappedRender) -> list[str]:
        """The features of a pair that are read: a file may have many more, and to decode and keep these takes long."""
        try:
            return [*_features_read(self._session(lr, hr)), *light_features(hr)]
        except InputError:  # which `session` raises, too, when the frame's turn has come
            return [*HRLS_FEATURES, "alpha", *light_features(hr)]

    def fuse(
        self,
        loaded: LoadedFrame,
        session: Session,
        neighbours: Neighbours,
        progress: Callable[[int, int], None] | None = None,
    ) -> FusedAlone:
        """Fuse the beauty of a pair.

        Args:
            loaded: the pair.
            session: a model for its scale.
            neighbours: frames before and after it, whose renders are averaged with its own before.
            progress: called with (tiles done, tiles in all).

        Raises:
            InputError: the pair does not fit into memory, or pixels can't be decoded.
            MssplError: the network failed.
        """
        start = time.perf_counter()
        held = self._held_bytes(loaded)
        check_frame_memory(loaded.lr, loaded.hr, session, self.write_options, self.max_memory, held)
        pair, frames, averaged = RenderPair(loaded.lr_pixels, loaded.hr_pixels), None, None
        if any(neighbours):
            passes = light_features(loaded.averaged_hr)
            if any(lacking_passes(pair, step.frame) for steps in neighbours for step in steps):
                passes = []
            means = average_renders(pair, *neighbours, [*_features_read(session), *passes])
            pair, frames = RenderPair(means.lr, means.hr), means.frames
            if passes:
                on_disk = is_large(loaded.hr)
                averaged = _kept(means.lr, on_disk=on_disk), _kept(means.hr, on_disk=on_disk)
        fused = fuse(
            pair.lr,
            pair.hr,
            session,
            error=self.write_options.error_layer,
            clean_aovs=uses_clean_aovs(loaded.hr, self.write_options),
            # Fused frames that are averaged are float.
            half=stored_type(loaded.hr.beauty_channels, self.write_options) == "half" and not self.temporal.count,
            max_memory=self.max_memory,
            held=held,
            progress=progress,
        )
        fused.frames = frames
        # The pixels in memory are not needed any more. A neighbour may need the frame for a while.
        alone = replace(loaded, lr_pixels=loaded.averaged_lr, hr_pixels=loaded.averaged_hr)
        return FusedAlone(alone, session, fused, time.perf_counter() - start, averaged)

    def fuse_others(
        self, loaded: LoadedFrame, session: Session, held: int = 0, progress: Callable[[int, int], None] | None = None
    ) -> FusedViews:
        """Fuse the views beside the first one that are fused by themselves.

        Args:
            loaded, session, progress: see :meth:`fuse`.
            held: memory of other frames.

        Raises:
            InputError, MssplError: see :meth:`fuse`.
        """
        options = self.write_options
        return fuse_other_views(loaded.others, session, options, self.max_memory, held=held, progress=progress)

    def complete(
        self,
        alone: FusedAlone,
        fused: FusedFrame,
        views: Iterable[tuple[FusedAlone, FusedFrame]] = (),
        others: FusedViews | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> FrameReport:
        """Fuse what depends on the final beauty: the passes, and other views.

        Args:
            alone: the frame.
            fused: its final beauty; gets the passes.
            views: the same for each view beside the first one that is averaged with its neighbours.
            others: what :meth:`fuse_others` returned, if it was called before.
            progress: called with (steps done, steps in all) of each set of passes.

        Returns:
            The report, complete but for the time and the warnings of writing.

        Raises:
            InputError, MssplError: see :meth:`fuse`.
        """
        start, busy = time.perf_counter(), alone.seconds
        loaded, session = alone.loaded, alone.session
        if others is None:
            others = self.fuse_others(loaded, session, self._held_bytes(loaded) + fused.nbytes)
        fused.replaced, reports = others
        for report, seconds in self._complete_views(fused, views):
            reports.append(report)
            busy += seconds
        reports.sort(key=lambda each: loaded.hr.other_views.index(each.hr.view))
        self._fuse_passes(alone, fused, progress)
        report = report_on(loaded.lr, loaded.hr, session, fused, loaded.frame.output, loaded.frame.preview)
        report.layers = written_layers(loaded.hr, self.write_options)
        add_other_views(report, reports, [*loaded.others.passed_on, *self._not_planned(loaded.others)])
        busy += time.perf_counter() - start
        report.seconds = {"read": loaded.seconds, "fuse": busy, "network": report.network_seconds}
        return report

    def _not_planned(self, others: OtherViews) -> list[str]:
        """A sentence for each view that is fused frame by frame because the plan for the shot does not know it."""
        names = [view.hr.view for view in others.views if self.temporal.count]
        new = [name_of(name) for name in names if name not in self.temporal.looked_at]
        return [f"{name} is fused frame by frame: the frames by which its motion is found lack it" for name in new]

    def _complete_views(
        self, fused: FusedFrame, views: Iterable[tuple[FusedAlone, FusedFrame]]
    ) -> Iterator[tuple[FrameReport, float]]:
        """Fuse the passes of other views and put all that is fused of them into ``fused``, the frame of the first view.

        Yields:
            The report on each, and the seconds for which it was fused before it was averaged.
        """
        for alone, final in views:
            final.replaced = fused.replaced or ReplacedChannels()
            alone.loaded.stages._fuse_passes(alone, final)
            fused.replaced = final.replaced
            yield store_view(View(alone.loaded.lr, alone.loaded.hr), final, alone.session), alone.seconds

    def _fuse_passes(
        self, alone: FusedAlone, fused: FusedFrame, progress: Callable[[int, int], None] | None = None
    ) -> None:
        """Fuse the passes of a view, given its final beauty."""
        loaded, session = alone.loaded, alone.session
        room = self.max_memory - self._held_bytes(loaded)
        fuse_frame_passes(
            loaded.lr, loaded.hr, fused, session, self.write_options, room, progress, averaged=alone.averaged
        )

    def _held_bytes(self, loaded: LoadedFrame) -> int:
        """Memory of other frames while one is fused."""
        return self._memory(loaded.averaged_lr, loaded.averaged_hr).held if self.reads_ahead else 0

    def write(self, report: FrameReport, fused: FusedFrame) -> None:
        """Write preview and EXR, see :func:`oiio_msspl.jobs.frame_writing.write_frame`.

        Raises:
            InputError: another process has put a file there in the meantime.
            MssplError: the file system refused. An old frame is as it was; of a new one nothing is left.
        """
        start = time.perf_counter()
        overwrite = self.overwrite or (
            report.output.exists() and self.replaces(report.lr.file.path, report.hr.file.path, report.output)
        )
        # Half of what is left: compression and the preview need memory, too. In a shot, the next frame needs all.
        cache_bytes = 0 if self.reads_ahead else max(0, self.max_memory - FIXED_MEMORY - fused.nbytes) // 2
        write_frame(
            report,
            fused,
            self.write_options,
            self.view_transform,
            overwrite=overwrite,
            overwrite_preview=self.replaces_preview(report.preview),
            cache_bytes=cache_bytes,
        )
        report.seconds["write"] = time.perf_counter() - start


def _features_read(session: Session) -> list[str]:
    """The features that a model reads of either render, and those that tell it what they show."""
    return list(dict.fromkeys([*session.contract.hrls, *session.contract.lrhs, ALBEDO, NORMAL, "alpha"]))


def _kept(render: Render, *, on_disk: bool) -> Render:
    """What passes are fused from of a render that waits for its neighbours."""
    needed = [name for name in render.layers if name in (RGB, ALBEDO, NORMAL) or is_light_of_pass(name)]
    return replace(render, layers={name: kept(render.layers[name], on_disk=on_disk) for name in needed})
