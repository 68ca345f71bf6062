# SPDX-License-Identifier: Apache-2.0
"""Operations on images."""

import warnings

import numpy as np
import pytest

from oiio_msspl.arrays import box_downsample


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_means_are_exact_and_finite_up_to_the_largest_value(dtype):
    """Also where the sum of the pixels does not fit into their type."""
    image = np.full((8, 8, 3), np.finfo(dtype).max, dtype)
    image[4:] = 0.1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        means = box_downsample(image, 4)
    assert means.dtype == np.float32
    np.testing.assert_allclose(means[1], np.float32(dtype(0.1)), rtol=1e-6)
    # Sums of floats are limited
    expected = np.float32(65504) if dtype is np.float16 else np.finfo(np.float32).max / 16
    np.testing.assert_allclose(means[0], expected, rtol=1e-6)
