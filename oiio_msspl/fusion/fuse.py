# SPDX-License-Identifier: Apache-2.0
"""Fuses an LRHS and an HRLS, two renders of one size, or one, in memory or on disk: the story of a frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import ALBEDO, NORMAL
from oiio_msspl.aovs.mapped_render import ReadableRender
from oiio_msspl.errors import InputError
from oiio_msspl.exr.replaced import ReplacedChannels
from oiio_msspl.findings import Finding
from oiio_msspl.fusion.checks.averages import HrlsAverages, bounded_luminance
from oiio_msspl.fusion.checks.pair import Judgement, check_pair
from oiio_msspl.fusion.passes.fuse import FusedPasses
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.fusion.tiles.network import FusedPixels, fuse_tiles, tile_tasks
from oiio_msspl.fusion.tiles.prepare import FramePair
from oiio_msspl.fusion.tiles.tiling import MAX_MEMORY, memory_to_fuse, require_memory, strips_memory
from oiio_msspl.image.arrays import Array, blank, unload
from oiio_msspl.image.filters import columns_apart, even_and_odd
from oiio_msspl.image.parallel import in_background, limit_threads
from oiio_msspl.model.catalogue import shipped_models
from oiio_msspl.model.contract import SPREAD
from oiio_msspl.model.session import Session


@dataclass
class FusedFrame(FusedPixels):
    """A fused frame: its pixels, the luminance of both renders, counts and warnings."""

    repaired: dict[str, int]
    """Numbers of values that were NaN or infinite, by layer, as ``lrhs.rgb``."""
    lrhs_luminance: Array = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    """(h, w): luminance of the LRHS over the alignment's grid, at the places of its HRLS pixels."""
    hrls_luminance: Array = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    """(h, w): luminance of the HRLS, averaged over the LRHS's pixels."""
    frames: Array | None = None
    """(height, width, 1): number of frames that were averaged; None without neighbours."""
    coarse: Array | None = None
    """(h, w, 3): colours of large cells, as :class:`oiio_msspl.fusion.neighbours.trust.Light` judges the frame; None
    until they are needed."""
    negative: dict[str, int] = field(default_factory=dict)
    """Numbers of values that were negative and set to 0 (colours out of gamut), by layer; never of normals."""
    warnings: list[Finding] = field(default_factory=list)
    """One sentence each."""
    passes: FusedPasses | None = None
    """The fused layers of additive sets; None if there are none."""
    replaced: ReplacedChannels | None = None
    """New pixels of other channels of the HRLS: fused passes, and further views; None if there are none."""
    tiles: int = 1
    seconds: float = 0.0
    """Time in the network."""


def fuse(
    lr: ReadableRender,
    hr: ReadableRender,
    session: Session,
    *,
    error: bool = False,
    trust: bool = True,
    clean_aovs: bool = False,
    half: bool = False,
    share: float | None = None,
    max_memory: int = MAX_MEMORY,
    held: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> FusedFrame:
    """Fuse a low-resolution, high-spp render with a high-resolution, low-spp render of the same frame.

    Two renders of one size are averaged and denoised. So is one render, which is given as both.

    Args:
        lr, hr: files with their layers mapped (:func:`oiio_msspl.aovs.matching.map_render`), or renders in memory.
        session: a model for the scale of the pair.
        error: also predict the error of the result.
        trust: put back detail and light that both renders show, see
            :func:`oiio_msspl.fusion.tiles.trust.trust_renders`.
        clean_aovs: also keep the albedo and the normal that the model denoises, see :attr:`Session.clean_aovs`.
        half: keep the result as half floats; values above ``HALF_MAX`` are clipped.
        share: of the LRHS in the mean of both renders, in [0, 1]; None to find it by their noise.
        max_memory: bytes that the whole process should stay below. The result does not depend on it.
        held: bytes that the caller holds beside this frame.
        progress: called with (tiles done, tiles in all).

    Raises:
        InputError: the pair does not fit together or into memory, or the model is for another scale or does not
            predict its error. No pixel was read.
        MssplError: the network failed, or returned NaN or infinite values.
    """
    alignment = align(lr, hr)
    check_model(session, alignment.scale, error=error)
    require_memory(memory_to_fuse(alignment, session.contract, error=error) + held, session.contract, max_memory)
    seconds = session.seconds
    with limit_threads(session.threads):
        averages, aovs = HrlsAverages(alignment), session.clean_aovs if clean_aovs else ()
        pair = FramePair(lr, hr, alignment, session.contract, aovs, share=share, on_read=averages.add)
        size = alignment.hr_data_window.height, alignment.hr_data_window.width
        rgb: NDArray[Any] = blank((*size, 3), np.float16 if half else np.float32, on_disk=False)
        errors: Array | None = blank((*size, 1), on_disk=False) if error else None
        frame = FusedFrame(rgb, None, errors, alignment, pair.exposure, {})
        if trust and session.contract.denoiser and pair.tells_noise:
            frame.trust = blank((alignment.grid.height, alignment.grid.width), on_disk=False)

        def judge() -> Judgement:
            if lr is hr:
                return Judgement()
            return check_pair(bounded_luminance(pair.lrhs_rgb), averages, lr.name, hr.name)

        judged, tiles = judge, pair.tiles()
        frame.tiles = len(tiles)
        with hr.cache_strips(strips_memory(max_memory, held)):
            tasks = tile_tasks(pair, frame, tiles=tiles)
            if len(tiles) == 1:  # it is read now, so the pair is judged while the network works
                tasks = iter([*tasks])  # lets go of the tile, as a generator does
                judged = in_background(judge)
            for task in fuse_tiles(tasks, session):
                for image in frame.clean_aovs.values():
                    unload(image)
                for render in (lr, hr):
                    render.unload()
                if progress is not None:
                    progress(task.number, task.count)
                del task  # or its memory would be held while the next one is fused
        if frame.tiles > 1:
            session.release_memory()  # to check a large frame needs memory, too
        judgement = judged()
        if lr is hr:
            halves = columns_apart if session.contract.denoiser.endswith(SPREAD) else even_and_odd
            frame.lrhs_luminance, frame.hrls_luminance = halves(averages.rgb)
        else:
            frame.lrhs_luminance, frame.hrls_luminance = bounded_luminance(pair.exact_lrhs_rgb()), averages.rgb
        if frame.trust is not None and not judgement.independent:
            # The noise of one render can't be told from detail by that of the other one.
            again = partial(fuse, lr, hr, session, error=error, trust=False, clean_aovs=clean_aovs, half=half)
            return again(share=share, max_memory=max_memory, held=held, progress=progress)
        frame.warnings += judgement.warnings
    frame.repaired, frame.negative = pair.counts("repaired"), pair.counts("negative")
    frame.warnings += _lost(frame, pair)
    frame.seconds = session.seconds - seconds
    return frame


def _lost(frame: FusedFrame, pair: FramePair) -> Iterator[Finding]:
    """Yield what a fused frame lacks because its renders lack it, one sentence each."""
    for name in (ALBEDO, NORMAL):
        if (broken := frame.repaired.get(f"hrls.{name}", 0) / frame.rgb.size) > 0.5:
            lost = f"{broken:.0%} of the HRLS's {name} is NaN or infinite, so it tells little of the surfaces"
            yield Finding("broken_aov", f"{lost}; render it again")
    if frame.alpha is not None and not pair.lrhs_has_alpha:
        yield Finding("no_alpha", "the LRHS has no alpha, so the noisy alpha of the HRLS is kept")


def check_model(session: Session, scale: int, *, error: bool) -> None:
    """Check that a model fits a pair.

    Raises:
        InputError: it is for another scale, or does not predict its error though ``error`` asks for it.
    """
    if error:
        session.require_error()
    if session.contract.scale != scale:
        name = session.contract.name
        hint = f"; --model {name.rpartition('-x')[0]} takes the one for the pair" if name in shipped_models() else ""
        raise InputError(f"model {name} is for x{session.contract.scale}, but this pair is x{scale}{hint}")
