# SPDX-License-Identifier: Apache-2.0
import os
import threading

import numpy as np
import pytest

from oiio_msspl import bands, transforms
from tests.conftest import picture


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize(("rows", "multiple"), [(0, 1), (1, 1), (100, 1), (96, 8), (8, 8)])
def test_every_row_is_done_once(monkeypatch, count, rows, multiple):
    monkeypatch.setattr(bands, "BAND", 300)
    done = np.zeros(rows, dtype=int)
    parts = []

    def work(part):
        done[part] += 1
        parts.append(part)

    with bands.threads(count):
        bands.each(work, rows, 100, multiple)
    assert (done == 1).all()
    assert all(part.start % multiple == 0 for part in parts)


@pytest.mark.parametrize("count", [1, 3])
def test_no_more_threads_than_allowed(monkeypatch, count):
    monkeypatch.setattr(bands, "BAND", 1)
    met = threading.Barrier(count, timeout=10)  # each thread waits until all of them are at work
    seen = set()

    def work(part):
        if threading.get_ident() not in seen:
            seen.add(threading.get_ident())
            met.wait()

    with bands.threads(count):
        bands.each(work, 30, 1)
    assert len(seen) == count


def test_what_a_band_raises_is_raised(monkeypatch):
    monkeypatch.setattr(bands, "BAND", 1)

    def work(part):
        if part.start == 9:  # in another thread's share
            raise ValueError("band 9")

    with bands.threads(2), pytest.raises(ValueError, match="band 9"):
        bands.each(work, 10, 1)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_process_has_threads_of_its_own(monkeypatch):
    monkeypatch.setattr(bands, "BAND", 1)
    with bands.threads(2):
        bands.each(lambda part: None, 10, 1)
        if (child := os.fork()) == 0:
            bands.each(lambda part: None, 10, 1)
            os._exit(0)
    assert os.waitpid(child, 0)[1] == 0


@pytest.mark.parametrize("planar", [False, True])
def test_bands_change_no_value(monkeypatch, planar):
    """However many threads and bands, and whichever way a picture lies in memory."""
    image = picture(64, 96)
    if planar:
        image = np.ascontiguousarray(image.transpose(2, 0, 1)).transpose(1, 2, 0)

    def results():
        values = transforms.compress(image, 2.0)
        return values, transforms.expand(values, 2.0), transforms.box_downsample(image, 4)

    whole = results()
    monkeypatch.setattr(bands, "BAND", 1000)
    with bands.threads(3):
        for one, other in zip(results(), whole, strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("count", [1, 2])
def test_work_begins_aside_if_there_are_threads_for_it(count):
    """With what the caller has set; otherwise when it is asked for."""
    begun = threading.Event()

    def work():
        begun.set()
        return threading.current_thread(), bands._threads.get()

    with bands.threads(count):
        result = bands.aside(work)
        assert begun.wait(5 if count > 1 else 0) == (count > 1)
        thread, threads = result()
    assert (thread is threading.current_thread()) == (count == 1)
    assert threads == count
