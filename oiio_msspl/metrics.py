# SPDX-License-Identifier: Apache-2.0
"""How far a picture is from its reference, in the paper's measures (section 5) and SSIM.

All take scene-linear float32 (height, width, 3).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.arrays import Array
from oiio_msspl.colour import luminance, srgb

#: The paper's two conventions of RelMSE, (lambda_1, lambda_2): its BCR data set (after KPCN), and the Gharbi data set.
RELMSE_BCR = (0.5, 0.01)
RELMSE_GHARBI = (1.0, 1e-4)
#: Side of SSIM's Gaussian window.
SSIM_WINDOW = 11


def psnr(image: Array, reference: Array) -> float:
    """PSNR in dB of the sRGB pictures (values in [0, 1]); infinite for equal pictures."""
    error = float(np.mean(np.square(srgb(image).astype(np.float64) - srgb(reference))))
    return math.inf if error == 0 else -10 * math.log10(error)


def relmse_map(image: Array, reference: Array, convention: tuple[float, float] = RELMSE_BCR) -> NDArray[np.float64]:
    """Per value: ``lambda_1 (I - R)^2 / (R^2 + lambda_2)``, scene linear."""
    first, second = convention
    truth = reference.astype(np.float64)
    return first * np.square(image - truth) / (np.square(truth) + second)


def relmse(image: Array, reference: Array, convention: tuple[float, float] = RELMSE_BCR) -> float:
    return float(relmse_map(image, reference, convention).mean())


def ssim(image: Array, reference: Array) -> float:
    """SSIM (Wang et al. 2004: Gaussian window of sigma 1.5, 11 x 11, K1 = 0.01, K2 = 0.03) of the sRGB pictures' luma.

    Raises:
        ValueError: a side is shorter than the window.
    """
    if min(image.shape[:2]) < SSIM_WINDOW:
        raise ValueError(f"SSIM needs at least 11 x 11 pixels, got {image.shape[1]} x {image.shape[0]}")
    x, y = (luminance(srgb(v)).astype(np.float64) for v in (image, reference))
    mx, my = _blur(x), _blur(y)
    vx, vy, cov = _blur(x * x) - mx * mx, _blur(y * y) - my * my, _blur(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return float(np.mean((2 * mx * my + c1) * (2 * cov + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))))


def _blur(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """11-tap Gaussian of sigma 1.5 in both directions, without the borders."""
    taps = np.exp(-0.5 * np.square(np.arange(-5, 6) / 1.5))
    taps /= taps.sum()
    for axis in (0, 1):
        values = np.lib.stride_tricks.sliding_window_view(values, SSIM_WINDOW, axis=axis) @ taps
    return values
