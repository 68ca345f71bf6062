# SPDX-License-Identifier: Apache-2.0
"""Scores, and the picture of the error."""

import numpy as np
import OpenImageIO as oiio
import pytest

from oiio_msspl.compare import error_map, scores, upsample_bicubic
from oiio_msspl.metrics import RELMSE_GHARBI, relmse
from tests.conftest import picture


def test_scores_follow_the_conventions_that_they_are_named_after():
    image, truth = picture(32, 32), 1.5 * picture(32, 32)
    found = scores(image, truth)
    assert found["relmse"] == relmse(image, truth, (0.5, 0.01))
    assert found["relmse_gharbi"] == relmse(image, truth, RELMSE_GHARBI) != found["relmse"]


def test_an_enlarged_picture_has_no_negative_light():
    edge = np.full((8, 8, 3), -0.5, np.float32)
    edge[:, 4:] = 1
    enlarged = upsample_bicubic(edge, 32, 32)
    assert enlarged.min() == 0
    assert enlarged.max() == pytest.approx(1, rel=0.1)


def test_the_error_map_spans_five_decades():
    """From 1e-5 to 1, of the colours of "inferno"; beyond both ends nothing changes."""
    truth = np.zeros((1, 6, 3), np.float32)
    errors = np.float64([1e-6, 1e-5, 10**-2.5, 10**-1.25, 1, 10])
    image = np.sqrt(errors * 0.01 / 0.5)[None, :, None] * np.ones(3)
    colours = error_map(image.astype(np.float32), truth)[0]
    np.testing.assert_allclose(colours[0], colours[1], atol=0.01)
    np.testing.assert_allclose(colours[4], colours[5], atol=0.01)
    assert colours[1].sum() < 0.1 and colours[4].sum() > 2.3
    for colour, position in zip(colours[1:5], (0, 0.5, 0.75, 1), strict=True):
        grey = oiio.ImageBuf(np.full((1, 1, 1), position, np.float32))
        expected = oiio.ImageBufAlgo.color_map(grey, 0, "inferno").getpixel(0, 0)
        np.testing.assert_allclose(colour, expected[:3], atol=0.01)
