# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from oiio_msspl.aovs.features import HRLS_FEATURES, NORMAL
from oiio_msspl.image.arrays import repair
from oiio_msspl.image.colour import srgb
from oiio_msspl.model import encoding
from oiio_msspl.model.encoding import MAX_ENCODED, MAX_RADIANCE, NOISY, decode_radiance, encode_radiance, find_exposure
from tests.conftest import noisy, picture


def test_compress_and_expand_are_inverse_over_the_whole_range():
    """Radiance -> network values -> radiance is a no-op from half's smallest step to its largest value."""
    radiance = np.concatenate([[0], np.logspace(-6, np.log10(65504), 200)]).astype(np.float32)
    np.testing.assert_allclose(decode_radiance(encode_radiance(radiance, 1.0), 1.0), radiance, rtol=2e-4, atol=1e-7)


@pytest.mark.parametrize("factor", [2.0**-10, 1.0, 2.0**10])
def test_the_network_sees_a_scaled_scene_unchanged(factor):
    """Exposure cancels: scaling the scene by a power of two leaves the network's input as it was."""
    scene = picture(16, 16)
    base = encode_radiance(scene, find_exposure(scene))
    scaled = encode_radiance(scene * np.float32(factor), find_exposure(scene * np.float32(factor)))
    np.testing.assert_allclose(scaled, base, rtol=1e-5, atol=1e-6)


def test_exposure_brings_the_log_mean_to_mid_grey():
    scene = np.full((8, 8, 3), 0.02, np.float32)
    assert find_exposure(scene) == pytest.approx(9.0, rel=1e-3)


@pytest.mark.parametrize("channel", range(3))
def test_saturated_light_is_not_brighter_to_the_network_than_white(channel):
    """Blue has 7 percent of the luminance of white, and would be 14 times as bright."""
    light = np.zeros((64, 64, 3), np.float32)
    light[..., channel] = 0.3
    assert 0.3 * encoding.find_exposure(light) <= 2.001 * encoding.KEY


def test_traces_of_light_do_not_decide_the_exposure():
    """What a pixel filter or a float leaves between small lights is no light."""
    scene = np.full((8, 8, 3), 1e-40, np.float32)
    scene[:2] = 0.02
    assert find_exposure(scene) == pytest.approx(9.0, rel=1e-3)


def test_noise_does_not_make_a_frame_brighter_to_the_network():
    """With one lit sample in 20 and a little light in all others, the median is far below the mean. Lit samples are
    exposed to the same brightness, however few they are."""
    clean = np.full((64, 64, 3), 0.02, np.float32)
    random = np.random.default_rng(0).random((64, 64, 1))
    for share in (0.05, 0.1):
        noise = np.where(random < share, clean / np.float32(share), 1e-4 * clean)
        assert find_exposure(noise) * 0.02 / share == pytest.approx(NOISY, rel=0.2)
    assert find_exposure(noisy(clean, 1)) < 2 * find_exposure(clean)


def test_a_bright_sky_does_not_darken_what_stands_before_it(monkeypatch):
    """It is no noise."""
    scene = picture(96, 96)
    scene[:60] *= 1e4
    exposure = find_exposure(scene)
    monkeypatch.setattr(encoding, "NOISY", np.inf)
    assert find_exposure(scene) == exposure


@pytest.mark.parametrize("lamps", [1e2, 1e6])
def test_small_lamps_do_not_darken_a_frame_to_the_network(lamps):
    scene = picture(64, 64)
    with_lamps = scene.copy()
    with_lamps[4::16, 4::16] = lamps
    assert find_exposure(with_lamps) == pytest.approx(find_exposure(scene), rel=0.1)


def test_a_sample_of_a_large_frame_gives_its_exposure(monkeypatch):
    scene = noisy(picture(256, 256), 4)
    whole = find_exposure(scene)
    monkeypatch.setattr("oiio_msspl.image.arrays.LARGE_SAMPLE", 1000)
    assert find_exposure(scene) == pytest.approx(whole, rel=1e-3)


@pytest.mark.parametrize("light", [1e-45, 1e-40, 1e-30, 1.0, 1e30, 3e38])
def test_exposure_and_ceiling_are_finite(light):
    exposure = np.float32(find_exposure(np.full((4, 4, 3), light, np.float32)))
    assert np.isfinite([exposure, np.float32(65504) / exposure]).all()


def test_light_in_the_last_column_alone_has_an_exposure():
    """It lies in no whole block."""
    scene = np.full((64, 65, 3), 1e-40, np.float32)
    scene[:, -1] = 0.02
    assert find_exposure(scene) == pytest.approx(9.0, rel=1e-3)


def test_exposure_of_black_is_one():
    assert find_exposure(np.zeros((4, 4, 3), np.float32)) == 1.0


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -1.0, 1e6, 3e38])
@pytest.mark.parametrize("feature", list(HRLS_FEATURES))
def test_repaired_values_are_finite(value, feature):
    channels = HRLS_FEATURES[feature]
    values = np.full((2, 2, channels), value, np.float32)
    repaired, bad = repair(values, signed=feature == NORMAL)
    assert np.isfinite(repaired).all()
    needs_repair = not np.isfinite(value) or (value < 0 and feature != NORMAL)
    assert (bad is not None) == needs_repair
    if bad is not None:
        assert bad.sum() == values.size


def test_infinite_light_is_bright_and_nan_is_black():
    values = np.array([[np.inf, -np.inf, np.nan]], np.float32)
    assert repair(values)[0].tolist() == [[65504.0, 0.0, 0.0]]
    assert repair(values, signed=True)[0].tolist() == [[65504.0, -65504.0, 0.0]]


def test_repair_returns_sound_input_itself():
    values = picture(4, 4)
    repaired, bad = repair(values)
    assert repaired is values
    assert bad is None


def test_expand_stays_finite_for_whatever_a_network_says():
    assert np.isfinite(decode_radiance(np.array([-1e9, 0, 1e9, 5.0], np.float32), 1e-6)).all()


def test_srgb_follows_the_papers_curve():
    values = srgb(np.array([-1, 0, 0.001, 0.18, 1, 7], np.float32))
    np.testing.assert_allclose(values, [0, 0, 0.01292, 0.4613, 1, 1], atol=1e-4)


def test_radiance_beyond_the_largest_is_encoded_as_the_largest():
    """Otherwise a lamp would leave the range in which networks were trained."""
    values = np.array([MAX_RADIANCE / 2, MAX_RADIANCE, 2 * MAX_RADIANCE, 1e30], np.float32)
    below, *others = encode_radiance(values, 1.0)
    assert below < others[0] == others[1] == others[2] == pytest.approx(MAX_ENCODED)
