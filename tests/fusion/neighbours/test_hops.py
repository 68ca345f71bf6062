# SPDX-License-Identifier: Apache-2.0
"""Hops lead to the neighbours on one side, up to the first whose files can't be used."""

from types import SimpleNamespace

import pytest

from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.motion.shot import Motion
from oiio_msspl.fusion.motion.source import MotionFrame
from oiio_msspl.fusion.neighbours.hops import find_hops
from tests.fusion.motion.moving_texture import HEIGHT, WIDTH, texture
from tests.fusion.neighbours.test_renders import pair_of


class Between:
    """A :class:`ShotMotion` without motion that notes the hops."""

    def __init__(self):
        self.hops = []

    def between(self, here, there):
        self.hops.append((here.number, there.number))
        return Motion(), Motion()


def frames_of(broken=None, error=None, seeds=range(5), features=("rgb",)):
    def frame_of(n):
        if n == broken:
            raise error
        window = Window(0, 0, WIDTH, HEIGHT)
        own = ("rgb",) if n == 0 else features
        hr = SimpleNamespace(view="", display_window=window, features=own, alpha=None)
        return MotionFrame(hr, number=n, lr=hr), pair_of(texture(), seeds[n])

    return frame_of


def hops_of(frame_of, others=(1, 2, 3)):
    motion, warnings = Between(), []
    return find_hops(motion, 0, others, frame_of, warnings), motion.hops, warnings


def test_each_hop_starts_where_the_last_one_ends():
    hops, between, warnings = hops_of(frames_of())
    assert len(hops) == 3 and between == [(0, 1), (1, 2), (2, 3)] and not warnings


def test_behind_a_broken_frame_there_are_none():
    hops, _, warnings = hops_of(frames_of(2, InputError("x.exr: damaged")))
    assert len(hops) == 1 and warnings == ["frame 2 is not averaged: x.exr: damaged"]


def test_other_errors_are_passed_on():
    with pytest.raises(MssplError, match="disk"):
        hops_of(frames_of(2, MssplError("the disk is full")))


def test_a_neighbour_without_a_layer_is_not_averaged():
    hops, _, warnings = hops_of(frames_of(features=()))
    assert not hops and warnings == ["frame 1 is not averaged: its LRHS lacks rgb"]


def test_frames_with_one_seed_are_averaged_with_a_warning():
    hops, _, warnings = hops_of(frames_of(seeds=(1, 1, 2, 3)))
    assert len(hops) == 3 and warnings[0].startswith("frames 0 and 1 have the same noise") and len(warnings) == 1
