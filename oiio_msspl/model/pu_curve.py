# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise's own networks in 8 bits, by ONNX Runtime: less than half of its time, and nearly its result.

Nothing of them is in this package. Their weights are read from the library that the user has installed, and are taken
only if they are, to the byte, those that :mod:`training.eight_bit` has seen; what is kept here is the graph, how its
values are scaled, and by how many steps of 8 bits a weight differs from the nearest one. Whether the processor computes
it right is tried out, against Open Image Denoise itself. Where any of that fails, Open Image Denoise does the work.

Inputs and outputs are colours of a range of 2^30, and have to go through 8 bits, too. They go in parts: of equal slices
of the range, one behind the other, each has a channel that says how far it is filled. Their sum is the value.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.model.encoding import MAX_RADIANCE

#: The curve that Open Image Denoise sees HDR colours by: a fit to the PU encoding of Aydin et al. 2008, "Extending
#: Quality Metrics to Full Luminance Range Images", linear below the first bound, a power below the second, a logarithm
#: beyond. Its numbers are from core/color.h of Open Image Denoise.
BOUNDS = (1.57945760e-06, 3.22087631e-02)
SLOPE = 1.41283765e03
FACTOR, EXPONENT, OFFSET = 1.64593172e00, 4.31384981e-01, -2.94139609e-03
LOG_FACTOR, LOG_SHIFT, LOG_OFFSET = 1.92653254e-01, 6.26026094e-03, 9.98620152e-01


def pu_encode(radiance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Radiance in [0, 65504] as Open Image Denoise's networks see it, in [0, 1]."""
    curve = np.where(
        radiance <= BOUNDS[1],
        FACTOR * radiance**EXPONENT + OFFSET,
        LOG_FACTOR * np.log(radiance + LOG_SHIFT) + LOG_OFFSET,
    )
    return np.where(radiance <= BOUNDS[0], SLOPE * radiance, curve) / pu_top()


def pu_decode(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of :func:`encode`."""
    curve = values * pu_top()
    low, middle = pu_encode(np.asarray(BOUNDS)) * pu_top()
    power = (np.maximum(curve - OFFSET, 0) / FACTOR) ** (1 / EXPONENT)
    radiance = np.where(curve <= middle, power, np.exp((curve - LOG_OFFSET) / LOG_FACTOR) - LOG_SHIFT)
    return np.where(curve <= low, curve / SLOPE, radiance)


def pu_top() -> float:
    """What the curve ends at."""
    return LOG_FACTOR * float(np.log(MAX_RADIANCE + LOG_SHIFT)) + LOG_OFFSET
