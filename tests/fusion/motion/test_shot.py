# SPDX-License-Identifier: Apache-2.0
"""The motion between two frames is read once, in one order, and kept as long as both frames are needed."""

from types import SimpleNamespace

import numpy as np
import pytest

from oiio_msspl.errors import InputError
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.motion.shot import ROUND_TRIP, ROUND_TRIP_OF_FLOW, ShotMotion
from oiio_msspl.fusion.motion.source import FLOW, STATIC, VECTORS, MotionFrame

SIZE = 6, 8


class Source:
    """A source of motion that notes which frames are read."""

    fields = ()

    def __init__(self, kind=VECTORS, vector=(2.0, 0.0), objects=None, zeros_are_right=True, wrong=False):
        self.kind, self.vector, self.objects, self.right, self.wrong = kind, vector, objects, zeros_are_right, wrong
        self.reads = []

    def read(self, frame, neighbour, hop):
        self.reads.append((frame.number, neighbour.number))
        assert neighbour.number - frame.number == hop
        return np.full((*SIZE, 2), self.vector, np.float32) * hop, np.ones(SIZE, bool)

    def moved_objects(self, frame, neighbour, vectors, known):
        return self.objects

    def misleads(self, frame, neighbour, vectors, known):
        return self.wrong

    def zeros_are_right(self, frame, neighbour):
        return self.right


def frame(number):
    return MotionFrame(SimpleNamespace(data_window=Window(0, 0, SIZE[1], SIZE[0])), number=number)


def test_two_frames_are_read_once_and_in_one_order():
    source = Source()
    motion = ShotMotion(source)
    back, forth = motion.between(frame(5), frame(4))
    assert source.reads == [(4, 5), (5, 4)]
    assert (forth.vectors[0, 0] == (2, 0)).all() and (back.vectors[0, 0] == (-2, 0)).all()
    assert forth.known is None and forth.tolerance == ROUND_TRIP
    assert motion.between(frame(4), frame(5)) == (forth, back)
    assert len(source.reads) == 2
    motion.between(frame(5), frame(6))
    motion.forget(4)
    motion.between(frame(5), frame(6))
    assert len(source.reads) == 4
    motion.between(frame(4), frame(5))
    assert len(source.reads) == 6


def test_vectors_of_flow_may_miss_by_more():
    there, _ = ShotMotion(Source(FLOW)).between(frame(1), frame(2))
    assert there.tolerance == ROUND_TRIP_OF_FLOW


def test_a_camera_that_stands_still_is_read_one_way_and_moved_objects_are_not_known():
    objects = np.zeros(SIZE, bool)
    objects[2, 3] = True
    source = Source(STATIC, (0.0, 0.0), objects)
    there, back = ShotMotion(source).between(frame(2), frame(1))
    assert there == back and source.reads == [(1, 2)]
    assert there.vectors is None
    assert (there.known == ~objects).all() and (there.moved_objects == objects).all()


def test_zeros_that_are_wrong_are_refused_each_time():
    source = Source(vector=(0.0, 0.0), zeros_are_right=False)
    motion = ShotMotion(source)
    for _ in range(2):
        with pytest.raises(InputError, match="between frames 1 and 2 are 0, though the picture moves"):
            motion.between(frame(2), frame(1))
    assert len(source.reads) == 2


def test_vectors_that_mislead_are_refused():
    with pytest.raises(InputError, match="between frames 1 and 2 do not lead to the same surfaces"):
        ShotMotion(Source(wrong=True)).between(frame(1), frame(2))


def test_objects_that_vectors_mislead_are_not_known_and_hidden_ones_are_not_objects():
    objects = np.zeros(SIZE, bool)
    objects[2, 3] = objects[4, 6] = True
    source = Source(objects=objects)
    # The vector of the other frame's pixel there leads elsewhere: something is in front.
    source.read = lambda here, there, hop: (
        np.where((np.mgrid[: SIZE[0], : SIZE[1]][1] == 5)[..., None] & (hop < 0), 0, np.float32((2 * hop, 0))),
        np.ones(SIZE, bool),
    )
    there, back = ShotMotion(source).between(frame(1), frame(2))
    misled = np.zeros(SIZE, bool)
    misled[4, 6] = True
    assert (there.moved_objects == misled).all() and (there.known == ~objects).all()
    assert back.known is None and back.moved_objects is None


def test_what_differs_beside_a_border_of_vectors_is_no_object():
    objects = np.zeros((10, 20), bool)
    objects[:, 9] = objects[:, 16] = True

    class Border(Source):
        def read(self, frame, neighbour, hop):
            vectors = np.zeros((*objects.shape, 2), np.float32)
            vectors[:, :8] = 0.3 * hop
            return vectors, np.ones(objects.shape, bool)

    there, _ = ShotMotion(Border(objects=objects.copy())).between(frame(1), frame(2))
    assert there.moved_objects[:, 16].all() and not there.moved_objects[:, :16].any()
    assert (there.known == ~there.moved_objects).all()
