# SPDX-License-Identifier: Apache-2.0
"""Says which passes of a frame are fused, which layers are written, and how far this work is, for progress."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from oiio_msspl.aovs.additive_sets import AdditiveSet
from oiio_msspl.aovs.features import ALBEDO, NORMAL
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.errors import InputError
from oiio_msspl.exr.contents import dropped_channels
from oiio_msspl.exr.write_options import ADDED, WriteOptions
from oiio_msspl.exr.writer import check_layout
from oiio_msspl.model.catalogue import measured
from oiio_msspl.model.session import Session


def sets_to_fuse(hr: MappedRender, write: WriteOptions) -> list[AdditiveSet]:
    """Return the additive sets of a view that are asked for and have a layer that is written."""
    sets = _written_sets(hr, write)
    return [layers for layers in sets if not write.passes or any(layers.matches(p) for p in write.passes)]


def check_layers(views: Sequence[MappedRender], write: WriteOptions) -> None:
    """Check by the headers that the layers and passes that are asked for exist, and that one file can hold them all.

    Args:
        views: the HRLS, mapped for each of its views; the first one in front.
    """
    hr = views[0]
    added = [name for name, option in ADDED.items() if getattr(write, option)]
    lacking = {f"denoised_{name}" for name in (ALBEDO, NORMAL) if name not in hr.features}
    check_layout(hr.file, hr.beauty_channels, write, [name for name in added if name not in lacking])
    if write.data_passes and hr.features.keys().isdisjoint((ALBEDO, NORMAL)):
        raise InputError(f"--data-passes: {hr.name} has neither an albedo nor a normal; name them with --map")
    if write.passes == ("none",) and any(layers.by_user for layers in hr.additive_sets):
        raise InputError("--sum and --passes none exclude each other: fuse the layers of the sum, or leave it out")
    if write.passes and write.passes != ("none",) and not any(sets_to_fuse(view, write) for view in views):
        names = dict.fromkeys(f"'{layers.name}'" for view in views for layers in _written_sets(view, write))
        what = "such set of layers" + (f" that --layers {', '.join(write.layers)} keeps" if write.layers else "")
        listed = ", ".join(names) or "none"
        raise InputError(f"--passes {', '.join(write.passes)}: {hr.name} has no {what}; it has {listed}")


def _written_sets(hr: MappedRender, write: WriteOptions) -> list[AdditiveSet]:
    if write.passes == ("none",):
        return []
    dropped = dropped_channels(hr.file, hr.beauty_channels, write.layers)
    return [layers for layers in hr.additive_sets if any(not dropped.issuperset(x.channels) for x in layers.layers)]


#: Cost of a megapixel, where 1 is Open Image Denoise's: one layer of a set, by fitting and by a network, and one
#: channel that is written. Measured on a frame of 1920 x 1080 with four light groups.
FITTED_LAYER, NETWORK_LAYER, WRITTEN_CHANNEL = 0.075, 0.3, 0.006
#: Parts into which the progress of a frame is divided.
WHOLE = 1000


class Progress:
    """Joins the progress of all parts of a frame's work, each of which counts what it costs.

    Args:
        tell: called with (thousandths that are done, ``WHOLE``).
        costs: of the parts, in their order.
    """

    def __init__(self, tell: Callable[[int, int], None], costs: Sequence[float]) -> None:
        self._tell, self._costs, self._part = tell, costs, 0

    def __call__(self, done: int, count: int) -> None:
        """Take the steps that a part has done. A part ends with all of its steps."""
        before = sum(self._costs[: self._part])
        here = self._costs[self._part] * done / count if self._part < len(self._costs) else 0
        self._tell(round(WHOLE * (before + here) / sum(self._costs)), WHOLE)
        if done == count:
            self._part += 1


def costs_of(views: Sequence[MappedRender], session: Session, write: WriteOptions) -> list[float]:
    """Return what the parts of a frame's work cost: tiles and passes of each view, and then writing."""
    of_tiles, costs = measured().get(session.name, {}).get("time_vnni", 1.0), []
    of_layer = NETWORK_LAYER if session.layers else FITTED_LAYER
    for hr in views:
        megapixels = hr.data_window.width * hr.data_window.height / 1e6
        costs.append(megapixels * of_tiles)
        if sets := sets_to_fuse(hr, write):
            costs.append(megapixels * of_layer * sum(len(additive.layers) for additive in sets))
    channels = sum(len(part.channels) for part in views[-1].file.parts)
    return [*costs, WRITTEN_CHANNEL * megapixels * channels]
