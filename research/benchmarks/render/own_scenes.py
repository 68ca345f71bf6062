# SPDX-License-Identifier: Apache-2.0
"""Small scenes for Mitsuba 3 that are built here, so that anybody can render them: what breaks denoisers, one each."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

#: A Mitsuba scene as a dictionary, without sensor and integrator.
SceneDict = dict[str, Any]
#: Light groups of the scene with many lamps.
GROUPS = ("warm", "cold")


def _diffuse(*reflectance: float) -> SceneDict:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": reflectance}}


def _light(*radiance: float) -> SceneDict:
    return {"type": "area", "radiance": {"type": "rgb", "value": radiance}}


def _walls(mi: Any) -> SceneDict:
    """Return a box from -1 to 1 that is open to the front (+z), with a lamp below its ceiling."""
    to = mi.ScalarTransform4f
    sides = {
        "floor": (to().translate([0, -1, 0]).rotate([1, 0, 0], -90), (0.6, 0.6, 0.6)),
        "ceiling": (to().translate([0, 1, 0]).rotate([1, 0, 0], 90), (0.7, 0.7, 0.7)),
        "back": (to().translate([0, 0, -1]), (0.65, 0.65, 0.6)),
        "left": (to().translate([-1, 0, 0]).rotate([0, 1, 0], 90), (0.6, 0.1, 0.08)),
        "right": (to().translate([1, 0, 0]).rotate([0, 1, 0], -90), (0.1, 0.4, 0.1)),
    }
    scene: SceneDict = {
        name: {"type": "rectangle", "to_world": place, "bsdf": _diffuse(*colour)}
        for name, (place, colour) in sides.items()
    }
    place = to().translate([0, 0.99, 0]).rotate([1, 0, 0], 90).scale(0.25)
    return scene | {"lamp": {"type": "rectangle", "to_world": place, "emitter": _light(15, 13, 10)}}


def room(mi: Any) -> SceneDict:
    """Build a box with two blocks, lit by a lamp."""
    to = mi.ScalarTransform4f
    tall = to().translate([-0.35, -0.4, -0.3]).rotate([0, 1, 0], 20).scale([0.28, 0.6, 0.28])
    short = to().translate([0.35, -0.72, 0.25]).rotate([0, 1, 0], -18).scale(0.28)
    blocks = {"tall": tall, "short": short}
    return _walls(mi) | {k: {"type": "cube", "to_world": v, "bsdf": _diffuse(0.7, 0.7, 0.7)} for k, v in blocks.items()}


def glass(mi: Any) -> SceneDict:
    """Build a ball of glass and one of rough metal, with caustics."""
    balls = {"glass": (-0.4, {"type": "dielectric"}), "metal": (0.45, {"type": "roughconductor", "alpha": 0.15})}
    return _walls(mi) | {
        name: {"type": "sphere", "center": [x, -0.6, 0.1], "radius": 0.38, "bsdf": bsdf}
        for name, (x, bsdf) in balls.items()
    }


def hair(mi: Any) -> SceneDict:
    """Build a tuft of hairs, thinner than a pixel."""
    rng = np.random.default_rng(1)
    scene = _walls(mi)
    for i in range(120):
        root, tip = rng.normal(0, 0.12, 3), rng.normal(0, 0.45, 3)
        p0, p1 = root + np.array([0, -1, 0]), tip + np.array([0, 0.1, 0])
        hair_bsdf = _diffuse(*rng.uniform(0.2, 0.6) * np.array([1.0, 0.7, 0.4]))
        scene[f"hair{i}"] = {"type": "cylinder", "p0": [*p0], "p1": [*p1], "radius": 0.004, "bsdf": hair_bsdf}
    return scene


def text(mi: Any) -> SceneDict:
    """Build a wall with rows of letters and thin lines."""
    from PIL import Image, ImageDraw

    image = Image.new("RGB", (512, 512), (225, 220, 205))
    draw = ImageDraw.Draw(image)
    for row in range(24):
        draw.text((12, 8 + 14 * row), "Thin lines, and letters as small as these " * 2, fill=(20, 20, 30))
    for i in range(60):
        draw.line([(8 * i, 360), (8 * i + 40, 512)], fill=(30, 60, 160), width=1)
    bitmap = mi.Bitmap(np.asarray(image, np.float32) / 255)
    scene = _walls(mi)
    scene["back"]["bsdf"] = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": bitmap, "raw": True}}
    return scene


def fog(mi: Any) -> SceneDict:
    """Build the room filled with fog."""
    medium = {"type": "homogeneous", "albedo": {"type": "rgb", "value": [0.9, 0.9, 0.9]}, "sigma_t": 0.6}
    place = mi.ScalarTransform4f().scale(0.985)
    return room(mi) | {"fog": {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": medium}}


def foliage(mi: Any) -> SceneDict:
    """Build leaves close to the lens, out of focus, before a room."""
    rng, to, scene = np.random.default_rng(2), mi.ScalarTransform4f, room(mi)
    for i in range(80):
        x, y, z = rng.uniform(-0.8, 0.8), rng.uniform(-0.7, 0.7), rng.uniform(1.6, 2.2)
        place = to().translate([x, y, z]).rotate([*rng.normal(size=3)], rng.uniform(0, 180)).scale(0.04)
        scene[f"leaf{i}"] = {"type": "disk", "to_world": place, "bsdf": _diffuse(0.08, rng.uniform(0.2, 0.45), 0.05)}
    scene["sun"] = {"type": "point", "position": [0.5, 1.5, 3.5], "intensity": {"type": "rgb", "value": [6, 6, 5]}}
    return scene


def lamps(mi: Any, group: str | None = None) -> SceneDict:
    """Build a room with 24 small lamps of two groups. ``group``: only its lamps shine; None for all."""
    rng, scene = np.random.default_rng(3), room(mi)
    del scene["lamp"]
    for i in range(24):
        name = GROUPS[i % 2]
        at, power = rng.uniform(-0.9, 0.9, 3), 25 * float(group in (None, name))
        radiance = power * np.array([1.0, 0.6, 0.3] if name == "warm" else [0.4, 0.6, 1.0])
        scene[f"lamp{i}"] = {"type": "sphere", "center": [*at], "radius": 0.02, "emitter": _light(*radiance)}
    return scene


def stars(mi: Any) -> SceneDict:
    """Build a dim planet before black space with stars smaller than a pixel."""
    rng = np.random.default_rng(4)
    bsdf = _diffuse(0.4, 0.45, 0.5)
    scene: SceneDict = {"planet": {"type": "sphere", "center": [0.3, -0.3, 0], "radius": 0.6, "bsdf": bsdf}}
    for i in range(100):
        at, radiance = [*rng.uniform(-2, 2, 2), -2.5], float(10 ** rng.uniform(0, 1.5))
        scene[f"star{i}"] = {"type": "sphere", "center": at, "radius": 0.005, "emitter": _light(*[radiance] * 3)}
    scene["sun"] = {"type": "directional", "direction": [1, -0.3, -0.6], "irradiance": 2.0}
    return scene


SCENES: dict[str, Callable[[Any], SceneDict]] = {
    build.__name__: build for build in (room, glass, hair, text, fog, foliage, lamps, stars)
}
