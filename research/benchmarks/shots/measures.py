# SPDX-License-Identifier: Apache-2.0
"""Measure how wrong the frames of a sequence are, and how much they flicker.

Flicker is what changes from frame to frame of a result beyond what changes in the reference. With the result O and the
reference R, it is the root of the mean square of (O[t+1] - O[t]) - (R[t+1] - R[t]), in sRGB values from 0 to 1.

Motion error is the measure tOF of Chu et al. 2020, "Learning Temporal Coherence via Self-Supervision for GAN-based
Video Generation": how far the optical flow of a result lies from that of the reference, in pixels.

The reference comes in two halves with independent noise. Each square is the product of the differences to both halves,
so that the noise of the reference cancels out.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.image.arrays import Array
from oiio_msspl.image.metrics import RELMSE_BCR

Mask = NDArray[np.bool_]


def flicker(images: Array, truth: tuple[Array, Array]) -> float:
    """Return the flicker of sRGB images (frames, h, w, 3) against two references, or twice one without noise."""
    first, second = (np.diff(images - reference, axis=0) for reference in truth)
    return math.sqrt(_mean(first * second))


def motion_error(images: Array, truth: Array) -> float:
    """Return the mean distance in pixels of the optical flows of sRGB images (frames, h, w, 3) and their reference."""
    import cv2

    def flows(frames: Array) -> Array:
        grey = [cv2.cvtColor(np.round(255 * frame).astype(np.uint8), cv2.COLOR_RGB2GRAY) for frame in frames]
        start = np.zeros((*grey[0].shape, 2), np.float32)
        pairs = itertools.pairwise(grey)
        return np.stack([cv2.calcOpticalFlowFarneback(*pair, start, 0.5, 3, 15, 3, 5, 1.2, 0) for pair in pairs])

    return float(np.linalg.norm(flows(images) - flows(truth), axis=-1).mean())


def psnr(image: Array, truth: tuple[Array, Array], mask: Mask | None = None) -> float:
    """Return PSNR in dB of sRGB values (..., 3) against two references, where the mask (...) is set if there is one."""
    products = (image - truth[0]) * (image - truth[1])
    square = _mean(products if mask is None else products[mask])
    return math.inf if square == 0 else -10 * math.log10(square)


def relmse(image: Array, truth: tuple[Array, Array]) -> float:
    """Return RelMSE of linear values against two references. The divisor keeps a little of their noise."""
    factor, offset = RELMSE_BCR
    brightness = np.square((truth[0] + truth[1]) / 2)
    return factor * _mean((image - truth[0]) * (image - truth[1]) / (brightness + offset))


def _mean(products: NDArray[Any]) -> float:
    """Return the mean of products of two measurements. Noise of one of them may make it negative, which means 0."""
    return max(float(np.mean(products, dtype=np.float64)), 0.0)


def blur(images: Array, sigma: float) -> Array:
    """Blur (frames, h, w, c) with a Gaussian of ``sigma`` pixels. Pixels beyond the border have no weight."""
    kernels = []
    for size in images.shape[1:3]:
        position = np.arange(size, dtype=np.float32)
        kernel = np.exp(-0.5 * np.square((position[:, None] - position) / sigma))
        kernels.append(kernel / kernel.sum(axis=1, keepdims=True))
    return np.einsum("yj,xk,tjkc->tyxc", *kernels, images, optimize=True)


def warped(image: Array, vectors: Array) -> Array:
    """Sample an image (h, w, c) at the ends of vectors (h, w, 2): bicubic, within the four nearest pixels."""
    height, width = image.shape[:2]
    y, x = np.mgrid[0:height, 0:width] + np.moveaxis(vectors, -1, 0)[::-1]
    top, left = np.floor(y).astype(int), np.floor(x).astype(int)
    total: Array = np.zeros(1, np.float32)
    nearest = []
    for dy, wy in zip(range(-1, 3), _catmull_rom(y - top), strict=True):
        for dx, wx in zip(range(-1, 3), _catmull_rom(x - left), strict=True):
            values = image[np.clip(top + dy, 0, height - 1), np.clip(left + dx, 0, width - 1)]
            total = total + values * (wy * wx)[..., None].astype(np.float32)
            if dy in (0, 1) and dx in (0, 1):
                nearest.append(values)
    return np.clip(total, np.min(nearest, axis=0), np.max(nearest, axis=0))


def _catmull_rom(t: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Return the weights of the four pixels around a position that lies ``t`` beyond the second one."""
    return (
        ((-t + 2) * t - 1) * t / 2,
        ((3 * t - 5) * t * t + 2) / 2,
        ((-3 * t + 4) * t + 1) * t / 2,
        (t - 1) * t * t / 2,
    )
