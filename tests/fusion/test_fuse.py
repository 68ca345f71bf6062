# SPDX-License-Identifier: Apache-2.0
import re

import numpy as np
import pytest

from oiio_msspl import find_model, fuse, map_render, open_exr
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.reader import ExrFile
from oiio_msspl.exr.render import Render, Window
from oiio_msspl.fusion.tiles import tiling
from oiio_msspl.fusion.tiles.features import FIREFLY_FACTOR
from oiio_msspl.fusion.tiles.guards import SMEAR
from oiio_msspl.fusion.tiles.network import INVISIBLE
from oiio_msspl.image.filters import max_around
from oiio_msspl.model.encoding import decode_radiance, encode_radiance, find_exposure
from oiio_msspl.model.session import Session
from tests.conftest import downsample, noisy, picture, rgb, write_exr


def pair_of(scale, height=96, width=128, **layers):
    clean = picture(height, width)
    low = Render.from_arrays("lr", rgb=noisy(downsample(clean, scale), 64))
    high = Render.from_arrays("hr", rgb=noisy(clean, 1, seed=1), **layers)
    return low, high, clean


@pytest.fixture(params=[2, 4, 8])
def scale(request):
    return request.param


@pytest.fixture
def session(bilinear_models, scale):
    return Session(bilinear_models[scale])


def test_the_result_has_the_size_of_the_hrls_and_the_light_of_the_lrhs(session, scale):
    low, high, clean = pair_of(scale)
    fused = fuse(low, high, session)
    assert fused.rgb.shape == clean.shape
    assert fused.rgb.mean() == pytest.approx(low.layers["rgb"].mean(), rel=0.1)


@pytest.mark.parametrize("rounded_up", [False, True])
def test_the_luminances_of_both_renders_show_the_same_places(session, scale, rounded_up):
    """A ramp tells where a pixel is in the frame, which has an odd width."""
    width = 128 + scale // 2 - 1 + (scale == 2)
    sizes = (96 // scale, 128 // scale + rounded_up), (96, width)
    low, high = (1 + np.broadcast_to(np.linspace(0, 1, 2 * w + 1)[1::2, None], (h, w, 3)) for h, w in sizes)
    fused = fuse(*renders(low, high), session)
    inside = np.s_[:, 1:-2]
    np.testing.assert_allclose(fused.lrhs_luminance[inside], fused.hrls_luminance[inside], rtol=1e-5)


def test_tiled_and_untiled_agree_to_half_rounding(session, scale, monkeypatch):
    """No seam: the tiled result differs from the whole by less than a half float can tell."""
    low, high, _ = pair_of(scale, 60 * scale, 90 * scale)
    whole = fuse(low, high, session)
    tiles_of(monkeypatch, session, (36 * scale) ** 2)
    tiny = fuse(low, high, session)
    assert tiny.tiles > 4
    np.testing.assert_allclose(tiny.rgb, whole.rgb, rtol=2**-11)


def test_a_half_result_is_the_float_result_rounded_and_counts_what_it_clips(session, scale, monkeypatch):
    low, high, _ = pair_of(scale, 60 * scale, 90 * scale)
    low.layers["rgb"][:20], high.layers["rgb"][: 20 * scale] = 1e5, 1e5
    tiles_of(monkeypatch, session, (36 * scale) ** 2)
    full, half = (fuse(low, high, session, half=half) for half in (False, True))
    assert half.rgb.dtype == np.float16
    assert half.tiles > 1
    assert half.clipped == np.count_nonzero(full.rgb > 65504) > 0 == full.clipped
    np.testing.assert_array_equal(half.rgb, np.minimum(full.rgb, 65504).astype(np.float16))


def tiles_of(monkeypatch, session, pixels):
    """Let tiles have at most this many HRLS pixels."""
    monkeypatch.setattr(tiling, "TILE_MEMORY", pixels * session.contract.bytes_per_pixel)


@pytest.mark.parametrize("family", ["joint-large", "joint", "joint-small", "paper"])
def test_the_result_depends_neither_on_memory_nor_on_threads(scale, family, monkeypatch, tmp_path):
    """In a frame of two tiles: bit for bit whether decoded rows are kept or decoded again, and to float32's rounding
    whatever the threads, because ONNX Runtime cuts its work by them."""
    session, on_two = (Session(find_model(scale, family), threads=count) for count in (1, 2))
    core = core_beyond_overlap(session)
    tiles_of(monkeypatch, session, (core + session.contract.overlap) * 32 * scale**2)
    low, high, _ = pair_of(scale, 32 * scale, 2 * core * scale)
    files = [map_render(open_exr(write_exr(tmp_path / r.name, rgb(r.layers["rgb"])))) for r in (low, high)]
    decode, decoded = ExrFile._decode, []
    monkeypatch.setattr(ExrFile, "_decode", lambda *given: decoded.append(given) or decode(*given))
    once = fuse(*files, session)
    kept = len(decoded)
    monkeypatch.setattr(tiling, "STRIPS_FRACTION", 0)
    again = fuse(*files, session)
    assert once.tiles == again.tiles == 2 and len(decoded) > 2 * kept
    np.testing.assert_array_equal(once.rgb, again.rgb)
    np.testing.assert_allclose(fuse(low, high, on_two).rgb, once.rgb, rtol=1e-5)


def core_beyond_overlap(session):
    """LRHS pixels of a core that is larger than the overlap: a smaller frame would be fused as a whole."""
    return (session.contract.overlap // 16 + 1) * 16


def test_memory_that_cannot_suffice_is_said(session, scale):
    low, high, _ = pair_of(scale)
    with pytest.raises(InputError, match=r"this frame needs more with model .*; allow at least 0\.4G"):
        fuse(low, high, session, max_memory=1000)


@pytest.mark.parametrize("factor", [2.0**-10, 2.0**10])
def test_scaling_the_scene_scales_the_output(session, scale, factor):
    low, high, _ = pair_of(scale)
    scaled = [Render.from_arrays(r.name, rgb=r.layers["rgb"] * np.float32(factor)) for r in (low, high)]
    np.testing.assert_allclose(fuse(*scaled, session).rgb, fuse(low, high, session).rgb * factor, rtol=1e-3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, -5.0])
def test_bad_values_are_repaired_and_counted_once(session, scale, bad, monkeypatch):
    """Overlapping tiles read a pixel several times; it is counted once."""
    low, high, _ = pair_of(scale, 60 * scale, 90 * scale, albedo=np.full((60 * scale, 90 * scale, 3), 0.5, np.float32))
    high.layers["rgb"][64:66, 64:66, 0] = bad
    high.layers["albedo"][10, 10] = bad
    low.layers["rgb"][2, 3, 1] = bad
    tiles_of(monkeypatch, session, (36 * scale) ** 2)
    fused = fuse(low, high, session)
    counts = {"lrhs.rgb": 1, "hrls.rgb": 4, "hrls.albedo": 3}
    # A finite negative is no broken pixel but a colour out of gamut, so it is counted apart.
    assert (fused.repaired, fused.negative) == (({}, counts) if bad == -5 else (counts, {}))
    assert np.isfinite(fused.rgb).all()
    assert (fused.rgb >= 0).all()


def test_an_albedo_that_is_broken_nearly_everywhere_is_told(session, scale):
    side = 40 * scale
    low, high, _ = pair_of(scale, side, side, albedo=np.full((side, side, 3), np.nan, np.float32))
    high.layers["albedo"][:4] = 0.5
    (warning,) = (text for text in fuse(low, high, session).warnings if "albedo is NaN" in text)
    assert warning.startswith("9") and "% of the HRLS's albedo is NaN or infinite" in warning


@pytest.mark.parametrize(("render", "value"), [("hrls", np.nan), ("hrls", np.inf), ("lrhs", np.inf)])
def test_a_bucket_that_failed_is_filled_from_the_other_render(render, value):
    """All layers are broken there. Black or infinity instead would leave a dark or a bright square."""
    session, side, bucket = Session(find_model(4, "joint")), 256, slice(96, 128)
    low, high, clean = pair_of(4, side, side, albedo=np.full((side, side, 3), 0.5, np.float32))
    expected = np.abs(fuse(low, high, session).rgb - clean)[bucket, bucket].mean()
    failed, part = (high, bucket) if render == "hrls" else (low, slice(24, 32))
    for values in failed.layers.values():
        values[part, part] = value
    fused = fuse(low, high, session)
    error = np.abs(fused.rgb - clean)[bucket, bucket].mean()
    assert error < 3 * expected
    assert not any("times as bright" in warning for warning in fused.warnings)


def test_a_lamp_that_overflows_in_both_renders_is_no_failed_bucket():
    low, high, _ = pair_of(4, 128, 128)
    for render, part in ((low, slice(12, 16)), (high, slice(48, 64))):
        render.layers["rgb"][part, part] = np.inf
    assert (fuse(low, high, Session(find_model(4, "joint"))).rgb[52:60, 52:60] > 6e4).all()


def test_a_failed_region_as_large_as_tiles_is_filled_from_the_lrhs(session, scale, monkeypatch):
    low, high, _ = pair_of(scale, 60 * scale, 90 * scale)
    high.layers["rgb"][:, 20 * scale :] = np.nan
    tiles_of(monkeypatch, session, (36 * scale) ** 2)
    fused = fuse(low, high, session)
    assert fused.tiles > 4
    assert fused.warnings == []
    lrhs, hrls = (image[:, 24:] for image in (fused.lrhs_luminance, fused.hrls_luminance))
    assert np.abs(hrls - lrhs).mean() < 0.1 * lrhs.mean()


def test_a_frame_of_nan_is_refused_however_many_tiles_it_has(session, scale, monkeypatch):
    low, high, _ = pair_of(scale, 60 * scale, 90 * scale)
    high.layers["rgb"][:] = np.nan
    tiles_of(monkeypatch, session, (36 * scale) ** 2)
    with pytest.raises(InputError, match=r"hr: the beauty is black \(or NaN\) everywhere, while that of lr is not"):
        fuse(low, high, session)


@pytest.mark.parametrize("family", ["joint-large", "joint-large-spread"])
def test_albedo_and_normal_without_noise(monkeypatch, family):
    """They are cleaner, tiles or not, and the beauty is the same bit for bit."""
    session = Session(find_model(2, family))
    albedo = 0.2 + 0.5 * picture(160, 224).clip(0, 1)
    clean = {"albedo": albedo, "normal": np.broadcast_to(np.float32([0, 0.6, 0.8]), (160, 224, 3))}
    rng = np.random.default_rng(0)
    layers = {name: (v + 0.05 * rng.standard_normal(v.shape)).astype(np.float32) for name, v in clean.items()}
    low, high, _ = pair_of(2, 160, 224, **layers)
    fused = fuse(low, high, session, clean_aovs=True)
    np.testing.assert_array_equal(fused.rgb, fuse(low, high, session).rgb)
    tiles_of(monkeypatch, session, 128 * 128)
    for result in (fused, fuse(low, high, session, clean_aovs=True)):
        for name, expected in clean.items():
            left = np.abs(result.clean_aovs[name].astype(np.float32) - expected).mean()
            assert left < 0.5 * np.abs(layers[name] - expected).mean(), name


@pytest.mark.parametrize("has_noise", [True, False])
def test_an_albedo_above_1_stays_as_it_is(has_noise):
    """Cycles writes the light of an emitter as its albedo."""
    albedo = np.full((64, 96, 3), 0.5, np.float32)
    albedo[20:30, 40:60] = (870, 0.5, 1e6)
    low, high, _ = pair_of(2, 64, 96, albedo=albedo)
    if not has_noise:
        for render in (low, high):
            render.layers["rgb"] = np.full_like(render.layers["rgb"], 0.25)
    found = fuse(low, high, Session(find_model(2, "joint-large")), clean_aovs=True).clean_aovs["albedo"]
    np.testing.assert_array_equal(found[20:30, 40:60], np.float16([[(870, 0.5, 65504)]]) + np.zeros((10, 20, 1)))


def test_albedo_and_normal_without_noise_show_what_the_hrls_has():
    """A frame that is black, or free of noise, keeps its own layers. A layer that is absent stays absent."""
    session = Session(find_model(2, "joint-large"))
    albedo = picture(64, 96).clip(0, 1)
    for light in (np.zeros((64, 96, 3), np.float32), np.full((64, 96, 3), 0.25, np.float32)):
        low, high = (
            Render.from_arrays("lr", rgb=downsample(light, 2)),
            Render.from_arrays("hr", rgb=light, albedo=albedo),
        )
        aovs = fuse(low, high, session, clean_aovs=True).clean_aovs
        assert aovs.keys() == {"albedo"}
        assert np.abs(aovs["albedo"] - albedo).mean() < 0.02
    assert not fuse(*pair_of(2)[:2], session, clean_aovs=True).clean_aovs


@pytest.mark.parametrize("value", [1e6, 1e20, 3e38])
def test_a_firefly_of_any_size_stays_where_it_is(session, scale, value):
    """One absurd pixel in each render: the rest of the frame keeps its brightness."""
    low, high, _ = pair_of(scale, 64 * scale, 64 * scale)
    expected = fuse(low, high, session).rgb
    high.layers["rgb"][5, 5] = value
    low.layers["rgb"][3, 3] = value
    fused = fuse(low, high, session).rgb
    assert np.isfinite(fused).all()
    far = slice(8 * scale, None)
    # The pixel changes the exposure, and with it the smallest channel of pure colours.
    np.testing.assert_allclose(fused[far, far], expected[far, far], rtol=0.05, atol=5e-4)


def test_a_pixel_that_the_lrhs_rules_out_is_dimmed_before_it_is_fused(session, scale):
    """A firefly of the HRLS alone changes the result no more than the brightest light that the LRHS allows."""
    low, high, _ = pair_of(scale, 32 * scale, 32 * scale)
    around = low.layers["rgb"][1:4, 1:4].max((0, 1))
    results = []
    for value in (FIREFLY_FACTOR * around, np.float32(1e9)):
        high.layers["rgb"][2 * scale, 2 * scale] = value
        results.append(fuse(low, high, session).rgb)
    np.testing.assert_array_equal(*results)


LAMP_ROWS, LAMP_COLUMNS = slice(45, 72), slice(67, 102)  # not along the borders of LRHS pixels


@pytest.mark.parametrize("family", ["joint-small", "paper"])
@pytest.mark.parametrize(("lamp", "room"), [(120, 0.002), (5000, 0.002), (60_000, 0.05), (1e7, 0.05)])
def test_a_lamp_is_as_bright_as_in_both_renders(scale, family, lamp, room):
    """However dark the room is: inside, along the rim, and where it is smaller than an LRHS pixel; without a halo."""
    clean = np.full((144, 192, 3), room, np.float32)
    low_clean, high = downsample(clean, scale), noisy(clean, 1, seed=1)
    clean[LAMP_ROWS, LAMP_COLUMNS] = lamp
    clean[121, 31] = lamp
    on = clean == lamp
    high[on] = lamp
    mean = downsample(clean.astype(np.float64), scale)
    low = np.where(mean > 2 * room, mean, noisy(low_clean, scale**2))
    fused = fuse(*renders(low, high), Session(find_model(scale, family))).rgb
    np.testing.assert_allclose(fused[on], lamp, rtol=1e-6)
    assert fused[~on].max() < 0.2 * 65504 * room / 0.18  # a fifth of the ceiling: what the networks themselves spread


def test_pixels_of_a_small_lamp_may_differ(session, scale):
    """It is smaller than an LRHS pixel, and a pixel at its rim shows a part of it. If the LRHS has less of it, the
    brighter pixel loses light."""
    clean = np.full((96, 128, 3), 0.05, np.float32)
    high, lamp = noisy(clean, 4), np.float32([3e4, 1e4])[:, None, None]
    for image in (clean, high):
        image[48:50, 64:65] = lamp
    for share, expected in ((1, (3e4, 1e4)), (0.8, (2.4e4, 1e4))):
        low = downsample(np.where(clean > 1, share * clean, clean), scale)
        fused = fuse(*renders(low, high), session).rgb[48:50, 64]
        np.testing.assert_allclose(fused, np.float32(expected)[:, None].repeat(3, axis=1), rtol=0.02)


def test_a_lamp_keeps_its_colour_where_one_channel_alone_is_bright(session, scale):
    clean = np.full((96, 128, 3), 0.05, np.float32)
    high, colour = noisy(clean, 4), np.float32([3000, 300, 0])
    clean[32:64, 32:64] = high[32:64, 32:64] = colour
    low = downsample(clean, scale)
    assert 300 < 4096 / find_exposure(low.astype(np.float32)) < 3000
    fused = fuse(*renders(low, high), session).rgb[32:64, 32:64]
    np.testing.assert_allclose(fused, np.broadcast_to(colour, fused.shape), rtol=1e-6)


def test_the_rim_of_a_lamp_is_whole_under_a_wide_pixel_filter(session, scale):
    """The LRHS's filter is as wide in its own pixels, so it is darker than the lamp along the rim."""
    lamp = np.zeros((144, 192, 3), np.float32)
    lamp[LAMP_ROWS, LAMP_COLUMNS] = 1e6
    high, low = (downsample(_blurred(lamp, pixel), pixel) + np.float32(0.05) for pixel in (1, scale))
    fused = fuse(*renders(low, high), session).rgb
    ceiling = 65504 / find_exposure(low.astype(np.float32))
    np.testing.assert_allclose(fused[high > ceiling], high[high > ceiling], rtol=0.06)
    assert fused[high < 0.1].max() <= 1.001 * ceiling


def _blurred(values, width):
    """Tent filter of two pixels of ``width``."""
    tent = np.convolve(np.ones(width), np.ones(width)) / width**2
    for axis in (0, 1):
        values = np.apply_along_axis(lambda line: np.convolve(line, tent, "same"), axis, values)
    return values


@pytest.mark.parametrize("in_lrhs", [False, True])
@pytest.mark.parametrize("place", ["room", "beside the lamp", "lamp"])
def test_a_firefly_in_one_render_alone_is_no_light(session, scale, in_lrhs, place):
    clean = np.full((96, 128, 3), 0.05, np.float32)
    clean[32:64, 32:64] = 1e5
    low, high = downsample(clean, scale), noisy(clean, 4)
    high[32:64, 32:64] = 1e5
    expected = fuse(*renders(low, high), session).rgb
    row, column = {"room": (16, 96), "beside the lamp": (48, 65), "lamp": (48, 48)}[place]
    (low if in_lrhs else high)[(row // scale, column // scale) if in_lrhs else (row, column)] = 1e9
    fused = fuse(*renders(low, high), session).rgb
    lamp = np.zeros(fused.shape[:2], bool)
    lamp[32:64, 32:64] = True
    np.testing.assert_allclose(fused[lamp], 1e5, rtol=1e-6)
    assert fused[~lamp].max() <= max(65504 / find_exposure(low.astype(np.float32)), expected[~lamp].max()) * 1.001


def renders(low, high):
    return [Render.from_arrays(name, rgb=values.astype(np.float32)) for name, values in (("lr", low), ("hr", high))]


@pytest.mark.parametrize("light", [1e-45, 1e-40, 1e-38])
def test_the_end_of_a_fade_stays_finite(scale, light):
    """Light so weak that the exposure would be infinite."""
    low = np.full((96 // scale, 128 // scale, 3), light, np.float32)
    high = low.repeat(scale, 0).repeat(scale, 1) * np.random.default_rng(0).integers(0, 3, (96, 128, 1))
    fused = fuse(*renders(low, high), Session(find_model(scale, "joint-small")))
    assert np.isfinite(np.float32(fused.exposure))
    assert np.isfinite(fused.rgb).all()
    assert fused.rgb.max() <= 4 * light


@pytest.mark.parametrize("light", [1e37, 1e38, 3e38])
@pytest.mark.parametrize("everywhere", [False, True])
@pytest.mark.filterwarnings("error")
def test_light_near_the_end_of_float32_is_fused(session, scale, light, everywhere):
    clean = picture(64 * scale, 64 * scale)
    if everywhere:
        clean *= np.float32(light / clean.max())
    else:
        clean[16:32, 16:32] = light
    fused = fuse(*renders(downsample(clean.astype(np.float64), scale), clean), session)
    assert np.isfinite(fused.rgb).all()
    assert fused.rgb.max() > 0.9 * light
    assert fused.warnings == []


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("what", ["colour", "error", "alpha"])
def test_a_network_that_fails_is_an_error_and_no_frame(bilinear_models, monkeypatch, bad, what):
    session = Session(bilinear_models[4])
    low, high, _ = pair_of(4)
    if what == "alpha":
        for render in (low, high):
            render.layers["alpha"] = np.full((*render.layers["rgb"].shape[:2], 1), 0.5, np.float32)
    run, calls = session.run, []

    def broken(*arrays, **more):
        calls.append(arrays)
        images = {name: image.copy() for name, image in run(*arrays, **more).items()}
        if len(calls) == (2 if what == "alpha" else 1):
            images["error" if what == "error" else "fused"][3, 5] = bad
        return images

    monkeypatch.setattr(session, "run", broken)
    with pytest.raises(MssplError, match="bilinear-x4 on CPUExecutionProvider returned NaN or infinite values"):
        fuse(low, high, session, error=what == "error")


def test_crop_regions_with_negative_origins(session, scale):
    """A region fused alone equals that region of the fused frame, away from its borders."""
    low, high, _ = pair_of(scale, 160, 160)
    whole = fuse(low, high, session).rgb
    region = Window(-3, 5, 83, 91)  # in a frame whose display window begins at (-40, -40)
    shown = Window(-40, -40, 120, 120)
    rows, columns = region.slices(shown)
    cropped = Render({"rgb": high.layers["rgb"][rows, columns]}, region, shown, name="hr")
    fused = fuse(low, cropped, session)
    inner = slice(4 * scale, -4 * scale)
    # The exposure follows the LRHS over the region, so values differ by the curve's rounding.
    np.testing.assert_allclose(fused.rgb[inner, inner], whole[rows, columns][inner, inner], rtol=0.05, atol=0.02)


def ramp_of(width, height, axis):
    """Values that grow from 0 to 1 along an axis, taken at pixel centres: the same picture at any size."""
    x, y = ((np.arange(n, dtype=np.float32) + 0.5) / n for n in (width, height))
    values = np.broadcast_to(x[None, :] if axis == "x" else y[:, None], (height, width))
    return np.repeat(values[..., None], 3, -1).copy()


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("rounding", ["up", "down"])
def test_odd_sizes_are_stretched_to_fit(session, scale, axis, rounding):
    """An LRHS of rounded size still covers the whole frame: its gradient is off by half an LRHS pixel at most."""
    width, height = 8 * scale + 1, 10 * scale + 1
    low_size = [n // scale + (rounding == "up") for n in (width, height)]
    truth = ramp_of(width, height, axis)
    low = Render.from_arrays("lr", rgb=ramp_of(*low_size, axis))
    fused = fuse(low, Render.from_arrays("hr", rgb=truth), session).rgb
    inner = slice(2 * scale, -2 * scale)
    half_lrhs_pixel = 0.5 / (low_size[0] if axis == "x" else low_size[1])
    # Interpolating the log curve instead of the values costs a little of its own.
    assert np.abs(fused - truth)[inner, inner].max() < half_lrhs_pixel + 0.01


def test_a_window_one_pixel_short_repeats_the_edge(session, scale):
    """An LRHS region rounded inwards ends one pixel before the grid: its last pixel goes on, not its first."""
    high = Render.from_arrays("hr", rgb=ramp_of(12 * scale, 12 * scale, "x"))
    whole = ramp_of(12, 12, "x")
    short = Window(0, 0, 11, 12)
    low = Render({"rgb": whole[:, :11]}, short, Window(0, 0, 12, 12), name="lr")
    fused = fuse(low, high, session).rgb
    assert fused[:, -1].min() > 0.85


def test_alpha_is_fused_and_exact_where_both_agree(session, scale):
    """Coverage comes from the LRHS where the HRLS is noisy, and is exactly 0 or 1 where both say so."""
    low, high, _ = pair_of(scale)
    y, x = np.mgrid[0:96, 0:128]
    coverage = np.clip((40 - np.hypot(x - 64, y - 48)) / 16, 0, 1).astype(np.float32)[..., None]
    rng = np.random.default_rng(3)
    high.layers["alpha"] = (rng.random(coverage.shape) < coverage).astype(np.float32)  # as at 1 spp
    low.layers["alpha"] = downsample(coverage, scale)
    alpha = fuse(low, high, session).alpha
    assert alpha.shape == coverage.shape
    error = {name: np.abs(a - coverage).mean() for name, a in (("fused", alpha), ("hrls", high.layers["alpha"]))}
    assert error["fused"] < 0.5 * error["hrls"]
    assert (alpha[47:49, 63:65] == 1).all()
    assert (alpha[:2, :2] == 0).all()
    assert alpha.min() >= 0
    assert alpha.max() <= 1


def test_alpha_is_exact_only_if_the_pixels_around_agree(bilinear_models):
    """Pixels near a soft edge get the network's alpha, and those further inside are exactly 1. A crisp edge stays."""
    low, high, _ = pair_of(4)
    coverage = np.zeros((96, 128, 1), np.float32)
    coverage[:, 64:] = 1
    high.layers["alpha"], low.layers["alpha"] = coverage, downsample(coverage, 4)
    session = Session(bilinear_models[4])
    assert (fuse(low, high, session).alpha == coverage).all()
    low.layers["alpha"][:, 15], low.layers["alpha"][:, 16] = 0.2, 0.8
    alpha = fuse(low, high, session).alpha[40, :, 0]
    assert 0 < alpha[59] < alpha[63] < alpha[64] < alpha[68] < 1
    assert (alpha[: 60 - SMEAR] == 0).all() and (alpha[68 + SMEAR :] == 1).all()
    low.layers["alpha"][:, 15], low.layers["alpha"][:, 16] = 0.005, 0.995
    alpha = fuse(low, high, session).alpha[40, :, 0]
    assert 0 < alpha[59] < INVISIBLE and 1 - INVISIBLE < alpha[68] < 1


def test_a_surface_is_solid_up_to_its_edge(scale):
    """The network makes the edge soft, as in the LRHS. Inside of the surface, both renders are sure."""
    session = Session(find_model(scale, "joint"))
    low, high, _ = pair_of(scale)
    coverage = np.zeros((96, 128, 1), np.float32)
    coverage[48:] = 1
    high.layers["alpha"], low.layers["alpha"] = coverage, downsample(coverage, scale)
    alpha = fuse(low, high, session).alpha
    assert (alpha[49:] == 1).all() and (alpha[:47] == 0).all()


def test_alpha_settles_only_where_both_renders_agree(session, scale):
    """An uncovered HRLS pixel under a partly covered LRHS pixel is a sample that missed."""
    low, high, _ = pair_of(scale)
    high.layers["alpha"] = np.zeros((96, 128, 1), np.float32)
    low.layers["alpha"] = np.zeros((96 // scale, 128 // scale, 1), np.float32)
    low.layers["alpha"][3, 3] = 0.5
    alpha = fuse(low, high, session).alpha
    under = np.zeros((96, 128, 1), bool)
    under[3 * scale : 4 * scale, 3 * scale : 4 * scale] = True
    assert (alpha[under] > 0).all() and not alpha[~max_around(under, SMEAR)].any()


def test_alpha_without_a_partner_is_passed_through_and_said(session, scale):
    low, high, _ = pair_of(scale)
    high.layers["alpha"] = np.full((96, 128, 1), 0.37, np.float32)
    fused = fuse(low, high, session)
    np.testing.assert_array_equal(fused.alpha, high.layers["alpha"])
    assert any("no alpha" in w for w in fused.warnings)


def test_nothing_glows_where_neither_render_has_light(scale):
    """A transparent film stays empty with the network that ships, whatever it says about black."""
    low, high, _ = pair_of(scale)
    low.layers["rgb"][:, : 64 // scale] = 0
    high.layers["rgb"][:, :64] = 0
    fused = fuse(low, high, Session(find_model(scale, "joint-small"))).rgb
    assert not fused[:, : 64 - scale].any()
    assert fused[:, 64:].mean() > 0.1


@pytest.mark.parametrize("black", ["LRHS", "HRLS"])
def test_a_dark_frame_in_which_one_render_found_no_light_is_fused(session, scale, black):
    low, high = np.zeros((96 // scale, 128 // scale, 3)), np.zeros((96, 128, 3))
    (high if black == "LRHS" else low)[5, 5] = 1e-4
    fused = fuse(*renders(low, high), session)
    assert np.isfinite(fused.rgb).all()
    assert fused.warnings == []


def test_two_black_frames_give_a_black_frame(scale):
    """A fade to black is a legitimate shot, also with the network that ships."""
    low, high, _ = pair_of(scale)
    low.layers["rgb"][:] = 0
    high.layers["rgb"][:] = 0
    fused = fuse(low, high, Session(find_model(scale, "joint-small")))
    assert not fused.rgb.any()
    assert "black" in fused.warnings[0]


@pytest.mark.parametrize(("factor", "noticed"), [(1.0, False), (1.2, False), (1.5, True), (0.4, True)])
def test_another_exposure_is_noticed(session, scale, factor, noticed):
    low, high, _ = pair_of(scale, 256, 256)
    other = Render.from_arrays("hr", rgb=high.layers["rgb"] * np.float32(factor))
    assert any("times as bright" in w for w in fuse(low, other, session).warnings) == noticed


def test_a_small_light_in_the_dark_is_no_other_exposure(session, scale):
    square = np.zeros((256, 256, 3), np.float32)
    square[96:112, 96:112] = 1
    fused = fuse(Render.from_arrays("lr", rgb=downsample(square, scale)), Render.from_arrays("hr", rgb=square), session)
    assert fused.warnings == []


@pytest.mark.parametrize("shift", [(0, 0), (1, 0), (0, -1), (2, 3)])
def test_a_shift_of_one_lrhs_pixel_is_noticed(session, scale, shift):
    """In the direction that is said, under the noise of 1 spp; and none is seen where there is none."""
    x, y = (n * scale for n in shift)
    clean = texture(80 * scale)
    low = Render.from_arrays("lr", rgb=noisy(downsample(clean, scale), 64))
    high = Render.from_arrays("hr", rgb=noisy(np.roll(clean, (y, x), (0, 1)), 1, seed=1))
    warnings = fuse(low, high, session).warnings
    assert len(warnings) == (shift != (0, 0))
    if warnings:
        found = re.search(r"([\d.]+) pixels to the (left|right) and ([\d.]+) pixels (up|down)", warnings[0])
        seen = (float(found[1]) * (-1) ** (found[2] == "left"), float(found[3]) * (-1) ** (found[4] == "up"))
        assert seen == pytest.approx((x, y), abs=0.2 * scale)


def texture(size):
    """A picture with structure of all sizes, (size, size, 3), the same at any size."""
    y, x = (np.mgrid[0:size, 0:size] + 0.5) / size
    waves = sum(np.sin(2 * np.pi * (k * x + (4 - k) * y) + k * k) for k in range(-3, 6))
    return np.repeat(np.exp(0.3 * waves)[..., None], 3, -1).astype(np.float32)


def test_tiles_average_the_renders_alike(scale, monkeypatch):
    """The left half has its noise in the HRLS, the right half in the LRHS. Both tiles get the same shares, of colour,
    AOVs and alpha, and the same values where they overlap."""
    session, calls = Session(find_model(scale, "joint")), []
    run = session.run

    def recorded(lrhs, hrls, exposure, shares, **options):
        calls.append((lrhs, exposure, shares))
        return run(lrhs, hrls, exposure, shares, **options)

    monkeypatch.setattr(session, "run", recorded)
    core, overlap = core_beyond_overlap(session), session.contract.overlap
    tiles_of(monkeypatch, session, (core + overlap) * 32 * scale**2)
    low, high, clean = pair_of(scale, 32 * scale, 2 * core * scale)
    half = core * scale
    low.layers["rgb"][:, :core] = downsample(clean, scale)[:, :core]
    low.layers["rgb"][:, core:] = noisy(downsample(clean, scale), scale**2)[:, core:]
    high.layers["rgb"][:, half:] = clean[:, half:]
    # The AOVs of the left half are those of another picture.
    high.layers["albedo"] = high.layers["normal"] = np.clip(clean, 0, 1)
    aov = downsample(high.layers["albedo"], scale)
    low.layers["albedo"] = low.layers["normal"] = np.concatenate([1 - aov[:, :core], aov[:, core:]], axis=1)
    low.layers["alpha"], high.layers["alpha"] = (r.layers["rgb"].clip(0.01, 0.99)[..., :1] for r in (low, high))
    assert fuse(low, high, session).tiles == 2
    shared = slice(core - overlap + 1, core + overlap - 1)  # fireflies at the first and last column see less around
    for (first, *numbers), (second, *others) in zip(calls[:2], calls[2:], strict=True):
        assert numbers == others and 0.05 <= numbers[1]["rgb"] <= 0.95
        for name in session.contract.lrhs:
            np.testing.assert_array_equal(first[name][:, shared], second[name][:, 1 : 2 * overlap - 1])


@pytest.mark.parametrize("family", ["joint", "joint-small", "paper"])
def test_the_shipped_overlap_hides_the_seams(scale, family, monkeypatch):
    """Steps between pixels are no larger across the borders of tiles than they are in the frame fused as a whole."""
    shipped = Session(find_model(scale, family))
    core = core_beyond_overlap(shipped)
    side = core + shipped.contract.overlap
    low, high, _ = pair_of(scale, 2 * core * scale, 2 * core * scale)
    whole = fuse(low, high, shipped)
    tiles_of(monkeypatch, shipped, (side * scale) ** 2)
    tiled = fuse(low, high, shipped)
    assert (whole.tiles, tiled.tiles) == (1, 4)
    border = core * scale
    difference = np.abs(tiled.rgb - whole.rgb) / (whole.rgb + 0.01)
    assert seam(tiled, border) < 1.1 * seam(whole, border)
    # joint-small computes with fewer codes, so rounding differs more between a tile and the whole frame
    assert np.quantile(difference, 0.9) < (0.025 if family == "joint-small" else 0.02)


def seam(fused, border):
    """Mean step across the middle row and column by the mean step across the rows and columns near them."""
    image = encode_radiance(fused.rgb, fused.exposure)
    steps = [np.abs(np.diff(image.swapaxes(0, axis), axis=0)).mean((1, 2)) for axis in (0, 1)]
    return float(np.mean([s[border - 1] / np.delete(s[border - 9 : border + 8], 8).mean() for s in steps]))


def test_progress_counts_tiles(session, scale, monkeypatch):
    low, high, _ = pair_of(scale, 60 * scale, 90 * scale)
    seen = []
    tiles_of(monkeypatch, session, (36 * scale) ** 2)
    fused = fuse(low, high, session, progress=lambda done, count: seen.append((done, count)))
    assert seen == [(i + 1, fused.tiles) for i in range(fused.tiles)]


def test_a_firefly_of_the_lrhs_is_dimmed_to_what_the_hrls_allows(session, scale):
    low, high, _ = pair_of(scale, 64 * scale, 64 * scale)
    brightest = downsample(high.layers["rgb"], scale)[2:5, 2:5].max(axis=(0, 1))
    low.layers["rgb"][3, 3] = FIREFLY_FACTOR * brightest
    expected = fuse(low, high, session).rgb
    low.layers["rgb"][3, 3] = 1e6
    # The pixel changes the exposure, and with it the smallest channel of pure colours.
    np.testing.assert_allclose(fuse(low, high, session).rgb, expected, rtol=0.05, atol=5e-4)


def test_empty_tiles_never_reach_the_network(session, scale, monkeypatch):
    """Half of the frame is an empty film: the tiles there cost nothing, the others are as ever."""
    low, high, _ = pair_of(scale, 32 * scale, 128 * scale)
    low.layers["rgb"][:, : low.layers["rgb"].shape[1] // 2] = 0
    high.layers["rgb"][:, : high.layers["rgb"].shape[1] // 2] = 0
    whole = fuse(low, high, session)
    calls = []
    run = session.run
    monkeypatch.setattr(session, "run", lambda *arrays, **more: calls.append(arrays) or run(*arrays, **more))
    tiles_of(monkeypatch, session, (36 * scale) ** 2)
    calls.clear()
    tiled = fuse(low, high, session)
    assert 0 < len(calls) < tiled.tiles
    np.testing.assert_allclose(tiled.rgb, whole.rgb, rtol=1e-5, atol=1e-6)


def test_a_surface_that_hardly_a_sample_lights_has_no_holes(bilinear_models, monkeypatch):
    """Black in both renders, 3 x 3 LRHS pixels around included: empty where nothing is, dark where a surface is, unless
    there is no light far around either."""
    session = Session(bilinear_models[4])
    monkeypatch.setattr(session, "run", lambda lrhs, hrls, *_, **more: {"fused": np.full_like(hrls["rgb"], 0.3)})
    low, high = np.zeros((32, 64, 3), np.float32), np.zeros((128, 256, 3), np.float32)
    low[::8, :32:8], high[::32, :128:32] = 1.0, 1.0  # a sample in 64 finds light; right half: none
    surface = np.zeros_like(high)
    surface[:64] = (0, 0, 1)

    def empty(**layers):
        fused = fuse(Render.from_arrays("lr", rgb=low), Render.from_arrays("hr", rgb=high, **layers), session).rgb
        return (fused == 0).all(-1)

    for layers in ({"normal": surface}, {"alpha": surface[..., 2:]}):
        found = empty(**layers)
        assert not found[:64, :128].any()
        assert found[64:, :128].mean() > 0.5
        assert found[:, 192:].all()
    assert empty()[:, :128].mean() > 0.5  # nothing tells


def test_where_both_renders_agree_the_hrls_is_the_result(bilinear_models):
    """Nothing is filtered that has no noise; a single pixel that has some is enough to filter its tile."""
    clean = np.maximum(picture(64, 96), 1e-3)
    session = Session(bilinear_models[4])
    low = Render.from_arrays("lr", rgb=downsample(clean, 4))
    fused = fuse(low, Render.from_arrays("hr", rgb=clean), session, error=True)
    np.testing.assert_allclose(fused.rgb, clean, rtol=1e-4)
    assert not fused.error.any()
    noisy_one = clean.copy()
    noisy_one[30, 40] *= 1.5
    assert np.abs(fuse(low, Render.from_arrays("hr", rgb=noisy_one), session).rgb - clean).mean() > 1e-3


def test_the_error_is_told_as_radiance_where_asked_for(bilinear_models):
    """The models expect 0.1 in network values."""
    low, high, _ = pair_of(4)
    session = Session(bilinear_models[4])
    assert fuse(low, high, session).error is None
    fused = fuse(low, high, session, error=True)
    middle = encode_radiance(fused.rgb, fused.exposure).mean(-1, keepdims=True)
    brighter = decode_radiance(middle + 0.1, fused.exposure)
    np.testing.assert_allclose(fused.error, brighter - decode_radiance(middle, fused.exposure), rtol=1e-3)


def test_a_model_that_predicts_no_error_says_so():
    low, high, _ = pair_of(4)
    with pytest.raises(InputError, match="paper-x4 does not predict its error; choose another --model"):
        fuse(low, high, Session(find_model(4, "paper")), error=True)


@pytest.mark.parametrize("size", [(1, 32), (32, 1), (2, 2)])
def test_the_smallest_frames_are_fused(size):
    rng = np.random.default_rng(0)
    low, high = (rng.random((n * size[0], n * size[1], 3), np.float32) for n in (1, 2))
    fused = fuse(Render.from_arrays("lr", rgb=low), Render.from_arrays("hr", rgb=high), Session(find_model(2)))
    assert np.isfinite(fused.rgb).all() and fused.rgb.shape == high.shape


def test_alpha_does_not_depend_on_layers_of_light():
    """Though `paper` reads them beside the beauty."""
    rng, session = np.random.default_rng(0), Session(find_model(2, "paper"))
    alpha = rng.random((64, 96, 1), np.float32)
    low = Render.from_arrays("lr", rgb=downsample(picture(64, 96), 2).astype(np.float32), alpha=alpha[::2, ::2])
    light = {name: noisy(picture(64, 96), 1) for name in ("diffuse", "specular")} | {"variance": alpha}
    one, other = (
        fuse(low, Render.from_arrays("hr", rgb=picture(64, 96), alpha=alpha, **layers), session).alpha
        for layers in ({}, light)
    )
    np.testing.assert_array_equal(one, other)


def detailed_pair(side=128):
    """A checker that no AOV shows, with hardly any noise."""
    y, x = np.mgrid[:side, :side]
    clean = picture(side, side) * (1 + 0.4 * (-1.0) ** (x + y))[..., None]
    low, high = (noisy(values, 4000, seed=seed) for seed, values in enumerate((downsample(clean, 2), clean)))
    return renders(low, high), clean


def test_detail_that_both_renders_show_comes_back_unless_it_is_not_wanted():
    pair, clean = detailed_pair()
    session = Session(find_model(2, "joint-small"))
    trusted, alone = fuse(*pair, session), fuse(*pair, session, trust=False)
    errors = [np.abs(frame.rgb - clean).mean() / clean.mean() for frame in (trusted, alone)]
    assert errors[0] < 0.05 < 0.2 < errors[1]
    assert trusted.trust.shape == (64, 64) and trusted.trust.mean() > 0.8
    assert trusted.trust_pixels().shape == (128, 128, 1)
    assert alone.trust is None and not alone.trust_pixels().any()


def test_what_comes_back_has_no_seam_between_tiles(monkeypatch):
    pair, _ = detailed_pair(256)
    session = Session(find_model(2, "joint-small"))
    whole = fuse(*pair, session)
    tiles_of(monkeypatch, session, 192 * 192)
    tiled = fuse(*pair, session)
    assert tiled.tiles > 1
    assert np.abs(tiled.rgb - whole.rgb).max() < 0.02 * whole.rgb.max()


def test_an_lrhs_with_the_noise_of_the_hrls_brings_no_noise_back():
    clean = picture(256, 256)
    high = noisy(clean, 4)
    pair = renders(downsample(high, 2), high)
    frame = fuse(*pair, Session(find_model(2, "joint-small")))
    assert frame.trust is None
    assert any("the LRHS has the noise of the HRLS" in warning for warning in frame.warnings)


def cropped(render):
    """A render whose data window is the box around what is not empty."""
    rows, columns = (np.flatnonzero(render.layers["alpha"].any(axis=(axis, 2))) for axis in (1, 0))
    window = Window(int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1)
    layers = {name: image[window.slices(render.data_window)] for name, image in render.layers.items()}
    return Render(layers, window, render.display_window, name=render.name)


def test_renders_that_are_cropped_to_what_is_not_empty_are_fused(session, scale):
    """A soft-edged object before an empty film. Noise decides where each render ends: here the LRHS ends first."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[: 48 * scale, : 64 * scale] / scale
    cover = 1 / (1 + np.exp((np.hypot(y - 24, x - 32) - 12) / 2))[..., None]
    share = downsample(cover, scale)
    masks = np.where(share > 0.4 / scale**2, share, 0), rng.binomial(4, cover) / 4
    whole = [
        Render.from_arrays(name, rgb=(mask * np.array([0.8, 0.5, 0.3])).astype(np.float32), alpha=mask)
        for name, mask in zip(("lr", "hr"), masks, strict=True)
    ]
    low, high = (cropped(render) for render in whole)
    assert low.data_window.x0 * scale > high.data_window.x0 + scale
    fused, expected = fuse(low, high, session), fuse(*whole, session)
    inside = high.data_window.slices(whole[1].data_window)
    assert fused.warnings == []
    np.testing.assert_allclose(fused.rgb, expected.rgb[inside], atol=0.02)
    np.testing.assert_allclose(fused.alpha, expected.alpha[inside], atol=0.02)


@pytest.mark.parametrize("family", ["joint", "joint-large", "joint-clean"])
def test_a_room_lit_in_blue_keeps_its_light(family):
    """Exposed by its luminance, which is small, it lost a quarter."""
    spp = 64 if family.endswith("clean") else 4
    rows, columns = np.mgrid[:128, :128] // 16
    truth = np.zeros((128, 128, 3), np.float32)
    truth[..., 2] = 0.1 + 0.2 * ((rows + columns) % 2)
    aovs = {"albedo": 2 * truth, "normal": np.full_like(truth, 0.5)}
    high = Render.from_arrays("hr", rgb=noisy(truth, spp, 1), **aovs)
    low = Render.from_arrays("lr", rgb=noisy(downsample(truth, 2), 4 * spp, 2))
    fused = fuse(low, high, Session(find_model(2, family)), trust=False).rgb
    assert fused[..., 2].mean() == pytest.approx(truth[..., 2].mean(), rel=0.03)
