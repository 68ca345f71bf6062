# SPDX-License-Identifier: Apache-2.0
"""What `--model auto` takes."""

import numpy as np
import pytest

from oiio_msspl import choice, fuse
from oiio_msspl.errors import InputError
from oiio_msspl.pairing import pair
from oiio_msspl.render import Render
from oiio_msspl.session import ALWAYS, BEST, FAST, Session
from tests.conftest import downsample, noisy, picture


def renders(height=64, width=96):
    clean = picture(height, width)
    layers = {"albedo": np.full_like(clean, 0.5), "alpha": np.ones_like(clean[..., :1])}
    low = Render.from_arrays("lr", rgb=noisy(downsample(clean, 4), 16))
    return low, Render.from_arrays("hr", rgb=noisy(clean, 1, seed=1), **layers)


@pytest.fixture
def loaded(bilinear_models, monkeypatch):
    """Which models were asked for, in turn; all are the bilinear one, which expects an error of 0.1 everywhere."""
    asked = []
    session = Session(bilinear_models[4])
    monkeypatch.setattr(choice, "find_spec", lambda name: object())

    def load(path):
        asked.append(path.stem)
        return session

    return asked, load


def test_the_small_model_is_enough_where_it_says_so(loaded, monkeypatch):
    asked, load = loaded
    _, reason = choice.choose(*renders(), None, load)
    assert asked == [f"{FAST}-x4", f"{BEST}-x4"]
    assert reason == "auto: bilinear-x4 expects an error of 0.100"
    monkeypatch.setattr(choice, "ENOUGH", 0.11)
    _, reason = choice.choose(*renders(), "auto", load)
    assert asked[2:] == [f"{FAST}-x4"]
    assert reason == "auto: expects an error of 0.100, below 0.11"


def test_without_open_image_denoise_there_is_one_model(loaded, monkeypatch):
    asked, load = loaded
    monkeypatch.setattr(choice, "find_spec", lambda name: None)
    choice.choose(*renders(), "auto", load)
    assert asked == [f"{ALWAYS}-x4"]


def test_a_model_that_was_named_is_taken(loaded):
    asked, load = loaded
    assert choice.choose(*renders(), "paper", load)[1] == ""
    assert asked == ["paper-x4"]
    with pytest.raises(InputError, match="no model 'x'"):
        choice.choose(*renders(), "x", load)


def test_a_large_frame_is_judged_by_some_of_it(bilinear_models, monkeypatch):
    """Squares of both renders that lie over each other, and as much light as in the frame."""
    low, high = renders(1200, 2048)
    seen = []
    monkeypatch.setattr(choice, "fuse", lambda *arguments, **more: seen.append(arguments) or fuse(*arguments, **more))
    error = choice.expected_error(low, high, pair(low, high), Session(bilinear_models[4]))
    assert error == pytest.approx(0.1, rel=0.01)
    ((small, large, _),) = seen
    assert (large.data_window.width, large.data_window.height) == (3 * 256, 2 * 256)
    colours = [source.read(source.data_window, ["rgb"])["rgb"] for source in (small, large)]
    assert np.abs(downsample(colours[1], 4) / colours[0] - 1).mean() < 0.4
