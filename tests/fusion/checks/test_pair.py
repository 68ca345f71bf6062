# SPDX-License-Identifier: Apache-2.0
"""Right pairs fit, wrong ones are noticed: on pictures of rectangles with albedo, normals, light and noise of 4 spp."""

from dataclasses import replace

import numpy as np
import pytest

from oiio_msspl.errors import InputError
from oiio_msspl.exr.render import Render, Window
from oiio_msspl.fusion.checks.averages import HrlsAverages
from oiio_msspl.fusion.checks.colours import different_colours
from oiio_msspl.fusion.checks.framing import Framing, central_area, find_framing
from oiio_msspl.fusion.checks.pair import check_renders
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.fusion.tiles.features import read_tile
from oiio_msspl.fusion.tiles.tiling import Tile
from oiio_msspl.image.colour import ACES2065, ACESCG, P3, REC709, conversion, luminance, srgb
from oiio_msspl.image.filters import interpolate
from tests.conftest import downsample, noisy

#: Height and width of the LRHS.
LOW = (64, 96)


@pytest.fixture(params=[2, 4, 8])
def scale(request):
    return request.param


def scene(scale, seed=0, size=LOW):
    """Colour, albedo and normal, (h, w, 3) each, of coloured rectangles in the light of a window."""
    rng = np.random.default_rng(seed)
    height, width = (n * scale for n in size)
    albedo, normal = np.full((height, width, 3), 0.5), np.zeros((height, width, 3))
    normal[..., 2] = 1
    for _ in range(60):
        y, x = rng.integers(0, height), rng.integers(0, width)
        rows, columns = slice(y, y + rng.integers(4, 20) * scale), slice(x, x + rng.integers(4, 20) * scale)
        albedo[rows, columns] = rng.uniform(0.05, 0.95, 3)
        direction = rng.normal(size=3)
        normal[rows, columns] = direction / np.linalg.norm(direction)
    light = 0.3 + np.maximum(normal @ (0.5, 0.5, 0.7), 0) * np.linspace(1, 2, width)[:, None].T
    return tuple(v.astype(np.float32) for v in (albedo * light[..., None], albedo, normal))


def pair(scale, seed=0, **changed):
    """A right pair with 4 spp in the HRLS and as many samples in the LRHS; ``changed`` replaces layers, ``lr`` the
    LRHS."""
    colour, albedo, normal = scene(scale, seed)
    low = noisy(downsample(colour, scale), 4 * scale**2, seed + 100)
    layers = {"rgb": noisy(colour, 4, seed + 200), "albedo": albedo, "normal": normal}
    lr = changed.pop("lr", low)
    high = Render.from_arrays("hr", **{k: np.ascontiguousarray(v, np.float32) for k, v in (layers | changed).items()})
    return Render.from_arrays("lr", rgb=np.ascontiguousarray(lr, np.float32)), high


def warnings_of(low, high):
    return check_renders(low, high).warnings


def warnings(scale, seed=0, **changed):
    return warnings_of(*pair(scale, seed, **changed))


@pytest.mark.parametrize("seed", range(8))
def test_a_right_pair_fits(scale, seed):
    assert warnings(scale, seed) == []


@pytest.mark.parametrize("period", [4, 8, 16])
def test_boards_of_one_width_belong_to_the_picture(period):
    """Their albedo fits as well when it is shifted by a board, or along the boards."""
    assert warnings_of_boards(period, turned=False) == []


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_picture_without_edges_says_nothing_of_the_albedo():
    _, albedo, _ = scene(2)
    grey = np.full_like(albedo, 0.5)
    low, high = Render.from_arrays("lr", rgb=grey[::2, ::2].copy()), Render.from_arrays("hr", rgb=grey, albedo=albedo)
    assert warnings_of(low, high) == []


def test_boards_that_run_the_other_way_do_not():
    (warning,) = warnings_of_boards(16, turned=True)
    assert "the albedo's edges are not in the picture" in warning


def warnings_of_boards(period, *, turned):
    """Those of a picture of boards, so many pixels wide, whose albedo may run the other way."""
    colour, albedo, normal = scene(2)

    def boards(axis):
        dark = (np.arange(albedo.shape[axis]) % (2 * period) < period)[:, None]
        stripes = np.where(dark, np.float32(0.8), np.float32([0.3, 0.2, 0.1]))
        return np.ascontiguousarray(np.broadcast_to(np.expand_dims(stripes, 1 - axis), albedo.shape))

    picture = boards(1) * colour / albedo
    low, high = noisy(downsample(picture, 2), 16, 2), noisy(picture, 4, 1)
    return warnings_of(
        Render.from_arrays("lr", rgb=np.ascontiguousarray(low, np.float32)),
        Render.from_arrays(
            "hr", rgb=np.ascontiguousarray(high, np.float32), albedo=boards(0 if turned else 1), normal=normal
        ),
    )


def test_a_right_pair_fits_whatever_tiles_it_is_read_in(scale, monkeypatch):
    monkeypatch.setattr("oiio_msspl.fusion.checks.pair.PIXELS_PER_READ", 30 * 30 * scale**2)
    assert warnings(scale) == []


def test_aovs_are_averaged_over_the_area_that_is_compared(scale, monkeypatch):
    for module in ("framing", "averages"):
        monkeypatch.setattr(f"oiio_msspl.fusion.checks.{module}.AREA", 40)
    lr, hr = pair(scale)
    alignment = align(lr, hr)
    averages = HrlsAverages(alignment)
    lrhs = {"rgb": lr.layers["rgb"]}
    for tile in (Window(x, y, x + 32, y + 16) for y in range(0, LOW[0], 16) for x in range(0, LOW[1], 32)):
        features = ["rgb", "albedo", "normal"]
        averages.add(read_tile(Tile(tile, tile), lrhs, alignment.grid, hr, alignment, features))
    expected = central_area(luminance(downsample(hr.layers["albedo"], scale)))
    assert expected.shape == averages.aovs["normal"].shape == (40, 40)
    np.testing.assert_allclose(averages.aovs["albedo"], expected, rtol=1e-5)


@pytest.mark.parametrize("how", ["box", "nearest"])
def test_an_lrhs_made_from_the_hrls_is_noticed(scale, how):
    """It has the HRLS's noise, so the result would keep it."""
    high = pair(scale)[1].layers["rgb"]
    made = downsample(high, scale) if how == "box" else high[scale // 2 :: scale, scale // 2 :: scale]
    assert any("the LRHS has the noise of the HRLS" in w for w in warnings(scale, lr=made))


def gaussian(image, scale):
    """An image scaled down with a Gaussian filter that reaches over three pixels of the result."""
    for axis in (0, 1):
        places = (np.arange(image.shape[axis] // scale) + 0.5) * scale - 0.5
        weights = np.exp(-2 * np.square((np.arange(image.shape[axis]) - places[:, None]) / (1.5 * scale)))
        weights[np.abs(np.arange(image.shape[axis]) - places[:, None]) > 1.5 * scale] = 0
        image = np.moveaxis(np.tensordot(weights / weights.sum(1, keepdims=True), image, (1, axis)), 0, axis)
    return image


def test_an_lrhs_scaled_down_with_a_wide_filter_is_noticed(scale):
    """Every pixel shares noise with its neighbours, so it differs from the mean of its own HRLS pixels."""
    made = gaussian(pair(scale)[1].layers["rgb"], scale)
    assert any("the LRHS has the noise of the HRLS" in w for w in warnings(scale, lr=made))


@pytest.mark.parametrize("spp", [64, 1024])
def test_texture_is_not_taken_for_the_noise_of_both(spp):
    """Hair at many samples: nearly all that differs between neighbours is in both renders."""
    rng = np.random.default_rng(3)
    hair = np.repeat(rng.exponential(0.5, (128, 256)), 2, axis=0)[..., None].repeat(3, -1).astype(np.float32) + 0.02
    low, high = noisy(downsample(hair, 2), 4 * spp), noisy(hair, spp, seed=1)
    assert warnings_of(Render.from_arrays("lr", rgb=low), Render.from_arrays("hr", rgb=high)) == []


def test_a_colour_that_repeats_is_no_shared_noise():
    """Of a translucent smear, samples hit or miss, so that few values occur."""
    rng = np.random.default_rng(0)
    cover = np.broadcast_to(np.linspace(0, 0.6, 256), (256, 256))
    low, high = (rng.binomial(4, v)[..., None] / 4 * np.array([0.8, 0.5, 0.3]) for v in (cover[::2, ::2], cover))
    low, high = (Render.from_arrays("r", rgb=v.astype(np.float32)) for v in (low, high))
    assert warnings_of(low, high) == []


def test_two_renders_without_noise_share_none(scale):
    colour, *_ = scene(scale)
    assert warnings(scale, lr=downsample(colour, scale), rgb=colour) == []


def test_a_tighter_crop_is_noticed(scale):
    """By 3 %, and which of the two renders has it."""
    image = pair(scale)[0].layers["rgb"]
    for axis in (0, 1):
        middle = (image.shape[axis] - 1) / 2
        image = interpolate(image, (np.arange(image.shape[axis]) - middle) * 0.97 + middle, axis)
    (warning,) = [w for w in warnings(scale, lr=image) if "tighter" in w]
    assert warning.startswith("the LRHS is framed")
    assert 2.5 < float(warning.split(" %")[0].split()[-1]) < 3.5


@pytest.mark.parametrize(
    ("axes", "how"), [((1,), "from left to right"), ((0,), "from top to bottom"), ((0, 1), "turned by 180 degrees")]
)
def test_a_mirrored_render_is_noticed(scale, axes, how):
    (warning,) = warnings(scale, lr=np.flip(pair(scale)[0].layers["rgb"], axes))
    assert "one of the two renders is mirrored" in warning and how in warning


def test_two_scenes_are_no_pair(scale):
    alike_by_chance, foreign = (downsample(scene(scale, seed)[0][:, ::-1], scale) for seed in (50, 60))
    (warning,) = warnings(scale, lr=alike_by_chance)
    assert warning.startswith("the two renders hardly look alike (correlation 0.1")
    with pytest.raises(InputError, match=r"nothing in common \(correlation -?0.\d+, where their noise lets expect 0.9"):
        warnings(scale, lr=foreign)


@pytest.mark.parametrize("lit", [0.03, 0.1])
def test_rare_light_lets_expect_little(scale, lit):
    """Where 3 % of the samples find light, the renders correlate by 0.03, and are right."""
    rng = np.random.default_rng(1)
    colour = scene(scale, size=(128, 128))[0]
    low, high = (colour / lit * (rng.random(colour.shape[:2]) < lit)[..., None] for _ in range(2))
    low = Render.from_arrays("lr", rgb=downsample(low, scale).astype(np.float32))
    assert warnings_of(low, Render.from_arrays("hr", rgb=high)) == []


@pytest.mark.parametrize("spp", [1, 4, 16])
@pytest.mark.parametrize("seed", range(3))
def test_an_empty_sky_has_no_framing(scale, spp, seed):
    """A smooth gradient under noise: no shift can be seen, and none is reported."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: 128 * scale, : 128 * scale] / (128 * scale)
    sky = (0.01 + 0.02 * x + 0.01 * y)[..., None] * np.array([0.7, 0.8, 1])

    def render(clean, spp):
        grain = np.exp(rng.normal(-0.02, 0.2, (spp, *clean.shape[:2]))).mean(axis=0)
        return Render.from_arrays("r", rgb=(clean * grain[..., None]).astype(np.float32))

    assert warnings_of(render(downsample(sky, scale), spp * scale**2), render(sky, spp)) == []


@pytest.mark.parametrize(("which", "name"), [("hr", "HRLS"), ("lr", "LRHS")])
def test_a_failed_bucket_is_said(scale, which, name):
    renders = dict(zip(("lr", "hr"), pair(scale), strict=True))
    size = 64 if which == "hr" else 64 // scale
    renders[which].layers["rgb"][size : 2 * size, size : 2 * size] = 0
    (warning,) = warnings_of(renders["lr"], renders["hr"])
    assert warning.startswith(f"a bucket of the {name} failed: it is black or magenta around HRLS pixel (96, 96)")


@pytest.mark.parametrize("aov", ["albedo", "normal"])
def test_a_shifted_aov_is_noticed(scale, aov):
    layers = dict(zip(("rgb", "albedo", "normal"), scene(scale), strict=True))
    (warning,) = warnings(scale, **{aov: np.roll(layers[aov], 8, axis=1)})
    assert f"the {aov} is shifted against the picture by 8.0 pixels to the right" in warning


@pytest.mark.parametrize("turned", [1, -1])
def test_negated_normals_are_noticed(scale, turned):
    """By the normals of both renders. Where one of them has none, nobody can tell."""
    _, _, normal = scene(scale)
    low, high = pair(scale, normal=turned * normal)
    layers = {"rgb": low.layers["rgb"], "normal": np.ascontiguousarray(downsample(normal, scale), np.float32)}
    both = check_renders(Render.from_arrays("lr", **layers), high)
    assert [text.code for text in both.warnings] == ([] if turned == 1 else ["negated_normal"])
    unknown = "which way the normals point"
    assert unknown not in both.not_judged
    alone = check_renders(low, high)
    assert alone.warnings == [] and unknown in alone.not_judged


@pytest.mark.parametrize("gains", [(1.25, 1, 0.8), (0.8, 1, 1.1)])
def test_another_white_balance_is_noticed(scale, gains):
    (warning,) = warnings(scale, lr=pair(scale)[0].layers["rgb"] * np.float32(gains))
    assert "the white balance of the two renders differs" in warning


def test_values_encoded_for_a_display_are_noticed(scale):
    low, high = (0.3 * render.layers["rgb"] for render in pair(scale))
    said = warnings(scale, lr=srgb(low), rgb=high)
    assert any("the LRHS looks encoded for a display" in text for text in said)


def test_a_few_blocks_full_of_coloured_noise_do_not_hide_swapped_channels():
    high = np.random.default_rng(0).uniform(0.4, 0.6, (80, 3))
    low = high[:, ::-1].copy()
    low[:20], high[:20] = (0.01, 1, 0.01), (1, 0.01, 0.01)
    assert different_colours(low, high) == "red and blue are swapped in one of the two renders"
    assert different_colours(low, low) is None


def test_swapped_channels_are_noticed(scale):
    assert warnings(scale, lr=pair(scale)[0].layers["rgb"][..., ::-1]) == [
        "red and blue are swapped in one of the two renders: write both in the same colour space"
    ]


@pytest.mark.parametrize(("space", "name"), [(ACESCG, "ACEScg"), (ACES2065, "ACES2065-1"), (P3, "linear P3")])
def test_another_colour_space_is_noticed(scale, space, name):
    if space is P3 and scale == 2:
        pytest.skip("the colours of 4 samples in 4 pixels are too noisy to tell P3")
    matrix = conversion(REC709, space).T
    low, high = (render.layers["rgb"] for render in pair(scale))
    assert any(f"the LRHS looks like {name} and" in w for w in warnings(scale, lr=low @ matrix))
    assert any(f"and the HRLS like {name}" in w for w in warnings(scale, rgb=high @ matrix))


def test_grey_pictures_have_no_colour_space(scale):
    low, high = (render.layers["rgb"].mean(axis=-1, keepdims=True).repeat(3, -1) for render in pair(scale))
    assert warnings(scale, lr=low, rgb=high) == []


@pytest.mark.parametrize("aov", ["albedo", "normal"])
def test_an_aov_of_another_frame_is_noticed(scale, aov):
    other = dict(zip(("rgb", "albedo", "normal"), scene(scale, seed=50), strict=True))[aov]
    assert [w for w in warnings(scale, **{aov: other}) if f"the {aov}'s edges are not in the picture" in w]
    assert warnings(scale, **{aov: np.full_like(other, 0.5)}) == []  # without edges


def test_an_aov_is_not_judged_by_a_picture_without_edges(scale):
    """Fog or darkness hides the edges of the right albedo."""
    grey = np.full((*(n * scale for n in LOW), 3), 0.2, np.float32)
    assert warnings(scale, lr=noisy(downsample(grey, scale), scale**2), rgb=noisy(grey, 1, seed=1)) == []


def test_something_small_that_moved_is_noticed(scale):
    """A 1/64 of the frame, which is no brighter than the rest."""
    high = pair(scale)[1].layers["rgb"].copy()
    h, w = LOW[0] // 8 * scale, LOW[1] // 8 * scale
    high[3 * h : 4 * h, 5 * w : 6 * w] = high[6 * h : 7 * h, w : 2 * w].copy()
    (warning,) = warnings(scale, rgb=high)
    x, y = map(int, warning.split("(")[1].split(")")[0].split(","))
    assert 5 * w - 8 * scale <= x < 6 * w + 8 * scale
    assert 3 * h - 8 * scale <= y < 4 * h + 8 * scale


def test_flat_frames_full_of_noise_look_alike(scale):
    """Their blocks correlate by nothing, because there is nothing but noise."""
    grey = np.full((*(n * scale for n in LOW), 3), 0.2, np.float32)
    low, high = noisy(downsample(grey, scale), 1), noisy(grey, 0.05, seed=1)
    assert warnings(scale, lr=low, rgb=high) == []


def test_a_wider_pixel_filter_is_no_difference(scale):
    """An LRHS that spreads its samples over its neighbours, beside lights 300 times as bright as the room."""
    colour, *_ = scene(scale)
    colour[20 * scale : 24 * scale, 30 * scale : 34 * scale] = 300
    low = downsample(colour, scale)
    for axis in (0, 1):
        low = 0.25 * np.roll(low, 1, axis) + 0.5 * low + 0.25 * np.roll(low, -1, axis)
    assert warnings(scale, lr=noisy(low, 64), rgb=noisy(colour, 4, seed=1)) == []


@pytest.mark.parametrize("side", [44, 48, 50])
@pytest.mark.parametrize("kind", ["black but for a pixel", "flat", "stripes", "huge"])
def test_pictures_without_a_framing_are_no_error(side, kind):
    """Stripes say nothing of the shift along them, so the equations have no single solution."""
    image = np.full((2 * side, 2 * side, 3), 0.3, np.float32)
    if kind == "black but for a pixel":
        image[:] = 0
        image[10:12, 10:12] = 1
    elif kind == "stripes":
        image[:, ::16] = 2
    elif kind == "huge":
        image[20:40, 20:40] = 3e38
    low = Render.from_arrays("lr", rgb=image[::2, ::2].copy())
    assert not [w for w in warnings_of(low, Render.from_arrays("hr", rgb=image)) if "shifted" in w or "tighter" in w]


def test_rare_light_is_not_shared_noise(scale):
    """Where one sample in ten finds light, both renders have black pixels in the same places."""
    rng = np.random.default_rng(0)
    colour = scene(scale)[0]
    first, second = (colour * 10 * (rng.random(colour.shape[:2]) < 0.1)[..., None] for _ in range(2))
    low = Render.from_arrays("lr", rgb=downsample(first, scale).astype(np.float32))
    assert warnings_of(low, Render.from_arrays("hr", rgb=second)) == []


@pytest.mark.parametrize("which", ["HRLS", "LRHS"])
@pytest.mark.parametrize("lit", [1, 0.1])
def test_a_render_region_in_one_render_is_noticed(scale, which, lit):
    """Around it, that render is black. Rare light has black pixels too, but not around a rectangle."""
    rng = np.random.default_rng(0)
    colour = scene(scale)[0] + np.float32(0.01)
    first, second = (colour / lit * (rng.random(colour.shape[:2]) < lit)[..., None] for _ in range(2))
    height, width = colour.shape[:2]
    region = np.zeros_like(colour)
    region[height // 4 : -height // 8, width // 8 : -width // 4] = 1
    sentence = f"the {which} is black outside of a rectangle"
    for mask, noticed in ((1, False), (region, True)):
        low, high = (first * mask, second) if which == "LRHS" else (first, second * mask)
        low = Render.from_arrays("lr", rgb=downsample(low, scale).astype(np.float32))
        said = warnings_of(low, Render.from_arrays("hr", rgb=high.astype(np.float32)))
        assert any(text.startswith(sentence) for text in said) == noticed


def test_a_shift_under_noise_is_noticed():
    """By one LRHS pixel, in a large and pale picture: noise is most of the difference, yet the shift is certain."""
    colour = 0.4 + 0.6 * scene(2, size=(180, 320))[0]
    low = np.roll(noisy(downsample(colour, 2), 64, seed=100), 1, axis=1)
    (warning,) = warnings_of(Render.from_arrays("lr", rgb=low), Render.from_arrays("hr", rgb=noisy(colour, 1, 200)))
    assert "shifted against the LRHS by 2.2 pixels to the left" in warning


@pytest.mark.parametrize("seed", [20, 39])
def test_noise_in_a_small_picture_is_no_shift(seed):
    """A smooth picture, in which noise explains a tenth of the difference by a shift."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:80, :80]
    waves = np.sin(x / rng.uniform(8, 30) + seed) * np.cos(y / rng.uniform(8, 30))
    clean = 1 + 0.6 * waves + 0.5 * (x > 70)
    noise = rng.choice([0.05, 0.1, 0.2, 0.4], 2)
    low, high = ((clean * rng.gamma(1 / s**2, s**2, clean.shape)).astype(np.float32) for s in noise)
    assert replace(find_framing(low, high), judged=False) == Framing()


def test_one_object_suffices_to_notice_a_shift():
    """A pillar in front of a flat wall, by which most of the frame says nothing of the shift."""
    clean = np.full((128, 192), 0.5, np.float32)
    clean[:64, 80:88] = 3
    low = np.roll(noisy(downsample(clean, 2)[..., 0], 64, seed=100), 1, axis=1)
    high = downsample(noisy(clean, 4, seed=200), 2)[..., 0].astype(np.float32)
    assert find_framing(low, high).x == pytest.approx(-1, abs=0.2)


def test_an_albedo_that_fits_by_chance_is_noticed():
    """Of two comparisons the better counts, so a foreign albedo may fit a little."""
    assert [w for w in warnings(2, albedo=scene(2, seed=72)[1]) if "the albedo's edges are not in the picture" in w]


def test_an_albedo_of_another_frame_is_noticed_under_noise():
    """Hardly an edge is common to both renders. The normals fit, so the albedo should fit, too."""
    colour, _, normal = scene(2)
    low = Render.from_arrays("lr", rgb=noisy(downsample(colour, 2), 0.8, seed=100))
    high = Render.from_arrays("hr", rgb=noisy(colour, 0.2, seed=200), albedo=scene(2, seed=60)[1], normal=normal)
    (warning,) = warnings_of(low, high)
    assert "the albedo's edges are not in the picture" in warning


def moving_pair(scale, seed, spp, reach):
    """A grey relief in front of a wall with pictures on it. It moves sideways by so many HRLS pixels during exposure,
    and each sample shows it at a time of its own: the HRLS's normal is noise there, and the LRHS is blurred."""
    rng = np.random.default_rng(seed)
    albedo, relief = scene(scale, seed)[1], scene(scale, seed + 500)[2]
    height, width = albedo.shape[:2]
    y, x = np.mgrid[:height, :width]
    shaded = 0.65 * (0.5 + 0.5 * np.maximum(relief @ (0.5, 0.5, 0.7), 0))[..., None].repeat(3, -1)

    def sample():
        moved = x - np.round((rng.random((height, width)) - 0.5) * reach).astype(int)
        covered = ((np.abs(moved - width / 2) < 0.15 * width) & (np.abs(y - height / 2) < 0.15 * height))[..., None]
        moved = np.clip(moved, 0, width - 1)
        colour, normal = (
            np.where(covered, shaded[y, moved], 1.3 * albedo),
            np.where(covered, relief[y, moved], (0, 0, 1)),
        )
        return np.stack([colour * rng.gamma(4, 0.25, (height, width, 1)), normal])

    (high, normal), (low, _) = (sum(sample() for _ in range(n)) / n for n in (spp, 4 * spp))
    low = Render.from_arrays("lr", rgb=downsample(low, scale).astype(np.float32))
    return low, Render.from_arrays("hr", rgb=high.astype(np.float32), normal=normal.astype(np.float32))


@pytest.mark.parametrize(("scale", "spp", "seed"), [(2, 1, 2), (2, 1, 5), (2, 3, 2), (4, 1, 2), (4, 1, 5)])
def test_normals_under_motion_blur_are_not_judged(scale, spp, seed):
    assert warnings_of(*moving_pair(scale, seed, spp, reach=24 * scale)) == []


def test_normals_of_another_frame_are_noticed_beside_a_little_motion_blur():
    """Most of their edges stand still."""
    high = moving_pair(2, 0, 1, 16)[1].layers["normal"]
    other = scene(2, seed=50)[2]
    other[40:88, 70:120] = high[40:88, 70:120]
    assert [w for w in warnings(2, normal=other) if "the normal's edges are not in the picture" in w]
