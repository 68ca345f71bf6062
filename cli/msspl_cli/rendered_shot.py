# SPDX-License-Identifier: Apache-2.0
"""Fuses the frames of a shot while Blender renders them. A frame waits until its neighbours are rendered."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.fusion.motion import VECTORS, MotionSource
from oiio_msspl.jobs.frame_window import FrameWindow, FusedAlone, Neighbours
from oiio_msspl.jobs.inputs import map_pair, resolve_auto
from oiio_msspl.jobs.sequence import Frame
from oiio_msspl.jobs.stages import LoadedFrame, Stages
from oiio_msspl.jobs.temporal import AUTO, Temporal, TemporalOptions, shares
from oiio_msspl.model.catalogue import family_of
from oiio_msspl.parallel import limit_threads


def beside(output: Path, suffix: str) -> Path:
    """``frame.exr`` -> ``frame_suffix.exr``."""
    return output.with_name(f"{output.stem}_{suffix}.exr")


class RenderedShot:
    """Frames that are fused in the order in which they are rendered.

    The renders of a frame, and its fused pixels, are kept until no other frame needs them. So disk and memory hold a
    few frames, however long the shot is.

    Args:
        stages: how a frame is fused.
        shot: all frames, without their renders.
        wanted: those of ``shot`` that are to be written.
        options: how many neighbours each frame is averaged with.
        keep: keep the renders of a frame beside its result, instead of deleting them.

    Raises:
        InputError: a number of neighbours is asked for, and no frame has any.
    """

    def __init__(
        self,
        stages: Stages,
        shot: Sequence[Frame],
        wanted: Sequence[Frame],
        options: TemporalOptions,
        *,
        keep: bool = False,
    ) -> None:
        self._stages, self._shot, self._wanted, self._keep = stages, shot, list(wanted), keep
        self._required = options.frames != AUTO
        #: Number of the frame that an error is about.
        self._at_work = 0
        #: Renders on the disk, by frame number.
        self._renders: dict[int, Frame] = {}
        #: Warnings about the frames that are written.
        self._warnings: dict[Path, list[str]] = {}
        frames = {frame.number: frame for frame in shot}
        # Every neighbour must be rendered, so `best` takes no more of them than other models.
        count = options.count()
        length = f"{count} frame{'s' if count > 1 else ''}"
        text = f"with {length} before and after each, along the motion vectors of Cycles"
        self._plan(Temporal(*shares(count, VECTORS), None, frames, text if count else ""))
        if count and not any(number + 1 in frames for number in frames):
            self.fuse_alone("no two frames follow each other")

    def _plan(self, temporal: Temporal) -> None:
        self._temporal = temporal
        self._stages = replace(self._stages, temporal=temporal)
        self._window = FrameWindow(temporal, self._wanted, self._fuse_frame)
        self.order = self._window.order()
        """The frames to render: those that are to be written, and their neighbours."""
        self._next = iter(self.order)

    @property
    def averages(self) -> bool:
        """Whether frames are averaged with their neighbours."""
        return self._temporal.count > 0

    @property
    def text(self) -> str:
        """How the shot is fused over time, in words; empty if the user has switched that off."""
        return self._temporal.text

    def fuse_alone(self, reason: str) -> None:
        """Fuse every frame by itself. No frame has been fused yet.

        Raises:
            InputError: the user has asked for neighbours.
        """
        if self._required:
            raise InputError(f"--temporal {self._temporal.count}: {reason}")
        self._plan(Temporal(text=f"frame by frame: {reason}"))

    def fuse(self, lr: Path, hr: Path) -> None:
        """Fuse the next frame of ``order``, and write each frame that has all its neighbours now.

        Args:
            lr, hr: the renders, which are deleted or renamed when no frame needs them any more.

        Raises:
            InputError, MssplError: a frame can't be fused. The message names it if there are several.
        """
        frame = replace(next(self._next), lr=lr, hr=hr)
        self._at_work = frame.number
        try:
            with limit_threads(self._stages.threads):
                if family_of(self._stages.model):  # all frames get the model that suits the first pair
                    family = resolve_auto(*map_pair(lr, hr, self._stages.inputs), self._stages.model)
                    self._stages = replace(self._stages, model=family)
                loaded = self._read(frame)
                for ready, outcome in self._window.add(frame.number, loaded):
                    self._at_work = ready.number
                    assert isinstance(outcome, FusedAlone)
                    self._write(ready, outcome)
        except MssplError as error:
            if len(self._shot) == 1:
                raise
            raise type(error)(f"frame {self._at_work}: {error}") from error
        self._release()

    def waits(self, output: Path) -> bool:
        """Whether a frame is rendered, and waits for its neighbours."""
        return output not in self._warnings and any(frame.output == output for frame in self._renders.values())

    def warnings(self, output: Path) -> list[str]:
        """Warnings about a frame that is written."""
        return self._warnings.get(output, [])

    def _read(self, frame: Frame) -> LoadedFrame:
        if self._temporal.count and self._temporal.motion is None:
            assert frame.lr is not None and frame.hr is not None
            _, hr = map_pair(frame.lr, frame.hr, self._stages.inputs)
            # The format need not be verified: Blender is known, and motion blur is off.
            motion = MotionSource(VECTORS, self.text, hr.motion.fields)
            self._temporal = replace(self._temporal, motion=motion)
            self._stages = replace(self._stages, temporal=self._temporal)  # it reads the vectors with the pixels
            self._window = FrameWindow(self._temporal, self._wanted, self._fuse_frame)
        loaded = self._stages.read(frame)
        self._renders[frame.number] = frame
        return loaded

    def _fuse_frame(self, loaded: LoadedFrame, neighbours: Neighbours) -> FusedAlone:
        self._at_work = loaded.frame.number
        return self._stages.fuse(loaded, self._stages.session(loaded), neighbours)

    def _write(self, frame: Frame, alone: FusedAlone) -> None:
        fused = self._window.accumulate(frame.number)
        report = self._stages.complete(alone, fused)
        self._stages.write(report, fused)
        self._warnings[frame.output] = report.warnings

    def _release(self) -> None:
        """Forget the frames, and discard the renders, that no frame needs any more."""
        self._window.release()
        missing = [frame.number for frame in self._wanted if frame.output not in self._warnings]
        needed = {each for number in missing for each in (number, *self._temporal.neighbours(number))}
        for number in self._renders.keys() - needed:
            frame = self._renders.pop(number)
            assert frame.lr is not None and frame.hr is not None
            for path, suffix in ((frame.lr, "lr"), (frame.hr, "hr")):
                if self._keep and frame.output in self._warnings:
                    os.replace(path, beside(frame.output, suffix))
                else:
                    path.unlink()
