# SPDX-License-Identifier: Apache-2.0
"""A shot: the main job on every frame of two sequences, reading, inference and writing at the same time.

While a frame is fused in the calling thread, the next one is read in a second thread and the one before is written in
a third: at most one frame is in each stage, so memory does not grow with the shot. On a cluster a worker takes a frame
through all three. A frame's EXR gets its name last, after its preview: an EXR that is there is a frame that is done, at
whatever moment a run was ended.
"""

from __future__ import annotations

import json
import logging
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from oiio_msspl._version import __version__
from oiio_msspl.aovs.features import HRLS_FEATURES
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.errors import InputError, MssplError, explain
from oiio_msspl.exr.atomic import check_folder, check_target, remove_leftovers, replacing
from oiio_msspl.exr.preview import check_view, is_our_preview
from oiio_msspl.exr.render import ReadableRender
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.fusion.alignment import align
from oiio_msspl.fusion.fuse import FusedFrame, fuse
from oiio_msspl.fusion.tiling import FIXED_MEMORY, MAX_MEMORY
from oiio_msspl.jobs.frame import InputOptions, map_pair, write_frame, write_frame_preview
from oiio_msspl.jobs.report import FrameReport, report_on
from oiio_msspl.jobs.sequence import Frame, Shot, find_shot
from oiio_msspl.model.catalogue import find_model
from oiio_msspl.model.session import Session

if TYPE_CHECKING:
    from dask.distributed import Client


log = logging.getLogger(__name__)

FUSED, SKIPPED, FAILED, MISSING = STATUSES = ("fused", "skipped", "failed", "missing")


@dataclass
class FrameResult:
    """What became of one frame."""

    frame: int
    status: str
    """``fused``, ``skipped`` (it was there), ``failed``, or ``missing`` (a partner is)."""
    message: str = ""
    """Why it is not fused."""
    exit_code: int = 0
    """0, 2 for the caller's mistake, 1 for a failure of ours."""
    warnings: list[str] = field(default_factory=list)
    repaired: dict[str, int] = field(default_factory=dict)
    """See :class:`oiio_msspl.fusion.fuse.FusedFrame`."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Of ``read``, ``fuse``, ``network`` in it, and ``write``: they overlap with those of the neighbours."""
    lrhs: str | None = None
    hrls: str | None = None
    output: str = ""


@dataclass
class ShotReport:
    """What became of a shot."""

    shot: Shot
    results: dict[int, FrameResult] = field(default_factory=dict)
    """By frame; while the shot is not finished, frames that are not reached have none."""
    first: dict[str, Any] | None = None
    """The whole report of the first frame that was fused: scale, model, which layers were read."""
    seconds: float = 0.0
    """Wall time."""

    @property
    def exit_code(self) -> int:
        """0 if every frame is fused or was there, 1 if some failed by a fault of ours, otherwise 2."""
        codes = {result.exit_code for result in self.results.values()}
        return 1 if 1 in codes else max(codes, default=0)

    @property
    def stage_seconds(self) -> dict[str, float]:
        """Time spent in each stage, all frames together; overlapped, so that the sum exceeds the wall time."""
        total: Counter[str] = Counter()
        for result in self.results.values():
            if result.status == FUSED:
                total.update(result.seconds)
        return dict(total)

    def as_dict(self) -> dict[str, Any]:
        counts = Counter(result.status for result in self.results.values())
        return {
            "lrhs": str(self.shot.lr.pattern),
            "hrls": str(self.shot.hr.pattern),
            "output": str(self.shot.output),
            "finished": len(self.results) == len(self.shot.frames),
            "exit_code": self.exit_code,
            "counts": {"all": len(self.shot.frames), **{status: counts[status] for status in STATUSES}},
            "seconds": {k: round(v, 3) for k, v in {"wall": self.seconds, **self.stage_seconds}.items()},
            "first_fused": self.first,
            "frames": [asdict(self.results[f.number]) for f in self.shot.frames if f.number in self.results],
            "version": __version__,
        }


def fuse_shot(
    lr: str | Path,
    hr: str | Path,
    output: str | Path,
    *,
    frames: str | Iterable[int] | None = None,
    inputs: InputOptions = InputOptions(),
    write: WriteOptions = WriteOptions(),
    model: str | None = None,
    device: str = "cpu",
    threads: int = 0,
    max_memory: int = MAX_MEMORY,
    previews: bool = False,
    view_transform: str | None = None,
    overwrite: bool = False,
    skip_existing: bool = False,
    report_path: str | Path | None = None,
    progress: Callable[[FrameResult, ShotReport], None] | None = None,
    client: Client | None = None,
) -> ShotReport:
    """Fuse two sequences frame by frame. A frame that can't be fused is reported, and the others go on.

    Args:
        lr, hr: folders or patterns, see :func:`oiio_msspl.jobs.sequence.find_shot`.
        output: a pattern, or a folder, which is made if only it is missing.
        frames: numbers, or a range such as ``1001-1100x2``; None for all that there are.
        inputs, write, model, device, threads, max_memory, view_transform: as of :func:`oiio_msspl.fuse_files`.
        previews: write a PNG beside each EXR.
        overwrite: replace files that exist.
        skip_existing: leave frames alone whose EXR exists, and do the others: resumes a run that was ended.
        report_path: JSON to keep up to date, frame by frame. With ``skip_existing``, what a report there says of
            skipped frames is kept.
        progress: called after each frame with its result and the report so far. What is known of frames before anything
            is computed (skipped, missing, in the way) comes first.
        client: of a Dask cluster that sees the same files (:func:`oiio_msspl.jobs.dask_cluster.connect`): its workers fuse the
            frames, which then end in any order. None: this process does.

    Raises:
        InputError: nothing can be done: no frames, an output that can't be, an option that is wrong for all.
        MssplError: the report can't be written.
    """
    start = time.perf_counter()
    if overwrite and skip_existing:
        raise InputError("--overwrite and --skip-existing exclude each other: replace frames, or leave them")
    shot = find_shot(lr, hr, output, frames)
    if previews and view_transform is not None:
        check_view(view_transform)
    _prepare_output(shot)
    report = ShotReport(shot)
    report_path = None if report_path is None else Path(report_path)
    earlier = _read_earlier(report, report_path, overwrite, skip_existing)

    def done(result: FrameResult) -> None:
        report.results[result.frame] = result
        report.seconds = time.perf_counter() - start
        if progress is not None:
            progress(result, report)

    to_do = []
    for frame in shot.frames:
        result = _known_before(frame, shot, previews, overwrite, skip_existing)
        if result is None:
            to_do.append(frame)
        else:
            done(replace(result, **earlier.get(frame.number, {})) if result.status == SKIPPED else result)
    targets = [path for frame in shot.frames for path in (frame.output, frame.output.with_suffix(".png"))]
    remove_leftovers([*targets, report_path] if report_path else targets)
    stages = Stages(
        inputs, write, model, device, threads, max_memory, previews, view_transform, overwrite, skip_existing
    )
    try:
        if client is None:
            _run(stages, to_do, report, done, report_path)
        else:
            _run_on_cluster(client, stages, to_do, report, done, report_path)
            remove_leftovers(targets)  # of workers that died
    finally:
        report.seconds = time.perf_counter() - start
        _save(report, report_path)
    return report


# ---------------------------------------------------------------------------------------------- before the first frame


def _prepare_output(shot: Shot) -> None:
    folder = shot.output.folder
    if not folder.exists():
        check_folder(folder)
        folder.mkdir(exist_ok=True)
    check_folder(shot.output.path(0))
    check_no_input(shot)


def check_no_input(shot: Shot) -> None:
    """Raise InputError if a frame would be written over what it is made from."""
    for frame in shot.frames:
        for source in (frame.lr, frame.hr):
            if source is not None and source.exists() and frame.output.exists() and frame.output.samefile(source):
                raise InputError(f"{frame.output}: is one of the inputs; write the results elsewhere")


def _known_before(frame: Frame, shot: Shot, previews: bool, overwrite: bool, skip_existing: bool) -> FrameResult | None:
    """The result of a frame that there is nothing to compute of; None for the others."""
    if skip_existing and frame.output.exists():
        return _result(frame, SKIPPED)
    sources = (("LRHS", frame.lr, shot.lr), ("HRLS", frame.hr, shot.hr))
    lacking = [f"{name} ({sequence.pattern})" for name, path, sequence in sources if path is None]
    if lacking:
        return _result(frame, MISSING, f"no {' and no '.join(lacking)} of this number", 2)
    if os.path.lexists(frame.output) and not frame.output.is_dir() and not overwrite:
        return _result(frame, FAILED, "the output exists; pass --skip-existing or --overwrite", 2)
    try:
        check_target(frame.output, overwrite=overwrite)
        if previews:
            png = frame.output.with_suffix(".png")
            check_target(png, overwrite=overwrite or (skip_existing and _is_left_over(png)))
    except InputError as error:
        return _result(frame, FAILED, str(error), error.exit_code)
    return None


def _is_left_over(png: Path) -> bool:
    """Beside an EXR that is not there: is this the preview that a killed run left, and not somebody else's picture?"""
    return png.is_file() and is_our_preview(png)


def _result(frame: Frame, status: str, message: str = "", exit_code: int = 0, **more: Any) -> FrameResult:
    lrhs, hrls = (None if path is None else str(path) for path in (frame.lr, frame.hr))
    return FrameResult(frame.number, status, message, exit_code, lrhs=lrhs, hrls=hrls, output=str(frame.output), **more)


# ---------------------------------------------------------------------------------------------- the three stages


@dataclass(frozen=True)
class Pair:
    """A frame that is read."""

    frame: Frame
    lr: MappedRender
    hr: MappedRender
    sources: tuple[ReadableRender, ReadableRender]
    """The same two with their pixels in memory, or the files themselves where there is no room for that."""
    seconds: float


@dataclass(frozen=True)
class Stages:
    """What is done with a frame: ``read``, ``fuse`` and ``write``, each called from one thread alone."""

    inputs: InputOptions = InputOptions()
    options: WriteOptions = WriteOptions()
    model: str | None = None
    device: str = "cpu"
    threads: int = 0
    max_memory: int = MAX_MEMORY
    previews: bool = False
    view_transform: str | None = None
    overwrite: bool = False
    skip_existing: bool = False
    sessions: dict[Path, Session] = field(default_factory=dict)

    def read(self, frame: Frame) -> Pair:
        start = time.perf_counter()
        assert frame.lr is not None and frame.hr is not None
        lr, hr = map_pair(frame.lr, frame.hr, self.inputs)
        align(lr, hr)  # before pixels are read for nothing
        fits = 2 * (_pixel_bytes(lr) + _pixel_bytes(hr)) <= (self.max_memory - FIXED_MEMORY) // 2
        sources: tuple[ReadableRender, ReadableRender] = (lr.load(), hr.load()) if fits else (lr, hr)
        return Pair(frame, lr, hr, sources, time.perf_counter() - start)

    def session(self, ready: Pair) -> Session:
        """The model, loaded once for each scale that occurs."""
        path = find_model(align(*ready.sources).scale, self.model)
        if path not in self.sessions:
            self.sessions[path] = Session(path, self.device, self.threads)
        if self.options.error_layer:
            self.sessions[path].require_error()
        return self.sessions[path]

    def fuse(self, ready: Pair, session: Session) -> tuple[FrameReport, FusedFrame]:
        start = time.perf_counter()
        # Beside this frame there are the pixels of the next one, and the result of the one before.
        held = 5 if self.options.error_layer else 4
        beside = ready.hr.data_window.width * ready.hr.data_window.height * held * 4
        if ready.sources[1] is not ready.hr:
            beside += 2 * (_pixel_bytes(ready.lr) + _pixel_bytes(ready.hr))
        fused = fuse(*ready.sources, session, error=self.options.error_layer, max_memory=self.max_memory - beside)
        preview_path = ready.frame.output.with_suffix(".png") if self.previews else None
        report = report_on(ready.lr, ready.hr, session, fused, ready.frame.output, preview_path)
        report.seconds = {"read": ready.seconds, "fuse": time.perf_counter() - start, "network": fused.seconds}
        return report, fused

    def write(self, report: FrameReport, fused: FusedFrame) -> None:
        start = time.perf_counter()
        if self.overwrite and report.output.exists():
            # If it can't be replaced, the old frame keeps its preview.
            write_frame(report, fused, self.options, overwrite=True)
            write_frame_preview(report, fused, self.view_transform, overwrite=True)
        else:
            self._write_new(report, fused)
        report.seconds["write"] = time.perf_counter() - start

    def _write_new(self, report: FrameReport, fused: FusedFrame) -> None:
        replaces = self.skip_existing and report.preview is not None and _is_left_over(report.preview)
        write_frame_preview(report, fused, self.view_transform, overwrite=self.overwrite or replaces)
        try:
            write_frame(report, fused, self.options, overwrite=self.overwrite)
        except BaseException:
            # Should another run have put the frame there meanwhile, the preview is its own.
            if report.preview is not None and not report.output.exists():
                report.preview.unlink(missing_ok=True)
            raise


def _pixel_bytes(render: MappedRender) -> int:
    """What the features of a file take in memory."""
    channels = sum(HRLS_FEATURES[name] for name in render.features) + (render.alpha is not None)
    return render.data_window.width * render.data_window.height * channels * 4


def _run(
    stages: Stages,
    frames: list[Frame],
    report: ShotReport,
    done: Callable[[FrameResult], None],
    report_path: Path | None,
) -> None:
    """Take frames through the stages. Whatever ends this, the frame that is being written is finished and recorded."""
    writing: tuple[Frame, FrameReport, Future[None]] | None = None

    def failed(frame: Frame, error: BaseException) -> None:
        if not isinstance(error, Exception):
            raise error
        log.debug("frame %d", frame.number, exc_info=error)
        done(_result(frame, FAILED, *explain(error)))

    def finish_writing() -> None:
        nonlocal writing
        if writing is None:
            return
        frame, made, future = writing
        error = future.exception()
        if error is None:
            done(_fused_result(frame, made.as_dict(), report))
        else:
            failed(frame, error)
        writing = None  # only now: a signal may come anywhere above, and the frame is recorded on the way out

    with ThreadPoolExecutor(1, "read") as reader, ThreadPoolExecutor(1, "write") as writer:
        ahead = [reader.submit(stages.read, frame) for frame in frames[:1]]
        try:
            for index, frame in enumerate(frames):
                reading = ahead.pop()
                ahead += [reader.submit(stages.read, following) for following in frames[index + 1 : index + 2]]
                error = reading.exception()
                if error is None:
                    session = stages.session(reading.result())  # a model that can't be loaded is no frame's fault
                    try:
                        made, fused = stages.fuse(reading.result(), session)
                    except Exception as caught:
                        error = caught
                # One frame is written at a time, and results are told in the order of the frames.
                finish_writing()
                if error is None:
                    # Known before it is handed over: a signal may come while that is done
                    outcome: Future[None] = Future()
                    writing = frame, made, outcome
                    writer.submit(_settle, outcome, stages.write, made, fused)
                    del made, fused
                else:
                    failed(frame, error)
                del reading, error  # with their pixels, before the next frame's arrive
                _save_meanwhile(report, report_path)
        finally:
            for reading in ahead:
                reading.cancel()
            writer.shutdown()
            if writing is not None and writing[2].done():  # else it was never handed over
                finish_writing()


def _settle(
    outcome: Future[None], write: Callable[[FrameReport, FusedFrame], None], report: FrameReport, fused: FusedFrame
) -> None:
    """Write, and say how that ended."""
    try:
        write(report, fused)
    except BaseException as error:
        outcome.set_exception(error)
    else:
        outcome.set_result(None)


def _run_on_cluster(
    client: Client,
    stages: Stages,
    frames: list[Frame],
    report: ShotReport,
    done: Callable[[FrameResult], None],
    report_path: Path | None,
) -> None:
    from oiio_msspl.jobs.dask_cluster import fuse_frames

    for frame, made in fuse_frames(client, stages, frames):
        if isinstance(made, Exception):
            log.debug("frame %d", frame.number, exc_info=made)
            done(_result(frame, FAILED, *explain(made)))
        elif made is None:
            done(_result(frame, SKIPPED))
        else:
            done(_fused_result(frame, made, report))
        _save_meanwhile(report, report_path)


def _fused_result(frame: Frame, made: dict[str, Any], report: ShotReport) -> FrameResult:
    """The result of a frame whose single-frame report is ``made``."""
    first = report.first = report.first or {"frame": frame.number, **made}
    warnings = list(made["warnings"])
    if made["repaired"]:
        warnings.append(f"repaired values that were NaN, infinite or negative in {', '.join(made['repaired'])}")
    was = {row["feature"]: row["status"] for row in first["aovs"]}
    warnings += [
        f"{row['feature']} is {row['status']} here and {was[row['feature']]} in frame {first['frame']}: it may flicker"
        for row in made["aovs"]
        if row["status"] != was[row["feature"]]
    ]
    return _result(frame, FUSED, warnings=warnings, repaired=made["repaired"], seconds=made["seconds"])


# ---------------------------------------------------------------------------------------------- the report as a file


def _read_earlier(
    report: ShotReport, path: Path | None, overwrite: bool, skip_existing: bool
) -> dict[int, dict[str, Any]]:
    """By frame, what the report of the run that is resumed says of it beyond its status."""
    if path is None:
        return {}
    check_target(path, overwrite=overwrite or skip_existing)
    if not skip_existing or not path.exists():
        return {}
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        report.first = data["first_fused"]
        return {entry["frame"]: {k: entry[k] for k in ("warnings", "repaired", "seconds")} for entry in data["frames"]}
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: exists and is no report of a shot; name another file") from error


def _save(report: ShotReport, path: Path | None) -> None:
    """Write the whole report: a run that is killed leaves one that is valid and up to date."""
    if path is not None:
        with replacing(path, overwrite=True) as temporary:
            temporary.write_text(json.dumps(report.as_dict(), indent=1) + "\n", encoding="utf-8")


def _save_meanwhile(report: ShotReport, path: Path | None) -> None:
    """As :func:`_save`; a failure (a full disk, which may be emptied again) waits for the end to be an error."""
    try:
        _save(report, path)
    except MssplError as error:
        log.warning("%s", error)
