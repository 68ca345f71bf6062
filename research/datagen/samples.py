# SPDX-License-Identifier: Apache-2.0
"""Views that keep every sample with its place in the pixel, so that any pixel filter can be applied afterwards.

A file is an uncompressed ``.npz`` named ``<renderer>-<seed>-<view>.samples.npz``. K samples a pixel are for the HRLS:

* ``place``: uint8 (K, H, W, 2), x and y in the pixel in steps of 1/256, from the left and from the top;
* ``color``, ``diffuse``, ``specular``: uint32 (K, H, W), radiance with a shared exponent, see :func:`encode`;
* ``albedo``: uint8 (K, H, W, 3), 255 is 1; ``normal``: int8 (K, H, W, 3), 127 is 1;
* ``depth``: float16 (K, H, W), distance of the first hit in metres, 0 where the sample sees the background (so alpha is
  1 where it is positive).

Others are for the LRHS and independent: ``lr_place``, ``lr_color``, ``lr_albedo``, ``lr_normal``, (L, H, W...). L
samples a pixel are L * s^2 samples for each LRHS pixel at scale s.

* ``ref``: uint32 (R * H, R * W), the reference at R = ``REF_CELLS`` times the resolution, filtered with a box of one of
  its own pixels. Filters for the reference are applied to these cells. It is independent of all samples.
  In views of the split ``NO_REFERENCE``, it is the mean of the samples for the LRHS.
* ``ref_albedo`` and ``ref_normal``: as ``albedo`` and ``normal``, (R * H, R * W, 3), of a reference that is to be
  denoised.
* ``meta``: a JSON string, as in :mod:`research.datagen.views`.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from research.datagen.quality import log_mean

#: Height and width of a view in pixels.
SIZE = 384
#: Samples per pixel for the HRLS and for the LRHS.
HR_SAMPLES, LR_SAMPLES = 12, 4
#: The smallest step of :func:`encode`, and its largest mantissa.
STEP, MANTISSA = 2.0**-24, 511


def encode(radiance: NDArray[Any]) -> NDArray[np.uint32]:
    """Three channels (..., 3) as uint32 (...): 9 bits each and an exponent of 5 bits, as OpenGL's ``RGB9_E5``.

    Values are clipped to 0 ... 65408. The error is at most 1/511 of the largest channel.
    """
    values = np.clip(radiance, 0, 65408).astype(np.float64)
    largest = np.maximum(values.max(axis=-1), STEP)
    exponent = np.clip(np.floor(np.log2(largest)) + 16, 0, 31)
    exponent = np.where(np.rint(largest / (STEP * 2.0**exponent)) > MANTISSA, exponent + 1, exponent)
    r, g, b = np.moveaxis(np.rint(values / (STEP * 2.0**exponent)[..., None]).astype(np.uint32), -1, 0)
    return (r | g << 9 | b << 18 | exponent.astype(np.uint32) << 27).astype(np.uint32)


def pack(
    hr: dict[str, np.ndarray],
    lr: dict[str, np.ndarray],
    ref: np.ndarray,
    rng: np.random.Generator,
    meta: dict,
    ref_layers: dict[str, np.ndarray] | None = None,
) -> dict[str, np.ndarray]:
    """All arrays of a view's file, at a random exposure within three decades.

    Args:
        hr: ``place``, ``color``, ``albedo``, ``normal``, ``diffuse``, ``specular``, ``depth``, each (K, H, W, C).
        lr: the first four of them, each (L, H, W, C).
        ref: (R * H, R * W, 3).
        meta: entries of ``meta``; the exposure is added.
        ref_layers: ``albedo`` and ``normal`` of the reference, to be stored with it.
    """
    target = 10 ** rng.uniform(-1.5, 1.3)
    scale = target / log_mean(ref)

    def stored(name: str, values: np.ndarray) -> np.ndarray:
        if name == "place":
            return np.floor(values * 256).clip(0, 255).astype(np.uint8)
        if name == "albedo":
            return np.rint(values.clip(0, 1) * 255).astype(np.uint8)
        if name == "normal":
            return np.rint(values.clip(-1, 1) * 127).astype(np.int8)
        if name == "depth":
            return values[..., 0].clip(0, 65504).astype(np.float16)
        return encode(values * scale)

    return {
        **{name: stored(name, values) for name, values in hr.items()},
        **{f"lr_{name}": stored(name, values) for name, values in lr.items()},
        "ref": encode(ref * scale),
        **{f"ref_{name}": stored(name, values) for name, values in (ref_layers or {}).items()},
        "meta": np.array(json.dumps({**meta, "exposure": {"scale": scale, "log_mean": target}})),
    }
