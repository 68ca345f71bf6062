# SPDX-License-Identifier: Apache-2.0
"""Pixels that show another surface in the neighbour are found by their albedo."""

import numpy as np

from oiio_msspl.exr.render import Render
from oiio_msspl.fusion.motion.surfaces import other_surfaces

SIZE, SQUARE = 96, 6


def render(shift):
    """A grey wall, and before it an object of dark and bright squares that has moved."""
    squares = np.random.default_rng(1).choice([0.2, 0.8], (SIZE // SQUARE, SIZE // SQUARE))
    albedo = np.full((SIZE, SIZE, 3), 0.5, np.float32)
    albedo[24:72, 24 + shift : 72 + shift] = squares.repeat(SQUARE, 0).repeat(SQUARE, 1)[24:72, 24:72, None]
    return Render.from_arrays("frame", rgb=albedo, albedo=albedo)


def found(vectors):
    everywhere = np.broadcast_to(np.float32(vectors), (SIZE, SIZE, 2))
    return other_surfaces(render(0), render(12), ["albedo"], everywhere, np.ones((SIZE, SIZE), bool))


def test_most_squares_that_have_the_same_colour_by_chance_are_another_surface():
    other = found([0, 0])
    assert other[30:66, 30:66].mean() > 0.85
    assert not other[:16].any() and not other[:, :12].any()


def test_an_object_that_is_followed_is_the_same_surface():
    assert not found([12, 0])[32:64, 32:64].any()


def test_a_blurred_edge_with_few_samples_is_no_other_surface():
    covered = np.clip(np.linspace(-2, 3, SIZE, dtype=np.float32), 0, 1)
    renders = []
    for seed in (1, 2):
        shown = np.random.default_rng(seed).random((SIZE, SIZE)) < covered  # one sample a pixel
        albedo = np.where(shown[..., None], np.float32(0.8), np.float32(0.2)).repeat(3, axis=2)
        renders.append(Render.from_arrays("frame", rgb=albedo, albedo=albedo))
    vectors = np.zeros((SIZE, SIZE, 2), np.float32)
    assert other_surfaces(*renders, ["albedo"], vectors, np.ones((SIZE, SIZE), bool)).mean() < 0.002


def test_a_thing_that_turns_is_the_same_surface_if_vectors_follow_it():
    renders = []
    for degrees in (30, 34):
        normal = np.zeros((SIZE, SIZE, 3), np.float32)
        normal[..., 0], normal[..., 2] = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
        renders.append(Render.from_arrays("frame", rgb=normal, normal=normal))
    vectors = np.zeros((SIZE, SIZE, 2), np.float32)
    pair = *renders, ["normal"], vectors, np.ones((SIZE, SIZE), bool)
    assert not other_surfaces(*pair).any()
    assert other_surfaces(*pair, turns=False).all()
