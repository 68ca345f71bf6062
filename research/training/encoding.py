# SPDX-License-Identifier: Apache-2.0
"""Encodings in PyTorch: log-encoded radiance, the PU curve, exposure, the stack of features.

Inference has NumPy versions of all but the PU curve; tests hold the two together.

The PU curve is how Open Image Denoise encodes HDR colour for its networks. It is a fit to the PU (perceptually uniform)
encoding of Aydin et al. 2008, "Extending Quality Metrics to Full Luminance Range Images": linear near black, then a
power, then a logarithm. The constants are those of ``core/color.h`` in Open Image Denoise.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from oiio_msspl.aovs.features import ALBEDO, DEFAULTS, HRLS_FEATURES, NORMAL, RADIANCE_FEATURES, RGB, VARIANCE
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.colour import LUMINANCE_WEIGHTS
from oiio_msspl.model.encoding import MAX_ALBEDO, MAX_RADIANCE, MU, find_exposure

#: Factor of the logarithm, which makes a log-encoded radiance of 1 a 1.
LOG_SCALE = 1.0 / math.log1p(MU)

#: The PU curve: radiance at which the linear segment ends, and the power segment; constants of the three segments.
BOUNDS = (1.57945760e-06, 3.22087631e-02)
SLOPE = 1.41283765e03
FACTOR, EXPONENT, OFFSET = 1.64593172e00, 4.31384981e-01, -2.94139609e-03
LOG_FACTOR, LOG_SHIFT, LOG_OFFSET = 1.92653254e-01, 6.26026094e-03, 9.98620152e-01
#: Value of the curve at ``MAX_RADIANCE``; dividing by it normalises the curve to [0, 1].
PU_MAX = LOG_FACTOR * math.log(MAX_RADIANCE + LOG_SHIFT) + LOG_OFFSET


# Log-encoded radiance, what every network reads and writes


def log_encode(radiance: Tensor) -> Tensor:
    """Encode exposed radiance >= 0, as :func:`oiio_msspl.model.encoding.encode_radiance`."""
    return torch.log1p(MU * radiance) * LOG_SCALE


def log_decode(encoded: Tensor) -> Tensor:
    """Decode to exposed radiance, as :func:`oiio_msspl.model.encoding.decode_radiance`."""
    return torch.expm1(encoded / LOG_SCALE) / MU


# The PU curve, what Open Image Denoise's networks read and write


def pu_encode(radiance: Tensor) -> Tensor:
    """Encode radiance in [0, MAX_RADIANCE] to [0, 1]."""
    low, middle = BOUNDS
    power = FACTOR * radiance.clamp_min(low) ** EXPONENT + OFFSET
    curve = torch.where(radiance <= middle, power, LOG_FACTOR * torch.log(radiance + LOG_SHIFT) + LOG_OFFSET)
    return torch.where(radiance <= low, SLOPE * radiance, curve) / PU_MAX


def pu_decode(encoded: Tensor) -> Tensor:
    """Decode [0, 1] to radiance."""
    curve = encoded * PU_MAX
    low, middle = (pu_encode(torch.tensor(BOUNDS, dtype=torch.double)) * PU_MAX).tolist()
    # The branches are bounded: an infinity that torch.where discards would still make its gradient NaN.
    power = ((curve.clamp(low, middle) - OFFSET) / FACTOR) ** (1 / EXPONENT)
    logarithm = torch.exp((curve.clamp_min(middle) - LOG_OFFSET) / LOG_FACTOR) - LOG_SHIFT
    radiance = torch.where(curve <= middle, power, logarithm)
    return torch.where(curve <= low, curve / SLOPE, radiance)


def log_to_pu(encoded: Tensor) -> Tensor:
    """Convert log-encoded to PU-encoded radiance."""
    return pu_encode(log_decode(encoded.float()).clamp(0.0, MAX_RADIANCE))


def pu_to_log(encoded: Tensor) -> Tensor:
    """Convert PU-encoded to log-encoded radiance."""
    return log_encode(pu_decode(encoded))


# Renders


def luminance(rgb: Tensor) -> Tensor:
    """Return the Rec. 709 luminance (...) of linear RGB (..., 3)."""
    return rgb @ rgb.new_tensor(LUMINANCE_WEIGHTS)


def srgb(exposed: Tensor) -> Tensor:
    """Convert exposed radiance to sRGB values in [0, 1]."""
    exposed = exposed.clamp(0.0, 1.0)
    return torch.where(exposed <= 0.0031308, 12.92 * exposed, 1.055 * exposed.clamp_min(0.0031308) ** (1 / 2.4) - 0.055)


def from_srgb(encoded: Tensor) -> Tensor:
    """Convert sRGB values in [0, 1] to linear ones."""
    return torch.where(encoded <= 0.04045, encoded / 12.92, ((encoded.clamp_min(0.0) + 0.055) / 1.055) ** 2.4)


def repair(values: Tensor, *, signed: bool = False) -> Tensor:
    """Convert stored half floats to finite float32, non-negative unless ``signed``."""
    values = torch.nan_to_num(values.float(), nan=0.0, posinf=MAX_RADIANCE, neginf=-MAX_RADIANCE)
    return values if signed else values.clamp_min(0.0)


def exposure_of(lrhs: Tensor) -> Tensor:
    """Return the exposure (N,) of each image (N, h, w, 3)."""
    return lrhs.new_tensor([find_exposure(image.cpu().numpy()) for image in lrhs])


def compress(radiance: Tensor, exposure: Tensor) -> Tensor:
    """Expose and log-encode scene-linear images (N, H, W, C), with an exposure (N,) for each."""
    return log_encode((radiance * exposure[:, None, None, None]).clamp(0.0, MAX_RADIANCE))


def exposed_feature(name: str, values: Tensor, exposure: Tensor) -> Tensor:
    """Bring a feature of :mod:`oiio_msspl.aovs.features` into the range that networks know, in linear values.

    Radiance is multiplied by the exposure. A variance becomes a standard deviation, which is a radiance. Albedo and
    normal are clipped.
    """
    if name == VARIANCE:
        values = values.clamp_min(0.0).sqrt()
    if name in (*RADIANCE_FEATURES, VARIANCE):
        return (values * exposure).clamp(0.0, MAX_RADIANCE)
    return values.clamp(0.0, MAX_ALBEDO) if name == ALBEDO else values.clamp(-1.0, 1.0)


def encoded_feature(name: str, exposed: Tensor) -> Tensor:
    """Encode a feature of :func:`exposed_feature` as networks read it: radiance and deviation are log-encoded."""
    return exposed if name in (ALBEDO, NORMAL) else log_encode(exposed)


def pack(features: dict[str, Tensor], exposure: Tensor) -> Tensor:
    """Encode and stack the features of an HRLS: (N, H, W, C) by name to (N, H, W, 16).

    A missing feature gets its default.
    """
    factors, rgb = exposure[:, None, None, None], features[RGB]
    stack = [
        encoded_feature(name, exposed_feature(name, features[name], factors))
        if name in features
        else rgb.new_full((*rgb.shape[:3], count), DEFAULTS[name])
        for name, count in HRLS_FEATURES.items()
    ]
    return torch.cat(stack, dim=-1)


def packed(features: dict[str, Array], exposure: float) -> Array:
    """Encode and stack the features of one HRLS in NumPy: (H, W, C) by name to (H, W, 16)."""
    tensors = {name: torch.from_numpy(np.ascontiguousarray(values))[None] for name, values in features.items()}
    return pack(tensors, torch.tensor([exposure]))[0].numpy()
