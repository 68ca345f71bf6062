# SPDX-License-Identifier: Apache-2.0
"""Luminance and the sRGB display transform."""

from __future__ import annotations

import numpy as np

from oiio_msspl.arrays import Array

#: Rec. 709 luminance weights of linear RGB.
LUMINANCE_WEIGHTS = (0.2126, 0.7152, 0.0722)

_WEIGHTS = np.asarray(LUMINANCE_WEIGHTS, dtype=np.float32)


def luminance(rgb: Array) -> Array:
    """Rec. 709 luminance of linear RGB: (..., 3) to (...)."""
    return rgb @ _WEIGHTS


def srgb(linear: Array) -> Array:
    """Scene-linear values to sRGB in [0, 1], clipped: the display transform s(x) of the paper, section 5.1."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(np.maximum(x, 1e-12), 1 / 2.4) - 0.055).astype(
        np.float32
    )
