# SPDX-License-Identifier: Apache-2.0
"""A shot given as arrays."""

import re

import numpy as np
import pytest

from oiio_msspl import ArrayFrame, InputError, fuse_array_shot
from tests.conftest import downsample, noisy
from tests.moving_plane import HEIGHT, WIDTH, positions, texture, truck, vectors

FRAMES = range(5)
SHARES = {"key": 0.7, "fill": 0.3}


def clean(t):
    return texture(*np.moveaxis(positions(truck, t)[..., :2], -1, 0))


def passes(t, scale, spp):
    """Passes with noise of their own, by name."""
    image = downsample(clean(t), scale)
    return {name: noisy(share * image, spp, [t, scale, i]) for i, (name, share) in enumerate(SHARES.items())}


def rendered(t, *, two):
    own, low = passes(t, 1, 2), passes(t, 2, 8)
    pair = {"lr": sum(low.values()), "lr_passes": low} if two else {}
    return ArrayFrame(sum(own.values()), albedo=clean(t), motion=vectors(truck, t, 1), passes=own, **pair)


@pytest.mark.parametrize("two", [False, True])
def test_neighbours_and_passes_of_arrays_are_fused(two):
    frames = [rendered(t, two=two) for t in FRAMES]
    alone, averaged = (list(fuse_array_shot(frames, temporal=over_time, quality="fast")) for over_time in ("off", 2))
    assert [frame.rgb.shape for frame in averaged] == [(HEIGHT, WIDTH, 3)] * len(FRAMES)
    for t, single, fused in zip(FRAMES, alone, averaged, strict=True):
        pictures = (frames[t].hr, single.rgb, fused.rgb)
        errors = [np.square(picture - clean(t)).mean() for picture in pictures]
        assert errors[2] < 0.9 * errors[1] < 0.5 * errors[0]
        assert list(fused.passes) == list(SHARES)
        np.testing.assert_allclose(sum(fused.passes.values()), fused.rgb, atol=1e-5)


def test_frames_of_one_render_keep_what_no_aov_shows():
    """A light that is as fine as pixels: the network alone takes it for noise."""
    rng = np.random.default_rng(2)
    light = (0.5 * rng.uniform(0.4, 1.6, (96, 200, 1)) * np.ones(3)).astype(np.float32)
    motion = np.tile(np.float32([-4, 0]), (96, 160, 1))
    truth = [light[:, 4 * t : 4 * t + 160] for t in FRAMES]
    frames = [
        ArrayFrame(noisy(image, 32, t), albedo=np.full_like(image, 0.5), motion=motion) for t, image in enumerate(truth)
    ]
    alone, averaged = (list(fuse_array_shot(frames, temporal=over_time, quality="fast")) for over_time in ("off", 2))
    errors = [np.square(shot[2].rgb - truth[2]).mean() for shot in (alone, averaged)]
    assert errors[1] < 0.6 * np.square(frames[2].hr - truth[2]).mean() < 0.6 * errors[0]


@pytest.mark.parametrize("dimmer", [0.0, 0.01])
def test_frames_of_one_seed_tell_no_noise(dimmer):
    """They are equal, or differ by their light alone, although each has noise."""
    albedo = np.full((96, 160, 3), 0.5, np.float32)
    albedo[:, ::2] = 0.6
    albedo[:40] = 0.3
    wall = np.full_like(albedo, 0.5)
    frames = [ArrayFrame(noisy(wall, 16, 0) * np.float32(1 - dimmer * t), albedo=albedo) for t in FRAMES]
    alone, averaged = (list(fuse_array_shot(frames, temporal=over_time, quality="fast")) for over_time in ("off", 2))
    assert "same_seed" in {warning.code for warning in averaged[2].warnings}
    errors = [np.abs(shot[2].rgb - wall * np.float32(1 - 2 * dimmer)).mean() for shot in (alone, averaged)]
    assert errors[1] < 1.05 * errors[0]


def test_arrays_that_do_not_fit_are_named():
    frame = rendered(0, two=False)
    wrong = {"key": frame.passes["key"][:-1], "fill": frame.passes["fill"]}
    with pytest.raises(InputError, match=r"hr\.0002\.exr: key has the shape \(95, 160, 3\), and not \(96, 160, 3\)"):
        list(fuse_array_shot([frame, ArrayFrame(frame.hr, passes=wrong)]))
    for name in ("a+b", "albedo"):
        with pytest.raises(InputError, match=f"pass {re.escape(repr(name))}: give it a name of its own, of letters"):
            list(fuse_array_shot([ArrayFrame(frame.hr, albedo=frame.hr, passes={name: frame.hr})]))
    with pytest.raises(InputError, match="render the LRHS at one of 80x48"):
        list(fuse_array_shot([ArrayFrame(frame.hr, lr=frame.hr[:32])]))
    assert list(fuse_array_shot([])) == []
