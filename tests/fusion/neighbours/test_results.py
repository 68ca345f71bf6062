# SPDX-License-Identifier: Apache-2.0
"""Frames are averaged with their neighbours where these show the same surface in the same light, and nowhere else."""

import numpy as np
import pytest

from oiio_msspl.exr.render import Render, Window
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.fusion.motion.shot import ROUND_TRIP, ROUND_TRIP_OF_FLOW
from oiio_msspl.fusion.motion.vectors import near_borders
from oiio_msspl.fusion.neighbours import bands
from oiio_msspl.fusion.neighbours.average import average_results
from oiio_msspl.fusion.neighbours.trust import likeness
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.image.colour import luminance
from oiio_msspl.image.filters import box_downsample
from tests.fusion.motion.moving_texture import HEIGHT, SCALE, WIDTH, hop, moved, rms, still, texture

#: Deviation of the error of a fused frame, as a share of its light, and of a sample's noise.
FUSED_ERROR, SAMPLE_NOISE = 0.03, 0.5


def frame_of(truth, seed, alpha=None, error=FUSED_ERROR):
    """A fused frame, as if its two renders had independent noise."""
    rng = np.random.default_rng(seed)
    height, width = truth.shape[:2]
    lrhs = box_downsample(truth, SCALE)
    hrls = truth * (1 + rng.normal(0, SAMPLE_NOISE, truth.shape)).astype(np.float32)
    lrhs = lrhs * (1 + rng.normal(0, SAMPLE_NOISE / SCALE, lrhs.shape)).astype(np.float32)
    alignment = align(Render.from_arrays(rgb=lrhs), Render.from_arrays(rgb=truth))
    # The error of a fused frame is smooth: it is what is left of the noise after a blur.
    blotches = rng.normal(0, error, (height // 4, width // 4, 3)).repeat(4, 0).repeat(4, 1).astype(np.float32)
    fused = FusedFrame(truth * (1 + blotches), alpha, None, alignment, 1.0, {})
    fused.lrhs_luminance, fused.hrls_luminance = luminance(lrhs), luminance(box_downsample(hrls, SCALE))
    return fused


def test_four_still_neighbours_halve_the_error():
    truth = texture()
    frames = [frame_of(truth, seed) for seed in range(5)]
    result = average_results(frames[2], [still(frames[1]), still(frames[0])], [still(frames[3]), still(frames[4])])
    assert rms(result.rgb, truth) < 0.55 * rms(frames[2].rgb, truth)
    assert np.median(result.frames) > 4


def test_what_stands_alone_in_the_average_of_renders_keeps_its_bits():
    frames = [frame_of(texture(), seed) for seed in range(3)]
    counts = frames[0].frames = np.full((HEIGHT, WIDTH, 1), 2, np.float32)
    counts[30:60, 40:80] = 1
    result = average_results(frames[0], [still(frames[1])], [still(frames[2])])
    same = (result.rgb == frames[0].rgb).all(axis=-1)
    assert same[30:60, 40:80].all() and np.mean(same) < 0.15


def test_neighbours_are_found_where_their_surfaces_are():
    frames = {n: frame_of(texture(1.7 * n), n + 5) for n in (-2, -1, 0, 1, 2)}
    before, after = ([moved(frames[n], 1.7 * np.sign(n)) for n in numbers] for numbers in ((-1, -2), (1, 2)))
    result = average_results(frames[0], before, after)
    inside = np.s_[:, 4:-4]
    assert rms(result.rgb, texture(), inside) < 0.6 * rms(frames[0].rgb, texture(), inside)
    wrong = average_results(frames[0], [still(frames[-1])], [still(frames[1])])
    assert rms(wrong.rgb, texture(), inside) > 1.2 * rms(result.rgb, texture(), inside)


def test_another_mix_of_two_surfaces_hardly_counts():
    """A bright thing moves over a dark one. The pixels of its edge show a little of it, and in the neighbour a lot."""
    truth = np.full((HEIGHT, WIDTH, 3), 0.05, np.float32)
    truth[:, WIDTH // 2 :] = 0.8
    edge = np.s_[:, WIDTH // 2 - 1]
    vectors = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    vectors[:, WIDTH // 2 :] = (0.5, 0)
    frame, neighbour = (frame_of(truth, seed, error=0) for seed in (1, 2))
    frame.rgb[edge], neighbour.rgb[edge] = 0.1, 0.3
    hops = [hop(neighbour, motion, -motion) for motion in (np.zeros_like(vectors), vectors)]
    without, with_borders = (average_results(frame, [way], []).rgb[edge] - 0.1 for way in hops)
    assert 0 < 3 * with_borders.mean() < without.mean()


def test_the_rim_of_a_lamp_in_the_neighbour_leaves_no_ghost():
    """The rim has light of the lamp, and the vectors of the wall, which stands still."""
    wall = np.full((HEIGHT, WIDTH, 3), 0.05, np.float32)
    frame, neighbour = frame_of(wall, 1), frame_of(wall, 2)
    lamp, rim = np.s_[20:40, 30:60], np.s_[40, 30:60]
    neighbour.rgb[lamp], neighbour.rgb[rim] = 50, 5
    none = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    back = none.copy()
    back[lamp] = (-40, 0)
    for vectors in (None, none):
        result = average_results(frame, [hop(neighbour, vectors, back)], [])
        assert (result.rgb[rim] < 1.1 * frame.rgb[rim]).all()


def test_borders_do_not_depend_on_bands(monkeypatch):
    frame, neighbour = frame_of(texture(), 1), frame_of(texture(), 2)
    neighbour.rgb[30:50] *= 1.5
    vectors = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    vectors[20:60, 30:80] = (0.2, 0.1)
    vectors[33, ::9] = 0.4
    hops = [hop(neighbour, way, -way) for way in (vectors, vectors[::-1].copy())]
    whole = [average_results(frame, [way], []).rgb for way in hops]
    monkeypatch.setattr(bands, "BAND_ROWS", 16)
    monkeypatch.setattr(bands, "BAND_PIXELS", 1)
    for way, expected in zip(hops, whole, strict=True):
        assert np.array_equal(average_results(frame, [way], []).rgb, expected)


def test_borders_reach_one_pixel_to_each_side():
    vectors = np.zeros((7, 9, 2), np.float32)
    vectors[:, 5:] = (0.3, 0)
    borders = near_borders(vectors, 0.25)
    assert (borders == np.isin(np.arange(9), (3, 4, 5, 6))).all()
    assert not near_borders(vectors, 0.35).any()
    vectors[3, 1] = np.nan  # another surface
    assert near_borders(vectors, 0.35)[1:6, 0:4].sum() == near_borders(vectors, 0.35).sum() > 0


def test_a_way_back_that_misses_by_more_than_the_tolerance_does_not_count():
    frame, neighbour = frame_of(texture(), 1), frame_of(texture(), 2)
    vectors = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    for tolerance, counts in ((ROUND_TRIP, False), (ROUND_TRIP_OF_FLOW, True)):
        way = hop(neighbour, vectors, vectors + np.float32(0.5), tolerance=tolerance)
        assert np.array_equal(average_results(frame, [way], []).rgb, frame.rgb) != counts


@pytest.mark.parametrize("arrives", [True, False])
def test_a_thing_that_covers_what_stands_still_is_not_averaged(arrives):
    """The vectors that are all zero, of what stands still or of a frame without the thing, may be left out."""
    frame, neighbour = frame_of(texture(), 1), frame_of(texture(), 2)
    place = np.s_[20:40, 30:60]
    (neighbour if arrives else frame).rgb[place] = frame.rgb[place][..., ::-1]
    none = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    away = none.copy()
    away[place] = (-40, 0)
    vectors, back = (none, away) if arrives else (away, none)
    for ways in ((vectors, back), tuple(way if way.any() else None for way in (vectors, back))):
        result = average_results(frame, [hop(neighbour, *ways)], [])
        assert np.array_equal(result.rgb[place], frame.rgb[place])
        assert not np.array_equal(result.rgb, frame.rgb)


def test_without_neighbours_every_bit_stays():
    frame = frame_of(texture(), 1)
    result = average_results(frame, [], [])
    assert np.array_equal(result.rgb, frame.rgb) and (result.frames == 1).all()


def test_a_frame_that_no_neighbour_shows_keeps_every_bit():
    frame = frame_of(texture(), 1)
    hidden = hop(frame_of(texture(), 2), known=np.zeros((HEIGHT, WIDTH), bool))
    lost = moved(frame_of(texture(), 3), 5.0 * WIDTH)
    there, back = np.ones((HEIGHT, WIDTH, 2), np.float32), np.zeros((HEIGHT, WIDTH, 2), np.float32) + 9
    there_only = hop(frame_of(texture(), 4), there, back)
    result = average_results(frame, [hidden], [lost])
    assert np.array_equal(result.rgb, frame.rgb)
    assert np.array_equal(average_results(frame, [there_only], []).rgb, frame.rgb)


@pytest.mark.parametrize("change", [0.0, 0.3, 2.0])
def test_light_that_changes_is_not_averaged(change):
    """A lamp goes on, or a shadow moves over a part of the picture: vectors say that nothing moves."""
    truth, other = texture(), texture()
    other[:, WIDTH // 2 :] *= change
    frames = [frame_of(truth, 1), frame_of(other, 2), frame_of(other, 3)]
    result = average_results(frames[0], [still(frames[1])], [still(frames[2])])
    changed = np.s_[:, WIDTH // 2 + 8 :]
    assert rms(result.rgb, truth, changed) < 1.1 * rms(frames[0].rgb, truth, changed)
    same = np.s_[:, : WIDTH // 4]
    assert rms(result.rgb, truth, same) < 0.7 * rms(frames[0].rgb, truth, same)


@pytest.mark.parametrize("on", [False, True])
def test_a_small_lamp_that_is_on_in_one_frame_leaves_no_trace(on):
    """It is 400 times as bright as the wall, so a thousandth of its light would be seen."""
    wall, lit = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32), np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    lamp = np.s_[40:43, 61:65]
    lit[lamp] = 200
    truth, other = (lit, wall) if on else (wall, lit)
    frames = [frame_of(truth, 1), frame_of(other, 2), frame_of(other, 3)]
    result = average_results(frames[0], [still(frames[1])], [still(frames[2])])
    around = np.s_[38:45, 59:67]
    assert np.array_equal(result.rgb[around], frames[0].rgb[around])
    assert np.median(result.frames) > 2


def test_light_that_has_changed_in_the_nearer_frame_has_in_the_farther_one():
    truth, dark = texture(), texture() * 0.2
    frames = [frame_of(truth, 1), frame_of(dark, 2), frame_of(truth, 3)]
    result = average_results(frames[0], [still(frames[1]), still(frames[2])], [])
    assert np.median(result.frames) < 1.2


def test_a_scaled_scene_gives_a_scaled_result():
    def result(factor):
        frames = [frame_of(texture() * np.float32(factor), seed) for seed in range(3)]
        return average_results(frames[1], [moved(frames[0], 0.4)], [moved(frames[2], -0.4)]).rgb

    assert np.allclose(result(1024.0) / 1024, result(1.0), rtol=1e-5)
    assert np.isfinite(result(1e-20)).all() and np.isfinite(result(1e25)).all()


def test_alpha_is_averaged_with_the_same_weights():
    frames = [frame_of(texture(), seed) for seed in range(3)]
    for frame in frames:
        frame.alpha = frame.rgb[..., :1].copy()
    result = average_results(frames[1], [moved(frames[0], 0.3)], [moved(frames[2], -0.3)])
    assert np.array_equal(result.alpha, result.rgb[..., :1])
    without = frame_of(texture(), 4)
    assert np.allclose(average_results(frames[1], [still(without)], []).alpha, frames[1].alpha)
    assert average_results(without, [still(frames[1])], []).alpha is None


def test_neighbours_may_have_other_data_windows():
    """Some renderers write only the rectangle that holds something, frame by frame."""
    truth = texture()
    whole = [frame_of(truth, seed) for seed in range(2)]
    part = frame_of(truth[16:80, 32:96], 5)
    window = Window(32, 16, 96, 80)
    part.alignment = align(
        Render({"rgb": truth[4:20, 8:24]}, Window(8, 4, 24, 20), Window(0, 0, WIDTH // SCALE, HEIGHT // SCALE)),
        Render({"rgb": part.rgb}, window, Window(0, 0, WIDTH, HEIGHT)),
    )
    result = average_results(whole[0], [still(part)], [])
    outside = np.ones((HEIGHT, WIDTH), bool)
    outside[16:80, 32:96] = False
    assert np.array_equal(result.rgb[outside], whole[0].rgb[outside])
    assert rms(result.rgb, truth, np.s_[16:80, 32:96]) < 0.85 * rms(whole[0].rgb, truth, np.s_[16:80, 32:96])
    assert rms(average_results(part, [still(whole[0])], []).rgb, truth[16:80, 32:96]) < 0.85 * rms(
        part.rgb, truth[16:80, 32:96]
    )


@pytest.mark.parametrize("alpha", [False, True])
def test_bands_of_rows_agree(monkeypatch, alpha):
    frames = [frame_of(texture(0.7 * seed), seed) for seed in range(3)]
    for frame in frames:
        frame.alpha = frame.rgb[..., :1].copy() if alpha else None
    dark = np.float32([1, 0.2])[(np.mgrid[0:HEIGHT, 0:WIDTH][0] > 50).astype(int)][..., None]
    frames[2].rgb *= dark

    def result(rows):
        monkeypatch.setattr(bands, "BAND_ROWS", rows)
        monkeypatch.setattr(bands, "BAND_PIXELS", 1)
        return average_results(frames[1], [moved(frames[0], -0.7, 0.4)], [moved(frames[2], 0.7, -3.3)])

    whole, parts = result(1024), result(16)
    assert np.allclose(whole.rgb, parts.rgb, rtol=1e-5) and np.allclose(whole.frames, parts.frames, rtol=1e-5)
    assert alpha == (parts.alpha is not None)


def test_differences_of_any_brightness_are_relative():
    own, other = np.float32([1, 4, 0, 3e38, 3e38, 0]), np.float32([1, 1, 0, 1.5e38, 0, 3e38])
    for steep in (False, True):
        squares = np.float64([0, 1.5, 0, np.sqrt(0.5), np.inf, np.inf]) ** (4 if steep else 2)
        np.testing.assert_allclose(likeness(own, other, 1e-20, 1, steep=steep), 1 / (1 + squares), rtol=1e-5)


@pytest.mark.parametrize("lights", [(1.5, 1.5, 1.5), (0.9, 0.9, 0.9), (1, 1, 1.5), (1.3, 0.92, 0.7)])
def test_a_frame_in_another_light_does_not_count(lights):
    frame = frame_of(texture(), 1)
    others = [frame_of(texture() * np.float32(lights), seed) for seed in (2, 3)]
    result = average_results(frame, [still(others[0])], [still(others[1])])
    assert np.allclose(result.rgb.mean(axis=(0, 1)), frame.rgb.mean(axis=(0, 1)), rtol=0.01)
    assert result.frames.mean() < 1.1


def test_frames_that_were_averaged_before_count():
    """The renders of three frames were averaged, and no fused neighbour is added."""
    frame = frame_of(texture(), 1)
    frame.frames = np.full((*frame.rgb.shape[:2], 1), 3, np.float32)
    assert average_results(frame, [], []).frames == pytest.approx(3)
