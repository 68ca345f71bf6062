# SPDX-License-Identifier: Apache-2.0
"""Procedural bitmaps: float32 (H, W, 3), linear, 0..1, seamless where the pattern allows."""

from __future__ import annotations

import colorsys
from collections.abc import Callable

import numpy as np
from PIL import Image, ImageDraw, ImageFont

Rng = np.random.Generator
SIZE = 512


def color(rng: Rng, low: float = 0.02, high: float = 0.85) -> np.ndarray:
    """Draw a linear colour; value log-uniform-ish in [low, high], so dark albedos are not rare."""
    value = low * (high / low) ** rng.beta(2.2, 1.0)
    saturation = rng.beta(1.0, 1.6)
    return np.array(colorsys.hsv_to_rgb(rng.random(), saturation, value), np.float32)


def fractal(rng: Rng, slope: float, stretch: float = 1.0, size: int = SIZE) -> np.ndarray:
    """1/f^slope noise, (size, size) in 0..1, 0.2 about 0.5; `stretch` > 1 lengthens it in x."""
    fy, fx = np.fft.fftfreq(size)[:, None] * size, np.fft.rfftfreq(size)[None] * size
    f = np.hypot(fx * stretch, fy)
    f[0, 0] = 1
    spectrum = np.fft.rfft2(rng.normal(size=(size, size))) / f**slope
    spectrum[0, 0] = 0
    x = np.fft.irfft2(spectrum, s=(size, size))
    return np.clip(0.5 + 0.2 * x / x.std(), 0, 1).astype(np.float32)


def _mix(a: np.ndarray, b: np.ndarray, t: np.ndarray) -> np.ndarray:
    return a + (b - a) * t[..., None]


def _grid() -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    return x, y


def plain(rng: Rng) -> np.ndarray:
    return np.broadcast_to(color(rng), (4, 4, 3)).copy()


def noise(rng: Rng) -> np.ndarray:
    return _mix(color(rng), color(rng), fractal(rng, rng.uniform(0.3, 1.8)))


def photo_like(rng: Rng) -> np.ndarray:
    """Three correlated 1/f channels: the spectrum of a photograph."""
    base, slope = fractal(rng, 1.1), rng.uniform(0.9, 1.4)
    channels = np.stack([fractal(rng, slope) for _ in range(3)], -1)
    return np.clip(0.6 * base[..., None] + 0.5 * channels * (0.4 + color(rng)) - 0.1, 0.01, 0.95) ** 2


def checker(rng: Rng) -> np.ndarray:
    x, y = _grid()
    k = rng.choice([4, 8, 16, 32])
    return _mix(color(rng), color(rng), ((x * k).astype(int) + (y * k).astype(int)) % 2)


def stripes(rng: Rng) -> np.ndarray:
    x, y = _grid()
    a, b = rng.integers(0, 24), rng.integers(0, 24)
    phase = (a * x + (b if a + b else 8) * y) % 1
    return _mix(color(rng), color(rng), (phase < rng.uniform(0.1, 0.6)).astype(np.float32))


def _tiles(rng: Rng, columns: int, rows: int, offset: float, gap: float) -> np.ndarray:
    x, y = _grid()
    row = (y * rows).astype(int)
    across = x * columns + offset * (row % 2)
    column = across.astype(int) % columns
    u, v = across % 1, (y * rows) % 1
    joint = (u < gap) | (v < gap * rows / columns)
    tint = rng.uniform(0.6, 1.1, (rows, columns, 1)) * (1 + 0.1 * rng.normal(size=(rows, columns, 3)))
    face = color(rng) * tint[row, column] * (0.75 + 0.5 * fractal(rng, 0.8)[..., None])
    return np.where(joint[..., None], color(rng), face)


def bricks(rng: Rng) -> np.ndarray:
    k = int(rng.choice([4, 6, 8]))
    return _tiles(rng, k, 2 * k, 0.5, rng.uniform(0.04, 0.1))


def tiles(rng: Rng) -> np.ndarray:
    k = int(rng.choice([4, 8, 12, 16]))
    return _tiles(rng, k, k, 0.0, rng.uniform(0.02, 0.1))


def wood(rng: Rng) -> np.ndarray:
    """Planks: each its own stretch of grain."""
    planks = int(rng.choice([3, 5, 8]))
    _, y = _grid()
    grain = fractal(rng, 1.0, stretch=12)
    rings = 0.5 + 0.5 * np.sin(60 * fractal(rng, 2.2, stretch=6) + 6 * grain)
    row = (y * planks).astype(int)
    t = 0.55 * rings + 0.45 * grain
    base = np.array([0.35, 0.17, 0.07], np.float32) * rng.uniform(0.15, 1.6) * rng.uniform(0.8, 1.2, 3)
    c = _mix(base * 0.45, base * 1.3, t) * rng.uniform(0.6, 1.2, (planks, 1))[row]
    return np.where(((y * planks) % 1 < 0.03)[..., None], base * 0.15, c)


def glyphs(rng: Rng) -> np.ndarray:
    """Rows of text, sometimes dense pages and sometimes large letters."""
    ink = rng.random() < 0.75
    paper, pen = color(rng, 0.4, 0.9), color(rng, 0.01, 0.1)
    image = Image.new("L", (SIZE, SIZE), 0)
    draw, size = ImageDraw.Draw(image), int(rng.choice([12, 18, 28, 60]))
    font = ImageFont.load_default(size)
    letters = np.array(list("abcdefghijklmnopqrstuvwxyz      ABCDEFG0123456789.,"))
    for y in range(4, SIZE - size, int(size * 1.25)):
        if rng.random() < 0.9:
            draw.text((int(rng.integers(2, 40)), y), "".join(rng.choice(letters, 100)), fill=255, font=font)
    t = np.asarray(image, np.float32) / 255
    return _mix(paper, pen, t) if ink else _mix(pen, paper, t)


def carpet(rng: Rng) -> np.ndarray:
    """Fine, near-white noise over a broad pattern."""
    pattern = (fractal(rng, 2.0) > 0.5).astype(np.float32)
    t = np.clip(0.7 * pattern + 0.5 * (rng.random((SIZE, SIZE)) - 0.3), 0, 1)
    return _mix(color(rng), color(rng), t.astype(np.float32))


def marble(rng: Rng) -> np.ndarray:
    x, _ = _grid()
    t = np.abs(np.sin(np.pi * (rng.integers(1, 4) * x + 3 * fractal(rng, 1.6))))
    return _mix(color(rng, 0.01, 0.3), color(rng, 0.2, 0.9), t ** rng.uniform(0.2, 1))


def dots(rng: Rng) -> np.ndarray:
    x, y = _grid()
    k = rng.choice([6, 12, 24])
    r = np.hypot((x * k) % 1 - 0.5, (y * k) % 1 - 0.5)
    return _mix(color(rng), color(rng), (r < rng.uniform(0.15, 0.45)).astype(np.float32))


def scratches(rng: Rng) -> np.ndarray:
    image = Image.new("L", (SIZE, SIZE), 0)
    draw = ImageDraw.Draw(image)
    for _ in range(300):
        p = rng.uniform(0, SIZE, 2)
        q = p + rng.normal(size=2) * 60
        draw.line([*p, *q], fill=int(rng.integers(60, 255)))
    return _mix(color(rng), color(rng), np.asarray(image, np.float32) / 255)


def palette(rng: Rng) -> np.ndarray:
    """64 unrelated colours side by side, for meshes whose parts each take one."""
    return np.stack([color(rng) for _ in range(64)])[None].repeat(2, 0)


def foliage(rng: Rng) -> np.ndarray:
    """Return the kindred colours of one plant, as `palette`; darker towards v = 0."""
    base = np.array(colorsys.hsv_to_rgb(rng.uniform(0.08, 0.4), rng.uniform(0.4, 0.9), rng.uniform(0.08, 0.5)))
    c = base * rng.uniform(0.4, 1.5, (1, 64, 1)) * (1 + 0.12 * rng.normal(size=(1, 64, 3)))
    return np.clip(c * np.linspace(1.2, 0.5, 8)[:, None, None], 0.005, 0.9)


PATTERNS: list[Callable[[Rng], np.ndarray]] = [
    noise, photo_like, checker, stripes, bricks, tiles, wood, wood, glyphs, carpet, marble, dots, scratches,
]  # fmt: skip


def pattern(rng: Rng, plainness: float = 0.25) -> np.ndarray:
    """Draw a plain colour with probability `plainness`, else one of `PATTERNS`."""
    if rng.random() < plainness:
        return plain(rng)
    image = PATTERNS[rng.integers(len(PATTERNS))](rng)
    return np.clip(image, 0.003, 0.95).astype(np.float32)


def sky(rng: Rng, height: int = 512) -> np.ndarray:
    """Draw an environment (height, 2 height, 3), rows from the zenith down, mostly with a sun."""
    elevation = np.linspace(np.pi / 2, -np.pi / 2, height)[:, None]
    azimuth = np.linspace(0, 2 * np.pi, 2 * height, endpoint=False)[None]
    up = np.clip(np.sin(elevation), 0, 1)
    horizon, zenith = color(rng, 0.3, 1.0), color(rng, 0.1, 0.8) * (0.6, 0.8, 1.3)
    image = _mix(horizon, zenith, np.sqrt(up) + 0 * azimuth)
    cloud = np.clip((fractal(rng, 1.5, size=2 * height)[:height] - 0.5) * 4, 0, 1) * (up > 0)
    image = _mix(image, np.full(3, rng.uniform(0.5, 1.5), np.float32), cloud * rng.uniform(0, 1))
    image = np.where((elevation < 0)[..., None], image * color(rng, 0.05, 0.4), image)
    if rng.random() < 0.75:
        at, turn = rng.uniform(0.08, 1.1), rng.uniform(0, 2 * np.pi)
        cosine = np.sin(elevation) * np.sin(at) + np.cos(elevation) * np.cos(at) * np.cos(azimuth - turn)
        warm = np.array([1.0, 0.55 + 0.4 * min(at, 1), 0.25 + 0.6 * min(at, 1)])
        image = image + (cosine > np.cos(0.03))[..., None] * warm * 10 ** rng.uniform(2.5, 4.2)
        image = image + 4 * np.exp((cosine - 1)[..., None] * 60) * warm
    return image.astype(np.float32)
