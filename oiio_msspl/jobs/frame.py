# SPDX-License-Identifier: Apache-2.0
"""Reads a frame of a shot, and keeps what is known of it on its way to its result, one record for each view.

Its pair is opened, the layers of each view are mapped, and pixels are read if there is room for them.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial

from oiio_msspl.aovs.features import ALBEDO, HRLS_FEATURES, NORMAL, VARIANCE
from oiio_msspl.aovs.mapped_render import ROWS_PER_LOAD, MappedRender
from oiio_msspl.aovs.views import name_of
from oiio_msspl.errors import InputError
from oiio_msspl.exr.atomic import check_separate
from oiio_msspl.exr.render import Render
from oiio_msspl.exr.replaced import ReplacedChannels
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.findings import Finding
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.fusion.motion.source import MotionFrame
from oiio_msspl.fusion.neighbours.renders import RenderPair
from oiio_msspl.fusion.passes.layers import is_large, pass_features
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.image.arrays import Array, Mask, kept
from oiio_msspl.jobs.inputs import MappedPair, files_by_name, find_views, map_pair
from oiio_msspl.jobs.memory import ViewMemory, budget_view, light_features
from oiio_msspl.jobs.passes import check_layers, sets_to_fuse
from oiio_msspl.jobs.plan import ShotPlan, ViewPlan
from oiio_msspl.jobs.report import FrameReport
from oiio_msspl.jobs.sequence import FrameFiles
from oiio_msspl.jobs.settings import Settings
from oiio_msspl.jobs.timeline import Key
from oiio_msspl.model.contract import ONE_SIZE
from oiio_msspl.model.session import Session


class NoSuchView(InputError):
    """A frame lacks a view that other frames of the shot have."""


@dataclass(eq=False)
class ShotFrame:
    """One view of a frame on its way from its files to its EXR."""

    files: FrameFiles
    view: str | None = None
    """The name of a view beside the first one; None for the first one, whose name may differ from frame to frame."""
    plan: ViewPlan = field(default_factory=ViewPlan)
    error: Exception | None = None
    """Why it did not come further."""
    warnings: list[Finding] = field(default_factory=list)
    """What is wrong with its neighbours, one sentence each."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time by what it was spent on: ``read`` and ``fuse``."""

    was_read: bool = False
    """Whether its pair is open and mapped, which sets the attributes below. Its pixels are in memory, if there is room.
    """
    lr: MappedRender = field(init=False)
    hr: MappedRender = field(init=False)
    stored: tuple[MappedRender, MappedRender] = field(init=False)
    """The pair as files, with the light of its passes if renders are averaged with those of neighbours."""
    renders: RenderPair = field(init=False)
    """What is averaged and fused: pixels in memory, or ``stored``."""
    write: WriteOptions = field(init=False)
    """What is written of this view."""
    memory: ViewMemory | None = None
    """The budget of this view's frames; None if there is only one frame."""
    vectors: Mapping[int, tuple[Array, Mask]] = field(default_factory=dict)
    """Motion vectors that were read with the pixels, see :class:`oiio_msspl.fusion.motion.source.MotionFrame`."""
    others: list[ShotFrame] = field(default_factory=list)
    """Of the first view: the views without neighbours, which are fused before it."""
    passed_on: tuple[str, ...] = ()
    """Of the first view: why further views are not fused, one sentence each."""

    # Once its renders are averaged with those of its neighbours
    averaged: RenderPair = field(init=False)
    """The means over neighbours; ``renders`` if there are none. Given up when the frame is fused."""
    means: tuple[Render, Render] | None = None
    """What passes are fused from of both means; None if there are no neighbours, or no passes to fuse."""
    frame_counts: Array | None = None
    """(h, w, 1): how many frames each pixel is the mean of; None if there are no neighbours."""

    session: Session = field(init=False)
    """The model for the scale of the pair."""

    # Once the network has fused it
    fused: FusedFrame | None = None
    """As the network fused it, for as long as a frame needs it."""
    replaced: ReplacedChannels | None = None
    """Of the first view: the channels of other views, fused."""

    # Once its picture is averaged with those of its neighbours, and its passes are fused
    picture: FusedFrame | None = None
    """What is written, until it is."""
    report: FrameReport = field(init=False)
    """On this view; that of the first view is about all views."""

    @property
    def number(self) -> int:
        """The frame number."""
        return self.files.number

    @property
    def key(self) -> Key:
        """What a timeline knows this frame by."""
        return self.files.number, self.view

    @property
    def for_motion(self) -> MotionFrame:
        """What its motion is read from."""
        picture = None if self.fused is None else self.fused.rgb
        return MotionFrame(self.hr, picture, self.vectors, self.renders.hr, self.number, self.lr)

    @property
    def held_bytes(self) -> int:
        """Memory of other frames while this one is fused."""
        return self.memory.held if self.memory else 0

    @contextmanager
    def attempt(self) -> Iterator[None]:
        """Keep an exception of the block as the frame's error, so that other frames go on."""
        try:
            yield
        except Exception as error:
            traceback.clear_frames(error.__traceback__)  # or they would keep pixels
            self.error = error

    def require(self) -> None:
        """Raise what went wrong with this frame."""
        if self.error is not None:
            raise self.error

    def read_if_small(self) -> RenderPair:
        """Return the renders. Those of a small frame are decoded once, with the passes to fuse, into memory.

        Raises:
            InputError: pixels can't be decoded.
        """
        if self.renders.hr is self.stored[1] and not is_large(self.hr):
            low, high = pass_features(self.lr, self.hr, sets_to_fuse(self.hr, self.write))
            loaded = high.load([*high.features, "alpha"])
            self.renders = RenderPair(loaded if low is high else low.load([*low.features, "alpha"]), loaded)
        return self.renders


def read_frame(files: FrameFiles, settings: Settings, plan: ShotPlan, *, only_frame: bool = False) -> list[ShotFrame]:
    """Read a frame whose renders exist.

    Args:
        only_frame: no other frame needs memory. Pixels are then read from the files as the network needs them.

    Returns:
        A record for each view of the plan, the first view in front. One that can't be used has an ``error``. Views
        that the plan lacks are the ``others`` of the first one.
    """
    start = time.perf_counter()
    frames = [ShotFrame(files, view, own) for view, own in plan.views.items()]
    first = frames[0]
    with first.attempt():
        present = _open(frames, settings)
        if not only_frame:
            _budget(present, settings, missing=len(frames) - len(present))
        for frame in present:
            with frame.attempt():
                if not only_frame:
                    _read_pixels(frame)
                frame.was_read = True
        first.seconds["read"] = time.perf_counter() - start
    for frame in frames[1:]:
        if not frame.was_read and frame.error is None:
            frame.error = first.error or NoSuchView(f"it has no pair for {name_of(frame.view or '')}")
    return frames


def _open(frames: Sequence[ShotFrame], settings: Settings) -> list[ShotFrame]:
    """Open the pair, map it for each view, and check all that headers tell. Return the views that it has."""
    first, inputs, write = frames[0], settings.inputs, settings.write
    files = first.files
    lr, hr = map_pair(*files.pair, inputs)
    views, first.passed_on = find_views(lr, hr, inputs, write)
    read = files_by_name(files.pair, inputs, settings.model)
    check_separate({*read, *lr.file.siblings, *hr.file.siblings}, files.targets)
    align(lr, hr)  # refuses the pair before its pixels are read
    check_layers([view.hr for view in views], write)
    pairs: dict[str | None, MappedPair] = {view.hr.view: view for view in views[1:]}
    pairs[None] = views[0]
    present = [frame for frame in frames if frame.view in pairs]
    planned = {frame.view for frame in frames}
    first.others = [ShotFrame(files, name, was_read=True) for name in pairs if name not in planned]
    for frame in (*present, *first.others):
        _set_pair(frame, *pairs[frame.view], settings)
    return present


def _set_pair(frame: ShotFrame, lr: MappedRender, hr: MappedRender, settings: Settings) -> None:
    frame.lr, frame.hr, frame.write = lr, hr, settings.write
    if frame.view is not None:  # layers about the fused picture are those of the first view
        frame.write = replace(settings.write, error_layer=False, trust_layer=False, data_passes=False, pixel_type=None)
    # Coarser layers are sums of averages.
    sets = [replace(layers, coarser=()) for layers in sets_to_fuse(hr, frame.write) if frame.plan.reach.renders]
    frame.stored = pass_features(lr, hr, sets) if sets else (lr, hr)
    frame.renders = RenderPair(*frame.stored)


def _budget(frames: Sequence[ShotFrame], settings: Settings, *, missing: int) -> None:
    """Budget the memory of each view that is there. Of those that are ``missing``, other frames may wait."""
    budgets = []
    for frame in frames:
        low, high = frame.stored
        try:  # a file may have many more features than the model reads, and decoding them all is slow
            features = features_read(settings.session(align(low, high).scale))
        except InputError:  # the model can't be used, which ends the job when it is needed
            features = [*HRLS_FEATURES, "alpha"]
        features += light_features(high)
        most, error = settings.max_memory, frame.write.error_layer
        budgets.append(partial(budget_view, low, high, features, frame.plan, error=error, max_memory=most))
    waiting = [budget().waiting for budget in budgets]
    total = sum(waiting) + missing * max(waiting)
    for frame, budget, own in zip(frames, budgets, waiting, strict=True):
        frame.memory = budget(other_views=total - own)


def features_read(session: Session) -> list[str]:
    """Return the features that a model reads of either render, and those that tell what a pixel shows, or its noise."""
    variance = [VARIANCE] if session.contract.scale == ONE_SIZE else []
    return list(dict.fromkeys([*session.contract.hrls, *session.contract.lrhs, ALBEDO, NORMAL, "alpha", *variance]))


def _read_pixels(frame: ShotFrame) -> None:
    """Read the pixels of a view if the frames that live fit into memory beside a tile."""
    start = time.perf_counter()
    memory, (low, high) = frame.memory, frame.stored
    assert memory is not None
    if memory.motion_channels and not (memory.fits and memory.vectors_ahead):
        # A frame with damaged vectors fails, however much memory there is.
        for window in high.data_window.bands(ROWS_PER_LOAD):
            high.file.read(memory.motion_channels, window)
    if memory.fits:
        motion, channels = frame.plan.motion, memory.vectors_ahead
        loaded, stored = high.load_with(channels, memory.features, on_disk=memory.on_disk)
        vectors = motion.vectors_of(frame.hr, loaded, stored) if motion and channels else {}
        frame.vectors = {direction: (kept(pixels), kept(mask)) for direction, (pixels, mask) in vectors.items()}
        loaded_low = loaded if low is high else low.load(memory.features, on_disk=memory.on_disk)
        frame.renders = RenderPair(loaded_low, loaded)
    frame.seconds["read"] = time.perf_counter() - start
