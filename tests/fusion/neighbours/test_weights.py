# SPDX-License-Identifier: Apache-2.0
"""Weighted means of frames."""

import numpy as np
import pytest

from oiio_msspl.aovs.features import RGB, VARIANCE
from oiio_msspl.fusion.neighbours.weights import WeightedSum


def test_a_mean_has_the_noise_of_as_many_frames_as_it_says():
    """Of n equal frames, n. A frame that counts half adds less: (1 + 0.5)^2 / (1 + 0.25)."""
    first = {RGB: np.ones((1, 3, 3), np.float32), VARIANCE: np.ones((1, 3, 1), np.float32)}
    other = {RGB: np.full((1, 3, 3), 4, np.float32), VARIANCE: np.full((1, 3, 1), 4, np.float32)}
    total = WeightedSum(first)
    total.add(lambda name, rows: other[name][rows], np.array([[0, 0.5, 1]], np.float32))
    frames = total.divide()
    assert frames[0, :, 0] == pytest.approx([1, 1.5**2 / 1.25, 2])
    assert first[RGB][0, :, 0] == pytest.approx([1, 3 / 1.5, 2.5])
    assert first[VARIANCE][0, :, 0] == pytest.approx([1, 2 / 1.5**2, 5 / 4])
