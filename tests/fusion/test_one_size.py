# SPDX-License-Identifier: Apache-2.0
"""One render, which is given as both, and two renders of one size."""

import numpy as np
import pytest

from oiio_msspl import InputError, Render, fuse, fuse_arrays
from oiio_msspl.fusion.checks.noise import is_noise_spread
from oiio_msspl.fusion.checks.pair import check_renders
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.image.filters import box_downsample, columns_apart, even_and_odd
from oiio_msspl.model.catalogue import load_model
from oiio_msspl.model.encoding import encode_radiance
from tests.conftest import noisy, picture, spread

HEIGHT, WIDTH = 120, 168


def layers(spp=4, seed=0, height=HEIGHT, width=WIDTH):
    clean = picture(height, width)
    return {"rgb": noisy(clean, spp, seed), "albedo": clean.clip(0, 1), "normal": np.full_like(clean, 0.5)}


def error(image, height=HEIGHT, width=WIDTH):
    return np.abs(encode_radiance(image, 1.0) - encode_radiance(picture(height, width), 1.0)).mean()


@pytest.mark.parametrize("quality", ["fast", "balanced", "best"])
def test_one_render_loses_its_noise_and_two_lose_more(quality):
    session = load_model(1, quality, threads=1)
    first, second = (Render.from_arrays(f"seed {seed}", **layers(seed=seed)) for seed in (1, 2))
    one, both = fuse(second, second, session), fuse(first, second, session)
    assert one.rgb.shape == both.rgb.shape == (HEIGHT, WIDTH, 3)
    assert error(both.rgb) < error(one.rgb) < 0.3 * error(second.layers["rgb"])
    assert one.warnings == both.warnings == []


def test_tiles_of_one_render_do_not_show(monkeypatch):
    from oiio_msspl.fusion.tiles import tiling

    session = load_model(1, "fast", threads=1)
    render = Render.from_arrays("hr", **layers(height=64, width=400))
    whole = fuse(render, render, session)
    monkeypatch.setattr(tiling, "TILE_MEMORY", 64 * 300 * session.contract.bytes_per_pixel)
    tiled = fuse(render, render, session)
    assert tiled.tiles > whole.tiles == 1
    difference = np.abs(encode_radiance(tiled.rgb, 1.0) - encode_radiance(whole.rgb, 1.0))
    assert difference.max() < 0.02


@pytest.mark.parametrize("colour", [(0, 10, 0), (200, 0, 0), (2000, 2000, 2000)])
def test_a_visible_lamp_of_one_render_keeps_its_light(colour):
    """Its pixels have no noise. Networks have no codes for light that is so bright or saturated."""
    session = load_model(1, "fast", threads=1)
    images = layers()
    lamp = (slice(40, 70), slice(60, 100))
    images["rgb"][lamp] = colour
    render = Render.from_arrays("hr", **images)
    np.testing.assert_array_equal(fuse(render, render, session).rgb[lamp], render.layers["rgb"][lamp])


def test_a_bright_highlight_with_noise_is_denoised():
    session = load_model(1, "fast", threads=1)
    images = layers()
    bright = (slice(40, 70), slice(60, 100))
    images["rgb"][bright] = noisy(np.full((30, 40, 3), 12, np.float32), 16, 1)
    render = Render.from_arrays("hr", **images)
    inner = (slice(45, 65), slice(65, 95))
    assert fuse(render, render, session).rgb[inner].std() < 0.4 * images["rgb"][inner].std()


@pytest.mark.parametrize("colour", [(0, 10, 0), (0, 60, 0), (30, 0, 0), (0, 8, 8)])
def test_pure_light_with_noise_keeps_its_brightness_and_its_colour(colour):
    session = load_model(1, "fast", threads=1)
    images = layers()
    images["rgb"][30:80, 50:110] = noisy(np.full((50, 60, 3), colour, np.float32), 4, 1)
    render = Render.from_arrays("hr", **images)
    light = fuse(render, render, session).rgb[40:70, 60:100].mean(axis=(0, 1))
    np.testing.assert_allclose(light, colour, rtol=0.1, atol=0.005 * max(colour))


def test_the_share_of_two_renders_is_found_or_given():
    """A render with 64 times the samples of the other one decides the result."""
    session = load_model(1, "fast", threads=1)
    few, many = (Render.from_arrays(f"{spp} spp", **layers(spp=spp, seed=spp)) for spp in (1, 64))
    found, by_spp, equal = (fuse(few, many, session, share=share).rgb for share in (None, 1 / 65, 0.5))
    assert error(found) < 0.7 * error(equal)
    assert error(by_spp) < 0.7 * error(equal)


def test_two_renders_without_noise_are_no_mistake():
    clean = picture(HEIGHT, WIDTH)
    first, second = (Render.from_arrays(name, rgb=clean) for name in ("a", "b"))
    np.testing.assert_array_equal(fuse(first, second, load_model(1, "fast", threads=1)).rgb, clean)


def test_renders_of_other_frames_are_doubted():
    first, second = (Render.from_arrays(f"seed {seed}", **layers(spp=16, seed=seed)) for seed in (1, 2))
    assert check_renders(first, second).warnings == []
    shifted = Render.from_arrays("b", rgb=np.roll(second.layers["rgb"], 9, axis=1))
    (warning,) = check_renders(first, shifted).warnings
    assert "shifted" in warning and "LRHS" not in warning


@pytest.mark.parametrize("sigma", [0, 0.5])
def test_one_render_tells_whether_its_noise_is_spread(sigma):
    rgb = layers()["rgb"]
    render = Render.from_arrays("hr", rgb=spread(rgb, sigma) if sigma else rgb)
    assert is_noise_spread(render, render, align(render, render)) == bool(sigma)


def test_columns_apart_are_two_pictures_whose_noise_is_independent_though_it_is_spread():
    noise = np.random.default_rng(1).normal(size=(200, 243)).astype(np.float32)
    wide = noise[:, :-2] + 4 * noise[:, 1:-1] + noise[:, 2:]
    correlation = {}
    for halves in (columns_apart, even_and_odd):
        cells = [box_downsample(half[:, :240], 4) for half in halves(wide)]
        correlation[halves] = np.corrcoef(*map(np.ravel, cells))[0, 1]
    assert abs(correlation[columns_apart]) < 0.2 < 0.4 < correlation[even_and_odd]
    ramp = np.broadcast_to(np.arange(11, dtype=np.float32)[:, None], (3, 11, 1))
    first, second = columns_apart(ramp)
    np.testing.assert_allclose(first[:, :9], ramp[:, :9])
    np.testing.assert_allclose(second[:, 2:], ramp[:, 2:])
    for width in (1, 2):  # has no second column
        assert (columns_apart(ramp[:, :width])[1] == ramp[:, width - 1 : width]).all()


def test_even_and_odd_pixels_are_two_pictures():
    plane = np.random.default_rng(0).normal(size=(31, 40)).astype(np.float32)
    even, odd = even_and_odd(plane)
    assert even[0, 0] == plane[0, 0] and odd[0, 1] == plane[0, 1]
    assert even[1, 2] == pytest.approx(plane[[0, 2, 1, 1], [2, 2, 1, 3]].mean(), abs=1e-6)
    assert abs(np.corrcoef(even.ravel(), odd.ravel())[0, 1]) < 0.1


@pytest.mark.parametrize("sigma", [0, 0.5])
def test_arrays_choose_their_model(sigma, monkeypatch):
    """By sizes, layers and noise; and the frame is that of the model."""
    from oiio_msspl.jobs import arrays

    chosen = []
    monkeypatch.setattr(
        arrays, "_load_once", lambda *given: chosen.append(given[:2]) or load_model(*given[:2], threads=1)
    )
    images = layers(spp=1)
    images["rgb"] = spread(images["rgb"], sigma) if sigma else images["rgb"]
    second = noisy(picture(HEIGHT, WIDTH), 1, seed=5)
    second = spread(second, sigma) if sigma else second
    aovs = {name: images[name] for name in ("albedo", "normal")}
    fused = fuse_arrays(images["rgb"], **aovs, quality="best")
    assert error(fused.rgb) < 0.4 * error(images["rgb"])
    fuse_arrays(images["rgb"], second, quality="best")
    fuse_arrays(hr=images["rgb"], lr=second[::2, ::2], **aovs, quality="fast")
    end = "-spread" if sigma else ""
    assert chosen[:2] == [(1, f"joint-large{end}"), (1, f"joint{end}")]
    assert chosen[2][0] == 2
    with pytest.raises(InputError, match="use one of fast, balanced, best"):
        fuse_arrays(images["rgb"], quality="good")


def test_a_variance_keeps_what_no_aov_shows():
    """Flakes that only the light shows stay, and noise does not come back."""
    rng = np.random.default_rng(3)
    clean = np.full((HEIGHT, WIDTH, 3), 0.4, np.float32)
    clean[:, 90:] *= rng.uniform(0.5, 1.5, (HEIGHT, WIDTH - 90, 1))
    samples = 64
    rendered = (clean * rng.gamma(samples, 1 / samples, (HEIGHT, WIDTH, 3))).astype(np.float32)
    variance = np.square(clean) / np.float32(samples)
    aovs = {"albedo": np.full_like(clean, 0.5), "normal": np.full_like(clean, 0.5)}
    kept, lost = fuse_arrays(rendered, **aovs, variance=variance), fuse_arrays(rendered, **aovs)
    flakes, wall = np.s_[8:-8, 98:-8], np.s_[8:-8, 8:50]
    rms = [[np.sqrt(np.square(i[part] - clean[part]).mean()) for part in (flakes, wall)] for i in (kept.rgb, lost.rgb)]
    assert lost.trust is None and kept.trust[flakes].mean() > 0.3 > 0.05 > kept.trust[wall].mean()
    assert rms[0][0] < 0.6 * rms[1][0] and rms[0][1] < 1.02 * rms[1][1]
    for untold in (np.zeros_like(variance), variance[..., :1]):  # of single samples, and of luminance
        assert fuse_arrays(rendered, **aovs, variance=untold).trust is None


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (3, 5), (33, 47)])
def test_any_size_will_do(size):
    session = load_model(1, "fast", threads=1)
    first, second = (Render.from_arrays(name, rgb=noisy(picture(*size), 4, seed)) for seed, name in enumerate("ab"))
    for low in (first, second):
        assert fuse(low, second, session).rgb.shape == (*size, 3)
