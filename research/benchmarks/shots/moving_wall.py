# SPDX-License-Identifier: Apache-2.0
"""Write a shot of real size whose clean light is known: a textured wall past which the camera moves.

It has noise of 1 spp, albedo, normal, depth and exact motion vectors, as half-float EXRs. With lamps, both renders have
light groups.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from oiio_msspl.image.arrays import Array
from oiio_msspl.image.filters import box_downsample, enlarged
from research.benchmarks.render.film import write_exr

#: How many pixels the wall moves to the left from one frame to the next.
STEP = 3
#: Size of the wall's stains, and of the places where one lamp or another is brighter, in pixels.
STAIN, LIT = 8, 48


def clean_frame(number: int, count: int, width: int, height: int, lamps: int) -> tuple[Array, list[Array]]:
    """Return the wall's colour in a frame, (height, width, 3), and its light from each lamp; from all without groups.

    Args:
        count: frames of the shot.
    """
    wide = width + STEP * count
    stains = np.random.default_rng(0).random((-(-height // STAIN), -(-wide // STAIN), 3), np.float32)
    wall = (0.1 + 0.8 * enlarged(stains, STAIN)[:height, :wide]).astype(np.float32)
    parts = np.ones((1, height, wide, 1), np.float32)
    if lamps:
        lights = np.random.default_rng(1).random((lamps, -(-height // LIT), -(-wide // LIT), 1), np.float32)
        parts = np.stack([enlarged(light, LIT) for light in lights / lights.sum(axis=0)])
    colour, *shares = (image[:height, STEP * number :][:, :width] for image in (wall, *parts))
    return colour, [np.float32(0.5) * colour * share for share in shares]


def write_shot(folder: Path, count: int, width: int, height: int, scale: int, lamps: int = 0) -> None:
    """Write the frames of both renders, with the light of each lamp as a layer."""
    for name in ("lr", "hr"):
        (folder / name).mkdir()
    for number in range(1, count + 1):
        colour, clean = clean_frame(number, count, width, height, lamps)
        for name, factor, spp in (("lr", scale, scale**2), ("hr", 1, 1)):
            albedo = box_downsample(colour, factor)
            rng = np.random.default_rng([number, factor])
            noise = rng.gamma(spp, 1 / spp, (len(clean), *albedo.shape[:2], 1)).astype(np.float32)
            light = [box_downsample(image, factor) * part for image, part in zip(clean, noise, strict=True)]
            layers = {"": (sum(light), "RGB"), "albedo": (albedo, "RGB")}
            layers |= {f"light_{i}": (image, "RGB") for i, image in enumerate(light[:lamps])}
            layers["N"] = (np.full_like(albedo, (0, 0, 1)), "XYZ")
            if name == "hr":
                back = np.full((height, width, 2), (STEP, 0), np.float32)
                layers |= {"depth": (np.full((height, width, 1), 5, np.float32), "Z")}
                layers |= {"motionBack": (back, "XY"), "motionFore": (-back, "XY")}
            write_layers(folder / name / f"{name}.{number:04d}.exr", layers)


def write_layers(path: Path, layers: Mapping[str, tuple[Array, str]]) -> None:
    """Write layers (h, w, c), each with a letter for every channel, as half floats."""
    channels = [f"{layer}.{letter}".lstrip(".") for layer, (_, letters) in layers.items() for letter in letters]
    write_exr(path, np.concatenate([image for image, _ in layers.values()], axis=-1), channels)
