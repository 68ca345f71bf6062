# SPDX-License-Identifier: Apache-2.0
"""A shot: the main job on every frame of two sequences, in this process or on a Dask cluster.

A bad frame is reported and does not stop the others. A new EXR gets its name last, after its preview: an EXR that
exists is a frame that is complete, whenever a run was ended. An EXR that is replaced comes before its preview, so a run
that is killed between the two leaves the new frame without one.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from oiio_msspl.errors import InputError, MssplError, explain
from oiio_msspl.exr.atomic import remove_leftovers
from oiio_msspl.exr.preview import check_view
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.fusion.tiles.tiling import MAX_MEMORY
from oiio_msspl.image.parallel import limit_threads
from oiio_msspl.jobs.checks import check_first_pair, check_output, make_output, model_of_shot
from oiio_msspl.jobs.existing import ExistingResults
from oiio_msspl.jobs.farm.dask import fuse_frames
from oiio_msspl.jobs.inputs import InputOptions
from oiio_msspl.jobs.pipeline import run_pipeline
from oiio_msspl.jobs.plan import AUTO, TemporalOptions, plan_temporal
from oiio_msspl.jobs.run import ShotRun
from oiio_msspl.jobs.sequence import FrameFiles, find_shot
from oiio_msspl.jobs.settings import Settings
from oiio_msspl.jobs.shot_report import FAILED, SKIPPED, FrameResult, ShotReport, fused_result, read_earlier, result_of
from oiio_msspl.model.devices import require_device

if TYPE_CHECKING:
    from dask.distributed import Client


log = logging.getLogger(__name__)


def fuse_shot(
    lr: str | Path,
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
    max_memory: int = MAX_MEMORY,
    previews: bool = False,
    view_transform: str | None = None,
    overwrite: bool = False,
    skip_existing: bool = False,
    update: bool = False,
    report_path: str | Path | None = None,
    progress: Callable[[FrameResult, ShotReport], None] | None = None,
    client: Client | None = None,
) -> ShotReport:
    """Fuse two sequences. A frame that can't be fused is reported, and the others go on.

    Args:
        lr, hr: folders or patterns, see :func:`oiio_msspl.jobs.sequence.find_shot`.
        output: a pattern, or a folder, which is created if its parent exists.
        frames: numbers, or a range such as ``1001-1100x2``; None for all frames that exist.
        inputs, write, model, device, threads, max_memory, view_transform: as in :func:`oiio_msspl.fuse_files`.
        temporal: ``auto``, ``off``, or the number of frames before and after each frame that it is averaged with;
            :class:`oiio_msspl.jobs.plan.TemporalOptions` also say how motion is stored.
        previews: write a PNG beside each EXR.
        overwrite: replace existing files.
        skip_existing: skip frames whose EXR exists. This resumes a run that was ended.
        update: the same, but fuse a frame again if one of its inputs is newer than its EXR, as ``make`` does.
        report_path: JSON file that is kept up to date frame by frame. With ``skip_existing``, skipped frames keep
            their entries of an earlier report.
        progress: called after each frame with its result and the report so far. Frames that are skipped, missing or
            blocked by an existing file come first.
        client: a client of a Dask cluster that sees the same files, see
            :func:`oiio_msspl.jobs.farm.dask.connect`. The cluster's workers fuse the frames, which then end in any
            order. None fuses in this process.

    Returns:
        The result of every frame.

    Raises:
        InputError: no frame could be fused: there are none, the output can't be written, or an option is wrong.
        MssplError: the report can't be written.
    """
    start = time.perf_counter()
    if overwrite and (skip_existing or update):
        option = "--update" if update else "--skip-existing"
        raise InputError(f"--overwrite and {option} exclude each other: replace all frames, or leave some")
    if not isinstance(temporal, TemporalOptions):
        temporal = TemporalOptions(temporal)
    shot = find_shot(lr, hr, output, frames)
    if previews and view_transform is not None:
        check_view(view_transform)
    report_path = None if report_path is None else Path(report_path)
    if previews:
        shot = replace(shot, frames=[replace(each, preview=each.output.with_suffix(".png")) for each in shot.frames])
    if client is None:  # workers of a cluster may have other devices
        require_device(device)
    check_output(shot, inputs, model, [] if report_path is None else [report_path])
    with limit_threads(threads):
        plan = plan_temporal(shot, inputs, temporal, model, write)
    report = ShotReport(shot, temporal=plan.text, neighbours=plan.count)
    earlier = read_earlier(report, report_path, overwrite, skip_existing or update)
    make_output(shot)

    def finish(result: FrameResult) -> None:
        report.results[result.frame] = result
        report.seconds = time.perf_counter() - start
        if progress is not None:
            progress(result, report)

    def record(frame: FrameFiles, outcome: dict[str, Any] | Exception | None) -> None:
        if isinstance(outcome, Exception):
            log.debug("frame %d", frame.number, exc_info=outcome)
            finish(result_of(frame, FAILED, *explain(outcome)))
        elif outcome is None:
            finish(result_of(frame, SKIPPED))
        else:
            finish(fused_result(frame, outcome, report))

    def save() -> None:
        # A disk that is full now may have room later, so a failure becomes an error only at the end.
        try:
            if report_path is not None:
                report.save(report_path)
        except MssplError as error:
            log.warning("%s", error)

    settings = Settings(
        inputs,
        write,
        model,
        device,
        threads,
        max_memory,
        view_transform,
        overwrite,
        skip_existing=skip_existing or update,
        update=update,
    )
    existing = ExistingResults(settings, plan)
    to_fuse = []
    for frame in shot.frames:
        result = existing.known_result(frame, shot)
        if result is None:
            to_fuse.append(frame)
            continue
        if result.status == SKIPPED and (entry := earlier.get(frame.number)):
            warnings = list(dict.fromkeys([*entry["warnings"], *result.warnings]))
            result = replace(result, **entry | {"warnings": warnings})
        finish(result)
    if report.first is not None and report.first["frame"] in {frame.number for frame in to_fuse}:
        report.first = None  # the report of a result that is replaced
    if to_fuse:
        with limit_threads(threads):
            settings = replace(settings, model=model_of_shot(shot, inputs, model))
    targets = [path for frame in shot.frames for path in (frame.output, frame.output.with_suffix(".png"))]
    remove_leftovers([*targets, report_path] if report_path else targets)
    try:
        if client is None:
            run_pipeline(ShotRun(settings, plan, to_fuse), record, save)
        else:
            for doubt in check_first_pair(to_fuse, inputs):
                log.warning("%s", doubt)
            for frame, outcome in fuse_frames(client, settings, plan, to_fuse):
                record(frame, outcome)
                save()
            remove_leftovers(targets)  # of workers that died
    finally:
        report.seconds = time.perf_counter() - start
        if report_path is not None:
            report.save(report_path)
    return report
