# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from oiio_msspl import choice, schema
from oiio_msspl.errors import InputError
from oiio_msspl.pairing import pair
from oiio_msspl.render import Render
from oiio_msspl.session import find_model, shipped_models
from tests.conftest import downsample, noisy, picture


def pair_of(scale, spp, size=128):
    clean = picture(size, size)
    low = Render.from_arrays("lr", rgb=noisy(downsample(clean, scale), spp * scale**2))
    return low, Render.from_arrays("hr", rgb=noisy(clean, spp, seed=1))


@pytest.fixture
def installed(monkeypatch):
    """As if Open Image Denoise were, or were not."""

    def set_to(there):
        monkeypatch.setattr(choice, "find_spec", lambda name: object() if there else None)

    set_to(True)
    return set_to


@pytest.mark.parametrize("scale", schema.SCALES)
def test_noise_follows_the_hrls_whatever_the_scale(scale):
    """Its deviation: half as much with four times the samples, and alike at every scale."""
    levels = [choice.noise(*renders, pair(*renders)) for renders in (pair_of(scale, spp) for spp in (1, 4, 16))]
    np.testing.assert_allclose(np.divide(levels[:-1], levels[1:]), 2, rtol=0.25)
    of_2 = pair_of(2, 4)
    assert levels[1] == pytest.approx(choice.noise(*of_2, pair(*of_2)), rel=0.25)


def test_noise_of_black_is_none():
    low, high = (Render.from_arrays("r", rgb=np.zeros((n, n, 3), np.float32)) for n in (16, 32))
    assert choice.noise(low, high, pair(low, high)) == 0


@pytest.mark.parametrize("scale", schema.SCALES)
def test_the_smallest_model_that_is_enough(scale, installed):
    noisy_pair, quiet_pair = pair_of(scale, 1), pair_of(scale, 4000)
    path, reason = choice.choose(*noisy_pair)
    assert path == shipped_models()[f"pyramid-oidn-x{scale}"] and reason.startswith("noise ")
    path, reason = choice.choose(*quiet_pair, "auto")
    assert path == shipped_models()[f"pyramid-x{scale}"] and "as good" in reason
    installed(False)
    path, reason = choice.choose(*noisy_pair)
    assert path == shipped_models()[f"pyramid-x{scale}"] and "pip install pyoidn" in reason


def test_what_is_named_is_taken(installed, tmp_path):
    pair_x4 = pair_of(4, 1)
    assert choice.choose(*pair_x4, "paper") == (shipped_models()["paper-x4"], "")
    assert choice.choose(*pair_x4, "paper-x2")[0] == shipped_models()["paper-x2"]  # fusing then says why it can't be
    copy = tmp_path / "own.onnx"
    copy.write_bytes(find_model(4).read_bytes())
    assert choice.choose(*pair_x4, str(copy))[0] == copy
    with pytest.raises(InputError, match="no model 'papers': neither a file nor one of paper, pyramid"):
        choice.choose(*pair_x4, "papers")
