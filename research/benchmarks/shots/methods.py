# SPDX-License-Identifier: Apache-2.0
"""Make the frames of a sequence by each method, through the code that fuses shots."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from oiio_msspl import map_render, open_exr
from oiio_msspl.aovs.mapped_render import ReadableRender
from oiio_msspl.errors import InputError
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.fusion.neighbours.renders import RenderPair
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.colour import luminance
from oiio_msspl.jobs.checks import model_of_shot
from oiio_msspl.jobs.frame import ShotFrame
from oiio_msspl.jobs.inputs import InputOptions
from oiio_msspl.jobs.plan import ShotPlan, TemporalOptions, plan_temporal
from oiio_msspl.jobs.run import ShotRun
from oiio_msspl.jobs.sequence import FrameFiles, find_shot
from oiio_msspl.jobs.settings import Settings
from oiio_msspl.model.contract import ONE_SIZE
from research.benchmarks.peers import oidn_prefiltered, oidn_split
from research.benchmarks.results import Row
from research.benchmarks.shots.sequence import Sequence as MovingSequence
from research.benchmarks.shots.sequence import write_one_render

ALONE, NEIGHBOURS = "frame by frame", "with neighbours"
OIDN_BEST, OIDN_SPLIT = "OIDN prefiltered", "OIDN on every second pixel"
SCALES = (2, 4)
#: The qualities that are measured: what the names of their methods begin with.
QUALITIES = {"balanced": "", "best": "best, "}
Denoiser = Callable[[ReadableRender], Array]


def all_methods(
    sequence: MovingSequence, options: TemporalOptions = TemporalOptions(), pattern: str = "*", *, spread: bool = False
) -> Iterator[tuple[Row, Array]]:
    """Yield each method on a sequence whose name matches the pattern: columns, and linear images (frames, h, w, 3).

    The columns are ``method``, ``scale`` and, of ours, ``model``. The scale is that of the LRHS, and 1 for what reads
    the full-resolution render with all samples.

    Ours fuse pairs, and at a scale of 1 the full-resolution render that OIDN gets.

    OIDN denoises renders with the samples of both renders together. With neighbours, these renders and OIDN's frames
    are averaged exactly as ours are with `best`. The test of the light gets the same LRHS. ``options`` say which
    neighbours are averaged. If a pixel filter has ``spread`` the noise, OIDN also reads every second pixel.
    """
    full = [map_render(open_exr(sequence.folder / f"full.{n:04d}.exr")) for n in sequence.numbers]
    peers = {OIDN_BEST: oidn_prefiltered} | ({OIDN_SPLIT: oidn_split} if spread else {})
    for name, denoised in peers.items():
        if fnmatchcase(name, pattern):
            yield {"method": name, "scale": 1}, np.stack([denoised(render) for render in full])
    with tempfile.TemporaryDirectory() as folder:
        for scale in (ONE_SIZE, *SCALES):
            for name, run in _by_scale(sequence, scale, options, Path(folder), peers):
                if fnmatchcase(name, pattern):
                    model = {} if isinstance(run, _RunOfPeer) else {"model": f"{run.settings.model}-x{scale}"}
                    yield {"method": name, "scale": scale} | model, _images(run)


class _RunOfPeer(ShotRun):
    """A shot whose full-resolution renders are averaged as ours are, and then denoised by another program."""

    def __init__(self, denoised: Denoiser, folder: Path, *shot: Any) -> None:
        super().__init__(*shot)
        self._denoised, self._folder = denoised, folder

    def read(self, files: FrameFiles) -> list[ShotFrame]:
        """Read a frame whose HRLS has the pixels of the full render, and its own motion vectors."""
        views = super().read(files)
        full = map_render(open_exr(self._folder / f"full.{files.number:04d}.exr"))
        views[0].renders = RenderPair(views[0].renders.lr, full.load())
        return views

    def fuse(self, frame: ShotFrame) -> FusedFrame:
        """Denoise the averaged full-resolution render."""
        rgb = self._denoised(frame.averaged.hr)
        lrhs, hrls = (luminance(colours) for colours in frame.averaged.colours)
        alignment = frame.averaged.alignment
        return FusedFrame(rgb, None, None, alignment, 1.0, repaired={}, lrhs_luminance=lrhs, hrls_luminance=hrls)


def _by_scale(
    sequence: MovingSequence, scale: int, options: TemporalOptions, folder: Path, peers: Mapping[str, Denoiser]
) -> Iterator[tuple[str, ShotRun]]:
    """Yield the methods for a scale: the name, and how a shot is fused. ``folder`` is for files that they read."""
    one = scale == ONE_SIZE
    if one:
        for n in sequence.numbers:
            write_one_render(sequence, n, folder / f"one.{n:04d}.exr")
    lr = None if one else sequence.folder / f"lr_x{scale}.####.exr"
    hr = folder / "one.####.exr" if one else sequence.folder / "hr.####.exr"
    shot = find_shot(lr, hr, sequence.folder / "fused.####.exr")
    for quality, prefix in QUALITIES.items():
        # More threads only wait for each other: the pictures are small.
        settings = Settings(model=model_of_shot(shot, InputOptions(), quality), threads=1)
        plan = plan_temporal(shot, InputOptions(), options, settings.model)
        yield prefix + ALONE, ShotRun(settings, ShotPlan(), shot.frames)
        yield prefix + NEIGHBOURS, ShotRun(settings, plan, shot.frames)
    # The peers' frames have the neighbours of the last quality, `best`, and the LRHS of a pair tests their light.
    for name, denoised in () if one else peers.items():
        yield f"{name}, {NEIGHBOURS}", _RunOfPeer(denoised, sequence.folder, settings, plan, shot.frames)


def _images(run: ShotRun) -> Array:
    """Return the images of all frames, which must all be fused and averaged."""
    images = []
    for files in run.order:
        for frame in run.take(run.read(files)):
            frame.require()
            assert frame.picture is not None
            if left_out := [text for text in frame.picture.warnings if "is not averaged" in text]:
                raise InputError(f"{frame.files.hr}: {left_out[0]}")
            images.append(frame.picture.rgb)
    return np.stack(images)
