# SPDX-License-Identifier: Apache-2.0
"""Fuses a shot on the workers of a Dask cluster. A task is a frame, or a few that are averaged with each other.

If a worker dies, Dask gives its task to another worker. An EXR gets its name last, so a task that runs again finds a
complete frame or none.
"""

from __future__ import annotations

import json
import logging
import uuid
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.reader import use_threads
from oiio_msspl.jobs.existing import ExistingResults
from oiio_msspl.jobs.pipeline import Outcome, run_pipeline
from oiio_msspl.jobs.plan import ShotPlan
from oiio_msspl.jobs.run import ShotRun
from oiio_msspl.jobs.sequence import FrameFiles
from oiio_msspl.jobs.settings import Settings
from oiio_msspl.model.session import Session

if TYPE_CHECKING:
    from dask.distributed import Client, Future


log = logging.getLogger(__name__)

#: How often a frame is tried again after a failure that may pass, such as a file server that did not answer.
RETRIES = 2
#: Frames of a task if frames are averaged with their neighbours. A task fuses the neighbours of its first and last
#: frames once more, so longer tasks compute less, and shorter tasks keep more workers busy.
CHUNK = 8


def connect(scheduler: str) -> Client:
    """Return a client of a Dask cluster, by its scheduler's address (``tcp://host:8786``) or file, which to close."""
    try:
        from dask.distributed import Client
    except ImportError as error:
        raise InputError("--scheduler needs Dask: pip install 'dask[distributed]'") from error
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # its tracebacks repeat our messages
    file = Path(scheduler)
    try:
        return Client(json.loads(file.read_text(encoding="utf-8"))["address"] if file.is_file() else scheduler)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InputError(f"--scheduler {scheduler}: no Dask scheduler answers there ({error})") from error


def fuse_frames(
    client: Client, settings: Settings, plan: ShotPlan, frames: list[FrameFiles]
) -> Iterator[tuple[FrameFiles, Outcome]]:
    """Fuse frames on the workers. All paths are absolute, because workers have other working directories.

    Yields:
        A frame as soon as it ends, in any order, with its outcome: None if its EXR already existed.
    """
    from dask.distributed import CancelledError, KilledWorker, as_completed
    from distributed.comm import CommClosedError

    if not frames:
        return
    workers = _most_workers_on_a_machine(client)
    address = client.scheduler.address
    run = uuid.uuid4().hex
    futures: dict[Future, list[FrameFiles]] = {}
    # skip_existing lets a task that runs again keep its frames, and replace the preview that a dead worker left without
    # its EXR.
    settings = replace(settings, skip_existing=True)
    existing = ExistingResults(settings, plan)
    size = CHUNK if plan.count else 1
    try:
        for start in range(0, len(frames), size):
            chunk = frames[start : start + size]
            key = f"msspl-fuse-{chunk[0].number}-{run}"
            futures[client.submit(_fuse_chunk, run, settings, plan, chunk, workers, key=key, retries=RETRIES)] = chunk
        for future in as_completed(list(futures)):
            chunk = futures.pop(future)
            try:
                yield from zip(chunk, future.result(), strict=True)
                continue
            except KilledWorker:
                text = "every worker that tried it died; if for lack of memory, lower --max-memory"
                failure: Exception = MssplError(text)
            except (CancelledError, CommClosedError) as error:
                raise MssplError(f"{address}: the Dask scheduler is gone; run again with --skip-existing") from error
            except Exception as error:
                failure = error
            # Frames of the chunk that were written before are complete.
            yield from ((frame, None if existing.skips(frame) else failure) for frame in chunk)
    finally:
        client.cancel(list(futures))


def _most_workers_on_a_machine(client: Client) -> int:
    """Return how many workers share a machine at the most. Raise InputError if one takes several frames at a time."""
    if not client.scheduler_info()["workers"]:
        log.warning("%s has no workers yet; waiting for the first", client.scheduler.address)
        client.wait_for_workers(1)
    workers = client.scheduler_info(n_workers=-1)["workers"]
    for address, worker in workers.items():
        if worker["nthreads"] != 1:
            raise InputError(
                f"Dask worker {address} would fuse {worker['nthreads']} frames at a time; start it with --nthreads 1: "
                "the network itself uses several cores"
            )
    return max(Counter(worker["host"] for worker in workers.values()).values())


@lru_cache(maxsize=2)
def _sessions(run: str) -> dict[tuple[int, str | None], Session]:
    """Return the models that this worker has loaded for a run. A later run loads them anew: files may have changed."""
    return {}


def _fuse_chunk(run: str, settings: Settings, plan: ShotPlan, frames: list[FrameFiles], workers: int) -> list[Outcome]:
    """Fuse frames in a worker, and return their outcomes as :func:`fuse_frames` does. ``workers`` share the cores."""
    from dask.system import CPU_COUNT

    threads = settings.threads or (max(1, CPU_COUNT // workers) if workers > 1 else 0)
    use_threads(threads)
    settings = replace(settings, threads=threads, sessions=_sessions(run))
    existing = ExistingResults(settings, plan)
    outcomes: dict[int, Outcome] = {}
    # There was no EXR when the run began (or it may be replaced), so another try or another worker has written it.
    missing = [frame for frame in frames if not existing.skips(frame)]
    for _ in range(1 + RETRIES):
        if missing:
            shot = ShotRun(settings, plan, missing)
            run_pipeline(shot, lambda frame, outcome: outcomes.update({frame.number: outcome}))
        # Another try may not meet the reason again, unless the files are it.
        failed = [frame for frame in missing if isinstance(outcomes[frame.number], Exception)]
        missing = [frame for frame in failed if not isinstance(outcomes[frame.number], InputError)]
    return [outcomes.get(frame.number) for frame in frames]
