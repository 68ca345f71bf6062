# SPDX-License-Identifier: Apache-2.0
"""Frames on the workers of a Dask cluster: Dask gives them out, and gives those of a worker that died to another.

A task is a frame. An EXR gets its name last, so a task that is run again finds a whole frame or none.
"""

from __future__ import annotations

import logging
import uuid
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.jobs.sequence import Frame
from oiio_msspl.jobs.shot import Stages
from oiio_msspl.model.catalogue import AUTO, WITHOUT_OIDN, find_model
from oiio_msspl.model.session import Session

if TYPE_CHECKING:
    from dask.distributed import Client


log = logging.getLogger(__name__)

#: How often a frame is tried again after a failure that is not the caller's, such as a file server that did not answer.
RETRIES = 2


def connect(scheduler: str) -> Client:
    """A client, to be closed, of the cluster whose scheduler has this address (``tcp://host:8786``) or scheduler file.

    Raises:
        InputError: Dask is not installed, or no scheduler answers.
    """
    try:
        from dask.distributed import Client
    except ImportError as error:
        raise InputError("--scheduler needs Dask: pip install 'oiio-msspl[farm]'") from error
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # tracebacks of what is said in a sentence here
    try:
        return Client(scheduler_file=scheduler) if Path(scheduler).is_file() else Client(scheduler)
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {scheduler}: no Dask scheduler answers there ({error})") from error


def fuse_frames(
    client: Client, stages: Stages, frames: list[Frame]
) -> Iterator[tuple[Frame, dict[str, Any] | Exception | None]]:
    """Fuse frames on the workers.

    Yields:
        A frame as soon as it ends, with its report as a dict, or why it failed, or None where its EXR was there.

    Raises:
        InputError: there is no such model, or a worker takes several frames at a time.
        MssplError: the scheduler is gone.
    """
    from dask.distributed import CancelledError, KilledWorker, as_completed
    from distributed.comm import CommClosedError

    neighbours = _most_on_a_machine(client)
    if stages.model in (None, AUTO):
        stages = replace(stages, model=WITHOUT_OIDN)  # the same for all frames and machines, whatever is installed
    elif Path(stages.model).is_file():
        stages = replace(stages, model=str(Path(stages.model).absolute()))
    find_model(2, stages.model)  # if there is no such model, it is said here
    address = client.scheduler.address
    run = uuid.uuid4().hex
    futures = {}
    for frame in frames:
        key = f"msspl-fuse-{frame.number}-{run}"
        future = client.submit(_fuse, run, stages, _absolute(frame), neighbours, key=key, retries=RETRIES)
        futures[future] = frame
    try:
        for future in as_completed(list(futures)):
            frame = futures.pop(future)
            try:
                yield frame, future.result()
            except KilledWorker:
                yield frame, MssplError("every worker that tried it died; if for lack of memory, lower --max-memory")
            except (CancelledError, CommClosedError) as error:
                raise MssplError(f"{address}: the Dask scheduler is gone; run again with --skip-existing") from error
            except Exception as error:
                yield frame, error
    finally:
        client.cancel(list(futures))


def _most_on_a_machine(client: Client) -> int:
    """How many workers share the cores of one machine."""
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


def _absolute(frame: Frame) -> Frame:
    """Workers have other working directories."""
    assert frame.lr is not None and frame.hr is not None
    return replace(frame, lr=frame.lr.absolute(), hr=frame.hr.absolute(), output=frame.output.absolute())


# ---------------------------------------------------------------------------------------------- in a worker


@lru_cache(maxsize=2)
def _sessions(run: str) -> dict[Path, Session]:
    """Models that this process has loaded for a run. A later run may mean another file by the same name."""
    return {}


def _fuse(run: str, stages: Stages, frame: Frame, neighbours: int) -> dict[str, Any] | Exception | None:
    """Take a frame through all stages. A failure that another try could mend is raised, others are returned."""
    from dask.system import CPU_COUNT

    # When the run began there was no such EXR, or --overwrite was given.
    if not stages.overwrite and frame.output.exists():
        return None
    threads = stages.threads or (max(1, CPU_COUNT // neighbours) if neighbours > 1 else 0)
    # A preview without its EXR is what a worker left that died between the two.
    stages = replace(stages, threads=threads, skip_existing=True, sessions=_sessions(run))
    try:
        ready = stages.read(frame)
        report, fused = stages.fuse(ready, stages.session(ready))
        stages.write(report, fused)
    except InputError as error:
        # Dask also takes a worker for dead that it can't reach: another one may have been faster.
        return None if not stages.overwrite and frame.output.exists() else error
    return report.as_dict()
