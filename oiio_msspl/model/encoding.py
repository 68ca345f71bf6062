# SPDX-License-Identifier: Apache-2.0
"""Exposure, and the log curve in which networks see radiance.

Radiance is multiplied by the exposure of the LRHS, so every scene has the same brightness and a brighter scene gives
the same picture, brighter. Then it is log-encoded, so errors in shadows and in highlights weigh alike. The paper clips
linear values at 100; a log curve keeps highlights and does not let them dominate the loss.

Models encode and decode for themselves. Here is what is computed around them: the exposure, and the curve for
comparisons that should see dark and bright pixels alike.
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
#: Largest exposed radiance; brighter pixels are clipped. Log-encoded it is 4.87.
MAX_RADIANCE = HALF_MAX
#: Largest albedo; glass and wrong materials exceed 1.
MAX_ALBEDO = 2.0
#: Bounds of the exposure: with these, it is a finite float32, and so is ``MAX_RADIANCE`` divided by it.
EXPOSURE_BOUNDS = (2e-34, 1e38)
#: Pixels darker than this share of a frame's bright pixels (33 stops below) do not count for its exposure.
NO_LIGHT = 1e-10
#: Side, in pixels, of the squares that show how noisy a frame is, and how many a frame has at least. In fewer of them,
#: one lamp could decide.
BLOCK, MIN_BLOCKS = 8, 64
#: Largest exposed luminance at which the light of a square may lie: the median of all lit squares, or their log-mean if
#: that is less. Frames with little noise are well below.
NOISY = 1.25

_LOG_SCALE = np.float32(1.0 / np.log1p(MU))
#: Log-encoded ``MAX_RADIANCE``.
MAX_ENCODED = float(np.log1p(MU * MAX_RADIANCE)) * float(_LOG_SCALE)


def find_exposure(rgb: Array) -> float:
    """Factor that brings a render to a log-mean luminance of ``KEY``.

    Only lit pixels count, because a black pixel has no exposure. Noise makes most pixels darker than their mean, and a
    few much brighter. So the log-mean of a very noisy frame is far too dark. And networks average log-encoded radiance,
    which loses light if the few bright pixels are far up on the curve. So these bound the factor: the light of a
    square of ``BLOCK`` x ``BLOCK`` pixels lies at the mean of their luminance, weighted by luminance. The median of all
    squares counts, or their log-mean if it is less. So neither lamps in some of them decide, nor a bright sky in most.

    Args:
        rgb: (height, width, 3), scene linear, repaired.

    Returns:
        The factor, within ``EXPOSURE_BOUNDS``; 1.0 for a black render.
    """
    y = luminance(rgb)
    lit = y[y > 0]
    if lit.size == 0:
        return 1.0
    bright = quantile(lit, 0.99)
    darkest = NO_LIGHT * bright
    exposure = KEY / _log_mean(lit if lit.min() >= darkest else lit[lit >= darkest])
    rows, columns = (side // BLOCK for side in y.shape)
    if rows * columns >= MIN_BLOCKS:
        shares = np.minimum(y[: rows * BLOCK, : columns * BLOCK], np.float32(bright)) / np.float32(bright)
        light, squares = (box_downsample(values, BLOCK) for values in (shares, shares * shares))
        levels = squares[squares > 0] / light[squares > 0]
        levels = levels[levels >= NO_LIGHT]
        if levels.size:
            exposure = min(exposure, NOISY / (min(quantile(levels, 0.5), _log_mean(levels)) * bright))
    return float(np.clip(exposure, *EXPOSURE_BOUNDS))


def _log_mean(lit: Array) -> float:
    """The log-mean of luminances > 0 (n,).

    The offset inside the logarithm keeps a few nearly black pixels from deciding. It follows the median, which a
    firefly hardly changes.
    """
    offset = 1e-4 * quantile(lit, 0.5)
    blocks = np.array_split(lit, -(-lit.size // BLOCK_VALUES))  # a block fits into the processor's cache
    log_sum = sum(float(np.log(block.astype(np.float64) + offset).sum()) for block in blocks)
    return float(np.exp(log_sum / lit.size))


def encode_radiance(radiance: Array, exposure: float, out: Array | None = None) -> Array:
    """Log-encode scene-linear radiance: ``log(1 + MU e x) / log(1 + MU)``, with ``e x`` clipped to [0, MAX_RADIANCE].

    Args:
        radiance: any shape.
        out: where to put the result; a new array if None.
    """

    def encode(values: Array) -> None:
        with np.errstate(over="ignore"):  # what overflows is clipped
            values *= np.float32(exposure)
        np.clip(values, 0.0, MAX_RADIANCE, out=values)
        values *= np.float32(MU)
        _log1p(values)
        values *= _LOG_SCALE

    return map_rows(encode, radiance, out)


def decode_radiance(encoded: Array, exposure: float) -> Array:
    """Inverse of :func:`encode_radiance`. Input is clipped to its range, so the result is finite and >= 0."""

    def decode(values: Array) -> None:
        np.clip(values, 0.0, MAX_ENCODED, out=values)
        values /= _LOG_SCALE
        _expm1(values)
        values /= np.float32(MU)
        values /= np.float32(exposure)

    return map_rows(decode, encoded)


def _log1p(values: Array) -> None:
    """``np.log1p`` in place, for values >= 0. NumPy's own is several times slower, because it is not vectorised.

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
    """``np.expm1`` in place, for values >= 0, as :func:`_log1p`: exp(x) is rounded, and exact for its logarithm."""
    power = np.exp(values)
    logarithm = np.log(power)
    power -= np.float32(1)
    with np.errstate(invalid="ignore", divide="ignore"):
        power *= values / logarithm
    np.copyto(values, power, where=logarithm != 0)


def default_value(feature: str, exposure: float) -> float:
    """Value of a missing feature in the units of :mod:`oiio_msspl.aovs.features`: ``DEFAULTS`` are encoded ones."""
    if feature != VARIANCE:
        return DEFAULTS[feature]
    deviation = float(decode_radiance(np.full(1, DEFAULTS[VARIANCE], np.float32), exposure)[0])
    return min(deviation**2, float(np.finfo(np.float32).max))
