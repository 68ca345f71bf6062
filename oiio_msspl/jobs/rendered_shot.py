# SPDX-License-Identifier: Apache-2.0
"""Fuses the frames of a shot while Blender renders them. A frame waits until its neighbours are rendered."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from oiio_msspl.aovs.additive_sets import AdditiveSet, find_additive_sets
from oiio_msspl.aovs.renderers import renderers
from oiio_msspl.aovs.views import Beauty
from oiio_msspl.errors import InputError, MssplError, explain
from oiio_msspl.exr.layers import Layer
from oiio_msspl.exr.reader import Channel
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.motion.source import VECTORS, MotionSource
from oiio_msspl.fusion.neighbours.renders import USUAL_CHANNELS
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.fusion.tiles.tiling import result_bytes
from oiio_msspl.image.parallel import limit_threads
from oiio_msspl.jobs.frame_checks import require_frame_memory
from oiio_msspl.jobs.frame_window import FrameWindow, FusedAlone, Neighbours
from oiio_msspl.jobs.inputs import map_pair
from oiio_msspl.jobs.model_choice import choose_model
from oiio_msspl.jobs.sequence import Frame
from oiio_msspl.jobs.stages import LoadedFrame, Stages
from oiio_msspl.jobs.temporal import AUTO, Temporal, TemporalOptions, shares
from oiio_msspl.model.catalogue import family_of


def beside(output: Path, suffix: str) -> Path:
    """``frame.exr`` -> ``frame_suffix.exr``."""
    return output.with_name(f"{output.stem}_{suffix}.exr")


def _cycles_sets(names: Sequence[str]) -> list[AdditiveSet]:
    """The additive sets that a file of Cycles with these passes has."""
    layers = [
        Layer(name, "", {c: Channel(Path(), 0, 3 * i + j, f"{name}.{c}", "float") for j, c in enumerate("RGB")})
        for i, name in enumerate(names)
    ]
    cycles = next(each for each in renderers() if each["name"] == "Cycles")
    return find_additive_sets(cycles, layers, Beauty("", "", Layer("Combined", "")))


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

    def check(self, size: tuple[int, int], layers: Sequence[str] | None, pixel_bytes: int) -> None:
        """Refuse a frame that could not be fused, before it is rendered.

        Args:
            size: width and height of the HRLS.
            layers: names of the passes that Cycles will render; None if they are not known.
            pixel_bytes: bytes of all passes for each pixel, at least.

        Raises:
            InputError: the frame needs more memory than it may take, or a pattern of ``--passes`` matches no pass.
        """
        write = self._stages.write_options
        (session,) = self._stages.sessions.values()
        width, height = size
        scale = session.contract.scale
        window, grid = Window(0, 0, width, height), Window(0, 0, -(-width // scale), -(-height // scale))
        alignment = Alignment(scale, grid, grid, window)
        held = result_bytes(alignment, error=write.error_layer) + self._temporal.memory(window, USUAL_CHANNELS, scale)
        written = pixel_bytes * width * height if write.layout == "multilayer" else 0
        require_frame_memory(alignment, session, write, self._stages.max_memory, layers=written, held=held)
        if layers is None or write.passes in ((), ("none",)):
            return
        sets = _cycles_sets(layers)
        if not any(each.matches(pattern) for each in sets for pattern in write.passes):
            known = ", ".join(f"'{each.name}'" for each in sets) or "none (turn on light groups, or pass --components)"
            raise InputError(
                f"--passes {', '.join(write.passes)}: the scene renders no such set of layers; it has {known}"
            )

    def fuse(self, lr: Path, hr: Path) -> None:
        """Fuse the next frame of ``order``, and write each frame that has all its neighbours now.

        Args:
            lr, hr: the renders, which are deleted or renamed when no frame needs them any more. Those of a frame that
                can't be fused are kept beside its result.

        Raises:
            InputError, MssplError: a frame can't be fused. The message names it if there are several.
        """
        frame = replace(next(self._next), lr=lr, hr=hr)
        self._at_work = frame.number
        try:
            with limit_threads(self._stages.threads):
                if family_of(self._stages.model):  # all frames get the model that suits the first pair with noise
                    family, told = choose_model(*map_pair(lr, hr, self._stages.inputs), self._stages.model)
                    if told:
                        self._stages = replace(self._stages, model=family)
                loaded = self._read(frame)
                for ready, outcome in self._window.add(frame.number, loaded):
                    self._at_work = ready.number
                    if isinstance(outcome, Exception):
                        raise outcome
                    self._write(ready, outcome)
        except Exception as error:
            said, code = explain(error)
            said = self._keep_failed(self._renders.get(self._at_work, frame), said)
            if len(self._shot) > 1:
                said = f"frame {self._at_work}: {said}"
            raise (InputError if code == InputError.exit_code else MssplError)(said) from error
        self._release()

    def _keep_failed(self, frame: Frame, said: str) -> str:
        """Keep the renders of a frame that can't be fused. The rest of the temporary files is deleted.

        Args:
            said: the error. It may name the renders.

        Returns:
            The error, with the names of the files that are kept.
        """
        assert frame.lr is not None and frame.hr is not None
        renders = ((frame.lr, "lr", "the LRHS"), (frame.hr, "hr", "the HRLS"))
        if not all(path.exists() for path, _, _ in renders):  # Blender wrote none, and the error says so
            return said
        kept = {path: beside(frame.output, suffix) for path, suffix, _ in renders}
        wanted = any(frame.output == each.output for each in self._wanted)
        if not wanted or (not self._keep and any(target.exists() for target in kept.values())):
            for path, _, name in renders:
                said = said.replace(str(path), name)
            return said
        for path, target in kept.items():
            os.replace(path, target)
            said = said.replace(str(path), str(target))
        return f"{said}; both renders are kept for msspl-fuse: {', '.join(map(str, kept.values()))}"

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
