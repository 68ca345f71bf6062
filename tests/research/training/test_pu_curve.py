# SPDX-License-Identifier: Apache-2.0
"""The curve by which Open Image Denoise encodes HDR colour."""

import numpy as np
import pytest

from oiio_msspl.model.encoding import MAX_RADIANCE
from research.training.pu_curve import pu_decode, pu_encode


def test_the_curve_rises_from_0_to_1_and_decoding_inverts_it():
    radiance = np.concatenate([[0.0], np.geomspace(1e-8, MAX_RADIANCE, 2000)])
    values = pu_encode(radiance)
    assert values[0] == 0
    assert values[-1] == pytest.approx(1)
    assert (np.diff(values) > 0).all()
    np.testing.assert_allclose(pu_decode(values), radiance, rtol=1e-3, atol=1e-9)
