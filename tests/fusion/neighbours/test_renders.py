# SPDX-License-Identifier: Apache-2.0
"""Renders are averaged with those of neighbours where these show the same surface in the same light, nowhere else."""

from dataclasses import dataclass

import numpy as np
import pytest

from oiio_msspl import map_render, open_exr
from oiio_msspl.exr.render import Render, Window
from oiio_msspl.fusion.neighbours import bands
from oiio_msspl.fusion.neighbours.average import average_renders as average
from oiio_msspl.fusion.neighbours.renders import RenderPair, shared_noise
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.image.parallel import limit_threads
from tests.conftest import rgb, write_exr
from tests.fusion.motion.moving_texture import HEIGHT, SCALE, WIDTH, hop, moved, rms, still, texture

NOISE = 0.5


@dataclass
class Averaged:
    """What average_renders returns."""

    lr: Render
    hr: Render
    frames: np.ndarray


def average_renders(pair, before, after):
    return Averaged(*average(pair, before, after))


def pair_of(truth, seed, **more):
    """A pair of a picture, with independent noise, and an albedo that is the picture."""
    rng = np.random.default_rng(seed)
    noise = [1 + rng.normal(0, NOISE / k, truth[::k, ::k].shape).astype(np.float32) for k in (1, SCALE)]
    hr = Render.from_arrays("hr", rgb=truth * noise[0], albedo=truth.copy(), **more)
    return RenderPair(Render.from_arrays("lr", rgb=box_downsample(truth, SCALE) * noise[1]), hr)


def test_four_still_neighbours_halve_the_noise_of_both_renders():
    truth = texture()
    pairs = [pair_of(truth, seed) for seed in range(5)]
    result = average_renders(pairs[2], [still(pairs[1]), still(pairs[0])], [still(pairs[3]), still(pairs[4])])
    assert rms(result.hr.layers["rgb"], truth) < 0.5 * rms(pairs[2].hr.layers["rgb"], truth)
    low = box_downsample(truth, SCALE)
    assert rms(result.lr.layers["rgb"], low) < 0.5 * rms(pairs[2].lr.layers["rgb"], low)
    assert np.allclose(result.hr.layers["albedo"], truth, rtol=1e-5)
    assert np.median(result.frames) > 4


@pytest.mark.parametrize("own", [{}, {"variance": np.zeros((*texture().shape[:2], 1), np.float32)}])
def test_the_frames_of_one_render_tell_its_variance(own):
    """Also if it has one of luminance, which says nothing of colours."""
    truth, renders = texture(), []
    for seed in range(5):
        noise = 1 + np.random.default_rng(seed).normal(0, NOISE, truth.shape)
        layers = {"rgb": (truth * noise).astype(np.float32), "albedo": truth.copy()} | own
        renders.append(Render.from_arrays("hr", **layers))
    pairs = [RenderPair(render, render) for render in renders]
    before, after = [still(pairs[1]), still(pairs[0])], [still(pairs[3]), still(pairs[4])]
    _, averaged, frames = average(pairs[2], before, after, ["rgb", "albedo", "variance"])
    many = frames[..., 0] > 4
    expected = np.square(NOISE * truth) / frames
    assert averaged.layers["variance"][many].mean() == pytest.approx(expected[many].mean(), rel=0.1)
    assert "variance" not in average(pairs[2], before, after, ["rgb", "albedo"])[1].layers


def test_neighbours_are_found_where_their_surfaces_are():
    pairs = {n: pair_of(texture(4 * n), n + 5) for n in (-2, -1, 0, 1, 2)}
    before, after = ([moved(pairs[n], 4 * np.sign(n)) for n in numbers] for numbers in ((-1, -2), (1, 2)))
    result = average_renders(pairs[0], before, after)
    inside, low_inside = np.s_[:, 8:-8], np.s_[:, 3:-3]
    assert rms(result.hr.layers["rgb"], texture(), inside) < 0.5 * rms(pairs[0].hr.layers["rgb"], texture(), inside)
    low = box_downsample(texture(), SCALE)
    assert rms(result.lr.layers["rgb"], low, low_inside) < 0.6 * rms(pairs[0].lr.layers["rgb"], low, low_inside)
    assert np.allclose(result.hr.layers["albedo"][inside], texture()[inside], rtol=1e-5)


def test_renders_may_have_different_layers():
    pairs = []
    for seed in range(3):
        pair = pair_of(texture(), seed)
        alpha = np.ones((HEIGHT // SCALE, WIDTH // SCALE, 1), np.float32)
        pairs.append(RenderPair(Render.from_arrays("lr", rgb=pair.lr.layers["rgb"], alpha=alpha), pair.hr))
    result = average_renders(pairs[1], [still(pairs[0])], [still(pairs[2])])
    assert result.lr.layers.keys() == {"rgb", "alpha"} and result.hr.layers.keys() == {"rgb", "albedo"}
    assert (result.lr.layers["alpha"] == 1).all()


def test_pixels_do_not_share_their_noise():
    """A surface moves by a third of a pixel. Interpolated noise would be correlated from pixel to pixel."""
    truth = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    pairs = [pair_of(truth, seed) for seed in range(3)]
    result = average_renders(pairs[1], [moved(pairs[0], 0.3, 0.3)], [moved(pairs[2], -0.3, -0.3)])
    noise = result.hr.layers["rgb"][..., 0] - 0.5
    assert abs(np.corrcoef(noise[:, 1:].ravel(), noise[:, :-1].ravel())[0, 1]) < 0.05
    assert noise.std() < 0.65 * (pairs[1].hr.layers["rgb"][..., 0] - 0.5).std()


def test_what_no_neighbour_shows_keeps_every_bit():
    pair = pair_of(texture(), 1)
    hidden = hop(pair_of(texture(), 2), known=np.zeros((HEIGHT, WIDTH), bool))
    lost = moved(pair_of(texture(), 3), 5.0 * WIDTH)
    result = average_renders(pair, [hidden], [lost])
    for name in ("lr", "hr"):
        for feature, values in getattr(pair, name).layers.items():
            assert np.array_equal(getattr(result, name).layers[feature], values)
    assert (result.frames == 1).all()


@pytest.mark.parametrize("change", [0.0, 0.3, 2.0])
def test_light_that_changes_is_not_averaged(change):
    truth, other = texture(), texture()
    other[:, WIDTH // 2 :] *= change
    pairs = [pair_of(truth, 1), pair_of(other, 2), pair_of(other, 3)]
    result = average_renders(pairs[0], [still(pairs[1])], [still(pairs[2])])
    changed, same = np.s_[:, WIDTH // 2 + 8 :], np.s_[:, : WIDTH // 4]
    own, made = (pair.hr.layers["rgb"] for pair in (pairs[0], result))
    assert rms(made, truth, changed) < 1.1 * rms(own, truth, changed)
    assert abs(np.mean((made - truth)[changed])) < 0.02
    assert rms(made, truth, same) < 0.75 * rms(own, truth, same)


@pytest.mark.parametrize("lights", [(1.5, 1.5, 1.5), (0.8, 0.8, 0.8), (1, 1, 1.5), (1.3, 0.92, 0.7)])
@pytest.mark.parametrize("pixels", [0.0, 1.7])
def test_a_frame_in_another_light_does_not_count(lights, pixels):
    """A flash, a lamp that flickers in blue, or one that changes its hue at equal luminance."""
    lit = texture(pixels) * np.float32(lights)
    pairs = [pair_of(texture(), 1), pair_of(lit, 2), pair_of(lit * np.float32(1), 3)]
    result = average_renders(pairs[0], [moved(pairs[1], pixels)], [moved(pairs[2], pixels)])
    assert result.frames[:, 8:-8].mean() < 1.1
    for render, own in ((result.hr, pairs[0].hr), (result.lr, pairs[0].lr)):
        light = [layers["rgb"].mean(axis=(0, 1)) for layers in (render.layers, own.layers)]
        assert np.allclose(*light, rtol=0.01)


@pytest.mark.parametrize("pixels", [0.0, 3.0])
def test_a_moving_picture_on_a_screen_does_not_count_and_the_wall_around_does(pixels):
    """The screen stands still, or a wall with the screen is panned; its albedo shows nothing."""
    film = np.random.default_rng(1).random((4, HEIGHT // 8, WIDTH // 8, 3)).repeat(8, 1).repeat(8, 2)
    screen = np.s_[24:72, 56:112]
    pairs = []
    for number in range(3):
        truth = texture(pixels * number)
        shift = round(pixels * number)
        truth[:, shift:][screen] = film[number][screen]
        pairs.append(pair_of(truth, number))
    result = average_renders(pairs[0], [moved(pairs[1], pixels), moved(pairs[2], pixels)], [])
    assert result.frames[24:72, 56:112].mean() < 1.15
    assert result.frames[:, 4:28].mean() > 1.4


def test_clean_renders_keep_their_detail_where_a_surface_lies_between_pixels():
    """Stripes of two pixels move by half of one. Only the albedo of the pixels that are fetched shows it."""
    x = np.arange(WIDTH, dtype=np.float32)
    pairs = []
    for shift in (0.0, 0.4, 0.8):
        stripes = (0.5 + 0.08 * np.sin((x - shift) * np.pi / 2.5))[None, :, None]
        truth = np.broadcast_to(stripes, (HEIGHT, WIDTH, 3)).astype(np.float32)
        noise = [np.random.default_rng(int(10 * shift)).normal(1, 0.1 / k, truth[::k, ::k].shape) for k in (1, SCALE)]
        hr = Render.from_arrays("hr", rgb=(truth * noise[0]).astype(np.float32), albedo=truth.copy())
        lr = Render.from_arrays("lr", rgb=(box_downsample(truth, SCALE) * noise[1]).astype(np.float32))
        pairs.append((RenderPair(lr, hr), truth))
    result = average_renders(pairs[0][0], [moved(pairs[1][0], 0.4), moved(pairs[2][0], 0.4)], [])
    inside = np.s_[:, 8:-8]
    own = pairs[0][0].hr.layers
    assert rms(result.hr.layers["rgb"], pairs[0][1], inside) < rms(own["rgb"], pairs[0][1], inside)
    assert np.array_equal(result.hr.layers["albedo"], own["albedo"])


def test_a_frame_without_noise_is_not_blurred_by_neighbours_that_moved():
    """A neighbour that stands still can't blur it."""
    truth = texture()
    lr, hr = Render.from_arrays("lr", rgb=box_downsample(truth, SCALE)), Render.from_arrays("hr", rgb=truth)
    pair = RenderPair(lr, hr)
    result = average_renders(pair, [moved(pair, 0.3)], [moved(pair, 0.3)])
    assert np.array_equal(result.hr.layers["rgb"], truth) and np.array_equal(result.lr.layers["rgb"], lr.layers["rgb"])
    assert average_renders(pair, [still(pair)], [still(pair)]).frames.mean() > 2.9


@pytest.mark.parametrize("spread", [False, True])
def test_frames_of_one_render_count_though_a_filter_has_spread_their_noise(spread):
    """Its halves tell how much light has changed, and a lamp that brightens is noticed."""
    renders = []
    for seed, light in enumerate((1, 1, 1, 1.5)):
        noise = np.random.default_rng(seed).normal(0, 0.5, (HEIGHT + 2, WIDTH + 2, 1)).astype(np.float32)
        if spread:
            noise = noise[:-2] + 4 * noise[1:-1] + noise[2:]
            noise = (noise[:, :-2] + 4 * noise[:, 1:-1] + noise[:, 2:]) / 18
        noise = noise[:HEIGHT, :WIDTH]
        render = Render.from_arrays("hr", rgb=(texture() * light * (1 + noise)).astype(np.float32))
        renders.append(RenderPair(render, render))
    assert average_renders(renders[0], [still(renders[1])], [still(renders[2])]).frames.mean() > 2.3
    assert average_renders(renders[0], [still(renders[3])], []).frames.mean() < 1.2


def test_neighbours_that_moved_by_half_a_pixel_give_each_pixel_another_sample():
    """Noise that two pixels share looks like detail to a network."""
    pairs = [pair_of(texture(shift), seed) for seed, shift in enumerate((0.0, 0.5))]
    noise = average_renders(pairs[0], [moved(pairs[1], 0.5)], []).hr.layers["rgb"][..., 0] / texture()[..., 0] - 1
    inside = noise[:, 8:-8]
    assert abs(np.mean(inside[:, 1:] * inside[:, :-1]) / inside.var()) < 0.05


def test_pixels_beside_an_object_that_is_not_followed_count_less():
    """Some of its own pixels look like what is behind it, and are not found."""
    pairs = [pair_of(texture(), seed) for seed in range(2)]
    objects = np.zeros((HEIGHT, WIDTH), bool)
    objects[36:60, 52:76] = True
    frames = average_renders(pairs[0], [hop(pairs[1], known=~objects, moved_objects=objects)], []).frames[..., 0]
    assert (frames[objects] == 1).all()
    assert frames[48, 78] < 1.2 < 1.8 < frames[48, 88]


def test_a_small_lamp_in_the_neighbour_leaves_no_ghost():
    truth, lit = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32), np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    lit[40:43, 61:65] = 200
    pairs = [pair_of(truth, 1), pair_of(lit, 2)]
    result = average_renders(pairs[0], [still(pairs[1])], [])
    assert result.hr.layers["rgb"].max() < 1.1 * pairs[0].hr.layers["rgb"].max()
    assert result.lr.layers["rgb"].max() < 1.1 * pairs[0].lr.layers["rgb"].max()


def test_a_firefly_is_no_lamp():
    """It is in one render alone, so neighbours count as they do without it."""
    pairs = [pair_of(texture(), 1), pair_of(texture(), 2)]
    before = average_renders(pairs[0], [still(pairs[1])], [])
    pairs[1].hr.layers["rgb"][41, 62] = 500
    after = average_renders(RenderPair(pairs[0].lr, pairs[0].hr), [still(RenderPair(pairs[1].lr, pairs[1].hr))], [])
    beside = np.s_[40:44, 64:68]
    assert before.frames[beside].min() > 1.3
    assert np.allclose(after.frames[beside], before.frames[beside], rtol=0.2)


def test_a_lamp_that_is_wider_in_the_lrhs_leaves_no_ghost():
    """Its light reaches further than its vectors: the filter of the LRHS is as wide as the LRHS's pixels."""
    places = (slice(40, 52), slice(48, 60)), (slice(40, 52), slice(32, 44))
    ways, pairs = [], []
    for seed, (place, distance) in enumerate(zip(places, (-16, 16), strict=True)):
        truth = np.full((HEIGHT, WIDTH, 3), 0.05, np.float32)
        truth[place] = 50
        pairs.append(pair_of(truth, seed))
        ways.append(np.zeros((HEIGHT, WIDTH, 2), np.float32))
        ways[-1][place] = (distance, 0)
        low = pairs[-1].lr.layers["rgb"]
        y, x = (slice(part.start // SCALE - 1, part.stop // SCALE + 1) for part in place)
        low[y, x] = np.maximum(low[y, x], 5)
    result = average_renders(pairs[0], [hop(pairs[1], *ways)], [])
    ghost = np.s_[9:14, 7:11]
    assert result.lr.layers["rgb"][ghost].max() < 1.5 * pairs[0].lr.layers["rgb"][ghost].max()


def test_values_that_are_not_finite_do_not_count():
    pairs = [pair_of(texture(), seed) for seed in range(2)]
    pairs[1].hr.layers["rgb"][40:44, 60:64] = np.nan
    pairs[1].hr.layers["albedo"][8, 8] = np.inf
    pairs[1].lr.layers["rgb"][3, 5] = np.inf
    pairs[0].hr.layers["rgb"][70, 70] = np.nan
    result = average_renders(pairs[0], [still(pairs[1])], [])
    own = pairs[0].hr.layers["rgb"]
    assert np.array_equal(result.hr.layers["rgb"][40:44, 60:64], own[40:44, 60:64])
    assert np.array_equal(result.hr.layers["albedo"][8, 8], texture()[8, 8])
    assert np.array_equal(result.lr.layers["rgb"][3, 5], pairs[0].lr.layers["rgb"][3, 5])
    bad = ~np.isfinite(result.hr.layers["rgb"]).all(axis=-1)
    assert np.argwhere(bad).tolist() == [[70, 70]]


@pytest.mark.filterwarnings("error")
def test_values_that_are_not_finite_bring_no_warning(monkeypatch):
    """Nor in other threads: each has NumPy's settings for errors of its own."""
    monkeypatch.setattr("oiio_msspl.image.parallel.BLOCK_VALUES", 256)
    pairs = [pair_of(texture(), seed) for seed in range(2)]
    pairs[1].lr.layers["rgb"][::7, ::7] = np.inf
    with limit_threads(4):
        average_renders(pairs[0], [moved(pairs[1], 2.6, 0.8)], [])


def test_the_variance_of_a_mean_is_smaller():
    variance = np.full((HEIGHT, WIDTH, 1), 0.25, np.float32)
    pairs = [pair_of(texture(), seed, variance=variance) for seed in range(2)]
    result = average_renders(pairs[0], [still(pairs[1])], [])
    assert np.median(result.hr.layers["variance"]) < 0.14


def test_neighbours_may_have_other_data_windows():
    """Some renderers write only the rectangle that holds something, frame by frame."""
    truth = texture()
    whole = [pair_of(truth, seed) for seed in range(2)]
    lr, hr = pair_of(truth[16:80, 32:96], 5).lr, pair_of(truth[16:80, 32:96], 5).hr
    part = RenderPair(
        Render(lr.layers, Window(8, 4, 24, 20), Window(0, 0, WIDTH // SCALE, HEIGHT // SCALE)),
        Render(hr.layers, Window(32, 16, 96, 80), Window(0, 0, WIDTH, HEIGHT)),
    )
    result = average_renders(whole[0], [still(part)], []).hr.layers["rgb"]
    outside = np.ones((HEIGHT, WIDTH), bool)
    outside[16:80, 32:96] = False
    own = whole[0].hr.layers["rgb"]
    assert np.array_equal(result[outside], own[outside])
    inside = np.s_[16:80, 32:96]
    assert rms(result, truth, inside) < 0.8 * rms(own, truth, inside)
    made = average_renders(part, [still(whole[0])], [])
    assert rms(made.hr.layers["rgb"], truth[inside]) < 0.8 * rms(hr.layers["rgb"], truth[inside])
    assert (made.hr.data_window, made.lr.data_window) == (part.hr.data_window, part.lr.data_window)


def test_an_lrhs_that_was_rounded_is_averaged():
    truth = np.full((HEIGHT + 1, WIDTH + 1, 3), 0.5, np.float32)
    rng = np.random.default_rng(0)

    def odd(size):
        low, high = (0.5 * (1 + rng.normal(0, s, (*shape, 3))).astype(np.float32) for s, shape in zip(
            (NOISE / SCALE, NOISE), (size, truth.shape[:2]), strict=True))  # fmt: skip
        return RenderPair(Render.from_arrays(rgb=low), Render.from_arrays(rgb=high))

    for size in ((24, 32), (25, 33)):
        pairs = [odd(size) for _ in range(3)]
        way = np.full((*truth.shape[:2], 2), 2.0, np.float32)
        after = hop(pairs[2], way, -way)
        result = average_renders(pairs[0], [still(pairs[1])], [after])
        for name in ("lr", "hr"):
            own, made = (getattr(pair, name).layers["rgb"] for pair in (pairs[0], result))
            assert made.shape == own.shape and made.std() < 0.7 * own.std()


@pytest.mark.parametrize("side", [32, 33])
def test_light_that_changes_is_not_averaged_where_an_lrhs_was_rounded(side):
    """A board of black and white squares: half a pixel beside an edge, the LRHS and the HRLS differ by more than noise,
    which would hide a change of the light."""
    scale, size = 8, 257

    def board(side, samples):
        places = (np.arange(side * samples) + 0.5) / (side * samples)
        squares = np.sign(np.sin(60 * places[:, None]) * np.cos(45 * places))
        return box_downsample(np.repeat(0.5 + 0.45 * squares[..., None], 3, axis=-1), samples)

    def odd(seed, brightness):
        rng = np.random.default_rng(seed)
        both = ((side, 24, 0.1), (size, 3, 0.2))
        low, high = (brightness * board(n, samples) * rng.normal(1, noise, (n, n, 1)) for n, samples, noise in both)
        return RenderPair(Render.from_arrays(rgb=low), Render.from_arrays(rgb=high))

    for change, least, most in ((1, 2.5, 3), (1.5, 1, 1.25)):
        frame, *neighbours = (odd(seed, factor) for seed, factor in enumerate((1, change, change)))
        assert frame.alignment.scale == scale
        result = average_renders(frame, [still(neighbours[0])], [still(neighbours[1])])
        assert least <= result.frames.mean() <= most


def test_bands_of_rows_agree(monkeypatch):
    pairs = [pair_of(texture(0.7 * seed), seed) for seed in range(3)]

    def result(rows):
        monkeypatch.setattr(bands, "BAND_ROWS", rows)
        monkeypatch.setattr(bands, "BAND_PIXELS", 1)
        fresh = [RenderPair(pair.lr, pair.hr) for pair in pairs]
        return average_renders(fresh[1], [moved(fresh[0], -0.7, 0.4)], [moved(fresh[2], 0.7, -3.3)])

    whole, parts = result(1024), result(16)
    assert np.allclose(whole.hr.layers["rgb"], parts.hr.layers["rgb"], rtol=1e-5)
    assert np.allclose(whole.lr.layers["rgb"], parts.lr.layers["rgb"], rtol=1e-5)
    assert np.allclose(whole.frames, parts.frames, rtol=1e-5)


def test_rows_above_the_frame_are_averaged_like_others(monkeypatch):
    """The same pixels, once all inside the display window and once all above it. Some surfaces move further than the
    others, so that the first row that is read belongs to them."""
    monkeypatch.setattr(bands, "BAND_ROWS", 16)
    monkeypatch.setattr(bands, "BAND_PIXELS", 1)
    pairs = [pair_of(np.full((HEIGHT, WIDTH, 3), 0.5, np.float32), seed) for seed in range(2)]
    way, back = np.zeros((2, HEIGHT, WIDTH, 2), np.float32)
    way[40:48, 32:64, 1], back[10:18, 32:64, 1] = -30, 30

    def raised(render, rows):
        width, height = render.data_window.width, render.data_window.height
        return Render(render.layers, Window(0, -rows, width, height - rows), Window(0, 0, width, height))

    def result(rows):
        own, other = (RenderPair(raised(pair.lr, rows // SCALE), raised(pair.hr, rows)) for pair in pairs)
        return average_renders(own, [], [hop(other, way, back)]).lr.layers["rgb"]

    assert np.allclose(result(0), result(HEIGHT), atol=1e-5)


def test_bands_read_a_file_at_the_same_time(monkeypatch, tmp_path):
    """As for frames that don't fit into memory."""
    monkeypatch.setattr(bands, "BAND_ROWS", 16)
    monkeypatch.setattr(bands, "BAND_PIXELS", 1)
    pairs = [pair_of(texture(0.7 * seed), seed) for seed in range(3)]

    def on_disk(render, name):
        layers = rgb(render.layers["rgb"]) | rgb(render.layers.get("albedo", render.layers["rgb"]), "albedo.")
        return map_render(open_exr(write_exr(tmp_path / name, layers)))

    files = [RenderPair(on_disk(p.lr, f"lr{i}.exr"), on_disk(p.hr, f"hr{i}.exr")) for i, p in enumerate(pairs)]
    loaded = [RenderPair(pair.lr.load(), pair.hr.load()) for pair in files]
    with limit_threads(2):
        from_files, in_memory = (
            average_renders(each[1], [moved(each[0], -0.7, 0.4)], [moved(each[2], 0.7, -3.3)])
            for each in (files, loaded)
        )
    for name, image in in_memory.hr.layers.items():
        assert np.array_equal(from_files.hr.layers[name], image)


def test_frames_with_one_seed_share_their_noise():
    pairs = [pair_of(texture(), seed) for seed in (1, 1, 2)]
    assert shared_noise(pairs[0], pairs[1]) > 0.9
    assert abs(shared_noise(pairs[0], pairs[2])) < 0.2


def test_edges_that_both_renders_show_differently_are_no_shared_noise():
    """The LRHS of a standing camera is brighter in a few pixels of every frame, by far more than its noise."""
    pairs = [pair_of(texture(), seed) for seed in (1, 2)]
    for pair in pairs:
        pair.lr.layers["rgb"][::4, ::4] *= 4
    low = [np.log(pair.lr.layers["rgb"] / box_downsample(pair.hr.layers["rgb"], SCALE)).ravel() for pair in pairs]
    assert np.corrcoef(*low)[0, 1] > 0.5
    assert shared_noise(*pairs) < 0.2
