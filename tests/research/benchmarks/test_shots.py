# SPDX-License-Identifier: Apache-2.0
"""`research.benchmarks.shots` measures the right amount on sequences whose errors are known."""

import math

import numpy as np
import pytest

from research.benchmarks.shots import methods
from research.benchmarks.shots.measures import blur, flicker, psnr, relmse, warped
from research.benchmarks.shots.moving_wall import STEP, clean_frame, write_shot
from research.benchmarks.shots.sequence import load, without_vectors
from tests.conftest import noisy, picture, rgb, write_exr
from tests.moving_plane import layer

SIGMA = 0.02
FRAMES, WIDTH, HEIGHT = 3, 96, 64


def still(frames=6, height=96, width=128):
    return np.repeat(picture(height, width).clip(0, 1)[None], frames, axis=0)


def noise(shape, seed=0):
    return np.random.default_rng(seed).normal(0, SIGMA, shape).astype(np.float32)


def panned(frames=6, step=3):
    wide = picture(96, 128 + frames * step).clip(0, 1)
    return np.stack([wide[:, step * t : step * t + 128] for t in range(frames)])


def test_identical_frames_do_not_flicker_however_wrong_they_are():
    assert flicker(still() * 0.5, (still(), still())) == 0


def test_motion_that_the_reference_shares_is_no_flicker():
    moving = panned()
    assert flicker(moving + 0.1, (moving, moving)) < 1e-6
    assert flicker(moving, (still(), still())) > 0.01


def test_independent_noise_flickers_by_the_root_of_two_of_its_deviation():
    truth = still()
    assert flicker(truth + noise(truth.shape), (truth, truth)) == pytest.approx(math.sqrt(2) * SIGMA, rel=0.01)


def test_noise_of_the_reference_halves_cancels_out():
    truth = still()
    halves = tuple(truth + noise(truth.shape, seed) for seed in (1, 2))
    assert flicker(truth + noise(truth.shape, 3), halves) == pytest.approx(math.sqrt(2) * SIGMA, rel=0.02)
    assert psnr((truth + 0.1)[0], tuple(h[0] for h in halves)) == pytest.approx(20, abs=0.1)


def test_blur_keeps_a_constant_picture_up_to_its_border():
    assert blur(np.full((2, 40, 50, 3), 0.7, np.float32), 8) == pytest.approx(0.7, abs=1e-5)


def test_psnr_in_a_mask_counts_that_alone():
    truth = still(2)
    wrong, mask = truth.copy(), np.zeros(truth.shape[:3], bool)
    wrong[:, :10] += 0.1
    mask[:, :10] = True
    assert psnr(wrong, (truth, truth), mask) == pytest.approx(20, abs=1e-3)
    assert psnr(wrong, (truth, truth), ~mask) == math.inf


def test_noise_of_the_reference_halves_hardly_counts_in_relmse():
    truth = still(2) + 0.2
    halves = tuple(truth + noise(truth.shape, seed) for seed in (1, 2))
    expected = 0.5 * np.mean(np.square(0.1 * truth) / (np.square(truth) + 0.01))
    assert relmse(1.1 * truth, (truth, truth)) == pytest.approx(expected, rel=1e-4)
    assert relmse(1.1 * truth, halves) == pytest.approx(expected, rel=0.1)  # some noise is left in the divisor
    assert relmse(1.1 * truth, (halves[0], halves[0])) > 1.2 * expected


def test_warping_brings_the_next_frame_of_a_pan_to_its_place():
    moving = panned(step=3)
    vectors = np.broadcast_to(np.float32((-3, 0)), (96, 128, 2))
    assert warped(moving[1], vectors)[:, 3:] == pytest.approx(moving[0][:, 3:], abs=1e-6)


@pytest.fixture
def sequence(tmp_path):
    """A wall past which the camera moves. Its full-resolution renders have 2 spp."""
    folder = tmp_path / "wall/pan"
    for scale in methods.SCALES:
        shot = folder / f"x{scale}"
        shot.mkdir(parents=True)
        write_shot(shot, FRAMES, WIDTH, HEIGHT, scale)
        for path in shot.glob("*/*.exr"):
            path.rename(folder / path.name.replace("lr", f"lr_x{scale}"))
    steps = np.full((HEIGHT, WIDTH, 2), (STEP, 0), np.float32)
    mask = {f"{name}.Y": np.zeros((HEIGHT, WIDTH), np.float32) for name in ("moves", "reflects")}
    mask |= layer("motionBack", steps) | layer("motionFore", -steps)
    for number in range(1, FRAMES + 1):
        _, (clean,) = clean_frame(number, FRAMES, WIDTH, HEIGHT, 0)
        images = {"full": noisy(clean, 2, number), "ref_a": clean, "ref_b": clean}
        for name, channels in {"mask": mask, **{name: rgb(image) for name, image in images.items()}}.items():
            write_exr(folder / f"{name}.{number:04d}.exr", channels)
    return load(folder)


def test_frames_of_another_program_are_averaged_along_the_motion(sequence, monkeypatch):
    """A denoiser that changes nothing returns the full-resolution render, or its mean with those of its neighbours."""
    monkeypatch.setattr(methods, "oidn_prefiltered", lambda render: render.read(render.data_window, ["rgb"])["rgb"])
    made = list(methods.all_methods(sequence, pattern="OIDN prefiltered*"))
    assert [(m.method, m.scale) for m in made] == [(methods.OIDN_BEST, 1)] + [
        (methods.OIDN_NEIGHBOURS, s) for s in (2, 4)
    ]
    single, *averaged = ((m.images - sequence.truth[0])[:, :, STEP * FRAMES : -STEP * FRAMES] for m in made)
    for errors in averaged:
        assert np.square(errors).mean() < 0.5 * np.square(single).mean()


def test_a_sequence_without_vectors_has_its_other_files(sequence, tmp_path):
    bare = without_vectors(sequence, tmp_path / "bare")
    assert {path.name for path in bare.folder.iterdir()} == {path.name for path in sequence.folder.iterdir()}
    assert list(load(bare.folder).masks) == list(sequence.masks)


def test_a_moved_picture_stays_between_its_pixels():
    image = np.zeros((8, 12, 1), np.float32)
    image[:, 6:] = 1
    moved = warped(image, np.full((8, 12, 2), (0.3, 0), np.float32))
    assert moved.min() == 0 and moved.max() == 1
    assert 0 < moved[4, 5, 0] < 1
