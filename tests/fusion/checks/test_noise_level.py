# SPDX-License-Identifier: Apache-2.0
"""Whether albedo and normal are clean is told by their edges, and not by the noise of the light."""

import numpy as np
import pytest

from oiio_msspl.exr.render import Render
from oiio_msspl.fusion.checks.noise import has_clean_aovs, has_little_noise, is_noise_spread
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.jobs.settings import family_for_noise
from tests.conftest import spread

SIZE = 96


def checks(samples, seed=1):
    """The albedo (h, w, 3) of a turned checkerboard, with so many samples in each pixel."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:SIZE, :SIZE][..., None] + rng.random((2, SIZE, SIZE, samples))
    board = (np.floor((x + 0.4 * y) / 14) + np.floor((y - 0.4 * x) / 14)) % 2
    return np.repeat(0.2 + 0.5 * board.mean(axis=-1, keepdims=True), 3, axis=-1).astype(np.float32)


def render_of(albedo, light=0.0, seed=2):
    """A render whose light has noise of this deviation."""
    noise = np.random.default_rng(seed).normal(1, light, (*albedo.shape[:2], 1)).astype(np.float32)
    return Render.from_arrays(rgb=albedo * noise, albedo=albedo, normal=np.full_like(albedo, 0.5))


@pytest.mark.parametrize("light", [0.0, 0.5])
@pytest.mark.parametrize(("samples", "clean"), [(1, False), (2, False), (16, True), (64, True)])
def test_few_samples_show_at_the_edges_of_an_albedo(samples, clean, light):
    hr = render_of(checks(samples), light)
    assert has_clean_aovs(hr, align(hr, hr)) is clean
    lr = Render.from_arrays(rgb=box_downsample(hr.layers["rgb"], 2))
    assert has_clean_aovs(hr, align(lr, hr)) is clean


def test_aovs_without_an_edge_and_renders_without_aovs_are_clean():
    plain = render_of(np.full((SIZE, SIZE, 3), 0.5, np.float32), 0.5)
    without = Render.from_arrays(rgb=checks(1))
    assert has_clean_aovs(plain, align(plain, plain)) and has_clean_aovs(without, align(without, without))


@pytest.mark.parametrize("samples", [2, 64])
def test_only_best_takes_the_model_for_little_noise_if_aovs_are_noisy(samples):
    """A room with even light has little noise at 2 spp, and the other model copies the noise of its AOVs."""
    albedo = checks(samples)
    albedo[:, SIZE // 3 :] = 0.5
    hr = render_of(albedo, 0.02)
    for family, clean in (("joint-large", True), ("joint", samples == 64)):
        assert family_for_noise(family, hr, hr, align(hr, hr))[0] == family + "-clean" * clean


@pytest.mark.parametrize(("light", "best", "balanced"), [(0.25, True, True), (0.35, True, False), (0.6, False, False)])
def test_a_model_that_denoises_albedo_and_normal_before_is_taken_in_more_noise(light, best, balanced):
    hr = render_of(checks(64), light)
    for family, clean in (("joint-large", best), ("joint", balanced)):
        assert family_for_noise(family, hr, hr, align(hr, hr))[0] == family + "-clean" * clean


@pytest.mark.parametrize(("of_lr", "best"), [(0.25, False), (0.03, True)])
def test_a_clean_lrhs_makes_up_for_a_noisy_hrls(of_lr, best):
    """For a model that denoises albedo and normal before. The other one would leave their noise."""
    hr = render_of(checks(64), 0.5)
    noise = np.random.default_rng(3).normal(1, of_lr, (SIZE // 2, SIZE // 2, 1))
    light = box_downsample(checks(64), 2) * noise
    lr = Render.from_arrays(rgb=light.astype(np.float32))
    for family, clean in (("joint-large", best), ("joint", False)):
        assert family_for_noise(family, lr, hr, align(lr, hr))[0] == family + "-clean" * clean


@pytest.mark.parametrize("scale", [2, 4])
@pytest.mark.parametrize(("noise", "little"), [(0.03, True), (0.3, False)])
def test_fine_texture_of_a_pair_is_no_noise(scale, noise, little):
    """Both renders show it. One render alone can't tell them apart."""
    rng = np.random.default_rng(0)
    texture = rng.uniform(0.2, 0.8, (4 * SIZE, 4 * SIZE, 1))
    lr, hr = (
        Render.from_arrays(rgb=(image * rng.normal(1, noise / size, image.shape)).astype(np.float32).repeat(3, -1))
        for size, image in ((scale, box_downsample(texture, scale)), (1, texture))
    )
    assert has_little_noise(lr, hr, align(lr, hr)) is little
    assert not has_little_noise(hr, hr, align(hr, hr))


def grey(*parts):
    """A render of light 1 with noise of these deviations, each spread by a filter of so many pixels."""
    rng = np.random.default_rng(2)
    light = 1 + sum(spread(rng.normal(0, deviation, (SIZE, SIZE, 1)), sigma) for deviation, sigma in parts)
    return Render.from_arrays(rgb=np.repeat(light, 3, axis=-1).astype(np.float32))


@pytest.mark.parametrize("family", ["joint", "joint-large"])
@pytest.mark.parametrize(
    ("parts", "ending"),
    [
        ([(0.2, 0.6)], "-spread"),
        ([(0.6, 1.5)], "-spread"),
        ([(0.06, 0.6)], ""),
        ([(0.02, 0.6)], "-clean"),
        ([(0.1, 0.6), (0.6, 3)], ""),
        ([(0.1, 0.6), (1, 2.5)], "-clean"),
    ],
)
def test_models_for_spread_noise_are_not_taken_for_one_render_with_less_of_it(family, parts, ending):
    """They take detail for noise. Wide filters are no texture, which is alike over more pixels."""
    hr = grey(*parts)
    alignment = align(hr, hr)
    assert is_noise_spread(hr, hr, alignment)
    assert family_for_noise(family, hr, hr, alignment) == (family + ending, ending)
