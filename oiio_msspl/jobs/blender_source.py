# SPDX-License-Identifier: Apache-2.0
"""Blender as a source of frames: each frame is fused as soon as its neighbours are rendered."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from oiio_msspl.aovs.additive_sets import AdditiveSet, find_additive_sets
from oiio_msspl.aovs.renderers import renderers
from oiio_msspl.aovs.views import Beauty
from oiio_msspl.errors import InputError, MssplError, explain
from oiio_msspl.exr.layers import Layer
from oiio_msspl.exr.reader import Channel
from oiio_msspl.exr.render import Window
from oiio_msspl.findings import Finding
from oiio_msspl.fusion.motion.source import VECTORS, MotionSource
from oiio_msspl.fusion.neighbours.renders import USUAL_CHANNELS
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.fusion.tiles.tiling import result_bytes
from oiio_msspl.image.parallel import limit_threads
from oiio_msspl.jobs.inputs import map_pair
from oiio_msspl.jobs.memory import check_frame_memory, memory_to_average
from oiio_msspl.jobs.plan import AUTO, ShotPlan, TemporalOptions, ViewPlan, reach_of
from oiio_msspl.jobs.run import ShotRun
from oiio_msspl.jobs.sequence import FrameFiles
from oiio_msspl.jobs.settings import Settings, choose_model
from oiio_msspl.jobs.timeline import neighbours
from oiio_msspl.jobs.write import write_settled
from oiio_msspl.model.catalogue import family_of
from oiio_msspl.model.contract import ONE_SIZE


def beside(output: Path, suffix: str) -> Path:
    """``frame.exr`` -> ``frame_suffix.exr``."""
    return output.with_name(f"{output.stem}_{suffix}.exr")


def suffixes(renders: int, scale: int) -> tuple[str, ...]:
    """Return what :func:`beside` adds to the names of a frame's renders: one, or the first and the second one."""
    if renders == 1:
        return ("hr",)
    return ("a", "b") if scale == ONE_SIZE else ("lr", "hr")


def _cycles_sets(names: Sequence[str]) -> list[AdditiveSet]:
    """Return the additive sets that a file of Cycles with these passes has."""
    layers = [
        Layer(name, "", {c: Channel(Path(), 0, 3 * i + j, f"{name}.{c}", "float") for j, c in enumerate("RGB")})
        for i, name in enumerate(names)
    ]
    cycles = next(renderer for renderer in renderers() if renderer["name"] == "Cycles")
    return find_additive_sets(cycles, layers, Beauty("", "", Layer("Combined", "")))


class RenderedShot:
    """Frames that are fused in the order in which they are rendered.

    The renders of a frame, and its fused pixels, are kept until no other frame needs them. So disk and memory hold a
    few frames, however long the shot is. The model is loaded first, so that no frame is rendered for nothing.

    Args:
        settings: how a frame is fused.
        renders: 1, or 2 for each frame.
        scale: width of the frame / width of the first of two renders.
        shot: all frames, without their renders.
        wanted: those of ``shot`` that are to be written.
        options: how many neighbours each frame is averaged with.
        keep: keep the renders of a frame beside its result, instead of deleting them.

    Raises:
        InputError: the model or the device can't be had, or a number of neighbours is asked for and no frame has any.
    """

    def __init__(
        self,
        settings: Settings,
        renders: int,
        scale: int,
        shot: Sequence[FrameFiles],
        wanted: Sequence[FrameFiles],
        options: TemporalOptions,
        *,
        keep: bool = False,
    ) -> None:
        settings = replace(settings, model=family_of(settings.model) or settings.model)
        contract = settings.session(scale).contract
        if contract.scale != scale:
            raise InputError(f"--model {settings.model}: is for x{contract.scale}, but --scale is {scale}")
        self._settings, self._scale, self._wanted, self._keep = settings, scale, list(wanted), keep
        #: What the names of a frame's renders end with if they are kept.
        self.suffixes = suffixes(renders, scale)
        self._required = options.frames != AUTO
        self._at_work = 0  # number of the frame that an error is about
        self._renders: dict[int, FrameFiles] = {}  # on the disk, by frame number
        #: The results that are written, each with its warnings.
        self.written: dict[Path, list[Finding]] = {}
        frames = {files.number: files for files in shot}
        # Every neighbour must be rendered, so `best` takes no more of them than other models.
        count = options.count()
        length = f"{count} frame{'s' if count > 1 else ''}"
        text = f"with {length} before and after each, along the motion vectors of Cycles" if count else ""
        #: How frames are averaged. How Cycles stores vectors is read from the first frame.
        self.plan = ShotPlan(frames, {None: ViewPlan(reach_of(count, VECTORS))}, text)
        if count and not any(number + 1 in frames for number in frames):
            self.fuse_alone("no two frames follow each other")
        self._run: ShotRun | None = None
        self._next: Iterator[FrameFiles] | None = None

    @property
    def order(self) -> list[FrameFiles]:
        """The frames to render: those that are to be written, and their neighbours."""
        return [self.plan.frames[number] for number in self.plan.timeline(self._wanted).order]

    def fuse_alone(self, reason: str) -> None:
        """Fuse every frame by itself, before any is fused. Raise InputError if the user has asked for neighbours."""
        if self._required:
            raise InputError(f"--temporal {self.plan.count}: {reason}")
        self.plan = ShotPlan(self.plan.frames, text=f"frame by frame: {reason}")

    def check(self, size: tuple[int, int], layers: Sequence[str] | None, pixel_bytes: int) -> None:
        """Refuse a frame that could not be fused, before it is rendered.

        Args:
            size: width and height of the frame.
            layers: names of the passes that Cycles will render; None if they are not known.
            pixel_bytes: bytes of all passes for each pixel, at least.
        """
        write = self._settings.write
        (width, height), scale = size, self._scale
        window, grid = Window(0, 0, width, height), Window(0, 0, -(-width // scale), -(-height // scale))
        alignment = Alignment(scale, grid, grid, window)
        held = result_bytes(alignment, error=write.error_layer)
        held += sum(memory_to_average(self.plan.views[None].reach, window, USUAL_CHANNELS, scale))
        written = pixel_bytes * width * height if write.layout == "multilayer" else 0
        most, session = self._settings.max_memory, self._settings.session(scale)
        check_frame_memory(alignment, session, write, most, written, held)
        if layers is None or write.passes in ((), ("none",)):
            return
        sets = _cycles_sets(layers)
        if not any(group.matches(pattern) for group in sets for pattern in write.passes):
            listed = ", ".join(f"'{group.name}'" for group in sets)
            listed = listed or "none (turn on light groups, or pass --components)"
            said = f"--passes {', '.join(write.passes)}: the scene renders no such set of layers"
            raise InputError(f"{said}; it has {listed}")

    def fuse(self, lr: Path, hr: Path) -> None:
        """Fuse the next frame of ``order``, and write each frame that has all its neighbours now.

        Args:
            lr, hr: the renders, or twice the only one. They are deleted or renamed when no frame needs them any more.
                Those of a frame that can't be fused are kept beside its result.

        Raises:
            InputError, MssplError: a frame can't be fused, and the message names it if there are several; or other
                weights made the frames that exist.
        """
        if self._next is None:
            self._next = iter(self.order)
        files = replace(next(self._next), lr=lr, hr=hr)
        self._at_work, is_first = files.number, self._run is None
        with self._keep_if_it_fails(files):
            run = self._run = self._run or self._start(files)
            if family_of(run.settings.model):  # all frames get the model that suits the first pair with noise
                pair, error = map_pair(*files.pair, run.settings.inputs), run.settings.write.error_layer
                family, told = choose_model(*pair, run.settings.model, error=error)
                if told:
                    run.settings = replace(run.settings, model=family)
        if is_first:
            run.existing.check_weights(frame for frame in run.plan.frames.values() if frame not in self._wanted)
        with self._keep_if_it_fails(files):
            views = run.read(files)
            views[0].require()
            self._renders[files.number] = files
            for frame in run.take(views):
                self._at_work = frame.number
                frame.require()
                first, last = (str(beside(frame.files.output, self.suffixes[index])) for index in (0, -1))
                frame.report.sources = (first, last) if self._keep else ("a render that was not kept",) * 2
                write_settled(frame, run.existing)
                self.written[frame.files.output] = frame.report.warnings
        self._discard()

    @contextmanager
    def _keep_if_it_fails(self, files: FrameFiles) -> Iterator[None]:
        """Keep the renders of the frame at work if the block raises an error, and name both in the error."""
        try:
            with limit_threads(self._settings.threads):
                yield
        except Exception as error:
            said, code = explain(error)
            said = self._keep_failed(self._renders.get(self._at_work, files), said)
            if len(self.plan.frames) > 1:
                said = f"frame {self._at_work}: {said}"
            raise (InputError if code == InputError.exit_code else MssplError)(said) from error

    def _start(self, files: FrameFiles) -> ShotRun:
        plan = self.plan
        if plan.count:
            _, hr = map_pair(*files.pair, self._settings.inputs)
            # The format need not be verified: Blender is known, and motion blur is off.
            motion = MotionSource(VECTORS, plan.text, hr.motion.fields)
            plan = replace(plan, views={None: ViewPlan(plan.views[None].reach, motion)})
        return ShotRun(self._settings, plan, self._wanted, yields_errors=True)

    def _keep_failed(self, files: FrameFiles, said: str) -> str:
        """Keep the renders of a frame that can't be fused. The rest of the temporary files is deleted.

        Return the error ``said``, which may name the renders, with the names of the files that are kept.
        """
        kept = self._places(files)
        if not all(path.exists() for path in kept):  # Blender wrote none, and the error says so
            return said
        wanted = any(files.output == frame.output for frame in self._wanted)
        if not wanted or (not self._keep and any(target.exists() for target in kept.values())):
            names = ("the LRHS", "the HRLS") if self._scale != ONE_SIZE else ("the first render", "the second render")
            for path, name in zip(kept, names if len(kept) > 1 else ["the render"], strict=True):
                said = said.replace(str(path), name)
            return said
        for path, target in kept.items():
            os.replace(path, target)
            said = said.replace(str(path), str(target))
        subject = "both renders are" if len(kept) > 1 else "the render is"
        return f"{said}; {subject} kept for msspl-fuse: {', '.join(map(str, kept.values()))}"

    def _places(self, files: FrameFiles) -> dict[Path, Path]:
        """Return where each render of a frame is kept, by its temporary file. An only render is there once."""
        paths = dict.fromkeys(files.pair)
        return {path: beside(files.output, name) for path, name in zip(paths, self.suffixes, strict=True)}

    def waits(self, output: Path) -> bool:
        """Return whether a frame is rendered, and waits for its neighbours."""
        return output not in self.written and any(frame.output == output for frame in self._renders.values())

    def _discard(self) -> None:
        """Delete the renders that no frame needs any more, or keep them beside the result."""
        missing = [files.number for files in self._wanted if files.output not in self.written]
        needed = {n for number in missing for n in (number, *neighbours(number, self.plan.count, self.plan.frames))}
        for number in self._renders.keys() - needed:
            files = self._renders.pop(number)
            for path, target in self._places(files).items():
                if self._keep and files.output in self.written:
                    os.replace(path, target)
                else:
                    path.unlink()
