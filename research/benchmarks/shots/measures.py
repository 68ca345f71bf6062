# SPDX-License-Identifier: Apache-2.0
"""How wrong the frames of a sequence are, and how much they flicker.

Flicker is what changes from frame to frame of a result beyond what changes in the reference. With the result O and the
reference R, it is the root of the mean square of (O[t+1] - O[t]) - (R[t+1] - R[t]), in sRGB values from 0 to 1. A
Gaussian of `BLUR` pixels divides it into blotches, which it keeps, and grain, which it removes. tPSNR is the same
difference as PSNR, averaged over the pairs of frames (noisebase). E_warp compares each frame with the next one, which
is brought to its place by motion vectors (Lai et al. 2018).

The reference comes in two halves with independent noise. Each square is the product of the differences to both halves,
so that the noise of the reference cancels out.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.image.arrays import Array
from oiio_msspl.image.metrics import RELMSE_BCR

#: Standard deviation of the Gaussian that divides blotches from grain, in pixels.
BLUR = 8.0

Mask = NDArray[np.bool_]


def flicker(images: Array, truth: tuple[Array, Array]) -> dict[str, float]:
    """Measure a sequence.

    Args:
        images: (frames, h, w, 3), sRGB values.
        truth: two references with independent noise, of the same shape; twice the same one if it has no noise.

    Returns:
        The root mean squares ``flicker``, ``blotches`` and ``grain``, and ``tpsnr`` in dB.
    """
    first, second = (np.diff(images - t, axis=0) for t in truth)
    first_low, second_low = blur(first), blur(second)
    return {
        "flicker": math.sqrt(_mean(first * second)),
        "blotches": math.sqrt(_mean(first_low * second_low)),
        "grain": math.sqrt(_mean((first - first_low) * (second - second_low))),
        "tpsnr": float(np.mean([decibels(_mean(a * b)) for a, b in zip(first, second, strict=True)])),
    }


def psnr(image: Array, truth: tuple[Array, Array], mask: Mask | None = None) -> float:
    """PSNR in dB of sRGB values (..., 3), against two references; where the mask (...) is set, if there is one."""
    products = (image - truth[0]) * (image - truth[1])
    return decibels(_mean(products if mask is None else products[mask]))


def jod(images: Array, truth: tuple[Array, Array]) -> float:
    """Visible difference of a film from the mean of both references, in JOD (Mantiuk et al. 2021, FovVideoVDP).

    10 is no difference; one less is seen by 75 % of the viewers. The film has 24 frames a second, on a display of
    1920 x 1080 pixels that is looked at from 60 cm.

    Args:
        images, truth: (frames, h, w, 3), sRGB values, at least two frames.
    """
    import pyfvvdp

    metric = pyfvvdp.fvvdp(display_name="standard_fhd", heatmap=None)
    shown, wanted = (np.clip(film, 0, 1).astype(np.float32) for film in (images, (truth[0] + truth[1]) / 2))
    value, _ = metric.predict(shown, wanted, dim_order="FHWC", frames_per_second=24)
    return float(value)


def relmse(image: Array, truth: tuple[Array, Array]) -> float:
    """RelMSE of linear values, against two references. The divisor keeps a little of their noise."""
    factor, offset = RELMSE_BCR
    brightness = np.square((truth[0] + truth[1]) / 2)
    return factor * _mean((image - truth[0]) * (image - truth[1]) / (brightness + offset))


def warp_error(images: Array, others: Array, vectors: Array, seen: Mask) -> float:
    """E_warp of sRGB values: how far each frame is from the next one at the places that the vectors lead to.

    Args:
        images: (frames, h, w, 3).
        others: the same. If it is another half of a reference, their noise cancels out.
        vectors: (frames - 1, h, w, 2), from each frame to the next one, in pixels as (x, y).
        seen: (frames - 1, h, w): pixels whose surface the next frame shows, too.
    """

    def change(values: Array, t: int) -> Array:
        return (warped(values[t + 1], vectors[t]) - values[t])[seen[t]]

    return float(np.mean([_mean(change(images, t) * change(others, t)) for t in range(len(images) - 1)]))


def decibels(square: float) -> float:
    """Return a mean squared error of values from 0 to 1 as PSNR."""
    return math.inf if square == 0 else -10 * math.log10(square)


def _mean(products: Array) -> float:
    """Mean of products of two measurements. Noise that only one of them has may make it negative, which means 0."""
    return max(float(np.mean(products, dtype=np.float64)), 0.0)


def blur(images: Array, sigma: float = BLUR) -> Array:
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


def _catmull_rom(t: Array) -> tuple[Array, Array, Array, Array]:
    """Weights of the four pixels around a position that lies ``t`` beyond the second one."""
    return (
        ((-t + 2) * t - 1) * t / 2,
        ((3 * t - 5) * t * t + 2) / 2,
        ((-3 * t + 4) * t + 1) * t / 2,
        (t - 1) * t * t / 2,
    )
