# SPDX-License-Identifier: Apache-2.0
"""The views and view layers of a pair, and their passes.

The first view goes the way of a file that has only one. The others are fused before it, one after the other, into a
temporary file, so memory holds one view at a time. In a shot, each view whose motion is known is averaged with its own
neighbours instead (:mod:`oiio_msspl.jobs.view_windows`), and memory holds frames of all these views.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from oiio_msspl.aovs.additive_sets import AdditiveSet
from oiio_msspl.aovs.features import ALBEDO, NORMAL
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.arrays import HALF_MAX
from oiio_msspl.errors import InputError
from oiio_msspl.exr.contents import dropped_channels, stored_type, widest_type
from oiio_msspl.exr.render import Render
from oiio_msspl.exr.replaced import ReplacedChannels
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.fusion.alignment import align
from oiio_msspl.fusion.fuse import FusedFrame, fuse, layer_fuser, memory_to_fuse, tile_count
from oiio_msspl.fusion.passes import fuse_passes, pass_steps
from oiio_msspl.fusion.tiling import require_memory, strips_memory
from oiio_msspl.jobs.inputs import InputOptions, map_other_view
from oiio_msspl.jobs.report import FrameReport, report_on
from oiio_msspl.model.session import Session
from oiio_msspl.parallel import limit_threads

#: Rows of a fused view that are stored at a time.
ROWS_PER_PUT = 256


@dataclass(frozen=True)
class View:
    """A pair, mapped for one view or view layer."""

    lr: MappedRender
    hr: MappedRender


@dataclass(frozen=True)
class OtherViews:
    """The views beside the first one."""

    views: tuple[View, ...] = ()
    """Those that are fused."""
    passed_on: tuple[str, ...] = ()
    """Why others are not, one sentence each."""


def find_other_views(
    lr: MappedRender, hr: MappedRender, inputs: InputOptions, write: WriteOptions = WriteOptions()
) -> OtherViews:
    """The views and view layers to fuse beside the first one: those with a beauty in both renders that is written.

    Args:
        lr, hr: the pair, mapped for its first view.
        inputs: how the files are to be understood. If it names a view, there are no others.
        write: which layers are written.

    Raises:
        InputError: the first view does not fit together, or a pattern of ``write`` matches nothing.
    """
    if inputs.view is not None or not hr.other_views:
        return OtherViews()
    scale = align(lr, hr).scale
    dropped = dropped_channels(hr.file, hr.beauty_channels, write.layers)
    taken = _channels(hr)
    views, passed_on = [], []
    for label in hr.other_views:
        try:
            view = View(*map_other_view(lr, hr, label, inputs))
            if align(view.lr, view.hr).scale != scale:
                raise InputError(f"the pair is x{align(view.lr, view.hr).scale} here and x{scale} in {hr.view}")
            if not taken.isdisjoint(view.hr.beauty_channels):
                raise InputError("its beauty is a layer of another view")
        except InputError as error:
            passed_on.append(f"{label or '(unnamed)'} is passed on as it is: {error}")
            continue
        if not dropped.issuperset(view.hr.beauty_channels):
            # A layer of no view layer may be found for several.
            sets = [each for each in view.hr.additive_sets if taken.isdisjoint(_channels_of_set(each))]
            view.hr.additive_sets = sets
            taken |= _channels(view.hr)
            views.append(view)
    return OtherViews(tuple(views), tuple(passed_on))


def _channels(hr: MappedRender) -> set[object]:
    """The channels that may be fused for a view."""
    return {*hr.beauty_channels}.union(*map(_channels_of_set, hr.additive_sets))


def _channels_of_set(additive_set: AdditiveSet) -> set[object]:
    return {channel for layer in additive_set.layers for channel in layer.channels}


def fuse_other_views(
    others: OtherViews,
    session: Session,
    write: WriteOptions,
    max_memory: int,
    *,
    held: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[ReplacedChannels | None, list[FrameReport]]:
    """Fuse the views beside the first one.

    Args:
        others: from :func:`find_other_views`.
        session: the model of the first view.
        write: which passes are fused.
        max_memory: bytes that the process should stay below.
        held: bytes of these that other frames need.
        progress: called with (steps done, steps in all) of each part of the work, see :class:`Progress`.

    Returns:
        The fused channels, None without other views; and a report on each view.

    Raises:
        InputError: a view does not fit into memory, or pixels can't be decoded.
        MssplError: the network failed.
    """
    for view in others.views:
        needed = memory_to_fuse(align(view.lr, view.hr), session, error=False) + held
        require_memory(needed, session.contract, max_memory)
    replaced = ReplacedChannels() if others.views else None
    reports = []
    for view in others.views:
        clean = bool(sets_to_fuse(view.hr, write))
        fused = fuse(view.lr, view.hr, session, clean_aovs=clean, max_memory=max_memory, held=held, progress=progress)
        fused.replaced = replaced
        # The pixel type that is asked for is that of the first view.
        own = replace(write, pixel_type=None)
        fuse_frame_passes(view.lr, view.hr, fused, session, own, max_memory - held, progress)
        reports.append(store_view(view, fused, session))
    return replaced, reports


def store_view(view: View, fused: FusedFrame, session: Session) -> FrameReport:
    """Put a fused view beside the first one where its passes are, in ``fused.replaced``, and report on it."""
    assert fused.replaced is not None
    _store(fused.replaced, view.hr, fused)
    return report_on(view.lr, view.hr, session, fused, view.hr.file.path, None)


def _store(replaced: ReplacedChannels, hr: MappedRender, fused: FusedFrame) -> None:
    """Keep the beauty and the alpha of a view. What half can't hold is clipped, and a warning says so."""
    channels = hr.beauty_channels
    height, width = fused.rgb.shape[:2]
    replaced.add(channels, width, height)
    for start in range(0, height, ROWS_PER_PUT):
        rows = slice(start, start + ROWS_PER_PUT)
        for i, channel in enumerate(channels):
            values = fused.rgb[rows, :, i] if i < 3 or fused.alpha is None else fused.alpha[rows, :, 0]
            replaced.put(channel, start, values)
    clipped = int(np.count_nonzero(fused.rgb > HALF_MAX)) if widest_type(channels) == "half" else 0
    if clipped:
        fused.warnings.append(f"{clipped} values are too bright for half and were clipped to {HALF_MAX:.0f}")


def sets_to_fuse(hr: MappedRender, write: WriteOptions) -> list[AdditiveSet]:
    """The additive sets of a view that are asked for and of which a layer is written."""
    return [each for each in _written_sets(hr, write) if not write.passes or any(each.matches(p) for p in write.passes)]


def uses_clean_aovs(hr: MappedRender, write: WriteOptions) -> bool:
    """Whether albedo and normal without noise are of use: as layers, or to fuse passes."""
    return write.data_passes or bool(sets_to_fuse(hr, write))


def check_passes(hr: MappedRender, others: OtherViews, write: WriteOptions) -> None:
    """Raise InputError if the user asks for additive sets by a name that no view has, names a sum that is not to be
    fused, or asks for data passes that the first view lacks."""
    if write.data_passes and hr.features.keys().isdisjoint((ALBEDO, NORMAL)):
        raise InputError(f"--data-passes: {hr.name} has neither an albedo nor a normal; name them with --map")
    if write.passes == ("none",) and any(each.by_user for each in hr.additive_sets):
        raise InputError("--sum and --passes none exclude each other: fuse the layers of the sum, or leave it out")
    views = [hr, *(view.hr for view in others.views)]
    if write.passes and write.passes != ("none",) and not any(sets_to_fuse(view, write) for view in views):
        if any(each.matches(p) for view in views for each in view.additive_sets for p in write.passes):
            raise InputError(
                f"--passes {', '.join(write.passes)}: --layers {', '.join(write.layers)} leaves these layers out; "
                "name them there, too"
            )
        names = dict.fromkeys(f"'{each.name}'" for view in views for each in _written_sets(view, write))
        known = ", ".join(names) or "none"
        raise InputError(f"--passes {', '.join(write.passes)}: {hr.name} has no such set of layers; it has {known}")


def _written_sets(hr: MappedRender, write: WriteOptions) -> list[AdditiveSet]:
    if write.passes == ("none",):
        return []
    dropped = dropped_channels(hr.file, hr.beauty_channels, write.layers)
    return [each for each in hr.additive_sets if any(not dropped.issuperset(x.channels) for x in each.layers)]


def fuse_frame_passes(
    lr: MappedRender,
    hr: MappedRender,
    fused: FusedFrame,
    session: Session,
    write: WriteOptions,
    max_memory: int,
    progress: Callable[[int, int], None] | None = None,
    averaged: tuple[Render, Render] | None = None,
) -> None:
    """Fuse the additive sets of :func:`sets_to_fuse` and add them to ``fused``.

    Args:
        lr, hr: the pair, as files.
        fused: its fused beauty.
        session: the model of the beauty. Its memory is used for the passes.
        write: ``passes`` says which, and ``pixel_type`` how the beauty is stored.
        max_memory: bytes that the process should stay below.
        progress: called with (steps done, steps in all) of this part of the work.
        averaged: see :func:`oiio_msspl.fusion.passes.fuse_passes`.

    Raises:
        InputError: pixels can't be decoded.
    """
    sets = sets_to_fuse(hr, write)
    if sets:
        session.release_memory()
        beauty = fused.rgb
        if stored_type(hr.beauty_channels, write) == "half" and beauty.dtype != np.float16:
            # The passes sum to the beauty that is written.
            beauty = np.minimum(beauty, np.float32(HALF_MAX)).astype(np.float16)
        with limit_threads(session.threads):
            fused.passes = fuse_passes(
                lr,
                hr,
                beauty,
                fused.alignment,
                sets,
                cache_bytes=strips_memory(max_memory, fused.nbytes),
                pixels=fused.replaced,
                guides=fused.clean_aovs,
                fuse_layers=layer_fuser(session, fused),
                averaged=averaged,
                progress=progress,
            )
        fused.replaced = fused.passes.pixels
        if session.layer_session is not None:
            session.layer_session.release_memory()


class Progress:
    """Joins the progress of all parts of a frame's work: tiles and passes of each view.

    Args:
        tell: called with (steps done, steps in all).
        steps: in all.
    """

    def __init__(self, tell: Callable[[int, int], None], steps: int) -> None:
        self._tell, self._steps, self._before = tell, steps, 0

    def __call__(self, done: int, count: int) -> None:
        """A part has done so many of its steps. It ends with all of them."""
        self._tell(self._before + done, self._steps)
        if done == count:
            self._before += count


def steps_of(views: Sequence[View], session: Session, write: WriteOptions) -> int:
    """The steps in which views are fused: a tile is one, and so is each set of passes in each band of rows."""
    steps = 0
    for view in views:
        alignment = align(view.lr, view.hr)
        by_network = session.layers is not None
        steps += tile_count(alignment, session)
        steps += pass_steps(alignment, sets_to_fuse(view.hr, write), by_network=by_network)
    return steps
