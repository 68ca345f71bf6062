# SPDX-License-Identifier: Apache-2.0
"""Does a pair make sense? Looks into the pixels, once, before any time is spent on fusing."""

from __future__ import annotations

import numpy as np

from oiio_msspl import schema, tensors
from oiio_msspl.errors import InputError
from oiio_msspl.pairing import Pairing, Source
from oiio_msspl.render import Array, Window
from oiio_msspl.transforms import luminance

#: Correlation of log luminance below which two renders hardly show one frame. Measured with a 1-spp HRLS: 0.83 to 0.99
#: on scenes with clean references, 0.31 where nearly all light is fireflies; between different scenes -0.2 to 0.25.
LOW_CORRELATION = 0.3
#: Ratio of mean luminance that no sampling noise explains.
EXPOSURE_RATIO = 2.0
#: Rows of the LRHS grid that are compared at a time.
BAND = 32


def check(lr_rgb: Array, hr: Source, pairing: Pairing, lr_name: str) -> list[str]:
    """Compare the LRHS (h, w, 3), repaired, over the grid, with the HRLS averaged down to it.

    Returns:
        Warnings, one sentence each.

    Raises:
        InputError: one of the two is black (a wrong pass, most likely) and the other is not.
    """
    low = luminance(lr_rgb)
    high = _averaged(hr, pairing)
    if not low.any() and not high.any():
        return ["both renders are black (or NaN) everywhere: the result is black"]
    for name, values, other in ((lr_name, low, hr.name), (hr.name, high, lr_name)):
        if not values.any():
            raise InputError(
                f"{name}: the beauty is black (or NaN) everywhere, while that of {other} is not; "
                "check which layer it is (--map rgb=LAYER)"
            )
    warnings = []
    # Fireflies rule a plain mean: compare where neither is among the brightest percent of what is lit.
    lit = (low > 0) | (high > 0)
    plain = lit & (low <= np.quantile(low[lit], 0.99)) & (high <= np.quantile(high[lit], 0.99))
    ratio = (
        float(high[plain].sum(dtype=np.float64) / max(low[plain].sum(dtype=np.float64), 1e-30)) if plain.any() else 1.0
    )
    if not 1 / EXPOSURE_RATIO < ratio < EXPOSURE_RATIO:
        warnings.append(f"the HRLS is {ratio:.3g} times as bright as the LRHS: are exposure and view layer the same?")
    correlation = _correlation(low, high)
    if correlation < LOW_CORRELATION:
        warnings.append(
            f"the two renders hardly look alike (correlation {correlation:.2f}): are they the same frame and camera?"
        )
    return warnings


def _averaged(hr: Source, pairing: Pairing) -> Array:
    """Luminance of the HRLS averaged over each pixel of the grid."""
    s, grid = pairing.scale, pairing.grid
    result = np.empty((grid.height, grid.width), dtype=np.float32)
    for y0 in range(grid.y0, grid.y1, BAND):
        want = Window(grid.x0 * s, y0 * s, grid.x1 * s, min(y0 + BAND, grid.y1) * s)
        rgb = tensors.read(hr, want, pairing.hr_data, features=[schema.RGB])[schema.RGB]
        y = luminance(rgb)
        result[y0 - grid.y0 : y0 - grid.y0 + y.shape[0] // s] = y.reshape(y.shape[0] // s, s, grid.width, s).mean(
            (1, 3)
        )
    return result


def _correlation(a: Array, b: Array) -> float:
    """Pearson correlation of log luminance on blocks of 4 x 4: noise averages out, framing stays."""
    height, width = (a.shape[0] // 4) * 4, (a.shape[1] // 4) * 4
    if height < 16 or width < 16:
        return 1.0
    blocks = [v[:height, :width].reshape(height // 4, 4, width // 4, 4).mean((1, 3)) for v in (a, b)]
    logs = [np.log(v + 1e-3 * v.mean() + 1e-20).ravel() for v in blocks]
    if min(v.std() for v in logs) < 1e-3:
        return 1.0  # a flat frame has no framing to compare
    return float(np.corrcoef(*logs)[0, 1])
