# SPDX-License-Identifier: Apache-2.0
"""Takes the frames of a shot through this process: one is read and one is written while another is fused.

The calling thread fuses, a second one reads, and a third one writes. Each holds at most one frame, and a fused frame
waits for a few neighbours at most. So memory does not grow with the length of the shot.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from typing import Any

from oiio_msspl.image.parallel import limit_threads, submit
from oiio_msspl.jobs.frame import ShotFrame
from oiio_msspl.jobs.run import ShotRun
from oiio_msspl.jobs.sequence import FrameFiles
from oiio_msspl.jobs.write import write_settled

#: What became of a frame: its report as a dict, the reason for its failure, or None if another run has fused it.
Outcome = dict[str, Any] | Exception | None


def run_pipeline(run: ShotRun, record: Callable[[FrameFiles, Outcome], None]) -> None:
    """Fuse and write the frames of a shot.

    However it ends, the frame that was handed over to be written is finished and recorded before.

    Args:
        record: called with each frame and its outcome, in the order of the frames, on the thread that writes.

    Raises:
        InputError: the model can't be loaded, which no other frame would change.
    """

    def write(frame: ShotFrame) -> None:
        outcome: Outcome = frame.error
        try:
            if outcome is None:
                write_settled(frame, run.existing)
                outcome = frame.report.as_dict()
        except Exception as error:
            outcome = error
        # If another run has written the EXR in the meantime, the frame is complete, whatever failed here.
        is_there = isinstance(outcome, Exception) and run.existing.skips(frame.files)
        record(frame.files, None if is_there else outcome)

    written: Future[None] | None = None
    with (
        limit_threads(run.settings.threads),
        closing(read_ahead(run)) as source,
        ThreadPoolExecutor(1, "write") as writer,
    ):
        for views in source:
            for frame in run.take(views):
                if written is not None:
                    written.result()  # or several fused frames would wait in memory
                written = submit(writer, write, frame)
                del frame  # or its pixels would be held while the next one is fused
        if written is not None:
            written.result()


def read_ahead(run: ShotRun) -> Generator[list[ShotFrame]]:
    """Yield the frames of a shot. Each is read while the caller works on the one before it."""
    coming: Future[list[ShotFrame]] | None = None
    with ThreadPoolExecutor(1, "read") as reader:
        for files in [*run.order, None]:
            read, coming = coming, None if files is None else submit(reader, run.read, files)
            if read is not None:
                yield read.result()
