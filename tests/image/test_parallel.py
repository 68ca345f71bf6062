# SPDX-License-Identifier: Apache-2.0
import os
import threading
import time

import numpy as np
import pytest

from oiio_msspl.errors import InputError
from oiio_msspl.image import parallel
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.image.parallel import (
    _thread_limit,
    for_row_blocks,
    in_background,
    limit_threads,
    one_ahead,
    two_at_a_time,
)
from oiio_msspl.model.encoding import decode_radiance, encode_radiance
from tests.conftest import picture


@pytest.mark.parametrize("count", [-1, 100_000])
def test_a_number_of_threads_has_bounds(count):
    """So many threads that the system runs out of them would take other programs down."""
    with pytest.raises(InputError, match=rf"--threads {count}: give a number from 0"), limit_threads(count):
        pass


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize(("rows", "multiple"), [(0, 1), (1, 1), (100, 1), (96, 8), (8, 8)])
def test_every_row_is_done_once(monkeypatch, count, rows, multiple):
    monkeypatch.setattr(parallel, "BLOCK_VALUES", 300)
    done = np.zeros(rows, dtype=int)
    parts = []

    def work(part):
        done[part] += 1
        parts.append(part)

    with limit_threads(count):
        for_row_blocks(work, rows, 100, multiple)
    assert (done == 1).all()
    assert all(part.start % multiple == 0 for part in parts)


@pytest.mark.parametrize("count", [1, 3])
def test_no_more_threads_than_allowed(monkeypatch, count):
    monkeypatch.setattr(parallel, "BLOCK_VALUES", 1)
    met = threading.Barrier(count, timeout=10)  # each thread waits until all of them are at work
    seen = set()

    def work(part):
        if threading.get_ident() not in seen:
            seen.add(threading.get_ident())
            met.wait()

    with limit_threads(count):
        for_row_blocks(work, 30, 1)
    assert len(seen) == count


def test_what_a_band_raises_is_raised(monkeypatch):
    monkeypatch.setattr(parallel, "BLOCK_VALUES", 1)

    def work(part):
        if part.start == 9:  # in another thread's share
            raise ValueError("band 9")

    with limit_threads(2), pytest.raises(ValueError, match="band 9"):
        for_row_blocks(work, 10, 1)


def test_nobody_works_any_more_when_a_band_has_raised(monkeypatch):
    monkeypatch.setattr(parallel, "BLOCK_VALUES", 1)
    ended = threading.Event()

    def work(part):
        if part.start == 0:
            raise ValueError("band 0")
        time.sleep(0.05)
        if part.start == 3:
            ended.set()

    with limit_threads(2), pytest.raises(ValueError, match="band 0"):
        for_row_blocks(work, 4, 1)
    assert ended.is_set()


def test_rows_inside_of_rows_are_worked_on_by_one_thread(monkeypatch):
    """Otherwise all threads of the pool could wait for the pool."""
    monkeypatch.setattr(parallel, "BLOCK_VALUES", 1)
    threads = []

    def work(_):
        for_row_blocks(lambda part: threads[-1].add(threading.get_ident()), 8, 1)

    def outer(_):
        threads.append(set())
        work(None)

    with limit_threads(2):
        for_row_blocks(outer, 1, 1)
    assert threads == [{threading.get_ident()}]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_process_has_threads_of_its_own(monkeypatch):
    monkeypatch.setattr(parallel, "BLOCK_VALUES", 1)
    with limit_threads(2):
        for_row_blocks(lambda part: None, 10, 1)
        if (child := os.fork()) == 0:
            for_row_blocks(lambda part: None, 10, 1)
            os._exit(0)
    assert os.waitpid(child, 0)[1] == 0


@pytest.mark.parametrize("planar", [False, True])
def test_bands_change_no_value(monkeypatch, planar):
    """However many threads and parallel, and whichever way a picture lies in memory."""
    image = picture(64, 96)
    if planar:
        image = np.ascontiguousarray(image.transpose(2, 0, 1)).transpose(1, 2, 0)

    def results():
        values = encode_radiance(image, 2.0)
        return values, decode_radiance(values, 2.0), box_downsample(image, 4)

    whole = results()
    monkeypatch.setattr(parallel, "BLOCK_VALUES", 1000)
    with limit_threads(3):
        for one, other in zip(results(), whole, strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("count", [1, 2])
def test_work_begins_aside_if_there_are_threads_for_it(count):
    """With what the caller has set; otherwise when it is asked for."""
    begun = threading.Event()

    def work():
        begun.set()
        return threading.current_thread(), _thread_limit.get()

    with limit_threads(count):
        result = in_background(work)
        assert begun.wait(5 if count > 1 else 0) == (count > 1)
        thread, threads = result()
    assert (thread is threading.current_thread()) == (count == 1)
    assert threads == count


@pytest.mark.parametrize("count", [1, 2, 4])
def test_two_items_at_a_time_share_the_threads(count):
    met = threading.Barrier(min(count, 2), timeout=10)  # each thread waits until both are at work
    limits = set()

    def square(item):
        if item < 2:
            met.wait()
        limits.add(_thread_limit.get())
        return item * item

    with limit_threads(count):
        assert two_at_a_time(square, range(5)) == [0, 1, 4, 9, 16]
        assert two_at_a_time(square, [3]) == [9]
        assert two_at_a_time(square, []) == []
        assert limits == {count, max(count // 2, 1)}


@pytest.mark.parametrize("bad", [0, 1])
def test_what_one_of_two_items_raises_is_raised(bad):
    def work(item):
        if item == bad:
            raise ValueError(f"item {item}")
        return item

    with limit_threads(2), pytest.raises(ValueError, match=f"item {bad}"):
        two_at_a_time(work, [0, 1])


@pytest.mark.parametrize("count", [1, 2])
def test_one_ahead_computes_the_next_item_and_never_two_at_once(count):
    running, started = [], []

    def square(item):
        running.append(item)
        assert len(running) == 1
        started.append(item)
        running.remove(item)
        return item * item

    with limit_threads(count):
        assert list(one_ahead(map(square, range(5)))) == [0, 1, 4, 9, 16]
        assert list(one_ahead(map(square, []))) == []
        results = one_ahead(map(square, iter([7, 8, 9])))
        assert next(results) == 49
    assert 9 not in started[5:]


def test_one_ahead_has_ended_when_its_caller_fails():
    ended = threading.Event()

    def items():
        yield 0
        time.sleep(0.05)
        ended.set()
        yield 1

    def fail():
        for _ in one_ahead(items()):
            raise ValueError("no tile")

    with limit_threads(2), pytest.raises(ValueError, match="no tile"):
        fail()
    assert ended.is_set()


def test_all_cores_are_used_where_a_process_can_not_ask_for_its_own(monkeypatch):
    """As on macOS and Windows."""
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    assert parallel.available_cores() == os.cpu_count()
