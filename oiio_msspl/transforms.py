# SPDX-License-Identifier: Apache-2.0
"""Between a render's values and the network's, and back: pure NumPy, used by training and by inference alike.

Radiance is first scaled by the exposure of the LRHS, so that the network sees every scene at the same brightness and
scaling a scene scales its output; then compressed by a logarithm, so that errors in shadows and in highlights weigh
alike. The paper feeds linear values clipped at 100; a log keeps highlights without letting them rule the loss.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl import bands, schema

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


def compress(radiance: Array, exposure: float, out: Array | None = None) -> Array:
    """Scene-linear radiance >= 0 to network values: ``log(1 + mu e x) / log(1 + mu)``; into ``out``, if given."""

    def steps(values: Array) -> None:
        values *= np.float32(exposure)
        np.clip(values, 0.0, MAX_RADIANCE, out=values)
        values *= np.float32(MU)
        np.log1p(values, out=values)
        values *= _LOG_SCALE

    return in_place(steps, radiance, out)


def expand(values: Array, exposure: float, out: Array | None = None) -> Array:
    """Inverse of :func:`compress`. Values outside what ``compress`` yields are clipped, so the result is finite."""
    top = float(np.log1p(MU * MAX_RADIANCE)) * float(_LOG_SCALE)

    def steps(radiance: Array) -> None:
        np.clip(radiance, 0.0, top, out=radiance)
        radiance /= _LOG_SCALE
        np.expm1(radiance, out=radiance)
        radiance /= np.float32(MU)
        radiance /= np.float32(exposure)

    return in_place(steps, values, out)


def in_place(steps: Callable[[Array], object], source: Array, out: Array | None = None) -> Array:
    """A float32 copy of ``source``, in ``out`` if given, that ``steps`` have changed: band by band, every value for
    itself."""
    result = np.empty(np.shape(source), np.float32) if out is None else out

    def work(rows: slice) -> None:
        part = np.array(source[rows], np.float32)  # as the source lies in memory, whichever way the result does
        steps(part)
        result[rows] = part

    bands.each(work, len(result), result[0].size if len(result) else 0)
    return result


def forward(feature: str, values: Array, exposure: float, out: Array | None = None) -> Array:
    """Values of one feature of :mod:`oiio_msspl.schema`, (..., C), to network values of the same shape; into ``out``,
    if given."""
    if feature in schema.RADIANCE_FEATURES:
        return compress(values, exposure, out)
    if feature == schema.VARIANCE:
        # A standard deviation is a radiance: it goes through the same exposure and the same curve.
        return compress(np.sqrt(np.maximum(values, 0.0)), exposure, out)
    if feature == schema.ALBEDO:
        return limited(values, 0.0, MAX_ALBEDO, out)
    if feature == schema.NORMAL:
        return limited(values, -1.0, 1.0, out)
    raise ValueError(f"unknown feature {feature!r}")


def limited(values: Array, lowest: float, highest: float, out: Array | None = None) -> Array:
    """The values within bounds."""
    return in_place(lambda part: np.clip(part, lowest, highest, out=part), values, out)


def repair(values: Array, *, signed: bool = False) -> tuple[Array, NDArray[np.bool_] | None]:
    """Make an array finite; unless ``signed``, also non-negative. Returns it and a mask of what was changed.

    NaN becomes 0, infinities the largest half float: the network clips there anyway, and the neighbourhood of an Inf
    is bright in practice. Nothing to repair: the input itself, and no mask.
    """
    bounds: list[tuple[Any, Any]] = []

    def work(rows: slice) -> None:
        part = values[rows]
        bounds.append((part.min(), part.max()))

    if values.size:
        bands.each(work, len(values), values[0].size)
        if np.isfinite(bounds).all() and (signed or min(bounds)[0] >= 0):
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
    """Mean over ``scale`` x ``scale`` pixels: (H, W, ...) to (H/s, W/s, ...)."""
    height, width, *channels = image.shape
    result = np.empty((height // scale, width // scale, *channels), np.float32)

    def work(rows: slice) -> None:
        # Sums of strided views: ten times as fast as the mean over short axes, wherever channels lie in memory
        part = image[rows]
        sums = reduce(np.add, (part[y::scale] for y in range(scale)))
        total = reduce(np.add, (sums[:, x::scale] for x in range(scale)))
        np.multiply(total, np.float32(1 / scale**2), out=result[rows.start // scale : rows.stop // scale])

    bands.each(work, height, image[0].size, multiple=scale)
    return result
