# SPDX-License-Identifier: Apache-2.0
"""Fuses places of a frame again, from its own renders: those where no neighbour counts.

``docs/design/temporal.md`` says why such pixels become those that the frame has without neighbours.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.fusion.neighbours.bands import whole_grid
from oiio_msspl.fusion.neighbours.renders import RenderPair
from oiio_msspl.fusion.tiles.network import FusedPixels, fuse_tiles, tile_tasks
from oiio_msspl.fusion.tiles.prepare import FramePair
from oiio_msspl.image.arrays import Array, Mask, blank, unload
from oiio_msspl.image.filters import all_within, max_around
from oiio_msspl.image.parallel import limit_threads
from oiio_msspl.model.session import Session

#: Up to the first number of frames a pixel stands alone, from the second on it does not. In between, both pictures are
#: mixed.
ALONE, AVERAGED = 1.02, 1.2
#: Places are fused again that hold a square of this many HRLS pixels on a side.
SMALLEST = 9


def fuse_alone(
    pair: RenderPair, frame: FusedFrame, session: Session, *, share: float | None = None, cache_bytes: int = 0
) -> None:
    """Replace the pixels of a frame that stand alone by those that its own renders give.

    Args:
        pair: the frame's own renders.
        frame: fused from the averages of its renders with those of its neighbours; ``frames`` counts them. Its colour,
            alpha, error and trust change.
        session: the model.
        share: see :func:`oiio_msspl.fusion.fuse.fuse`.
        cache_bytes: for decoded rows that several places read.

    Raises:
        InputError: pixels can't be decoded.
        MssplError: the network failed, or returned NaN or infinite values.
    """
    alignment, counts = frame.alignment, frame.frames
    if counts is None:
        return
    window, seconds = alignment.hr_data_window, session.seconds
    alone = whole_grid(alignment, lambda core: _alone(counts[core.slices(window)]))[..., 0]
    reach = max(1, SMALLEST // 2 // alignment.scale)
    places = max_around(all_within(alone >= 0.5, reach), reach)
    if not places.any() or alone.min() == 1:  # a frame that stands alone was fused from its own renders
        return
    with limit_threads(session.threads), pair.hr.cache_strips(cache_bytes):
        own = FramePair(pair.lr, pair.hr, alignment, session.contract, share=share)
        error: Array | None = None if frame.error is None else blank(frame.error.shape)
        trust = None if frame.trust is None else frame.trust.copy()
        result = FusedPixels(blank(frame.rgb.shape), None, error, alignment, own.exposure, trust=trust)
        # Tiles begin at multiples of the contract's alignment, which is no more than the overlap: none meets another.
        boxes = _boxes(places, 2 * session.contract.overlap)
        tiles = [tile for box in boxes for tile in own.tiles(box.shift(alignment.grid.x0, alignment.grid.y0))]
        for task in fuse_tiles(tile_tasks(own, result, tiles=tiles), session):
            target = task.tile.features.hrls_target.slices(window)
            weight = _alone(counts[target])
            for image, new in ((frame.rgb, result.rgb), (frame.alpha, result.alpha), (frame.error, result.error)):
                if image is not None and new is not None:
                    image[target] += weight * (new[target] - image[target])
                    unload(image)
                    unload(new)
            del task  # or its memory would be held while the next one is fused
        if frame.trust is not None and trust is not None:
            frame.trust += alone * (trust - frame.trust)
    session.release_memory(to_system=False)
    frame.seconds += session.seconds - seconds


def _alone(frames: Array) -> Array:
    """Return how much pixels that are averages of so many frames stand alone, from 0 to 1."""
    return np.clip((AVERAGED - frames) / np.float32(AVERAGED - ALONE), 0, 1)


def _boxes(places: Mask, gap: int) -> Iterator[Window]:
    """Yield boxes that hold all places (h, w). More than ``gap`` rows or columns lie between two of them."""
    rows, columns = (np.flatnonzero(places.any(axis=axis)) for axis in (1, 0))
    for axis, used in enumerate((rows, columns)):
        starts = used[1:][np.diff(used) > gap]
        if len(starts):
            for start, part in zip((0, *starts), np.split(places, starts, axis), strict=True):
                yield from (box.shift(start * axis, start * (1 - axis)) for box in _boxes(part, gap))
            return
    yield Window(columns[0], rows[0], columns[-1] + 1, rows[-1] + 1)
