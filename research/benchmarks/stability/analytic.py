# SPDX-License-Identifier: Apache-2.0
"""Define scenes with exact references, and render them with the noise of one-sample Monte Carlo.

A scene is defined at ``SUB`` x ``SUB`` points in each pixel. A sample picks one of the points under its pixel filter.
Then it picks the front, with the probability of its coverage, or the back; whether it sees the light (Bernoulli); and
how much ambient and glossy light arrives (exponential, the glossy light is rare and strong). The reference is the
expectation of this, computed without sampling. The mean of many renders converges to it.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.exr.render import Render
from oiio_msspl.image.arrays import Array

#: Points a pixel along each axis.
SUB = 4
#: Share of samples that see any glossy light.
GLOSS_SEEN = 0.4
#: Features of a surface and their channels, in the order in which they are stacked.
CHANNELS = {"albedo": 3, "normal": 3, "direct": 1, "visible": 1, "ambient": 1, "gloss": 3, "emission": 3}


def surface(shape: tuple[int, int], **features: NDArray | float | tuple[float, ...]) -> Array:
    """Return features at every point, (h * SUB, w * SUB, 15). Missing ones are 0, and the normal faces the camera.

    Radiance is ``albedo * (direct * visible + ambient) + gloss + emission``; ``visible`` is a probability.
    """
    values = {"normal": (0.0, 0.0, 1.0), **features}
    parts = [np.broadcast_to(values.get(name, 0.0), (*shape, count)) for name, count in CHANNELS.items()]
    return np.concatenate(parts, axis=-1, dtype=np.float32)


def split(points: Array) -> dict[str, Array]:
    """Return stacked features (..., 15) by name."""
    ends = np.cumsum(list(CHANNELS.values()))
    return dict(zip(CHANNELS, np.split(points, ends[:-1], axis=-1), strict=True))


@dataclass(frozen=True, eq=False)
class Scene:
    """A front that partly covers a back, at every point."""

    back: Array
    """See :func:`surface`."""
    front: Array | None = None
    """Features of what covers the back."""
    coverage: Array | None = None
    """Probability that a sample at a point hits the front, (h * SUB, w * SUB, 1), as with lens or motion blur."""


@dataclass(frozen=True, eq=False)
class Footprint:
    """A pixel filter along one axis: points, counted from the first one of the pixel, and their probabilities."""

    offsets: NDArray[np.int64]
    weights: NDArray[np.float64]


def box(scale: int = 1) -> Footprint:
    """Return the box filter of a pixel that is ``scale`` HRLS pixels wide."""
    count = SUB * scale
    return Footprint(np.arange(count), np.full(count, 1 / count))


def point(scale: int) -> Footprint:
    """Return the filter of one of the HRLS pixels that an LRHS pixel covers, as in the paper's LRHS."""
    return Footprint(scale // 2 * SUB + np.arange(SUB), np.full(SUB, 1 / SUB))


def blackman_harris(scale: int = 1, width: float = 3.0) -> Footprint:
    """Return the Blackman-Harris window over ``width`` pixels, as renderers sample it by importance."""
    count = round(width * SUB * scale)
    phase = 2 * np.pi * (np.arange(count) + 0.5) / count
    window = 0.35875 - 0.48829 * np.cos(phase) + 0.14128 * np.cos(2 * phase) - 0.01168 * np.cos(3 * phase)
    return Footprint(np.arange(count) - (count - SUB * scale) // 2, window / window.sum())


def reference(scene: Scene, footprint: Footprint | None = None, scale: int = 1) -> Array:
    """Return expected colour of every pixel, (h / scale, w / scale, 3), with a pixel filter (the box if None)."""
    footprint = footprint or box(scale)
    image = _expected(scene.back)
    if scene.front is not None and scene.coverage is not None:
        image += scene.coverage * (_expected(scene.front) - image)
    for axis in (0, 1):
        first = np.arange(0, image.shape[axis], SUB * scale)
        last = image.shape[axis] - 1
        shifted = (image.take(np.clip(first + offset, 0, last), axis) for offset in footprint.offsets)
        image = functools.reduce(np.add, (w * part for w, part in zip(footprint.weights, shifted, strict=True)))
    return image.astype(np.float32)


def render(
    scene: Scene, spp: int, rng: np.random.Generator, *, footprint: Footprint | None = None, scale: int = 1
) -> Render:
    """Render all layers at 1 / ``scale`` of the scene's resolution. The variance needs at least 2 spp."""
    footprint = footprint or box(scale)
    height, width = (n // (SUB * scale) for n in scene.back.shape[:2])
    corners = np.mgrid[0:height, 0:width] * (SUB * scale)
    total: dict[str, NDArray[np.float64]] = {}
    squares = np.zeros((height, width, 3))
    for _ in range(spp):
        sample = _sample(scene, footprint, corners, rng)
        for name, values in sample.items():
            total[name] = total.get(name, 0.0) + values / spp
        squares += np.square(sample["rgb"]) / spp
    if spp > 1:
        total["variance"] = np.maximum(squares - np.square(total["rgb"]), 0) / (spp - 1)
    layers = {name: values.astype(np.float32) for name, values in total.items()}
    return Render.from_arrays("HRLS" if scale == 1 else "LRHS", **layers)


def _expected(points: Array) -> Array:
    f = split(points)
    return f["albedo"] * (f["direct"] * f["visible"] + f["ambient"]) + f["gloss"] + f["emission"]


def _sample(
    scene: Scene, footprint: Footprint, corners: NDArray[np.int64], rng: np.random.Generator
) -> dict[str, Array]:
    shape = corners.shape[1:]
    steps = np.cumsum(footprint.weights)[:-1]  # the last bin is open, so the rounding of the sum does not matter
    rows, columns = (
        np.clip(corner + footprint.offsets[np.searchsorted(steps, rng.random(shape))], 0, size - 1)
        for corner, size in zip(corners, scene.back.shape[:2], strict=True)
    )
    points = scene.back[rows, columns]
    if scene.front is not None and scene.coverage is not None:
        hit = rng.random((*shape, 1)) < scene.coverage[rows, columns]
        points = np.where(hit, scene.front[rows, columns], points)
    f = split(points)
    seen = rng.random((*shape, 1)) < f["visible"]
    diffuse = f["albedo"] * (f["direct"] * seen + f["ambient"] * rng.exponential(size=(*shape, 1)))
    rare = (rng.random((*shape, 1)) < GLOSS_SEEN) / GLOSS_SEEN
    specular = f["gloss"] * rare * rng.exponential(size=(*shape, 1))
    layers: dict[str, NDArray[Any]] = {"albedo": f["albedo"], "normal": f["normal"], "diffuse": diffuse}
    layers |= {"specular": specular, "rgb": diffuse + specular + f["emission"]}
    return {name: values.astype(np.float32) for name, values in layers.items()}


# Scenes. Lengths are shares of the frame. Those named ``pixels`` are in pixels: a hair is thin at any frame size.


def grid(size: int) -> tuple[Array, Array]:
    """Return (x, y) of all points of a square frame, in [0, 1]."""
    along = (np.arange(size * SUB, dtype=np.float32) + 0.5) / np.float32(size * SUB)
    x, y = np.meshgrid(along, along)
    return x[..., None], y[..., None]


def where(mask: NDArray[np.bool_], yes: Any, no: Any) -> Array:
    """Call np.where in single precision, to save memory."""
    return np.where(mask, np.asarray(yes, np.float32), np.asarray(no, np.float32))


def moved(scene: Scene, x: int, y: int) -> Scene:
    """Return a scene shifted by whole pixels to the right and down. Its border values are repeated."""
    rows, columns = (
        np.clip(np.arange(size) - pixels * SUB, 0, size - 1)
        for size, pixels in zip(scene.back.shape, (y, x), strict=False)
    )
    parts = (scene.back, scene.front, scene.coverage)
    back, front, coverage = (None if part is None else part[rows][:, columns] for part in parts)
    assert back is not None
    return Scene(back, front, coverage)


def room(size: int, *, ball: tuple[float, float] = (0.35, 0.52), light: float = 1.0) -> Scene:
    """Make a checkered wall, a floor of thin tiles, a ball with its soft shadow, a glossy box, posts of all widths.

    ``light`` scales the direct light. The ambient light stays.
    """
    x, y = grid(size)
    wall = where(((np.floor(x * 9) + np.floor(y * 9)) % 2) == 0, (0.7, 0.55, 0.4), (0.25, 0.3, 0.45))
    tiles = where((np.mod(x * 24 + y * 10, 1) < 0.12) | (np.mod(y * 24, 1) < 0.16), 0.12, (0.5, 0.48, 0.42))
    floor = y > 0.66
    albedo = where(floor, tiles, wall)
    normal = where(floor, (0.0, 0.9, 0.44), (0.0, 0.0, 1.0))
    shadow = np.hypot((x - ball[0] - 0.08) / 0.2, (y - ball[1] - 0.19) / 0.07)
    visible = 0.9 * np.clip((shadow - 0.5) / 0.9, 0, 1) * np.clip(1.25 - x, 0.2, 1)
    gloss = np.zeros_like(albedo)

    post = np.zeros_like(x, dtype=bool)
    for i, pixels in enumerate((0.5, 1, 2, 4, 8)):
        post |= (np.abs(x - 0.56 - 0.035 * i) < pixels / 2 / size) & (y < 0.6) & (y > 0.1)
    albedo = where(post, 0.05, albedo)

    inside = (np.abs(x - 0.82) < 0.1) & (np.abs(y - 0.62) < 0.14)
    albedo = where(inside, (0.1, 0.02, 0.02), albedo)
    normal = where(inside, (0.6, 0.0, 0.8), normal)
    gloss = where(inside, 0.8 * np.exp(-np.square((x - y * 0.3 - 0.62) / 0.03)), gloss)

    dx, dy = (x - ball[0]) / 0.15, (y - ball[1]) / 0.15
    radius = dx * dx + dy * dy
    height = np.sqrt(np.clip(1 - radius, 0, 1))
    on_ball = radius < 1
    facing = np.clip(0.6 * height - 0.5 * dy + 0.3 * dx, 0, 1)
    albedo = where(on_ball, (0.75, 0.3, 0.12), albedo)
    normal = where(on_ball, np.concatenate([dx, -dy, height], axis=-1), normal)
    visible = where(on_ball, 0.05 + 0.9 * facing, visible)
    highlight = np.exp(-(np.square(dx - 0.3) + np.square(dy + 0.5)) / 0.02)
    gloss = where(on_ball, 3.0 * highlight, gloss)
    shown = {"albedo": albedo, "normal": normal, "visible": visible, "gloss": gloss}
    return Scene(surface(x.shape[:2], **shown, direct=light, ambient=0.12))


def changed(scene: Scene, **features: NDArray | float) -> Scene:
    """Return the back of a scene with other features."""
    return Scene(surface(scene.back.shape[:2], **(split(scene.back) | features)))


def with_emission(scene: Scene, emission: NDArray, dim: float = 1.0) -> Scene:
    """Put emitters in front of a scene whose own light is dimmed. They have no albedo, as in renderers."""
    features = split(scene.back)
    lit = emission.max(axis=-1, keepdims=True) > 0
    dimmed = {name: where(lit, 0, features[name] * dim) for name in ("direct", "ambient", "gloss")}
    return changed(scene, emission=where(lit, emission, 0), albedo=where(lit, 0, features["albedo"]), **dimmed)


def small_lights(size: int, radiance: float) -> Scene:
    """Make lamps with a radius of 0.3 to 3 pixels in front of a dim room, from ``radiance`` / 1000 to ``radiance``."""
    x, y = grid(size)
    rng = np.random.default_rng(5)
    emission = np.zeros((*x.shape[:2], 3), np.float32)
    for i in range(24):
        at_x, at_y = rng.uniform(0.05, 0.95, 2)
        pixels = 0.3 + 2.7 * rng.random()
        colour = radiance * 10 ** (-3 * i / 23) * np.array([1.0, 0.8, 0.5])
        emission = where(np.hypot(x - at_x, y - at_y) * size < pixels, colour, emission)
    return with_emission(room(size), emission, dim=0.1)


def emitters(size: int) -> Scene:
    """Make bright panels with hard edges, one seen through a grille."""
    x, y = grid(size)
    panel = (np.abs(x - 0.3) < 0.18) & (np.abs(y - 0.22) < 0.1)
    window = (np.abs(x - 0.72) < 0.17) & (np.abs(y - 0.5) < 0.3)
    grille = (np.mod(x * size, 8) < 1.5) | (np.mod(y * size, 16) < 2.5)
    emission = where(panel, (40.0, 38.0, 30.0), where(window & ~grille, (6.0, 9.0, 14.0), (0.0, 0.0, 0.0)))
    return with_emission(room(size), emission, dim=0.5)


def near_black(size: int, traces: float = 0.0) -> Scene:
    """Make a room in which one sample of 200 finds the light.

    ``traces`` is the share of the glossy light that stays; its tails reach down to the smallest floats.
    """
    lit = room(size)
    features = split(lit.back)
    return changed(lit, visible=features["visible"] * 0.005, ambient=0.0, gloss=features["gloss"] * traces)


def door_ajar(size: int, seen: float) -> Scene:
    """Make a room with a plain white wall, lit through a door that is hardly open.

    A share ``seen`` of the samples finds the light, which gets weaker to the left. Nothing else is lit.
    """
    (x, y), lit = grid(size), room(size)
    features = split(lit.back)
    wall = (y < 0.66) & ~(np.hypot(x - 0.35, y - 0.52) < 0.15)
    albedo = where(wall, 0.8, np.maximum(features["albedo"], 0.2))
    light = np.square(0.2 + x) * (0.4 + 0.6 * features["visible"])
    return changed(lit, albedo=albedo, direct=light / seen, visible=seen, ambient=0.0, gloss=0.0)


def slit(size: int, radiance: float) -> Scene:
    """Make a lamp behind a wall, seen through a vertical slit of a quarter of a pixel and a horizontal one of two.

    One sample of 50 finds its light in the room.
    """
    x, y = grid(size)
    upright = (np.abs(x * size - size // 2 - 0.375) < 0.5 / SUB) & (y > 0.2) & (y < 0.6)
    level = (np.abs(y - 0.3) * size < 1) & (np.abs(x - 0.2) < 0.12)
    emission = where(upright | level, radiance * np.array([1.0, 0.9, 0.7]), 0)
    return with_emission(door_ajar(size, 1 / 50), emission)


def dark_room(size: int) -> Scene:
    """Return a room in which one sample of 10 finds the light, with a trace of ambient light."""
    lit = room(size)
    features = split(lit.back)
    return changed(lit, visible=0.1 * features["visible"], ambient=0.01 * features["ambient"])


def defocused(size: int) -> Scene:
    """Make out-of-focus discs in front of the room. At their rims each sample hits the front or the back."""
    x, y = grid(size)
    coverage = np.zeros_like(x)
    albedo = np.zeros((*x.shape[:2], 3), np.float32)
    rng = np.random.default_rng(7)
    for _ in range(7):
        at_x, at_y, radius = rng.uniform(0.1, 0.9), rng.uniform(0.1, 0.9), rng.uniform(0.04, 0.1)
        blur = radius * rng.uniform(0.4, 1.2)
        disc = np.clip(0.5 + (radius - np.hypot(x - at_x, y - at_y)) / blur, 0, 1)
        albedo = where(disc > coverage, rng.uniform(0.1, 0.9, 3), albedo)
        coverage = np.maximum(coverage, disc)
    front = surface(x.shape[:2], albedo=albedo, normal=(0.5, 0.5, 0.7), direct=1.5, visible=0.6, ambient=0.1)
    return Scene(room(size).back, front, coverage.astype(np.float32))


def moving(size: int) -> Scene:
    """Make a textured bar that moves by 60 pixels in an open shutter, and a small light that leaves a streak."""
    x, y = grid(size)
    travel = 60 / size

    def time_over(left: float, right: float) -> NDArray:
        """Return the share of the time that something between left and right, moving to the right, is at x."""
        return np.clip((np.minimum(x - left, travel) - np.maximum(x - right, 0)) / travel, 0, 1)

    bar = time_over(0.2, 0.4) * ((y > 0.3) & (y < 0.5))
    streak = time_over(0.3, 0.3 + 3 / size) * (np.abs(y - 0.75) * size < 1.5)
    albedo = where(np.mod(y * 40, 1) < 0.5, (0.8, 0.7, 0.2), (0.1, 0.2, 0.5))
    shining = streak > 0
    own = {"albedo": where(shining, 0, albedo), "emission": where(shining, (60.0, 50.0, 30.0), 0)}
    front = surface(x.shape[:2], **own, normal=(-0.6, 0.0, 0.8), direct=1.2, visible=0.7, ambient=0.1)
    return Scene(room(size).back, front, np.maximum(bar, streak).astype(np.float32))


def hairy(size: int) -> Scene:
    """Make curved hairs with a width of 0.1 to 0.8 pixels, lighter than their background."""
    x, y = grid(size)
    cell = 1 / SUB
    coverage = np.zeros_like(x)
    rng = np.random.default_rng(11)
    for _ in range(90):
        start, bend, phase = rng.uniform(0.05, 0.95), rng.uniform(-0.12, 0.12), rng.uniform(0, 6)
        pixels = rng.uniform(0.1, 0.8)
        slope = bend * 4 * np.cos(4 * y + phase)
        distance = np.abs(x - start - bend * np.sin(4 * y + phase)) * size / np.sqrt(1 + slope * slope)
        overlap = np.minimum(distance + cell / 2, pixels / 2) - np.maximum(distance - cell / 2, -pixels / 2)
        coverage = np.maximum(coverage, np.clip(overlap / cell, 0, 1) * (y > 0.1))
    light = {"direct": 1.5, "visible": 0.7, "ambient": 0.1, "gloss": 0.3}
    front = surface(x.shape[:2], albedo=(0.6, 0.42, 0.2), normal=(0.7, 0.0, 0.7), **light)
    return Scene(room(size, light=0.5).back, front, coverage.astype(np.float32))


def glassy(size: int) -> Scene:
    """Return a pane and a lens of albedo 1. Only the specular layer shows what is behind them."""
    (x, y), behind = grid(size), room(size)
    features = split(behind.back)
    pane = (np.abs(x - 0.68) < 0.22) & (np.abs(y - 0.5) < 0.35)
    lens = np.hypot(x - 0.25, y - 0.4) < 0.18
    stripes = np.mod((x + 0.4 * y) * 30, 1) < 0.4
    rings = np.mod(np.hypot(x - 0.25, y - 0.4) * 60, 1) < 0.5
    seen = where(pane, where(stripes, (0.9, 0.7, 0.3), (0.08, 0.1, 0.2)), where(rings, 0.6, (0.1, 0.3, 0.15)))
    shown = {"albedo": 1, "normal": (0.0, 0.1, 0.99), "gloss": seen, "direct": 0, "ambient": 0}
    return changed(behind, **{name: where(pane | lens, value, features[name]) for name, value in shown.items()})
