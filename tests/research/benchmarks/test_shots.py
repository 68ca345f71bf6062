# SPDX-License-Identifier: Apache-2.0
"""`research.benchmarks.shots` measures the right amount on sequences whose errors are known."""

import math

import numpy as np
import pytest

from research.benchmarks.shots import methods
from research.benchmarks.shots.measures import flicker, psnr
from research.benchmarks.shots.moving_wall import STEP, clean_frame, write_shot
from research.benchmarks.shots.sequence import _channels, _differs, load, without_vectors
from tests.conftest import noisy, picture, rgb, write_exr

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


def test_psnr_in_a_mask_counts_that_alone():
    truth = still(2)
    wrong, mask = truth.copy(), np.zeros(truth.shape[:3], bool)
    wrong[:, :10] += 0.1
    mask[:, :10] = True
    assert psnr(wrong, (truth, truth), mask) == pytest.approx(20, abs=1e-3)
    assert psnr(wrong, (truth, truth), ~mask) == math.inf


def test_light_changes_where_a_lamp_goes_on_and_not_where_the_camera_moves():
    moving = panned(step=3)
    moving[1, 40:60, 50:70] += 0.1
    vectors = np.broadcast_to(np.float32((-3, 0)), (96, 128, 2))
    changed = _differs((moving, moving), 0, 1, vectors)
    assert changed[40:60, 53:73].all() and not changed[:30, 3:].any() and not changed[:, 3:40].any()


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
    for number in range(1, FRAMES + 1):
        _, (clean,) = clean_frame(number, FRAMES, WIDTH, HEIGHT, 0)
        images = {"full": noisy(clean, 2, number), "ref_a": clean, "ref_b": clean}
        for name, image in images.items():
            write_exr(folder / f"{name}.{number:04d}.exr", rgb(image))
    return load(folder)


def test_frames_of_another_program_are_averaged_along_the_motion(sequence, monkeypatch):
    """A denoiser that changes nothing returns the full-resolution render, or its mean with those of its neighbours."""
    monkeypatch.setattr(methods, "oidn_prefiltered", lambda render: render.read(render.data_window, ["rgb"])["rgb"])
    made = list(methods.all_methods(sequence, pattern="OIDN prefiltered*"))
    assert [row for row, _ in made] == [{"method": methods.OIDN_BEST, "scale": 1}] + [
        {"method": f"{methods.OIDN_BEST}, {methods.NEIGHBOURS}", "scale": s} for s in (2, 4)
    ]
    single, *averaged = ((images - sequence.truth[0])[:, :, STEP * FRAMES : -STEP * FRAMES] for _, images in made)
    for errors in averaged:
        assert np.square(errors).mean() < 0.5 * np.square(single).mean()


def test_a_sequence_without_vectors_has_its_other_files(sequence, tmp_path):
    bare = without_vectors(sequence, tmp_path / "bare")
    assert {path.name for path in bare.folder.iterdir()} == {path.name for path in sequence.folder.iterdir()}
    assert not any(name.startswith("motion") for name in _channels(bare.folder / "hr.0001.exr"))
