# SPDX-License-Identifier: Apache-2.0
"""A shot on the workers of a Dask cluster: each frame is a task, or a few frames that are averaged with each other.

If a worker dies, Dask gives its task to another one. An EXR gets its name last, so a task that runs again finds a
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
from typing import TYPE_CHECKING, Any

from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.reader import use_threads
from oiio_msspl.jobs.pipeline import run_pipeline
from oiio_msspl.jobs.sequence import Frame
from oiio_msspl.jobs.stages import Stages
from oiio_msspl.model.catalogue import find_model
from oiio_msspl.model.session import Session

if TYPE_CHECKING:
    from dask.distributed import Client, Future


log = logging.getLogger(__name__)

#: How often a frame is tried again after a failure that may pass, such as a file server that did not answer.
RETRIES = 2
#: Frames of a task if frames are averaged with their neighbours. A task fuses the neighbours of its first and last
#: frames once more, so longer ones compute less, and shorter ones keep more workers busy.
CHUNK = 8


def connect(scheduler: str) -> Client:
    """Connect to a Dask cluster.

    Args:
        scheduler: address of its scheduler (``tcp://host:8786``), or a scheduler file.

    Returns:
        A client, which the caller closes.

    Raises:
        InputError: Dask is not installed, or no scheduler answers.
    """
    try:
        from dask.distributed import Client
    except ImportError as error:
        raise InputError("--scheduler needs Dask: pip install 'dask[distributed]'") from error
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # its tracebacks repeat our messages
    if Path(scheduler).is_file():
        try:
            json.loads(Path(scheduler).read_text(encoding="utf-8"))["address"]
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise InputError(f"--scheduler {scheduler}: is no scheduler file of Dask; it has no address") from error
    try:
        return Client(scheduler_file=scheduler) if Path(scheduler).is_file() else Client(scheduler)
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {scheduler}: no Dask scheduler answers there ({error})") from error


def fuse_frames(
    client: Client, stages: Stages, frames: list[Frame]
) -> Iterator[tuple[Frame, dict[str, Any] | Exception | None]]:
    """Fuse frames on the workers.

    Args:
        client: of the cluster, whose workers see the same files.
        stages: settings, which every worker gets.
        frames: what to fuse. Frames end in any order.

    Yields:
        Each frame as soon as it ends, with its report as a dict, the reason for its failure, or None if its EXR
        already existed.

    Raises:
        InputError: there is no such model, or a worker takes several frames at a time.
        MssplError: the scheduler is gone.
    """
    from dask.distributed import CancelledError, KilledWorker, as_completed
    from distributed.comm import CommClosedError

    if not frames:
        return
    workers = _most_workers_on_a_machine(client)
    if stages.model is not None and Path(stages.model).is_file():
        stages = replace(stages, model=str(Path(stages.model).absolute()))
    find_model(2, stages.model)  # refuses an unknown model before any task is submitted
    address = client.scheduler.address
    run = uuid.uuid4().hex
    #: What is under way, and how often a frame of it may still be tried again.
    futures: dict[Future, tuple[list[Frame], int]] = {}
    stages = replace(stages, inputs=stages.inputs.absolute(), temporal=stages.temporal.absolute())

    def submit(chunk: list[Frame], tries: int) -> Future:
        key = f"msspl-fuse-{chunk[0].number}-{tries}-{run}"
        task = [frame.absolute() for frame in chunk]
        future = client.submit(_fuse_chunk, run, stages, task, workers, key=key, retries=RETRIES)
        futures[future] = chunk, tries
        return future

    size = CHUNK if stages.temporal.count else 1
    try:
        ended = as_completed([submit(frames[start : start + size], RETRIES) for start in range(0, len(frames), size)])
        for future in ended:
            chunk, tries = futures.pop(future)
            failure: Exception | None = None
            try:
                outcomes = dict(zip(chunk, future.result(), strict=True))
                failed = [frame for frame, outcome in outcomes.items() if tries and _may_pass(outcome)]
                if failed:
                    ended.add(submit(failed, tries - 1))
                yield from (item for item in outcomes.items() if item[0] not in failed)
            except KilledWorker:
                failure = MssplError("every worker that tried it died; if for lack of memory, lower --max-memory")
            except (CancelledError, CommClosedError) as error:
                raise MssplError(f"{address}: the Dask scheduler is gone; run again with --skip-existing") from error
            except Exception as error:
                failure = error
            if failure is not None:
                # Frames of the chunk that were written before are complete.
                done = [
                    frame.output.exists() and not stages.replaces(frame.lr, frame.hr, frame.output) for frame in chunk
                ]
                yield from ((frame, None if fused else failure) for frame, fused in zip(chunk, done, strict=True))
    finally:
        client.cancel(list(futures))


def _may_pass(outcome: dict[str, Any] | Exception | None) -> bool:
    """Whether a frame has failed for a reason that another try may not meet."""
    return isinstance(outcome, Exception) and not isinstance(outcome, InputError)


def _most_workers_on_a_machine(client: Client) -> int:
    """The largest number of workers that share the cores of one machine.

    Raises:
        InputError: a worker takes several frames at a time.
    """
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


# ---------------------------------------------------------------------------------------------- in a worker


@lru_cache(maxsize=2)
def _sessions(run: str) -> dict[tuple[int, str | None], Session]:
    """The models that this worker has loaded for a run. A later run gets its own: a file may have been replaced."""
    return {}


def _fuse_chunk(run: str, stages: Stages, frames: list[Frame], workers: int) -> list[dict[str, Any] | Exception | None]:
    """Take frames through the three stages, in a worker.

    Args:
        run: identifies the run.
        stages, frames: what to do, with absolute paths.
        workers: those on this machine, which share its cores.

    Returns:
        For each frame its report as a dict, the reason for its failure, or None if the EXR exists.
    """
    from dask.system import CPU_COUNT

    outcomes: dict[int, dict[str, Any] | Exception | None] = {}
    # There was no EXR when the run began (or it may be replaced), so another try or another worker has written it.
    missing = []
    for frame in frames:
        if stages.replaces(frame.lr, frame.hr, frame.output) or not frame.output.exists():
            missing.append(frame)
        else:
            outcomes[frame.number] = None
    threads = stages.threads or (max(1, CPU_COUNT // workers) if workers > 1 else 0)
    # skip_existing lets a frame replace the preview that a dead worker left without its EXR.
    use_threads(threads)
    stages = replace(stages, threads=threads, skip_existing=True, sessions=_sessions(run))
    if missing:
        run_pipeline(stages, missing, lambda frame, outcome: outcomes.update({frame.number: outcome}), lambda: None)
    results: list[dict[str, Any] | Exception | None] = []
    for frame in frames:
        outcome = outcomes[frame.number]
        if isinstance(outcome, InputError):
            # Dask also gives up a worker that it can't reach, so two workers may have fused the same frame.
            replaces = stages.replaces(frame.lr, frame.hr, frame.output)
            outcome = None if not replaces and frame.output.exists() else outcome
        results.append(outcome)
    return results
