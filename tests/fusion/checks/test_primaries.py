# SPDX-License-Identifier: Apache-2.0
"""P3 in one of two renders is told from noise."""

import numpy as np
import pytest

from oiio_msspl.fusion.checks.colours import different_primaries
from oiio_msspl.image.colour import P3, REC709, conversion
from oiio_msspl.image.filters import box_downsample
from tests.conftest import noisy
from tests.fusion.checks.test_pair import scene

TO_P3 = conversion(REC709, P3).T


def blocks(spp, seed):
    """A noisy render of a scene, as means over blocks."""
    return box_downsample(noisy(scene(2, seed=3, size=(128, 128))[0], spp, seed), 8).astype(np.float64)


@pytest.mark.parametrize("spp", [1, 4, 16])
@pytest.mark.parametrize("seed", range(4))
def test_p3_is_told_from_noise(spp, seed):
    low, high = blocks(spp, seed), blocks(spp, seed + 10)
    assert different_primaries(low, high) is None
    assert different_primaries(low @ TO_P3, high) == "the LRHS looks like linear P3 and the HRLS like linear Rec.709"
    assert different_primaries(low, high @ TO_P3) == "the HRLS looks like linear P3 and the LRHS like linear Rec.709"


def test_one_object_in_another_light_is_no_p3():
    low, high = blocks(16, 1), blocks(16, 2)
    high[:, :12] = high[:, :12] @ TO_P3 @ TO_P3
    assert different_primaries(low, high) is None


def test_grey_dark_small_and_broken_pictures_say_nothing():
    low, high = blocks(4, 1), blocks(4, 2)
    grey = np.repeat(low.mean(axis=2, keepdims=True), 3, axis=2)
    assert different_primaries(grey @ TO_P3, grey) is None
    assert different_primaries(np.zeros_like(low), high) is None
    assert different_primaries(low[:7, :7] @ TO_P3, high[:7, :7]) is None
    assert different_primaries(np.full_like(low, np.inf), high) is None
