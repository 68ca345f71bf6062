# SPDX-License-Identifier: Apache-2.0
"""Between a render's values and the network's, and back: pure NumPy, used by training and by inference alike.

Radiance is first scaled by the exposure of the LRHS, so that the network sees every scene at the same brightness and
scaling a scene scales its output; then compressed by a logarithm, so that errors in shadows and in highlights weigh
alike. The paper feeds linear values clipped at 100; a log keeps highlights without letting them rule the loss.
"""

from __future__ import annotations

from functools import reduce

import numpy as np
from numpy.typing import NDArray

from oiio_msspl import schema

Array = NDArray[np.float32]

#: Log-mean luminance to which a scene is exposed: photographic mid-grey.
KEY = 0.18
#: Light below this share of a frame's bright parts is none: 33 stops.
TRACE = 1e-10
#: Slope parameter of the log curve. 16 puts mid-grey at 0.48 and white at 1, close to the sRGB curve below white.
MU = 16.0
#: Largest exposed radiance that is told apart (log value 4.87); about what half floats hold.
MAX_RADIANCE = 65504.0
#: Reflectances above 1 exist (glass, wrong materials); beyond 2 they say nothing.
MAX_ALBEDO = 2.0

_LOG_SCALE = np.float32(1.0 / np.log1p(MU))
_LUMINANCE = np.asarray(schema.LUMINANCE, dtype=np.float32)


def luminance(rgb: Array) -> Array:
    """Rec. 709 luminance of (..., 3) linear RGB, shape (...)."""
    return rgb @ _LUMINANCE


def exposure_of(lrhs_rgb: Array) -> float:
    """Factor that brings a repaired LRHS (H, W, 3) to a log-mean luminance of ``KEY``; 1.0 for a black frame.

    Pixels without light carry no exposure and are left out, and so are traces: what a filter or a float left of light
    elsewhere. Of the lit ones, the epsilon keeps a few almost black pixels from deciding. It comes from the median: a
    single firefly of any size moves the result by next to nothing.
    """
    y = luminance(lrhs_rgb).astype(np.float64)
    lit = y[y > 0]
    if lit.size == 0:
        return 1.0
    lit = lit[lit >= TRACE * np.quantile(lit, 0.99)]
    epsilon = 1e-4 * float(np.median(lit))
    return float(KEY / np.exp(np.mean(np.log(lit + epsilon))))


def compress(radiance: Array, exposure: float) -> Array:
    """Scene-linear radiance >= 0 to network values: ``log(1 + mu e x) / log(1 + mu)``."""
    # In place: new pages for every step would take as long as the steps
    values = np.multiply(radiance, np.float32(exposure), out=np.empty(np.shape(radiance), np.float32))
    np.clip(values, 0.0, MAX_RADIANCE, out=values)
    values *= np.float32(MU)
    np.log1p(values, out=values)
    values *= _LOG_SCALE
    return values


def expand(values: Array, exposure: float) -> Array:
    """Inverse of :func:`compress`. Values outside what ``compress`` yields are clipped, so the result is finite."""
    top = float(np.log1p(MU * MAX_RADIANCE)) * float(_LOG_SCALE)
    radiance = np.clip(values, 0.0, top, out=np.empty(np.shape(values), np.float32))
    radiance /= _LOG_SCALE
    np.expm1(radiance, out=radiance)
    radiance /= np.float32(MU)
    radiance /= np.float32(exposure)
    return radiance


def forward(feature: str, values: Array, exposure: float) -> Array:
    """Values of one feature of :mod:`oiio_msspl.schema`, (..., C), to network values of the same shape."""
    if feature in schema.RADIANCE_FEATURES:
        return compress(values, exposure)
    if feature == schema.VARIANCE:
        # A standard deviation is a radiance: it goes through the same exposure and the same curve.
        return compress(np.sqrt(np.maximum(values, 0.0)), exposure)
    if feature == schema.ALBEDO:
        return np.clip(values, 0.0, MAX_ALBEDO)
    if feature == schema.NORMAL:
        return np.clip(values, -1.0, 1.0)
    raise ValueError(f"unknown feature {feature!r}")


def repair(values: Array, *, signed: bool = False) -> tuple[Array, NDArray[np.bool_] | None]:
    """Make an array finite; unless ``signed``, also non-negative. Returns it and a mask of what was changed.

    NaN becomes 0, infinities the largest half float: the network clips there anyway, and the neighbourhood of an Inf
    is bright in practice. Nothing to repair: the input itself, and no mask.
    """
    if values.size and np.isfinite(values.max()) and np.isfinite(lowest := values.min()) and (signed or lowest >= 0):
        return values, None
    bad = ~np.isfinite(values)
    if not signed:
        bad |= values < 0
    fixed = np.nan_to_num(values, nan=0.0, posinf=MAX_RADIANCE, neginf=-MAX_RADIANCE if signed else 0.0)
    return (fixed if signed else np.maximum(fixed, 0.0)).astype(np.float32), bad


def srgb(linear: Array) -> Array:
    """The paper's display transform (equation for s): scene linear to sRGB in [0, 1]."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(np.maximum(x, 1e-12), 1 / 2.4) - 0.055).astype(
        np.float32
    )


def box_downsample(image: Array, scale: int) -> Array:
    """Mean over ``scale`` x ``scale`` pixels: (H, W, C) to (H/s, W/s, C)."""
    # Sums of strided views: ten times as fast as the mean over short axes, wherever channels lie in memory
    rows = reduce(np.add, (image[y::scale] for y in range(scale)))
    return reduce(np.add, (rows[:, x::scale] for x in range(scale))) * np.float32(1 / scale**2)
