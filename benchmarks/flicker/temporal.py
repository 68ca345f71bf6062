# SPDX-License-Identifier: Apache-2.0
"""A prototype of temporal accumulation: averages frames along the motion of their surfaces.

It accumulates a method's outputs or its inputs. The motion is that of the surfaces: reflections, refractions and
shadows that move otherwise are averaged wrongly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from oiio_msspl.arrays import Array

#: The n-th frame of a surface has the weight 1/n, from this n on 1/LENGTH.
LENGTH = 5
#: A surface counts as another one if its depth differs by more than this share from the depths where it was before.
DEPTH_TOLERANCE = 0.05

Layers = dict[str, Array]


@dataclass(frozen=True)
class Motion:
    """Motion and depth of the surfaces in a frame."""

    vectors: Array
    """(h, w, 2): where the surface of a pixel was in the frame before, as (x, y) in pixels from here, y downwards."""
    depth: Array
    """(h, w)"""

    def reduced(self, scale: int) -> Motion:
        """The same for a picture that is `scale` times smaller, a whole factor."""
        return Motion(_means(self.vectors, scale) / scale, _means(self.depth[..., None], scale)[..., 0])


def accumulate(frames: Sequence[Layers], motions: Sequence[Motion]) -> list[Layers]:
    """The layers (h, w, c) of each frame, averaged with those of earlier frames where these saw the same surface."""
    height, width = motions[0].depth.shape
    result = [frames[0]]
    ages = np.ones((height, width, 1), dtype=np.float32)
    for now, motion, before in zip(frames[1:], motions[1:], motions, strict=False):
        y, x = np.mgrid[0:height, 0:width] + np.moveaxis(motion.vectors, -1, 0)[::-1]
        known = _same_surface(motion.depth, before.depth, y, x)[..., None]
        ages = np.where(known, np.minimum(_sample(ages, y, x) + 1, LENGTH), 1).astype(np.float32)
        result.append({k: v / ages + _sample(result[-1][k], y, x) * (1 - 1 / ages) for k, v in now.items()})
    return result


def _same_surface(depth: Array, before: Array, y: Array, x: Array) -> Array:
    """(h, w): whether (y, x) lies in the frame before, and the depth within that of the 3 x 3 pixels there."""
    height, width = before.shape
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    row, column = (np.rint(v).astype(int) for v in (y, x))
    around = [
        before[np.clip(row + dy, 0, height - 1), np.clip(column + dx, 0, width - 1)]
        for dy in (-1, 0, 1)
        for dx in (-1, 0, 1)
    ]
    nearest, farthest = np.min(around, axis=0), np.max(around, axis=0)
    return inside & (depth > nearest * (1 - DEPTH_TOLERANCE)) & (depth < farthest * (1 + DEPTH_TOLERANCE))


def _sample(image: Array, y: Array, x: Array) -> Array:
    """Bicubic (Catmull-Rom) at pixel positions, clipped to the range of the four nearest pixels against ringing."""
    height, width = image.shape[:2]
    top, left = np.floor(y).astype(int), np.floor(x).astype(int)
    total: Array = np.zeros(1, np.float32)
    nearest = []
    for dy, wy in zip(range(-1, 3), _weights(y - top), strict=True):
        for dx, wx in zip(range(-1, 3), _weights(x - left), strict=True):
            values = image[np.clip(top + dy, 0, height - 1), np.clip(left + dx, 0, width - 1)]
            total = total + values * (wy * wx)[..., None].astype(np.float32)
            if dy in (0, 1) and dx in (0, 1):
                nearest.append(values)
    return np.clip(total, np.min(nearest, axis=0), np.max(nearest, axis=0))


def _weights(t: Array) -> tuple[Array, Array, Array, Array]:
    """Catmull-Rom weights of the four pixels around a position that lies ``t`` beyond the second one."""
    return (
        ((-t + 2) * t - 1) * t / 2,
        ((3 * t - 5) * t * t + 2) / 2,
        ((-3 * t + 4) * t + 1) * t / 2,
        (t - 1) * t * t / 2,
    )


def _means(image: Array, scale: int) -> Array:
    height, width, channels = image.shape
    return image.reshape(height // scale, scale, width // scale, scale, channels).mean(axis=(1, 3))
