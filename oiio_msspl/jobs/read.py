# SPDX-License-Identifier: Apache-2.0
"""Reads a frame: opens its pair, maps the layers of each view, and reads pixels if there is room for them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

from oiio_msspl.aovs.features import ALBEDO, HRLS_FEATURES, NORMAL
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.aovs.views import name_of
from oiio_msspl.errors import InputError
from oiio_msspl.exr.atomic import check_separate
from oiio_msspl.fusion.neighbours.renders import RenderPair
from oiio_msspl.fusion.passes.layers import pass_features
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.image.arrays import kept
from oiio_msspl.jobs.checks import check_written_layers
from oiio_msspl.jobs.frame import NoSuchView, ShotFrame, State
from oiio_msspl.jobs.inputs import files_read, map_pair
from oiio_msspl.jobs.memory import ViewMemory, light_features
from oiio_msspl.jobs.passes import check_passes, sets_to_fuse
from oiio_msspl.jobs.plan import ShotPlan
from oiio_msspl.jobs.sequence import FrameFiles
from oiio_msspl.jobs.settings import Settings
from oiio_msspl.jobs.views import find_other_views
from oiio_msspl.model.session import Session


def read_frame(files: FrameFiles, settings: Settings, plan: ShotPlan, *, only_frame: bool = False) -> list[ShotFrame]:
    """Read a frame.

    Args:
        files: its files. Both renders exist.
        settings, plan: how the frames of the shot are fused.
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
                frame.state = State.READ
        first.seconds["read"] = time.perf_counter() - start
    for frame in frames[1:]:
        if frame.state < State.READ and frame.error is None:
            frame.error = first.error or NoSuchView(f"it has no pair for {name_of(frame.view or '')}")
    return frames


def _open(frames: Sequence[ShotFrame], settings: Settings) -> list[ShotFrame]:
    """Open the pair, map it for each view, and check all that headers tell. Return the views that it has."""
    first, inputs, write = frames[0], settings.inputs, settings.write
    files = first.files
    assert files.lr is not None and files.hr is not None
    lr, hr = map_pair(files.lr, files.hr, inputs)
    others = find_other_views(lr, hr, inputs, write)
    check_separate(files_read(lr, hr, inputs, settings.model), files.targets)
    align(lr, hr)  # refuses the pair before its pixels are read
    check_written_layers(hr, write)
    check_passes([hr, *others.hrls], write)
    views = {view.hr.view: view for view in others.views}
    _set_pair(first, lr, hr, settings)
    present = [first]
    for frame in frames[1:]:
        if frame.view in views:
            view = views.pop(frame.view)
            _set_pair(frame, view.lr, view.hr, settings)
            present.append(frame)
    for name, view in views.items():
        frame = ShotFrame(files, name, state=State.READ)
        _set_pair(frame, view.lr, view.hr, settings)
        first.others.append(frame)
    first.passed_on = others.passed_on
    return present


def _set_pair(frame: ShotFrame, lr: MappedRender, hr: MappedRender, settings: Settings) -> None:
    """Give a view its pair."""
    frame.lr, frame.hr, frame.write = lr, hr, settings.write
    if frame.view is not None:  # layers about the fused picture are those of the first view
        frame.write = replace(settings.write, error_layer=False, trust_layer=False, data_passes=False, pixel_type=None)
    sets = sets_to_fuse(hr, frame.write) if frame.plan.reach.renders else []
    frame.stored = pass_features(lr, hr, sets) if sets else (lr, hr)
    frame.renders = RenderPair(*frame.stored)


def _budget(frames: Sequence[ShotFrame], settings: Settings, *, missing: int) -> None:
    """Budget the memory of each view.

    Args:
        frames: the views of a frame that are there.
        settings: of the job.
        missing: views that this frame lacks, and of which other frames may wait.
    """
    memories = [_memory(frame, settings) for frame in frames]
    if len(frames) + missing == 1:
        frames[0].memory = memories[0]
        return
    waiting = [memory.waiting for memory in memories]
    total = sum(waiting) + missing * max(waiting)
    for frame, memory, own in zip(frames, memories, waiting, strict=True):
        frame.memory = replace(memory, other_views=total - own)


def _memory(frame: ShotFrame, settings: Settings) -> ViewMemory:
    low, high = frame.stored
    features = [*_features_of(low, high, settings), *light_features(high)]
    return ViewMemory(low, high, features, frame.plan, frame.write.error_layer, settings.max_memory)


def _features_of(lr: MappedRender, hr: MappedRender, settings: Settings) -> list[str]:
    """Return the features to decode for this model. A file may have many more, and decoding them all is slow."""
    try:
        return features_read(settings.load(align(lr, hr).scale))
    except InputError:  # the model can't be loaded, which ends the job when it is needed
        return [*HRLS_FEATURES, "alpha"]


def features_read(session: Session) -> list[str]:
    """Return the features that a model reads of either render, and those that tell what a pixel shows."""
    return list(dict.fromkeys([*session.contract.hrls, *session.contract.lrhs, ALBEDO, NORMAL, "alpha"]))


def _read_pixels(frame: ShotFrame) -> None:
    """Read the pixels of a view if the frames that live fit into memory beside a tile."""
    start = time.perf_counter()
    memory = frame.memory
    assert memory is not None
    if memory.plan.reach.frames:
        # A damaged frame is left out by its neighbours, whether its pixels and vectors wait in memory or not.
        if not memory.fits:
            memory.hr.check_pixels(memory.motion_channels, memory.features)
            memory.lr.check_pixels((), memory.features)
        elif memory.motion_channels and not memory.vectors_ahead:
            memory.hr.check_pixels(memory.motion_channels, ())
    if memory.fits:
        motion, channels = frame.plan.motion, memory.vectors_ahead
        high, stored = memory.hr.load_with(channels, memory.features, on_disk=memory.on_disk)
        vectors = motion.vectors_of(frame.hr, high, stored) if motion and channels else {}
        frame.vectors = {direction: (kept(pixels), kept(mask)) for direction, (pixels, mask) in vectors.items()}
        low = high if memory.lr is memory.hr else memory.lr.load(memory.features, on_disk=memory.on_disk)
        frame.renders = RenderPair(low, high)
    frame.seconds["read"] = time.perf_counter() - start
