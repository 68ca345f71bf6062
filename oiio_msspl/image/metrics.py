# SPDX-License-Identifier: Apache-2.0
"""Measures of the error of a picture against its reference: those of the paper (section 5), and SSIM.

All take scene-linear float32 (height, width, 3).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.image.arrays import Array
from oiio_msspl.image.colour import luminance, srgb

#: Constants (lambda_1, lambda_2) of RelMSE, as the paper uses them on its BCR data set (after KPCN).
RELMSE_BCR = (0.5, 0.01)
#: Constants of RelMSE, as the paper uses them on the Gharbi data set.
RELMSE_GHARBI = (1.0, 1e-4)
#: Side of SSIM's Gaussian window.
SSIM_WINDOW = 11


def psnr(image: Array, reference: Array) -> float:
    """Compute the PSNR in dB of the pictures in sRGB, clipped to [0, 1]; infinite for equal pictures."""
    error = float(np.mean(np.square(srgb(image).astype(np.float64) - srgb(reference))))
    return math.inf if error == 0 else -10 * math.log10(error)


def relmse_map(image: Array, reference: Array, convention: tuple[float, float] = RELMSE_BCR) -> NDArray[np.float64]:
    """Compute the relative squared error of each value, ``lambda_1 (I - R)^2 / (R^2 + lambda_2)``: (height, width, 3).

    ``image`` is I, ``reference`` R, and ``convention`` (lambda_1, lambda_2).
    """
    first, second = convention
    truth = reference.astype(np.float64)
    return first * np.square(image - truth) / (np.square(truth) + second)


def relmse(image: Array, reference: Array, convention: tuple[float, float] = RELMSE_BCR) -> float:
    """Compute RelMSE, the mean of :func:`relmse_map`."""
    return float(relmse_map(image, reference, convention).mean())


def ssim(image: Array, reference: Array) -> float:
    """Compute the SSIM of the luma of the pictures in sRGB, in [-1, 1].

    After Wang et al. 2004: Gaussian window of 11 x 11 pixels with sigma 1.5, K1 = 0.01, K2 = 0.03.
    """
    if min(image.shape[:2]) < SSIM_WINDOW:
        raise ValueError(f"SSIM needs at least 11 x 11 pixels, got {image.shape[1]} x {image.shape[0]}")
    x, y = (luminance(srgb(v)).astype(np.float64) for v in (image, reference))
    mx, my = _blur(x), _blur(y)
    vx, vy, cov = _blur(x * x) - mx * mx, _blur(y * y) - my * my, _blur(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return float(np.mean((2 * mx * my + c1) * (2 * cov + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))))


def _blur(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Filter by a Gaussian of sigma 1.5 with 11 taps each way: (height, width) to (height - 10, width - 10)."""
    taps = np.exp(-0.5 * np.square(np.arange(-5, 6) / 1.5))
    taps /= taps.sum()
    for axis in (0, 1):
        values = np.lib.stride_tricks.sliding_window_view(values, SSIM_WINDOW, axis=axis) @ taps
    return values
