# SPDX-License-Identifier: Apache-2.0
"""Frames through the three stages in this process: one is read and one written while another is fused.

The calling thread fuses. A second thread reads the next frame, and a third writes the previous one. Each stage holds
at most one frame, and a frame that is fused waits at most for a few neighbours, so memory does not grow with the shot.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from oiio_msspl.errors import InputError
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.image.parallel import limit_threads, submit
from oiio_msspl.jobs.frame_window import FusedAlone, Neighbours
from oiio_msspl.jobs.report import FrameReport
from oiio_msspl.jobs.sequence import Frame
from oiio_msspl.jobs.stages import LoadedFrame, Stages
from oiio_msspl.jobs.view_windows import ViewWindows


def run_pipeline(
    stages: Stages,
    frames: list[Frame],
    record: Callable[[Frame, dict[str, Any] | Exception | None], None],
    save: Callable[[], None],
) -> None:
    """Take frames through the stages. However this ends, the frame that is being written is finished and recorded.

    Args:
        stages: the stages and their settings.
        frames: what to fuse, in this order.
        record: called in the order of the frames, with a frame and its report as a dict, the reason for its failure,
            or None if another run has fused it in the meantime.
        save: called after each frame, when the frames before it are recorded.

    Raises:
        InputError: the model can't be loaded, which no other frame would change.
    """
    writing: tuple[Frame, FrameReport, Future[None]] | None = None

    def record_failure(frame: Frame, error: Exception) -> None:
        # If another run has written the EXR in the meantime, the frame is complete, whatever failed here.
        record(frame, None if stages.skips(frame) else error)

    def finish_writing() -> None:
        """Wait until the frame that is being written is on the disk, and record it."""
        nonlocal writing
        if writing is None:
            return
        frame, report, written = writing
        error = written.exception()
        if error is None:
            record(frame, report.as_dict())
        elif isinstance(error, Exception):
            record_failure(frame, error)
        else:
            raise error
        # Reset last: a signal may interrupt the lines above, and the frame is then recorded on the way out.
        writing = None

    def fuse(loaded: LoadedFrame, neighbours: Neighbours) -> FusedAlone | Exception:
        session = stages.session(loaded)
        try:
            return loaded.stages.fuse(loaded, session, neighbours)
        except Exception as error:
            return error

    def finish(frame: Frame, outcome: FusedAlone | Exception) -> None:
        """Complete a frame that is fused, and hand it over to the writer; or record why it could not be."""
        nonlocal writing
        error = outcome if isinstance(outcome, Exception) else None
        if error is None and stages.temporal.count and stages.skips(frame):
            error = InputError("another run has fused it")
        if isinstance(outcome, FusedAlone) and error is None:
            try:
                fused = window.accumulate(frame.number)
                report = outcome.loaded.stages.complete(outcome, fused, window.others(frame.number))
            except Exception as caught:
                error = caught
        # The previous frame is written before this one is handed over, so one is written at a time.
        finish_writing()
        if error is not None:
            record_failure(frame, error)
            return
        # `writing` is set before the hand-over: a signal may arrive during the hand-over.
        written: Future[None] = Future()
        writing = frame, report, written
        submit(writer, _write, stages, report, fused, written)

    window = ViewWindows(stages.temporal, frames, fuse)
    order = window.order()
    with (
        limit_threads(stages.threads),
        ThreadPoolExecutor(1, "read") as reader,
        ThreadPoolExecutor(1, "write") as writer,
    ):
        reads = [submit(reader, stages.read_views, frame) for frame in order[:1]]
        try:
            for index, frame in enumerate(order):
                reading = reads.pop()
                reads += [submit(reader, stages.read_views, following) for following in order[index + 1 : index + 2]]
                problem = reading.exception()
                if problem is None and not stages.temporal.count and stages.skips(frame):
                    problem = InputError("another run has fused it")  # is recorded as skipped
                if not isinstance(problem, Exception | None):
                    raise problem
                for ready, result in window.add(frame.number, problem or reading.result()):
                    finish(ready, result)
                    save()
                window.release()
                del reading  # frees the frame's pixels before those of the next frame arrive
        finally:
            for reading in reads:
                reading.cancel()
            writer.shutdown()
            if writing is not None and writing[2].done():  # not done means that it was never handed over
                finish_writing()


def _write(stages: Stages, report: FrameReport, fused: FusedFrame, written: Future[None]) -> None:
    """Write a frame and settle ``written``."""
    try:
        stages.write(report, fused)
    except BaseException as error:
        written.set_exception(error)
    else:
        written.set_result(None)
