# SPDX-License-Identifier: Apache-2.0
"""Tests of :mod:`oiio_msspl.image.filters`."""

import numpy as np
import pytest

from oiio_msspl.image.filters import means_around


@pytest.mark.parametrize("size", [(40, 27), (9, 5), (1, 30)])
def test_means_are_those_of_the_pixels_around_that_exist(size):
    plane = np.random.default_rng(0).random(size, np.float32)
    reaches = [1, 4, 14]
    for reach, means in zip(reaches, means_around(plane, reaches), strict=True):
        for y, x in np.ndindex(size):
            around = plane[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1]
            assert means[y, x] == pytest.approx(around.mean(dtype=np.float64), rel=1e-6)


def test_a_dark_region_beside_a_lamp_keeps_its_mean():
    plane = np.full((200, 300), 1e-3, np.float32)
    plane[:4, :4] = 65504
    (means,) = means_around(plane, [2])
    np.testing.assert_allclose(means[50:], 1e-3, rtol=1e-4)
