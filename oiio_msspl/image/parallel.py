# SPDX-License-Identifier: Apache-2.0
"""Runs NumPy on several cores: an image is cut into blocks of rows, and threads work on several of them at a time.

A block fits into a core's cache, so several in-place operations on it cost little more than one. NumPy releases the
interpreter lock while it computes, so threads are enough.
"""

from __future__ import annotations

import contextlib
import contextvars
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager
from contextvars import ContextVar
from functools import partial
from typing import Any, TypeVar, cast

from oiio_msspl.errors import InputError

#: Values of a block: 512 KiB of float32.
BLOCK_VALUES = 1 << 17

T = TypeVar("T")
U = TypeVar("U")

#: Largest number of threads that the caller may ask for.
MOST_THREADS = 1024

_thread_limit: ContextVar[int] = ContextVar("thread_limit", default=0)


@contextlib.contextmanager
def limit_threads(count: int) -> Iterator[None]:
    """Use at most ``count`` threads inside of the ``with`` block; 0 means one for each available core."""
    check_threads(count)
    token = _thread_limit.set(count)
    try:
        yield
    finally:
        _thread_limit.reset(token)


def check_threads(count: int) -> None:
    """Raise InputError if a number of threads is below 0, or so large that the system could run out of threads."""
    if not 0 <= count <= MOST_THREADS:
        raise InputError(f"--threads {count}: give a number from 0, which means one a core, to {MOST_THREADS}")


def half_of_the_threads() -> AbstractContextManager[None]:
    """Use half as many threads inside of the ``with`` block, because other work runs at the same time."""
    return limit_threads(max((_thread_limit.get() or available_cores()) // 2, 1))


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def for_row_blocks(work: Callable[[slice], object], rows: int, row_size: int, multiple: int = 1) -> None:
    """Call ``work`` with slices that together cover ``rows`` rows, several at a time.

    Args:
        work: takes a slice of rows and uses one thread. Its exception is raised here, when all threads have ended.
        row_size: values in a row.
        multiple: the height of each slice, except the last, is a multiple of this.
    """
    height = max(BLOCK_VALUES // max(row_size, 1), 1)
    height = -(-height // multiple) * multiple
    slices = [slice(start, min(start + height, rows)) for start in range(0, rows, height)]
    count = min(_thread_limit.get() or available_cores(), len(slices))
    # Each thread gets its slices at once: handing over a single slice takes a third of the time to compute it.
    parts = [slices[len(slices) * i // count : len(slices) * (i + 1) // count] for i in range(count)]
    pending = [_pool(f"rows {count}", count).submit(_run_all, work, part) for part in parts[1:]]
    try:
        _run_all(work, parts[0] if parts else [])
    finally:
        wait(pending)
    for future in pending:
        future.result()


def in_background(work: Callable[[], T]) -> Callable[[], T]:
    """Start ``work`` on another thread, and return a function that waits for its result.

    If only one thread may be used, that function is ``work`` itself, not started.
    """
    return work if _one_thread() else _start(work).result


def in_parallel(first: Callable[[], T], second: Callable[[], U]) -> tuple[T, U]:
    """Run two functions at the same time and return their results. Both have ended when this returns or raises."""
    waiting = in_background(second)
    try:
        result = first()
    except BaseException:
        with contextlib.suppress(Exception):
            waiting()
        raise
    return result, waiting()


def two_at_a_time(work: Callable[[T], U], items: Sequence[T]) -> list[U]:
    """Return the results of ``work`` for each item, in order. Two items run at a time, with half of the threads each.

    Work that consists of many short operations gains more by this than by threads inside of each operation.
    """
    if _one_thread() or len(items) < 2:
        return [work(item) for item in items]
    results: dict[int, U] = {}
    waiting = iter(range(len(items)))  # next() on it is atomic, so no item is taken twice

    def take() -> None:
        with half_of_the_threads():
            for i in waiting:
                results[i] = work(items[i])

    in_parallel(take, take)
    return [results[i] for i in range(len(items))]


def one_ahead(items: Iterable[T]) -> Iterator[T]:
    """Yield the items. While the caller uses one, the next one is computed in the background.

    ``items`` never computes two at the same time. Nothing is computed after the caller has stopped.
    """
    if _one_thread():
        yield from items
        return
    remaining = iter(items)
    end = object()
    pending = _start(partial(next, remaining, end))
    try:
        while (item := pending.result()) is not end:
            pending = _start(partial(next, remaining, end))
            yield cast(T, item)
    finally:
        wait([pending])


def _one_thread() -> bool:
    return (_thread_limit.get() or available_cores()) == 1


def submit(pool: Executor, work: Callable[..., T], *arguments: Any) -> Future[T]:
    """Submit ``work`` to a pool, with the thread limit of the caller, which the threads of a pool do not know."""
    return pool.submit(contextvars.copy_context().run, work, *arguments)


def _start(work: Callable[[], T]) -> Future[T]:
    return submit(_pool("background", start=_yield_to_network), work)


def _run_all(work: Callable[[slice], object], slices: list[slice]) -> None:
    # A thread of a pool must not wait for the pool: all of its threads might do so.
    with limit_threads(1):
        for rows in slices:
            work(rows)


def _yield_to_network() -> None:
    """Lower the priority of this thread, so that it runs mainly while the network's threads wait for each other.

    The network needs all cores at once: if one of its threads waits for a core, the others wait for it. With a third of
    their weight, this thread still keeps pace on a machine that other programs use.
    """
    if sys.platform == "linux":  # elsewhere a thread has no priority of its own
        with contextlib.suppress(OSError):  # a sandbox may forbid it
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 5)


def end_pools() -> None:
    """End the threads of this module as soon as they have no more work.

    A program calls this after a signal. If a signal handler raises an exception while a pool starts a thread, Python
    does not know that the thread belongs to a pool, and would wait for it forever at exit.
    """
    for key in list(_pools):
        _pools.pop(key).shutdown(wait=False)


#: Pools by name: for rows, one for each number of threads; and for work in the background.
_pools: dict[str, ThreadPoolExecutor] = {}


def _pool(name: str, threads: int | None = None, start: Callable[[], object] | None = None) -> ThreadPoolExecutor:
    return _pools.get(name) or _pools.setdefault(name, ThreadPoolExecutor(threads, name, start))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pools.clear)  # a child process has none of its parent's threads
