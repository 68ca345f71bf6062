# SPDX-License-Identifier: Apache-2.0
"""Who needs whom in a shot: numbers alone, without files and pixels."""

from __future__ import annotations

import itertools
import random

import pytest

from oiio_msspl.jobs.timeline import ALONE, Reach, Timeline, neighbours

#: A shot in which frame 1005 is missing.
GAP = (1001, 1002, 1003, 1004, 1006, 1007)


def run_through(timeline: Timeline, order: list[int] | None = None) -> list[tuple[int, list[int]]]:
    """Return which frames are settled after each frame that is read and fused."""
    steps = []
    for number in timeline.order if order is None else order:
        for key in timeline.fusable(number):
            timeline.fused(key)
        steps.append((number, list(timeline.settled())))
    return steps


@pytest.mark.parametrize(
    ("number", "count", "expected"),
    [
        (1003, 0, []),
        (1003, 1, [1002, 1004]),
        (1003, 2, [1001, 1002, 1004]),  # nothing behind the gap
        (1006, 3, [1007]),
        (1001, 9, [1002, 1003, 1004]),
        (1005, 1, [1004, 1006]),
    ],
)
def test_neighbours_end_at_a_gap(number, count, expected):
    assert neighbours(number, count, GAP) == expected


def test_each_frame_is_read_and_settled_in_order_up_to_both_sides_of_a_gap():
    timeline = Timeline(GAP, GAP, {None: Reach(1, 1)})
    assert timeline.order == list(GAP)
    assert run_through(timeline) == [
        (1001, []),
        (1002, []),
        (1003, [1001]),  # 1002 is fused with 1001 and 1003, then averaged with 1001
        (1004, [1002, 1003, 1004]),  # no frame beyond the gap is waited for
        (1006, []),
        (1007, [1006, 1007]),
    ]


def test_a_frame_is_fusable_when_the_last_of_its_renders_has_arrived():
    timeline = Timeline(range(5), range(5), {None: Reach(renders=1, results=0)})
    fusable = []
    for number in timeline.order:
        keys = list(timeline.fusable(number))
        fusable.append(keys)
        for key in keys:
            timeline.fused(key)
    assert fusable == [[], [(0, None)], [(1, None)], [(2, None)], [(3, None), (4, None)]]


def test_a_frame_that_is_not_fused_stays_fusable():
    timeline = Timeline([1, 2], [1, 2], {None: ALONE})
    assert list(timeline.fusable(1)) == [(1, None)]
    assert list(timeline.fusable(2)) == [(1, None), (2, None)]


def test_each_side_is_told_from_near_to_far():
    timeline = Timeline(range(1, 10), [5], {None: Reach(2, 3)})
    assert timeline.sides((5, None), "renders") == ([4, 3], [6, 7])
    assert timeline.sides((5, None), "results") == ([4, 3, 2], [6, 7, 8])
    assert timeline.sides((1, None), "renders") == ([], [2, 3])


def test_the_view_with_the_most_neighbours_decides_when_a_frame_is_read_and_settled():
    reach = {None: ALONE, "left": Reach(1, 0), "right": Reach(1, 1)}
    timeline = Timeline(range(6), [2], reach)
    assert timeline.order == [0, 1, 2, 3, 4]
    assert timeline.needs_renders() == {
        (2, None),
        *((number, "left") for number in (1, 2, 3)),
        *((number, "right") for number in (0, 1, 2, 3, 4)),
    }
    assert timeline.needs_pictures() == {(2, None), (2, "left"), (1, "right"), (2, "right"), (3, "right")}
    fused = []
    for number in timeline.order:
        for key in timeline.fusable(number):
            fused.append((number, key))
            timeline.fused(key)
        assert list(timeline.settled()) == ([2] if number == 4 else [])
    assert fused == [(2, (1, "right")), (2, (2, None)), (3, (2, "left")), (3, (2, "right")), (4, (3, "right"))]


def test_without_neighbours_the_order_is_the_one_asked_for():
    timeline = Timeline(range(10), [7, 3, 5], {None: ALONE, "right": ALONE})
    assert timeline.order == [7, 3, 5]
    assert run_through(timeline) == [(7, [7]), (3, [3]), (5, [5])]


def test_with_neighbours_frames_are_settled_in_the_order_asked_for_if_several_can_be():
    timeline = Timeline(range(10), [7, 3, 5], {None: Reach(1, 0)})
    assert timeline.order == [2, 3, 4, 5, 6, 7, 8]
    assert run_through(timeline) == [(2, []), (3, []), (4, [3]), (5, []), (6, [5]), (7, []), (8, [7])]
    timeline = Timeline(range(10), [7, 3, 5], {None: Reach(1, 0)})
    assert run_through(timeline, [8, 6, 4, 2, 7, 5, 3])[-1] == (3, [3])


def test_a_frame_waits_until_it_is_settled():
    timeline = Timeline([1, 2], [1], {None: Reach(0, 1)})
    assert timeline.waits(1) and not timeline.waits(2)  # 2 is a neighbour only
    run_through(timeline)
    assert not timeline.waits(1)


def test_a_chunk_reads_and_fuses_the_neighbours_that_it_depends_on():
    shot = range(20)
    chunk = Timeline(shot, [8, 9, 10], {None: Reach(2, 1)})
    assert chunk.order == list(range(5, 14))
    assert {number for number, _ in chunk.needs_pictures()} == set(range(7, 12))
    assert {number for number, _ in chunk.needs_renders()} == set(range(5, 14))
    assert [number for _, settled in run_through(chunk) for number in settled] == [8, 9, 10]


def test_a_chunk_averages_the_frames_that_the_whole_shot_averages():
    """So that a shot cut into chunks has the pixels of one run."""
    shot, reach = [1, 2, 3, 4, 6, 7, 8, 9], {None: Reach(2, 1)}
    whole = Timeline(shot, shot, reach)
    for chunk in (shot[:3], shot[3:6], shot[6:]):
        part = Timeline(shot, chunk, reach)
        for number in chunk:
            for kind in ("renders", "results"):
                assert part.sides((number, None), kind) == whole.sides((number, None), kind)


def test_at_the_end_nothing_is_needed():
    timeline = Timeline(range(8), range(8), {None: Reach(1, 1), "right": Reach(2, 0)})
    sizes = []
    for number in timeline.order:
        for key in timeline.fusable(number):
            timeline.fused(key)
        list(timeline.settled())
        sizes.append((len(timeline.needs_renders()), len(timeline.needs_pictures())))
    for before, after in itertools.pairwise(sizes):
        assert after[0] <= before[0] and after[1] <= before[1]
    assert sizes[-1] == (0, 0)


@pytest.mark.parametrize("seed", range(200))
def test_random_shots_settle_each_wanted_frame_once_and_never_lack_what_they_need(seed):
    """Only renders and pictures that are said to be needed are kept, in shots with gaps, views and any order."""
    chance = random.Random(seed)
    shot = sorted(chance.sample(range(25), chance.randint(1, 20)))
    wanted = chance.sample(shot, chance.randint(1, len(shot)))
    views = [None, "left", "right"][: chance.randint(1, 3)]
    reach = {view: Reach(chance.randint(0, 3), chance.randint(0, 2)) for view in views}
    timeline = Timeline(shot, wanted, reach)
    assert set(wanted) <= set(timeline.order) <= set(shot)
    assert len(set(timeline.order)) == len(timeline.order)
    order = timeline.order if seed % 2 else chance.sample(timeline.order, len(timeline.order))
    renders, pictures, settled, fused = set(), set(), [], set()
    for number in order:
        renders |= {(number, view) for view in views} & timeline.needs_renders()
        for key in timeline.fusable(number):
            assert renders >= {(n, key[1]) for n in (key[0], *itertools.chain(*timeline.sides(key, "renders")))}
            assert key not in fused
            fused.add(key)
            pictures |= {key} & timeline.needs_pictures()
            timeline.fused(key)
        for frame in timeline.settled():
            for view in views:
                around = itertools.chain(*timeline.sides((frame, view), "results"))
                assert pictures >= {(n, view) for n in (frame, *around)}
            assert not timeline.waits(frame)
            settled.append(frame)
            pictures &= timeline.needs_pictures()
        renders &= timeline.needs_renders()
    assert sorted(settled) == sorted(wanted) and len(set(settled)) == len(settled)
    assert not timeline.needs_renders() and not timeline.needs_pictures()
