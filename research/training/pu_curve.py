# SPDX-License-Identifier: Apache-2.0
"""The curve by which Open Image Denoise encodes HDR colour for its networks, and its inverse.

It is a fit to the PU (perceptually uniform) encoding of Aydin et al. 2008, "Extending Quality Metrics to Full Luminance
Range Images": linear near black, then a power, then a logarithm. The constants are those of ``core/color.h`` in Open
Image Denoise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.model.encoding import MAX_RADIANCE, MU

#: Radiance at which the linear segment ends, and the power segment.
BOUNDS = (1.57945760e-06, 3.22087631e-02)
SLOPE = 1.41283765e03
FACTOR, EXPONENT, OFFSET = 1.64593172e00, 4.31384981e-01, -2.94139609e-03
LOG_FACTOR, LOG_SHIFT, LOG_OFFSET = 1.92653254e-01, 6.26026094e-03, 9.98620152e-01

#: Value of the curve at ``MAX_RADIANCE``; dividing by it normalises the curve to [0, 1].
PU_MAX = LOG_FACTOR * float(np.log(MAX_RADIANCE + LOG_SHIFT)) + LOG_OFFSET


def pu_encode(radiance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Radiance in [0, 65504] to PU-encoded values in [0, 1]."""
    curve = np.where(
        radiance <= BOUNDS[1],
        FACTOR * radiance**EXPONENT + OFFSET,
        LOG_FACTOR * np.log(radiance + LOG_SHIFT) + LOG_OFFSET,
    )
    return np.where(radiance <= BOUNDS[0], SLOPE * radiance, curve) / PU_MAX


def pu_decode(encoded: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of :func:`pu_encode`."""
    curve = encoded * PU_MAX
    linear_end, power_end = pu_encode(np.asarray(BOUNDS)) * PU_MAX
    power = (np.maximum(curve - OFFSET, 0) / FACTOR) ** (1 / EXPONENT)
    radiance = np.where(curve <= power_end, power, np.exp((curve - LOG_OFFSET) / LOG_FACTOR) - LOG_SHIFT)
    return np.where(curve <= linear_end, curve / SLOPE, radiance)


def largest_log_encoded() -> float:
    """Log-encoded ``MAX_RADIANCE``, see :func:`oiio_msspl.model.encoding.encode_radiance`."""
    return float(np.log1p(MU * MAX_RADIANCE) / np.log1p(MU))


def pu_encode_log(entries: int) -> NDArray[np.float64]:
    """PU-encoded values of ``entries`` evenly spaced log-encoded values, from 0 to the largest: (entries,)."""
    radiance = np.expm1(np.linspace(0, largest_log_encoded(), entries) * np.log1p(MU)) / MU
    return pu_encode(np.minimum(radiance, MAX_RADIANCE))
