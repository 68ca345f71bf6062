# SPDX-License-Identifier: Apache-2.0
"""Fuses the frames of a shot while Blender renders them. No other module of the programs uses RenderedShot."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from oiio_msspl.errors import InputError
from oiio_msspl.jobs.blender_source import RenderedShot, beside
from oiio_msspl.jobs.plan import TemporalOptions
from oiio_msspl.jobs.sequence import FrameFiles
from oiio_msspl.jobs.settings import Settings
from oiio_msspl.model.catalogue import family_of

__all__ = ["RenderedFrames", "beside"]


class RenderedFrames:
    """The frames of a shot that Blender renders, and their reports.

    The model is loaded first, so that no frame is rendered for nothing.

    Args:
        shot: number and result of each frame. A scene without a number is one frame, numbered 0.
        wanted: the results to write.
        scale: width of the frame / width of the LRHS.
        temporal: how many neighbours each frame is averaged with.
        keep: keep both renders of a frame beside its result.
        settings: further fields of :class:`oiio_msspl.jobs.settings.Settings`.

    Raises:
        InputError: the model, the device or the neighbours can't be had.
    """

    def __init__(
        self,
        shot: Sequence[tuple[int | None, Path]],
        wanted: Collection[Path],
        scale: int,
        temporal: TemporalOptions,
        *,
        keep: bool,
        **settings: Any,
    ) -> None:
        job = Settings(**settings)
        job = replace(job, model=family_of(job.model) or job.model)
        session = job.load(scale)
        if session.contract.scale != scale:
            raise InputError(f"--model {job.model}: is for x{session.contract.scale}, but --scale is {scale}")
        job.session(scale)  # refuses a model that does not make the layers that are asked for
        frames = [FrameFiles(number or 0, None, None, path.absolute()) for number, path in shot]
        results = {path.absolute() for path in wanted}
        to_write = [frame for frame in frames if frame.output in results]
        self._shot, self._keep = RenderedShot(job, frames, to_write, temporal, keep=keep), keep
        self._waiting: list[dict[str, Any]] = []  # reports of frames that wait for their neighbours
        self._warnings: list[str] = []  # about all frames
        self.order = [
            (frame.number, str(frame.output) if frame.output in results else None) for frame in self._shot.order
        ]
        """Number and result of each frame to render. A frame without a result is rendered for its neighbours."""

    @property
    def averages(self) -> bool:
        """True if frames are averaged with their neighbours."""
        return self._shot.averages

    @property
    def text(self) -> str:
        """How frames are averaged, in words; empty if the user has switched that off."""
        return self._shot.text

    def fuse(self, lr: Path, hr: Path) -> None:
        """Fuse the next frame of ``order``, and write each frame that has all its neighbours.

        Raises:
            InputError, MssplError: a frame can't be fused. The message names it if there are several.
        """
        self._shot.fuse(lr, hr)

    def take(self, event: dict[str, Any]) -> None:
        """Take an event of :func:`msspl_cli.blender_process.render_frames`.

        Raises:
            InputError: the frames that it is about could not be fused.
        """
        if "no_vectors" in event:
            self._shot.fuse_alone(event["no_vectors"])
        if "size" in event:
            self._shot.check(event["size"], event["layers"], event["pixel_bytes"])
        if "warning" in event:
            self._warnings.append(event["warning"])
        if "report" in event:
            self._waiting.append(event["report"])

    def written(self) -> list[dict[str, Any]]:
        """Return the reports of the frames that were written since the last call."""
        reports = []
        while self._waiting and not self._shot.waits(result := Path(self._waiting[0]["output"])):
            report = self._waiting.pop(0)
            report["temporal"] = self.text
            report["warnings"] += [*self._warnings, *self._shot.warnings(result)]
            for render, suffix in (("lrhs", "lr"), ("hrls", "hr")):
                report[render]["file"] = str(beside(result, suffix)) if self._keep else None
            reports.append(report)
        return reports
