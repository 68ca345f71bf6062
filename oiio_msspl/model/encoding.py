# SPDX-License-Identifier: Apache-2.0
"""Exposure, and the log curve in which networks see radiance.

Radiance is multiplied by the exposure of the LRHS, so all scenes have similar values, and a scene that is brighter by a
factor gives a result that is brighter by this factor. Then radiance is log-encoded, so errors in shadows and in
highlights weigh alike. The paper clips linear values at 100. A log curve keeps highlights and does not let them
dominate the loss.

Models encode and decode inside of their graphs. This module computes the exposure, and encodes radiance for comparisons
in which dark and bright pixels weigh alike.
"""

from __future__ import annotations

import numpy as np

from oiio_msspl.aovs.features import DEFAULTS, VARIANCE
from oiio_msspl.image.arrays import HALF_MAX, Array, map_rows, quantile
from oiio_msspl.image.colour import luminance
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.image.parallel import BLOCK_VALUES

#: Log-mean luminance to which a scene is exposed: photographic mid-grey.
KEY = 0.18
#: Slope of the log curve. 16 puts mid-grey at 0.48 and white at 1, close to the sRGB curve below white.
MU = 16.0
#: Largest exposed radiance, 4.87 when log-encoded. Brighter pixels are clipped.
MAX_RADIANCE = HALF_MAX
#: Largest albedo. Glass and wrong materials exceed 1.
MAX_ALBEDO = 2.0
#: Bounds of the exposure, so that it and ``MAX_RADIANCE`` divided by it are finite in float32.
EXPOSURE_BOUNDS = (2e-34, 1e38)
#: Pixels darker than this fraction of a frame's bright pixels (33 stops below) do not count for its exposure.
NO_LIGHT = 1e-10
#: A pixel counts with at least this share of its brightest channel. Blue light has hardly any luminance, and exposed by
#: that it would be so bright that networks lose a quarter of it.
SATURATED = np.float32(0.5)
#: Side, in pixels, of the squares that show how noisy a frame is, and the number that a frame must have: with fewer,
#: one lamp could decide.
BLOCK, MIN_BLOCKS = 8, 64
#: Largest exposed luminance of the light in a square: of the median of all lit squares, or of their log-mean if that is
#: less. Frames with little noise are well below.
NOISY = 1.25

_LOG_SCALE = np.float32(1.0 / np.log1p(MU))
#: Log-encoded ``MAX_RADIANCE``.
MAX_ENCODED = float(np.log1p(MU * MAX_RADIANCE)) * float(_LOG_SCALE)


def find_exposure(rgb: Array) -> float:
    """Return the factor that brings a render to a log-mean luminance of ``KEY``, or a saturated one to a darker one.

    Only lit pixels count. Noise makes most pixels darker than their mean, and a few much brighter, so the log-mean of a
    very noisy frame is far too dark. Networks average log-encoded radiance, which loses light if the few bright pixels
    are far up on the curve. Therefore the factor is bounded. The level of a square of ``BLOCK`` x ``BLOCK`` pixels is
    the mean of their luminance, weighted by luminance. The bound brings the median level of all squares to ``NOISY``,
    or their log-mean if it is less. So neither a few squares with lamps decide, nor many with a bright sky.

    Args:
        rgb: (height, width, 3), scene linear, repaired.

    Returns:
        The factor, within ``EXPOSURE_BOUNDS``; 1.0 for a black render.
    """
    brightest = np.maximum(np.maximum(rgb[..., 0], rgb[..., 1]), rgb[..., 2])
    y = np.maximum(luminance(rgb), SATURATED * brightest)
    lit = y[y > 0]
    if lit.size == 0:
        return 1.0
    bright = quantile(lit, 0.99)
    darkest = NO_LIGHT * bright
    exposure = KEY / _log_mean(lit if lit.min() >= darkest else lit[lit >= darkest])
    rows, columns = (side // BLOCK for side in y.shape)
    if rows * columns >= MIN_BLOCKS:
        relative = np.minimum(y[: rows * BLOCK, : columns * BLOCK], np.float32(bright)) / np.float32(bright)
        light, squares = (box_downsample(values, BLOCK) for values in (relative, relative * relative))
        levels = squares[squares > 0] / light[squares > 0]
        levels = levels[levels >= NO_LIGHT]
        if levels.size:
            exposure = min(exposure, NOISY / (min(quantile(levels, 0.5), _log_mean(levels)) * bright))
    return float(np.clip(exposure, *EXPOSURE_BOUNDS))


def _log_mean(lit: Array) -> float:
    """Return the log-mean of luminances > 0 (n,). A few nearly black pixels and fireflies hardly change it."""
    offset = 1e-4 * quantile(lit, 0.5)
    blocks = np.array_split(lit, -(-lit.size // BLOCK_VALUES))  # a block fits into the processor's cache
    log_sum = sum(float(np.log(block.astype(np.float64) + offset).sum()) for block in blocks)
    return float(np.exp(log_sum / lit.size))


def encode_radiance(radiance: Array, exposure: float) -> Array:
    """Log-encode scene-linear radiance: ``log(1 + MU e x) / log(1 + MU)``, ``e x`` clipped to [0, MAX_RADIANCE]."""

    def encode(values: Array) -> None:
        with np.errstate(over="ignore"):  # values that overflow are clipped
            values *= np.float32(exposure)
        np.clip(values, 0.0, MAX_RADIANCE, out=values)
        values *= np.float32(MU)
        _log1p(values)
        values *= _LOG_SCALE

    return map_rows(encode, radiance)


def decode_radiance(encoded: Array, exposure: float) -> Array:
    """Decode log-encoded radiance, clipped to [0, MAX_ENCODED]. The result is finite and >= 0."""

    def decode(values: Array) -> None:
        np.clip(values, 0.0, MAX_ENCODED, out=values)
        values /= _LOG_SCALE
        _expm1(values)
        values /= np.float32(MU)
        values /= np.float32(exposure)

    return map_rows(decode, encoded)


def _log1p(values: Array) -> None:
    """Compute ``np.log1p`` in place, for values >= 0. NumPy's own is not vectorised and several times slower.

    1 + x is rounded, so its logarithm is multiplied by x / (rounded - 1) (Goldberg 1991, theorem 4).
    """
    rounded = values + np.float32(1)
    logarithm = np.log(rounded)
    rounded -= np.float32(1)
    with np.errstate(invalid="ignore", divide="ignore"):
        logarithm /= rounded
    np.copyto(logarithm, np.float32(1), where=rounded == 0)
    values *= logarithm


def _expm1(values: Array) -> None:
    """Compute ``np.expm1`` in place, for values >= 0. exp(x) is rounded, and exact for the logarithm of the result."""
    power = np.exp(values)
    logarithm = np.log(power)
    power -= np.float32(1)
    with np.errstate(invalid="ignore", divide="ignore"):
        power *= values / logarithm
    np.copyto(values, power, where=logarithm != 0)


def luminance_variance(variance: Array) -> Array:
    """Return a variance of luminance (h, w, 1), of one of luminance or of colours (h, w, 1 or 3).

    The noise of R, G and B is taken for fully correlated: sigma_Y = sum of w_c sigma_c. Monte Carlo noise nearly is,
    because one path carries all three.
    """
    if variance.shape[-1] == 1:
        return variance
    return np.square(luminance(np.sqrt(np.maximum(variance, 0))))[..., None]


def default_value(feature: str, exposure: float) -> float:
    """Return the value of a missing feature, in the units of :mod:`oiio_msspl.aovs.features`."""
    if feature != VARIANCE:
        return DEFAULTS[feature]
    deviation = float(decode_radiance(np.full(1, DEFAULTS[VARIANCE], np.float32), exposure)[0])
    return min(deviation**2, float(np.finfo(np.float32).max))
