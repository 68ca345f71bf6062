# SPDX-License-Identifier: Apache-2.0
"""Writes files for the tests of the programs."""

import numpy as np
import pytest

from tests.conftest import downsample, noisy, picture, rgb, write_exr


@pytest.fixture
def files(tmp_path):
    """Write a x4 pair with albedo, alpha and a mask, and its reference."""
    clean = picture(96, 128)
    ones = np.ones((96, 128), np.float16)
    channels = rgb(noisy(clean, 1).astype(np.float16)) | {"A": ones} | rgb((clean > 0.3).astype(np.float16), "albedo.")
    write_exr(tmp_path / "hr.exr", channels | {"mask.X": ones * 7, "Z": ones})
    low = noisy(downsample(clean, 4), 16).astype(np.float16)
    write_exr(tmp_path / "lr.exr", rgb(low) | {"A": ones[::4, ::4]})
    write_exr(tmp_path / "ref.exr", rgb(clean))
    return tmp_path
