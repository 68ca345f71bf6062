# SPDX-License-Identifier: Apache-2.0
"""The frames of a sequence by each method, through the code that fuses shots."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.peers import oidn, oidn_prefiltered
from benchmarks.temporal.sequence import Sequence
from oiio_msspl import map_render, open_exr
from oiio_msspl.arrays import Array
from oiio_msspl.jobs.inputs import InputOptions
from oiio_msspl.jobs.sequence import Frame, find_shot
from oiio_msspl.jobs.stages import Stages
from oiio_msspl.jobs.temporal import FrameWindow, FusedAlone, TemporalOptions, plan_temporal

ALONE, NEIGHBOURS = "frame by frame", "with neighbours"
OIDN, OIDN_BEST, OIDN_NEIGHBOURS = "OIDN", "OIDN prefiltered", "OIDN prefiltered, with neighbours"
SCALES = (2, 4)


@dataclass(frozen=True)
class Made:
    """A method's frames."""

    method: str
    scale: int
    """Of the LRHS; 1 for what reads none."""
    images: Array
    """Linear (frames, h, w, 3)."""
    motion: str = ""
    """How the motion is known; empty for single frames."""


def all_methods(sequence: Sequence, model: str, motion_format: str | None = None) -> Iterator[Made]:
    """Each method on a sequence.

    OIDN denoises renders with the samples of both renders together. Its frames are averaged exactly as ours are. The
    test of the light gets the luminance of the same LRHS and HRLS. ``motion_format`` is that of `msspl-fuse`.
    """
    full = [map_render(open_exr(sequence.folder / f"full.{n:04d}.exr")) for n in sequence.numbers]
    best = np.stack([oidn_prefiltered(render) for render in full])
    yield Made(OIDN, 1, np.stack([oidn(render) for render in full]))
    yield Made(OIDN_BEST, 1, best)
    for scale in SCALES:
        yield from _by_scale(sequence, model, scale, best, TemporalOptions(motion_format=motion_format))


def _by_scale(sequence: Sequence, model: str, scale: int, peer: Array, options: TemporalOptions) -> Iterator[Made]:
    folder = sequence.folder
    shot = find_shot(folder / f"lr_x{scale}.####.exr", folder / "hr.####.exr", folder / "fused.####.exr")
    temporal = plan_temporal(shot, InputOptions(), options)
    motion = f"{temporal.motion.kind}: {temporal.text}" if temporal.motion else temporal.text
    # More threads only wait for each other: the pictures are small.
    stages = Stages(model=model, threads=1, temporal=temporal)
    frames = []
    for frame in shot.frames:
        loaded = stages.read(frame)
        frames.append(stages.fuse(loaded, stages.session(loaded)))
    ours = np.stack([each.fused.rgb for each in frames])
    yield Made(ALONE, scale, ours)
    for method, images in ((NEIGHBOURS, ours), (OIDN_NEIGHBOURS, peer)):
        window = FrameWindow(temporal, shot.frames)
        yield Made(method, scale, np.stack(list(_averaged(window, shot.frames, frames, images))), motion)


def _averaged(window: FrameWindow, frames: list[Frame], alone: list[FusedAlone], images: Array) -> Iterator[Array]:
    """Images of frames, averaged with their neighbours."""
    for frame, each, image in zip(frames, alone, images, strict=True):
        ready = window.add(frame.number, replace(each, fused=replace(each.fused, rgb=image)))
        for done, _ in ready:
            yield window.accumulate(done.number).rgb
        window.release()
