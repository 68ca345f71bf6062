# SPDX-License-Identifier: Apache-2.0
"""Between a render's values and the network's, and back: pure NumPy, used by training and by inference alike.

Radiance is first scaled by the exposure of the LRHS, so that the network sees every scene at the same brightness and
scaling a scene scales its output; then compressed by a logarithm, so that errors in shadows and in highlights weigh
alike. The paper feeds linear values clipped at 100; a log keeps highlights without letting them rule the loss.
"""

from __future__ import annotations

import numpy as np

from oiio_msspl.aovs.features import ALBEDO, DEFAULTS, NORMAL, RADIANCE_FEATURES, RGB, VARIANCE
from oiio_msspl.arrays import Array, clip, map_rows
from oiio_msspl.colour import luminance

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


def find_exposure(lrhs_rgb: Array) -> float:
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


def encode_radiance(radiance: Array, exposure: float, out: Array | None = None) -> Array:
    """Scene-linear radiance >= 0 to network values: ``log(1 + mu e x) / log(1 + mu)``; into ``out``, if given."""

    def steps(values: Array) -> None:
        values *= np.float32(exposure)
        np.clip(values, 0.0, MAX_RADIANCE, out=values)
        values *= np.float32(MU)
        np.log1p(values, out=values)
        values *= _LOG_SCALE

    return map_rows(steps, radiance, out)


def decode_radiance(values: Array, exposure: float, out: Array | None = None) -> Array:
    """Inverse of :func:`compress`. Values outside what ``compress`` yields are clipped, so the result is finite."""
    top = float(np.log1p(MU * MAX_RADIANCE)) * float(_LOG_SCALE)

    def steps(radiance: Array) -> None:
        np.clip(radiance, 0.0, top, out=radiance)
        radiance /= _LOG_SCALE
        np.expm1(radiance, out=radiance)
        radiance /= np.float32(MU)
        radiance /= np.float32(exposure)

    return map_rows(steps, values, out)


def encode_feature(feature: str, values: Array, exposure: float, out: Array | None = None) -> Array:
    """Values of one feature of :mod:`oiio_msspl.aovs.features`, (..., C), to network values of the same shape; into ``out``,
    if given."""
    if feature in RADIANCE_FEATURES:
        return encode_radiance(values, exposure, out)
    if feature == VARIANCE:
        # A standard deviation is a radiance: it goes through the same exposure and the same curve.
        return encode_radiance(np.sqrt(np.maximum(values, 0.0)), exposure, out)
    if feature == ALBEDO:
        return clip(values, 0.0, MAX_ALBEDO, out)
    if feature == NORMAL:
        return clip(values, -1.0, 1.0, out)
    raise ValueError(f"unknown feature {feature!r}")


def encode_features(layers: dict[str, Array], features: dict[str, int], exposure: float, channels: int = 0) -> Array:
    """Stack repaired features (h, w, c) in the order of the schema, transformed; absent ones at their default.

    Args:
        channels: of the result, if more than the features have; what is in the rest is undefined.

    Returns:
        float32 (h, w, channels), one channel after the other in memory, as the network wants them.
    """
    height, width = layers[RGB].shape[:2]
    channels = max(channels, sum(features.values()))
    stack = np.empty((channels, height, width), dtype=np.float32).transpose(1, 2, 0)
    position = 0
    for name, count in features.items():
        target = stack[..., position : position + count]
        if name in layers:
            encode_feature(name, layers[name], exposure, target)
        else:
            target[...] = DEFAULTS[name]
        position += count
    return stack
