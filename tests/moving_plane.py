# SPDX-License-Identifier: Apache-2.0
"""A textured plane before a moving camera: its frames, and exactly where its surfaces go."""

from __future__ import annotations

import numpy as np

from oiio_msspl.aovs.matching import map_render
from oiio_msspl.exr.reader import open_exr
from tests.conftest import rgb, write_exr

WIDTH, HEIGHT = 160, 96
#: Pixels per unit at distance 1.
FOCAL = 160.0


def truck_and_dolly(t):
    """A camera that moves to the right, down and forward, faster and faster: (x, y, distance) at time t."""
    return np.array([0.02 * t + 0.01 * t * t, 0.012 * t + 0.005 * t * t, 1.0 - 0.02 * t - 0.008 * t * t])


def truck(t):
    """A camera that moves to the right."""
    return np.array([0.02 * t + 0.01 * t * t, 0.0, 1.0])


def standing(t):
    return np.array([0.0, 0.0, 1.0])


def texture(x, y):
    """Colours (h, w, 3) of the plane at world places."""
    rng = np.random.default_rng(5)
    result = np.full((*x.shape, 3), 0.5)
    for _ in range(24):
        frequency, phase = rng.normal(0, 30, 2), rng.uniform(0, 6.28, 3)
        result += 0.06 * np.sin((x * frequency[0] + y * frequency[1])[..., None] + phase)
    return result.clip(0, 1).astype(np.float32)


def positions(camera, t, x0=0, y0=0, height=HEIGHT, width=WIDTH):
    """World positions (h, w, 3) of the pixels; y points up in the world."""
    cx, cy, distance = camera(t)
    y, x = np.mgrid[y0 : y0 + height, x0 : x0 + width]
    world_x = cx + (x - WIDTH / 2) * distance / FOCAL
    world_y = cy - (y - HEIGHT / 2) * distance / FOCAL
    return np.stack([world_x, world_y, np.full_like(world_x, 3.0)], axis=-1)


def project(camera, t, points):
    """Pixels (h, w, 2) of world positions."""
    cx, cy, distance = camera(t)
    x = (points[..., 0] - cx) * FOCAL / distance + WIDTH / 2
    y = (cy - points[..., 1]) * FOCAL / distance + HEIGHT / 2
    return np.stack([x, y], axis=-1)


def vectors(camera, t, step, **window):
    """Where surfaces of frame t are in frame t + step: (h, w, 2) in pixels, x right, y down."""
    points = positions(camera, t, **window)
    return (project(camera, t + step, points) - project(camera, t, points)).astype(np.float32)


def encode(way, form):
    """Vectors as a renderer stores them."""
    return (way / np.array(form.pixels_per_unit(WIDTH, HEIGHT)) + form.offset).astype(np.float32)


def screen_matrix(camera, t):
    """World to screen for row vectors, where the frame spans -1 to 1 and y points up, as Arnold writes it."""
    cx, cy, distance = camera(t)
    # The plane lies at z = 3, so the camera stands at 3 - distance and looks along z.
    near = 3.0 - distance
    matrix = np.zeros((4, 4), np.float32)
    matrix[0, 0], matrix[1, 1] = 2 * FOCAL / WIDTH, 2 * FOCAL / HEIGHT
    matrix[2, 2] = matrix[2, 3] = 1
    matrix[3] = (-cx * matrix[0, 0], -cy * matrix[1, 1], -near - 0.1, -near)
    return matrix


def camera_matrix(camera, t):
    """World to camera for row vectors."""
    cx, cy, distance = camera(t)
    matrix = np.eye(4, dtype=np.float32)
    matrix[3, :3] = -cx, -cy, distance - 3.0
    return matrix


def frame(folder, t, layers, camera=truck_and_dolly, *, guides=("albedo", "position"), window=None, **attributes):
    """Frame t as a mapped file with these further channels, {name: (h, w)}."""
    window = window or {}
    points = positions(camera, t, **window)
    albedo = texture(points[..., 0], points[..., 1])
    channels = rgb(albedo * np.float32(0.7)) | layers
    if "albedo" in guides:
        channels |= rgb(albedo, "albedo.")
    if "position" in guides:
        channels |= rgb(points.astype(np.float32), "position.", "XYZ")
    display = (np.array([0, 0], np.int32), np.array([WIDTH - 1, HEIGHT - 1], np.int32))
    path = folder / f"plane.{1001 + t}.exr"
    parts = [("", channels, (window.get("x0", 0), window.get("y0", 0)))]
    return map_render(open_exr(write_exr(path, parts, display=display, **attributes)))


def layer(name, values, letters="XY"):
    """Channels of a layer from (h, w, c)."""
    return {f"{name}.{letter}": np.ascontiguousarray(values[..., i]) for i, letter in enumerate(letters)}
