# SPDX-License-Identifier: Apache-2.0
"""Fuses a shot: every frame of two sequences, or of one, in this process or on a Dask cluster.

A bad frame is reported and does not stop the others.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from oiio_msspl.errors import InputError, MssplError, explain
from oiio_msspl.exr.atomic import make_folder, remove_leftovers
from oiio_msspl.exr.preview import check_view
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.fusion.tiles.tiling import MAX_MEMORY
from oiio_msspl.image.parallel import limit_threads
from oiio_msspl.jobs.checks import (
    check_first_pair,
    check_mapped_sequences,
    check_no_input,
    check_output,
    look_ahead,
    model_of_shot,
)
from oiio_msspl.jobs.existing import ExistingResults
from oiio_msspl.jobs.farm.dask import fuse_frames
from oiio_msspl.jobs.inputs import InputOptions
from oiio_msspl.jobs.pipeline import Outcome, run_pipeline
from oiio_msspl.jobs.plan import AUTO, TemporalOptions, plan_temporal
from oiio_msspl.jobs.run import ShotRun
from oiio_msspl.jobs.sequence import FrameFiles, find_shot
from oiio_msspl.jobs.settings import Settings, bytes_of
from oiio_msspl.jobs.shot_report import FAILED, SKIPPED, FrameResult, ShotReport, fused_result, read_earlier, result_of
from oiio_msspl.model.devices import require_device

if TYPE_CHECKING:
    from dask.distributed import Client


log = logging.getLogger(__name__)

#: Called after each frame with its result and the report so far.
ShotProgress = Callable[[FrameResult, ShotReport], None]


def fuse_shot(
    lr: str | Path | None,
    hr: str | Path,
    output: str | Path,
    *,
    frames: str | Iterable[int] | None = None,
    inputs: InputOptions = InputOptions(),
    write: WriteOptions = WriteOptions(),
    temporal: str | int | TemporalOptions = AUTO,
    model: str | None = None,
    device: str = "cpu",
    threads: int = 0,
    max_memory: int | str = MAX_MEMORY,
    previews: bool = False,
    view_transform: str | None = None,
    overwrite: bool = False,
    strict: bool = False,
    skip_existing: bool = False,
    update: bool = False,
    report_path: str | Path | None = None,
    begin: Callable[[ShotReport], None] | None = None,
    progress: ShotProgress | None = None,
    client: Client | None = None,
) -> ShotReport:
    """Fuse two sequences, or one. A frame that can't be fused is reported, and the others go on.

    Args:
        lr, hr: folders or patterns, see :func:`oiio_msspl.jobs.sequence.find_shot`.
        output: a pattern, or a folder, which is created if its parent exists.
        frames: numbers, or a range such as ``1001-1100x2``; None for all frames that exist.
        inputs, write, model, device, threads, max_memory, view_transform: as in :func:`oiio_msspl.fuse_files`.
        temporal: ``auto``, ``off``, or the number of frames before and after each frame that it is averaged with;
            :class:`oiio_msspl.jobs.plan.TemporalOptions` also say how motion is stored.
        previews: write a PNG beside each EXR.
        overwrite: replace existing files.
        strict: refuse a frame that has a warning, and write nothing.
        skip_existing: skip frames whose EXR exists. This resumes a run that was ended.
        update: as ``skip_existing``, but fuse a frame again if an input is newer than its EXR, as ``make`` does.
        report_path: JSON file that is kept up to date frame by frame. With ``skip_existing``, skipped frames keep
            their entries of an earlier report.
        begin: called before the first frame is fused with the report, whose ``found`` and ``temporal`` say what will be
            done. It is not called if no frame is to be fused.
        progress: called after each frame with its result and the report so far, on the thread that writes frames.
            Frames that are skipped, missing or blocked by an existing file come first.
        client: a client of a Dask cluster that sees the same files, see
            :func:`oiio_msspl.jobs.farm.dask.connect`. The cluster's workers fuse the frames, which then end in any
            order. None fuses in this process.

    Returns:
        The result of every frame.

    Raises:
        InputError: no frame could be fused: there are none, the output can't be written, an option is wrong, or other
            weights made the frames that ``skip_existing`` keeps.
        MssplError: the report can't be written.
    """
    start = time.perf_counter()
    if overwrite and (skip_existing or update):
        option = "--update" if update else "--skip-existing"
        raise InputError(f"--overwrite and {option} exclude each other: replace all frames, or leave some")
    if not isinstance(temporal, TemporalOptions):
        temporal = TemporalOptions(temporal)
    if client is not None:  # workers have other working directories
        lr, hr, output = None if lr is None else Path(lr).absolute(), Path(hr).absolute(), Path(output).absolute()
        inputs = replace(inputs, map_file=inputs.map_file and inputs.map_file.absolute())
        model = str(Path(model).absolute()) if model is not None and Path(model).is_file() else model
    shot = find_shot(lr, hr, output, frames)
    if previews:
        if view_transform is not None:
            check_view(view_transform)
        frames_to_fuse = [replace(files, preview=files.output.with_suffix(".png")) for files in shot.frames]
        shot = replace(shot, frames=frames_to_fuse)
    if client is None:  # workers of a cluster may have other devices
        require_device(device)
    path = None if report_path is None else Path(report_path)
    check_mapped_sequences(shot.frames, inputs)
    check_output(shot)
    check_no_input(shot, inputs, model, [] if path is None else [path])
    with limit_threads(threads):
        plan = plan_temporal(shot, inputs, temporal, model, write)
    skip, memory = skip_existing or update, bytes_of(max_memory)
    settings = Settings(inputs, write, model, device, threads, memory, view_transform, overwrite, skip, update, strict)
    report = ShotReport(shot, temporal=plan.text, neighbours=plan.count, warnings=plan.warnings)
    earlier = read_earlier(report, path, overwrite, settings.skip_existing)
    make_folder(shot.output.folder)
    running = _RunningReport(report, path, progress, start)
    to_fuse, skipped = running.add_known(ExistingResults(settings, plan), earlier)
    if to_fuse:
        with limit_threads(threads):
            settings = replace(settings, model=model_of_shot(shot, inputs, model, error=write.error_layer))
        ExistingResults(settings, plan).check_weights(skipped)
        report.found = look_ahead(to_fuse, settings)
        if client is None and report.found is not None:
            settings.session(report.found["scale"])  # a model that can't be used is refused before anything is told
        if begin is not None:
            begin(report)
    targets = [file for frame in shot.frames for file in (frame.output, frame.output.with_suffix(".png"))]
    remove_leftovers([*targets, *([] if path is None else [path])])
    try:
        if client is None:
            run_pipeline(ShotRun(settings, plan, to_fuse), running.add_outcome)
        else:
            for doubt in check_first_pair(to_fuse, inputs):
                log.warning("%s", doubt)
            for frame, outcome in fuse_frames(client, settings, plan, to_fuse):
                running.add_outcome(frame, outcome)
            remove_leftovers(targets)  # of workers that died
    finally:
        running.close()
    return report


@dataclass
class _RunningReport:
    """The report of a shot that runs, and who is told of it."""

    report: ShotReport
    path: Path | None
    progress: ShotProgress | None
    start: float

    def add(self, result: FrameResult) -> None:
        self.report.results[result.frame] = result
        self.report.seconds = time.perf_counter() - self.start
        if self.progress is not None:
            self.progress(result, self.report)

    def add_known(
        self, existing: ExistingResults, earlier: dict[int, dict[str, Any]]
    ) -> tuple[list[FrameFiles], list[FrameFiles]]:
        """Add the frames that are skipped, missing or blocked by an existing file. Return those to fuse and to skip.

        A skipped frame keeps its entry of an ``earlier`` report.
        """
        to_fuse, skipped = [], []
        for frame in self.report.shot.frames:
            result = existing.known_result(frame, self.report.shot)
            if result is None:
                to_fuse.append(frame)
                continue
            if result.status == SKIPPED:
                skipped.append(frame)
                if entry := earlier.get(frame.number):
                    warnings = list(dict.fromkeys([*entry["warnings"], *result.warnings]))
                    result = replace(result, **entry | {"warnings": warnings})
            self.add(result)
        first = self.report.first
        if first is not None and first["frame"] in {frame.number for frame in to_fuse}:
            self.report.first = None  # its result is replaced
        return to_fuse, skipped

    def add_outcome(self, frame: FrameFiles, outcome: Outcome) -> None:
        """Add a frame that ended, and save the report. A full disk may have room later, so it is only logged."""
        if isinstance(outcome, Exception):
            log.debug("frame %d", frame.number, exc_info=outcome)
            self.add(result_of(frame, FAILED, *explain(outcome)))
        elif outcome is None:
            self.add(result_of(frame, SKIPPED))
        else:
            self.add(fused_result(frame, outcome, self.report))
        try:
            self.close()
        except MssplError as error:
            log.warning("%s", error)

    def close(self) -> None:
        """Save the report at the end of the run. Raise MssplError if the file system refuses."""
        self.report.seconds = time.perf_counter() - self.start
        if self.path is not None:
            self.report.save(self.path)
