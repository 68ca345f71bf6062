# SPDX-License-Identifier: Apache-2.0
"""Flicker: what changes from frame to frame of a result beyond what changes in the reference.

With the result O and the reference R, it is the mean of |(O[t+1] - O[t]) - (R[t+1] - R[t])| and the root of the mean
square, in sRGB values from 0 to 1. A Gaussian of `BLUR` pixels divides it into blotches, which it keeps, and grain,
which it removes.

The reference comes in two halves with independent noise. Each square is the product of the differences to both halves,
so that the noise of the reference cancels out, in PSNR too. It does not cancel out of the mean absolute value. That one
means something only for a static camera, whose reference does not change.
"""

from __future__ import annotations

import math

import numpy as np

from oiio_msspl.arrays import Array

#: Standard deviation of the Gaussian that divides blotches from grain, in pixels.
BLUR = 8.0


def flicker(images: Array, truth: tuple[Array, Array]) -> dict[str, float]:
    """Measure a sequence.

    Args:
        images: (frames, h, w, 3), sRGB values.
        truth: two references with independent noise, of the same shape; twice the same one if it has no noise.

    Returns:
        ``mean_abs``, ``rms``, and the root mean squares ``rms_blotches`` and ``rms_grain``.
    """
    first, second = (np.diff(images - t, axis=0) for t in truth)
    first_low, second_low = blur(first), blur(second)
    return {
        "mean_abs": float(np.abs((first + second) / 2).mean()),
        "rms": _root(first, second),
        "rms_blotches": _root(first_low, second_low),
        "rms_grain": _root(first - first_low, second - second_low),
    }


def psnr(image: Array, truth: tuple[Array, Array]) -> float:
    """PSNR in dB of sRGB values, against two references with independent noise."""
    error = _root(image - truth[0], image - truth[1])
    return math.inf if error == 0 else -20 * math.log10(error)


def _root(first: Array, second: Array) -> float:
    """Root of the mean product of two measurements of the same: noise that only one of them has cancels out."""
    return math.sqrt(max(float(np.mean(first.astype(np.float64) * second)), 0.0))


def blur(images: Array) -> Array:
    """Blur (frames, h, w, c) with a Gaussian of `BLUR` pixels. Pixels beyond the border have no weight."""
    kernels = []
    for size in images.shape[1:3]:
        position = np.arange(size, dtype=np.float32)
        kernel = np.exp(-0.5 * np.square((position[:, None] - position) / BLUR))
        kernels.append(kernel / kernel.sum(axis=1, keepdims=True))
    return np.einsum("yj,xk,tjkc->tyxc", *kernels, images, optimize=True)
