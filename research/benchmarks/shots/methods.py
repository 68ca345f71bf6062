# SPDX-License-Identifier: Apache-2.0
"""Make the frames of a sequence by each method, through the code that fuses shots."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import partial

import numpy as np

from oiio_msspl import map_render, open_exr
from oiio_msspl.errors import InputError
from oiio_msspl.exr.render import ReadableRender
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.fusion.neighbours.renders import RenderPair, average_renders
from oiio_msspl.image.arrays import Array
from oiio_msspl.jobs.frame_window import FrameWindow, FusedAlone, Neighbours
from oiio_msspl.jobs.inputs import InputOptions
from oiio_msspl.jobs.sequence import Frame, find_shot
from oiio_msspl.jobs.shot_checks import model_of_shot
from oiio_msspl.jobs.stages import LoadedFrame, Stages
from oiio_msspl.jobs.temporal import Temporal, TemporalOptions, plan_temporal
from research.benchmarks.peers import oidn, oidn_prefiltered, oidn_split
from research.benchmarks.shots.sequence import Sequence

ALONE, NEIGHBOURS = "frame by frame", "with neighbours"
OIDN, OIDN_BEST, OIDN_SPLIT = "OIDN", "OIDN prefiltered", "OIDN on every second pixel"
OIDN_NEIGHBOURS, OIDN_SPLIT_NEIGHBOURS = f"{OIDN_BEST}, {NEIGHBOURS}", f"{OIDN_SPLIT}, {NEIGHBOURS}"
SCALES = (2, 4)
#: The qualities that are measured: what the names of their methods begin with.
QUALITIES = {"balanced": "", "best": "best, "}


@dataclass(frozen=True)
class Made:
    """A method's frames."""

    method: str
    scale: int
    """Of the LRHS; 1 for what reads none."""
    images: Array
    """Linear (frames, h, w, 3)."""
    motion: str = ""
    """Say how the motion is known; empty for single frames."""


def all_methods(
    sequence: Sequence, options: TemporalOptions = TemporalOptions(), pattern: str = "*", *, spread: bool = False
) -> Iterator[Made]:
    """Yield each method on a sequence whose name matches the pattern.

    OIDN denoises renders with the samples of both renders together. With neighbours, these renders and OIDN's frames
    are averaged exactly as ours are with `best`. The test of the light gets the same LRHS. ``options`` say which
    neighbours are averaged. If a pixel filter has ``spread`` the noise, OIDN also reads every second pixel.
    """
    full = [map_render(open_exr(sequence.folder / f"full.{n:04d}.exr")) for n in sequence.numbers]
    peers = {OIDN: oidn, OIDN_BEST: oidn_prefiltered} | ({OIDN_SPLIT: oidn_split} if spread else {})
    for name, denoised in peers.items():
        if fnmatchcase(name, pattern):
            yield Made(name, 1, np.stack([denoised(render) for render in full]))
    for scale in SCALES:
        for name, temporal, frames in _by_scale(sequence, scale, options, spread):
            if fnmatchcase(name, pattern):
                yield Made(name, scale, frames(), _motion(temporal) if temporal.count else "")


def _by_scale(
    sequence: Sequence, scale: int, options: TemporalOptions, spread: bool
) -> Iterator[tuple[str, Temporal, Callable[[], Array]]]:
    """Yield the methods that read an LRHS: the name, the neighbours, and how to compute its frames."""
    folder = sequence.folder
    shot = find_shot(folder / f"lr_x{scale}.####.exr", folder / "hr.####.exr", folder / "fused.####.exr")
    # More threads only wait for each other: the pictures are small.
    models = {quality: model_of_shot(shot, InputOptions(), quality) for quality in QUALITIES}
    by_quality = {
        quality: Stages(model=model, threads=1, temporal=plan_temporal(shot, InputOptions(), options, model))
        for quality, model in models.items()
    }
    stages = by_quality["best"]

    def ours(stages: Stages, loaded: LoadedFrame, neighbours: Neighbours) -> FusedAlone:
        return stages.fuse(loaded, stages.session(loaded), neighbours)

    def with_full(frame: Frame) -> LoadedFrame:
        """Return a frame whose HRLS has the pixels of the full render, and its own motion vectors."""
        full = map_render(open_exr(folder / f"full.{frame.number:04d}.exr"))
        return replace(stages.read(frame), hr_pixels=full.load())

    def theirs(denoised: Callable[[ReadableRender], Array], loaded: LoadedFrame, neighbours: Neighbours) -> FusedAlone:
        averaged = average_renders(RenderPair(loaded.lr_pixels, loaded.hr_pixels), *neighbours)
        pair = RenderPair(averaged.lr, averaged.hr)
        fused = FusedFrame(denoised(averaged.hr), None, None, pair.alignment, 1.0, {}, *pair.luminances)
        return FusedAlone(loaded, stages.session(loaded), fused, 0.0)

    for quality, prefix in QUALITIES.items():
        by_model = by_quality[quality]
        for name, temporal in ((ALONE, Temporal()), (NEIGHBOURS, by_model.temporal)):
            yield (
                prefix + name,
                temporal,
                partial(_frames, by_model.read, temporal, shot.frames, partial(ours, by_model)),
            )
    peers = {OIDN_NEIGHBOURS: oidn_prefiltered} | ({OIDN_SPLIT_NEIGHBOURS: oidn_split} if spread else {})
    for name, denoised in peers.items():
        fused = partial(theirs, denoised)
        yield name, stages.temporal, partial(_frames, with_full, stages.temporal, shot.frames, fused)


def _motion(temporal: Temporal) -> str:
    """How the motion is known, in words."""
    return f"{temporal.motion.kind}: {temporal.text}" if temporal.motion else temporal.text


def _frames(
    read: Callable[[Frame], LoadedFrame],
    temporal: Temporal,
    frames: list[Frame],
    fuse: Callable[[LoadedFrame, Neighbours], FusedAlone],
) -> Array:
    """Return the images of all frames.

    Raises:
        MssplError: a frame can't be fused.
        InputError: a neighbour is not averaged.
    """
    window = FrameWindow(temporal, frames, fuse)
    images = []
    for frame in window.order():
        for done, outcome in window.add(frame.number, read(frame)):
            if isinstance(outcome, Exception):
                raise outcome
            fused = window.accumulate(done.number)
            if left_out := [text for text in fused.warnings if "is not averaged" in text]:
                raise InputError(f"{done.hr}: {left_out[0]}")
            images.append(fused.rgb)
        window.release()
    return np.stack(images)
