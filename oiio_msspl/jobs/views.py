# SPDX-License-Identifier: Apache-2.0
"""Finds the views and view layers of a pair, and stores what is fused of those beside the first one.

Every view goes the same way. A view whose motion is unknown has no neighbours, so it is fused and stored in a temporary
file just before the first view: memory holds one such view at a time.
"""

from __future__ import annotations

from dataclasses import dataclass

from oiio_msspl.aovs.additive_sets import AdditiveSet
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.aovs.views import name_of
from oiio_msspl.errors import InputError
from oiio_msspl.exr.contents import dropped_channels
from oiio_msspl.exr.replaced import ReplacedChannels
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.findings import Finding
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.image.arrays import HALF_MAX
from oiio_msspl.jobs.inputs import InputOptions, MappedPair, map_other_view
from oiio_msspl.jobs.report import FrameReport, report_on
from oiio_msspl.model.session import Session

#: Rows of a fused view that are stored at a time.
ROWS_PER_PUT = 256


@dataclass(frozen=True)
class OtherViews:
    """The views of a pair beside the first one."""

    views: tuple[MappedPair, ...] = ()
    """Those that are fused."""
    passed_on: tuple[str, ...] = ()
    """Why others are not, and which beauties are not written, one sentence each."""

    @property
    def hrls(self) -> list[MappedRender]:
        """The HRLS, mapped for each of ``views``."""
        return [view.hr for view in self.views]


def find_other_views(
    lr: MappedRender, hr: MappedRender, inputs: InputOptions, write: WriteOptions = WriteOptions()
) -> OtherViews:
    """Find the views and view layers to fuse beside the first one: those whose beauty or passes are written.

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
            view = map_other_view(lr, hr, label, inputs)
            if align(view.lr, view.hr).scale != scale:
                raise InputError(f"the pair is x{align(view.lr, view.hr).scale} here and x{scale} in {hr.view}")
            if not taken.isdisjoint(view.hr.beauty_channels):
                raise InputError("its beauty is a layer of another view")
        except InputError as error:
            passed_on.append(f"{name_of(label)} is passed on as it is: {error}")
            continue
        # A layer of no view layer may be found for several.
        sets = [each for each in view.hr.additive_sets if taken.isdisjoint(_channels_of_set(each))]
        view.hr.additive_sets = sets
        made = view.hr.beauty_channels if write.passes == ("none",) else _channels(view.hr)
        if not dropped.issuperset(made):
            taken |= _channels(view.hr)
            views.append(view)
        if dropped.issuperset(view.hr.beauty_channels):
            passed_on.append(f"the beauty of {name_of(label)} is left out, because --layers does not name it")
    return OtherViews(tuple(views), tuple(passed_on))


def _channels(hr: MappedRender) -> set[object]:
    """Return the channels that may be fused for a view."""
    return {*hr.beauty_channels}.union(*map(_channels_of_set, hr.additive_sets))


def _channels_of_set(additive_set: AdditiveSet) -> set[object]:
    return {channel for layer in additive_set.layers for channel in layer.channels}


def store_view(view: MappedPair, fused: FusedFrame, session: Session) -> FrameReport:
    """Put a fused view beside the first one where its passes are, in ``fused.replaced``, and report on it."""
    assert fused.replaced is not None
    _store(fused.replaced, view.hr, fused)
    return report_on(view.lr, view.hr, session, fused, view.hr.file.path, None)


def _store(replaced: ReplacedChannels, hr: MappedRender, fused: FusedFrame) -> None:
    """Keep the beauty and the alpha of a view. What half can't hold is clipped, and a warning says so.

    An alpha in a part with another data window is passed on as it is.
    """
    channels = [each for each in hr.beauty_channels if hr.file.parts[each.part].data_window == hr.data_window]
    if len(channels) < len(hr.beauty_channels):
        text = "the alpha has another data window than the beauty, so it is passed on as it is"
        fused.warnings.append(Finding("no_alpha", text))
    height, width = fused.rgb.shape[:2]
    replaced.add(channels, width, height)
    clipped = 0
    for start in range(0, height, ROWS_PER_PUT):
        rows = slice(start, start + ROWS_PER_PUT)
        for i, channel in enumerate(channels):
            values = fused.rgb[rows, :, i] if i < 3 or fused.alpha is None else fused.alpha[rows, :, 0]
            clipped += replaced.put(channel, start, values)
    if clipped:
        text = f"{clipped} values are too bright for half and were clipped to {HALF_MAX:.0f}"
        fused.warnings.append(Finding("clipped", text))
