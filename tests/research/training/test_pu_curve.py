# SPDX-License-Identifier: Apache-2.0
"""The curve by which Open Image Denoise encodes HDR colour."""

import pytest

torch = pytest.importorskip("torch")

from oiio_msspl.model.encoding import MAX_RADIANCE  # noqa: E402
from research.training.encoding import pu_decode, pu_encode  # noqa: E402


def test_the_curve_rises_from_0_to_1_and_decoding_inverts_it():
    radiance = torch.cat([torch.zeros(1), torch.logspace(-8, torch.tensor(MAX_RADIANCE).log10(), 2000)]).double()
    values = pu_encode(radiance)
    assert values[0] == 0
    assert values[-1] == pytest.approx(1)
    assert (values.diff() > 0).all()
    torch.testing.assert_close(pu_decode(values), radiance, rtol=1e-3, atol=1e-9)
