# SPDX-License-Identifier: Apache-2.0
"""Pixels that are left out of the interpolation, because they need none, have the same bits as with it."""

import numpy as np
import pytest

from oiio_msspl.image import sampling
from oiio_msspl.image.sampling import nearest_indices, sample_cubic, sample_linear

HEIGHT, WIDTH = 40, 60


def sample(monkeypatch, most_chosen, images, x, y, valid=True):
    monkeypatch.setattr(sampling, "MOST_CHOSEN", most_chosen)
    return sample_cubic(images, lambda rows: (x[rows], y[rows]), x.shape, np.broadcast_to(valid, x.shape))


@pytest.mark.parametrize("layout", ["C", "F"])
def test_a_linear_sample_lies_between_four_pixels_and_repeats_the_edge(layout):
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    image = np.asarray(np.stack([x, 2 * y, 3 * x + y], axis=-1), order=layout)
    at_x, at_y = np.float32([[0.25, 58.5, -4], [7, 99, 59]]), np.float32([[3.5, 38.75, 2], [39, 0.5, 1e6]])
    inside_x, inside_y = np.clip(at_x, 0, WIDTH - 1), np.clip(at_y, 0, HEIGHT - 1)
    expected = np.stack([inside_x, 2 * inside_y, 3 * inside_x + inside_y], axis=-1)
    assert np.allclose(sample_linear(image, at_x, at_y), expected, rtol=1e-6)


@pytest.mark.parametrize("moving", [0, 0.1, 0.5, 1])
def test_pixels_that_lie_on_pixels_are_taken_as_they_are(monkeypatch, moving):
    rng = np.random.default_rng(0)
    images = [rng.random((HEIGHT, WIDTH, 3), np.float32), np.full((HEIGHT, WIDTH, 1), 0.3, np.float32)]
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    moves = rng.random(x.shape) < moving
    x, y = (at + moves * rng.normal(0, 3, x.shape).astype(np.float32) for at in (x, y))
    all_of_them, chosen = (sample(monkeypatch, most, images, x, y) for most in (0, 2))
    for one, other, image in zip(all_of_them, chosen, images, strict=True):
        assert np.array_equal(one, other)
        assert np.array_equal(one[~moves], image[~moves])


def test_only_valid_positions_are_interpolated(monkeypatch):
    rng = np.random.default_rng(0)
    image = rng.random((HEIGHT, WIDTH, 3), np.float32)
    x, y = (rng.uniform(-2, side, (HEIGHT, WIDTH)).astype(np.float32) for side in (WIDTH, HEIGHT))
    valid = rng.random(x.shape) < 0.3
    (everywhere,) = sample(monkeypatch, 0.8, [image], x, y)
    (found,) = sample(monkeypatch, 0.8, [image], x, y, valid)
    assert np.array_equal(found[valid], everywhere[valid])
    assert np.isin(found[~valid], image).all()


def test_a_sample_stays_between_the_four_nearest_pixels(monkeypatch):
    """Keys' cubic would overshoot beside an edge."""
    image = np.zeros((HEIGHT, WIDTH, 1), np.float32)
    image[:, WIDTH // 2 :] = 1
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    (found,) = sample(monkeypatch, 0, [image], x + np.float32(0.3), y)
    assert found.min() == 0 and found.max() == 1
    assert 0 < found[5, WIDTH // 2 - 1, 0] < 1


@pytest.mark.parametrize("error", [0, 1e-5, -1e-5])
def test_halves_are_rounded_to_one_side(error):
    """So that no pixel is the nearest one of two positions."""
    x = np.arange(20, dtype=np.float32) + np.float32(0.5 + error)
    assert np.array_equal(nearest_indices(x, np.zeros_like(x), (1, 40)), np.arange(1, 21))
