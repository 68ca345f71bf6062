# SPDX-License-Identifier: Apache-2.0
"""Takes the frames of a shot through this process: one is read and one is written while another is fused.

The calling thread fuses, a second one reads, and a third one writes. Each holds at most one frame, and a fused frame
waits for a few neighbours at most. So memory does not grow with the length of the shot.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from types import TracebackType
from typing import Any

from oiio_msspl.image.parallel import limit_threads, submit
from oiio_msspl.jobs.existing import ExistingResults
from oiio_msspl.jobs.frame import ShotFrame
from oiio_msspl.jobs.report import FrameReport
from oiio_msspl.jobs.run import ShotRun
from oiio_msspl.jobs.sequence import FrameFiles
from oiio_msspl.jobs.write import write_settled

#: What became of a frame: its report as a dict, the reason for its failure, or None if another run has fused it.
Outcome = dict[str, Any] | Exception | None
Record = Callable[[FrameFiles, Outcome], None]


def run_pipeline(run: ShotRun, record: Record, save: Callable[[], None] = lambda: None) -> None:
    """Fuse and write the frames of a shot.

    Args:
        record: called with each frame and its outcome, in the order of the frames.
        save: called after each frame, when the frames before it are recorded.

    Raises:
        InputError: the model can't be loaded, which no other frame would change.
    """
    with (
        limit_threads(run.settings.threads),
        closing(read_ahead(run)) as source,
        Writer(run.existing, record, save) as writer,
    ):
        for views in source:
            for frame in run.take(views):
                writer.write(frame)
                del frame  # or its pixels would be held while the next one is fused


def read_ahead(run: ShotRun) -> Generator[list[ShotFrame]]:
    """Yield the frames of a shot. Each is read while the caller works on the one before it."""
    coming: Future[list[ShotFrame]] | None = None
    with ThreadPoolExecutor(1, "read") as reader:
        for files in [*run.order, None]:
            read, coming = coming, None if files is None else submit(reader, run.read, files)
            if read is not None:
                yield read.result()


class Writer:
    """Writes frames in a thread, one at a time, and records what became of each.

    On leaving its ``with`` block, however that comes, the frame that is being written is finished and recorded.
    """

    def __init__(self, existing: ExistingResults, record: Record, save: Callable[[], None]) -> None:
        self._existing, self._record, self._save = existing, record, save
        self._pool = ThreadPoolExecutor(1, "write")
        #: What is being written. The frame itself belongs to the thread, so that its pixels are freed as it ends.
        self._writing: tuple[FrameFiles, FrameReport, Future[None]] | None = None

    def __enter__(self) -> Writer:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, where: TracebackType | None) -> None:
        self._pool.shutdown()
        if self._writing is not None and self._writing[2].done():  # not done means that it was never handed over
            self._finish()

    def write(self, frame: ShotFrame) -> None:
        """Hand over a frame that is settled, or that has failed."""
        # The previous frame is written before this one is handed over, so one is written at a time.
        self._finish()
        if frame.error is not None:
            self._record_failure(frame.files, frame.error)
        else:
            # `_writing` is set before the hand-over: a signal may arrive during the hand-over.
            written: Future[None] = Future()
            self._writing = frame.files, frame.report, written
            submit(self._pool, self._write, frame, written)
        self._save()

    def _write(self, frame: ShotFrame, written: Future[None]) -> None:
        try:
            write_settled(frame, self._existing)
        except BaseException as error:
            written.set_exception(error)
        else:
            written.set_result(None)

    def _finish(self) -> None:
        """Wait until the frame that is being written is on the disk, and record it."""
        if self._writing is None:
            return
        files, report, written = self._writing
        error = written.exception()
        if error is None:
            self._record(files, report.as_dict())
        elif isinstance(error, Exception):
            self._record_failure(files, error)
        else:
            raise error
        # Reset last: a signal may interrupt the lines above, and the frame is then recorded on the way out.
        self._writing = None

    def _record_failure(self, files: FrameFiles, error: Exception) -> None:
        # If another run has written the EXR in the meantime, the frame is complete, whatever failed here.
        self._record(files, None if self._existing.skips(files) else error)
