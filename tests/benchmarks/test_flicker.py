# SPDX-License-Identifier: Apache-2.0
"""`benchmarks.flicker` measures the right amount on sequences whose flicker is known."""

import math

import numpy as np
import pytest

from benchmarks.flicker.measures import BLUR, blur, flicker, psnr
from benchmarks.flicker.temporal import LENGTH, Motion, accumulate
from tests.conftest import picture

SIGMA = 0.02


def still(frames=6, height=96, width=128):
    return np.repeat(picture(height, width).clip(0, 1)[None], frames, axis=0)


def noise(shape, seed=0):
    return np.random.default_rng(seed).normal(0, SIGMA, shape).astype(np.float32)


def panned(frames=6, step=3):
    wide = picture(96, 128 + frames * step).clip(0, 1)
    return np.stack([wide[:, step * t : step * t + 128] for t in range(frames)])


def test_identical_frames_do_not_flicker_however_wrong_they_are():
    assert set(flicker(still() * 0.5, (still(), still())).values()) == {0.0}


def test_motion_that_the_reference_shares_is_no_flicker():
    moving = panned()
    measured = flicker(moving + 0.1, (moving, moving))
    assert max(measured.values()) < 1e-6
    assert flicker(moving, (still(), still()))["rms"] > 0.01


def test_independent_noise_flickers_by_the_root_of_two_of_its_deviation():
    truth = still()
    measured = flicker(truth + noise(truth.shape), (truth, truth))
    assert measured["rms"] == pytest.approx(math.sqrt(2) * SIGMA, rel=0.01)
    assert measured["mean_abs"] == pytest.approx(2 / math.sqrt(math.pi) * SIGMA, rel=0.01)
    # A Gaussian of deviation b leaves 1 / (2 sqrt(pi) b) of white noise, and somewhat more along the border.
    assert measured["rms_blotches"] == pytest.approx(math.sqrt(2) * SIGMA / (2 * math.sqrt(math.pi) * BLUR), rel=0.35)
    assert measured["rms_grain"] == pytest.approx(measured["rms"], rel=0.01)


def test_a_frame_that_changes_as_a_whole_flickers_in_the_low_frequencies_alone():
    truth = still()
    brightness = np.array([0, 0.01] * 3, np.float32)[:, None, None, None]
    measured = flicker(truth + brightness, (truth, truth))
    assert measured["rms_blotches"] == pytest.approx(0.01, rel=1e-3)
    assert measured["rms_grain"] < 1e-5


def test_noise_of_the_reference_halves_cancels_out():
    truth = still()
    halves = tuple(truth + noise(truth.shape, seed) for seed in (1, 2))
    measured = flicker(truth + noise(truth.shape, 3), halves)
    assert measured["rms"] == pytest.approx(math.sqrt(2) * SIGMA, rel=0.02)
    assert psnr((truth + 0.1)[0], tuple(h[0] for h in halves)) == pytest.approx(20, abs=0.1)


def test_blur_keeps_a_constant_picture_up_to_its_border():
    assert blur(np.full((2, 40, 50, 3), 0.7, np.float32)) == pytest.approx(0.7, abs=1e-5)


def test_accumulation_averages_a_static_picture():
    frames = [{"rgb": values} for values in 0.5 + noise((12, 64, 64, 3))]
    motion = Motion(np.zeros((64, 64, 2), np.float32), np.ones((64, 64), np.float32))
    last = accumulate(frames, [motion] * 12)[-1]["rgb"]
    # Weights a (1 - a)^k sum, squared, to a / (2 - a).
    assert last.std() == pytest.approx(SIGMA / math.sqrt(2 * LENGTH - 1), rel=0.1)


def test_accumulation_follows_motion_and_starts_anew_where_another_surface_appears():
    moving = panned(step=3)
    frames = [{"rgb": values} for values in moving]
    depth = np.ones((96, 128), np.float32)
    motions = [Motion(np.broadcast_to(np.float32((3, 0)), (96, 128, 2)), depth)] * len(frames)
    for before, after in zip(frames, accumulate(frames, motions), strict=True):
        assert after["rgb"] == pytest.approx(before["rgb"], abs=1e-5)

    unmoved = [Motion(np.zeros((96, 128, 2), np.float32), depth * (10.0**t)) for t in range(len(frames))]
    for before, after in zip(frames, accumulate(frames, unmoved), strict=True):
        assert np.array_equal(before["rgb"], after["rgb"])
