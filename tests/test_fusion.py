# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from oiio_msspl import fuse
from oiio_msspl.errors import InputError
from oiio_msspl.render import Render, Window
from oiio_msspl.session import Session
from tests.conftest import downsample, noisy, picture


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


def test_tiled_and_untiled_agree_to_half_rounding(session, scale):
    """No seam: the tiled result differs from the whole by less than a half float can tell."""
    low, high, _ = pair_of(scale, 60 * scale, 90 * scale)
    whole = fuse(low, high, session)
    tiny = fuse(low, high, session, max_memory=_memory_for_tiles(low, high, session, (36 * scale) ** 2))
    assert tiny.tiles > 4
    np.testing.assert_allclose(tiny.rgb, whole.rgb, rtol=2**-11)


def _memory_for_tiles(low, high, session, pixels):
    from oiio_msspl.fusion import FIXED_MEMORY

    frame = high.layers["rgb"].nbytes * 4 // 3 + 2 * low.layers["rgb"].nbytes
    return FIXED_MEMORY + frame + pixels * session.contract.bytes_per_pixel


def test_memory_that_cannot_suffice_is_said(session, scale):
    low, high, _ = pair_of(scale)
    with pytest.raises(InputError, match=r"this frame alone takes .* GiB; allow at least"):
        fuse(low, high, session, max_memory=1000)


@pytest.mark.parametrize("factor", [2.0**-10, 2.0**10])
def test_scaling_the_scene_scales_the_output(session, scale, factor):
    low, high, _ = pair_of(scale)
    scaled = [Render.from_arrays(r.name, rgb=r.layers["rgb"] * np.float32(factor)) for r in (low, high)]
    np.testing.assert_allclose(fuse(*scaled, session).rgb, fuse(low, high, session).rgb * factor, rtol=1e-3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, -5.0])
def test_bad_values_are_repaired_and_counted_once(session, scale, bad):
    """Overlapping tiles read a pixel several times; it is counted once."""
    low, high, _ = pair_of(scale, 60 * scale, 90 * scale, albedo=np.full((60 * scale, 90 * scale, 3), 0.5, np.float32))
    high.layers["rgb"][64:66, 64:66, 0] = bad
    high.layers["albedo"][10, 10] = bad
    low.layers["rgb"][2, 3, 1] = bad
    fused = fuse(low, high, session, max_memory=_memory_for_tiles(low, high, session, (36 * scale) ** 2))
    assert fused.repaired == {"lrhs.rgb": 1, "hrls.rgb": 4, "hrls.albedo": 3}
    assert np.isfinite(fused.rgb).all()
    assert (fused.rgb >= 0).all()


def test_fireflies_stay_finite(session, scale):
    low, high, _ = pair_of(scale)
    high.layers["rgb"][5, 5] = 1e6
    low.layers["rgb"][3, 3] = 1e6
    assert np.isfinite(fuse(low, high, session).rgb).all()


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


def test_odd_sizes_are_stretched_to_fit(session, scale):
    """An LRHS rounded down still covers the whole frame: its gradient lands where the HRLS has it."""
    width, height = 16 * scale + 1, 12 * scale + 1
    ramp = np.repeat(((np.arange(width) + 0.5) / width)[None, :, None], height, 0).repeat(3, 2).astype(np.float32)
    columns = width // scale
    low = (np.arange(columns) + 0.5) / columns
    low = np.repeat(low[None, :, None], height // scale, 0).repeat(3, 2).astype(np.float32)
    fused = fuse(Render.from_arrays("lr", rgb=low), Render.from_arrays("hr", rgb=ramp), session).rgb
    middle = slice(2 * scale, -2 * scale)
    np.testing.assert_allclose(fused[:, middle], ramp[:, middle], rtol=0.05, atol=0.003)


def test_alpha_is_fused_and_exact_where_both_agree(session, scale):
    low, high, _ = pair_of(scale)
    y, x = np.mgrid[0:96, 0:128]
    coverage = (((x - 64) ** 2 + (y - 48) ** 2) < 900).astype(np.float32)[..., None]
    high.layers["alpha"] = coverage
    low.layers["alpha"] = downsample(coverage, scale)
    alpha = fuse(low, high, session).alpha
    assert alpha.shape == coverage.shape
    assert alpha[48, 64, 0] == 1
    assert alpha[0, 0, 0] == 0
    assert alpha.min() >= 0
    assert alpha.max() <= 1
    assert abs(alpha.mean() - coverage.mean()) < 0.03


def test_alpha_without_a_partner_is_passed_through_and_said(session, scale):
    low, high, _ = pair_of(scale)
    high.layers["alpha"] = np.full((96, 128, 1), 0.37, np.float32)
    fused = fuse(low, high, session)
    np.testing.assert_array_equal(fused.alpha, high.layers["alpha"])
    assert any("no alpha" in w for w in fused.warnings)


def test_a_black_beauty_is_refused(session, scale):
    low, high, _ = pair_of(scale, albedo=np.ones((96, 128, 3), np.float32))
    high.layers["rgb"][:] = 0
    with pytest.raises(InputError, match="hr: the beauty is black everywhere, while that of lr is not"):
        fuse(low, high, session)


def test_two_black_frames_give_a_black_frame(session, scale):
    """A fade to black is a legitimate shot."""
    low, high, _ = pair_of(scale)
    low.layers["rgb"][:] = 0
    high.layers["rgb"][:] = 0
    fused = fuse(low, high, session)
    assert not fused.rgb.any()
    assert "black" in fused.warnings[0]


def test_another_exposure_or_frame_is_noticed(session, scale):
    low, high, _ = pair_of(scale, 256, 256)
    assert fuse(low, high, session).warnings == []
    brighter = Render.from_arrays("hr", rgb=high.layers["rgb"] * 4)
    assert any("times as bright" in w for w in fuse(low, brighter, session).warnings)
    other = Render.from_arrays("hr", rgb=np.ascontiguousarray(high.layers["rgb"][::-1, ::-1]))
    assert any("hardly look alike" in w for w in fuse(low, other, session).warnings)


def test_a_model_of_another_scale_is_refused(bilinear_models):
    low, high, _ = pair_of(4)
    with pytest.raises(InputError, match="bilinear-x2 is for x2, but this pair is x4"):
        fuse(low, high, Session(bilinear_models[2]))


def test_progress_counts_tiles(session, scale):
    low, high, _ = pair_of(scale, 60 * scale, 90 * scale)
    seen = []
    memory = _memory_for_tiles(low, high, session, (36 * scale) ** 2)
    fused = fuse(low, high, session, max_memory=memory, progress=lambda done, count: seen.append((done, count)))
    assert seen == [(i + 1, fused.tiles) for i in range(fused.tiles)]
