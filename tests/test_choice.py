# SPDX-License-Identifier: Apache-2.0
"""What `--model auto` takes."""

import numpy as np
import pytest

from oiio_msspl import choice, transforms
from oiio_msspl.errors import InputError
from oiio_msspl.pairing import pair
from oiio_msspl.render import Render
from oiio_msspl.session import ALWAYS, BEST, FAST
from tests.conftest import downsample, picture


def renders(deviation, shape=(512, 384), scale=4):
    """A pair whose noise, in network values at the LRHS's resolution, has this standard deviation in either."""
    rng = np.random.default_rng(0)
    clean = np.maximum(picture(*shape), 0.02)
    low = downsample(clean, scale)
    exposure = transforms.exposure_of(low)
    values = transforms.compress(low, exposure)
    one, other = (
        transforms.expand(np.maximum(values + rng.normal(0, deviation, values.shape).astype(np.float32), 0), exposure)
        for _ in range(2)
    )
    return Render.from_arrays("lr", rgb=one), Render.from_arrays("hr", rgb=other.repeat(scale, 0).repeat(scale, 1))


@pytest.mark.parametrize("shape", [(64, 96), (2048, 64)])
@pytest.mark.parametrize("deviation", [0.0, 0.01, 0.1])
def test_noise_is_told_from_picture(deviation, shape):
    """The mean of two renders of equal noise has 1 / sqrt 2 of it; a tall frame is judged by some of its rows."""
    low, high = renders(deviation, shape)
    assert choice.noise_of(low, high, pair(low, high)) == pytest.approx(deviation / np.sqrt(2), rel=0.15, abs=1e-3)


def test_little_noise_needs_little_model(monkeypatch):
    quiet, loud = renders(choice.QUIET / 2), renders(4 * choice.QUIET)
    monkeypatch.setattr(choice, "find_spec", lambda name: object())
    for sources, family, says in ((quiet, FAST, "is below"), (loud, BEST, "is not below")):
        path, reason = choice.choose(*sources, "auto")
        assert path.stem == f"{family}-x4"
        assert says in reason
    monkeypatch.setattr(choice, "find_spec", lambda name: None)
    assert choice.choose(*quiet)[0].stem == f"{ALWAYS}-x4"


def test_a_model_that_was_named_is_taken(monkeypatch):
    monkeypatch.setattr(choice, "noise_of", None)  # is not asked
    path, reason = choice.choose(*renders(0.0), "paper")
    assert (path.stem, reason) == ("paper-x4", "")
    with pytest.raises(InputError, match="no model 'x'"):
        choice.choose(*renders(0.0), "x")
