# SPDX-License-Identifier: Apache-2.0
"""NumPy on several cores: an image's bands of rows side by side.

A band is small enough for a core's cache, so that several steps in place cost little more than one; and NumPy lets go
of the interpreter while it computes. What is done to a frame beside the network would else take one core as long as
the network takes all.
"""

from __future__ import annotations

import contextlib
import contextvars
import functools
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from typing import TypeVar

#: Values of a band: 512 KiB of float32.
BAND = 1 << 17

T = TypeVar("T")

_threads: ContextVar[int] = ContextVar("threads", default=0)


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """Use so many threads within; 0: one for each core that the process may use."""
    token = _threads.set(count)
    try:
        yield
    finally:
        _threads.reset(token)


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def each(work: Callable[[slice], object], rows: int, row_size: int, multiple: int = 1) -> None:
    """Call ``work`` with slices that together are ``rows`` rows, several at a time.

    Args:
        work: of a slice; what it raises is raised here.
        row_size: values of a row.
        multiple: every slice but the last has a multiple of so many rows.
    """
    step = max(BAND // max(row_size, 1), 1)
    step = -(-step // multiple) * multiple
    slices = [slice(start, min(start + step, rows)) for start in range(0, rows, step)]
    count = min(_threads.get() or cores(), len(slices))
    # Not band by band: handing one over takes a third as long as computing it
    shares = [slices[len(slices) * i // count : len(slices) * (i + 1) // count] for i in range(count)]
    others = [_pool(count).submit(_all_of, work, share) for share in shares[1:]]
    _all_of(work, shares[0] if shares else [])
    for other in others:
        other.result()


def aside(work: Callable[[], T]) -> Callable[[], T]:
    """Begin some work on a thread of its own, if several may be used; what is returned waits for its result."""
    if (_threads.get() or cores()) == 1:
        return work
    return _beside().submit(contextvars.copy_context().run, work).result


def _all_of(work: Callable[[slice], object], slices: list[slice]) -> None:
    for part in slices:
        work(part)


@functools.cache
def _beside() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(thread_name_prefix="aside")


@functools.cache  # never so many that it matters: a process has one number of threads, or two
def _pool(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="bands")


if hasattr(os, "register_at_fork"):
    for pool in (_pool, _beside):
        os.register_at_fork(after_in_child=pool.cache_clear)  # a child has none of its parent's threads
