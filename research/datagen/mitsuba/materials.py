# SPDX-License-Identifier: Apache-2.0
"""Random materials as Mitsuba dictionaries.

Only plugins whose lobes can be evaluated one by one, so that the diffuse and specular layers are exact. Every
reflectance is a bitmap, even a plain one: fewer kinds of material make smaller kernels, which compile faster.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from research.datagen import textures

Rng = np.random.Generator
Bsdf = dict

_METALS = ["Au", "Cu", "Al", "Cr", "Ag", "W", "none"]


def bitmap(image: np.ndarray) -> dict:
    """Return a texture of linear values; (H, W) or (H, W, C)."""
    image = np.ascontiguousarray(np.atleast_3d(image), np.float32)
    if min(image.shape[:2]) < 2:
        image = image.repeat(2, 0).repeat(2, 1)
    return {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True, "filter_type": "bilinear"}


def _both_sides(bsdf: Bsdf) -> Bsdf:
    return {"type": "twosided", "bsdf": bsdf}


def diffuse(image: np.ndarray) -> Bsdf:
    return _both_sides({"type": "diffuse", "reflectance": bitmap(image)})


def bumpy(image: np.ndarray, height: np.ndarray, scale: float) -> Bsdf:
    inner = {"type": "diffuse", "reflectance": bitmap(image)}
    return _both_sides({"type": "bumpmap", "height": bitmap(height), "scale": scale, "bsdf": inner})


def glossy(image: np.ndarray, alpha: float) -> Bsdf:
    return _both_sides({"type": "roughplastic", "diffuse_reflectance": bitmap(image), "alpha": alpha})


def varnished(image: np.ndarray) -> Bsdf:
    return _both_sides({"type": "plastic", "diffuse_reflectance": bitmap(image)})


def mirror(tint: np.ndarray) -> Bsdf:
    return _both_sides({"type": "conductor", "material": "none", "specular_reflectance": bitmap(tint)})


def glass(ior: float = 1.5) -> Bsdf:
    return {"type": "dielectric", "int_ior": ior}


def pane() -> Bsdf:
    return {"type": "thindielectric"}


def structure(rng: Rng, image: np.ndarray | None = None) -> Bsdf:
    """For walls and floors: mostly matt, sometimes polished."""
    image = textures.pattern(rng, 0.35) if image is None else image
    kind = rng.random()
    if kind < 0.6:
        return diffuse(image)
    if kind < 0.7:
        return bumpy(image, textures.fractal(rng, rng.uniform(0.8, 1.6)), rng.uniform(0.01, 0.08))
    if kind < 0.93:
        return glossy(image, 10 ** rng.uniform(-1.7, -0.4))
    return varnished(image)


def metal(rng: Rng) -> Bsdf:
    tint = np.broadcast_to(0.4 + 0.6 * textures.color(rng, 0.2, 0.95), (2, 2, 3))
    name = _METALS[rng.integers(len(_METALS))]
    if rng.random() < 0.25:
        return mirror(tint)
    alpha = np.full((2, 2), 10 ** rng.uniform(-2, -0.35))
    if rng.random() < 0.4:
        alpha = np.clip(textures.fractal(rng, rng.uniform(0.4, 1.5)) * alpha[0, 0] * 2, 0.01, 0.7)
    rough = {"type": "roughconductor", "material": name, "distribution": "ggx", "alpha": bitmap(alpha)}
    return _both_sides(rough | {"specular_reflectance": bitmap(tint)})


def clear(rng: Rng) -> Bsdf:
    """Glass for closed meshes."""
    if rng.random() < 0.7:
        return glass(rng.uniform(1.3, 1.7))
    return {"type": "roughdielectric", "distribution": "ggx", "alpha": 10 ** rng.uniform(-1.7, -0.5)}


def thing(rng: Rng, image: np.ndarray | None = None, shiny: float = 0.25, clear_share: float = 0.08) -> Bsdf:
    """For objects: anything. With an `image` only what shows it."""
    if image is None:
        kind = rng.random()
        if kind < clear_share:
            return clear(rng)
        if kind < clear_share + shiny:
            return metal(rng)
        image = textures.pattern(rng, 0.4)
    kind = rng.random()
    if kind < 0.5:
        return diffuse(image)
    if kind < 0.85:
        return glossy(image, 10 ** rng.uniform(-1.8, -0.4))
    return varnished(image)
