# SPDX-License-Identifier: Apache-2.0
"""Which passes of a frame are fused, and the steps in which a frame is fused, for progress."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from oiio_msspl.aovs.additive_sets import AdditiveSet
from oiio_msspl.aovs.features import ALBEDO, NORMAL
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.errors import InputError
from oiio_msspl.exr.contents import dropped_channels
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.fusion.passes.fuse import pass_steps
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.fusion.tiles.tiling import tile_count
from oiio_msspl.model.session import Session


def sets_to_fuse(hr: MappedRender, write: WriteOptions) -> list[AdditiveSet]:
    """Return the additive sets of a view that are asked for and have a layer that is written."""
    sets = _written_sets(hr, write)
    return [layers for layers in sets if not write.passes or any(layers.matches(p) for p in write.passes)]


def uses_clean_aovs(hr: MappedRender, write: WriteOptions) -> bool:
    """Return whether albedo and normal without noise are of use: as layers, or to fuse passes."""
    return write.data_passes or bool(sets_to_fuse(hr, write))


def check_passes(views: Sequence[MappedRender], write: WriteOptions) -> None:
    """Check what is asked for by the headers.

    Args:
        views: the HRLS, mapped for each of its views; the first one in front.
        write: what is asked for.

    Raises:
        InputError: no view has additive sets of this name, a sum of the user's is not to be fused, or the first view
            lacks the data passes.
    """
    hr = views[0]
    if write.data_passes and hr.features.keys().isdisjoint((ALBEDO, NORMAL)):
        raise InputError(f"--data-passes: {hr.name} has neither an albedo nor a normal; name them with --map")
    if write.passes == ("none",) and any(layers.by_user for layers in hr.additive_sets):
        raise InputError("--sum and --passes none exclude each other: fuse the layers of the sum, or leave it out")
    if write.passes and write.passes != ("none",) and not any(sets_to_fuse(view, write) for view in views):
        if any(layers.matches(p) for view in views for layers in view.additive_sets for p in write.passes):
            raise InputError(
                f"--passes {', '.join(write.passes)}: --layers {', '.join(write.layers)} leaves these layers out; "
                "name them there, too"
            )
        names = dict.fromkeys(f"'{layers.name}'" for view in views for layers in _written_sets(view, write))
        listed = ", ".join(names) or "none"
        raise InputError(f"--passes {', '.join(write.passes)}: {hr.name} has no such set of layers; it has {listed}")


def _written_sets(hr: MappedRender, write: WriteOptions) -> list[AdditiveSet]:
    if write.passes == ("none",):
        return []
    dropped = dropped_channels(hr.file, hr.beauty_channels, write.layers)
    written = (layers for layers in hr.additive_sets if any(not dropped.issuperset(x.channels) for x in layers.layers))
    return list(written)


class Progress:
    """Joins the progress of all parts of a frame's work: tiles and passes of each view.

    Args:
        tell: called with (steps done, steps in all).
        steps: in all.
    """

    def __init__(self, tell: Callable[[int, int], None], steps: int) -> None:
        self._tell, self._steps, self._before = tell, steps, 0

    def __call__(self, done: int, count: int) -> None:
        """Take the steps that a part has done. A part ends with all of its steps."""
        self._tell(self._before + done, self._steps)
        if done == count:
            self._before += count


def steps_of(views: Sequence[tuple[MappedRender, MappedRender]], session: Session, write: WriteOptions) -> int:
    """Return the steps in which views are fused: a tile is one, and so is each set of passes in each band of rows."""
    steps = 0
    for lr, hr in views:
        alignment = align(lr, hr)
        steps += tile_count(alignment, session.contract)
        steps += pass_steps(alignment, sets_to_fuse(hr, write), by_network=session.layers is not None)
    return steps
