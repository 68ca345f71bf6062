# SPDX-License-Identifier: Apache-2.0
"""NumPy on several cores: an image is worked on in blocks of rows, several at a time.

A block fits into a core's cache, so several in-place steps on it cost little more than one. NumPy releases the
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

#: The most threads that may be asked for.
MOST_THREADS = 1024

_thread_limit: ContextVar[int] = ContextVar("thread_limit", default=0)


@contextlib.contextmanager
def limit_threads(count: int) -> Iterator[None]:
    """Use at most ``count`` threads inside the ``with`` block; 0 means one for each available core.

    Raises:
        InputError: see :func:`check_threads`.
    """
    check_threads(count)
    token = _thread_limit.set(count)
    try:
        yield
    finally:
        _thread_limit.reset(token)


def check_threads(count: int) -> None:
    """Check a number of threads that the caller asks for.

    Raises:
        InputError: it is below 0, or so large that the system could run out of them.
    """
    if not 0 <= count <= MOST_THREADS:
        raise InputError(f"--threads {count}: give a number from 0, which means one a core, to {MOST_THREADS}")


def half_of_the_threads() -> AbstractContextManager[None]:
    """Use half as many threads inside the ``with`` block, for work beside which other work is done."""
    return limit_threads(max((_thread_limit.get() or available_cores()) // 2, 1))


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def for_row_blocks(work: Callable[[slice], object], rows: int, row_size: int, multiple: int = 1) -> None:
    """Call ``work`` with slices that together cover ``rows`` rows, several at a time.

    Args:
        work: takes a slice of rows; what it raises is raised here, when no thread works any more. Inside of it, rows
            are worked on by one thread.
        row_size: values in a row.
        multiple: the height of each slice, except the last, is a multiple of this.
    """
    step = max(BLOCK_VALUES // max(row_size, 1), 1)
    step = -(-step // multiple) * multiple
    slices = [slice(start, min(start + step, rows)) for start in range(0, rows, step)]
    count = min(_thread_limit.get() or available_cores(), len(slices))
    # Each thread gets its slices at once: to hand over a single slice takes a third of the time to compute it.
    shares = [slices[len(slices) * i // count : len(slices) * (i + 1) // count] for i in range(count)]
    others = [_row_pool(count).submit(_run_all, work, share) for share in shares[1:]]
    try:
        _run_all(work, shares[0] if shares else [])
    finally:
        wait(others)
    for other in others:
        other.result()


def in_background(work: Callable[[], T]) -> Callable[[], T]:
    """Start ``work`` on another thread, if more than one may be used.

    Returns:
        A function that waits for the result and returns it: ``work`` itself if only one thread may be used.
    """
    return work if _one_thread() else _start(work).result


def in_parallel(first: Callable[[], T], second: Callable[[], U]) -> tuple[T, U]:
    """The results of two functions that run at the same time. Both have ended when this returns or raises."""
    waiting = in_background(second)
    try:
        result = first()
    except BaseException:
        with contextlib.suppress(Exception):
            waiting()
        raise
    return result, waiting()


def two_at_a_time(work: Callable[[T], U], items: Sequence[T]) -> list[U]:
    """The results of ``work`` for each item, in order. It works on two at a time, with half of the threads each.

    Work that is made of many short steps gains more by this than by threads within each step.
    """
    if _one_thread() or len(items) < 2:
        return [work(item) for item in items]
    results: dict[int, U] = {}
    waiting = iter(range(len(items)))  # next() on it is atomic, so no item is taken twice

    def take() -> None:
        with half_of_the_threads():
            for i in waiting:
                results[i] = work(items[i])

    other = submit(_pair_pool(), take)
    try:
        take()
    finally:
        failed = other.exception()
    if failed is not None:
        raise failed
    return [results[i] for i in range(len(items))]


def one_ahead(items: Iterable[T]) -> Iterator[T]:
    """Yield the items; while the caller uses one, the next one is computed in the background.

    ``items`` never computes two at the same time. Nothing is computed any more when the caller has stopped.
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
    """Let a pool do ``work`` with the thread limit of the caller, which the threads of a pool do not know."""
    return pool.submit(contextvars.copy_context().run, work, *arguments)


def _start(work: Callable[[], T]) -> Future[T]:
    return submit(_background_pool(), work)


def _run_all(work: Callable[[slice], object], slices: list[slice]) -> None:
    # A thread of a pool must not wait for the pool: all of its threads might do so.
    with limit_threads(1):
        for rows in slices:
            work(rows)


def _yield_to_network() -> None:
    """Let this thread work mainly while the network's threads wait for each other.

    The network needs all cores at once: if one of its threads has to share a core, the others wait for it. With a third
    of their weight this thread still keeps pace on a machine that other programs use.
    """
    if sys.platform == "linux":  # elsewhere a thread has no priority of its own
        with contextlib.suppress(OSError):  # a sandbox may forbid it
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 5)


def end_pools() -> None:
    """Let the threads of this module end as soon as they have no more work.

    A program calls this after a signal. An exception that a signal handler raises while a pool starts a thread leaves a
    thread that Python does not know as one of a pool: at exit Python would wait for it forever.
    """
    for key in list(_pools):
        _pools.pop(key).shutdown(wait=False)


#: A pool for each number of threads that share rows, one for work in the background, and one for every second item of
#: :func:`two_at_a_time`.
_pools: dict[int | str, ThreadPoolExecutor] = {}


def _row_pool(count: int) -> ThreadPoolExecutor:
    return _pools.get(count) or _pools.setdefault(count, ThreadPoolExecutor(count, thread_name_prefix="rows"))


def _pair_pool() -> ThreadPoolExecutor:
    return _pools.get("pairs") or _pools.setdefault("pairs", ThreadPoolExecutor(None, "pairs"))


def _background_pool() -> ThreadPoolExecutor:
    name = "background"
    return _pools.get(name) or _pools.setdefault(name, ThreadPoolExecutor(None, name, _yield_to_network))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pools.clear)  # a child process has none of its parent's threads
