# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise (OIDN) on renders: what a user can do without this project's networks."""

from __future__ import annotations

import numpy as np

from benchmarks.oidn import denoise, denoise_prefiltered
from benchmarks.scenes import beauty
from oiio_msspl import schema, tensors, transforms
from oiio_msspl.comparison import upsample_bicubic
from oiio_msspl.denoiser import Denoiser, aovs_of_lrhs
from oiio_msspl.pairing import Source
from oiio_msspl.render import Array
from oiio_msspl.transforms import box_downsample, repair


def oidn(source: Source, quality: str = "high") -> Array:
    """OIDN's plain call on a render, with its noisy albedo and normal if it has them."""
    return denoise(**_inputs(source), quality=quality)


def oidn_prefiltered(source: Source) -> Array:
    """OIDN as its documentation recommends it: the albedo and the normal are denoised first."""
    return denoise_prefiltered(**_inputs(source))


def _inputs(source: Source) -> dict[str, Array]:
    """``color``, ``albedo`` and ``normal`` of a render, as far as it has them. OIDN takes no normal without albedo."""
    layers = source.read(source.data_window)
    layers = {name: np.ascontiguousarray(repair(v, signed=name == "normal")[0]) for name, v in layers.items()}
    auxiliary = ("albedo", "normal") if "albedo" in layers else ()
    return {"color": layers["rgb"]} | {name: layers[name] for name in auxiliary if name in layers}


def oidn_on_average(lrhs: Source, hrls: Source) -> Array:
    """OIDN on the weighted mean of both renders at the LRHS's resolution, in 32 bits; linear (h / s, w / s, 3)."""
    low = beauty(lrhs)
    exposure = transforms.exposure_of(low)
    layers = tensors.read(hrls, hrls.data_window, hrls.data_window)
    packed = tensors.pack(layers, schema.HRLS_FEATURES, exposure)
    names = aovs_of_lrhs(packed.shape[0] // low.shape[0])
    low_aovs = tensors.read(lrhs, lrhs.data_window, lrhs.data_window, features=names) if names else {}
    denoised = Denoiser(exact=True).together(transforms.compress(low, exposure), packed, low_aovs)
    return transforms.expand(denoised, exposure)


def match_local_means(image: Array, low: Array) -> Array:
    """Multiply an image (h, w, 3) by a smooth ratio that gives it the local means of a smaller one (h/s, w/s, 3)."""
    height, width = image.shape[:2]
    means = box_downsample(image, height // low.shape[0])
    return image * upsample_bicubic(((low + 1e-3) / (means + 1e-3)).astype(np.float32), width, height)
